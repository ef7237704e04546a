"""Patterns fixed to the sensor: found as what submaps of different places have in common, and removed.

Ground does not recur at one place of a submap's own frame; a disparity bias of a camera, the range errors of
a LiDAR's rings or parts of the rover do. As a flat field is in photography, the mean gradient of the other
submaps, each in its own frame, is what the sensor adds; it is subtracted from the maps where it is
significant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import Array

MIN_SUBMAPS = 4  # that a mean is taken of
MIN_COVER = 0.67  # of the submaps that see a pixel: fewer, and the frame is that of the ground
MIN_SHARE = 0.05  # of the gradients' energy: less does no harm (docs/matching.md, section 3)
SIGNIFICANT = 5.0  # standard deviations of the mean squared significance
WINDOW = 2.0  # length scales over which the significance of the mean is averaged
MAX_PIXELS = 4  # times the largest map, that frames laid over each other may take

Place = tuple[slice, slice]


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

    def __str__(self) -> str:
        return (
            f"a pattern fixed to the sensor makes up {self.share:.0%} of the slopes of {self.submaps} "
            "submaps; it was subtracted before matching: calibrate the sensor, or mask what it sees of the "
            "vehicle"
        )


@dataclass(frozen=True, eq=False)
class _Stack:
    """Centred gradients of submaps summed in one frame: count, sums (2, ...) and energy of each pixel."""

    places: list[Place]
    count: Array
    sums: Array
    energy: Array

    @classmethod
    def of(cls, entries: Sequence[MapEntry]) -> "_Stack | None":
        """The stack, or nothing where the submaps have no common frame or resolution."""
        maps = [entry.gradient_map for entry in entries]
        resolution, low = maps[0].resolution, np.min([m.origin for m in maps], axis=0)
        corners = [np.round((np.array(m.origin) - low) / resolution).astype(int)[::-1] for m in maps]
        ends = [corner + m.mask.shape for corner, m in zip(corners, maps, strict=True)]
        extent = np.max(ends, axis=0)
        if any(m.resolution != resolution for m in maps) or extent.astype(float).prod() > MAX_PIXELS * max(
            m.mask.size for m in maps
        ):
            return None
        places = [
            (slice(*rows), slice(*columns))
            for rows, columns in (np.transpose(ends_of) for ends_of in zip(corners, ends, strict=True))
        ]
        stack = cls(places, np.zeros(extent), np.zeros((2, *extent)), np.zeros(extent))
        for entry, place in zip(entries, places, strict=True):
            gradient = _centred(entry)
            stack.count[place] += entry.gradient_map.mask
            stack.sums[:, *place] += gradient
            stack.energy[place] += (gradient**2).sum(axis=0)
        return stack

    def without(self, entry: MapEntry, place: Place) -> tuple[Array, Array, Array]:
        """Count, mean gradient (2, ...) and variance of the mean, of the other submaps where one is."""
        gradient = _centred(entry)
        count = self.count[place] - entry.gradient_map.mask
        n = np.maximum(count, 1)
        mean = (self.sums[:, *place] - gradient) / n
        spread = (self.energy[place] - (gradient**2).sum(axis=0)) / n - (mean**2).sum(axis=0)
        return count, mean, np.maximum(spread, 0.0) / np.maximum(n - 1, 1)


def remove_sensor_pattern(
    entries: Sequence[MapEntry], settings: Settings
) -> tuple[list[MapEntry], SensorPattern | None]:
    """The entries without the pattern that is fixed to the sensor, and the pattern; as they are without one.

    Parameters
    ----------
    entries : sequence of MapEntry
        Of one sensor, with one length scale.
    settings : Settings
    """
    stack = _Stack.of(entries) if len(entries) > MIN_SUBMAPS and not _stands_still(entries) else None
    if stack is None:
        return list(entries), None
    pattern = _pattern(stack, entries[0].field.length_scale / entries[0].gradient_map.resolution)
    if pattern is None:
        return list(entries), None
    cleaned = [_cleaned(e, p, stack, settings) for e, p in zip(entries, stack.places, strict=True)]
    return cleaned, pattern


def _pattern(stack: _Stack, pixels_per_length_scale: float) -> SensorPattern | None:
    """The pattern, if what the submaps have in common is more than chance and more than negligible."""
    seen = stack.count >= max(MIN_SUBMAPS, MIN_COVER * len(stack.places))
    n = stack.count[seen]
    if not n.size:
        return None
    mean_square = (stack.sums[:, seen] ** 2).sum(axis=0) / n**2
    by_chance = np.maximum(stack.energy[seen] / n - mean_square, 0.0) / (n - 1)
    energy = float((stack.energy[seen] / n).mean())
    excess = float((mean_square - by_chance).mean())
    independent = n.size / (WINDOW * pixels_per_length_scale) ** 2
    least = SIGNIFICANT * float(by_chance.mean()) / np.sqrt(max(independent, 1.0))
    if not excess > max(least, MIN_SHARE * energy):
        return None
    return SensorPattern(excess / energy, int(stack.count.max()))


def _cleaned(entry: MapEntry, place: Place, stack: _Stack, settings: Settings) -> MapEntry:
    """The entry less the mean of the others, shrunk by how much of it chance explains around each pixel."""
    g = entry.gradient_map
    count, mean, by_chance = stack.without(entry, place)
    sigma = WINDOW * entry.field.length_scale / g.resolution / 2
    valid = (count >= MIN_SUBMAPS - 1).astype(float)
    square, chance = (
        cv2.GaussianBlur(image * valid, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        for image in ((mean**2).sum(axis=0), by_chance)
    )
    weight = valid * np.clip(1.0 - chance / np.maximum(square, 1e-30), 0.0, 1.0)
    x, y = (
        (image - weight * of_sensor).astype(np.float32)
        for image, of_sensor in zip((g.gradient_x, g.gradient_y), mean, strict=True)
    )
    return MapEntry.of(entry.record, replace(g, gradient_x=x, gradient_y=y), settings)


def _centred(entry: MapEntry) -> Array:
    """Gradient (2, rows, columns) less its mean, zero where the ground was not observed."""
    g = entry.gradient_map
    gradient = np.stack([g.gradient_x, g.gradient_y]).astype(float)
    return (gradient - gradient[:, g.mask].mean(axis=1)[:, None, None] if g.mask.any() else gradient) * g.mask


def _stands_still(entries: Sequence[MapEntry]) -> bool:
    """Whether, by odometry, most submaps show one place: then they have the ground in common."""
    poses = [entry.record.odometry for entry in entries if entry.record.odometry is not None]
    if len(poses) < len(entries):
        return False
    positions = np.array([pose[:2, 3] for pose in poses])
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return bool(np.median(away) < entries[0].field.radius)
