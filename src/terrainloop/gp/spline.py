"""The Gaussian process from every point, in time linear in points and area: our solver in the C++ core.

The elevation is a spline of degree 7 on knots half a length scale apart, whose weights have the prior
covariance with which the spline is the process (docs/solver.md).
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from terrainloop import _core
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.grid import Grid
from terrainloop.gp.kernel import Array, Hyperparameters
from terrainloop.gp.prediction import Prediction

KNOT_SPACING = 0.5  # length scales, as in the core
REACH_CELLS = 14  # cells of the lattice that are solved around the points at most, as in the core
NOISE_CELL = 0.5  # length scales: the ground in a cell is near a plane
MIN_SCATTER = 0.1  # of the noise of the process


def predict_grid(
    xy: Array,
    elevation: Array,
    noise: Array,
    parameters: Hyperparameters,
    grid: Grid,
    *,
    workers: int = 1,
) -> Prediction:
    """Posterior of the elevation and its gradient on a grid; parameters as for `exact.predict_grid`.

    Returns
    -------
    Prediction
        Arrays of shape (H, W), float32.

    Raises
    ------
    TerrainLoopError
        If the equations cannot be solved to tolerance.
    """
    with _solver_errors(parameters):
        maps = _core.gp_predict_grid(
            xy,
            elevation,
            noise,
            length_scale=parameters.length_scale,
            variance=parameters.variance,
            x=grid.origin[0],
            y=grid.origin[1],
            resolution=grid.resolution,
            rows=grid.shape[0],
            cols=grid.shape[1],
            threads=workers,
        )
    return Prediction(*maps)


def predict_at(
    xy: Array,
    elevation: Array,
    noise: Array,
    parameters: Hyperparameters,
    queries: Array,
    *,
    workers: int = 1,
) -> Prediction:
    """Posterior at arbitrary points (Q, 2), metres; otherwise as `predict_grid`."""
    with _solver_errors(parameters):
        maps = _core.gp_predict_at(
            xy,
            elevation,
            noise,
            length_scale=parameters.length_scale,
            variance=parameters.variance,
            queries=queries,
            threads=workers,
        )
    return Prediction(*maps)


def noise_ratio(
    xy: Array, elevation: Array, length_scale: float, noise: float = 0.0, *, workers: int = 1
) -> Array:
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
    noise : float
        Of the process, metres. A typical scatter below a tenth of it is taken for a tenth: on ground whose
        elevations are quantised, most cells show none at all.
    workers : int
        Threads; the result does not depend on it.

    Returns
    -------
    array, (N,)
        Where points are too sparse to estimate a scatter, only the last effect is left.
    """
    cell, smallest = NOISE_CELL * length_scale, MIN_SCATTER * noise
    ratio = _core.gp_noise_ratio(xy, elevation, cell=cell, smallest_scatter=smallest, threads=workers)
    return np.ravel(ratio)


@contextmanager
def _solver_errors(parameters: Hyperparameters) -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        raise TerrainLoopError(
            expected="equations that can be solved in double precision",
            found=f"{error}, with {parameters}",
            mend="raise the noise or shorten the length scale",
        ) from error
