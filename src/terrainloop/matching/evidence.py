"""How sure a match is: the expected number of false alarms as good, from a null that is measured."""

import numpy as np
from numpy.typing import NDArray

LARGEST_CORRELATION = 0.999  # the most that two maps of real ground can be trusted to agree
NO_EVIDENCE = -10.0  # score of a pair that could not be compared

# Measured on 3840 pairs of simulated submaps that share nothing (docs/matching.md): the number of places
# above a surprise falls exponentially, a little slower than the formula alone would have it.
TAIL = 0.85  # decay per nat
INDEPENDENT_POSES = 0.08  # at no surprise, in a rotation times a squared length scale


def surprise(
    correlation_squared: NDArray[np.floating] | float, samples: NDArray[np.floating] | float
) -> NDArray[np.floating] | float:
    """Minus the logarithm of the chance that unrelated fields agree so well at one pose.

    A correlation r of n independent samples of mean zero exceeds a value with a chance that falls as
    (1 - r^2)^((n - 1) / 2).

    Parameters
    ----------
    correlation_squared : float or array
        r^2; 0 for a negative r.
    samples : float or array
        n, the shared ground in units of what counts as one sample.
    """
    trusted = np.minimum(correlation_squared, LARGEST_CORRELATION**2)
    return -0.5 * np.maximum(samples - 1.0, 0.0) * np.log1p(-trusted)


def log10_false_alarms(surprise: float, tried: float) -> float:
    """Logarithm of the expected number of places as surprising in a pair that shares nothing.

    Parameters
    ----------
    surprise : float
        Of the best pose (see `surprise`).
    tried : float
        Poses tried (see `terrainloop.matching.search.Search`).
    """
    return float((_log_poses(tried) - TAIL * surprise) / np.log(10.0))


def surprise_needed(false_alarms: float, tried: float) -> float:
    """Surprise from which on no more than so many false alarms are expected in a pair."""
    return float((_log_poses(tried) - np.log(false_alarms)) / TAIL)


def _log_poses(tried: float) -> float:
    return float(np.log(max(INDEPENDENT_POSES * tried, 1.0)))
