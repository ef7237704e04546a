"""Stray points: the few that are far from everything else as seen from above."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

CENTRAL = (10, 90)  # percentiles of the coordinates between which the bulk of a cloud is found
CELL = 0.25  # side of a cell, as a share of the bulk's; cells that touch are one piece of ground
GAP = 3.0  # sides of the bulk by which a stray piece is separated from the ground
MAX_SHARE = 0.05  # of the points: more are another piece of ground, not strays


def isolated_points(xy: Array) -> NDArray[np.bool_]:
    """Which points (N, 2) are strays: small groups separated from the rest by a wide gap.

    A group counts as stray where three times the side of the bulk of the cloud separate it from the largest
    group. Real ground thins out with the distance; it does not break off and begin again so far away. If
    the stray groups hold more than a twentieth of the points, none is taken for stray.
    """
    low, high = np.percentile(xy, CENTRAL, axis=0)
    side = float((high - low).max()) / (CENTRAL[1] - CENTRAL[0]) * 100
    stray = np.zeros(len(xy), dtype=bool)
    if not side > 0 or np.ptp(xy, axis=0).max() <= GAP * side:
        return stray
    cells, of_point = np.unique(np.floor((xy - low) / (CELL * side)), axis=0, return_inverse=True)
    group = _touching(cells)[of_point.ravel()]
    ground = group == np.bincount(group).argmax()
    others = np.flatnonzero(~ground)
    near = cKDTree(xy[ground]).query(xy[others], distance_upper_bound=GAP * side)[0] < np.inf
    stray[others] = ~np.isin(group[others], group[others[near]])
    return stray if stray.mean() <= MAX_SHARE else np.zeros_like(stray)


def _touching(cells: Array) -> NDArray[np.int32]:
    """Label of the connected group of each cell (M, 2); cells are connected by sides and corners."""
    pairs = cKDTree(cells).query_pairs(1.5, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells), len(cells)))
    labels: NDArray[np.int32] = connected_components(links, directed=False)[1]
    return labels
