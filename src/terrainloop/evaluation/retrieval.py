"""Place recognition per query: recall and precision at one, and the share of revisits that are closed."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from terrainloop.evaluation.pairs import EvaluatedPair
from terrainloop.evaluation.truth import GroundTruth
from terrainloop.loop import LoopCandidate


@dataclass(frozen=True)
class Retrieval:
    """Counts of queries and revisits; the query of a pair is the later of its two submaps.

    Attributes
    ----------
    queries : int
        Queries with at least one true pair among those compared.
    right_at_one : int
        Those of them whose best-scoring pair has the right pose.
    answered : int
        Queries with at least one accepted loop.
    answered_right : int
        Those of them whose best-scoring accepted loop has the right pose.
    revisits : int
        Submaps that truly overlap an earlier one, whether or not the pair was compared.
    closed : int
        Those of them with at least one accepted loop, as query, whose pose is right.
    """

    queries: int
    right_at_one: int
    answered: int
    answered_right: int
    revisits: int
    closed: int

    @property
    def recall_at_one(self) -> float:
        """R@1, NaN without queries."""
        return _share(self.right_at_one, self.queries)

    @property
    def precision_at_one(self) -> float:
        """P@1 of the accepted loops, NaN if no query is answered."""
        return _share(self.answered_right, self.answered)

    @property
    def closed_share(self) -> float:
        """Share of the revisits that are closed, NaN without revisits."""
        return _share(self.closed, self.revisits)


def retrieval(
    pairs: Sequence[EvaluatedPair[LoopCandidate]],
    scores: ArrayLike,
    truth: GroundTruth,
    min_overlap: float,
    observed: bool = False,
) -> Retrieval:
    """Count queries and revisits.

    Of pairs that tie for the best score of a query, all must be right. A query none of whose pairs could
    be compared (scores of minus infinity) is not right.

    Parameters
    ----------
    pairs : sequence of EvaluatedPair, (P,)
    scores : array_like, (P,)
        Minus infinity where a pair could not be compared.
    truth : GroundTruth
        That the pairs were evaluated with.
    min_overlap : float
        Intersection over union above which a pair is true.
    observed : bool
        Use the overlap of the observed ground instead of that of the bounding boxes.
    """
    by_query = defaultdict(list)
    for pair, score in zip(pairs, np.asarray(scores, dtype=float).tolist(), strict=True):
        by_query[pair.query].append((score, pair))
    best = {query: _best_is_right(scored) for query, scored in by_query.items()}
    accepted = {
        query: _best_is_right(loops)
        for query, scored in by_query.items()
        if (loops := [(score, pair) for score, pair in scored if pair.candidate])
    }
    queries = {
        pair.query for pair in pairs if (pair.observed_overlap if observed else pair.overlap) > min_overlap
    }
    revisits = set(truth.revisits(min_overlap, observed).tolist())
    closed = {pair.query for pair in pairs if pair.candidate and pair.pose_is_right}
    return Retrieval(
        queries=len(queries),
        right_at_one=sum(best[query] for query in queries),
        answered=len(accepted),
        answered_right=sum(accepted.values()),
        revisits=len(revisits),
        closed=len(revisits & closed),
    )


def _best_is_right(scored: Sequence[tuple[float, EvaluatedPair[LoopCandidate]]]) -> bool:
    best = max(score for score, _ in scored)
    return best > -np.inf and all(pair.pose_is_right for score, pair in scored if score == best)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
