"""The Gaussian process from every point, in time linear in points and area: our solver in the C++ core.

The elevation is a spline of degree 7 on knots half a length scale apart, whose weights have the prior
covariance with which the spline is the process (docs/solver.md).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainloop import _core
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Array, Hyperparameters
from terrainloop.gp.prediction import Prediction

NOISE_CELL = 0.5  # length scales: the ground in a cell is near a plane


def predict_grid(
    xy: Array,
    elevation: Array,
    noise: Array,
    parameters: Hyperparameters,
    origin: tuple[float, float],
    resolution: float,
    shape: tuple[int, int],
    *,
    workers: int = 1,
) -> Prediction:
    """Posterior on the grid whose pixel (row, column) lies at origin + resolution * (column, row).

    Parameters
    ----------
    xy : array, (N, 2)
        Training points, metres.
    elevation, noise : array, (N,)
        Their elevations, the prior having zero mean, and the standard deviation of each, metres.
    parameters : Hyperparameters
        Length scale and variance; the noise is given by point.
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    resolution : float
        Metres per pixel.
    shape : tuple of int
        Rows (y) and columns (x).
    workers : int
        Threads; the result does not depend on it.

    Returns
    -------
    Prediction
        float32.

    Raises
    ------
    TerrainLoopError
        If the equations cannot be solved to tolerance.
    """
    grid = {"x": origin[0], "y": origin[1], "resolution": resolution, "rows": shape[0], "cols": shape[1]}
    return _solve(_core.gp_predict_grid, xy, elevation, noise, parameters, threads=workers, **grid)


def predict_at(
    xy: Array,
    elevation: Array,
    noise: Array,
    parameters: Hyperparameters,
    queries: Array,
    *,
    workers: int = 1,
) -> Prediction:
    """Posterior at arbitrary places (Q, 2), metres; otherwise as `predict_grid`."""
    return _solve(_core.gp_predict_at, xy, elevation, noise, parameters, threads=workers, queries=queries)


def noise_ratio(xy: Array, elevation: Array, length_scale: float, *, workers: int = 1) -> Array:
    """Noise of each point as a share of that of a single typical one, from the points around it.

    Three effects are multiplied. In cells of half a length scale the robust scatter about a plane is taken
    and pooled with that of the cells around: it grows where the sensor's noise does. Points further from
    their cell's plane than three standard deviations are raised by the square of the excess: flying pixels
    raise no spikes. The n points in a square of a quarter of a length scale are raised by sqrt(n), so that
    they count as one: the errors of neighbours are much the same, and do not average out.

    Parameters
    ----------
    xy : array, (N, 2)
        Metres.
    elevation : array, (N,)
        Metres.
    length_scale : float
        Metres.
    workers : int
        Threads; the result does not depend on it.

    Returns
    -------
    array, (N,)
        Where points are too sparse to tell a scatter, only the last effect is left.
    """
    cell = NOISE_CELL * length_scale
    return np.ravel(_core.gp_noise_ratio(xy, elevation, cell=cell, threads=workers))


def _solve(
    predict: Callable[..., list[NDArray[np.float32]]],
    xy: Array,
    elevation: Array,
    noise: Array,
    parameters: Hyperparameters,
    **places: Any,
) -> Prediction:
    prior = {"length_scale": parameters.length_scale, "variance": parameters.variance}
    try:
        return Prediction(*predict(xy, elevation, noise, **prior, **places))
    except RuntimeError as error:
        raise TerrainLoopError(
            expected="equations that can be solved in double precision",
            found=f"{error}, with {parameters}",
            mend="raise the noise or shorten the length scale",
        ) from error
