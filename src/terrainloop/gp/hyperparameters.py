"""Length scale, variance and noise by maximum likelihood (Rasmussen & Williams 2006, ch. 5)."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import cho_solve
from scipy.optimize import Bounds, minimize
from threadpoolctl import threadpool_limits

from terrainloop import _core
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.checks import check_max_points, check_positive, check_seed, core_errors
from terrainloop.gp.exact import check_size, factorise, invert
from terrainloop.gp.kernel import Array, Hyperparameters, squared_distances
from terrainloop.gp.training import OCCUPANCY_CELLS, PATCH_SIDE, Points, TrainingData, detrend
from terrainloop.resources import usable_workers
from terrainloop.submap import MIN_POINTS

# How far each hyperparameter may move from its start, as a factor. A length scale far below the
# spacing of the points would only turn the terrain into noise.
SPAN = {"length_scale": 10.0, "variance": 1e3, "noise": 1e3}

# Drawn from a cloud for a fit: a few thousand are further apart than stereo's errors are correlated
# (docs/solver.md).
FIT_POINTS = 5000
MIN_SIGNAL = 0.1  # of the noise squared: a smaller variance is not terrain
MIN_PATCH = 10.0  # length scales along the side of a patch: a plane subtracted from less takes the terrain

# Stages of a search: side of the blocks in length scales, and the sum of r^3 over their ranks r. The first
# finds about where the length scale is; the larger the blocks, the nearer to the likelihood of all points.
BLOCK_STAGES = ((4.0, 3e7), (10.0, 1e9))
NOISE_STAGES = ((4.0, 3e7),)  # where the length scale is known
NOISE_SCATTER = 0.3  # of the logarithm of the noise of one sensor: rocks count as noise, more in one submap
MAX_ROUNDS = 6
TRUST_REGION = (1 / 1.5, 3.0)  # factors of the length scale that blocks are good for
CONVERGED_FACTOR = 1.25  # of the length scale, within which they are at their best
GRADIENT_TOLERANCE = 0.3  # standard errors from the optimum, where a search ends

PENALTY = 1e25  # reverses a line search

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


@dataclass(frozen=True)
class FitOptions:
    """How hyperparameters are fitted; see `fit_hyperparameters`."""

    max_points: int | None = FIT_POINTS
    exact: bool = False
    remove_plane: bool = True
    seed: int = 0
    workers: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "workers", usable_workers(self.workers))
        check_seed(self.seed)


def fit_hyperparameters(
    clouds: Sequence[Points],
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

    Clouds much wider than a submap are fitted in patches of about 45 x 45 m, so that the result does not
    depend on the extent of a cloud.

    Parameters
    ----------
    clouds : sequence of (N, 3) array_like or Submap
        Gravity-aligned points, metres.
    length_scale, variance, noise : float, optional
        Where the search begins: metres, metres squared (default: the elevations' own), metres.
    max_points : int or None
        Drawn at random from each cloud, or from each full patch of a wide one; None: all. Denser points
        lead to a shorter length scale: the errors that neighbours share count as terrain, because the
        process assumes white noise.
    exact : bool
        Use the likelihood of all points of a cloud at once, which takes minutes for 5000 of them, and of
        one patch of a wide cloud; otherwise that of square blocks, from any number of points (see
        `fit_blocks`).
    remove_plane : bool
        Subtract the best plane from each cloud first.
    seed : int
        Seed of the random draw.
    workers : int
        Threads; the result does not depend on it.

    Returns
    -------
    Hyperparameters
        ``.length_scale`` (m), ``.variance`` (m^2), ``.noise`` (m, standard deviation).

    Raises
    ------
    TerrainLoopError
        If there is no cloud or one that is not a submap, or a number is impossible.
    """
    if not isinstance(clouds, Sequence | np.ndarray) or len(clouds) == 0:
        raise TerrainLoopError(
            expected="at least one cloud",
            found="none" if clouds is None or isinstance(clouds, Sequence) else f"a {type(clouds).__name__}",
            mend="pass a list of clouds",
        )
    given = {"length_scale": length_scale, "variance": variance, "noise": noise}
    check_positive(**given)
    check_max_points(max_points=max_points)
    options = FitOptions(max_points, exact, remove_plane, seed, workers)
    return fit_training_data([detrend(cloud, remove_plane=remove_plane) for cloud in clouds], given, options)


def fit_training_data(
    data: Sequence[TrainingData],
    given: Mapping[str, float | None],
    options: FitOptions,
    *,
    fixed: Sequence[str] = (),
) -> Hyperparameters:
    """As `fit_hyperparameters`, from the start `given`; those named in `fixed` keep the value given."""
    side, widest = PATCH_SIDE, max(each.side for each in data)
    while True:
        patches = [each.patches(side, remove_plane=options.remove_plane) for each in data]
        with core_errors("a fit of the hyperparameters"):
            fitted = _fit_patches(patches, given, options, fixed)
        if fitted.length_scale * MIN_PATCH <= side or side >= widest:
            return fitted
        side *= 2


def fit_noise(cloud: TrainingData, shared: Hyperparameters, options: FitOptions) -> Hyperparameters:
    """The hyperparameters of a database, with the noise that makes one of its clouds most likely.

    Sensors, densities and epochs differ in their errors, the ground in its length scale and variance: these
    stay those of the database, so that its maps remain comparable.

    Parameters
    ----------
    cloud : TrainingData
    shared : Hyperparameters
        Of the database. Towards its noise that of the cloud is shrunk, the more the nearer they are: one
        sensor's fitted noise scatters by tens of per cent, with the rocks and stones in a submap.
    options : FitOptions
        ``exact`` has no effect: one noise is as well known from small blocks.

    Returns
    -------
    Hyperparameters
        ``.noise`` is that of the cloud (m), at least 1e-4 of the prior's standard deviation.
    """
    side = max(PATCH_SIDE, MIN_PATCH * shared.length_scale)
    drawn = _drawn(cloud.patches(side, remove_plane=options.remove_plane), options)
    start = _typical(drawn).start(shared.length_scale, shared.variance, None)
    with core_errors("a fit of the noise"):
        fitted = fit_blocks(
            drawn,
            start,
            fixed=("length_scale", "variance"),
            workers=options.workers,
            stages=NOISE_STAGES,
        )
    difference = float(np.log(fitted.noise / shared.noise))
    real = difference**2 / (difference**2 + NOISE_SCATTER**2)
    return replace(shared, noise=shared.noise * float(np.exp(real * difference)))


def _fit_patches(
    patches: Sequence[Sequence[TrainingData]],
    given: Mapping[str, float | None],
    options: FitOptions,
    fixed: Sequence[str],
) -> Hyperparameters:
    """Hyperparameters of points drawn from the patches of each cloud.

    The subsample is quadrupled until the fit resolves terrain (variance > 0.1 noise^2 and length scale >
    point spacing): on wide ground a few thousand points may be too far apart.
    """
    if options.exact:
        patches = [[max(each, key=lambda patch: len(patch.xy))] for each in patches]
    drawn = [patch for each in patches for patch in _drawn(each, options)]
    start = _typical(drawn[: len(patches[0])]).start(**given)
    fit = maximise_likelihood if options.exact else fit_blocks
    fitted = fit(drawn, start, fixed=fixed, workers=options.workers)
    spacing = min(patch.spacing for patch in drawn)
    shows_terrain = fitted.variance > MIN_SIGNAL * fitted.noise**2 and fitted.length_scale > spacing
    all_drawn = sum(len(patch.xy) for each in patches for patch in each) == sum(len(d.xy) for d in drawn)
    if options.exact or shows_terrain or options.max_points is None or all_drawn:
        return fitted
    return _fit_patches(patches, given, replace(options, max_points=4 * options.max_points), fixed)


def _drawn(patches: Sequence[TrainingData], options: FitOptions) -> list[TrainingData]:
    """Points drawn from each patch of a cloud, in proportion to its share of a full patch's area."""
    if len(patches) == 1 or options.max_points is None:
        return [patch.drawn(options.max_points, options.seed) for patch in patches]
    shares = [patch.area(PATCH_SIDE / OCCUPANCY_CELLS) / PATCH_SIDE**2 for patch in patches]
    counts = [max(MIN_POINTS, round(share * options.max_points)) for share in shares]
    return [patch.drawn(count, options.seed) for patch, count in zip(patches, counts, strict=True)]


def _typical(patches: Sequence[TrainingData]) -> TrainingData:
    """The patch of median relief."""
    return sorted(patches, key=lambda patch: float(patch.elevation.std()))[len(patches) // 2]


def fit_blocks(
    data: Sequence[TrainingData],
    start: Hyperparameters,
    *,
    fixed: Sequence[str] = (),
    workers: int = 1,
    stages: Sequence[tuple[float, float]] = BLOCK_STAGES,
) -> Hyperparameters:
    """Most likely hyperparameters from every point, square blocks of ground being taken as independent.

    On a block the prior is represented by its principal components, so the cost of the likelihood does not
    depend on the number of points. Blocks and components suit length scales near the one they were made for:
    a search begins anew until it ends near where it began.

    Parameters
    ----------
    data : sequence of TrainingData
        Independent draws from one prior.
    start : Hyperparameters
        Where the search begins.
    fixed : sequence of str
        Names of the hyperparameters that keep their value.
    workers : int
        Threads; the result does not depend on it.
    stages : sequence of (float, float)
        Side of the blocks and work, as in `BLOCK_STAGES`, of each search.
    """
    arrays = [(each.xy, each.elevation, each.relative_noise) for each in data]
    low, high = _bounds(start, fixed)
    if "length_scale" not in fixed:
        high[0] = max(high[0], np.log(max(np.ptp(each.xy, axis=0).max() for each in data)))
    log_parameters = np.log(astuple(start))
    for side, work in stages:
        for _ in range(MAX_ROUNDS):
            begin = log_parameters
            length_scale, variance, noise = np.exp(begin).tolist()
            likelihood, blocks, rank, points = _core.gp_block_likelihood(
                arrays,
                length_scale=length_scale,
                variance=variance,
                noise=noise,
                side=side * length_scale,
                work=work,
                threads=workers,
            )
            lowest, highest = low.copy(), high.copy()
            lowest[0], highest[0] = np.clip(begin[0] + np.log(TRUST_REGION), low[0], high[0])
            # About the standard errors, by the expected curvature.
            errors = 1 / np.sqrt([2 * blocks * rank, blocks * rank / 4, 2 * points])
            log_parameters = _descend(likelihood, begin, lowest, highest, errors)
            moved = log_parameters - begin
            more_detail = moved[1] - 2 * moved[2]  # of the ratio of variance and noise
            if abs(moved[0]) < np.log(CONVERGED_FACTOR) and more_detail < 1:
                break
    return Hyperparameters(*np.exp(log_parameters).tolist())


def _descend(likelihood: Likelihood, begin: Array, low: Array, high: Array, errors: Array) -> Array:
    """Logarithms of the most likely hyperparameters by L-BFGS-B, in steps of standard errors."""

    def in_errors(step: Array) -> tuple[float, Array]:
        try:
            value, gradient = likelihood(*np.exp(begin + errors * step).tolist())
        except RuntimeError:
            return PENALTY, np.zeros(3)
        return value, errors * np.array(gradient)

    result = minimize(
        in_errors,
        np.zeros(3),
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds((low - begin) / errors, (high - begin) / errors),
        options={"ftol": 1e-9, "gtol": GRADIENT_TOLERANCE},
    )
    moved: Array = errors * result.x
    return begin + moved


def _bounds(start: Hyperparameters, fixed: Sequence[str]) -> tuple[Array, Array]:
    """Least and greatest logarithms of the hyperparameters."""
    origin = np.log(astuple(start))
    span = np.array([0.0 if name in fixed else np.log(factor) for name, factor in SPAN.items()])
    return origin - span, origin + span


def maximise_likelihood(
    data: Sequence[TrainingData], start: Hyperparameters, *, fixed: Sequence[str] = (), workers: int = 1
) -> Hyperparameters:
    """As `fit_blocks`, by the likelihood of all points of a surface at once (see `negative_log_likelihood`).

    Raises
    ------
    TerrainLoopError
        If there are more points than a dense covariance can have.
    """
    check_size(max(len(each.xy) for each in data))
    count = sum(len(each.xy) for each in data)

    def per_point(log_parameters: Array) -> tuple[float, Array]:
        terms = list(pool.map(partial(_likelihood_or_penalty, log_parameters), data))
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


def _likelihood_or_penalty(log_parameters: Array, data: TrainingData) -> tuple[float, Array]:
    """The likelihood, or a penalty that reverses the line search where the covariance is singular."""
    try:
        return negative_log_likelihood(log_parameters, data.xy, data.elevation, data.relative_noise)
    except TerrainLoopError:
        return PENALTY, np.zeros(3)
