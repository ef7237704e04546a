"""What C++ users call, held to what Python does: one match of two maps, and a map from points."""

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import PARAMETERS, World, map_of, ridges

from terrainloop import _core
from terrainloop.config import Calibration, MatchSettings, Settings
from terrainloop.entry import MapEntry
from terrainloop.features import Features
from terrainloop.field import field_of, field_spacing
from terrainloop.geometry import parameters_of, se2, se3, translation
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.register import compare
from terrainloop.record import SubmapRecord

NO_KEYPOINTS = Features(np.empty((0, 2)), *np.empty((3, 0)), np.empty((0, 128), np.float32), "sift")
UTM = np.array([5e5, 4e6])
BIG = {"origin": (-4.0, -4.0), "shape": (100, 100)}


def entry(name, gradient_map, calibration):
    """A submap without keypoints."""
    field = field_of(gradient_map, field_spacing(gradient_map, calibration), calibration)
    return MapEntry(SubmapRecord(name), gradient_map, NO_KEYPOINTS, field)


def in_python(source, target, *, pairs=1.0, max_false_loops=0.01, **changed):
    calibration = Calibration(**changed)
    settings = Settings(calibration=calibration, match=MatchSettings(max_false_loops=max_false_loops))
    entries = entry("b", source, calibration), entry("a", target, calibration)
    return compare(*entries, settings, pairs=pairs)


def arrays(m):
    images = m.elevation, m.gradient_x, m.gradient_y, m.gradient_variance, m.mask.astype(np.uint8)
    return (*map(np.ascontiguousarray, images), m.origin, m.resolution, m.parameters.length_scale)


def in_cpp(source, target, *, pairs=1.0, max_false_loops=0.01, **changed):
    given = {"pairs": pairs, "max_false_loops": max_false_loops, "calibration": changed}
    return _core.match(arrays(source), arrays(target), **given)


def words(reason):
    return re.sub(r"(below )?\d[\d.e+-]*", "#", reason)


def same_decision(source, target, **options):
    """The candidate of Python and the match of C++, whose decisions, reasons and scores agree."""
    candidate, match = in_python(source, target, **options), in_cpp(source, target, **options)
    assert match["accepted"] == candidate.accepted, (match["reason"], candidate.reason)
    assert words(match["reason"]) == words(candidate.reason)
    assert match["score"] == pytest.approx(candidate.score, rel=0.02, abs=0.1)
    return candidate, match


def same_pose(candidate, match):
    """The poses agree, and the covariance where there is one."""
    T = translation(-match["target_origin"]) @ match["T_target_source"] @ translation(match["source_origin"])
    np.testing.assert_array_equal(match["source_origin"], candidate.source_origin)
    np.testing.assert_array_equal(match["target_origin"], candidate.target_origin)
    difference = parameters_of(T) - parameters_of(candidate.T_local)
    assert np.abs(difference[:3]).max() < 1e-3
    assert np.abs(difference[3:]).max() < 1e-4
    assert match["log_nfa"] == pytest.approx(candidate.log_nfa, rel=0.02, abs=0.1)
    assert match["correlation"] == pytest.approx(candidate.correlation, abs=1e-3)
    assert match["overlap"] == pytest.approx(candidate.overlap, abs=1e-3)
    deviations = np.sqrt(np.diag(candidate.covariance))
    scaled = match["covariance"] / np.outer(deviations, deviations)
    np.testing.assert_allclose(scaled, candidate.covariance / np.outer(deviations, deviations), atol=0.05)


def at(m, offset, height=0.0):
    """The map in a frame whose origin is elsewhere."""
    origin = (m.origin[0] + offset[0], m.origin[1] + offset[1])
    return replace(m, origin=origin, elevation=m.elevation + np.float32(height))


def with_length_scale(m, length_scale):
    return replace(m, parameters=replace(m.parameters, length_scale=length_scale))


def with_holes(m, seed):
    rng = np.random.default_rng(seed)
    mask = np.ones_like(m.mask)
    mask[20:38, 4:17] = mask[45:52, 30:44] = False
    variance = m.gradient_variance * rng.uniform(1, 20, mask.shape).astype(np.float32)
    return replace(m, mask=mask, gradient_variance=variance)


WORLD = World.of(7)
T = se2(0.3, -0.4, 1.1)
LOOPS = {
    "same": (WORLD.map(), WORLD.map()),
    "turned": (WORLD.map(T), WORLD.map()),
    "opposite direction": (WORLD.map(se2(0.4, 0.3, np.pi)), WORLD.map()),
    "partial overlap": (WORLD.map(se2(1.9, 0.6, -2.0)), WORLD.map()),
    "large": (WORLD.map(se2(1.0, -2.2, 0.5), **BIG), WORLD.map(**BIG)),
    "larger than the field": (WORLD.map(T, shape=(200, 60)), WORLD.map(shape=(60, 220))),
    "finer source": (WORLD.map(T, shape=(100, 90), resolution=0.05), WORLD.map()),
    "finer target": (WORLD.map(T), WORLD.map(shape=(100, 90), resolution=0.05)),
    "longer length scale": (with_length_scale(WORLD.map(T), 0.5), WORLD.map()),
    "shorter length scale": (with_length_scale(WORLD.map(T), 0.33), WORLD.map()),
    "holes": (with_holes(WORLD.map(T), 1), with_holes(WORLD.map(), 2)),
    "source in UTM": (at(WORLD.map(T), UTM, 321.0), WORLD.map()),
    "both in UTM": (at(WORLD.map(T), UTM, 321.0), at(WORLD.map(), UTM + 70.0, 320.0)),
}


@pytest.mark.parametrize("pair", LOOPS.values(), ids=LOOPS)
def test_loops_are_those_of_python(pair):
    candidate, match = same_decision(*pair)
    assert candidate
    same_pose(candidate, match)


def ripples(xy):
    k = 2 * np.pi / 0.8
    return 0.1 * np.sin(k * xy[:, 1]), np.c_[0 * xy[:, 0], 0.1 * k * np.cos(k * xy[:, 1])]


def flat(xy):
    return 0.25 * xy[:, 1], np.full(xy.shape, (0.0, 0.25))  # its mean is exact in single precision


def twice(xy):
    """The ground of a source at two places, side by side."""
    return WORLD._height_and_slope(np.c_[(xy[:, 0] + 2) % 4 - 2, xy[:, 1]])


def rings(xy):
    """Concentric about (0.5, 0.2)."""
    offset = xy - (0.5, 0.2)
    r = np.maximum(np.hypot(*offset.T), 1e-9)
    return 0.1 * np.cos(4 * r), -0.4 * np.sin(4 * r)[:, None] * offset / r[:, None]


def long_crests(xy):
    """Relief that is six times as long along x as across."""
    height, slope = WORLD._height_and_slope(xy * [1 / 6, 1])
    return height, slope * [1 / 6, 1]


def unknown(m):
    return replace(m, mask=np.zeros_like(m.mask))


REJECTED = {
    "chance": (WORLD.map(), World.of(8).map()),
    "chance ": (World.of(9).map(**BIG), World.of(5).map(**BIG)),
    "chance  ": (map_of(ripples), map_of(ripples)),
    "featureless": (map_of(flat), map_of(flat, T)),
    "featureless ": (map_of(flat), WORLD.map()),
    "too little ground: ": (WORLD.map(shape=(8, 9)), WORLD.map()),
    "too little ground:": (unknown(WORLD.map()), WORLD.map()),
    "too little ground": (WORLD.map(shape=(1, 1)), WORLD.map()),
    "ambiguous": (
        WORLD.map(origin=(-1.9, -1.9), shape=(48, 47)),
        map_of(twice, origin=(-2.0, -2.0), shape=(50, 100)),
    ),
    "ambiguous ": (map_of(ridges(1), T, **BIG), map_of(ridges(1), **BIG)),
    "undetermined in yaw": (map_of(rings, T, **BIG), map_of(rings, **BIG)),
    "the match slides": (map_of(long_crests, T, **BIG), map_of(long_crests, **BIG)),
    "too little ground to determine": (map_of(ridges(1)), map_of(ridges(1))),
}


@pytest.mark.parametrize(("word", "pair"), REJECTED.items(), ids=REJECTED)
def test_rejections_are_those_of_python(word, pair):
    candidate, match = same_decision(*pair)
    assert not candidate
    assert word.strip() in match["reason"]
    assert np.isnan(match["covariance"]).all()


@pytest.mark.parametrize(
    ("word", "changed"),
    [
        ("weak agreement", {"min_correlation": 0.995}),
        ("converges elsewhere", {"min_separation": 1e-5, "candidates": 1}),
        ("the match slides", {"min_separation": 0.05}),
        ("too little ground to determine", {"block": 8.0}),
        ("too little ground: ", {"min_shared_area": 1000.0}),
        ("featureless", {"dense_hypotheses": 0}),
        ("chance", {"pairs": 1e40}),
        ("chance", {"max_false_loops": 1e-40}),
        ("", {"usual_warp": 0.02, "motion_by_warp": (1.0, 3.0, 2.0)}),
        ("", {"rotation_by_warp": (0.1, 2.0, 1.0), "usual_warp_samples": 9.0}),
        ("", {"noise_factor": 9.0, "warp_noise_factor": 0.1, "reach_of_radius": 9.0}),
        ("", {"clip": 0.5, "blur": 0.6, "whitening_floor": 0.1, "spectrum_smoothing": 2.5}),
        ("", {"pixels_per_length_scale": 1.5, "rotation_step": 0.7, "wraparound": 1.0}),
        ("", {"max_pixels": 20, "candidates": 3, "peak_threshold": 3.0}),
        ("", {"tail": 0.5, "independent_tests": 2.0, "max_correlation": 0.9}),
    ],
)
def test_settings_have_the_effect_they_have_in_python(word, changed):
    pair = LOOPS["turned"]
    usual, (candidate, match) = in_cpp(*pair), same_decision(*pair, **changed)
    assert word in match["reason"]
    assert (word == "") == candidate.accepted
    assert match["accepted"] != usual["accepted"] or not np.allclose(
        np.r_[match["covariance"].ravel(), match["score"]],
        np.r_[usual["covariance"].ravel(), usual["score"]],
        rtol=1e-3, atol=0,
    )  # fmt: skip
    if candidate:
        same_pose(candidate, match)


def test_the_calibration_is_that_of_python():
    python = Calibration().model_dump(mode="json")
    assert _core.calibration() == {k: v for k, v in python.items() if not k.startswith("null_")}


def test_impossible_settings_are_refused():
    m = arrays(WORLD.map(shape=(20, 20)))
    for options in (
        {"pairs": 0.0},
        {"max_false_loops": np.nan},
        {"calibration": {"tail": -1.0}},
        {"calibration": {"no such number": 1.0}},
    ):
        with pytest.raises(ValueError, match=r"positive|within|unknown"):
            _core.match(m, m, **options)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (*UTM, 40.0)], ids=["local", "UTM"])
def test_a_map_from_points_is_that_of_python(origin):
    """On a slope, with spikes that are no terrain."""
    points = WORLD.observe(se3(0, 0, 0, 0.03, -0.12, 0.5), (0.3, 0.0), seed=3) + origin
    points[5:25, 2] += 6.0
    p = PARAMETERS
    made = _core.make_gradient_map(
        points, length_scale=p.length_scale, variance=p.variance, noise=p.noise, threads=2
    )
    expected = GradientMap.from_points(points, p.length_scale, p.variance, p.noise)
    np.testing.assert_array_equal(made["mask"], expected.mask)
    assert made["origin"] == pytest.approx(expected.origin, abs=1e-9)
    assert made["resolution"] == expected.resolution
    for name in ("elevation", "gradient_x", "gradient_y", "variance", "gradient_variance"):
        np.testing.assert_allclose(made[name], getattr(expected, name), rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("found", ["few", "NaN", "wide", "far"])
def test_points_that_make_no_map_are_refused(found):
    points = WORLD.observe(np.eye(4), (0.0, 0.0), seed=3)
    points[3] = {"NaN": np.nan, "wide": 1e6, "far": 1e12}.get(found, 0.0)
    points = points[:99] if found == "few" else points
    with pytest.raises(ValueError, match="points"):
        _core.make_gradient_map(points, length_scale=0.4, variance=0.01, noise=0.01)
