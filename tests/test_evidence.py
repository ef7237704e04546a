"""How sure a match is: the chance of a correlation, the covariance of a pose, and the decision itself."""

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from conftest import STRICT, flat, map_of, ridges, with_match
from scipy.stats import beta, binom

from terrainloop.config import Calibration
from terrainloop.entry import MapEntry
from terrainloop.geometry import inverse, se2, se3, transform, yaw_of
from terrainloop.loop import NO_EVIDENCE, Warp
from terrainloop.matching import significance
from terrainloop.matching.covariance import block_covariance
from terrainloop.matching.lift import PlanarPrecision, lift_to_se3
from terrainloop.matching.mission_warp import warp_variance
from terrainloop.matching.overlay import Overlay
from terrainloop.matching.refine import refine
from terrainloop.matching.register import compare, register
from terrainloop.matching.significance import combined_surprisal, surprisal_of_inliers
from terrainloop.record import SubmapRecord

CALIBRATION = Calibration()


def surprisal(correlation_squared, samples):
    return significance.surprisal_of_correlation(correlation_squared, samples, CALIBRATION)


def log_num_tests(tried, others):
    return significance.log_num_tests(tried, others, CALIBRATION)


BLOCK = 2.0
BIG = {"origin": (-4.0, -4.0), "shape": (100, 100)}

# --- the chance of a correlation


@pytest.mark.parametrize("samples", [8, 30, 100])
def test_surprisal_is_the_chance_of_independent_samples(samples):
    """The tail falls with the surprisal, from a half of it at no correlation to some tenths of it."""
    rng = np.random.default_rng(samples)
    x, y = rng.normal(size=(2, 100_000, samples)).astype(np.float32)
    r = (x * y).sum(1) / np.sqrt((x**2).sum(1) * (y**2).sum(1))
    assert np.mean(r**2) * samples == pytest.approx(1.0, rel=0.03)  # what the search takes for samples
    for chance in (0.3, 0.1, 0.01, 0.001):
        value = np.quantile(r, 1 - chance)
        bound = np.exp(-surprisal(value**2, samples))
        assert 0.9 * chance < bound < 10 * chance


@pytest.mark.parametrize(
    ("samples", "chance"), [(4.5, 1e-2), (20, 1e-6), (20, 1e-12), (1e3, 1e-6), (1e3, 1e-100), (1e5, 1e-300)]
)
def test_surprisal_of_far_tails_bounds_the_exact_law(samples, chance):
    """r^2 of n samples follows a beta law, half of its tail for each sign; in nats the bound is near."""
    value = surprisal(beta.isf(2 * chance, 0.5, (samples - 1) / 2), samples)
    assert -np.log(chance) - 5 < value < -np.log(chance)


def test_surprisal_grows_with_correlation_and_with_samples():
    squared, samples = np.linspace(0, 0.99, 40), np.linspace(1.5, 500, 30)
    values = surprisal(squared[:, None], samples)
    assert values.shape == (40, 30)
    assert (np.diff(values, axis=0) > 0).all()
    assert (np.diff(values[1:], axis=1) > 0).all()


def test_surprisal_at_the_ends():
    assert surprisal(0.0, 100.0) == 0
    for nothing in (0.0, 0.5, 1.0):  # samples
        assert surprisal(0.9, nothing) == 0
    assert np.isfinite(surprisal(1.0, 100.0))
    assert surprisal(1.0, 100.0) > surprisal(0.9, 100.0)
    assert surprisal(1.0, 100.0) == surprisal(0.9999, 100.0)  # no map is trusted to agree that well


def test_surprisal_of_inliers_is_the_binomial_tail():
    for inliers, associations, chance in ((1, 40, 0.01), (3, 130, 0.002), (20, 150, 0.003), (40, 40, 0.5)):
        exact = -binom.logsf(inliers - 1, associations, chance)
        assert surprisal_of_inliers(inliers, associations, chance) == pytest.approx(exact, rel=1e-6)
    assert surprisal_of_inliers(0, 50, 0.01) == surprisal_of_inliers(-2, 50, 0.01) == 0
    assert surprisal_of_inliers(3, 3, 1.0) == pytest.approx(0)
    assert np.isfinite(surprisal_of_inliers(400, 400, 1e-4))


def test_two_surprisals_are_as_rare_together_as_they_say():
    """Independent ones of unit decay: chance exceeds a level no more often than exp(-level), nor far less."""
    rng = np.random.default_rng(0)
    field, inliers = rng.exponential(size=(2, 200_000))
    both = np.array([combined_surprisal(f, i) for f, i in zip(field, inliers, strict=True)])
    for level in (1.0, 3.0, 5.0):
        assert 0.4 * np.exp(-level) < (both >= level).mean() < 1.05 * np.exp(-level)


def test_inliers_can_only_help():
    """But for the factor of two that it costs to look at them."""
    assert combined_surprisal(30.0, 0.0) == pytest.approx(30.0 - np.log(2))
    assert combined_surprisal(30.0, 30.0) > 54.0
    assert combined_surprisal(0.0, 0.0) == 0.0
    values = [combined_surprisal(12.0, inliers) for inliers in np.linspace(0, 50, 60)]
    assert (np.diff(values) >= 0).all()


def test_the_number_of_poses_goes_with_what_was_tried():
    none = np.empty(0)
    assert log_num_tests(1e6, none) - log_num_tests(1e4, none) == pytest.approx(np.log(100))
    assert log_num_tests(0.0, none) == 0.0


def test_like_places_count_as_poses():
    usual = log_num_tests(1e5, np.array([9.0, 8.0, 7.0]))
    assert usual == log_num_tests(1e5, np.empty(0))
    abounding = log_num_tests(1e5, np.linspace(25.0, 20.0, 10))
    assert abounding == pytest.approx(0.85 * 20 + np.log(10))
    assert abounding > usual


# --- the covariance of a fit


def blockwise(rng, block, shape):
    """Noise that is one number a block, for each column."""
    return rng.normal(size=(block.max() + 1, *shape))[block]


def test_covariance_is_that_of_many_fits_with_noise_by_the_block():
    """A plane on 90 places a block: counting the places as independent would be 90 times off."""
    length_scale = 0.7
    rng = np.random.default_rng(0)
    ground = rng.uniform([0, 0], [12 * BLOCK * length_scale, 8 * BLOCK * length_scale], (8600, 2))
    cell = np.floor(ground / (BLOCK * length_scale)).astype(int)
    block = cell[:, 0] * 8 + cell[:, 1]
    jacobian = np.c_[np.ones(len(ground)), ground - ground.mean(axis=0)]
    weights = rng.uniform(0.5, 2, len(ground))
    normal = jacobian.T @ (weights[:, None] * jacobian)
    fits, claimed = [], []
    for _ in range(400):
        noise = blockwise(rng, block, ()) + 0.3 * rng.normal(size=len(ground))
        fit = np.linalg.solve(normal, jacobian.T @ (weights * noise))
        residual = noise - jacobian @ fit
        fits.append(fit)
        claimed.append(block_covariance(jacobian, weights * residual, normal, ground, BLOCK * length_scale))
    np.testing.assert_allclose(np.diag(np.mean(claimed, 0)), np.var(fits, axis=0), rtol=0.2)
    normalised = [e @ np.linalg.solve(c, e) for e, c in zip(fits, claimed, strict=True)]
    assert 2.6 < np.mean(normalised) < 3.8  # 3 for known covariances


def test_two_components_at_a_place_are_in_one_block():
    rng = np.random.default_rng(0)
    ground = rng.uniform(0, 20, (300, 2))
    jacobian, residual = rng.normal(size=(2, 300, 4)), rng.normal(size=(2, 300))
    normal = np.einsum("cnp,cnq->pq", jacobian, jacobian)
    both = block_covariance(jacobian, residual, normal, ground, BLOCK * 0.9)
    flat = block_covariance(
        jacobian.reshape(-1, 4), residual.ravel(), normal, np.vstack([ground, ground]), BLOCK * 0.9
    )
    np.testing.assert_allclose(both, flat)
    np.testing.assert_allclose(both, both.T)
    assert np.linalg.eigvalsh(both).min() > 0


def test_covariance_scales_with_the_residuals_and_not_with_the_origin():
    rng = np.random.default_rng(0)
    ground = BLOCK * rng.integers(0, 9, (300, 2)) + rng.uniform(0.1, BLOCK - 0.1, (300, 2))
    jacobian, residual = rng.normal(size=(300, 3)), rng.normal(size=300)
    here = block_covariance(jacobian, residual, jacobian.T @ jacobian, ground, BLOCK)
    for blocks in ([250_000, -2_000_000], [-4, -8], [-9, -9]):
        moved = ground + BLOCK * np.array(blocks)
        there = block_covariance(jacobian, residual, jacobian.T @ jacobian, moved, BLOCK)
        np.testing.assert_allclose(there, here)
    np.testing.assert_allclose(
        block_covariance(jacobian, 3 * residual, jacobian.T @ jacobian, ground, BLOCK), 9 * here
    )


@pytest.mark.parametrize("blocks", [1, 2, 3])
def test_no_more_blocks_than_parameters_tell_nothing(blocks):
    ground = np.c_[BLOCK * np.arange(60) % (BLOCK * blocks) + 0.5, np.full(60, 0.5)]
    jacobian = np.random.default_rng(0).normal(size=(60, 3))
    covariance = block_covariance(jacobian, np.ones(60), jacobian.T @ jacobian, ground, BLOCK)
    assert covariance.shape == (3, 3)
    assert np.isnan(covariance).all()
    ground[0] = 50.0  # one more
    if blocks == 3:
        assert np.isfinite(
            block_covariance(jacobian, np.ones(60), jacobian.T @ jacobian, ground, BLOCK)
        ).all()


# --- the covariance of a pose


def test_the_pose_errs_no_more_than_its_covariance_says(world, gp_map):
    """Maps of noisy points, each ground seen twice, rigid: sigmas are short by less than 1.9."""
    T = se2(0.4, -0.3, 0.7)
    frame = se3(0.4, -0.3, 0.0, 0.0, 0.0, 0.7)
    values = []
    for seed in range(24):
        ground = world(seed % 6)
        source = gp_map(ground.observe(frame, (0.3, 0.2), seed=seed, count=2000, noise=0.02))
        target = gp_map(ground.observe(np.eye(4), (0.0, 0.0), seed=100 + seed, count=2000, noise=0.02))
        found = refine(source, target, se2(0.03, -0.05, 0.02) @ T, CALIBRATION)
        move = found.T_target_source @ inverse(T)
        error = [*(transform(move, found.pivot) - found.pivot), yaw_of(move)]
        values.append(error @ np.linalg.solve(found.covariance, error))
    assert 1.5 < np.mean(values) < 10.0  # 3 where they are not short


def warp_between(source, target):
    found = refine(source, target, np.eye(3), CALIBRATION)
    precision = PlanarPrecision(found.pivot, found.covariance)
    return lift_to_se3(Overlay(source, target, found.T_target_source), precision, CALIBRATION)[1]


def test_maps_that_are_warped_are_found_so(world):
    """By a rise of a two-hundredth of the radius between two maps; rigid ones by less than is usual."""
    ground, bend = world(0)._height_and_slope, 0.005 / 3.3

    def warped(xy):
        height, slope = ground(xy)
        x, y = xy.T
        return height + bend * x * y, slope + bend * np.c_[y, x]

    target = world(0).map(**BIG)
    rigid, bent = (warp_between(source, target) for source in (world(0).map(**BIG), map_of(warped, **BIG)))
    assert np.sqrt(warp_variance([rigid], CALIBRATION)) < CALIBRATION.usual_warp
    assert np.sqrt(bent.squares) == pytest.approx([0, 0.0025 / np.sqrt(2), 0], abs=3e-4)


def samples(squares, noise, count):
    return [Warp(np.full(3, squares), np.full(3, noise), np.eye(6), np.eye(6))] * count


def test_the_warp_of_a_mission_is_the_usual_one_until_its_loops_tell():
    usual = CALIBRATION.usual_warp**2
    assert warp_variance([], CALIBRATION) == pytest.approx(usual)
    assert warp_variance(samples(np.nan, np.nan, 9), CALIBRATION) == pytest.approx(usual)
    assert warp_variance(samples(1e6 * usual, 1e6 * usual, 9), CALIBRATION) == pytest.approx(usual, rel=1e-3)
    one, many = (warp_variance(samples(25 * usual, 0, n), CALIBRATION) / usual for n in (1, 100))
    assert 1 < one < many
    assert many == pytest.approx(25, rel=0.02)
    assert warp_variance(samples(0.0, 0.0, 100), CALIBRATION) < 0.01 * usual


def test_the_noise_of_a_warp_is_not_taken_for_warp():
    """Samples about a warp of a given size, each with a noise of its own."""
    rng, usual = np.random.default_rng(0), CALIBRATION.usual_warp**2
    for true in (0.0, usual, 16 * usual):
        noise = usual * rng.uniform(0.1, 10.0, (2000, 3))
        squares = rng.standard_normal((2000, 3)) ** 2 * (true + noise)
        warps = [Warp(s, n, np.eye(6), np.eye(6)) for s, n in zip(squares, noise, strict=True)]
        assert warp_variance(warps, CALIBRATION) == pytest.approx(true, abs=0.1 * max(true, usual))


# --- the decision


def mapped(name, gradient_map):
    return MapEntry.of(SubmapRecord(name), gradient_map, STRICT)


def judge(source, target, *, pairs=1, **match):
    return compare(mapped("b", source), mapped("a", target), with_match(STRICT, **match), pairs=pairs)


HALVES = [
    (se2(2.0, 0.5, 2.0), {}),
    (se2(-1.5, 0.0, -0.4), {"origin": (-1.5, -3.0), "shape": (70, 40), "resolution": 0.09}),
    (se2(3.0, -0.5, 3.0), BIG),
]


@pytest.mark.parametrize(("T", "options"), HALVES)
def test_maps_that_overlap_are_a_loop(world, T, options):
    loop = judge(world(0).map(T, **options), world(0).map())
    assert loop.accepted is True
    assert (loop.source, loop.target) == ("b", "a")
    offset = transform(loop.T_target_source[np.ix_([0, 1, 3], [0, 1, 3])], (0.0, 0.0)) - T[:2, 2]
    assert np.hypot(*offset) < 0.02
    assert abs(yaw_of(inverse(T) @ se2(0, 0, yaw_of(loop.T_target_source)))) < 0.005
    assert loop.correlation > 0.8
    assert loop.score > 5
    assert loop.found_by == "dense"
    assert f"correlation {loop.correlation:.2f}" in loop.reason


def test_either_may_be_the_source(world):
    T = se2(2.0, 0.5, 2.0)
    there, back = judge(world(0).map(T), world(0).map()), judge(world(0).map(), world(0).map(T))
    product = there.T_target_source @ back.T_target_source
    assert np.abs(product - np.eye(4)).max() < 0.02
    assert there.score == pytest.approx(back.score, rel=0.3)
    assert there.overlap == pytest.approx(back.overlap, abs=0.02)


def test_keypoints_make_a_loop_more_evident_and_do_not_move_it(world):
    source, target = (mapped(n, m) for n, m in (("b", world(0).map(se2(0.4, 0, 1))), ("a", world(0).map())))
    nothing = replace(source.features, positions=source.features.positions[:0])
    loop, without = (compare(s, target, STRICT) for s in (source, replace(source, features=nothing)))
    assert loop.inliers > 5
    assert without.inliers == 0
    assert loop.score > without.score + 5
    np.testing.assert_array_equal(without.T_target_source, loop.T_target_source)


def test_unrelated_ground_is_explained_by_chance(world):
    """Of all pairs of eleven worlds none is taken; half of the pairs expect less than ln 2 such places."""
    for options in ({"shape": (55, 55)}, BIG):
        submaps = [mapped(str(seed), world(seed).map(**options)) for seed in range(10, 19)]
        pairs = list(combinations(submaps, 2))
        found = [compare(a, b, STRICT, pairs=len(pairs)) for a, b in pairs]
        assert not any(found)
        assert all("chance" in c.reason or "ambiguous" in c.reason for c in found)
        assert sum("chance" in c.reason for c in found) > 30
        scores = np.array([c.score for c in found])
        assert np.log(2) / 3 < 10 ** -np.median(scores) < 3 * np.log(2)
        assert np.mean(scores > 1) < 0.25  # a tenth, for false alarms that are counted right


def test_max_false_loops_is_for_all_pairs(world):
    """Halfway to the score a loop, beyond it none; twice the pairs are half of what is allowed."""
    submaps = mapped("b", world(0).map(se2(2.0, 0.5, 2.0))), mapped("a", world(0).map())
    score = compare(*submaps, STRICT).score
    assert 4 < score < 60
    for allowed in (1e-4, 1e-2, 0.5):
        settings = with_match(STRICT, max_false_loops=allowed)
        loop = compare(*submaps, settings, pairs=10 ** (score / 2) * allowed)
        assert loop
        assert loop.score == pytest.approx(score)
        refused = compare(*submaps, settings, pairs=1.1 * 10**score * allowed)
        assert not refused
        assert "chance" in refused.reason
        assert f"{allowed:g} allowed" in refused.reason
    assert compare(*submaps, with_match(STRICT, max_false_loops=10 ** (-score / 2)))
    assert not compare(*submaps, with_match(STRICT, max_false_loops=0.9 * 10**-score))
    assert not compare(*submaps, with_match(STRICT, max_false_loops=1e-300), pairs=1e100)


def test_chance_is_reckoned_for_all_pairs(world):
    submaps = mapped("b", world(3).map()), mapped("a", world(0).map())
    one, many = (compare(*submaps, STRICT, pairs=pairs) for pairs in (1, 1000))
    assert one.score == many.score
    for candidate, pairs in ((one, 1), (many, 1000)):
        told = float(candidate.reason.split("chance explains it: ")[1].split()[0])
        assert told == pytest.approx(pairs * 10**-candidate.score, rel=0.06)


def ripples(xy):
    k = 2 * np.pi / 0.9
    return 0.1 * np.sin(k * xy[:, 0]), np.c_[0.1 * k * np.cos(k * xy[:, 0]), 0 * xy[:, 0]]


def egg_box(xy):
    k = 2 * np.pi / 0.9
    x, y = k * xy.T
    return 0.1 * np.sin(x) * np.sin(y), 0.1 * k * np.c_[np.cos(x) * np.sin(y), np.sin(x) * np.cos(y)]


@pytest.mark.parametrize(
    "T", [np.eye(3), se2(0.4, -0.3, 0.7), se2(0.2, 0.5, -3.0)], ids=["same", "turned", "back"]
)
@pytest.mark.parametrize("options", [{}, BIG], ids=["4 m", "8 m"])
@pytest.mark.parametrize(
    "ground", [flat, ripples, egg_box, ridges(0), ridges(1), ridges(2)],
    ids=["flat", "ripples", "egg box", "ridges 0", "ridges 1", "ridges 2"],
)  # fmt: skip
def test_ground_that_does_not_tell_the_place_is_no_loop(ground, options, T):
    """Least of all a perfect one: a motion along it, or by a period, changes nothing."""
    candidate = judge(map_of(ground, T, **options), map_of(ground, **options))
    assert not candidate, candidate.reason
    assert any(
        word in candidate.reason
        for word in ("chance", "ambiguous", "too little", "undetermined", "featureless")
    )


def test_the_same_ridge_with_bumps_on_it_is_a_loop(world):
    """What tells the place need not be the largest."""
    T = se2(0.4, -0.3, 0.7)

    def ground(xy):
        return tuple(a + b for a, b in zip(ridges(0)(xy), world(0)._height_and_slope(xy), strict=True))

    loop = judge(map_of(ground, T, **BIG), map_of(ground, **BIG))
    assert loop
    assert np.hypot(*(loop.T_target_source[:2, 3] - T[:2, 2])) < 0.02


def test_two_places_that_look_the_same_are_ambiguous(world):
    """The target holds the ground of the source twice, side by side."""
    period = 4.0

    def twice(xy):
        return world(0)._height_and_slope(np.c_[(xy[:, 0] + 2) % period - 2, xy[:, 1]])

    target = map_of(twice, origin=(-2.0, -2.0), shape=(50, 100))
    candidate = judge(world(0).map(origin=(-1.9, -1.9), shape=(48, 47)), target)
    assert not candidate
    assert "ambiguous" in candidate.reason
    assert candidate.score > 5  # not by chance
    assert judge(world(0).map(origin=(-1.9, -1.9), shape=(48, 47)), world(0).map())


MIDDLE = np.array([0.5, 0.2])


def rings(xy):
    """Concentric about the middle."""
    offset = xy - MIDDLE
    r = np.maximum(np.hypot(*offset.T), 1e-9)
    return 0.1 * np.cos(4 * r), -0.4 * np.sin(4 * r)[:, None] * offset / r[:, None]


def mounds(count):
    """Equal mounds on a circle about the middle."""
    angle = 2 * np.pi * np.arange(count) / count

    def ground(xy):
        offset = xy[:, None] - MIDDLE - 1.4 * np.c_[np.cos(angle), np.sin(angle)]
        bump = 0.2 * np.exp(-0.5 * (offset**2).sum(-1) / 0.3**2)
        return bump.sum(1), -(bump[..., None] * offset / 0.3**2).sum(1)

    return ground


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6])
def test_symmetric_ground_is_ambiguous_and_the_other_pose_is_named(count):
    T = se2(0.4, -0.3, 0.7)
    candidate = judge(map_of(mounds(count), T, **BIG), map_of(mounds(count), **BIG))
    assert candidate.reason.startswith("ambiguous")
    x, y, yaw = (float(n) for n in re.findall(r"-?\d+\.?\d*", candidate.reason)[:3])
    found = candidate.T_target_source
    turn = np.radians(yaw) - yaw_of(found)
    assert np.cos(count * turn) > 0.99
    assert np.cos(turn) < 0.9
    # Both poses put the middle where it is.
    named = transform(se2(x, y, np.radians(yaw)), transform(inverse(T), MIDDLE))
    assert np.hypot(*(named - MIDDLE)) < 0.1


def test_round_ground_leaves_the_yaw_open():
    candidate = judge(map_of(rings, se2(0.4, -0.3, 0.7), **BIG), map_of(rings, **BIG))
    assert candidate.reason.startswith("undetermined in yaw, the ground is round about x 0.5")
    assert np.isnan(candidate.covariance).all()


def test_maps_that_cannot_share_enough_are_not_judged(world):
    nothing = world(0).map()
    nothing = replace(nothing, mask=np.zeros_like(nothing.mask))
    candidate = judge(nothing, world(0).map())
    assert not candidate
    assert "too little ground" in candidate.reason
    assert candidate.score == NO_EVIDENCE
    assert candidate.found_by == ""
    assert np.isnan(candidate.correlation)
    assert np.isnan(candidate.T_target_source).all()


def test_too_little_ground_is_no_evidence_however_well_it_agrees(world):
    """1.4 m^2 of the same ground in the same frame, of 3.2 needed."""
    candidate = judge(world(0).map(shape=(15, 15)), world(0).map())
    assert not candidate
    assert candidate.score <= 0


def test_register_compares_one_pair(world):
    maps = world(0).map(se2(2.0, 0.5, 2.0)), world(0).map()
    alone, one = register(*maps, STRICT, names=("b", "a")), judge(*maps)
    assert alone.T_target_source.tobytes() == one.T_target_source.tobytes()
    assert (alone.score, alone.reason) == (one.score, one.reason)


def test_the_decision_does_not_hang_on_metres(world):
    """Ground a hundred times as large, with the process scaled along."""
    T = se2(2.0, 0.5, 2.0)

    def larger(gradient_map):
        p = gradient_map.parameters
        return replace(
            gradient_map,
            elevation=100 * gradient_map.elevation,
            variance=1e4 * gradient_map.variance,
            origin=tuple(100 * c for c in gradient_map.origin),
            resolution=100 * gradient_map.resolution,
            parameters=replace(p, length_scale=100 * p.length_scale),
        )

    maps = world(0).map(T), world(0).map()
    small = judge(*maps, inlier_radius=None)
    large = judge(*map(larger, maps), inlier_radius=None)
    assert small
    assert large
    assert large.score == pytest.approx(small.score, rel=0.05)
    np.testing.assert_allclose(
        large.T_target_source[:3, 3], 100 * small.T_target_source[:3, 3], rtol=0, atol=0.5
    )
    np.testing.assert_allclose(large.covariance[5, 5], small.covariance[5, 5], rtol=0.2)
