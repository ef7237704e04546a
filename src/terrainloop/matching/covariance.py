"""Covariance of a least-squares fit whose residuals are correlated over the ground."""

import numpy as np

from terrainloop.geometry import Array

MAX_CONDITION = 1e10  # largest condition of a normal matrix scaled to unit diagonal


def block_covariance(
    jacobian: Array, weighted_residuals: Array, normal: Array, positions: Array, block: float
) -> Array:
    """Sandwich covariance of a weighted fit, with blocks of ground as the independent units.

    Parameters
    ----------
    jacobian : array, (N, P) or (C, N, P)
        Jacobian of the residuals at N positions, C of them at each.
    weighted_residuals : array, (N,) or (C, N)
        Weights times residuals at the optimum.
    normal : array, (P, P)
        Derivative of the gradient J' W r by the parameters: J' W J if the weights are fixed.
    positions : array, (N, 2)
        Where the residuals are, metres.
    block : float
        Side of the blocks whose sums count as independent, metres.

    Returns
    -------
    array, (P, P)
        NaN where there are not more blocks than parameters, or a parameter is undetermined.
    """
    gradient = weighted_residuals[..., None] * jacobian
    if gradient.ndim == 3:
        gradient = gradient.sum(axis=0)
    cells = np.floor(positions / block).astype(np.int64)
    cells -= cells.min(axis=0)
    _, cell = np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1], return_inverse=True)
    sums = np.stack([np.bincount(cell, weights=column) for column in gradient.T], axis=1)
    blocks, parameters = sums.shape
    unknown = np.full((parameters, parameters), np.nan)
    if blocks <= parameters or np.diag(normal).min() <= 0:
        return unknown
    scale = np.sqrt(np.diag(normal))
    scales = np.outer(scale, scale)
    if np.linalg.cond(normal / scales) > MAX_CONDITION:
        return unknown
    inverse = np.linalg.inv(normal / scales) / scales
    return blocks / (blocks - parameters) * inverse @ (sums.T @ sums) @ inverse
