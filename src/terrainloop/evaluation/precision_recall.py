"""Precision and recall over a threshold on the score (paper, section VI-A)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class OperatingPoint:
    """Pairs counted as matches at one threshold.

    Precision is T_p / (T_p + F_p), NaN where nothing is matched; recall is T_p / (T_p + F_n).
    """

    threshold: float
    true_positives: int
    false_positives: int
    false_negatives: int

    @property
    def precision(self) -> float:
        """Share of the matches that are true, NaN if there is none."""
        matched = self.true_positives + self.false_positives
        return self.true_positives / matched if matched else float("nan")

    @property
    def recall(self) -> float:
        """Share of the true pairs that are matched, NaN if there is none."""
        total = self.true_positives + self.false_negatives
        return self.true_positives / total if total else float("nan")


def precision_recall(
    scores: ArrayLike, is_true: ArrayLike, thresholds: Sequence[float]
) -> list[OperatingPoint]:
    """Count the pairs with a score at or above each threshold.

    Parameters
    ----------
    scores, is_true : array_like, (P,)
        Score of each pair, and whether it truly shares ground.
    thresholds : sequence of float
    """
    scores, is_true = np.asarray(scores, dtype=float), np.asarray(is_true, dtype=bool)
    points = []
    for threshold in thresholds:
        matched = scores >= threshold
        true_positives = int((matched & is_true).sum())
        points.append(
            OperatingPoint(
                threshold=float(threshold),
                true_positives=true_positives,
                false_positives=int(matched.sum()) - true_positives,
                false_negatives=int(is_true.sum()) - true_positives,
            )
        )
    return points


def recall_at_full_precision(positive: ArrayLike, negative: ArrayLike) -> float:
    """Share of the positive scores above every negative one, NaN if there is no positive."""
    scores: NDArray[np.float64] = np.asarray(positive, dtype=float)
    if not scores.size:
        return float("nan")
    return float((scores > np.max(np.asarray(negative, dtype=float), initial=-np.inf)).mean())
