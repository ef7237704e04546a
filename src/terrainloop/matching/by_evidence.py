"""The default decision: poses from the dense search and from keypoints, one evidence for both."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Literal

import numpy as np

from terrainloop.config import Settings
from terrainloop.geometry import Array, fit_se2, transform, yaw_of
from terrainloop.loop import LoopCandidate
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.evidence import NO_EVIDENCE, log10_false_alarms, surprise, surprise_needed
from terrainloop.matching.field import Agreement, agreement_at
from terrainloop.matching.lift import lift_to_se3
from terrainloop.matching.mapped import MappedSubmap
from terrainloop.matching.ransac import draws_of, get_inliers, inlier_radius_of, propose
from terrainloop.matching.refine import Refinement, refine
from terrainloop.matching.search import APART, MIN_AREA, Search, SearchMap, same_place, search
from terrainloop.matching.ssd import compute_ssd

DENSE, SPARSE = 2, 1  # hypotheses of either kind that are refined
REJECTED_STEP = 3  # every third row and column is enough to show a rejected pair
UNKNOWN = np.full((3, 3), np.nan)
LOOKED_AT = 6  # inlier sets, of which the best are refined
GAIN = 3.0  # by which refining raises the surprise of a hypothesis, at most
RIVAL = 0.5  # share of the best place's surprise at which another place casts doubt on it
MIN_CORRELATION = 0.25  # large maps whose sensors leave like traces agree a little everywhere
ROUGHLY = {"places": 2000, "tolerance": 0.02}  # is how hypotheses are refined, before one is accepted


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose, how the fields agree there, and the evidence in nats that this is no chance."""

    T_target_source: Array
    agreement: Agreement
    surprise: float
    found_by: Literal["dense", "sparse"]


def compare_by_evidence(
    source: MappedSubmap, target: MappedSubmap, settings: Settings, pairs: float
) -> LoopCandidate:
    """Search, propose, refine; take the pose that is hardest to explain by chance, and decide.

    Parameters
    ----------
    source, target : MappedSubmap
    settings : Settings
    pairs : float
        Compared in the mission.
    """
    found = search(source.search_map, target.search_map, DENSE)
    associations = associate(source.features, target.features)
    judge = partial(_judge, source.search_map, target.search_map, found)
    hypotheses = [judge(T, "dense") for T in found.places]
    sparse = [judge(T, "sparse") for T in _sparse_poses(source, target, associations, settings)]
    for hypothesis in sorted(sparse, key=_surprise)[-SPARSE:]:
        if not _at_same_place(hypothesis, hypotheses, source):
            hypotheses.append(hypothesis)
    if found.tried == 0 or not hypotheses:
        reason = "too little ground: the maps cannot share enough to be compared"
        if found.tried > 0:
            reason = "featureless: the ground shows nothing that could agree"
        return LoopCandidate.without_transform(source.name, target.name, reason, score=NO_EVIDENCE)

    maps = source.gradient_map, target.gradient_map
    allowed = settings.match.max_false_loops
    needed = surprise_needed(allowed / pairs, found.tried)
    for index, hypothesis in enumerate(hypotheses):
        if hypothesis.surprise * GAIN > needed:
            settled = refine(*maps, hypothesis.T_target_source, **ROUGHLY)
            if settled is not None:
                better = judge(settled.T_target_source, hypothesis.found_by)
                hypotheses[index] = max(hypothesis, better, key=_surprise)
        if hypotheses[index].agreement.correlation < MIN_CORRELATION:
            hypotheses[index] = replace(hypotheses[index], surprise=0.0)
    best = max(hypotheses, key=_surprise)
    rival = max((h.surprise for h in hypotheses if not _at_same_place(h, [best], source)), default=0.0)
    false_alarms = log10_false_alarms(best.surprise, found.tried)
    settled = refine(*maps, best.T_target_source) if best.surprise >= needed else None
    objection = _objection(best, rival, settled, judge, needed, source)
    fit = f"correlation {best.agreement.correlation:.2f} over {best.agreement.area:.3g} m^2"
    expected = f"{_number(false_alarms + np.log10(pairs))} false loops expected, {allowed:g} allowed; {fit}"
    return _candidate(
        source,
        target,
        best,
        associations,
        settings,
        settled=None if objection else settled,
        score=-false_alarms,
        reason=f"{objection}: {expected}" if objection else expected,
    )


def _objection(
    best: Hypothesis,
    rival: float,
    settled: Refinement | None,
    judge: Callable[[Array, Literal["dense", "sparse"]], Hypothesis],
    needed: float,
    source: MappedSubmap,
) -> str:
    """Why a pose is no loop, in words; nothing if it is one."""
    if best.surprise < needed:
        return "chance explains it"
    if rival > RIVAL * best.surprise:
        return "ambiguous, another place fits as well"
    if settled is None or not same_place(settled.T_target_source, best.T_target_source, source.search_map):
        return "undetermined, the gradients settle elsewhere"
    if np.isnan(settled.covariance).any():
        return "undetermined, too little ground to tell the pose"
    slid = settled.weakest(APART * source.search_map.length_scale)
    if max(judge(T, best.found_by).surprise for T in slid) > RIVAL * best.surprise:
        return "undetermined, the match slides"
    return ""


def _judge(
    source: SearchMap, target: SearchMap, found: Search, T: Array, found_by: Literal["dense", "sparse"]
) -> Hypothesis:
    """The evidence for a pose, none where it shares too little ground or the fields disagree."""
    spacing = max(source.spacing, target.spacing)
    agreement = agreement_at(source.field(spacing), target.field(spacing), T)
    enough = agreement.area >= MIN_AREA * max(source.length_scale, target.length_scale) ** 2
    null_area = found.null_area_at(yaw_of(T))
    if not enough or agreement.correlation <= 0 or not np.isfinite(null_area):
        return Hypothesis(T, agreement, 0.0, found_by)
    sure = surprise(agreement.correlation**2, agreement.area / null_area)
    return Hypothesis(T, agreement, float(sure), found_by)


def _sparse_poses(
    source: MappedSubmap, target: MappedSubmap, associations: Associations, settings: Settings
) -> Iterator[Array]:
    """The poses that most keypoints agree with."""
    proposed = propose(
        associations,
        iterations=settings.match.iterations,
        inlier_radius=inlier_radius_of(settings, target.gradient_map),
        rng=draws_of(settings, source.name, target.name),
    )
    for inliers in islice(proposed, LOOKED_AT):
        yield fit_se2(associations.source[inliers], associations.target[inliers])


def _surprise(hypothesis: Hypothesis) -> float:
    return hypothesis.surprise


def _at_same_place(hypothesis: Hypothesis, others: list[Hypothesis], source: MappedSubmap) -> bool:
    T = hypothesis.T_target_source
    return any(same_place(T, other.T_target_source, source.search_map) for other in others)


def _number(exponent: float) -> str:
    return f"{10**exponent:.2g}" if -3 < exponent < 6 else f"1e{exponent:.0f}"


def _candidate(
    source: MappedSubmap,
    target: MappedSubmap,
    best: Hypothesis,
    associations: Associations,
    settings: Settings,
    *,
    settled: Refinement | None,
    score: float,
    reason: str,
) -> LoopCandidate:
    """The pose in SE(3); only roughly, and without covariance, where it was not settled as a loop."""
    maps = source.gradient_map, target.gradient_map
    if settled is None:
        T, step = best.T_target_source, REJECTED_STEP
        lifted = lift_to_se3(*maps, T, transform(T, source.search_map.middle), UNKNOWN, step=step)
    else:
        T, step = settled.T_target_source, 1
        lifted = lift_to_se3(
            *maps, T, settled.pivot, settled.covariance, strain_variance=settled.strain_variance
        )
    ssd = compute_ssd(*maps, T, step)
    radius = inlier_radius_of(settings, target.gradient_map)
    return LoopCandidate(
        source=source.name,
        target=target.name,
        T_target_source=lifted[0],
        covariance=lifted[1],
        inliers=int(get_inliers(associations, T[None], radius).sum()),
        ssd=ssd.value,
        ssd_ratio=ssd.ratio,
        overlap=ssd.overlap,
        score=score,
        accepted=settled is not None,
        reason=reason,
        found_by=best.found_by,
        correlation=best.agreement.correlation,
    )
