"""The default decision: a loop closure if chance cannot explain the best hypothesis and nothing rivals it."""

from dataclasses import dataclass

import numpy as np

from terrainloop.config import Calibration, Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import Array, inverse, rotation_about, transform, yaw_of
from terrainloop.loop import NO_EVIDENCE, LoopCandidate
from terrainloop.matching.hypotheses import Hypothesis, Pair, propose_hypotheses
from terrainloop.matching.lift import PlanarPrecision, lift_to_se3, pose_in_se3
from terrainloop.matching.mission_warp import warp_variance
from terrainloop.matching.overlay import Overlay
from terrainloop.matching.query import Query
from terrainloop.matching.refine import Refinement, refine
from terrainloop.matching.significance import log_num_tests
from terrainloop.matching.ssd import compute_ssd
from terrainloop.matching.window import Window

REJECTED_STEP = 3  # every third row and column is enough to describe a rejected pair
TURNS = 7  # by equal parts of a full turn: only round ground looks the same after each of them
LN_10 = float(np.log(10.0))


@dataclass(frozen=True, eq=False)
class Weighed:
    """The best hypothesis of a pair, its rivals, and the evidence that a loop closure needs.

    Attributes
    ----------
    best : Hypothesis
        The one with the highest surprisal, among those whose correlation is high enough if there are any.
    rivals : list of Hypothesis
        All hypotheses whose correlation is high enough.
    log_tests : float
        Natural logarithm of the number of tests in this pair.
    needed : float
        Surprisal at which the expected number of false loops per run equals the allowed number, nats.
    """

    best: Hypothesis
    rivals: list[Hypothesis]
    log_tests: float
    needed: float

    @classmethod
    def of(cls, pair: Pair, hypotheses: list[Hypothesis], pairs: float) -> "Weighed":
        """Weigh the hypotheses of a pair, one of `pairs` in the run."""
        calibration = pair.settings.calibration
        rivals = [h for h in hypotheses if h.agreement.correlation >= calibration.min_correlation]
        log_tests = log_num_tests(pair.found.tried, pair.found.surprisals[1:], calibration)
        needed = log_tests + float(np.log(pairs) - np.log(pair.settings.match.max_false_loops))
        return cls(max(rivals or hypotheses, key=lambda h: h.surprisal), rivals, log_tests, needed)

    @property
    def log_nfa(self) -> float:
        """Decimal logarithm of the number of false alarms of the best hypothesis in one pair."""
        return (self.log_tests - self.best.surprisal) / LN_10

    def rivalling(self, calibration: Calibration) -> float:
        """Surprisal of the field above which another pose explains the pair as well, nats.

        It must be a large share of the best's, and either unlikely by chance or nearly all of it. Keypoints
        are no help: where the field is the same after a turn, theirs is too.
        """
        by_chance = self.log_tests - float(np.log(calibration.ambiguity_chance))
        near = calibration.equivalence_ratio * self.best.of_field
        return max(calibration.ambiguity_ratio * self.best.of_field, min(by_chance, near))

    @property
    def significant(self) -> bool:
        """Whether no more than the allowed number of false loops is expected at this surprisal."""
        return self.best.surprisal >= self.needed


def compare_by_evidence(
    query: Query, target: MapEntry, pairs: float, settings: Settings, window: Window | None = None
) -> LoopCandidate:
    """Search, propose, refine; take the hypothesis with the highest surprisal, and decide.

    Parameters
    ----------
    query : Query
        Made for the search grid of the two submaps.
    target : MapEntry
    pairs : float
        Number of pairs that `max_false_loops` is shared among.
    settings : Settings
    window : Window, optional
        Where the two must lie, if they share ground.
    """
    pair = Pair.of(query, target, settings)
    if window is not None:
        pair = pair.within(window)
    names = query.entry.name, target.name
    if pair.found.tried == 0:
        area = settings.calibration.min_shared_area * pair.length_scale**2
        least = f"{area:.3g} m^2 at a length scale of {pair.length_scale:.2g} m"
        return LoopCandidate.without_transform(*names, f"too little ground: an overlap of {least} is needed")
    first = settings.calibration.dense_hypotheses
    hypotheses = propose_hypotheses(pair, slice(first))
    if not hypotheses:
        reason = "featureless: the ground has no structure that could agree"
        return LoopCandidate.without_transform(*names, reason)
    weighed = Weighed.of(pair, hypotheses, pairs)
    refinement = None
    if weighed.significant:  # any other place may be a rival
        weighed = Weighed.of(pair, hypotheses + propose_hypotheses(pair, slice(first, None)), pairs)
        refinement = refine(*pair.maps, weighed.best.T_target_source, settings.calibration)
    objection = _objection(pair, weighed, refinement)
    return _candidate(pair, weighed, None if objection else refinement, objection)


def _objection(pair: Pair, weighed: Weighed, refinement: Refinement | None) -> str:
    """Why the best hypothesis is not a loop closure, in words; empty if it is."""
    calibration, best = pair.settings.calibration, weighed.best
    if not weighed.significant:
        return "chance explains it"
    if not weighed.rivals:
        return f"weak agreement, correlation below {calibration.min_correlation:g}"
    participation = pair.participation(best.T_target_source)
    if participation < calibration.min_participation:
        return f"uneven agreement, it rests on {participation:.0%} of the shared ground"
    T, rivalling = best.T_target_source, weighed.rivalling(calibration)
    equal = [
        h for h in weighed.rivals if h.of_field > rivalling and not _leads_to(pair, h.T_target_source, T)
    ]
    if equal:
        return _ambiguity(pair, best, equal)
    if refinement is None or not pair.same_place(refinement.T_target_source, T):
        return "undetermined, the refinement converges elsewhere"
    if np.isnan(refinement.covariance).any():
        return "undetermined, too little ground to determine the pose"
    slid = refinement.weakest(calibration.min_separation * pair.source_field.length_scale)
    if any(pair.weigh(T).of_field > rivalling for T in slid):
        return "undetermined, the match slides"
    return ""


def _leads_to(pair: Pair, rival: Array, T: Array) -> bool:
    """Whether a rival is the place of T, or on the flank of its peak: a thorough refinement arrives there."""
    if pair.same_place(rival, T):
        return True
    refinement = refine(*pair.maps, rival, pair.settings.calibration)
    return refinement is not None and pair.same_place(refinement.T_target_source, T)


def _ambiguity(pair: Pair, best: Hypothesis, rivals: list[Hypothesis]) -> str:
    """Which poses explain a pair as well as the best, in words."""
    T, round_ground = best.T_target_source, pair.settings.calibration.ambiguity_ratio * best.of_field
    motion = max((h.T_target_source @ inverse(T) for h in rivals), key=lambda motion: abs(yaw_of(motion)))
    centre = np.linalg.lstsq(np.eye(2) - motion[:2, :2], motion[:2, 2], rcond=None)[0]
    angles = 2 * np.pi * np.arange(1, TURNS) / TURNS
    turned = [pair.weigh(rotation_about(centre, angle) @ T).of_field for angle in angles]
    if np.median(turned) > round_ground:
        return f"undetermined in yaw, the ground is round about x {centre[0]:.2f} m, y {centre[1]:.2f} m"
    rival = max(rivals, key=lambda h: h.of_field).T_target_source
    x, y, yaw = *rival[:2, 2], np.degrees(yaw_of(rival))
    return f"ambiguous, the pose x {x:.2f} m, y {y:.2f} m, yaw {yaw:.0f} deg fits as well"


def _candidate(pair: Pair, weighed: Weighed, refinement: Refinement | None, objection: str) -> LoopCandidate:
    """The decision and the pose in SE(3); without a covariance where the pair is not a loop closure."""
    best, calibration = weighed.best, pair.settings.calibration
    warp, covariance = None, np.full((6, 6), np.nan)
    if refinement is None:
        T = best.T_target_source
        overlay = Overlay(*pair.maps, T, REJECTED_STEP)
        T_target_source = pose_in_se3(overlay, transform(T, pair.source_field.centre), calibration)
    else:
        T = refinement.T_target_source
        overlay = Overlay(*pair.maps, T)
        precision = PlanarPrecision(refinement.pivot, refinement.covariance)
        T_target_source, warp = lift_to_se3(overlay, precision, calibration)
        covariance = warp.covariance(warp_variance([warp], calibration))
    ssd, inliers = compute_ssd(overlay), len(pair.inliers_of(T))
    return LoopCandidate(
        source=pair.source.name,
        target=pair.target.name,
        T_target_source=T_target_source,
        covariance=covariance,
        inliers=inliers,
        ssd=ssd.value,
        ssd_ratio=ssd.ratio,
        overlap=ssd.overlap,
        score=-weighed.log_nfa if weighed.rivals else NO_EVIDENCE,
        accepted=refinement is not None,
        reason=_reason(weighed, objection, pair.settings.match.max_false_loops),
        found_by="dense",
        correlation=best.agreement.correlation,
        log_nfa=weighed.log_nfa,
        inlier_score=inliers * max(0.0, 1.0 - ssd.ratio),
        source_origin=pair.source.gradient_map.local_origin,
        target_origin=pair.target.gradient_map.local_origin,
        warp=warp,
    )


def _reason(weighed: Weighed, objection: str, allowed: float) -> str:
    exponent = (weighed.needed - weighed.best.surprisal) / LN_10 + float(np.log10(allowed))
    agreement = weighed.best.agreement
    fit = f"correlation {agreement.correlation:.2f} over {agreement.area:.3g} m^2"
    return reason_in_words(objection, exponent, allowed, fit)


def reason_in_words(objection: str, log_expected: float, allowed: float, fit: str) -> str:
    """Why a pair is a loop or not: the objection, the false loops expected (decimal logarithm), the fit."""
    reason = f"{_in_words(log_expected)} false loops expected, {allowed:g} allowed; {fit}"
    return f"{objection}: {reason}" if objection else reason


def _in_words(exponent: float) -> str:
    """Ten to a power as text; below 1e-12 the value is of no interest."""
    if exponent < -12:
        return "below 1e-12"
    return f"{10**exponent:.2g}" if -3 < exponent < 6 else f"1e{exponent:.0f}"
