"""What the submaps of a sensor have in common in its own frame, measured and subtracted.

Ground does not recur at one place of a submap's own frame; a disparity bias of a camera, the range errors of
a LiDAR's rings or parts of the rover do. As a flat field is in photography, the mean gradient of the other
submaps, each in its own frame, is what the sensor adds; it is subtracted from the maps where it is
significant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import Array
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.overlay import agreement_at

MIN_SUBMAPS = 4  # that a mean is taken of
MIN_COVER = 0.67  # of the submaps that see a pixel: fewer, and the frame is that of the ground
MIN_SHARE = 0.05  # of the gradients' energy: less does no harm (docs/matching.md, section 3)
SIGNIFICANT = 5.0  # standard deviations of the mean squared significance
WINDOW = 2.0  # length scales over which the significance of the mean is averaged
MAX_PIXELS = 4  # times the largest map, that frames laid over each other may take
TYPICAL = 0.5  # of the share, that the median pair has in common: less, and it is ground that some share
PRESENT = 0.5  # of the pattern, that a submap must have: with less it is of another sensor
MAX_PAIRS = 300  # that the median is taken of


@dataclass(frozen=True)
class SensorPattern:
    """What submaps have in common in their own frames.

    Attributes
    ----------
    share : float
        Of the energy of the gradients, 0 to 1.
    submaps : int
        Number of submaps it was measured on.
    """

    share: float
    submaps: int

    @property
    def _size(self) -> str:
        return f"{self.share:.0%} of the slopes of {self.submaps} submaps"

    @property
    def subtracted(self) -> str:
        """What the reason of a pair says."""
        return f"a pattern fixed to the sensor ({self._size}) was subtracted"

    def __str__(self) -> str:
        return (
            f"a pattern fixed to the sensor makes up {self._size}; it was subtracted before matching: "
            "calibrate the sensor, or mask what it sees of the vehicle; loops of a vehicle that stood still "
            "need its odometry"
        )


@dataclass(frozen=True, eq=False)
class FlatField:
    """Centred gradients of submaps, weighted, summed in the frame of their sensor.

    Attributes
    ----------
    members : dict of str to (MapEntry, float)
        The submaps and their weights, by id.
    origin, resolution : array (2,), float
        Of the common frame, metres.
    sums : array, (9, rows, columns)
        For each pixel the sums over the submaps that see it, of: 1, w, w^2, w g (2), w^2 g (2), w |g|^2 and
        w^2 |g|^2, with the gradient g of a submap and its weight w.
    """

    members: dict[str, tuple[MapEntry, float]]
    origin: Array
    resolution: float
    sums: Array

    @classmethod
    def of(cls, entries: Sequence[MapEntry], weights: Array) -> "FlatField | None":
        """The flat field, or nothing where the submaps have no common frame or resolution."""
        maps = [entry.gradient_map for entry in entries]
        resolution, origin = maps[0].resolution, np.min([m.origin for m in maps], axis=0)
        ends = np.array([_corner(m, origin, resolution) + m.mask.shape for m in maps])
        extent = ends.max(axis=0)
        most = MAX_PIXELS * max(m.mask.size for m in maps)
        if any(is_far(m) or m.resolution != resolution for m in maps) or extent.astype(float).prod() > most:
            return None
        sums = np.zeros((9, *extent))
        for m, weight in zip(maps, weights, strict=True):
            row, column = _corner(m, origin, resolution)
            rows, columns = m.mask.shape
            sums[:, row : row + rows, column : column + columns] += _summands(m, weight)
        members = {entry.id: (entry, float(w)) for entry, w in zip(entries, weights, strict=True)}
        return cls(members, origin, resolution, sums)

    def pattern(self) -> SensorPattern | None:
        """What the submaps have in common, if it is more than chance, not negligible, and common to most."""
        seen = self.sums[0] >= max(MIN_SUBMAPS, MIN_COVER * len(self.members))
        if not seen.any():
            return None
        _, mean, by_chance = _mean(self.sums[:, seen])
        energy = float((self.sums[7, seen] / self.sums[1, seen]).mean())
        excess = float(((mean**2).sum(axis=0) - by_chance).mean())
        window = WINDOW * self._length_scale / self.resolution
        least = SIGNIFICANT * float(by_chance.mean()) / np.sqrt(max(seen.sum() / window**2, 1.0))
        if not excess > max(least, MIN_SHARE * energy) or not self._is_typical():
            return None
        return SensorPattern(excess / energy, len(self.members))

    def clean(self, entry: MapEntry, settings: Settings) -> MapEntry:
        """The entry less the mean of the others, shrunk by how much of it chance explains nearby.

        As it is where it has no such pattern: a mission may have several sensors.
        """
        g = entry.gradient_map
        if g.resolution != self.resolution or is_far(g):
            return entry
        _, weight_of_entry = self.members.get(entry.id, (None, 0.0))
        sums = self._at(g)
        if weight_of_entry:
            sums -= _summands(g, weight_of_entry)
        count, mean, by_chance = _mean(sums)
        sigma = WINDOW * self._length_scale / g.resolution / 2
        valid = (count >= max(MIN_SUBMAPS - 1, MIN_COVER * (len(self.members) - 1))).astype(float)
        square, chance = (
            cv2.GaussianBlur(image * valid, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
            for image in ((mean**2).sum(axis=0), by_chance)
        )
        weight = valid * np.clip(1.0 - chance / np.maximum(square, 1e-30), 0.0, 1.0)
        of_sensor = weight * mean * g.mask
        if (centred(g) * of_sensor).sum() <= PRESENT * (of_sensor**2).sum():
            return entry
        x, y = (
            (image - part).astype(np.float32)
            for image, part in zip((g.gradient_x, g.gradient_y), weight * mean, strict=True)
        )
        return MapEntry.of(entry.record, replace(g, gradient_x=x, gradient_y=y), settings)

    @property
    def _length_scale(self) -> float:
        return next(iter(self.members.values()))[0].field.length_scale

    def _at(self, g: GradientMap) -> Array:
        """The sums on the pixels of a map; zero beyond the common frame."""
        row, column = _corner(g, self.origin, self.resolution)
        rows, columns = g.mask.shape
        sums = np.zeros((9, rows, columns))
        ends = np.minimum((row + rows, column + columns), self.sums.shape[1:])
        low = np.maximum((row, column), 0)
        if (ends > low).all():
            inside = tuple(slice(a - at, b - at) for a, b, at in zip(low, ends, (row, column), strict=True))
            sums[:, *inside] = self.sums[:, low[0] : ends[0], low[1] : ends[1]]
        return sums

    def _is_typical(self) -> bool:
        """Whether most pairs of submaps have it in common, rather than a few much (ground seen again)."""
        pairs = list(combinations(self.members.values(), 2))
        pairs = pairs[:: -(-len(pairs) // MAX_PAIRS)]
        common = np.array([agreement_at(a.field, b.field, np.eye(3)).correlation for (a, _), (b, _) in pairs])
        weights = np.array([v * w for (_, v), (_, w) in pairs])
        order = common.argsort()
        below = weights[order].cumsum()
        median = common[order[np.searchsorted(below, 0.5 * below[-1])]]
        return bool(median > TYPICAL * np.average(common, weights=weights))


def _corner(g: GradientMap, origin: Array, resolution: float) -> Array:
    """Row and column of the first pixel of a map in a frame."""
    return np.asarray(np.round((np.array(g.origin) - origin) / resolution).astype(int)[::-1])


def _summands(g: GradientMap, weight: float) -> Array:
    """What a map adds to the sums of a `FlatField`."""
    gradient, seen = centred(g), g.mask.astype(float)
    energy = (gradient**2).sum(axis=0)
    w, v = weight, weight**2
    return np.stack([seen, w * seen, v * seen, *(w * gradient), *(v * gradient), w * energy, v * energy])


def _mean(sums: Array) -> tuple[Array, Array, Array]:
    """Number of submaps, weighted mean gradient (2, ...) and variance of that mean, from the sums."""
    count, w, v, energy = sums[0], np.maximum(sums[1], 1e-30), sums[2], sums[8]
    mean = sums[3:5] / w
    squares = energy - 2 * (mean * sums[5:7]).sum(axis=0) + (mean**2).sum(axis=0) * v
    effective = w**2 / np.maximum(v, 1e-30)
    return count, mean, np.maximum(squares, 0.0) / w**2 / np.maximum(1.0 - 1.0 / effective, 1e-3)


def centred(g: GradientMap) -> Array:
    """Gradient (2, rows, columns) less its mean, zero where the ground was not observed."""
    gradient = np.stack([g.gradient_x, g.gradient_y]).astype(float)
    return (gradient - gradient[:, g.mask].mean(axis=1)[:, None, None] if g.mask.any() else gradient) * g.mask


def is_far(g: GradientMap) -> bool:
    """Whether the frame of a map cannot be that of a sensor, which is near what it sees."""
    return bool(g.local_origin.any())
