"""Associations, Algorithm 1, its SSD, the pose, and `register`, against naive versions and known truth."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import BY_INLIERS, STRICT, with_match, with_pixels
from scipy.ndimage import map_coordinates

from terrainloop.config import Calibration
from terrainloop.entry import MapEntry
from terrainloop.features import Features
from terrainloop.geometry import fit_se2, inverse, parameters_of, se2, se3, transform, translation, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.algorithm_1 import algorithm_1
from terrainloop.matching.by_inliers import align
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.lift import PlanarPrecision, covariance_of_inliers, lift_to_se3
from terrainloop.matching.overlay import Overlay
from terrainloop.matching.ransac import get_inliers, register_by_ransac, select_random_associations
from terrainloop.matching.refine import refine
from terrainloop.matching.register import compare, register
from terrainloop.matching.ssd import compute_ssd as ssd_of_overlay
from terrainloop.record import SubmapRecord

UTM = np.array([5e5, 4e6, 0.0])


def compute_ssd(source, target, T):
    return ssd_of_overlay(Overlay(source, target, T))


def lift(source, target, T, pivot, covariance):
    """The transform and its covariance, of rigid submaps."""
    lifted, warp = lift_to_se3(Overlay(source, target, T), PlanarPrecision(pivot, covariance), Calibration())
    return lifted, warp.rigid


SHIFT = se3(*UTM, 0.0, 0.0, 0.0)


# --- associations


def features(count, kind="sift", seed=0):
    rng = np.random.default_rng(seed)
    if kind == "orb":
        descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    else:
        descriptors = rng.normal(size=(count, 128)).astype(np.float32)
    positions = rng.uniform(-5, 5, (count, 2))
    return Features(positions, np.ones(count), np.zeros(count), np.ones(count), descriptors, kind)


def nearest(source, target):
    """Index pairs that are each other's nearest, by every distance."""
    if source.descriptors.dtype == np.uint8:
        a, b = (np.unpackbits(f.descriptors, axis=1).astype(int) for f in (source, target))
        distances = np.abs(a[:, None] - b).sum(-1)
    else:
        a, b = (f.descriptors.astype(float) for f in (source, target))
        distances = ((a[:, None] - b) ** 2).sum(-1)
    forward, backward = distances.argmin(1), distances.argmin(0)
    return {(i, j) for i, j in enumerate(forward.tolist()) if backward[j] == i}


def rows(positions):
    return {tuple(row) for row in positions.tolist()}


def pairs_of(source, target, indices):
    return rows(np.array([np.r_[source.positions[i], target.positions[j]] for i, j in indices]))


def test_associations_are_nearest_neighbours_both_ways():
    source, target = features(60, seed=1), features(45, seed=2)
    found, expected = associate(source, target), nearest(source, target)
    assert rows(np.hstack([found.source, found.target])) == pairs_of(source, target, expected)
    assert 5 < len(found) == len(expected) < 45


def test_binary_descriptors_are_compared_by_bits():
    """Targets 0-9 differ from their sources in few but high bits, targets 10-19 in many but low ones."""
    original = features(10, "orb", 1).descriptors
    high, low = original.copy(), original ^ np.uint8(0x03)
    high[:, :20] ^= 0x80
    similar = original.copy()  # sources 10-19: one bit further from everything
    similar[:, 31] ^= 0x40
    source = replace(features(20, "orb", 1), descriptors=np.vstack([original, similar]))
    target = replace(features(20, "orb", 2), descriptors=np.vstack([high, low]))
    found = associate(source, target)
    expected = {(i, i) for i in range(10)}
    assert nearest(source, target) == expected
    assert rows(np.hstack([found.source, found.target])) == pairs_of(source, target, expected)


def test_a_keypoint_of_two_orientations_is_one_spot():
    """Spots 3 and 5 stand twice on both sides, with a descriptor for each orientation."""
    source, target = features(20, seed=1), features(20, seed=2)
    target = replace(target, descriptors=source.descriptors + np.float32(0.01))
    places = [*range(18), 3, 5]
    source, target = (replace(each, positions=each.positions[places]) for each in (source, target))
    found = associate(source, target)
    assert nearest(source, target) == {(i, i) for i in range(20)}
    assert len(found) == 18
    assert rows(np.hstack([found.source, found.target])) == pairs_of(
        source, target, [(i, i) for i in range(18)]
    )


@pytest.mark.parametrize("kind", ["sift", "orb"])
@pytest.mark.parametrize("counts", [(0, 5), (5, 0), (0, 0)])
def test_no_features_no_associations(kind, counts):
    found = associate(features(counts[0], kind), features(counts[1], kind))
    assert len(found) == 0
    assert found.source.shape == found.target.shape == (0, 2)


# --- SSD and overlap


def square_map(world, rows=40, columns=60, seed=0, resolution=0.1):
    return world(seed).map(origin=(-3.0, -2.0), shape=(rows, columns), resolution=resolution)


def with_variance(gradient_map, seed):
    """The map with an uneven variance, as ground seen from afar has."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices(gradient_map.mask.shape)
    a, b = rng.uniform(0.05, 0.15, 2)
    variance = 1e-4 * (1.5 + np.sin(a * rows) * np.cos(b * columns))
    return replace(gradient_map, variance=variance.astype(np.float32))


def naive_ssd(source, target, T):
    """h, its ratio and the overlap, pixel by pixel of the target in metres, interpolating with SciPy."""
    rows, columns = np.indices(target.mask.shape)
    ground = target.origin + target.resolution * np.stack([columns, rows], -1)
    at = (transform(np.linalg.inv(T), ground) - source.origin) / source.resolution
    at = np.stack([at[..., 1], at[..., 0]])

    def resample(image):
        return map_coordinates(image.astype(float), at, order=1, mode="constant", cval=0.0)

    both = (resample(source.mask) > 0.999) & target.mask
    g_q, v_q = resample(source.magnitude)[both], resample(source.variance)[both]
    g_d, v_d = target.magnitude[both].astype(float), target.variance[both].astype(float)
    w = 1 / (v_q * v_d)
    h = np.sum((g_q - g_d) ** 2 / (v_q * v_d))
    # Unrelated: every pixel of one against every pixel of the other, less the difference of the means.
    mean_q, mean_d = (w @ g_q) / w.sum(), (w @ g_d) / w.sum()
    unrelated = w @ (g_q - mean_q) ** 2 + w @ (g_d - mean_d) ** 2
    area = source.mask.sum() * source.resolution**2 + (target.mask.sum() - both.sum()) * target.resolution**2
    return h, h / unrelated, both.sum() * target.resolution**2 / area


@pytest.mark.parametrize("T", [se2(0.0, 0.0, 0.0), se2(0.5, -0.7, 0.0)], ids=["same", "whole pixels"])
def test_ssd_on_whole_pixels_equals_the_naive_sum(world, T):
    source, target = with_variance(square_map(world), 1), with_variance(square_map(world, seed=3), 2)
    ssd = compute_ssd(source, target, T)
    h, ratio, overlap = naive_ssd(source, target, T)
    assert ssd.value == pytest.approx(h, rel=1e-4)
    assert ssd.ratio == pytest.approx(ratio, rel=1e-4)
    assert ssd.overlap == pytest.approx(overlap, rel=1e-9)


@pytest.mark.parametrize("T", [se2(0.43, -0.71, 0.3), se2(-1.234, 0.5, 2.9), se2(2.0, 1.5, -1.5)])
def test_ssd_between_pixels_equals_the_naive_sum(world, T):
    source = with_variance(square_map(world, resolution=0.09), 1)
    target = with_variance(square_map(world, seed=3), 2)
    ssd = compute_ssd(source, target, T)
    h, ratio, overlap = naive_ssd(source, target, T)
    # OpenCV may interpolate at 1/32 of a pixel, and pixels on the very border then fall in or out.
    assert ssd.value == pytest.approx(h, rel=0.05)
    assert ssd.ratio == pytest.approx(ratio, rel=0.03)
    assert ssd.overlap == pytest.approx(overlap, rel=0.03)


def test_identical_ground_has_no_ssd(world):
    ssd = compute_ssd(square_map(world), square_map(world), np.eye(3))
    assert ssd.value == 0.0
    assert ssd.ratio == 0.0
    assert ssd.overlap == 1.0


def test_the_same_ground_in_another_frame_has_little_ssd(world):
    T = se2(0.7, -0.4, 2.0)
    ssd = compute_ssd(world(0).map(T), world(0).map(), T)
    assert 0.0 < ssd.ratio < 0.02
    assert compute_ssd(world(0).map(T), world(0).map(), se2(0.7, -0.4, 1.0)).ratio > 0.3


def test_unrelated_ground_has_a_ratio_of_one(world):
    options = {"origin": (-6.0, -6.0), "shape": (60, 60), "resolution": 0.2}
    maps = [world(seed).map(**options) for seed in range(4)]
    ratios = [compute_ssd(a, b, np.eye(3)).ratio for a in maps for b in maps if a is not b]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
    assert min(ratios) > 0.6


def test_ssd_grows_with_certainty_and_its_ratio_does_not(world):
    source, target = square_map(world), square_map(world, seed=3)
    once = compute_ssd(source, target, np.eye(3))
    surer = compute_ssd(replace(source, variance=source.variance / 4), target, np.eye(3))
    assert surer.value == pytest.approx(4 * once.value, rel=1e-5)
    assert surer.ratio == pytest.approx(once.ratio, rel=1e-5)


@pytest.mark.parametrize(("dx", "dy"), [(0, 0), (7, 0), (-12, 5), (30, -30), (59, 39)])
def test_overlap_is_that_of_the_two_rectangles(world, dx, dy):
    shared = (60 - abs(dx)) * (40 - abs(dy))
    ssd = compute_ssd(square_map(world), square_map(world), se2(0.1 * dx, 0.1 * dy, 0.0))
    assert ssd.overlap == pytest.approx(shared / (2 * 60 * 40 - shared), rel=1e-9)


def test_overlap_of_a_quarter_turn(world):
    """6 x 4 m over 4 x 6 m about one centre share 4 x 4 m."""
    centre = np.array([-3.0, -2.0]) + 0.05 * np.array([59, 39])
    T = se2(*centre, 0.0) @ se2(0, 0, np.pi / 2) @ inverse(se2(*centre, 0.0))
    ssd = compute_ssd(square_map(world), square_map(world), T)
    assert ssd.overlap == pytest.approx(16 / (2 * 24 - 16), abs=0.03)


def test_overlap_counts_known_ground_only(world):
    source, target = square_map(world), square_map(world)
    source = with_pixels(source, np.s_[:, 30:], mask=False)
    target = with_pixels(target, np.s_[:20], mask=False)
    ssd = compute_ssd(source, target, np.eye(3))
    assert ssd.overlap == pytest.approx(20 * 30 / (40 * 30 + 20 * 60 - 20 * 30), rel=0.05)


def test_overlap_in_metres_where_resolutions_differ(world):
    coarse = square_map(world, rows=21, columns=31, resolution=0.2)
    assert compute_ssd(coarse, square_map(world, 41, 61), np.eye(3)).overlap == pytest.approx(1.0, abs=0.05)


def test_maps_apart_share_nothing(world):
    ssd = compute_ssd(square_map(world), square_map(world), se2(50.0, 0.0, 0.0))
    assert ssd.overlap == 0.0
    assert ssd.ratio == np.inf  # acceptable under no threshold
    assert ssd.value == 0.0


@pytest.mark.parametrize("step", [1, 3])
def test_an_overlay_puts_ground_where_the_transform_says(world, step):
    T = se2(0.5, -0.8, np.pi / 2)
    source, target = square_map(world), square_map(world)
    spot = np.zeros(source.mask.shape, np.float32)
    spot[11:14, 39:42] = 1.0
    overlay = Overlay(source, target, T, step)
    values = overlay.of_source(spot)
    spotted = overlay.positions[values > 0.99]
    assert len(spotted) >= 1
    expected = transform(T, np.array(source.origin) + 0.1 * np.array([40, 12]))
    assert np.abs(spotted.mean(axis=0) - expected).max() < 0.051 * step
    assert overlay.shared_area == pytest.approx(len(values) * (0.1 * step) ** 2)
    np.testing.assert_array_equal(
        overlay.of_target(target.elevation), target.elevation[::step, ::step][overlay.shared]
    )


# --- Algorithm 1


def noisy_associations(T, seed, good=25, bad=60, spread=0.04):
    """Associations of which `good` follow T up to some scatter, and `bad` do not, in random order."""
    rng = np.random.default_rng(seed)
    source = rng.uniform([-1.8, -2.3], [1.8, 2.0], (good + bad, 2))
    target = transform(T, source) + rng.normal(0, spread, source.shape)
    target[good:] = rng.uniform(-2, 2, (bad, 2))
    order = rng.permutation(good + bad)
    return Associations(source[order], target[order])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("max_ssd_ratio", [0.6, 100.0])
def test_ransac_is_algorithm_1(world, seed, max_ssd_ratio):
    T = se2(0.7, -0.4, 0.5 + seed)
    source, target = world(0).map(T), world(0).map()
    associations = noisy_associations(T, seed)
    # Only the naive loop's own cost keeps the draws few.
    draws = select_random_associations(len(associations), 150, np.random.default_rng(seed))
    naive = algorithm_1(source, target, associations, draws, 0.1, lambda n, h: h.ratio <= max_ssd_ratio)
    found = register_by_ransac(
        source,
        target,
        associations,
        iterations=150,
        inlier_radius=0.1,
        max_ssd_ratio=max_ssd_ratio,
        rng=np.random.default_rng(seed),
    )
    assert naive.n > 2
    assert found.inliers.sum() == naive.n
    np.testing.assert_allclose(found.T_target_source, naive.T, rtol=0, atol=1e-12)
    assert found.ssd == naive.h


def test_ransac_prefers_an_acceptable_transform_to_one_with_more_inliers(world):
    """Two consistent sets: the larger lays the maps wrongly over each other."""
    T, wrong = se2(0.7, -0.4, 0.5), se2(-0.5, 0.5, 2.0)
    source, target = world(0).map(T), world(0).map()
    right_set, wrong_set = noisy_associations(T, 0, 12, 0), noisy_associations(wrong, 1, 20, 0)
    both = Associations(
        np.vstack([right_set.source, wrong_set.source]), np.vstack([right_set.target, wrong_set.target])
    )
    options = {"iterations": 600, "inlier_radius": 0.15}
    strict, loose = (
        register_by_ransac(source, target, both, **options, max_ssd_ratio=ratio, rng=np.random.default_rng(0))
        for ratio in (0.3, 100.0)
    )
    assert loose.inliers[12:].sum() > 15
    assert strict.inliers[:12].sum() > 9
    assert strict.inliers[12:].sum() < 5
    np.testing.assert_allclose(strict.T_target_source, T, rtol=0, atol=0.08)


def test_where_nothing_is_acceptable_the_most_inliers_are_told(world):
    T = se2(0.7, -0.4, 0.5)
    associations = noisy_associations(T, 0)
    found = register_by_ransac(
        world(0).map(T), world(5).map(), associations,
        iterations=400, inlier_radius=0.1, max_ssd_ratio=1e-6, rng=np.random.default_rng(0),
    )  # fmt: skip
    assert found.ssd.ratio > 1e-6
    assert found.inliers.sum() >= 15


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_associations_give_nothing(world, count):
    few = Associations(np.ones((count, 2)), np.ones((count, 2)))
    options = {"iterations": 5, "inlier_radius": 0.1, "max_ssd_ratio": 1.0, "rng": np.random.default_rng(0)}
    assert register_by_ransac(world(0).map(), world(0).map(), few, **options) is None


def test_associations_all_in_one_spot_give_nothing(world):
    spot = Associations(np.full((9, 2), 0.5), np.random.default_rng(0).uniform(-1, 1, (9, 2)))
    options = {"iterations": 50, "inlier_radius": 0.1, "max_ssd_ratio": 1.0, "rng": np.random.default_rng(0)}
    assert register_by_ransac(world(0).map(), world(0).map(), spot, **options) is None


def test_draws_are_pairs_of_different_associations_each_as_likely():
    draws = select_random_associations(6, 30_000, np.random.default_rng(0))
    assert draws.shape == (30_000, 2)
    assert (draws[:, 0] != draws[:, 1]).all()
    counts = np.zeros((6, 6))
    np.add.at(counts, tuple(draws.T), 1)
    expected = 1000 * (1 - np.eye(6))
    assert np.abs(counts - expected).max() < 5 * np.sqrt(1000)  # 5 sigma of a count
    again = select_random_associations(6, 30_000, np.random.default_rng(0))
    np.testing.assert_array_equal(draws, again)


def test_inliers_are_within_the_radius():
    associations = Associations(np.zeros((4, 2)), np.array([[0.0, 0.0], [0.3, 0.4], [0.3, 0.401], [9, 9]]))
    T = np.array([np.eye(3), se2(9.0, 9.0, 1.0)])
    expected = [[True, True, False, False], [False, False, False, True]]
    np.testing.assert_array_equal(get_inliers(associations, T, 0.5), expected)


# --- register


def place(seed=0, *, yaw=0.0, centre=(0.0, 0.0), draw=0):
    """One look at a world from a tilted, lifted frame: seed, T_world_submap, centre, draw of the points."""
    T = se3(0.5, -0.3, 0.4, 0.03, -0.02, np.radians(yaw)) if draw else np.eye(4)
    return SimpleNamespace(seed=seed, T=T, centre=centre, draw=draw)


PLACES = {
    "target": place(),
    "same direction": place(yaw=10.0, centre=(0.7, 0.5), draw=1),
    "opposite direction": place(yaw=170.0, centre=(0.7, 0.5), draw=2),
    "elsewhere": place(1),
    "elsewhere again": place(2),
}
SEEN_TWICE = ["same direction", "opposite direction"]


@pytest.fixture(scope="module")
def clouds(world):
    return {name: world(p.seed).observe(p.T, p.centre, seed=p.draw) for name, p in PLACES.items()}


@pytest.fixture(scope="module")
def maps(clouds, gp_map):
    made = {name: gp_map(points) for name, points in clouds.items()}
    for name in ("target", *SEEN_TWICE):  # far from the origin of their frames
        made["utm " + name] = gp_map(clouds[name] + UTM)
    rng = np.random.default_rng(0)
    for number in (1, 2):
        points = np.c_[rng.uniform(-2.5, 2.5, (850, 2)), rng.normal(0, 0.005, 850)]
        made[f"flat {number}"] = gp_map(points)
    return made


@pytest.fixture(params=[STRICT, BY_INLIERS], ids=["evidence", "inliers"])
def either(request):
    """Settings for the one decision and the other."""
    return request.param


def errors(T, name, clouds):
    """At the middle of the source, in metres; and of roll, pitch and yaw, radians."""
    true, middle = PLACES[name].T, clouds[name].mean(axis=0)
    return transform(T, middle) - transform(true, middle), (parameters_of(T) - parameters_of(true))[3:]


@pytest.mark.parametrize("settings", [STRICT, BY_INLIERS, None], ids=["evidence", "inliers", "defaults"])
@pytest.mark.parametrize("name", SEEN_TWICE)
def test_register_finds_the_transform(maps, clouds, name, settings):
    loop = register(maps[name], maps["target"], settings, names=("b", "a"))
    assert loop
    assert loop.accepted
    assert (loop.source, loop.target) == ("b", "a")
    assert loop.inliers >= 10
    assert loop.ssd_ratio < 0.2
    assert loop.score > 0
    assert loop.reason
    offset, turn = errors(loop.T_target_source, name, clouds)
    assert np.hypot(*offset[:2]) < 0.06
    assert abs(offset[2]) < 0.01
    assert np.abs(turn[:2]).max() < np.radians(0.3)
    assert abs(turn[2]) < np.radians(1.5)
    R = loop.T_target_source[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("name", SEEN_TWICE)
def test_register_measures_the_overlap(maps, either, name):
    """Two squares of 5 m, 0.7 and 0.5 m apart; the maps' rectangles and margins differ a little."""
    loop = register(maps[name], maps["target"], either)
    shared = 4.3 * 4.5
    assert loop.overlap == pytest.approx(shared / (50 - shared), abs=0.06)


@pytest.mark.parametrize("name", SEEN_TWICE)
def test_covariance_is_one_and_fits_the_error(maps, clouds, either, name):
    loop = register(maps[name], maps["target"], either)
    covariance = loop.covariance
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-10, atol=1e-16)
    assert np.linalg.eigvalsh(covariance).min() > 0
    sigma = np.sqrt(np.diag(covariance))
    error = parameters_of(loop.T_target_source) - parameters_of(PLACES[name].T)
    assert (np.abs(error) < 5 * sigma).all()
    assert (sigma[:2] < 0.1).all()
    assert sigma[2] < 0.02
    assert (sigma[3:] < np.radians(3.0)).all()
    assert (sigma > 1e-5).all()


def test_covariance_is_calibrated_over_many_places(world):
    """Normalised squared error over noisy associations of known truth averages near its three degrees."""
    T = se2(0.5, -0.3, 2.0)
    source, target, values = world(0).map(T), world(0).map(), []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        keypoints, pivot = rng.uniform(-1.5, 1.5, (20, 2)), rng.uniform(-1, 1, 2)
        matched = transform(T, keypoints) + rng.normal(0, 0.05, (20, 2))
        estimate = fit_se2(keypoints, matched)
        moved = transform(estimate, keypoints)
        planar = covariance_of_inliers(moved - pivot, moved - matched, floor=1e-3)
        lifted, covariance = lift(source, target, estimate, pivot, planar)
        error = (parameters_of(lifted) - [0.5, -0.3, 0, 0, 0, 2.0])[[0, 1, 5]]
        planar = covariance[np.ix_([0, 1, 5], [0, 1, 5])]
        values.append(error @ np.linalg.solve(planar, error))
    assert 2.2 < np.mean(values) < 4.2  # 3 with a standard error of 0.25


@pytest.mark.parametrize(
    ("tilt", "yaw"), [((0.0, 0.0), 1.0), ((0.02, 0.0), 0.0), ((0.0, -0.03), 3.0), ((-0.02, 0.03), 1.5)]
)
def test_lift_finds_height_and_tilt(world, tilt, yaw):
    """The maps of exact points; the planar part is the truth, so that height and tilt stand alone."""
    T = se3(0.2, -0.1, 0.7, *tilt, yaw)
    xy = np.random.default_rng(0).uniform(-2, 2, (2, 500, 2))
    options = {"length_scale": 0.5, "variance": 0.01, "noise": 0.003, "resolution": 0.1}
    target = GradientMap.from_points(np.c_[xy[0], world(0).height(xy[0])], **options)
    seen = transform(inverse(T), np.c_[xy[1], world(0).height(xy[1])])
    source = GradientMap.from_points(seen, **options)
    planar = np.diag([0.01, 0.01, 0.01]) ** 2
    lifted, covariance = lift(source, target, se2(0.2, -0.1, yaw), np.array([0.3, 0.5]), planar)
    # A tilt moves ground at height z sideways by z times the tilt, which the planar fit cannot tell.
    np.testing.assert_allclose(parameters_of(lifted)[[0, 1]], [0.2, -0.1], rtol=0, atol=0.05)
    assert parameters_of(lifted)[2] == pytest.approx(0.7, abs=0.005)
    np.testing.assert_allclose(parameters_of(lifted)[3:], [*tilt, yaw], rtol=0, atol=0.004)
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_lift_without_shared_ground_leaves_height_and_tilt_open(world):
    T = se2(100.0, 0.0, 0.3)
    lifted, covariance = lift(world(0).map(), world(0).map(), T, np.ones(2), np.eye(3))
    np.testing.assert_allclose(lifted, se3(100.0, 0.0, 0.0, 0.0, 0.0, 0.3), rtol=0, atol=1e-12)
    assert np.isnan(covariance).all()


@pytest.mark.parametrize("settings", [STRICT, BY_INLIERS, None], ids=["evidence", "inliers", "defaults"])
@pytest.mark.parametrize("name", ["elsewhere", "elsewhere again"])
def test_register_rejects_unrelated_ground(maps, name, settings):
    for source, target in ((name, "target"), ("target", name)):
        candidate = register(maps[source], maps[target], settings)
        assert not candidate
        assert candidate.accepted is False
        assert len(candidate.reason.split()) > 3


@pytest.mark.parametrize("settings", [STRICT, BY_INLIERS, None], ids=["evidence", "inliers", "defaults"])
def test_register_rejects_flat_ground(maps, settings):
    candidate = register(maps["flat 1"], maps["flat 2"], settings)
    assert not candidate
    assert candidate.reason


def test_maps_without_a_feature_are_rejected(world, either):
    nothing = world(0).map()
    nothing = replace(nothing, mask=np.zeros_like(nothing.mask))
    for source, target in ((nothing, world(0).map()), (world(0).map(), nothing), (nothing, nothing)):
        candidate = register(source, target, either)
        assert not candidate
        assert np.isnan(candidate.T_target_source).all()
        assert np.isnan(candidate.covariance).all()
        assert candidate.T_target_source.shape == (4, 4)
        assert candidate.covariance.shape == (6, 6)
        assert candidate.inliers == 0
        assert candidate.overlap == 0.0
        assert ("association" if either is BY_INLIERS else "ground") in candidate.reason


def test_rejection_by_inliers_names_what_failed(maps):
    def because(**changes):
        return register(maps["same direction"], maps["target"], with_match(BY_INLIERS, **changes))

    assert because()
    few, differ = because(min_inliers=1000), because(max_ssd_ratio=1e-9)
    assert not few
    assert "inliers" in few.reason
    assert "1000" in few.reason
    assert not differ
    assert "SSD" in differ.reason
    # What was estimated stays, for whoever wants to look at it.
    assert np.isfinite(few.T_target_source).all()


@pytest.mark.parametrize("name", SEEN_TWICE)
def test_utm_clouds_have_their_transform_in_their_own_frames(maps, either, name):
    loop = register(maps[name], maps["target"], either)
    far = register(maps["utm " + name], maps["utm target"], either)
    assert far
    expected = SHIFT @ loop.T_target_source @ inverse(SHIFT)
    middle = np.array([*UTM[:2], 0.0])
    # Compared where the clouds are: 4000 km away a billionth of a radian is centimetres.
    np.testing.assert_allclose(
        transform(far.T_target_source, middle), transform(expected, middle), rtol=0, atol=0.02
    )
    np.testing.assert_allclose(
        parameters_of(far.T_target_source)[3:], parameters_of(expected)[3:], rtol=0, atol=2e-3
    )
    assert far.overlap == pytest.approx(loop.overlap, abs=0.01)


def test_utm_covariance_is_about_stated_points_near_the_clouds(maps, either):
    """By finite differences of the transform between frames that are moved to these points."""
    name = "same direction"
    loop = register(maps[name], maps["target"], either)
    far = register(maps["utm " + name], maps["utm target"], either)
    assert not loop.source_origin.any()
    assert not loop.target_origin.any()
    to_source, to_target = (translation(origin - UTM) for origin in (far.source_origin, far.target_origin))

    def carried(parameters):
        return parameters_of(inverse(to_target) @ se3(*parameters) @ to_source)

    here, step = parameters_of(loop.T_target_source), 1e-6 * np.eye(6)
    jacobian = np.array([(carried(here + d) - carried(here - d)) / 2e-6 for d in step]).T
    expected = jacobian @ loop.covariance @ jacobian.T
    np.testing.assert_allclose(np.diag(far.covariance), np.diag(expected), rtol=0.3)

    def correlation(covariance):
        return covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))

    np.testing.assert_allclose(correlation(far.covariance), correlation(expected), rtol=0, atol=0.1)
    error = parameters_of(far.T_local) - carried(parameters_of(PLACES[name].T))
    assert (np.abs(error) < 5 * np.sqrt(np.diag(far.covariance))).all()
    assert np.linalg.cond(far.covariance) < 1e8
    np.linalg.cholesky(far.information("gtsam"))


def test_the_local_transform_joins_the_stated_points(maps, either):
    far = register(maps["utm same direction"], maps["utm target"], either)
    points = UTM + np.random.default_rng(0).uniform(-3, 3, (20, 3))
    expected = transform(far.T_target_source, points) - far.target_origin
    np.testing.assert_allclose(
        transform(far.T_local, points - far.source_origin), expected, rtol=0, atol=1e-6
    )


def test_register_gives_the_same_bytes_again(maps, either):
    one, two = (register(maps["same direction"], maps["target"], either) for _ in range(2))
    assert one.T_target_source.tobytes() == two.T_target_source.tobytes()
    assert one.covariance.tobytes() == two.covariance.tobytes()
    assert one.reason == two.reason


def test_compare_is_register_of_what_is_mapped(maps, either):
    pair = {"b": maps["opposite direction"], "a": maps["target"]}
    known = compare(
        *(MapEntry.of(SubmapRecord(name), gradient_map, either) for name, gradient_map in pair.items()),
        either,
    )
    loop = register(*pair.values(), either, names=("b", "a"))
    assert (known.source, known.target) == ("b", "a")
    assert known.T_target_source.tobytes() == loop.T_target_source.tobytes()
    assert known.covariance.tobytes() == loop.covariance.tobytes()


def test_draws_hang_on_seed_and_names(maps):
    """Other draws, another subset of inliers perhaps; the same names and seed, the same draws."""
    few = with_match(BY_INLIERS, iterations=3)
    source, target = (MapEntry.of(SubmapRecord(""), maps[name], few) for name in ("same direction", "target"))
    associations = associate(source.features, target.features)

    def inliers(seed, names):
        named = (
            replace(entry, record=SubmapRecord(name))
            for entry, name in zip((source, target), names, strict=True)
        )
        found = align(*named, associations, few.model_copy(update={"seed": seed}))
        return b"" if found is None else found.inliers.tobytes()

    assert inliers(0, ("a", "b")) == inliers(0, ("a", "b"))
    assert len({inliers(seed, ("a", "b")) for seed in range(8)}) > 1
    assert len({inliers(0, (name, "b")) for name in "abcdefgh"}) > 1
    assert len({inliers(0, ("a", name)) for name in "abcdefgh"}) > 1


@pytest.mark.parametrize("kind", ["surf", "sift", "orb"])
def test_every_kind_of_feature_can_close_the_loop(world, by_inliers, kind):
    features_settings = by_inliers.features.model_copy(update={"kind": kind, "max_keypoints": 500})
    T = se2(0.4, -0.3, np.radians(25.0))
    size = {"origin": (-3.0, -3.0), "shape": (120, 120), "resolution": 0.05}
    source, target = world(0).map(T, **size), world(0).map(**size)
    loop = register(source, target, by_inliers.model_copy(update={"features": features_settings}))
    assert loop
    middle = np.zeros(3)
    assert transform(loop.T_target_source, middle)[:2] == pytest.approx([0.4, -0.3], abs=0.05)
    assert parameters_of(loop.T_target_source)[5] == pytest.approx(np.radians(25.0), abs=np.radians(1.0))


@pytest.mark.parametrize("offset", [(0.1, -0.08, 0.03), (-0.06, 0.05, -0.05), (0.0, 0.0, 0.0)])
def test_refinement_finds_the_pose_of_the_field(world, offset):
    """From a keypoint's accuracy to a hundredth of a pixel's size and angle, on maps in closed form."""
    target = world(0).map()
    T_world_source = se2(0.4, -0.3, 0.7)
    source = world(0).map(T_world_source)
    refined = refine(source, target, se2(*offset) @ T_world_source, Calibration()).T_target_source
    error = inverse(T_world_source) @ refined
    assert np.hypot(*error[:2, 2]) < 2e-3
    assert abs(yaw_of(error)) < 1e-3


def test_refinement_is_not_drawn_by_tilt_and_outliers(world):
    target = world(0).map()
    T_world_source = se2(0.4, -0.3, 0.7)
    source = world(0).map(T_world_source)
    boulder = np.zeros(source.mask.shape, np.float32)
    boulder[20:26, 20:26] = 1.5
    disturbed = replace(source, gradient_x=source.gradient_x + 0.05 + boulder)
    refined = refine(disturbed, target, se2(0.05, 0.05, 0.02) @ T_world_source, Calibration()).T_target_source
    error = inverse(T_world_source) @ refined
    assert np.hypot(*error[:2, 2]) < 1e-2
    assert abs(yaw_of(error)) < 5e-3


def test_maps_that_share_nothing_are_not_refined(world):
    assert refine(world(0).map(), world(0).map(), se2(100.0, 0.0, 0.3), Calibration()) is None
