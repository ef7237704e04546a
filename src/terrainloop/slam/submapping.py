"""Submapping: posed scans, joined into upright submaps of a bounded length of drive.

Short is right: the drift of odometry within a submap stays in its loops. A submap has to be so long that it
shares ground with one that was driven from another side, which depends on how far the sensor sees
(docs/slam.md).
"""

import logging
from dataclasses import dataclass, field

import numpy as np

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array, inverse, levelled, transform
from terrainloop.scan import PosedScan
from terrainloop.submap import Submap

logger = logging.getLogger(__name__)

REACH_PERCENTILE = 90.0  # of the ranges of a scan: how far the sensor sees
REACH_SCANS = 20  # first scans whose median that is
LENGTH_OF_REACH = 0.7  # length of drive of a submap, in reaches
RANGE_OF_REACH = 1.5  # reaches, beyond which points are too few to be of use
LEAST_MOTION = 0.02  # of the length of a submap: a scan after less shows what the one before did ...
LEAST_TURN_DEG = 5.0  # ... unless the sensor turned
MAX_SCAN_POINTS = 10_000
MAX_SUBMAP_POINTS = 60_000


@dataclass(frozen=True, eq=False)
class PosedSubmap:
    """A submap, and where odometry puts it.

    Attributes
    ----------
    submap : Submap
        Its frame is upright, and that of the middle one of its scans.
    T_world_submap : array, (4, 4)
    """

    submap: Submap
    T_world_submap: Array


@dataclass(eq=False)
class Submapper:
    """Joins posed scans into submaps as they come, in bounded memory.

    A submap ends with the length of the drive, or with a full turn on the spot.

    Parameters
    ----------
    length : float, optional
        Metres driven in one submap; by default 0.7 times how far the sensor sees.
    min_range : float
        Metres: what is nearer to the sensor is the vehicle.
    seed : int
        Of the points that are drawn where there are too many.
    each_scan : bool
        Whether each scan is a submap already, as the clouds of a mission are.
    """

    length: float | None = None
    min_range: float = 0.5
    seed: int = 0
    each_scan: bool = False
    _count: int = 0
    _reaches: list[float] = field(default_factory=list)
    _scans: list[PosedScan] = field(default_factory=list)
    _points: list[Array] = field(default_factory=list)
    _driven: float = 0.0
    _turned: float = 0.0

    def add(self, posed: PosedScan) -> PosedSubmap | None:
        """The submap that ends before this scan, if one does."""
        if self.each_scan:
            finished = self.finish()
            self._scans, self._points = [posed], [transform(posed.T_world_sensor, posed.scan.points)]
            return finished
        points = self._usable(posed)
        if not len(points):
            return None
        moved, turned = _motion(self._scans[-1], posed) if self._scans else (np.inf, np.inf)
        if moved < LEAST_MOTION * self._length and turned < np.radians(LEAST_TURN_DEG):
            return None
        finished = None
        if self._scans:
            self._driven, self._turned = self._driven + moved, self._turned + turned
            if self._driven > self._length or self._turned > 2 * np.pi:
                finished = self.finish()
        self._scans.append(posed)
        self._points.append(points)
        return finished

    def finish(self) -> PosedSubmap | None:
        """The submap of the scans since the last one, if any ground can be mapped of it."""
        scans, points = self._scans, self._points
        self._scans, self._points, self._driven, self._turned = [], [], 0.0, 0.0
        if not scans:
            return None
        middle = scans[len(scans) // 2]
        T_world_submap = levelled(middle.T_world_sensor)
        joined = np.concatenate(points)
        joined = _thinned(joined, MAX_SUBMAP_POINTS, np.random.default_rng([self.seed, self._count]))
        name = f"{self._count:06d}"
        try:
            submap = Submap(transform(inverse(T_world_submap), joined), name=name, stamp=middle.scan.stamp)
        except TerrainLoopError as error:
            logger.warning("no submap of %d scans: %s", len(scans), error)
            return None
        self._count += 1
        return PosedSubmap(submap, T_world_submap)

    @property
    def _reach(self) -> float:
        return float(np.median(self._reaches))

    @property
    def _length(self) -> float:
        return self.length or LENGTH_OF_REACH * self._reach

    def _usable(self, posed: PosedScan) -> Array:
        """Points of a scan in the world, without the vehicle and what is too far."""
        points = posed.scan.points
        ranges = np.linalg.norm(points, axis=1)
        points, ranges = points[ranges >= self.min_range], ranges[ranges >= self.min_range]
        if not len(points):
            return points
        if len(self._reaches) < REACH_SCANS:
            self._reaches.append(float(np.percentile(ranges, REACH_PERCENTILE)))
        points = points[ranges <= RANGE_OF_REACH * self._reach]
        rng = np.random.default_rng([self.seed, self._count, len(self._scans)])
        return transform(posed.T_world_sensor, _thinned(points, MAX_SCAN_POINTS, rng))


def _motion(before: PosedScan, after: PosedScan) -> tuple[float, float]:
    """Metres and radians that the sensor moved between two scans."""
    T = inverse(before.T_world_sensor) @ after.T_world_sensor
    turn = np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))
    return float(np.linalg.norm(T[:3, 3])), float(turn)


def _thinned(points: Array, count: int, rng: np.random.Generator) -> Array:
    """Points drawn without regard to where they are: their noise stays as it is."""
    return points if len(points) <= count else points[np.sort(rng.permutation(len(points))[:count])]
