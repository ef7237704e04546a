"""The posterior of a Gaussian process over the elevation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float32] | NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prediction:
    """Posterior mean and variance; all arrays have one shape, (rows = y, columns = x) on a grid.

    Attributes
    ----------
    elevation : array
        Metres.
    gradient_x, gradient_y : array
        Slope along x and y, dimensionless.
    variance : array
        Of the elevation, metres squared.
    gradient_variance : array
        Mean of the variances of the two gradient components, dimensionless.
    """

    elevation: Values
    gradient_x: Values
    gradient_y: Values
    variance: Values
    gradient_variance: Values
