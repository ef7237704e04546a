"""The Gaussian process solved exactly, in float64: the paper's method and the reference for any other.

With training points X, elevations z and A = [K(X, X) + N]^-1, N the diagonal of the points' noise
squared, at a query x:

    elevation       k(x, X) A z                                (paper, eq. 2)
    variance        k(x, x) - k(x, X) A k(X, x)                (paper, eq. 3)
    gradient        dk(x, X)/dx A z                            (paper, eqs. 4 and 5)
    its variance    variance / l^2 - dk(x, X)/dx A dk(X, x)/dx (Saerkkae, ICANN 2011)
"""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from threadpoolctl import threadpool_limits

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.grid import Grid
from terrainloop.gp.kernel import Array, Hyperparameters, factor, squared_distances
from terrainloop.gp.prediction import Prediction, Values

KERNEL_RADIUS = 7.0  # length scales beyond which the kernel, below 3e-11, is negligible
TILE = 6.0  # side of the tiles the variance is computed in, length scales
NODES = 30  # along an axis of a tile: they interpolate the kernel to 1e-11
MAX_TILE = 64  # pixels along an axis of a tile, which bounds memory
BATCH = 256  # arbitrary points predicted at once, which bounds memory
ROUNDING = 1e-12
MAX_POINTS = 20_000  # 3.2 GB a matrix


def check_size(count: int) -> None:
    """Refuse so many points that their covariance would not fit into memory."""
    if count > MAX_POINTS:
        raise TerrainLoopError(
            expected=f"at most {MAX_POINTS} points for the dense process",
            found=f"{count}, {8e-9 * count**2:.0f} GB a matrix",
            mend="set max_points, or leave the solver at 'spline', which takes them all",
        )


def factorise(xy: Array, parameters: Hyperparameters, noise: Array | float) -> Array:
    """Lower Cholesky factor (N, N) of K(X, X) + N, from the standard deviation of each point's noise (N,).

    Raises
    ------
    TerrainLoopError
        If the matrix is not positive definite to rounding.
    """
    covariance = squared_distances(xy)
    covariance *= -0.5 / parameters.length_scale**2
    np.exp(covariance, out=covariance)
    covariance *= parameters.variance
    covariance.flat[:: len(xy) + 1] += noise**2
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
    xy: Array,
    elevation: Array,
    noise: Array,
    parameters: Hyperparameters,
    grid: Grid,
    *,
    workers: int = 1,
) -> Prediction:
    """Posterior of the elevation and its gradient on a grid.

    Parameters
    ----------
    xy : array, (N, 2)
        Training points, metres.
    elevation, noise : array, (N,)
        Their elevations, the prior having zero mean, and the standard deviation of each, metres.
    parameters : Hyperparameters
        Length scale and variance; the noise is given by point.
    grid : Grid
        Of H x W pixels.
    workers : int
        Threads; the result does not depend on it.

    Returns
    -------
    Prediction
        Arrays of shape (H, W), float64.

    Raises
    ------
    TerrainLoopError
        If the covariance cannot be factorised, or there are more points than fit into memory.
    """
    check_size(len(xy))
    x, y = grid.x, grid.y
    with threadpool_limits(1, user_api="blas"):  # BLAS sums in another order with more threads
        lower = factorise(xy, parameters, noise)
        weights = parameters.variance * cho_solve((lower, True), elevation, check_finite=False)
        kx, dkx = factor(x, xy[:, 0], parameters.length_scale)
        ky, dky = factor(y, xy[:, 1], parameters.length_scale)
        mean, gradient_x = (ky * weights) @ kx.T, (ky * weights) @ dkx.T
        gradient_y = (dky * weights) @ kx.T
        del kx, dkx, ky, dky
        variance, gradient_variance = _variances(xy, invert(lower), parameters, x, y, workers)
    return Prediction(mean, gradient_x, gradient_y, variance, gradient_variance)


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
    check_size(len(xy))
    length_scale, prior = parameters.length_scale, parameters.variance / parameters.length_scale**2
    result = Prediction(*np.empty((5, len(queries))))
    with threadpool_limits(1, user_api="blas"):
        lower = factorise(xy, parameters, noise)
        weights = cho_solve((lower, True), elevation, check_finite=False)

        def explained(covariance: Array) -> Array:
            half = solve_triangular(lower, covariance.T, lower=True, check_finite=False)
            return np.einsum("ij,ij->j", half, half)

        def solve(some: slice) -> None:
            kx, dkx = factor(queries[some, 0], xy[:, 0], length_scale)
            ky, dky = factor(queries[some, 1], xy[:, 1], length_scale)
            k, by_x, by_y = (parameters.variance * product for product in (kx * ky, dkx * ky, kx * dky))
            result.elevation[some], result.gradient_x[some] = k @ weights, by_x @ weights
            result.gradient_y[some] = by_y @ weights
            result.variance[some] = parameters.variance - explained(k)
            result.gradient_variance[some] = prior - (explained(by_x) + explained(by_y)) / 2

        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(solve, (slice(i, i + BATCH) for i in range(0, len(queries), BATCH))))
    _keep_positive(result.variance, result.gradient_variance, parameters)
    return result


def _variances(
    xy: Array, precision: Array, parameters: Hyperparameters, x: Array, y: Array, workers: int
) -> tuple[Array, Array]:
    """Variance of the elevation, and mean variance of the gradient components, (H, W) each.

    Over a tile, k(x, X) is a polynomial in x to within rounding: with N its values at Chebyshev
    nodes and b(x) the interpolation weights, k(x, X) = b(x) N. So k A k' = b (N A N') b', and a
    derivative of k is one of b. Only the points within reach of a tile take part.
    """
    variance, gradient_variance = np.empty((len(y), len(x))), np.empty((len(y), len(x)))
    side, reach = TILE * parameters.length_scale, KERNEL_RADIUS * parameters.length_scale
    prior = parameters.variance / parameters.length_scale**2

    def solve(tile: tuple[slice, slice]) -> None:
        nodes_y, weight_y, slope_y = _interpolation(y[tile[0]], side)
        nodes_x, weight_x, slope_x = _interpolation(x[tile[1]], side)
        near = _within_reach(xy, nodes_x, nodes_y, reach)
        if len(near) == 0:
            variance[tile], gradient_variance[tile] = parameters.variance, prior
            return
        kx = factor(nodes_x, xy[near, 0], parameters.length_scale)[0]
        ky = factor(nodes_y, xy[near, 1], parameters.length_scale)[0]
        k = parameters.variance * (ky[:, None, :] * kx[None, :, :]).reshape(-1, len(near))
        local = precision if len(near) == len(xy) else precision[np.ix_(near, near)]
        explained = k @ local @ k.T
        variance[tile] = parameters.variance - _quadratic(explained, weight_y, weight_x)
        by_both = _quadratic(explained, weight_y, slope_x) + _quadratic(explained, slope_y, weight_x)
        gradient_variance[tile] = prior - by_both / 2

    tiles = [(rows, columns) for rows in _chunks(y, side) for columns in _chunks(x, side)]
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(solve, tiles))
    _keep_positive(variance, gradient_variance, parameters)
    return variance, gradient_variance


def _keep_positive(variance: Values, gradient_variance: Values, parameters: Hyperparameters) -> None:
    """A variance is positive even where cancellation leaves less."""
    smallest = ROUNDING * parameters.variance
    np.maximum(variance, smallest, out=variance)
    np.maximum(gradient_variance, smallest / parameters.length_scale**2, out=gradient_variance)


def _interpolation(coordinates: Array, side: float) -> tuple[Array, Array, Array]:
    """Chebyshev nodes (n,) around the coordinates (M,); weights and their derivatives (M, n)."""
    middle, half = (coordinates[0] + coordinates[-1]) / 2, side / 2
    nodes = chebyshev.chebpts1(NODES)
    from_values = np.linalg.inv(chebyshev.chebvander(nodes, NODES - 1))
    derivatives = chebyshev.chebder(np.eye(NODES)) @ from_values / half
    at = (coordinates - middle) / half
    weights = chebyshev.chebvander(at, NODES - 1) @ from_values
    return middle + half * nodes, weights, chebyshev.chebvander(at, NODES - 2) @ derivatives


def _quadratic(explained: Array, weight_y: Array, weight_x: Array) -> Array:
    """The form b E b' at every pixel of a tile, with b the product of the axes' weights; (rows, columns)."""
    rows, columns = len(weight_y), len(weight_x)
    b = (weight_y[:, None, :, None] * weight_x[None, :, None, :]).reshape(rows * columns, -1)
    return np.einsum("ij,ij->i", b @ explained, b).reshape(rows, columns)


def _within_reach(xy: Array, x: Array, y: Array, reach: float) -> NDArray[np.intp]:
    inside_x = (xy[:, 0] >= x.min() - reach) & (xy[:, 0] <= x.max() + reach)
    return np.flatnonzero(inside_x & (xy[:, 1] >= y.min() - reach) & (xy[:, 1] <= y.max() + reach))


def _chunks(coordinates: Array, side: float) -> list[slice]:
    """Slices of evenly spaced coordinates that span at most `side` metres, nearly equal in length."""
    spacing = coordinates[1] - coordinates[0] if len(coordinates) > 1 else side
    count = -(-len(coordinates) // int(np.clip(side / spacing, 1, MAX_TILE)))
    edges = np.linspace(0, len(coordinates), count + 1).astype(int)
    return [slice(start, stop) for start, stop in pairwise(edges)]
