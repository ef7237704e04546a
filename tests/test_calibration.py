"""The calibration under guard: what it promises is measured, and a constant that moves breaks a promise.

Bounds are for the data of tests/make_calibration_fixture.py, whose seeds no reported result uses. Those of
ratios are a factor of two or so around what is measured, those of counts a few cases: honest, but near enough
that each of the mutations below leaves them. docs/calibration.md lists every constant.
"""

from dataclasses import replace
from functools import cache, partial

import calibration_util as measure
import numpy as np
import pytest
from calibration_util import calibrated, heights_and_slopes
from conftest import World, flat, map_of, ridges
from test_mission_null import NULL_MUTANTS

from terrainloop.config import Calibration, Settings
from terrainloop.geometry import se2
from terrainloop.matching.register import register

MEASURES = {
    "unrelated": measure.of_unrelated,
    "small maps": measure.of_small_maps,
    "revisits": measure.of_revisits,
    "errors": measure.of_errors,
    "rigid": measure.of_rigid_errors,
    "warped": measure.of_warped_maps,
}
BOUNDS = {
    "false alarms at 1": (0.4, 0.8),  # a test that counted right would have 1; this one is on the safe side
    "false alarms at 0.1": (0.15, 0.6),
    "false loops": (0, 1.5),
    "largest score of unrelated ground": (1.5, 3.5),  # a run of these pairs needs 4.5
    "false alarms at 1, small maps": (0.25, 0.8),
    "false alarms at 0.1, small maps": (0.05, 0.8),
    "recall above 30 %": (0.98, 1.0),  # one of 51 may be missed
    "recall at 10-30 %": (0.49, 0.65),
    "wrong loops": (0, 0),
    "revisits called ambiguous": (0, 1),
    "mean score above 30 %": (39.3, 42.6),
    "mean score at 10-30 %": (9.9, 11.0),
    "NEES of all": (0.5, 2.0),
    "NEES of x, y": (0.5, 2.0),
    "NEES of z": (0.25, 1.1),
    "NEES of roll, pitch": (0.5, 2.0),
    "NEES of yaw": (0.5, 2.0),
    "within 95 %": (0.90, 1.0),
    "NEES of loops alone": (0.35, 1.1),
    "NEES, rigid": (0.5, 2.0),
    "within 95 %, rigid": (0.85, 1.0),
    "NEES of noise, rigid": (0.5, 2.0),
    "warp found": (0.6, 0.9),  # less than all of it, for what is usual is less
}


def outside(measured):
    return {
        name: value for name, value in measured.items() if not BOUNDS[name][0] <= value <= BOUNDS[name][1]
    }


@pytest.mark.parametrize("name", MEASURES)
def test_the_calibration_keeps_its_promises(name):
    measured = MEASURES[name](Settings())
    assert not outside(measured), measured


# --- reasons

BIG = {"origin": (-4.0, -4.0), "shape": (100, 100)}
LARGE = {"origin": (-9.0, -9.0), "shape": (113, 113), "resolution": 0.16}
TURNED = se2(0.4, -0.3, 0.7)


def both(*grounds):
    """Sum of grounds."""

    def ground(xy):
        return tuple(sum(parts) for parts in zip(*(part(xy) for part in grounds), strict=True))

    return ground


def twice(difference):
    """The ground of world 0 side by side with itself, there changed by some share of world 7."""

    def ground(xy):
        height, slope = heights_and_slopes(0)(np.c_[(xy[:, 0] + 2) % 4 - 2, xy[:, 1]])
        other, other_slope = heights_and_slopes(7, difference)(xy)
        second = xy[:, 0] > 2
        return height + second * other, slope + second[:, None] * other_slope

    return ground


def same_ground_twice(difference):
    source = World.of(0).map(origin=(-1.9, -1.9), shape=(48, 47))
    return source, map_of(twice(difference), origin=(-2.0, -2.0), shape=(50, 100))


def with_common_trace(*seeds):
    """Large maps of different ground, to which one sensor added the same faint pattern."""
    trace = heights_and_slopes(2, 0.4)
    return tuple(map_of(both(heights_and_slopes(seed), trace), **LARGE) for seed in seeds)


def crest():
    """A straight crest on maps so small that a rival is no surprise by itself."""
    options = {"origin": (-2.5, -2.5), "shape": (62, 62)}
    return map_of(ridges(4), TURNED, **options), map_of(ridges(4), **options)


def long_crests(xy):
    """Relief that is six times as long along x as across."""
    height, slope = heights_and_slopes(0)(xy * [1 / 6, 1])
    return height, slope * [1 / 6, 1]


def full_of_holes():
    """So many that no sample has observed ground all around it."""
    target = World.of(0).map(**BIG)
    mask = target.mask.copy()
    mask[::6, ::6] = False
    return World.of(0).map(TURNED, **BIG), replace(target, mask=mask)


def same_corner(side, seed=0):
    return (World.of(seed).map(origin=(-1.0, -1.0), shape=(side, side)),) * 2


def turned(ground, T=TURNED):
    return map_of(ground, T, **BIG), map_of(ground, **BIG)


def same_on_one_side():
    """Large maps that show the same ground on a strip and different ground beside it."""

    def ground(seed):
        def of(xy):
            strip = xy[:, 0] < -4.3
            (height, slope), (other, other_slope) = heights_and_slopes(0)(xy), heights_and_slopes(seed)(xy)
            return np.where(strip, height, other), np.where(strip[:, None], slope, other_slope)

        return of

    return tuple(map_of(ground(seed), **LARGE) for seed in (3, 4))


SCENES = {
    "a loop": lambda: (World.of(0).map(TURNED, **BIG), World.of(0).map(**BIG)),
    "other ground": lambda: (World.of(0).map(**BIG), World.of(1).map(**BIG)),
    "common trace": lambda: with_common_trace(3, 4),
    "same ground twice": lambda: same_ground_twice(0.3),
    "like ground beside": lambda: same_ground_twice(0.5),
    "less like ground beside": lambda: same_ground_twice(0.8),
    "ridges": lambda: turned(ridges(0)),
    "crest": crest,
    "long crests": lambda: turned(long_crests),
    "ridges, not turned": lambda: turned(ridges(1), np.eye(3)),
    "same on one side": same_on_one_side,
    "full of holes": full_of_holes,
    "flat": lambda: turned(flat),
    "tiny": lambda: same_corner(20),
    "small": lambda: same_corner(30, seed=2),
}
REASONS = {
    "a loop": "",
    "other ground": "chance explains it",
    "common trace": "chance explains it",
    "same ground twice": "ambiguous",
    "like ground beside": "ambiguous",
    "less like ground beside": "",
    "ridges": "ambiguous",
    "crest": "ambiguous",
    "long crests": "undetermined, the match slides",
    "ridges, not turned": "undetermined, too little ground",
    "same on one side": "uneven agreement",
    "full of holes": "undetermined, the refinement converges elsewhere",
    "flat": "featureless",
    "tiny": "too little ground",
    "small": "",
}


@cache
def scene_maps(scene):
    return SCENES[scene]()


def is_for(loop, reason):
    """Whether a pair was rejected for a reason, or is a loop if that is empty."""
    return loop.accepted is (not reason) and (not reason or loop.reason.startswith(reason))


@pytest.mark.parametrize("scene", SCENES)
def test_every_reason_is_given_where_it_should_be(scene):
    loop = register(*scene_maps(scene), Settings())
    assert is_for(loop, REASONS[scene]), loop.reason


# --- mutations

QUICKER = {
    "unrelated": partial(measure.of_unrelated, every=3),
    "weak revisits": partial(measure.of_revisits, most=0.3),
}
MUTANTS = [
    ("unrelated", "tail", 1.0),
    ("unrelated", "tail", 0.7),
    ("unrelated", "independent_tests", 0.5),
    ("small maps", "independent_tests", 0.005),
    ("revisits", "dense_hypotheses", 0),
    ("revisits", "block", 6.0),
    ("weak revisits", "pixels_per_length_scale", 1.0),
    ("weak revisits", "max_pixels", 24),
    ("weak revisits", "blur", 1.2),
    ("weak revisits", "spectrum_smoothing", 6.0),
    ("weak revisits", "whitening_floor", 100.0),
    ("weak revisits", "clip", 100.0),
    ("weak revisits", "min_shared_area", 60.0),
    ("weak revisits", "min_separation", 0.3),
    ("weak revisits", "peak_threshold", 30.0),
    ("weak revisits", "wraparound", 0.4),
    ("weak revisits", "candidates", 2),
    ("weak revisits", "rotation_step", 10.0),
    ("errors", "usual_warp", 0.0045),
    ("errors", "usual_warp", 0.0002),
    ("errors", "usual_warp_samples", 0.1),
    ("errors", "reach_of_radius", 60.0),
    ("errors", "motion_by_warp", (1500.0, 1500.0, 650.0)),
    ("errors", "motion_by_warp", (2.4, 2.4, 1.0)),
    ("errors", "motion_by_warp", (60.0, 60.0, 650.0)),
    ("errors", "motion_by_warp", (60.0, 60.0, 1.0)),
    ("errors", "rotation_by_warp", (0.0, 0.0, 0.0)),
    ("errors", "rotation_by_warp", (1000.0, 1000.0, 9000.0)),
    ("errors", "rotation_by_warp", (40.0, 40.0, 0.0)),
    ("rigid", "block", 0.5),
    ("rigid", "noise_factor", 1.0),
    ("rigid", "noise_factor", 10.0),
    ("rigid", "warp_noise_factor", 0.5),
    ("errors", "warp_noise_factor", 25.0),
    ("warped", "usual_warp_samples", 30.0),
]


@pytest.mark.parametrize("name", QUICKER)
def test_fewer_pairs_keep_them_too(name):
    """So that what breaks one below is the constant."""
    measured = QUICKER[name](Settings())
    assert not outside(measured), measured


@pytest.mark.parametrize(("name", "constant", "value"), MUTANTS)
def test_a_constant_that_moves_breaks_a_promise(name, constant, value):
    settings = calibrated(**{constant: value})
    assert outside((MEASURES | QUICKER)[name](settings))


SCENE_MUTANTS = [
    ("common trace", "min_correlation", 0.0),
    ("same on one side", "min_participation", 0.05),
    ("a loop", "min_participation", 0.9),
    ("same ground twice", "ambiguity_ratio", 0.99),
    ("less like ground beside", "ambiguity_ratio", 0.1),
    ("like ground beside", "ambiguity_chance", 1e-16),
    ("crest", "equivalence_ratio", 10.0),
    ("same ground twice", "min_separation", 20.0),
    ("small", "max_correlation", 0.9),
    ("tiny", "min_shared_area", 5.0),
]


@pytest.mark.parametrize(("scene", "constant", "value"), SCENE_MUTANTS)
def test_a_constant_that_moves_changes_a_reason(scene, constant, value):
    loop = register(*scene_maps(scene), calibrated(**{constant: value}))
    assert not is_for(loop, REASONS[scene]), loop.reason


def test_a_perfect_overlap_is_worth_only_so_much():
    """0.999 for what agrees better: a hundred million pairs need more than this small overlap."""
    scores = [register(*scene_maps("small"), calibrated(max_correlation=r)).score for r in (0.999, 0.99999)]
    assert scores[0] < 12 < scores[1]


def test_every_constant_is_moved():
    moved = {constant for _, constant, _ in MUTANTS + SCENE_MUTANTS}
    moved |= {constant for constant, _ in NULL_MUTANTS}
    assert moved == set(Calibration.model_fields)
