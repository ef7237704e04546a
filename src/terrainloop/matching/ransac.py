"""The fast form of Algorithm 1: RANSAC on SE(2) over keypoint associations, verified on the maps."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from terrainloop import _core
from terrainloop.config import Settings
from terrainloop.geometry import Array, fit_se2
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.correspondences import Associations
from terrainloop.matching.overlay import Overlay
from terrainloop.matching.ssd import Ssd, compute_ssd

CHUNK = 32  # inlier sets computed at a time: usually few are needed
MAX_VERIFIED = 200  # inlier sets, the largest, whose h is computed; bounds the time per pair


@dataclass(frozen=True, eq=False)
class Alignment:
    """What Algorithm 1 returns: T, the inliers (n of them) and h."""

    T_target_source: Array
    inliers: NDArray[np.bool_]
    ssd: Ssd


def register_by_ransac(
    source: GradientMap,
    target: GradientMap,
    associations: Associations,
    *,
    iterations: int,
    inlier_radius: float,
    max_ssd_ratio: float,
    rng: np.random.Generator,
) -> Alignment | None:
    """The result of `algorithm_1.algorithm_1`: the accepted transform with the most inliers.

    The loop of the paper keeps, over all draws, the transform with the most inliers among those
    whose SSD is acceptable. Here draws are visited in order of decreasing inlier count, so that the
    first acceptable one is that transform and h need not be computed for the rest. To bound the time per
    pair, h is computed for at most `MAX_VERIFIED` inlier sets, the largest.

    Parameters
    ----------
    source, target : GradientMap
    associations : Associations
        The set A.
    iterations : int
        Number of draws of two associations.
    inlier_radius : float
        Largest distance of an inlier, metres.
    max_ssd_ratio : float
        Largest `Ssd.ratio` of an acceptable transform.
    rng : numpy.random.Generator
        Source of the draws.

    Returns
    -------
    Alignment or None
        None if no draw has two inliers; if none is acceptable, the first draw with most inliers.
    """
    # Neighbouring pixels are redundant: samples half a length scale apart are enough to discard a draw.
    step = max(1, int(target.parameters.length_scale / 2 / target.resolution))
    best = None
    proposed = propose(associations, iterations=iterations, inlier_radius=inlier_radius, rng=rng)
    for inliers in islice(proposed, MAX_VERIFIED):
        T_i = fit_se2(associations.source[inliers], associations.target[inliers])
        promising = compute_ssd(Overlay(source, target, T_i, step)).ratio <= max_ssd_ratio
        if promising or best is None:
            alignment = Alignment(T_i, inliers, compute_ssd(Overlay(source, target, T_i)))
            if alignment.ssd.ratio <= max_ssd_ratio:
                return alignment
            best = best or alignment
    return best


def propose(
    associations: Associations, *, iterations: int, inlier_radius: float, rng: np.random.Generator
) -> Iterator[NDArray[np.bool_]]:
    """Distinct inlier sets of random draws, the largest first, each of two associations or more.

    Parameters
    ----------
    associations, iterations, inlier_radius, rng
        The parameters of `register_by_ransac`.
    """
    if len(associations) < 2:
        return
    draws = select_random_associations(len(associations), iterations, rng)
    apart = np.linalg.norm(associations.source[draws[:, 0]] - associations.source[draws[:, 1]], axis=1)
    draws = draws[apart > inlier_radius]  # closer ones do not constrain the rotation
    T = fit_se2(associations.source[draws], associations.target[draws])
    yield from _distinct_by_falling_count(associations, T, inlier_radius)


def inlier_radius_of(settings: Settings, target: GradientMap) -> float:
    """Largest distance of an inlier, metres: as set, or half the length scale."""
    return settings.match.inlier_radius or target.parameters.length_scale / 2


def rng_for_pair(settings: Settings, *names: str) -> np.random.Generator:
    """The random generator of a pair of submaps, the same whatever was compared before."""
    return np.random.default_rng([settings.seed, *(zlib.crc32(name.encode()) for name in names)])


def select_random_associations(count: int, iterations: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """*SelectRandomAsso*: pairs (iterations, 2) of two different associations out of `count`."""
    first = rng.integers(count, size=iterations)
    second = (first + rng.integers(1, count, size=iterations)) % count
    return np.stack([first, second], axis=1)


def get_inliers(associations: Associations, T: Array, inlier_radius: float) -> NDArray[np.bool_]:
    """*GetInliers*: (K, A), which associations each of the transforms (K, 3, 3) brings together."""
    # The plane as complex numbers: a rotation is a product.
    source, target = (points @ (1.0, 1j) for points in (associations.source, associations.target))
    away = (T[:, :1, 0] + 1j * T[:, 1:2, 0]) * source
    away += T[:, :1, 2] + 1j * T[:, 1:2, 2]
    away -= target
    return away.real**2 + away.imag**2 <= inlier_radius**2


def _distinct_by_falling_count(
    associations: Associations, T: Array, inlier_radius: float
) -> Iterator[NDArray[np.bool_]]:
    """Distinct inlier sets of two or more, the largest first, equal ones in the order of the draws."""
    motions = np.stack([T[:, 0, 0], T[:, 1, 0], T[:, 0, 2], T[:, 1, 2]], axis=1)
    counts = _core.inlier_counts(associations.source, associations.target, motions, inlier_radius)
    order = np.argsort(-counts, kind="stable")
    order = order[: np.count_nonzero(counts >= 2)]
    seen = set()
    for start in range(0, len(order), CHUNK):
        for inliers in get_inliers(associations, T[order[start : start + CHUNK]], inlier_radius):
            key = inliers.tobytes()
            if key not in seen:
                seen.add(key)
                yield inliers
