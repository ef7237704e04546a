"""Training data of the Gaussian process: points about a local origin, without their plane."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Array, Hyperparameters
from terrainloop.submap import MIN_POINTS, Submap

logger = logging.getLogger(__name__)

# Points further from the plane than this many robust standard deviations are not terrain: flying pixels,
# masts, people. Single rocks on flat ground stay.
MAX_DEVIATIONS = 10.0
MAX_PLANE_FITS = 3
MIN_LIMIT = 1e-3  # metres; a smaller deviation is never an outlier
MAX_OUTLIERS = 0.1  # of the points: more are terrain, however flat the rest (a shore with a lake)

# No sensor resolves less, so the search for hyperparameters does not begin below it. The residuals of exactly
# flat ground are rounding errors of 1e-16 m; a model of those has noise of 1e-25 m and cannot be solved.
MIN_RELIEF = 1e-6  # metres

# Clouds much wider than an ordinary submap are fitted in patches of about this size, so that the density of
# the points drawn, and with it the length scale, does not fall with the extent (docs/solver.md).
PATCH_SIDE = 45.0  # metres
MAX_PATCHES = 64
OCCUPANCY_CELLS = 16  # along a side of a patch; the occupied ones make up its area


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Points with elevation = residual + centre_z + slope . (xy - centre_xy).

    Attributes
    ----------
    xy : array, (N, 2)
        Metres from the centre, so that large (UTM) coordinates lose no digits.
    elevation : array, (N,)
        Residual elevation, zero mean, metres.
    centre : array, (3,)
        Of the points, in the frame of the cloud, metres.
    slope : array, (2,)
        Of the plane that was subtracted; zero where none was.
    relative_noise : array, (N,)
        Noise of each point as a share of the typical one.
    typical_noise : float, optional
        Median of the noise that was given with the points, metres.
    """

    xy: Array
    elevation: Array
    centre: Array
    slope: Array
    relative_noise: Array
    typical_noise: float | None = None

    @property
    def side(self) -> float:
        """Side of a square of the area that the points cover, metres; stray points do not count."""
        low, high = np.percentile(self.xy, [2, 98], axis=0)
        return float(np.sqrt(np.prod((high - low) / 0.96)))

    @property
    def spacing(self) -> float:
        """Typical distance between neighbouring points, metres."""
        return self.side / len(self.xy) ** 0.5

    @property
    def extent_in_words(self) -> str:
        """The extent of the points, and that of most of them."""
        width, depth = np.ptp(self.xy, axis=0)
        most = np.diff(np.percentile(self.xy, [1, 99], axis=0), axis=0)[0]
        return (
            f"an extent of {width:.0f} x {depth:.0f} m, of which all but a hundredth of the points at each "
            f"border take {most[0]:.0f} x {most[1]:.0f} m"
        )

    def start(
        self, length_scale: float | None, variance: float | None, noise: float | None
    ) -> Hyperparameters:
        """Hyperparameters to begin a search from, derived from the data where None."""
        relief = max(float(self.elevation.std()), MIN_RELIEF)
        variance = relief**2 if variance is None else variance
        return Hyperparameters(
            length_scale=2 * self.spacing if length_scale is None else length_scale,
            variance=variance,
            # Not too far below the prior's deviation: what is then fitted can be solved in double precision.
            noise=max(0.2 * relief, 0.1 * variance**0.5) if noise is None else noise,
        )

    def drawn(self, count: int | None, seed: int) -> "TrainingData":
        """At most `count` of the points, at random."""
        if count is None or len(self.xy) <= count:
            return self
        rows = np.sort(np.random.default_rng(seed).choice(len(self.xy), count, replace=False))
        return self._rows(rows)

    def patches(self, side: float, *, remove_plane: bool) -> Sequence["TrainingData"]:
        """Square pieces of ground with sides of about `side`, each without its own plane.

        The whole itself if it is not larger. Patches of fewer than `MIN_POINTS` points are left out.
        """
        counts = np.maximum(1, np.round(np.ptp(self.xy, axis=0) / side)).astype(int)
        if self.side <= side or counts.max() == 1:
            return [self]
        low = self.xy.min(axis=0)
        cells = np.minimum((self.xy - low) / np.ptp(self.xy, axis=0) * counts, counts - 1).astype(int)
        patch_of = cells[:, 1] * counts[0] + cells[:, 0]
        order = np.argsort(patch_of, kind="stable")
        pieces = np.split(order, np.flatnonzero(np.diff(patch_of[order])) + 1)
        pieces = [rows for rows in pieces if len(rows) >= MIN_POINTS]
        if len(pieces) > MAX_PATCHES:
            chosen = np.random.default_rng(0).choice(len(pieces), MAX_PATCHES, replace=False)
            pieces = [pieces[k] for k in np.sort(chosen)]
        return [self._rows(rows)._detrended(remove_plane) for rows in pieces] or [self]

    def area(self, cell: float) -> float:
        """Area of the square cells that hold points, metres squared."""
        return cell**2 * len(np.unique(np.floor((self.xy - self.xy.min(axis=0)) / cell), axis=0))

    def _rows(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "TrainingData":
        parts = {name: getattr(self, name)[rows] for name in ("xy", "elevation", "relative_noise")}
        return replace(self, **parts)

    def _detrended(self, remove_plane: bool) -> "TrainingData":
        """The same points about their own centre and, where it is to be removed, their robust plane."""
        cloud, noise = np.c_[self.xy, self.elevation], self.relative_noise
        centre, slope = cloud.mean(axis=0), np.zeros(2)
        for _ in range(MAX_PLANE_FITS if remove_plane else 0):
            local = cloud - centre
            normal, right = local[:, :2].T @ local[:, :2], local[:, :2].T @ local[:, 2]
            slope = np.linalg.lstsq(normal, right, rcond=None)[0]
            residual = local[:, 2] - local[:, :2] @ slope
            terrain = _near(np.abs(residual - np.median(residual)))
            if terrain.all():
                break
            cloud, noise = cloud[terrain], noise[terrain]
            centre = cloud.mean(axis=0)
        local = cloud - centre
        return replace(
            self,
            xy=local[:, :2].copy(),
            elevation=local[:, 2] - local[:, :2] @ slope,
            centre=self.centre + centre + [0.0, 0.0, self.slope @ centre[:2]],
            slope=self.slope + slope,
            relative_noise=noise,
        )


Points = ArrayLike | Submap | TrainingData


def detrend(points: Points, *, remove_plane: bool = True, noise: ArrayLike | None = None) -> TrainingData:
    """Refer points (N, 3) to their centre and plane; what is detrended already stays as it is.

    Raises
    ------
    TerrainLoopError
        If the points do not make a submap (see `Submap`), or the noise (N,) is not one number for each.
    """
    if isinstance(points, TrainingData):
        return points
    submap = points if isinstance(points, Submap) else Submap(np.asarray(points))
    each = None if noise is None else _checked_noise(noise, points, submap)
    cloud = submap.points
    typical = None if each is None else float(np.median(each))
    relative = np.ones(len(cloud)) if each is None or typical is None else each / typical
    whole = TrainingData(cloud[:, :2], cloud[:, 2], np.zeros(3), np.zeros(2), relative, typical)
    return whole._detrended(remove_plane)


def _near(distance: Array) -> NDArray[np.bool_]:
    """Which points are near the plane that most of them are on, by their distances (N,) from it."""
    near = distance <= max(MAX_DEVIATIONS * 1.4826 * float(np.median(distance)), MIN_LIMIT)
    return near if near.mean() >= 1 - MAX_OUTLIERS else np.ones_like(near)


def _checked_noise(noise: ArrayLike, points: ArrayLike | Submap, submap: Submap) -> Array:
    given = np.asarray(noise, dtype=np.float64)
    if given.shape != (len(submap),) or not ((given > 0) & np.isfinite(given)).all():
        dropped = 0 if isinstance(points, Submap) else len(np.asarray(points)) - len(submap)
        raise TerrainLoopError(
            expected=f"one positive noise for each of the {len(submap)} points, in metres",
            found=f"shape {given.shape}" + (f", {dropped} points having been dropped" if dropped else ""),
            mend="drop repeated, stray and non-finite points first, or give one number",
        )
    return given
