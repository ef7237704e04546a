"""The squared-exponential kernel k(a, b) = variance exp(-|a - b|^2 / (2 length_scale^2)).

It is a product of one factor in x and one in y, so that on a grid the mean and both gradients are
plain matrix products. The paper writes exp(-d^2 / (2 l_k)): its l_k is our length scale squared.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters of a Gaussian process over the elevation.

    Attributes
    ----------
    length_scale : float
        Metres.
    variance : float
        Variance of the elevation under the prior, metres squared.
    noise : float
        Standard deviation of one measured elevation, metres.
    """

    length_scale: float
    variance: float
    noise: float


def factor(query: Array, training: Array, length_scale: float) -> tuple[Array, Array]:
    """One axis of the correlation and its derivative with respect to the query coordinate.

    Parameters
    ----------
    query, training : array, (Q,) and (N,)
        Coordinates along the axis, metres.
    length_scale : float
        Metres.

    Returns
    -------
    value, derivative : array, (Q, N)
        exp(-d^2 / (2 l^2)) and -d / l^2 times that, with d = query - training.
    """
    offset = query[:, None] - training
    value = np.exp(-0.5 * (offset / length_scale) ** 2)
    return value, -offset / length_scale**2 * value


def squared_distances(xy: Array) -> Array:
    """Squared distances (N, N) between all pairs of points (N, 2), metres squared."""
    distances = np.subtract.outer(xy[:, 0], xy[:, 0]) ** 2
    distances += np.subtract.outer(xy[:, 1], xy[:, 1]) ** 2
    return distances
