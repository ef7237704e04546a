"""The elevation of a cloud as a Gaussian process with estimated hyperparameters, evaluated anywhere."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from terrainloop.errors import TerrainLoopError
from terrainloop.gp import exact, spline
from terrainloop.gp.checks import check_max_points, check_positive, core_errors
from terrainloop.gp.grid import Grid
from terrainloop.gp.hyperparameters import FIT_POINTS, FitOptions, fit_training_data
from terrainloop.gp.kernel import Array, Hyperparameters
from terrainloop.gp.prediction import Prediction
from terrainloop.gp.training import Points, TrainingData, detrend

Solver = Literal["spline", "exact"]

MAX_LENGTH_SCALES = 1_000_000  # squares of a length scale that the points may cover
BAND = 1_000_000  # pixels to which the plane is added at once, which bounds memory

# Memory of a prediction, measured (tests/test_memory.py). Spline solver: bytes per point and per cell of the
# lattice, and the cells along an axis that are solved at once.
POINT_BYTES, CELL_BYTES, WINDOW_CELLS = 100, 4000, 368
EXACT_BYTES, EXACT_PIXEL_BYTES = 48, 80  # per entry of the covariance and per pixel


@dataclass(frozen=True, eq=False)
class ElevationProcess:
    """Posterior of the elevation of a cloud, in the frame of the cloud.

    Attributes
    ----------
    data : TrainingData
        The points, and the plane subtracted from them.
    parameters : Hyperparameters
        Hyperparameters of the process; the noise is the typical one.
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

    data: TrainingData
    parameters: Hyperparameters
    noise: Array
    solver: Solver = "spline"
    workers: int = 1

    @classmethod
    def from_points(
        cls,
        points: Points,
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
        """Estimate the hyperparameters that are not given; parameters as for `GradientMap.from_points`."""
        check_max_points(max_points=max_points, fit_points=fit_points)
        options = FitOptions(fit_points, _checked(solver) == "exact", remove_plane, seed, workers)
        each, typical = _noise(noise)
        with core_errors("a detrended cloud"):
            data = detrend(points, remove_plane=remove_plane, noise=each).drawn(max_points, seed)
        if options.exact:
            exact.check_size(len(data.xy))
        given = {
            "length_scale": length_scale,
            "variance": variance,
            "noise": typical if each is None else data.typical_noise,
        }
        check_positive(**given)
        parameters = data.start(**given)
        _check_extent(data, parameters.length_scale)
        fixed = [name for name, value in given.items() if value is not None]
        if len(fixed) < len(given):
            parameters = fit_training_data([data], given, options, fixed=fixed)
            _check_extent(data, parameters.length_scale)
        process = cls(data, parameters, parameters.noise * data.relative_noise, solver, options.workers)
        return process._with_local_noise() if each is None and local_noise else process

    def _with_local_noise(self) -> "ElevationProcess":
        """With the noise scaled by the scatter around each point (see `spline.noise_ratio`)."""
        data, fitted = self.data, self.parameters
        with core_errors("an estimate of the local noise"):
            ratio = spline.noise_ratio(
                data.xy, data.elevation, fitted.length_scale, fitted.noise, workers=self.workers
            )
        return replace(self, noise=fitted.noise * ratio)

    def predict_grid(
        self, origin: tuple[float, float], resolution: float, shape: tuple[int, int]
    ) -> Prediction:
        """Posterior on the grid whose pixel (row, column) is at origin + resolution * (column, row).

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
        corner = (origin[0] - self.data.centre[0], origin[1] - self.data.centre[1])
        grid = Grid(corner, resolution, shape)
        solver = exact if self.solver == "exact" else spline
        with core_errors(f"a map of {shape[1]} x {shape[0]} pixels"):
            field = solver.predict_grid(*self._training, grid, workers=self.workers)
            rows = max(1, BAND // max(1, shape[1]))
            for top in range(0, shape[0], rows):
                band = Prediction(*(image[top : top + rows] for image in vars(field).values()))
                _add_plane(band, self.data, grid.x, grid.y[top : top + rows, None])
        return field

    def predict_at(self, queries: ArrayLike) -> Prediction:
        """Posterior at points (Q, 2) in the frame of the cloud, metres.

        Raises
        ------
        TerrainLoopError
            If the queries do not have that shape, or the equations cannot be solved.
        """
        try:
            positions = np.asarray(queries, dtype=np.float64)
        except (ValueError, TypeError):
            positions = np.empty(0)
        if positions.ndim != 2 or positions.shape[1] != 2 or not np.isfinite(positions).all():
            raise TerrainLoopError(
                expected="finite query points of shape (Q, 2), the columns x and y in metres",
                found=f"shape {positions.shape}",
                mend="give one row per point",
            )
        local = positions - self.data.centre[:2]
        solver = exact if self.solver == "exact" else spline
        with core_errors(f"a prediction at {len(positions)} points"):
            field = solver.predict_at(*self._training, local, workers=self.workers)
        _add_plane(field, self.data, local[:, 0], local[:, 1])
        return field

    def memory_for(self, pixels: int) -> float:
        """Approximate bytes needed to predict this many pixels, including 20 bytes each for the result."""
        count = len(self.data.xy)
        if self.solver == "exact":
            return EXACT_BYTES * count**2 + EXACT_PIXEL_BYTES * pixels
        extent = np.ptp(self.data.xy, axis=0) / (spline.KNOT_SPACING * self.parameters.length_scale)
        cells = float(np.prod(np.clip(extent + 2 * spline.REACH_CELLS, None, WINDOW_CELLS)))
        return POINT_BYTES * count + CELL_BYTES * cells + 20 * pixels

    @property
    def _training(self) -> tuple[Array, Array, Array, Hyperparameters]:
        return self.data.xy, self.data.elevation, self.noise, self.parameters


def _add_plane(field: Prediction, data: TrainingData, x: Array, y: Array) -> None:
    """Add the removed plane back."""
    field.elevation[...] += data.centre[2] + data.slope[0] * x + data.slope[1] * y
    field.gradient_x[...] += data.slope[0]
    field.gradient_y[...] += data.slope[1]


def _noise(noise: float | ArrayLike | None) -> tuple[Array | None, float | None]:
    """The noise of each point, if it is given so, or of all."""
    if noise is None:
        return None, None
    try:
        given = np.asarray(noise, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise TerrainLoopError(
            expected="a noise in metres, one number or one for each point",
            found=" ".join(str(error).split()),
            mend="leave it out to have it derived",
        ) from error
    return (given, None) if given.ndim else (None, float(given))


def _checked(solver: str) -> str:
    if solver not in get_args(Solver):
        raise TerrainLoopError(
            expected=f"a solver out of {', '.join(get_args(Solver))}",
            found=repr(solver),
            mend="leave it out for 'spline'",
        )
    return solver


def _check_extent(data: TrainingData, length_scale: float) -> None:
    """Refuse an extent that would take minutes and gigabytes, mostly caused by a few stray points."""
    with np.errstate(over="ignore"):
        squares = np.prod(np.ptp(data.xy, axis=0) / length_scale)
    if not squares <= MAX_LENGTH_SCALES:
        raise TerrainLoopError(
            expected=f"points over at most {MAX_LENGTH_SCALES / 1e6:.0f} million squares of a length scale",
            found=f"{squares / 1e6:.3g} million squares of {length_scale:.3g} m: {data.extent_in_words}",
            mend="remove far outlier points, or cut the cloud into submaps",
        )
