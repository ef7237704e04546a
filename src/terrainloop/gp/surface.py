"""What the Gaussian process sees of a cloud: a few thousand points about a local origin."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

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
    """

    xy: Array
    elevation: Array
    centre: Array
    slope: Array

    @property
    def spacing(self) -> float:
        """Typical distance between neighbouring points, metres."""
        return float(np.sqrt(np.prod(np.ptp(self.xy, axis=0)) / len(self.xy)))

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

    def blocks(self, max_points: int) -> list["Surface"]:
        """The surface cut at medians, across its longer side, into parts of at most `max_points`."""
        if len(self.xy) <= max_points:
            return [self]
        axis = int(np.argmax(np.ptp(self.xy, axis=0)))
        order = np.argsort(self.xy[:, axis], kind="stable")
        halves = np.array_split(order, 2)
        parts = (replace(self, xy=self.xy[half], elevation=self.elevation[half]) for half in halves)
        return [block for part in parts for block in part.blocks(max_points)]


def surface_of(points: ArrayLike | Submap, *, max_points: int, remove_plane: bool, seed: int) -> Surface:
    """Draw at most `max_points` of the points (N, 3) at random and refer them to their centre.

    Raises
    ------
    TerrainLoopError
        If the points make no submap (see `Submap`).
    """
    cloud = points.points if isinstance(points, Submap) else Submap(np.asarray(points)).points
    if len(cloud) > max_points:
        rng = np.random.default_rng(seed)
        cloud = cloud[np.sort(rng.choice(len(cloud), max_points, replace=False))]
    centre, slope = cloud.mean(axis=0), np.zeros(2)
    for _ in range(PLANE_FITS if remove_plane else 0):
        local = cloud - centre
        slope = np.linalg.lstsq(local[:, :2], local[:, 2], rcond=None)[0]
        residual = local[:, 2] - local[:, :2] @ slope
        spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
        cloud = cloud[np.abs(residual - np.median(residual)) <= max(NO_TERRAIN * spread, 1e-3)]
        centre = cloud.mean(axis=0)
    local = cloud - centre
    return Surface(local[:, :2].copy(), local[:, 2] - local[:, :2] @ slope, centre, slope)
