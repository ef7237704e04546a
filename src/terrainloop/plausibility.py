"""Properties of a cloud that are implausible for a submap of the ground, although it can be mapped."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SAMPLE = 20_000  # points that are examined
_ACROSS = 32  # cells along the cloud, or fewer where it is sparse ...
_PER_CELL = 16  # ... as each should hold so many points
_FEWEST = 8  # points that a cell needs to be examined
_LAYERED = 0.3  # share of cells with two layers; scans of trees and undergrowth reach 0.17
_THICK = 1.5  # median thickness of a cell over its side; scans of undergrowth reach 1.2
_SMALLEST, _LARGEST = 0.5, 500.0  # metres across
_STEEP = np.radians(40.0)  # beyond the angle of repose of loose ground
_TILTED = np.radians(20.0)  # a slope this steep is rarely ...
_SMOOTH = 0.02  # ... as even as that: relief about its plane over its width


def plausibility_warnings(bulk: Array) -> tuple[str, ...]:
    """Warnings about a cloud, in words.

    Two layers above each other, points that fill a volume, a mean plane steeper than ground, or an even
    one that is tilted like a sensor, and extents that suggest another unit. A cloud upside down, a tilt of
    rough ground within natural slopes, and small clouds in centimetres cannot be detected.

    Parameters
    ----------
    bulk : array, (N, 3)
        Points without outliers, metres.
    """
    if len(bulk) > _SAMPLE:
        bulk = bulk[np.random.default_rng(0).integers(0, len(bulk), _SAMPLE)]
    slope, residual = _robust_plane(bulk)
    width = float(np.ptp(bulk[:, :2], axis=0).max())
    found = (_no_surface(bulk, residual), _steepness(slope, residual, width), _size(width))
    return tuple(words for words in found if words)


def _robust_plane(points: Array) -> tuple[Array, Array]:
    """Slope (2,) of the plane through most points, and the heights above it (N,)."""
    local = points - points.mean(axis=0)
    design = np.column_stack([local[:, :2], np.ones(len(local))])
    kept = np.ones(len(local), dtype=bool)
    for _ in range(3):
        plane = np.linalg.lstsq(design[kept], local[kept, 2], rcond=None)[0]
        residual = local[:, 2] - design @ plane
        kept = np.abs(residual) <= 3 * np.median(np.abs(residual))
    return plane[:2], residual


def _no_surface(points: Array, heights: Array) -> str:
    """Whether columns of the cloud hold two layers, or are thicker than wide."""
    xy = points[:, :2] - points[:, :2].min(axis=0)
    extent = xy.max(axis=0)
    side = float(max(np.sqrt(_PER_CELL * extent.prod() / len(xy)), extent.max() / _ACROSS))
    column, row = np.floor(xy / side).astype(np.int64).T
    cell = column * (int(row.max()) + 1) + row
    order = np.lexsort((heights, cell))
    cell, heights = cell[order], heights[order]
    first, count = np.unique(cell, return_index=True, return_counts=True)[1:]
    examined = count >= _FEWEST
    if not examined.any():
        return ""
    tenth = count // 10
    thickness = heights[first + count - 1 - tenth] - heights[first + tenth]
    place = np.arange(len(cell)) - np.repeat(first, count)
    inner = (place >= np.repeat(tenth, count)) & (place < np.repeat(count - 1 - tenth, count))
    steps = np.append(np.diff(heights), 0.0)
    gap = np.maximum.reduceat(np.where(inner, steps, 0.0), first)
    layered = examined & (gap > 0.5 * thickness) & (gap > 0.3 * side)
    if layered.sum() > _LAYERED * examined.sum():
        apart = np.median(gap[layered])
        return f"two layers {apart:.2g} m apart, as of a floor and a ceiling: no map of one surface"
    thick = float(np.median(thickness[examined]))
    if thick > _THICK * side:
        return f"points fill a volume, {thick:.2g} m thick within {side:.2g} m: no map of one surface"
    return ""


def _steepness(slope: Array, residual: Array, width: float) -> str:
    angle = np.arctan(np.hypot(*slope))
    relief = np.diff(np.percentile(residual, [5, 95]))[0]
    if angle > _STEEP or (angle > _TILTED and relief < _SMOOTH * width):
        return f"the mean plane is tilted by {np.degrees(angle):.0f} deg: is z up?"
    return ""


def _size(width: float) -> str:
    if width > _LARGEST:
        return f"{width:.0f} m across, more than a submap: are these centimetres or feet?"
    if width < _SMALLEST:
        return f"{width:.2g} m across, less than a submap: are these kilometres?"
    return ""
