import dataclasses

import numpy as np
import pytest

from terrainloop.geometry import se3, transform
from terrainloop.simulation.sensors import SpinningLidar, StereoCamera, cast_rays
from terrainloop.simulation.terrain import Terrain, make_terrain


@pytest.fixture(scope="module")
def mars():
    return make_terrain("mars", 0, 24.0, 0.04)


@pytest.fixture(scope="module")
def plane():
    return Terrain(np.zeros((700, 700), dtype=np.float32), 0.04, (-14.0, -14.0))


def _camera_pose(terrain, x=-8.0, y=0.0):
    return se3(x, y, float(terrain.height_at([x, y])) + 1.1, 0.0, np.radians(20), 0.3)


def _random_rays(n):
    rng = np.random.default_rng(1)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.6, -0.05, n)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def test_rays_first_meet_the_terrain_where_they_are_said_to(mars):
    origin, rays = np.array([0.3, -0.2, float(mars.height_at([0.3, -0.2])) + 1.0]), _random_rays(3000)
    distances = cast_rays(mars, origin, rays, 9.0)
    hit = ~np.isnan(distances)
    assert 0.5 < hit.mean() < 1.0
    points = origin + distances[hit, None] * rays[hit]
    np.testing.assert_allclose(points[:, 2], mars.height_at(points[:, :2]), atol=2e-3)
    # Independent check: walk every ray in 5 mm steps. Only a corner thinner than a casting step may differ.
    steps = np.arange(0.0, 9.0, 0.005)
    walked = origin + steps[:, None, None] * rays
    under = walked[..., 2] <= mars.height_at(walked[..., :2])
    first = np.where(under.any(axis=0), steps[under.argmax(axis=0)], np.nan)
    agree = np.isclose(first, distances, atol=0.01, equal_nan=True)
    assert agree.mean() > 0.99


def test_a_wall_hides_what_is_behind_it():
    height = np.zeros((400, 400), dtype=np.float32)
    height[:, 250:255] = 0.5
    wall = Terrain(height, 0.04, (-8.0, -8.0))
    angles = np.linspace(-0.6, -0.05, 400)
    rays = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=-1)
    distances = cast_rays(wall, np.array([0.0, 0.0, 1.0]), rays, 7.0)
    x = distances * rays[:, 0]
    shadow_end = 2.16 / 0.5  # the far edge of the wall, seen from 1 m, casts its shadow to here
    assert not ((x > 2.22) & (x < shadow_end - 0.05)).any()
    assert (x > shadow_end).any()
    assert (x < 1.95).any()


def test_rays_to_the_sky_or_off_the_terrain_miss(mars):
    rays = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.05], [0.995, 0.0, -0.09]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert np.isnan(cast_rays(mars, np.array([8.0, 0.0, mars.height.max() + 2.0]), rays, 30.0)).all()


def _quiet(**changes):
    silent = {"smooth_noise": 0.0, "white_noise": 0.0, "locking": 0.0, "blank": 0.0}
    return dataclasses.replace(StereoCamera(), **{**silent, **changes})


def test_a_camera_without_noise_sees_the_ground(mars):
    pose = _camera_pose(mars)
    points = _quiet().observe(mars, pose, np.random.default_rng(0))
    world = transform(pose, points)
    error = world[:, 2] - mars.height_at(world[:, :2])
    assert len(points) > 20_000
    assert np.quantile(np.abs(error), 0.98) < 2e-3  # the rest are flying pixels
    assert points[:, 0].max() <= 8.0


@pytest.mark.parametrize("noise", [{"smooth_noise": 0.1}, {"white_noise": 0.1}])
def test_depth_error_grows_with_range_squared(plane, noise):
    pose = se3(-8.0, 0.0, 1.1, 0.0, np.radians(20), 0.0)
    camera = _quiet(max_range=10.0, **noise)
    ranges, errors = [], []
    for seed in range(4):
        points = camera.observe(plane, pose, np.random.default_rng(seed))
        rays = points @ pose[:3, :3].T
        truth = points[:, 0] * (-1.1 / rays[:, 2])
        ranges.append(truth)
        errors.append(points[:, 0] - truth)
    ranges, errors = np.concatenate(ranges), np.concatenate(errors)
    centres = np.geomspace(2.0, 7.5, 8)
    spread = [errors[np.abs(ranges / c - 1) < 0.05].std() for c in centres]
    exponent, _ = np.polyfit(np.log(centres), np.log(spread), 1)
    assert exponent == pytest.approx(2.0, abs=0.15)
    expected = 0.1 * centres**2 / (camera.focal_length * camera.baseline)
    np.testing.assert_allclose(spread, expected, rtol=0.2)


def test_disparity_errors_of_neighbours_agree_and_of_far_pixels_do_not():
    error = StereoCamera()._disparity_error(np.full((480, 160), 10.0), np.random.default_rng(0))
    assert np.corrcoef(error[:-2].ravel(), error[2:].ravel())[0, 1] > 0.8
    assert abs(np.corrcoef(error[:-40].ravel(), error[40:].ravel())[0, 1]) < 0.1
    assert error.std() == pytest.approx(np.hypot(0.15, 0.05), rel=0.1)


def test_the_camera_loses_points_without_texture_and_outside_the_other_image(plane):
    pose, rng = se3(0.0, 0.0, 1.1, 0.0, np.radians(20), 0.0), np.random.default_rng
    everything = _quiet().observe(plane, pose, rng(0))
    blank = _quiet(blank=0.2).observe(plane, pose, rng(0))
    assert 0.7 < len(blank) / len(everything) < 0.9
    near = everything[everything[:, 0] < 2.0]
    assert near[:, 1].max() < -near[:, 1].min() - 0.1  # the left camera sees farther to the left than both


def test_lidar_measures_all_around_with_its_noise(plane):
    lidar, pose = SpinningLidar(), se3(0.0, 0.0, 1.5, 0.0, 0.0, 0.7)
    points = lidar.observe(plane, pose, np.random.default_rng(0))
    distances = np.linalg.norm(points, axis=1)
    error = distances - distances * 1.5 / -points[:, 2]
    assert error.std() == pytest.approx(0.02, rel=0.1)
    counts, _ = np.histogram(np.arctan2(points[:, 1], points[:, 0]), 8, (-np.pi, np.pi))
    assert counts.min() > 0.8 * counts.max()
    per_ring = np.unique(np.round(np.degrees(np.arcsin(points[:, 2] / distances)), 3), return_counts=True)[1]
    assert per_ring[0] == 1200  # steep rings return all, grazing ones lose some
    assert per_ring[-1] < 1100


def test_observations_repeat_by_seed(mars):
    for sensor in (StereoCamera(), SpinningLidar()):
        first, again, other = (
            sensor.observe(mars, _camera_pose(mars), np.random.default_rng(seed)) for seed in (0, 0, 1)
        )
        assert first.tobytes() == again.tobytes()
        assert first.tobytes() != other.tobytes()
