"""The null of a mission: mirror images are submaps like others; what they achieve corrects decisions."""

from dataclasses import fields, replace

import numpy as np
import pytest
from calibration_util import calibrated
from conftest import PARAMETERS, map_of

from terrainloop.config import Calibration, Settings
from terrainloop.detection.detector import LoopDetector, map_submap, mirror_scores, sample_null
from terrainloop.entry import MapEntry
from terrainloop.geometry import se2, transform
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import NO_EVIDENCE, LoopCandidate
from terrainloop.matching.mission_null import MissionNull, by_mission_null, mirrored, without_loops
from terrainloop.record import SubmapRecord
from terrainloop.submap import Submap

LN_10 = np.log(10.0)
RECORD = SubmapRecord("submap", None, 1000, "ok")


def entry_of(ground, name, settings, T_planar=None):
    m = map_of(ground, T_planar)
    return MapEntry.of(replace(RECORD, name=name), m, settings)


def mounds(seed):
    """Three mounds in much the same triangle on smooth ground: unrelated places look alike."""
    rng = np.random.default_rng(seed)
    triangle = np.array([[-0.9, -0.5], [0.9, -0.5], [0.4, 0.9]]) + rng.normal(0, 0.12, (3, 2))
    centres = transform(se2(*rng.uniform(-0.8, 0.8, 2), rng.uniform(0, 2 * np.pi)), triangle)
    ripple = rng.uniform(0, 2 * np.pi, (12, 2))

    def ground(xy):
        offsets = xy[:, None] - centres
        bumps = 0.1 * np.exp(-0.5 * (offsets**2).sum(-1) / 0.3**2)
        slope = -(offsets / 0.3**2 * bumps[..., None]).sum(1)
        waves = np.cos(6.0 * (xy @ _directions(ripple).T) + ripple[:, 1])
        return bumps.sum(1), slope + 0.004 * waves @ _directions(ripple)

    return ground


def _directions(ripple):
    return np.c_[np.cos(ripple[:, 0]), np.sin(ripple[:, 0])]


@pytest.fixture(scope="module")
def alike():
    """Submaps of unrelated places that look alike."""
    return [entry_of(mounds(seed), f"{seed}", Settings()) for seed in range(12)]


def loops_of(entries, settings, scores):
    detector = LoopDetector(settings, expected_pairs=66, null_scores=scores)
    for entry in entries:
        detector.add_entry(entry)
    return detector.loops


def every_pair(settings):
    return settings.model_copy(update={"skip_recent": 0})


def test_the_mirror_image_is_the_map_of_mirrored_ground(world):
    def mirrored_ground(xy):
        height, slope = world(3)._height_and_slope(xy * (-1.0, 1.0))
        return height, slope * (-1.0, 1.0)

    shape, resolution, left = (60, 50), 0.08, -1.5
    right = left + (shape[1] - 1) * resolution
    entry = MapEntry.of(RECORD, map_of(world(3)._height_and_slope, origin=(left, -2.5)), Settings())
    image = mirrored(entry, Settings()).gradient_map
    expected = map_of(mirrored_ground, origin=(-right, -2.5))
    assert image.origin == pytest.approx(expected.origin)
    for name in ("elevation", "gradient_x", "gradient_y"):
        assert np.allclose(getattr(image, name), getattr(expected, name), atol=1e-6)


def test_the_mirror_image_of_the_mirror_image_is_the_submap(world, strict):
    entry = map_submap(Submap(world(4).observe(np.eye(4), (0.1, -0.2), seed=0)), strict, PARAMETERS)
    again = mirrored(mirrored(entry, strict), strict)
    assert again.record is entry.record
    for field in fields(GradientMap):
        a, b = getattr(entry.gradient_map, field.name), getattr(again.gradient_map, field.name)
        if isinstance(a, np.ndarray):
            assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        else:
            assert a == b or np.allclose(a, b)


def test_a_mirror_image_does_not_match_its_submap(world, strict):
    entry = map_submap(Submap(world(5).observe(np.eye(4), (0.1, -0.2), seed=0)), strict, PARAMETERS)
    (score,) = mirror_scores(entry, [entry], strict)
    assert score < 2.0


def test_a_mission_of_which_nothing_is_known_has_the_law_of_one_pair():
    null = MissionNull.of([], Calibration())
    for score in (2.0, 5.0, 30.0):
        assert -score <= null.log_nfa(score) < -0.88 * score  # a little on the safe side


def test_scores_as_the_law_predicts_change_nothing():
    scores = np.log10(np.random.default_rng(0).exponential(size=3000)) * -1
    null = MissionNull.of(scores, Calibration())
    assert null.log_nfa(6.0) == pytest.approx(-6.0, abs=0.6)


def test_chance_is_never_rarer_than_the_law_of_one_pair_decays():
    assert MissionNull.of(np.full(1000, 1.0), Calibration()).scale == pytest.approx(1 / LN_10)


@pytest.fixture
def candidate():
    loop = LoopCandidate.without_transform(
        "b", "a", "1e-08 false loops expected, 0.01 allowed; correlation 0.60"
    )
    covariance = np.eye(6)
    return replace(
        loop, T_target_source=np.eye(4), covariance=covariance, score=9.0, log_nfa=-9.0, accepted=True
    )


HEAVY = MissionNull(threshold=2.0, share=0.3, scale=2.0)
AS_THE_LAW = MissionNull.of([], Calibration())


def test_what_chance_explains_is_no_loop(candidate):
    decided = by_mission_null(candidate, HEAVY, Settings(), 10)
    assert not decided
    assert decided.log_nfa == pytest.approx(np.log10(0.3) - 7.0 / (2.0 * LN_10))
    assert decided.score == -decided.log_nfa
    assert np.isnan(decided.covariance).all()
    assert decided.reason.startswith("chance explains it, as mirror images show: 0.091 false loops")
    assert decided.reason.endswith("0.01 allowed; correlation 0.60")


def test_what_it_does_not_explain_stays_a_loop(candidate):
    decided = by_mission_null(candidate, AS_THE_LAW, Settings(), 10)
    assert decided
    assert -9.0 < decided.log_nfa < -8.0
    assert np.array_equal(decided.covariance, np.eye(6))


def test_it_says_what_chance_does():
    null = MissionNull(threshold=2.0, share=0.5, scale=1.5)
    (score,) = (float(word) for word in str(null).split()[-1:])
    assert null.log_nfa(score) == pytest.approx(-3.0, abs=0.02)


def test_no_null_makes_a_pair_more_significant(candidate):
    generous = MissionNull(threshold=-30.0, share=1e-3, scale=0.44)
    assert by_mission_null(candidate, generous, Settings(), 10).log_nfa == -9.0


def test_other_objections_stay(candidate):
    rejected = replace(
        candidate, accepted=False, score=NO_EVIDENCE, reason=f"weak agreement: {candidate.reason}"
    )
    decided = by_mission_null(rejected, HEAVY, Settings(), 10)
    assert decided.reason.startswith("weak agreement: 0.0")
    assert decided.score == NO_EVIDENCE
    nothing = LoopCandidate.without_transform("b", "a", "featureless")
    assert by_mission_null(nothing, HEAVY, Settings(), 10) is nothing


def false_loops(settings, alike):
    """On places that look alike, all unrelated."""
    settings = every_pair(settings)
    return len(loops_of(alike, settings, sample_null(alike, settings)))


def test_places_that_look_alike_are_no_loops(alike):
    assert len(loops_of(alike, every_pair(Settings()), [])) >= 2  # by the law of one pair
    assert false_loops(Settings(), alike) == 0


def test_nor_are_they_online(alike):
    settings = every_pair(Settings())
    detector = LoopDetector(settings)
    for entry in alike:
        detector.add_entry(entry)
    by_law = LoopDetector(settings, null_scores=[])
    for entry in alike:
        by_law.add_entry(entry)
    assert len(detector.null_scores) >= 60
    assert len(detector.loops) < len(by_law.loops)


def test_a_revisit_among_ordinary_places_is_a_loop(world):
    settings = every_pair(Settings())
    entries = [entry_of(world(seed)._height_and_slope, f"{seed}", settings) for seed in range(6)]
    turned = se2(0.4, -0.3, 0.5)
    again = entry_of(lambda xy: world(0)._height_and_slope(xy), "again", settings, turned)
    (loop,) = loops_of([*entries, again], settings, sample_null([*entries, again], settings))
    assert (loop.source, loop.target) == ("again", "0")
    assert np.allclose(transform(loop.T_target_source, np.zeros(3))[:2], (0.4, -0.3), atol=0.05)


def test_the_sample_is_spread_over_the_pairs_of_the_mission(alike):
    settings = calibrated(null_pairs=20)
    assert len(sample_null(alike, settings)) == 20
    assert len(sample_null(alike[: settings.skip_recent + 1], settings)) == 0
    assert len(sample_null([], settings)) == 0


def test_mirror_images_of_loops_are_not_in_the_null(candidate):
    """Strong loops are found by any null and leave it; then weaker ones are found."""
    rng = np.random.default_rng(4)
    ordinary = -np.log10(rng.exponential(size=100))
    own = [40.0] * 30 + [5.5] + [0.2] * 99
    candidates = [replace(candidate, log_nfa=-score, score=score, accepted=score > 5) for score in own]
    scores = np.r_[rng.uniform(1, 6, 30), ordinary]
    scores[60] = np.nan
    kept = without_loops(scores, candidates, Settings(), 130)
    assert sorted(kept) == sorted(score for score in np.delete(ordinary, [0, 30]))
    weak = candidates[30]
    assert not by_mission_null(
        weak, MissionNull.of(scores[~np.isnan(scores)], Calibration()), Settings(), 130
    )
    assert by_mission_null(weak, MissionNull.of(kept, Calibration()), Settings(), 130)


def test_where_nothing_is_a_loop_all_mirror_images_are_in_the_null(candidate):
    rejected = [replace(candidate, accepted=False)] * 3
    assert without_loops(np.array([1.0, np.nan, 7.0]), rejected, Settings(), 3) == [1.0, 7.0]
    assert without_loops(np.empty(0), [], Settings(), 0) == []


def estimates(calibration, *, count, heavy=0.25, score=6.0):
    """Error of the null at a score, from samples of chance of which a share has a heavy tail."""
    rng = np.random.default_rng(7)
    found = []
    for _ in range(300):
        law = -np.log10(rng.exponential(size=count))
        tail = rng.exponential(1.5, size=count)
        found.append(
            MissionNull.of(np.where(rng.random(count) < heavy, tail, law), calibration).log_nfa(score)
        )
    return np.array(found) - np.log10(heavy * np.exp(-score / 1.5) + (1 - heavy) * 10.0**-score)


NULL_MUTANTS = [
    ("null_pairs", 0),
    ("null_share", 0.95),
    ("null_share", 0.02),
    ("null_margin", 1.0),
    ("null_margin", 3.0),
    ("null_prior", 2),
    ("null_prior", 3000),
]


def little_bias(settings):
    return abs(estimates(settings.calibration, count=300).mean()) < 0.45


def little_scatter(settings):
    return estimates(settings.calibration, count=300).std() < 0.38


def few_scores_mislead_little(settings):
    error = estimates(settings.calibration, count=8, heavy=0.0)
    return error.mean() + 2 * error.std() < 2.1


PROMISES = (little_bias, little_scatter, few_scores_mislead_little)  # and test_places_that_look_alike...


@pytest.mark.parametrize("promise", PROMISES)
def test_the_tail_is_estimated_well(promise):
    assert promise(Settings())


@pytest.mark.parametrize(("constant", "value"), NULL_MUTANTS)
def test_a_constant_that_moves_breaks_a_promise(constant, value, alike):
    settings = calibrated(**{constant: value})
    assert not all(promise(settings) for promise in PROMISES) or false_loops(settings, alike) > 0
