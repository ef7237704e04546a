"""How significant a match is: a-contrario, by the number of false alarms (NFA) that chance yields.

The NFA of a match is the number of tests times the probability that unrelated ground agrees at least as well
in one test (Desolneux, Moisan and Morel, Int. J. Comput. Vis. 40(1), 2000). It is the expected number of
matches as good in a pair of submaps that share nothing. The surprisal of an observation is minus the natural
logarithm of that probability, in nats.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from terrainloop.config import Calibration

LN_2 = float(np.log(2.0))


def surprisal_of_correlation(
    correlation_squared: NDArray[np.floating] | float,
    samples: NDArray[np.floating] | float,
    calibration: Calibration,
) -> NDArray[np.floating]:
    """Surprisal of the correlation of independent samples of zero mean.

    A correlation r of n samples is exceeded with a probability that falls as (1 - r^2)^((n - 1) / 2).

    Parameters
    ----------
    correlation_squared : float or array
        r^2; 0 for a negative r.
    samples : float or array
        Number n of samples: the shared area in units of the area of one independent sample.
    calibration : Calibration
    """
    bounded = np.minimum(correlation_squared, calibration.max_correlation**2)
    return np.asarray(-0.5 * np.maximum(samples - 1.0, 0.0) * np.log1p(-bounded))


def surprisal_of_field(correlation: float, samples: float, calibration: Calibration) -> float:
    """Surprisal of the agreement of two fields: that of the correlation, with the calibrated tail."""
    squared = max(correlation, 0.0) ** 2
    return calibration.tail * float(surprisal_of_correlation(squared, samples, calibration))


def surprisal_of_inliers(inliers: int, associations: int, probability: float) -> float:
    """Surprisal of a number of keypoint associations that agree with a pose they did not propose.

    Parameters
    ----------
    inliers : int
        Number n of independent inliers.
    associations : int
        Number M of all associations.
    probability : float
        Probability p that one association agrees by chance: the area within the inlier radius over the
        observed area.

    Returns
    -------
    float
        Minus the natural logarithm of the binomial tail P(n or more of M).
    """
    if inliers <= 0:
        return 0.0
    tail = float(betainc(inliers, associations - inliers + 1, probability))
    return -float(np.log(max(tail, np.finfo(float).tiny)))


def combined_surprisal(field: float, inliers: float) -> float:
    """Surprisal of the field alone, or of field and inliers together, whichever is larger.

    The sum x of two independent surprisals has tail probability exp(-x)(1 + x) (Fisher's method, 1932);
    choosing the better of two tests costs a factor of two.
    """
    together = field + inliers
    return max(field, together - float(np.log1p(together)), LN_2) - LN_2


def log_num_tests(tried: float, others: NDArray[np.floating], calibration: Calibration) -> float:
    """Natural logarithm of the number of independent tests among the poses that a search tried.

    Where similar places abound, as on ripples, the pair itself reveals more: if k places besides the best
    reach a surprisal s, it is as if k exp(s) tests had been made.

    Parameters
    ----------
    tried : float
        See `terrainloop.matching.search.SearchResult`.
    others : array, (K,)
        Surprisals, by the correlation's formula, of the places found besides the best, in decreasing order.
    calibration : Calibration
    """
    measured = calibration.tail * others[-1] + np.log(len(others)) if len(others) else 0.0
    return float(max(np.log(max(calibration.independent_tests * tried, 1.0)), measured))
