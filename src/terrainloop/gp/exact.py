"""The Gaussian process solved exactly, in float64: the paper's method and the reference for any other.

With training points X, elevations z and A = [K(X, X) + noise^2 I]^-1, at a query x:

    elevation       k(x, X) A z                                (paper, eq. 2)
    variance        k(x, x) - k(x, X) A k(X, x)                (paper, eq. 3)
    gradient        dk(x, X)/dx A z                            (paper, eqs. 4 and 5)
    its variance    variance / l^2 - dk(x, X)/dx A dk(X, x)/dx (Saerkkae, ICANN 2011)
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dpotri
from threadpoolctl import threadpool_limits

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Array, Hyperparameters, factor, squared_distances

REACH = 8.0  # length scales beyond which the kernel, below 1.3e-14, is lost in float64 rounding
TILE = 1.5  # side of the tiles the variance is computed in, length scales


@dataclass(frozen=True, eq=False)
class GridPrediction:
    """Posterior on a grid, each (rows = y, columns = x), float64.

    `gradient_variance` is the mean of the variances of the two gradient components.
    """

    elevation: Array
    gradient_x: Array
    gradient_y: Array
    variance: Array
    gradient_variance: Array


def factorise(xy: Array, parameters: Hyperparameters) -> Array:
    """Lower Cholesky factor (N, N) of K(X, X) + noise^2 I.

    Raises
    ------
    TerrainLoopError
        If the matrix is not positive definite to rounding.
    """
    covariance = squared_distances(xy)
    covariance *= -0.5 / parameters.length_scale**2
    np.exp(covariance, out=covariance)
    covariance *= parameters.variance
    covariance.flat[:: len(xy) + 1] += parameters.noise**2
    try:
        # The transpose of a symmetric matrix is itself, and LAPACK then works in place.
        return cholesky(covariance.T, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise TerrainLoopError(
            expected="a positive-definite covariance",
            found=f"a singular one for {len(xy)} points with {parameters}",
            mend="raise the noise or shorten the length scale",
        ) from error


def invert(cholesky_factor: Array) -> Array:
    """Inverse (N, N), symmetric and full, of the matrix whose lower factor is given (overwritten)."""
    inverse, _ = dpotri(cholesky_factor, lower=1, overwrite_c=1)  # sets the lower triangle only
    inverse += np.tril(inverse, -1).T
    return inverse


def predict_grid(
    xy: Array, elevation: Array, parameters: Hyperparameters, x: Array, y: Array, *, workers: int = 1
) -> GridPrediction:
    """Posterior of the elevation and its gradient on the grid spanned by `x` and `y`.

    Parameters
    ----------
    xy : array, (N, 2)
        Training points, metres.
    elevation : array, (N,)
        Their elevations, metres; the prior has zero mean.
    parameters : Hyperparameters
    x, y : array, (W,) and (H,)
        Grid coordinates, metres.
    workers : int
        Threads; the result does not depend on it.

    Returns
    -------
    GridPrediction
        Arrays of shape (H, W).

    Raises
    ------
    TerrainLoopError
        If the covariance cannot be factorised.
    """
    with threadpool_limits(1, user_api="blas"):  # BLAS sums in another order with more threads
        lower = factorise(xy, parameters)
        weights = parameters.variance * cho_solve((lower, True), elevation, check_finite=False)
        kx, dkx = factor(x, xy[:, 0], parameters.length_scale)
        ky, dky = factor(y, xy[:, 1], parameters.length_scale)
        mean, gradient_x = (ky * weights) @ kx.T, (ky * weights) @ dkx.T
        gradient_y = (dky * weights) @ kx.T
        del kx, dkx, ky, dky
        variance, gradient_variance = _variances(xy, invert(lower), parameters, x, y, workers)
    return GridPrediction(mean, gradient_x, gradient_y, variance, gradient_variance)


def _variances(
    xy: Array, precision: Array, parameters: Hyperparameters, x: Array, y: Array, workers: int
) -> tuple[Array, Array]:
    """Variance of the elevation, and mean variance of the gradient components, (H, W) each.

    Tile by tile, so that memory stays bounded and only points within reach of a tile take part.
    """
    variance, gradient_variance = np.empty((len(y), len(x))), np.empty((len(y), len(x)))

    def solve(tile: tuple[slice, slice]) -> None:
        rows, columns = tile
        near = _within_reach(xy, x[columns], y[rows], REACH * parameters.length_scale)
        kx, dkx = factor(x[columns], xy[near, 0], parameters.length_scale)
        ky, dky = factor(y[rows], xy[near, 1], parameters.length_scale)
        local = precision if len(near) == len(xy) else precision[np.ix_(near, near)]
        explained = [_quadratic(local, a, b) for a, b in ((ky, kx), (ky, dkx), (dky, kx))]
        scale = parameters.variance**2
        variance[tile] = parameters.variance - scale * explained[0]
        prior = parameters.variance / parameters.length_scale**2
        gradient_variance[tile] = prior - scale * (explained[1] + explained[2]) / 2

    side = TILE * parameters.length_scale
    tiles = [(rows, columns) for rows in _chunks(y, side) for columns in _chunks(x, side)]
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(solve, tiles))
    rounding = 1e-12  # a variance is positive even where cancellation leaves less
    np.maximum(variance, rounding * parameters.variance, out=variance)
    np.maximum(gradient_variance, rounding * parameters.variance, out=gradient_variance)
    return variance, gradient_variance


def _quadratic(precision: Array, ky: Array, kx: Array) -> Array:
    """k' A k at every pixel of a tile whose separable kernel factors are given; (rows, columns)."""
    k = (ky[:, None, :] * kx[None, :, :]).reshape(len(ky) * len(kx), len(precision))
    return np.einsum("ij,ij->i", k @ precision, k).reshape(len(ky), len(kx))


def _within_reach(xy: Array, x: Array, y: Array, reach: float) -> np.ndarray:
    inside_x = (xy[:, 0] >= x[0] - reach) & (xy[:, 0] <= x[-1] + reach)
    return np.flatnonzero(inside_x & (xy[:, 1] >= y[0] - reach) & (xy[:, 1] <= y[-1] + reach))


def _chunks(coordinates: Array, side: float) -> Iterator[slice]:
    """Slices of at most 32 evenly spaced coordinates that span at most `side` metres."""
    spacing = coordinates[1] - coordinates[0] if len(coordinates) > 1 else side
    step = int(np.clip(side / spacing, 1, 32))
    return (slice(start, start + step) for start in range(0, len(coordinates), step))
