"""What the Gaussian process sees of a cloud: its points about a local origin, without their plane."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Array, Hyperparameters
from terrainloop.submap import Submap

# Points further from the plane than this many robust standard deviations are no terrain: flying pixels,
# masts, people. Single rocks on flat ground stay.
NO_TERRAIN = 10.0
PLANE_FITS = 3


@dataclass(frozen=True, eq=False)
class Surface:
    """Training data: elevation = residual + centre_z + slope . (xy - centre_xy).

    Attributes
    ----------
    xy : array, (N, 2)
        Metres from the centre, so that no digit is lost to large (UTM) coordinates.
    elevation : array, (N,)
        Residual elevation, zero mean, metres.
    centre : array, (3,)
        Of the points, in the frame of the cloud, metres.
    slope : array, (2,)
        Of the plane that was taken out; zero where none was.
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
    def spacing(self) -> float:
        """Typical distance between neighbouring points, metres."""
        low, high = np.percentile(self.xy, [2, 98], axis=0)  # a stray point must not decide
        return float(np.sqrt(np.prod(high - low) / (0.96**2 * len(self.xy))))

    @property
    def extent_in_words(self) -> str:
        """How far the points reach, and most of them."""
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
        relief = float(self.elevation.std()) or 1e-3
        return Hyperparameters(
            length_scale=2 * self.spacing if length_scale is None else length_scale,
            variance=relief**2 if variance is None else variance,
            noise=0.2 * relief if noise is None else noise,
        )

    def drawn(self, count: int | None, seed: int) -> "Surface":
        """At most `count` of the points, at random."""
        if count is None or len(self.xy) <= count:
            return self
        rows = np.sort(np.random.default_rng(seed).choice(len(self.xy), count, replace=False))
        parts = {name: getattr(self, name)[rows] for name in ("xy", "elevation", "relative_noise")}
        return replace(self, **parts)


def surface_of(
    points: ArrayLike | Submap,
    *,
    remove_plane: bool = True,
    noise: Array | None = None,
) -> Surface:
    """Refer points (N, 3) to their centre and plane.

    Raises
    ------
    TerrainLoopError
        If the points make no submap (see `Submap`), or the noise (N,) is not one number for each.
    """
    cloud = _checked(points, noise).points
    if noise is not None:
        noise = np.asarray(noise, dtype=np.float64)
    centre, slope = cloud.mean(axis=0), np.zeros(2)
    for _ in range(PLANE_FITS if remove_plane else 0):
        local = cloud - centre
        slope = np.linalg.lstsq(local[:, :2].T @ local[:, :2], local[:, :2].T @ local[:, 2], rcond=None)[0]
        residual = local[:, 2] - local[:, :2] @ slope
        residual -= np.median(residual)
        spread = 1.4826 * np.median(np.abs(residual))
        terrain = np.abs(residual) <= max(NO_TERRAIN * spread, 1e-3)
        if terrain.all():
            break
        cloud, noise = cloud[terrain], None if noise is None else noise[terrain]
        centre = cloud.mean(axis=0)
    local = cloud - centre
    relative_noise, typical_noise = np.ones(len(cloud)), None
    if noise is not None:
        typical_noise = float(np.median(noise))
        relative_noise = noise / typical_noise
    return Surface(
        xy=local[:, :2].copy(),
        elevation=local[:, 2] - local[:, :2] @ slope,
        centre=centre,
        slope=slope,
        relative_noise=relative_noise,
        typical_noise=typical_noise,
    )


def _checked(points: ArrayLike | Submap, noise: Array | None) -> Submap:
    submap = points if isinstance(points, Submap) else Submap(np.asarray(points))
    if noise is None:
        return submap
    given = np.asarray(noise)
    if given.shape != (len(submap),) or not ((given > 0) & np.isfinite(given)).all():
        dropped = 0 if isinstance(points, Submap) else len(np.asarray(points)) - len(submap)
        raise TerrainLoopError(
            expected=f"one positive noise for each of the {len(submap)} points, in metres",
            found=f"shape {given.shape}" + (f", {dropped} points having been dropped" if dropped else ""),
            mend="drop repeated and non-finite points first, or give one number",
        )
    return submap
