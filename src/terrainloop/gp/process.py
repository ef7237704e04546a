"""The elevation of a cloud as a Gaussian process: hyperparameters settled, to be asked anywhere."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from terrainloop.errors import TerrainLoopError
from terrainloop.gp import exact, spline
from terrainloop.gp.hyperparameters import FIT_POINTS, fit_surfaces
from terrainloop.gp.kernel import Array, Hyperparameters
from terrainloop.gp.prediction import Prediction
from terrainloop.gp.surface import Surface, surface_of
from terrainloop.submap import Submap
from terrainloop.workers import usable_workers

Solver = Literal["spline", "exact"]

MAX_LENGTH_SCALES = 4_000_000  # squares of a length scale that the points may reach over


@dataclass(frozen=True, eq=False)
class ElevationProcess:
    """Posterior of the elevation of a cloud, in the frame of the cloud.

    Attributes
    ----------
    surface : Surface
        The points, and the plane taken out of them.
    parameters : Hyperparameters
        Of the process; the noise is the typical one.
    noise : array, (N,)
        Standard deviation of each point's elevation, metres.
    solver : str
        "spline" (every point, our core) or "exact" (dense, some thousands of points).
    workers : int
        Threads; the result does not depend on it.

    Examples
    --------
    >>> process = ElevationProcess.from_points(points)  # doctest: +SKIP
    >>> process.predict_at([[1.0, 2.0]]).elevation  # doctest: +SKIP
    """

    surface: Surface
    parameters: Hyperparameters
    noise: Array
    solver: Solver = "spline"
    workers: int = 1

    @classmethod
    def from_points(
        cls,
        points: ArrayLike | Submap,
        length_scale: float | None = None,
        variance: float | None = None,
        noise: float | ArrayLike | None = None,
        *,
        max_points: int | None = None,
        fit_points: int | None = FIT_POINTS,
        remove_plane: bool = True,
        local_noise: bool = True,
        solver: Solver = "spline",
        seed: int = 0,
        workers: int = 1,
    ) -> "ElevationProcess":
        """Settle what is not given; the parameters are those of `GradientMap.from_points`."""
        workers = usable_workers(workers)
        given_noise = None if noise is None else np.asarray(noise, dtype=np.float64)
        each = given_noise if given_noise is not None and given_noise.ndim else None
        surface = surface_of(points, remove_plane=remove_plane, noise=each).drawn(max_points, seed)
        typical = surface.typical_noise
        if typical is None and given_noise is not None:
            typical = float(given_noise)
        given = {"length_scale": length_scale, "variance": variance, "noise": typical}
        check_positive(**given)
        parameters = surface.start(**given)
        _check_extent(surface, parameters.length_scale)
        fixed = [name for name, value in given.items() if value is not None]
        if len(fixed) < len(given):
            parameters = fit_surfaces(
                [surface],
                **given,
                fixed=fixed,
                max_points=fit_points,
                exact=solver == "exact",
                seed=seed,
                workers=workers,
            )
            _check_extent(surface, parameters.length_scale)
        ratio = surface.relative_noise
        if each is None and local_noise:
            ratio = spline.noise_ratio(
                surface.xy, surface.elevation, parameters.length_scale, workers=workers
            )
        return cls(surface, parameters, parameters.noise * ratio, solver, workers)

    def predict_grid(
        self, origin: tuple[float, float], resolution: float, shape: tuple[int, int]
    ) -> Prediction:
        """Posterior on the grid whose pixel (row, column) lies at origin + resolution * (column, row).

        Parameters
        ----------
        origin : tuple of float
            (x, y) of pixel (0, 0) in the frame of the cloud, metres.
        resolution : float
            Metres per pixel.
        shape : tuple of int
            Rows (y) and columns (x).

        Raises
        ------
        TerrainLoopError
            If the equations cannot be solved.
        """
        surface = self.surface
        corner = (origin[0] - surface.centre[0], origin[1] - surface.centre[1])
        x = corner[0] + resolution * np.arange(shape[1])
        y = corner[1] + resolution * np.arange(shape[0])
        if self.solver == "exact":
            field = exact.predict_grid(
                surface.xy,
                surface.elevation,
                self.parameters,
                x,
                y,
                noise=self.noise,
                workers=self.workers,
            )
        else:
            field = spline.predict_grid(
                surface.xy,
                surface.elevation,
                self.noise,
                self.parameters,
                corner,
                resolution,
                shape,
                workers=self.workers,
            )
        return _with_plane(field, surface, x, y[:, None])

    def predict_at(self, queries: ArrayLike) -> Prediction:
        """Posterior at places (Q, 2) in the frame of the cloud, metres; by the spline solver."""
        places = np.asarray(queries, dtype=np.float64)
        if places.ndim != 2 or places.shape[1] != 2 or not np.isfinite(places).all():
            raise TerrainLoopError(
                expected="finite places of shape (Q, 2), the columns x and y in metres",
                found=f"shape {places.shape}",
                mend="give one row a place",
            )
        surface = self.surface
        local = places - surface.centre[:2]
        field = spline.predict_at(
            surface.xy, surface.elevation, self.noise, self.parameters, local, workers=self.workers
        )
        return _with_plane(field, surface, local[:, 0], local[:, 1])


def _with_plane(field: Prediction, surface: Surface, x: Array, y: Array) -> Prediction:
    """Give the plane that was taken out back."""
    field.elevation[...] += surface.centre[2] + surface.slope[0] * x + surface.slope[1] * y
    field.gradient_x[...] += surface.slope[0]
    field.gradient_y[...] += surface.slope[1]
    return field


def _check_extent(surface: Surface, length_scale: float) -> None:
    """Refuse what would take minutes and gigabytes, most often for the sake of one stray point."""
    squares = np.prod(np.ptp(surface.xy, axis=0) / length_scale)
    if squares > MAX_LENGTH_SCALES:
        raise TerrainLoopError(
            expected=f"points over at most {MAX_LENGTH_SCALES / 1e6:.0f} million squares of a length scale",
            found=f"{squares / 1e6:.0f} million squares of {length_scale:.3g} m: {surface.extent_in_words}",
            mend="remove far outlier points, or cut the cloud into submaps",
        )


def check_positive(**numbers: float | None) -> None:
    """Refuse a number that is given and not positive."""
    for name, value in numbers.items():
        if value is not None and not 0 < value < np.inf:
            raise TerrainLoopError(
                expected=f"a positive {name}", found=f"{value}", mend="leave it out to have it derived"
            )
