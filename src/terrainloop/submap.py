"""Submaps: gravity-aligned point clouds, checked and cleaned when they are made."""

import logging
import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.arrays import ReadOnlyArrays, read_only
from terrainloop.errors import TerrainLoopError
from terrainloop.isolated import isolated_points
from terrainloop.plausibility import plausibility_warnings

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

UNNAMED = "submap"
"""Name of a submap that was given none."""

MIN_POINTS = 100
"""A 10 x 10 grid: fewer points cannot hold the handful of keypoints that one loop closure needs."""

_FARTHEST = 1e10  # metres; beyond any frame on a planet, even in millimetres: an uninitialised value
_LATEST = 1e300  # of a stamp; beyond any, even in nanoseconds
_COARSEST = 5e-3  # metres; coordinates stored in steps above this have lost the shape of the ground
_ALL_ON_A_LINE = 1e-3  # width over length of a cloud that covers no area
_LARGEST_SIDE = 2000.0  # metres; submaps are tens to hundreds of metres across ...
_LARGEST_CELL = 25.0  # ... and hold far more than one point in so many square metres
_FLAT = 0.2  # thickness over width of what surely is a surface
_STEEPEST = np.radians(70.0)  # a surface steeper than this is not ground
_TALLEST = 3.0  # height over width of what surely is not ground


@dataclass(frozen=True, eq=False, repr=False)
class Submap(ReadOnlyArrays):
    """A point cloud in its own gravity-aligned frame (z up), fit to be mapped.

    Parameters
    ----------
    points : array_like, (N, 3)
        Metres. Rows with NaN or infinity and exact repeats are dropped; the rest keep their order and
        their frame, however far its origin is.
    name, session : str
        Without path separators, commas and control characters: they go into file names and CSVs.
    stamp : float
        Seconds, or the index within the mission.
    intensity : array_like, (N,), optional
        One value per point; rows dropped from `points` are dropped here too.
    repairs : tuple of str
        Repairs made while reading, in words; those made here are appended and logged.

    Attributes
    ----------
    warnings : tuple of str
        What is implausible for a submap of the ground, in words (see `plausibility_warnings`); also logged.

    Raises
    ------
    TerrainLoopError
        If no elevation map can be made of the points: wrong shape, fewer than `MIN_POINTS`, no area,
        millimetres, coordinates too large for their type, z not up; or if name, session or stamp is invalid.
    """

    points: Array
    name: str = UNNAMED
    session: str = ""
    stamp: float = 0.0
    intensity: Array | None = None
    repairs: tuple[str, ...] = ()
    warnings: tuple[str, ...] = field(init=False, default=())

    def __post_init__(self) -> None:
        _check_label("name", self.name)
        if self.session != "":
            _check_label("session", self.session)
        _check_stamp(self.stamp)
        given = _numbers(self.points)
        points = np.array(given, dtype=np.float64)
        intensity = None if self.intensity is None else _checked_intensity(self.intensity, len(points))
        rows, repairs = _usable_rows(points)
        rows, strays = _without_strays(points, rows)
        points, repairs = points[rows], repairs + strays
        _check_count(points, repairs)
        low, high = np.percentile(points, [1, 99], axis=0)
        # Everything below looks at the bulk of the cloud: a few stray points must not decide.
        bulk = points[((points >= low) & (points <= high)).all(axis=1)] - low
        _check_units(high - low, len(points))
        repairs += _check_precision(float(np.abs([low, high]).max()), given.dtype)
        _check_area(bulk)
        _check_gravity(bulk, high - low)
        warnings = plausibility_warnings(bulk)
        for words in [*repairs, *warnings]:
            logger.warning("%s: %s", self.name, words)
        object.__setattr__(self, "points", read_only(points))
        object.__setattr__(self, "intensity", None if intensity is None else read_only(intensity[rows]))
        object.__setattr__(self, "repairs", tuple(dict.fromkeys([*self.repairs, *repairs])))
        object.__setattr__(self, "warnings", warnings)

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        width, depth, height = np.ptp(self.points, axis=0)
        return f"Submap({self.name!r}, {len(self)} points, {width:.4g} x {depth:.4g} x {height:.4g} m)"


def _without_strays(points: Array, rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], list[str]]:
    """The rows whose points are not far from all others, and what was dropped."""
    stray = isolated_points(points[rows, :2]) if len(rows) else np.zeros(0, dtype=bool)
    if not stray.any():
        return rows, []
    x, y, z = points[rows[stray][0]]
    found = f"far from all others, such as ({x:.6g}, {y:.6g}, {z:.6g})"
    return rows[~stray], [f"dropped {stray.sum()} of {len(points)} points: {found}"]


def _check_label(what: str, label: str) -> None:
    if (
        not isinstance(label, str)
        or not label.strip()
        or any(c in "/\\," or not c.isprintable() for c in label)
    ):
        raise TerrainLoopError(
            expected=f"a {what} without path separators, commas and control characters",
            found=f"{label!r:.60}",
            mend="rename it",
        )


def _check_stamp(stamp: float) -> None:
    # Compared, as np.isfinite fails for integers beyond those of NumPy.
    if not isinstance(stamp, (int, float, np.integer, np.floating)) or not abs(stamp) < _LATEST:
        raise TerrainLoopError(
            expected="a finite number of seconds, or the index, as the stamp",
            found=f"{stamp!r:.60}",
            mend="give a number, or leave it out",
        )


def _numbers(points: ArrayLike) -> NDArray[np.generic]:
    """`points` as the numeric (N, 3) array it has to be, in the type it was given in."""
    if isinstance(points, str | bytes | os.PathLike):
        raise TerrainLoopError(
            expected="points as numbers of shape (N, 3)",
            found=f"the text or path {os.fspath(points)!r:.60}",
            mend="read a file with terrainloop.read_cloud",
        )
    array = as_numbers(points)
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] != 3:
        raise TerrainLoopError(
            expected="numbers of shape (N, 3), the columns x, y and z in metres",
            found=f"shape {array.shape} of {array.dtype}",
            mend="give one row per point (transpose if x, y and z are the rows)",
        )
    return array


def as_numbers(values: ArrayLike) -> NDArray[Any]:
    """The values as an array, NaN where masked; of objects where they are none, as nested lists may be."""
    try:
        return np.asarray(np.ma.filled(values, np.nan) if np.ma.isMaskedArray(values) else values)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0, dtype=object)


def _checked_intensity(values: ArrayLike, count: int) -> Array:
    array = as_numbers(values)
    if array.dtype.kind not in "fiu" or array.shape != (count,):
        raise TerrainLoopError(
            expected=f"one intensity per point, shape ({count},)",
            found=f"shape {array.shape} of {array.dtype}",
            mend="give as many numbers as points, or none",
        )
    return array.astype(np.float64)


def _usable_rows(points: Array) -> tuple[NDArray[np.intp], list[str]]:
    """Rows to keep, in order, and what was wrong with the others."""
    finite = np.flatnonzero((np.abs(points) < _FARTHEST).all(axis=1))  # False for NaN too
    repeats = _repeats(points, finite)
    counts = {"not finite": len(points) - len(finite), "an exact repeat of another": len(repeats)}
    repairs = [f"dropped {n} of {len(points)} points: {what}" for what, n in counts.items() if n]
    return np.setdiff1d(finite, repeats, assume_unique=True), repairs


def _repeats(points: Array, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Those of the rows that hold the same numbers as one before."""
    x, y, z = points[rows].T
    key = x + np.sqrt(2.0) * y + np.sqrt(3.0) * z  # the same for equal rows
    order = np.argsort(key)
    tied = np.zeros(len(rows), dtype=bool)
    same = np.diff(key[order]) == 0
    tied[1:] |= same
    tied[:-1] |= same
    suspects = np.sort(rows[order[tied]])
    suspects = suspects[np.lexsort(points[suspects].T)]
    return suspects[1:][(np.diff(points[suspects], axis=0) == 0).all(axis=1)]


def _check_count(points: Array, repairs: list[str]) -> None:
    if len(points) < MIN_POINTS:
        raise TerrainLoopError(
            expected=f"at least {MIN_POINTS} different points",
            found="; ".join([str(len(points)), *repairs]),
            mend="join several scans into one submap",
        )


def _check_units(extent: Array, count: int) -> None:
    width, depth = extent[:2]
    if max(width, depth) > _LARGEST_SIDE and width * depth > _LARGEST_CELL * count:
        raise TerrainLoopError(
            expected="a submap in metres, some 5 to 500 m across",
            found=f"{count} points over {width:.0f} x {depth:.0f} m",
            mend="divide by 1000 if these are millimetres, or cut it into submaps",
        )


def _check_precision(largest: float, dtype: np.dtype[np.generic]) -> list[str]:
    """Refuse a type that has rounded the coordinates away; report if only single precision would."""
    steps_of = np.float64 if dtype.kind in "iu" else dtype.type
    if np.spacing(steps_of(largest)) > _COARSEST:
        raise TerrainLoopError(
            expected=f"coordinates kept to {1000 * _COARSEST:.0f} mm",
            found=f"{dtype} coordinates up to {largest:.0f} m, which round to "
            f"{np.spacing(steps_of(largest)):.2g} m",
            mend="export them as double, or subtract an offset before storing them",
        )
    if np.spacing(np.float32(largest)) > _COARSEST:
        return [f"coordinates up to {largest:.0f} m: kept in their frame, mapped about a local origin"]
    return []


def _check_area(bulk: Array) -> None:
    narrow, long = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(bulk[:, :2].T)), 0))
    if narrow <= _ALL_ON_A_LINE * long:
        raise TerrainLoopError(
            expected="points that cover an area in x and y",
            found=f"all within {narrow:.2g} m of a {'line' if long > 0 else 'point'} as seen from above",
            mend="join scans over an area into one submap, and rotate it so that z is up",
        )


def _check_gravity(bulk: Array, extent: Array) -> None:
    """Refuse what surely does not have z up: a wall-like sheet, or a tower."""
    variances, axes = np.linalg.eigh(np.cov(bulk.T))
    slope = np.arccos(min(abs(axes[2, 0]), 1.0))
    wall = variances[0] < _FLAT**2 * variances[1] and slope > _STEEPEST
    if wall or extent[2] > _TALLEST * extent[:2].max():
        shape = f"a surface at {np.degrees(slope):.0f} degrees to the horizontal" if wall else "a tower"
        width, depth, height = extent
        raise TerrainLoopError(
            expected="a gravity-aligned cloud, z up",
            found=f"{shape}, {width:.3g} x {depth:.3g} m and {height:.3g} m in z",
            mend="rotate it so that z is up (camera frames have z forward and y down)",
        )
