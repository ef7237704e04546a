"""Precision and recall over a threshold on the score (paper, section VI-A), and numbers of the curve."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.geometry import Array

RESAMPLES = 1000
CONFIDENCE = 0.95


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


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % bootstrap interval; NaN where there is no true pair."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return "-" if np.isnan(self.value) else f"{self.value:.2f} ({self.low:.2f}-{self.high:.2f})"


@dataclass(frozen=True)
class Metrics:
    """Three numbers that summarise a precision-recall curve.

    Attributes
    ----------
    pairs, true_pairs : int
    recall_at_full_precision : Estimate
        Recall at the lowest threshold that admits no false match.
    max_f1 : Estimate
        Largest 2 P R / (P + R).
    average_precision : Estimate
        Sum over the thresholds, from high to low, of precision times the gain in recall.
    """

    pairs: int
    true_pairs: int
    recall_at_full_precision: Estimate
    max_f1: Estimate
    average_precision: Estimate


def precision_recall(
    scores: ArrayLike,
    is_true: ArrayLike,
    thresholds: Sequence[float] | None = None,
    is_right: ArrayLike | None = None,
) -> list[OperatingPoint]:
    """Count the pairs with a score at or above each threshold.

    Parameters
    ----------
    scores, is_true : array_like, (P,)
        Score of each pair, and whether it truly shares ground. A score of minus infinity or NaN is
        below every threshold.
    thresholds : sequence of float, optional
        By default every distinct score, from high to low.
    is_right : array_like, (P,), optional
        Whether the match, if made, is right. A true pair that is matched wrongly is a false positive
        and a false negative.
    """
    ranked = _Ranked.of(scores, is_true, is_right)
    if thresholds is None:
        thresholds, counts = ranked.scores[ranked.ends].tolist(), ranked.ends + 1
    else:
        counts = np.searchsorted(-ranked.scores, -np.asarray(thresholds, dtype=float), side="right")
    found = np.concatenate([[0], np.cumsum(ranked.right)])[counts]
    positives = int(ranked.is_true.sum())
    return [
        OperatingPoint(float(threshold), int(right), int(count - right), positives - int(right))
        for threshold, count, right in zip(thresholds, counts, found, strict=True)
    ]


def measure(
    scores: ArrayLike, is_true: ArrayLike, submaps: ArrayLike, is_right: ArrayLike | None = None
) -> Metrics:
    """Three numbers that summarise the curve over every distinct score, with bootstrap intervals.

    The pairs of one submap succeed or fail together, be it their source or their target, so submaps are
    resampled, not pairs: each resample draws as many submaps as there are, with replacement, and counts a
    pair as often as the product of how often its two submaps were drawn (the vertex bootstrap of Snijders
    and Borgatti, Connections 22(2), 1999). Resamples without a true pair are skipped. Seeded: the same
    pairs give the same interval.

    Parameters
    ----------
    scores, is_true, is_right : array_like, (P,)
        As of `precision_recall`.
    submaps : array_like, (P, 2)
        Name or number of the two submaps of each pair.
    """
    ranked = _Ranked.of(scores, is_true, is_right)
    names, ends = np.unique(np.asarray(submaps).reshape(-1, 2), return_inverse=True)
    ends = ends.reshape(-1, 2)
    value = ranked.numbers(np.ones(len(ends)))
    rng = np.random.default_rng(0)
    drawn = np.full((RESAMPLES, 3), np.nan)
    if ranked.is_true.any():
        for numbers in drawn:
            times = np.bincount(rng.integers(len(names), size=len(names)), minlength=len(names))
            numbers[:] = ranked.numbers(times[ends].prod(axis=1).astype(float))
    drawn = drawn[~np.isnan(drawn[:, 0])]
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(drawn, [tail, 100 - tail], axis=0) if len(drawn) else np.full((2, 3), np.nan)
    estimates = [Estimate(*map(float, three)) for three in zip(value, low, high, strict=True)]
    return Metrics(len(ends), int(ranked.is_true.sum()), *estimates)


def recall_at_full_precision(positive: ArrayLike, negative: ArrayLike) -> float:
    """Share of the positive scores above every negative one, NaN if there is no positive."""
    scores: NDArray[np.float64] = np.asarray(positive, dtype=float)
    if not scores.size:
        return float("nan")
    return float((scores > np.max(np.asarray(negative, dtype=float), initial=-np.inf)).mean())


@dataclass(frozen=True, eq=False)
class _Ranked:
    """Pairs by decreasing score, without those that no threshold matches.

    `order` are their indices among all pairs, `ends` the last of each run of equal scores (which are one
    threshold); `scores` and `right` are in that order, `is_true` in that of all pairs.
    """

    order: NDArray[np.intp]
    ends: NDArray[np.intp]
    scores: Array
    right: NDArray[np.bool_]
    is_true: NDArray[np.bool_]

    @classmethod
    def of(cls, scores: ArrayLike, is_true: ArrayLike, is_right: ArrayLike | None) -> "_Ranked":
        values, true = np.asarray(scores, dtype=float), np.asarray(is_true, dtype=bool)
        right = true if is_right is None else true & np.asarray(is_right, dtype=bool)
        order = np.argsort(-values, kind="stable")
        order = order[values[order] > -np.inf]  # False for NaN too
        falling = values[order]
        ends = np.flatnonzero(np.append(falling[1:] != falling[:-1], True)[: len(falling)])
        return cls(order, ends, falling, right[order], true)

    def numbers(self, weight: Array) -> Array:
        """Recall at full precision, largest F1, average precision; pairs counted by their weight."""
        positives = weight[self.is_true].sum()
        if not positives:
            return np.full(3, np.nan)
        counted = weight[self.order]
        matched, found = np.cumsum(counted)[self.ends], np.cumsum(counted * self.right)[self.ends]
        recall = found / positives
        precision = np.divide(found, matched, out=np.zeros_like(found), where=matched > 0)
        full = recall[found == matched].max(initial=0.0)
        f1 = (2 * found / (matched + positives)).max(initial=0.0)
        return np.array([full, f1, (np.diff(recall, prepend=0.0) * precision).sum()])
