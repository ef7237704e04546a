"""Keypoints of gradient maps: metres, the map's sense of rotation, masks, and the same for all kinds."""

import pickle

import numpy as np
import pytest

from terrainloop.config import FeatureSettings
from terrainloop.features import extract_features
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gradient_map import GradientMap

KINDS = {"surf": (64, np.float32), "sift": (128, np.float32), "orb": (32, np.uint8)}
ORIGIN, RESOLUTION = np.array([-4.0, 7.5]), 0.05
SIDE = 201
EVERYWHERE = np.ones((SIDE, SIDE), bool)

all_kinds = pytest.mark.parametrize("kind", KINDS)


def bumps(yaw=0.0, seed=0):
    """Magnitude map of 60 round bumps of many sizes, turned counter-clockwise about the map's centre."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-4.2, 4.2, (2, 60))
    x, y = np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y
    size, height = rng.uniform(0.15, 0.5, 60), rng.uniform(0.3, 1.0, 60)
    axis = (np.arange(SIDE) - SIDE // 2) * RESOLUTION  # of both x (columns) and y (rows)
    near_x = np.exp(-0.5 * ((axis - x[:, None]) / size[:, None]) ** 2)
    near_y = np.exp(-0.5 * ((axis - y[:, None]) / size[:, None]) ** 2)
    return np.einsum("n,ny,nx->yx", height, near_y, near_x)


def extract(magnitude, mask=EVERYWHERE, kind="surf", **settings):
    """Of a map whose gradient points along x everywhere, with this magnitude."""
    image = np.asarray(magnitude, dtype=np.float32)
    flat = np.zeros_like(image)
    gradient_map = GradientMap(
        flat, image, flat, flat + 1, flat + 1, mask, tuple(ORIGIN), RESOLUTION, Hyperparameters(0.4, 1.0, 0.1)
    )
    return extract_features(gradient_map, FeatureSettings(kind=kind, **settings))


def pixels(features):
    return np.rint((features.positions - ORIGIN) / RESOLUTION).astype(int)


@all_kinds
def test_shapes_and_types(kind):
    features = extract(bumps(), kind=kind)
    width, dtype = KINDS[kind]
    count = len(features)
    assert count > 40
    assert features.kind == kind
    assert features.positions.shape == (count, 2)
    for values in (features.scales, features.orientations, features.responses):
        assert values.shape == (count,)
        assert values.dtype == np.float64
    assert features.descriptors.shape == (count, width)
    assert features.descriptors.dtype == dtype
    assert (np.diff(features.responses) <= 0.0).all()
    assert (np.abs(features.orientations) <= np.pi).all()


@pytest.mark.parametrize("kind", ["surf", "sift"])
def test_bump_is_found_in_metres(kind):
    x, y, sigma = -1.23, 9.87, 0.3
    cols, rows = ORIGIN[0] + RESOLUTION * np.arange(SIDE), ORIGIN[1] + RESOLUTION * np.arange(120)
    bump = np.exp(-0.5 * (((cols - x) / sigma) ** 2 + ((rows[:, None] - y) / sigma) ** 2))
    features = extract(bump, np.ones(bump.shape, bool), kind=kind, max_keypoints=2)
    np.testing.assert_allclose(features.positions[:1], [[x, y]], atol=0.2 * RESOLUTION)
    assert 0.6 < features.scales[0] / sigma < 1.4


@all_kinds
def test_arrays_are_read_only(kind):
    features = extract(bumps(), kind=kind, max_keypoints=20)
    for each in (features, pickle.loads(pickle.dumps(features))):
        for name in ("positions", "scales", "orientations", "responses", "descriptors"):
            with pytest.raises(ValueError, match="read-only"):
                getattr(each, name)[0] = 0


@all_kinds
@pytest.mark.parametrize("yaw", [np.pi / 2, -np.pi / 2])
def test_turning_the_ground_counter_clockwise_turns_the_orientations(kind, yaw):
    before, after = (extract(bumps(angle), kind=kind, max_keypoints=150) for angle in (0.0, yaw))
    centre = ORIGIN + RESOLUTION * (SIDE // 2)
    c, s = np.cos(yaw), np.sin(yaw)
    expected = (before.positions - centre) @ np.array([[c, s], [-s, c]]) + centre
    distance = np.linalg.norm(expected[:, None] - after.positions, axis=2)
    # SIFT gives a place several orientations: any of them may be the one.
    same = (distance < RESOLUTION) & (np.abs(before.scales[:, None] / after.scales - 1.0) < 0.05)
    turn = np.angle(np.exp(1j * (after.orientations - before.orientations[:, None])))
    turned = same & (np.abs(turn - yaw) < 0.05)
    assert same.any(axis=1).mean() > 0.9
    assert turned.any(axis=1).mean() > 0.9


@all_kinds
@pytest.mark.parametrize("direction", np.radians([0.0, 60.0, 135.0, -100.0]))
def test_orientation_points_up_the_slope(kind, direction):
    x, y = np.meshgrid(*[(np.arange(SIDE) - SIDE // 2) * RESOLUTION] * 2)
    slope = 0.2 * (np.cos(direction) * x + np.sin(direction) * y) + 1.5
    bump = np.exp(-0.5 * (x**2 + y**2) / 0.2**2) if kind != "orb" else (np.hypot(x, y) < 0.2)
    features = extract(slope + 0.3 * bump, kind=kind)
    middle = np.linalg.norm(features.positions - ORIGIN - RESOLUTION * (SIDE // 2), axis=1) < 0.1
    assert middle.any()
    error = np.angle(np.exp(1j * (features.orientations[middle] - direction)))
    assert np.abs(error).min() < np.radians(10.0)


@all_kinds
def test_keypoints_keep_within_the_mask(kind):
    mask = np.zeros((SIDE, SIDE), bool)
    mask[50:150, 40:120] = True
    mask[90:100] = False
    features = extract(bumps(), mask, kind=kind)
    cols, rows = pixels(features).T
    assert 5 < len(features) < len(extract(bumps(), kind=kind))
    assert mask[rows, cols].all()


@all_kinds
def test_the_strongest_are_kept(kind):
    some, all_of_them = extract(bumps(), kind=kind, max_keypoints=25), extract(bumps(), kind=kind)
    if kind == "orb":  # OpenCV spreads the number over the sizes, and may not fill it
        assert 20 <= len(some) <= 25
    else:
        assert len(some) == 25
        np.testing.assert_array_equal(some.positions, all_of_them.positions[:25])
        np.testing.assert_array_equal(some.descriptors, all_of_them.descriptors[:25])


@all_kinds
def test_the_same_map_gives_the_same_bytes(kind):
    first, second = extract(bumps(), kind=kind), extract(bumps().astype(np.float32), kind=kind)
    for name in ("positions", "scales", "orientations", "responses", "descriptors"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@all_kinds
def test_flat_ground_gives_as_many_keypoints_as_rough_ground(kind):
    rough, gentle = extract(bumps(), kind=kind), extract(1e-3 * bumps(), kind=kind)
    assert len(gentle) == pytest.approx(len(rough), rel=0.02)


@all_kinds
@pytest.mark.parametrize("value", [0.0, 0.7])
def test_featureless_ground_gives_none(kind, value):
    features = extract(np.full((SIDE, SIDE), value), kind=kind)
    width, dtype = KINDS[kind]
    assert len(features) == 0
    assert features.positions.shape == (0, 2)
    assert features.descriptors.shape == (0, width)
    assert features.descriptors.dtype == dtype


@all_kinds
def test_nothing_trustworthy_or_a_tiny_map_gives_none(kind):
    assert len(extract(bumps(), ~EVERYWHERE, kind=kind)) == 0
    for shape in [(1, 1), (3, 9), (1, 300)]:
        assert len(extract(np.random.default_rng(0).random(shape), np.ones(shape, bool), kind=kind)) == 0
