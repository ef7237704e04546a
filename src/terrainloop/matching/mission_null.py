"""The null of a mission, measured on mirror images of its own submaps.

The mirror image of a submap has the statistics, footprint, sampling and features of the submap, and shows no
place of the mission. What mirror images achieve against the stored submaps is what chance achieves on this
ground with this sensor: where few things are on smooth ground, or where things repeat, far more than the law
of one pair says.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainloop.config import Calibration, Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import Array
from terrainloop.loop import NO_EVIDENCE, LoopCandidate
from terrainloop.matching.decision import reason_in_words

LN_10 = float(np.log(10.0))


def mirrored(entry: MapEntry, settings: Settings) -> MapEntry:
    """The submap as seen in a mirror along y: x, and the gradient along it, change their sign."""

    def flip(image: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(image[:, ::-1])

    g = entry.gradient_map
    names = ("elevation", "gradient_y", "variance", "gradient_variance", "mask")
    images: dict[str, Any] = {name: flip(getattr(g, name)) for name in names}
    right = g.origin[0] + (g.mask.shape[1] - 1) * g.resolution
    image = replace(
        g,
        **images,
        gradient_x=-flip(g.gradient_x),
        origin=(-right, g.origin[1]),
    )
    return MapEntry.of(entry.record, image, settings)


@dataclass(frozen=True)
class MissionNull:
    """How often chance reaches a score on this mission: an exponential tail.

    Attributes
    ----------
    threshold : float
        Score above which the tail is fitted.
    share : float
        Share of the pairs of unrelated submaps that exceed it.
    scale : float
        Mean excess over it, in decades; 0.43, that of the law of one pair, at least. What exceeds the law
        counts `null_margin` times, for what recurs on the ground unmirrored.
    """

    threshold: float
    share: float
    scale: float

    @classmethod
    def of(cls, scores: Iterable[float], calibration: Calibration) -> "MissionNull":
        """The null from scores of mirror images.

        A few scores that the law of one pair predicts (a Gumbel distribution) are added, so that it is the
        null of a mission of which nothing is known yet.
        """
        count, share = calibration.null_prior, calibration.null_share
        levels = (np.arange(count) + 0.5) / count
        predicted = -np.log(-np.log(levels)) / LN_10
        _, _, usual = _tail(predicted, share)
        threshold, share, scale = _tail(np.concatenate([predicted, np.fromiter(scores, dtype=float)]), share)
        scale += (calibration.null_margin - 1.0) * max(scale - usual, 0.0)
        return cls(threshold, share, max(scale, 1.0 / LN_10))

    def __str__(self) -> str:
        in_thousand = self.threshold + self.scale * np.log(1e3 * self.share)
        return f"by chance, one pair in a thousand has a score above {in_thousand:.1f}"

    def log_nfa(self, score: float) -> float:
        """Decimal logarithm of the number of false alarms in one pair, at a score by the law of one pair."""
        return float(np.log10(self.share) - (score - self.threshold) / (self.scale * LN_10))


def _tail(scores: Array, share: float) -> tuple[float, float, float]:
    """Threshold of about the largest share of scores, their share, and their mean excess over it."""
    ordered = np.sort(scores)[::-1]
    above = max(2, round(share * len(ordered)))
    threshold = float(ordered[above - 1])
    return threshold, above / len(ordered), float((ordered[:above] - threshold).sum() / (above - 1))


def by_mission_null(
    candidate: LoopCandidate, null: MissionNull, settings: Settings, pairs: float
) -> LoopCandidate:
    """A candidate decided by the null of its mission, where that is the stricter one."""
    if np.isnan(candidate.log_nfa):
        return candidate
    log_nfa = max(candidate.log_nfa, null.log_nfa(-candidate.log_nfa))
    allowed = settings.match.max_false_loops
    explained = candidate.accepted and log_nfa + np.log10(pairs) > np.log10(allowed)
    objection, found, rest = candidate.reason.partition(": ")
    if not found:
        objection, rest = "", candidate.reason
    if explained:
        objection = "chance explains it, as mirror images show"
    fit = rest.partition(" allowed; ")[2]
    reason = reason_in_words(objection, log_nfa + np.log10(pairs), allowed, fit)
    score = candidate.score if candidate.score == NO_EVIDENCE else -log_nfa
    decided = replace(candidate, log_nfa=log_nfa, score=score, reason=reason)
    return decided.rejected(reason) if explained else decided


def without_loops(
    scores: Array, candidates: Sequence[LoopCandidate], settings: Settings, pairs: float
) -> list[float]:
    """Scores of mirror images without those of pairs that are loop closures even by the null they give.

    Parameters
    ----------
    scores : array, (N,)
        Of the mirror images, by the law of one pair; NaN where there is none.
    candidates : sequence of LoopCandidate
        The same N pairs, not mirrored, decided by the law of one pair.
    settings : Settings
    pairs : float
        Number of pairs that `max_false_loops` is shared among.
    """
    kept = ~np.isnan(scores)
    while True:
        null = MissionNull.of(scores[kept], settings.calibration)
        decided = (by_mission_null(candidate, null, settings, pairs) for candidate in candidates)
        loops = np.fromiter(map(bool, decided), dtype=bool)
        if not (kept & loops).any():
            return [float(score) for score in scores[kept]]
        kept &= ~loops
