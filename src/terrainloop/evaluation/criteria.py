"""Criteria of correctness: by which of them a match counts as right, wrong or not at all."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.evaluation.pairs import EvaluatedPair, ScoredPair
from terrainloop.evaluation.precision_recall import Metrics, OperatingPoint, measure, precision_recall
from terrainloop.geometry import Array


@dataclass(frozen=True, eq=False)
class Criterion:
    """Evaluated pairs as one criterion of correctness counts them.

    Attributes
    ----------
    scores : array, (P,)
    is_true : array, (P,) bool
        Whether the two share enough ground: the pairs that recall refers to.
    is_right : array, (P,) bool
        Whether the match of a true pair is right; matches of other pairs are all false.
    submaps : array, (P, 2) of str
        Source and target.
    """

    scores: Array
    is_true: NDArray[np.bool_]
    is_right: NDArray[np.bool_]
    submaps: NDArray[np.str_]

    def curve(self) -> list[OperatingPoint]:
        """Precision and recall at every distinct score, from high to low."""
        return precision_recall(self.scores, self.is_true, is_right=self.is_right)

    def metrics(self) -> Metrics:
        """Three numbers that summarise the curve, with intervals."""
        return measure(self.scores, self.is_true, self.submaps, self.is_right)


def criteria(
    pairs: Sequence[EvaluatedPair[ScoredPair]],
    min_overlap: float,
    observed: bool = False,
    scores: ArrayLike | None = None,
) -> dict[str, Criterion]:
    """The three criteria by which a match counts as right.

    In all of them a pair is true if it shares more than `min_overlap`. A match is right

    - by "overlap", if its pair is true: the criterion of the paper;
    - by "overlap and pose", if its pair is true and its pose right: the strictest;
    - by "pose", if its pose is right. Pairs that share less but have the right pose are ignored, neither
      found nor false: they close a loop where there is one.

    Parameters
    ----------
    pairs : sequence of EvaluatedPair
    min_overlap : float
        Intersection over union.
    observed : bool
        Use the overlap of the observed ground instead of that of the bounding boxes.
    scores : array_like, (P,), optional
        Replace the pairs' own scores.
    """
    overlap = np.array([pair.observed_overlap if observed else pair.overlap for pair in pairs])
    is_true = overlap > min_overlap
    pose = np.array([pair.pose_is_right for pair in pairs], dtype=bool)
    own = [pair.candidate.score for pair in pairs] if scores is None else scores
    values = np.asarray(own, dtype=float)
    submaps = np.array([(pair.candidate.source, pair.candidate.target) for pair in pairs], dtype=str)
    submaps = submaps.reshape(-1, 2)
    counted = is_true | ~pose
    return {
        "overlap": Criterion(values, is_true, is_true, submaps),
        "overlap and pose": Criterion(values, is_true, pose, submaps),
        "pose": Criterion(values[counted], is_true[counted], pose[counted], submaps[counted]),
    }
