"""Scored pairs against ground truth: how much ground each pair shares, and the error of each pose."""

from collections.abc import Sequence
from dataclasses import dataclass
from reprlib import repr as shown  # quotes a name, and cuts one that is too long for a message
from typing import Generic, Protocol, TypeVar

import numpy as np

from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.truth import GroundTruth
from terrainloop.geometry import Array, inverse, is_rigid, yaw_of
from terrainloop.record import SubmapRecord

POSITION_TOLERANCE = 1.0  # metres, within the two bounds below
TOLERANCE_BY_SIZE = (0.02, 0.1)  # least and most of the size of a submap that a position may be off
YAW_TOLERANCE = float(np.deg2rad(5.0))


@dataclass(frozen=True)
class Tolerance:
    """Errors below which a pose is right.

    Attributes
    ----------
    position : float
        Horizontal error at the middle of the source, metres.
    yaw : float
        Radians.
    """

    position: float = POSITION_TOLERANCE
    yaw: float = YAW_TOLERANCE

    def __post_init__(self) -> None:
        for name, value in (("position", self.position), ("yaw", self.yaw)):
            if not (np.isfinite(value) and value > 0):
                raise TerrainLoopError(
                    expected=f"a {name} tolerance above 0", found=f"{value:g}", mend="give a finite number"
                )

    @classmethod
    def for_submaps(
        cls, records: Sequence[SubmapRecord], position: float | None = None, yaw: float | None = None
    ) -> "Tolerance":
        """The tolerance for submaps of this size: the given one, else the default.

        The default position tolerance is 1 m, but at least 2 % and at most 10 % of the size of the
        submaps: 1 m for submaps of 10 to 50 m, 0.5 m at 5 m, 10 m at 500 m. Their size is the square root
        of the area of the hull, in the median. The default yaw tolerance is 5 degrees at any size.

        Parameters
        ----------
        records : sequence of SubmapRecord
        position : float, optional
            Metres.
        yaw : float, optional
            Radians.
        """
        if position is None:
            sizes = [_size(record.hull) for record in records if record.status == "ok"]
            low, high = (share * float(np.median(sizes)) for share in TOLERANCE_BY_SIZE) if sizes else (0, 1)
            position = float(f"{np.clip(POSITION_TOLERANCE, low, high):.2g}")
        return cls(position, YAW_TOLERANCE if yaw is None else yaw)


class ScoredPair(Protocol):
    """A pair of submaps as any method scores it; a LoopCandidate is one."""

    @property
    def source(self) -> str:
        """Name of one submap."""

    @property
    def target(self) -> str:
        """Name of the other."""

    @property
    def score(self) -> float:
        """Higher is more certain; minus infinity if the two could not be compared."""

    @property
    def T_target_source(self) -> Array:
        """Takes points of source into the frame of target (4 x 4); NaN where there is none."""


Pair = TypeVar("Pair", bound=ScoredPair, covariant=True)


@dataclass(frozen=True, eq=False)
class EvaluatedPair(Generic[Pair]):
    """A scored pair with its true overlap and the errors of its pose.

    Attributes
    ----------
    candidate : ScoredPair
        The pair as it was given.
    query : int
        Index of the later of the two submaps in the mission.
    overlap : float
        Intersection over union of the posed submaps' bounding boxes, 0 to 1.
    observed_overlap : float
        The same of the ground that they observed; NaN where it was not given.
    position_error : float
        Horizontal distance between the estimated and the true position of the source in the target
        frame, at the middle of the source, metres; NaN without a transform.
    height_error : float
        The same, vertically.
    yaw_error : float
        Radians.
    rotation_error : float
        Angle of the whole rotation between the estimated and the true pose, radians.
    tolerance : Tolerance
        Errors below which the pose is right.
    """

    candidate: Pair
    query: int
    overlap: float
    observed_overlap: float
    position_error: float
    height_error: float
    yaw_error: float
    rotation_error: float
    tolerance: Tolerance

    @property
    def pose_is_right(self) -> bool:
        """Whether both errors are within the tolerance."""
        return self.position_error < self.tolerance.position and self.yaw_error < self.tolerance.yaw

    def is_within(self, distance: float, angle: float) -> bool:
        """Whether the pose is off by less than a distance in space, metres, and an angle, radians."""
        return float(np.hypot(self.position_error, self.height_error)) < distance and (
            self.rotation_error < angle
        )


def evaluate_pairs(
    pairs: Sequence[Pair], truth: GroundTruth, tolerance: Tolerance | None = None
) -> list[EvaluatedPair[Pair]]:
    """Compare scored pairs with ground truth, leaving out those that odometry already connects.

    Parameters
    ----------
    pairs : sequence of ScoredPair
        Each pair of submaps at most once.
    truth : GroundTruth
    tolerance : Tolerance, optional
        Default: that of `Tolerance.for_submaps`.

    Raises
    ------
    TerrainLoopError
        If a pair names a submap that is unknown or broken, joins a submap to itself, appears twice, has a
        score that is NaN or infinite, or a transform that is neither rigid nor all NaN.
    """
    _check_pairs(pairs, truth)
    tolerance = tolerance or Tolerance.for_submaps(truth.records)
    evaluated = []
    for pair in pairs:
        i, j = truth.index[pair.source], truth.index[pair.target]
        if not truth.are_connected(i, j):
            errors = _errors(pair.T_target_source, i, j, truth)
            overlap = float(truth.box_overlap[i, j])
            observed = float("nan") if truth.observed is None else float(truth.observed[i, j])
            evaluated.append(EvaluatedPair(pair, max(i, j), overlap, observed, *errors, tolerance))
    return evaluated


def _errors(T_target_source: Array, i: int, j: int, truth: GroundTruth) -> tuple[float, float, float, float]:
    """Errors of position, height, yaw and rotation of the pose of submap i in the frame of submap j."""
    true = inverse(truth.poses[j]) @ truth.poses[i]
    middle = np.array([*truth.records[i].hull.mean(axis=0), 0.0, 1.0])
    x, y, z = (T_target_source @ middle - true @ middle)[:3]
    rotation = inverse(true) @ T_target_source
    half_sine = np.linalg.norm(rotation[:3, :3] - np.eye(3)) / np.sqrt(8)  # |R - I| = sqrt(8) sin(angle / 2)
    angle = 2 * np.arcsin(np.minimum(half_sine, 1.0))
    return float(np.hypot(x, y)), float(abs(z)), abs(yaw_of(rotation)), float(angle)


def _size(hull: Array) -> float:
    """Side of the square that has the area of a convex hull."""
    x, y = (hull - hull[0]).T
    return float(np.sqrt(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2))


def _check_pairs(pairs: Sequence[ScoredPair], truth: GroundTruth) -> None:
    seen: set[frozenset[str]] = set()
    for pair in pairs:
        what = _fault_of(pair, truth, seen)
        if what is not None:
            raise TerrainLoopError(
                expected=what[0],
                found=f"{what[1]} for the pair {shown(pair.source)}, {shown(pair.target)}",
                mend="use pairs.csv and submaps.csv of one run, as 'terrainloop detect' wrote them",
            )
        seen.add(frozenset((pair.source, pair.target)))


def _fault_of(pair: ScoredPair, truth: GroundTruth, seen: set[frozenset[str]]) -> tuple[str, str] | None:
    """What was expected of a pair and what was found, or None if nothing is wrong."""
    T = np.asarray(pair.T_target_source)
    for name in (pair.source, pair.target):
        if name not in truth.index:
            return "every submap of pairs.csv in submaps.csv", f"no {shown(name)}"
        if truth.records[truth.index[name]].status != "ok":
            return "pairs of submaps that could be read", f"{shown(name)}, which is marked as broken,"
    if pair.source == pair.target:
        return "pairs of two different submaps", "one and the same submap"
    if frozenset((pair.source, pair.target)) in seen:
        return "every pair once", "a second line"
    if np.isnan(pair.score) or pair.score == np.inf:
        return "a score that is a number (minus infinity if not comparable)", f"{pair.score}"
    if not (is_rigid(T) or np.isnan(T[:3]).all()):
        return "a rigid transform with finite coordinates, or none (all NaN)", "something else"
    return None
