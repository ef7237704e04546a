"""How sure a match is: the false alarms as good that chance would yield, from a null that is measured.

A surprise is minus the natural logarithm of the chance that unrelated ground does as well at one pose.
With N poses tried, N exp(-surprise) places as good are expected in a pair of submaps that shares nothing.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

LARGEST_CORRELATION = 0.999  # the most that two maps of real ground can be trusted to agree
NO_EVIDENCE = -10.0  # score of a pair that could not be compared

# Measured on 3840 pairs of simulated submaps that share nothing (docs/matching.md): places become fewer
# with what the formula gives a little more slowly than the formula alone would have it.
TAIL = 0.85  # surprise in a nat of the formula
INDEPENDENT_POSES = 0.05  # in a rotation times a squared length scale


def surprise(
    correlation_squared: NDArray[np.floating] | float, samples: NDArray[np.floating] | float
) -> NDArray[np.floating]:
    """Surprise of a correlation, for independent samples.

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
    return np.asarray(-0.5 * np.maximum(samples - 1.0, 0.0) * np.log1p(-trusted))


def surprise_of_field(correlation: float, samples: float) -> float:
    """Surprise of the agreement of two fields: the formula, with the tail that was measured."""
    return TAIL * float(surprise(max(correlation, 0.0) ** 2, samples))


def surprise_of_inliers(inliers: int, associations: int, chance: float) -> float:
    """Surprise of so many associations that agree with a pose they had no part in.

    Parameters
    ----------
    inliers : int
        n, in spots apart from one another.
    associations : int
        M.
    chance : float
        p, that one agrees: the area within the inlier radius over that of the known ground. The surprise
        is minus the logarithm of the binomial tail P(n or more of M).
    """
    if inliers <= 0:
        return 0.0
    tail = float(betainc(inliers, associations - inliers + 1, chance))
    return -float(np.log(max(tail, np.finfo(float).tiny)))


def surprise_of_both(field: float, inliers: float) -> float:
    """Surprise of the field alone, or of field and inliers together, whichever is larger.

    Two independent surprises that add up to x are as rare as exp(-x) (1 + x) (Fisher 1932); to choose
    between two tests costs a factor of two.
    """
    together = field + inliers
    return max(field, together - float(np.log1p(together)), float(np.log(2.0))) - float(np.log(2.0))


def log_poses(tried: float, others: NDArray[np.floating]) -> float:
    """Natural logarithm of the number of independent poses among those that a search tried.

    Where like places abound, as on ripples, the pair itself shows more: if k places besides the best
    reach a surprise s, it is as if there were k exp(s) poses.

    Parameters
    ----------
    tried : float
        See `terrainloop.matching.search.Search`.
    others : array, (K,)
        Surprises of the best places but the best, by the formula, falling.
    """
    measured = TAIL * others[-1] + np.log(len(others)) if len(others) else 0.0
    return float(max(np.log(max(INDEPENDENT_POSES * tried, 1.0)), measured))
