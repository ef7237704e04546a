"""Length scale, variance and noise by maximum likelihood (Rasmussen & Williams 2006, ch. 5)."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve
from scipy.optimize import Bounds, minimize
from threadpoolctl import threadpool_limits

from terrainloop import _core
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.exact import check_size, factorise, invert
from terrainloop.gp.kernel import Array, Hyperparameters, squared_distances
from terrainloop.gp.surface import Surface, surface_of
from terrainloop.submap import Submap
from terrainloop.workers import usable_workers

# How far each hyperparameter may move from its start, as a factor. A length scale far below the
# spacing of the points would only turn the terrain into noise.
SPAN = {"length_scale": 10.0, "variance": 1e3, "noise": 1e3}

# Drawn from a cloud for a fit: a few thousand lie further apart than stereo's errors reach (docs/solver.md).
FIT_POINTS = 5000
ONLY_NOISE = 0.1  # of the noise squared: a smaller variance is no terrain

# Of the blocks of a search: their side in length scales, and the sum of r^3 over their ranks r. The first
# finds about where the length scale lies; the larger the blocks, the nearer to the likelihood of all points.
SEARCHES = ((4.0, 3e7), (10.0, 1e9))
ROUNDS = 6
REACH = (1 / 1.5, 3.0)  # factors of the length scale that blocks are good for
CLOSE = 1.25  # factor of the length scale within which they are at their best
STANDARD_ERRORS = 0.3  # from the optimum, where a search ends

WALL = 1e25  # turns a line search back

Likelihood = Callable[[float, float, float], tuple[float, tuple[float, float, float]]]


def negative_log_likelihood(
    log_parameters: Array, xy: Array, elevation: Array, relative_noise: Array | float = 1.0
) -> tuple[float, Array]:
    """-log p(z | X) and its gradient with respect to the logarithms of the hyperparameters.

    With C = K + N the covariance of the elevations (see `exact`) and a = C^-1 z, the derivative along
    any parameter t is -1/2 tr((a a' - C^-1) dC/dt) (Rasmussen & Williams, eq. 5.9).

    Parameters
    ----------
    log_parameters : array, (3,)
        Logarithms of length scale, variance and noise.
    xy, elevation : array, (N, 2) and (N,)
        Training data, metres.
    relative_noise : array, (N,), or float
        Noise of each point as a share of the typical one.
    """
    parameters = Hyperparameters(*np.exp(log_parameters).tolist())
    lower = factorise(xy, parameters, parameters.noise * relative_noise)
    weights = cho_solve((lower, True), elevation, check_finite=False)
    value = 0.5 * elevation @ weights + np.log(lower.diagonal()).sum() + 0.5 * len(xy) * np.log(2 * np.pi)
    sensitivity = invert(lower)
    noise_variance = np.broadcast_to((parameters.noise * relative_noise) ** 2, len(xy))
    by_noise = noise_variance @ (sensitivity.diagonal() - weights**2)
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
    max_points: int | None = FIT_POINTS,
    exact: bool = False,
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
    max_points : int or None
        Drawn at random from each cloud; None: all. Denser points ask for a shorter length scale: their
        errors, which neighbours share, count as terrain, for the process takes noise to be white.
    exact : bool
        By the likelihood of all points of a cloud at once, which takes minutes for 5000 of them; if not,
        by that of square blocks, from any number of points (see `fit_blocks`).
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
        If there is no cloud, one that is no submap, or no worker.
    """
    if len(clouds) == 0:
        raise TerrainLoopError(expected="at least one cloud", found="none", mend="pass a list of clouds")
    workers = usable_workers(workers)
    surfaces = [surface_of(cloud, remove_plane=remove_plane) for cloud in clouds]
    return fit_surfaces(
        surfaces,
        length_scale,
        variance,
        noise,
        max_points=max_points,
        exact=exact,
        seed=seed,
        workers=workers,
    )


def fit_surfaces(
    surfaces: Sequence[Surface],
    length_scale: float | None = None,
    variance: float | None = None,
    noise: float | None = None,
    *,
    fixed: Sequence[str] = (),
    max_points: int | None = FIT_POINTS,
    exact: bool = False,
    seed: int = 0,
    workers: int = 1,
) -> Hyperparameters:
    """As `fit_hyperparameters`, those named in `fixed` keeping the value given.

    While all that the drawn points show is noise, or ground that changes from one to the next, four times
    as many are drawn: on wide ground a few thousand may lie too far apart to tell its shape.
    """
    drawn = [surface.drawn(max_points, seed) for surface in surfaces]
    start = drawn[0].start(length_scale, variance, noise)
    fit = maximise_likelihood if exact else fit_blocks
    fitted = fit(drawn, start, fixed=fixed, workers=workers)
    spacing = min(surface.spacing for surface in drawn)
    shows_terrain = fitted.variance > ONLY_NOISE * fitted.noise**2 and fitted.length_scale > spacing
    if exact or shows_terrain or max_points is None or max_points >= max(len(s.xy) for s in surfaces):
        return fitted
    return fit_surfaces(
        surfaces,
        length_scale,
        variance,
        noise,
        fixed=fixed,
        max_points=4 * max_points,
        seed=seed,
        workers=workers,
    )


def fit_blocks(
    surfaces: Sequence[Surface], start: Hyperparameters, *, fixed: Sequence[str] = (), workers: int = 1
) -> Hyperparameters:
    """Most likely hyperparameters from every point, square blocks of ground being taken as independent.

    On a block the prior is held by its principal components, so that the likelihood costs the same for any
    number of points. Blocks and components suit length scales near the one they were made for: a search
    begins anew until it ends near where it began.

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
    data = [(surface.xy, surface.elevation, surface.relative_noise) for surface in surfaces]
    low, high = _bounds(start, fixed)
    if "length_scale" not in fixed:
        high[0] = max(high[0], np.log(max(np.ptp(surface.xy, axis=0).max() for surface in surfaces)))
    log_parameters = np.log(astuple(start))
    for side, work in SEARCHES:
        for _ in range(ROUNDS):
            begin = log_parameters
            length_scale, variance, noise = np.exp(begin).tolist()
            likelihood, blocks, rank, points = _core.gp_block_likelihood(
                data,
                length_scale=length_scale,
                variance=variance,
                noise=noise,
                side=side * length_scale,
                work=work,
                threads=workers,
            )
            lowest, highest = low.copy(), high.copy()
            lowest[0], highest[0] = np.clip(begin[0] + np.log(REACH), low[0], high[0])
            # About the standard errors, by the expected curvature.
            errors = 1 / np.sqrt([2 * blocks * rank, blocks * rank / 4, 2 * points])
            log_parameters = _descend(likelihood, begin, lowest, highest, errors)
            moved = log_parameters - begin
            more_detail = moved[1] - 2 * moved[2]  # of the ratio of variance and noise
            if abs(moved[0]) < np.log(CLOSE) and more_detail < 1:
                break
    return Hyperparameters(*np.exp(log_parameters).tolist())


def _descend(likelihood: Likelihood, begin: Array, low: Array, high: Array, errors: Array) -> Array:
    """Logarithms of the most likely hyperparameters by L-BFGS-B, in steps of standard errors."""

    def in_errors(step: Array) -> tuple[float, Array]:
        try:
            value, gradient = likelihood(*np.exp(begin + errors * step).tolist())
        except RuntimeError:
            return WALL, np.zeros(3)
        return value, errors * np.array(gradient)

    result = minimize(
        in_errors,
        np.zeros(3),
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds((low - begin) / errors, (high - begin) / errors),
        options={"ftol": 1e-9, "gtol": STANDARD_ERRORS},
    )
    moved: Array = errors * result.x
    return begin + moved


def _bounds(start: Hyperparameters, fixed: Sequence[str]) -> tuple[Array, Array]:
    """Least and greatest logarithms of the hyperparameters."""
    origin = np.log(astuple(start))
    span = np.array([0.0 if name in fixed else np.log(factor) for name, factor in SPAN.items()])
    return origin - span, origin + span


def maximise_likelihood(
    surfaces: Sequence[Surface], start: Hyperparameters, *, fixed: Sequence[str] = (), workers: int = 1
) -> Hyperparameters:
    """As `fit_blocks`, by the likelihood of all points of a surface at once (see `negative_log_likelihood`).

    Raises
    ------
    TerrainLoopError
        If there are more points than a dense covariance can have.
    """
    check_size(max(len(surface.xy) for surface in surfaces))
    count = sum(len(surface.xy) for surface in surfaces)

    def per_point(log_parameters: Array) -> tuple[float, Array]:
        terms = list(pool.map(partial(_likelihood_or_wall, log_parameters), surfaces))
        return sum(term[0] for term in terms) / count, np.sum([term[1] for term in terms], axis=0) / count

    with ThreadPoolExecutor(workers) as pool, threadpool_limits(1, user_api="blas"):
        result = minimize(
            per_point,
            np.log(astuple(start)),
            jac=True,
            method="L-BFGS-B",
            bounds=Bounds(*_bounds(start, fixed)),
            options={"ftol": 1e-6, "gtol": 1e-3},
        )
    return Hyperparameters(*np.exp(result.x).tolist())


def _likelihood_or_wall(log_parameters: Array, surface: Surface) -> tuple[float, Array]:
    """The likelihood, or a wall that turns the line search back where the covariance is singular."""
    try:
        return negative_log_likelihood(log_parameters, surface.xy, surface.elevation, surface.relative_noise)
    except TerrainLoopError:
        return WALL, np.zeros(3)
