"""How `max_false_loops` is spent: the share of it that each pair of a mission may use.

A pair is accepted if its number of false alarms (NFA) is at most w a, with a the allowance and w the pair's
share. For unrelated submaps that happens with a probability of at most w a, so the expected number of false
loops is at most the sum of all w a, however the pairs depend on one another; and at most a if the shares add
up to one or less. They may depend on everything but the evidence of the pair itself (docs/matching.md,
section 3).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrainloop.entry import MapEntry
from terrainloop.geometry import Array

FIRST_EPOCH = 32  # submaps; each further epoch doubles their number
DRIFT = 0.1  # of the distance travelled, more than which odometry is hardly off


def share_of_query(compared: int) -> float:
    """Share of the allowance that a query may spend in a mission whose length is not known.

    Epoch m = 1, 2, ... lasts until a query is compared with `FIRST_EPOCH` 2^(m - 1) submaps and spends
    1 / (m (m + 1)), evenly over its pairs. The shares of all queries add up to one.

    Parameters
    ----------
    compared : int
        Number of submaps that it is compared with, at least 1; one more at each query.
    """
    epoch = max(0, int(np.ceil(np.log2(compared / FIRST_EPOCH)))) + 1
    last = FIRST_EPOCH * 2 ** (epoch - 1)
    before = last // 2 if epoch > 1 else 0
    pairs = (last * (last + 1) - before * (before + 1)) / 2
    return compared / pairs / (epoch * (epoch + 1))


def pairs_equivalent(share: float, plausible: NDArray[np.bool_]) -> Array:
    """Among how many pairs the allowance, if divided evenly, would leave each pair what it may spend.

    Half of a query's share is divided among all its pairs, half among those that are plausible by odometry.

    Parameters
    ----------
    share : float
        Share of the allowance that the query may spend.
    plausible : array, (N,)
        Result of `plausible_by_odometry`.

    Returns
    -------
    array, (N,)
    """
    evenly = np.full(len(plausible), share / max(len(plausible), 1))
    shares = 0.5 * evenly + 0.5 * share * plausible / plausible.sum() if plausible.any() else evenly
    return np.asarray(1.0 / shares)


def plausible_by_odometry(
    query: MapEntry, stored: Sequence[MapEntry], since: Sequence[MapEntry]
) -> NDArray[np.bool_]:
    """Which stored submaps may share ground with the query by odometry that drifts by `DRIFT` at most.

    Parameters
    ----------
    query : MapEntry
    stored : sequence of MapEntry
    since : sequence of MapEntry
        The submaps between the last of these and the query.

    Returns
    -------
    array, (N,)
        True also where odometry or the submap's extent is not known, and between sessions.
    """
    discs = [_disc_of(entry) for entry in [*stored, *since, query]]
    middles, radii = np.array([disc[:2] for disc in discs]), np.array([disc[2] for disc in discs])
    steps = np.nan_to_num(np.linalg.norm(np.diff(middles, axis=0), axis=1))
    travelled = np.cumsum(steps[::-1])[::-1][: len(stored)]
    away = np.linalg.norm(middles[: len(stored)] - middles[-1], axis=1)
    apart = away > radii[: len(stored)] + radii[-1] + DRIFT * travelled
    same_session = np.array([entry.record.session == query.record.session for entry in stored], dtype=bool)
    return ~(apart & same_session)


def _disc_of(entry: MapEntry) -> tuple[float, float, float]:
    """x, y and radius, metres, of a disc that holds the submap in the world by odometry; NaN if unknown."""
    hull, odometry = entry.record.hull, entry.record.odometry
    if odometry is None or not len(hull):
        return np.nan, np.nan, np.nan
    middle = hull.mean(axis=0)
    x, y, *_ = odometry @ (*middle, 0.0, 1.0)
    return x, y, float(np.linalg.norm(hull - middle, axis=1).max())
