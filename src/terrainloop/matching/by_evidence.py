"""The default decision: poses from the dense search and from keypoints, one evidence for both."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Literal

import numpy as np

from terrainloop.config import Settings
from terrainloop.geometry import Array, fit_se2, transform, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import LoopCandidate
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.evidence import (
    NO_EVIDENCE,
    log_poses,
    surprise_of_both,
    surprise_of_field,
    surprise_of_inliers,
)
from terrainloop.matching.field import Agreement, agreement_at
from terrainloop.matching.lift import lift_to_se3
from terrainloop.matching.mapped import MappedSubmap
from terrainloop.matching.ransac import draws_of, get_inliers, inlier_radius_of, propose
from terrainloop.matching.refine import Refinement, refine
from terrainloop.matching.search import APART, MIN_AREA, Search, same_place, search
from terrainloop.matching.ssd import compute_ssd

PLACES = 11  # of the dense search: the best, and ten that tell how rare such a place is
DENSE, SPARSE = 2, 1  # hypotheses of either kind that are refined
LOOKED_AT = 6  # inlier sets, of which the best are refined
RIVAL = 0.5  # share of the best place's surprise at which another place casts doubt on it,
RIVAL_BY_CHANCE = 0.01  # unless as good a one turns up by chance in more pairs than that
MIN_CORRELATION = 0.25  # large maps whose sensors leave like traces agree a little everywhere
REJECTED_STEP = 3  # every third row and column is enough to show a rejected pair
UNKNOWN = np.full((3, 3), np.nan)

FoundBy = Literal["dense", "sparse"]

refine_roughly = partial(refine, places=2000, steps=3, tolerance=0.02)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose, how the fields agree there, and its surprise: how many nats chance would have to give."""

    T_target_source: Array
    agreement: Agreement
    surprise: float
    found_by: FoundBy


@dataclass(frozen=True, eq=False)
class _Pair:
    """What the evidence for a pose of two submaps is drawn from."""

    source: MappedSubmap
    target: MappedSubmap
    found: Search
    associations: Associations
    inlier_radius: float

    def judge(self, T: Array, found_by: FoundBy) -> Hypothesis:
        """The evidence for a pose; none where it shares too little ground or the fields disagree."""
        source, target = self.source.search_map, self.target.search_map
        spacing = max(source.spacing, target.spacing)
        agreement = agreement_at(source.field(spacing), target.field(spacing), T)
        null_area = self.found.null_area_at(yaw_of(T))
        enough = agreement.area >= MIN_AREA * max(source.length_scale, target.length_scale) ** 2
        if not enough or agreement.correlation <= 0 or np.isnan(null_area):
            return Hypothesis(T, agreement, 0.0, found_by)
        by_field = surprise_of_field(agreement.correlation, agreement.area / null_area)
        return Hypothesis(T, agreement, surprise_of_both(by_field, self._by_inliers(T, found_by)), found_by)

    def _by_inliers(self, T: Array, found_by: FoundBy) -> float:
        """Surprise of the keypoints that agree with a pose; two of them made it, if they proposed it."""
        inliers = self.associations.target[get_inliers(self.associations, T[None], self.inlier_radius)[0]]
        spots = len(np.unique(np.floor(inliers / self.target.search_map.length_scale), axis=0))
        ground = self.target.gradient_map.mask.sum() * self.target.gradient_map.resolution**2
        chance = min(np.pi * self.inlier_radius**2 / ground, 1.0)
        return surprise_of_inliers(spots - 2 * (found_by == "sparse"), len(self.associations), chance)

    def refined(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis where the gradients agree best, if that is more surprising."""
        settled = refine_roughly(*self.maps, hypothesis.T_target_source)
        if settled is None:
            return hypothesis
        better = self.judge(settled.T_target_source, hypothesis.found_by)
        return better if better.surprise > hypothesis.surprise else hypothesis

    @property
    def log_poses(self) -> float:
        return log_poses(self.found.tried, self.found.surprises[1:])

    @property
    def maps(self) -> tuple[GradientMap, GradientMap]:
        return self.source.gradient_map, self.target.gradient_map

    def same_place(self, T: Array, other: Array) -> bool:
        return same_place(T, other, self.source.search_map)


def compare_by_evidence(
    source: MappedSubmap, target: MappedSubmap, settings: Settings, pairs: float
) -> LoopCandidate:
    """Search, propose, refine; take the pose that is hardest to explain by chance, and decide.

    What it takes is what `terrainloop.matching.register.compare` does.
    """
    found = search(source.search_map, target.search_map, PLACES)
    if found.tried == 0:
        length_scale = max(source.search_map.length_scale, target.search_map.length_scale)
        least = f"{MIN_AREA * length_scale**2:.3g} m^2 at a length scale of {length_scale:.2g} m"
        return _incomparable(source, target, f"too little ground: they would have to share {least}")
    radius = inlier_radius_of(settings, target.gradient_map)
    pair = _Pair(source, target, found, associate(source.features, target.features), radius)
    hypotheses = _hypotheses(pair, settings)
    if not hypotheses:
        return _incomparable(source, target, "featureless: the ground shows nothing that could agree")

    allowed = settings.match.max_false_loops
    needed = pair.log_poses + np.log(pairs / allowed)
    hypotheses = [
        h if h.agreement.correlation >= MIN_CORRELATION else replace(h, surprise=0.0)
        for h in map(pair.refined, hypotheses)
    ]
    best = max(hypotheses, key=_surprise)
    settled = refine(*pair.maps, best.T_target_source) if best.surprise >= needed else None
    objection = _objection(pair, best, hypotheses, settled, needed)
    fit = f"correlation {best.agreement.correlation:.2f} over {best.agreement.area:.3g} m^2"
    expected = _number(needed - best.surprise + np.log(allowed))
    reason = f"{expected} false loops expected, {allowed:g} allowed; {fit}"
    return _candidate(
        pair,
        best,
        settled=None if objection else settled,
        score=(best.surprise - pair.log_poses) / np.log(10.0),
        reason=f"{objection}: {reason}" if objection else reason,
    )


def _hypotheses(pair: _Pair, settings: Settings) -> list[Hypothesis]:
    """The best places of the dense search, and the best of the keypoints that are not among them."""
    hypotheses = [pair.judge(T, "dense") for T in pair.found.places[:DENSE]]
    sparse = sorted((pair.judge(T, "sparse") for T in _sparse_poses(pair, settings)), key=_surprise)
    for proposed in sparse[-SPARSE:]:
        if not any(pair.same_place(proposed.T_target_source, h.T_target_source) for h in hypotheses):
            hypotheses.append(proposed)
    return hypotheses


def _sparse_poses(pair: _Pair, settings: Settings) -> Iterator[Array]:
    """The poses that most keypoints agree with."""
    associations = pair.associations
    proposed = propose(
        associations,
        iterations=settings.match.iterations,
        inlier_radius=pair.inlier_radius,
        rng=draws_of(settings, pair.source.name, pair.target.name),
    )
    for inliers in islice(proposed, LOOKED_AT):
        yield fit_se2(associations.source[inliers], associations.target[inliers])


def _objection(
    pair: _Pair, best: Hypothesis, hypotheses: list[Hypothesis], settled: Refinement | None, needed: float
) -> str:
    """Why the best pose is no loop, in words; nothing if it is one."""
    if best.surprise < needed:
        return "chance explains it"
    T = best.T_target_source
    doubtful = max(RIVAL * best.surprise, pair.log_poses - np.log(RIVAL_BY_CHANCE))
    if any(h.surprise > doubtful and not pair.same_place(h.T_target_source, T) for h in hypotheses):
        return "ambiguous, another place fits as well"
    if settled is None or not pair.same_place(settled.T_target_source, T):
        return "undetermined, the gradients settle elsewhere"
    if np.isnan(settled.covariance).any():
        return "undetermined, too little ground to tell the pose"
    slid = settled.weakest(APART * pair.source.search_map.length_scale)
    if any(pair.judge(T, best.found_by).surprise > doubtful for T in slid):
        return "undetermined, the match slides"
    return ""


def _candidate(
    pair: _Pair, best: Hypothesis, *, settled: Refinement | None, score: float, reason: str
) -> LoopCandidate:
    """The pose in SE(3); only roughly, and without covariance, where it was not settled as a loop."""
    if settled is None:
        T, step = best.T_target_source, REJECTED_STEP
        middle = transform(T, pair.source.search_map.middle)
        lifted = lift_to_se3(*pair.maps, T, middle, UNKNOWN, step=step)
    else:
        T, step = settled.T_target_source, 1
        lifted = lift_to_se3(
            *pair.maps, T, settled.pivot, settled.covariance, strain_variance=settled.strain_variance
        )
    ssd = compute_ssd(*pair.maps, T, step)
    return LoopCandidate(
        source=pair.source.name,
        target=pair.target.name,
        T_target_source=lifted[0],
        covariance=lifted[1],
        inliers=int(get_inliers(pair.associations, T[None], pair.inlier_radius).sum()),
        ssd=ssd.value,
        ssd_ratio=ssd.ratio,
        overlap=ssd.overlap,
        score=float(score),
        accepted=settled is not None,
        reason=reason,
        found_by=best.found_by,
        correlation=best.agreement.correlation,
    )


def _incomparable(source: MappedSubmap, target: MappedSubmap, reason: str) -> LoopCandidate:
    return LoopCandidate.without_transform(source.name, target.name, reason, score=NO_EVIDENCE)


def _surprise(hypothesis: Hypothesis) -> float:
    return hypothesis.surprise


def _number(logarithm: float) -> str:
    exponent = logarithm / np.log(10.0)
    return f"{10**exponent:.2g}" if -3 < exponent < 6 else f"1e{exponent:.0f}"
