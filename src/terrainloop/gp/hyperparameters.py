"""Length scale, variance and noise by maximum likelihood (Rasmussen & Williams 2006, ch. 5)."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.exact import factorise, invert
from terrainloop.gp.kernel import Array, Hyperparameters, squared_distances
from terrainloop.gp.surface import Surface, surface_of
from terrainloop.submap import Submap

BLOCK_POINTS = 600

# How far each hyperparameter may move from its start, as a factor. A length scale far below the
# spacing of the points would only turn the terrain into noise.
SPAN = {"length_scale": 10.0, "variance": 1e3, "noise": 1e3}


def negative_log_likelihood(log_parameters: Array, xy: Array, elevation: Array) -> tuple[float, Array]:
    """-log p(z | X) and its gradient with respect to the logarithms of the hyperparameters.

    With a = [K + noise^2 I]^-1 z, the derivative along any parameter t is
    -1/2 tr((a a' - [K + noise^2 I]^-1) dK/dt) (Rasmussen & Williams, eq. 5.9).

    Parameters
    ----------
    log_parameters : array, (3,)
        Logarithms of length scale, variance and noise.
    xy, elevation : array, (N, 2) and (N,)
        Training data, metres.
    """
    parameters = Hyperparameters(*np.exp(log_parameters).tolist())
    lower = factorise(xy, parameters)
    weights = cho_solve((lower, True), elevation, check_finite=False)
    value = 0.5 * elevation @ weights + np.log(lower.diagonal()).sum() + 0.5 * len(xy) * np.log(2 * np.pi)
    sensitivity = invert(lower)
    by_noise = parameters.noise**2 * (np.trace(sensitivity) - weights @ weights)
    sensitivity -= np.multiply.outer(weights, weights)
    scaled = squared_distances(xy)
    scaled /= parameters.length_scale**2
    sensitivity *= parameters.variance * np.exp(-0.5 * scaled)
    by_length_scale = 0.5 * np.vdot(sensitivity, scaled)
    by_variance = 0.5 * sensitivity.sum()
    return float(value), np.array([by_length_scale, by_variance, by_noise])


def fit_hyperparameters(
    clouds: Sequence[ArrayLike | Submap],
    length_scale: float | None = None,
    variance: float | None = None,
    noise: float | None = None,
    *,
    max_points: int = 5000,
    block_points: int | None = BLOCK_POINTS,
    remove_plane: bool = True,
    seed: int = 0,
    workers: int = 1,
) -> Hyperparameters:
    """Fit the hyperparameters that one or several submaps have in common.

    Parameters
    ----------
    clouds : sequence of (N, 3) array_like or Submap
        Gravity-aligned points, metres.
    length_scale, variance, noise : float, optional
        Where the search begins: metres, metres squared (default: the elevations' own), metres.
    max_points : int
        Drawn at random from each cloud. Fit on as many as the maps are made of: thinner data ask
        for a longer length scale.
    block_points : int, optional
        The likelihood is that of neighbouring blocks of at most so many points, taken as independent,
        which costs a hundredth of the exact one; None: exact, all points of a cloud at once.
    remove_plane : bool
        Take the best plane out of each cloud first.
    seed : int
        Of the draw.
    workers : int
        Threads; the result does not depend on it.

    Returns
    -------
    Hyperparameters
        ``.length_scale`` (m), ``.variance`` (m^2), ``.noise`` (m, standard deviation).

    Raises
    ------
    TerrainLoopError
        If there is no cloud, or one that is no submap.
    """
    if len(clouds) == 0:
        raise TerrainLoopError(expected="at least one cloud", found="none", mend="pass a list of clouds")
    surfaces = [
        surface_of(cloud, max_points=max_points, remove_plane=remove_plane, seed=seed) for cloud in clouds
    ]
    start = surfaces[0].start(length_scale, variance, noise)
    if block_points is not None:
        surfaces = [block for surface in surfaces for block in surface.blocks(block_points)]
    return maximise_likelihood(surfaces, start, workers=workers)


def maximise_likelihood(
    surfaces: Sequence[Surface], start: Hyperparameters, *, fixed: Sequence[str] = (), workers: int = 1
) -> Hyperparameters:
    """Most likely hyperparameters by L-BFGS-B over their logarithms.

    Parameters
    ----------
    surfaces : sequence of Surface
        Independent draws from one prior.
    start : Hyperparameters
        Where the search begins.
    fixed : sequence of str
        Names of the hyperparameters that keep their value.
    workers : int
        Threads; the result does not depend on it.
    """
    origin = np.log([getattr(start, name) for name in SPAN])
    span = np.array([0.0 if name in fixed else np.log(factor) for name, factor in SPAN.items()])
    count = sum(len(surface.xy) for surface in surfaces)

    def per_point(log_parameters: Array) -> tuple[float, Array]:
        terms = list(pool.map(partial(_likelihood_or_wall, log_parameters), surfaces))
        return sum(term[0] for term in terms) / count, np.sum([term[1] for term in terms], axis=0) / count

    with ThreadPoolExecutor(workers) as pool, threadpool_limits(1, user_api="blas"):
        result = minimize(
            per_point,
            origin,
            jac=True,
            method="L-BFGS-B",
            bounds=np.c_[origin - span, origin + span],
            options={"ftol": 1e-6, "gtol": 1e-3},
        )
    return Hyperparameters(*np.exp(result.x).tolist())


def _likelihood_or_wall(log_parameters: Array, surface: Surface) -> tuple[float, Array]:
    """The likelihood, or a wall that turns the line search back where the covariance is singular."""
    try:
        return negative_log_likelihood(log_parameters, surface.xy, surface.elevation)
    except TerrainLoopError:
        return 1e25, np.zeros(3)
