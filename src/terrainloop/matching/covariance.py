"""Covariance of a least-squares fit whose residuals are correlated over the ground."""

import numpy as np

from terrainloop.geometry import Array

WORST = 1e10  # condition of a normal matrix, in units of its diagonal
BLOCK = 2.0  # side of the blocks whose sums count as independent, in length scales


def block_covariance(
    jacobian: Array, weighted_residuals: Array, normal: Array, ground: Array, length_scale: float
) -> Array:
    """Sandwich covariance of a weighted fit, with blocks of ground as the independent units.

    Parameters
    ----------
    jacobian : array, (N, P) or (C, N, P)
        Of the residuals at N places; C of them a place.
    weighted_residuals : array, (N,) or (C, N)
        Weights times residuals at the optimum.
    normal : array, (P, P)
        Normal matrix J' W J.
    ground : array, (N, 2)
        Where the residuals are, metres.
    length_scale : float
        Metres.

    Returns
    -------
    array, (P, P)
        NaN where there are not more blocks than parameters, or a parameter is undetermined.
    """
    gradient = weighted_residuals[..., None] * jacobian
    if gradient.ndim == 3:
        gradient = gradient.sum(axis=0)
    cells = np.floor(ground / (BLOCK * length_scale)).astype(np.int64)
    cells -= cells.min(axis=0)
    _, block = np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1], return_inverse=True)
    sums = np.stack([np.bincount(block, weights=column) for column in gradient.T], axis=1)
    blocks, parameters = sums.shape
    scale = np.sqrt(np.diag(normal))
    if blocks <= parameters or scale.min() <= 0 or np.linalg.cond(normal / np.outer(scale, scale)) > WORST:
        return np.full((parameters, parameters), np.nan)
    inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    return blocks / (blocks - parameters) * inverse @ (sums.T @ sums) @ inverse
