import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from reproduce.appearance.ground import Ground, Sun, ground_of, light
from reproduce.appearance.looks import LOOKS
from reproduce.appearance.noise import value_noise
from reproduce.appearance.rendering import (
    GREY,
    Sky,
    _inverse_depth,
    colours_of,
    images_of,
    photograph,
)
from terrainloop.geometry import inverse, se3, transform
from terrainloop.simulation.missions import simulate_mission
from terrainloop.simulation.sensors import StereoCamera, cast_rays
from terrainloop.simulation.setups import SETUPS
from terrainloop.simulation.terrain import Terrain, make_terrain

CAMERA = StereoCamera(width=320, height=240, focal_length=228.5)  # half of it saves time
SUN = Sun(azimuth_deg=40.0, elevation_deg=35.0)


@functools.cache
def _ground(world="etna", seed=3):
    return ground_of(make_terrain(world, seed, 24.0, 0.035), world, seed)


def _pose(x, y, yaw):
    z = float(_ground().terrain.height_at([x, y]))
    return se3(x, y, z + 1.1, 0.0, np.radians(20.0), yaw)


def _photograph(T_world_camera, sun=SUN, seed=0):
    ground = _ground()
    return photograph(ground, T_world_camera, light(ground.terrain, sun), CAMERA, np.random.default_rng(seed))


def _correlation(a, b):
    return np.corrcoef(a.ravel(), b.ravel())[0, 1]


def _detail(image):
    return image - ndimage.gaussian_filter(image.astype(float), 8)


def _depth(T_world_camera):
    v, u = np.arange(CAMERA.height), np.arange(CAMERA.width)
    directions = CAMERA.directions(v, u) @ T_world_camera[:3, :3].T
    return directions, _inverse_depth(_ground(), T_world_camera[:3, 3], CAMERA, T_world_camera, directions)


def test_noise_has_unit_variance_and_slopes_that_are_its_differences():
    xy = np.random.default_rng(0).uniform(-40, 40, (200_000, 2))
    value, along_x, along_y = value_noise(xy, 0.1, 7)
    assert np.abs(value.mean()) < 0.01
    np.testing.assert_allclose([value.std(), along_x.std(), along_y.std()], 1.0, atol=0.01)
    step = np.array([1e-4, 0.0])
    for slope, shift in ((along_x, step), (along_y, step[::-1])):
        difference = value_noise(xy + shift, 0.1, 7)[0] - value_noise(xy - shift, 0.1, 7)[0]
        assert _correlation(difference, slope) > 0.999


def test_texture_does_not_repeat_itself():
    n = 1024  # a strip of 10 m by 0.5 m at 1 cm, against itself at every shift from 0.3 m on
    y, x = np.mgrid[:50, :n] * 0.01
    value = value_noise(np.stack([x.ravel(), y.ravel()], axis=-1), 0.04, 1)[0].reshape(50, n)
    shifts = [_correlation(value[:, : n - k], value[:, k:]) for k in range(30, n - 100)]
    assert np.abs(shifts).max() < 0.35
    assert _correlation(value, value_noise(np.stack([x.ravel(), y.ravel()], -1), 0.04, 2)[0]) < 0.1


def test_a_wall_casts_a_shadow_as_long_as_trigonometry_says():
    height = np.zeros((301, 301), np.float32)
    height[:, 150:153] = 0.4  # a wall along y at x = 0
    terrain = Terrain(height, 0.02, (-3.0, -3.0))
    lit = light(terrain, Sun(azimuth_deg=0.0, elevation_deg=30.0)).lit[150]  # the sun stands along +x
    x = -3.0 + 0.02 * np.arange(301)
    shadow = x[lit < 0.5]
    assert shadow.min() == pytest.approx(-0.4 / np.tan(np.radians(30.0)), abs=0.05)
    assert shadow.max() < 0.02
    slanting = light(terrain, Sun(azimuth_deg=60.0, elevation_deg=30.0)).lit[150]
    assert x[slanting < 0.5].min() == pytest.approx(-0.4 / np.tan(np.radians(30.0)) / 2, abs=0.05)


def test_plain_ground_obeys_lambert():
    slope = 0.2
    x = -3.0 + 0.05 * np.arange(121)
    terrain = Terrain(np.tile(slope * x, (121, 1)).astype(np.float32), 0.05, (-3.0, -3.0))
    plain = replace(LOOKS["etna"], contrast=0.0, roughness=0.0, stones=())
    ground = Ground(terrain, plain, ground_of(terrain, "etna", 0).nodes, 0)
    seen = ground.brightness(np.array([[0.3, 0.4]]), 0.001, light(terrain, SUN))
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1)
    expected = plain.sky_light + (1 - plain.sky_light) * normal @ SUN.direction
    np.testing.assert_allclose(seen[0], expected * np.array(plain.tint), rtol=1e-4)


def test_detail_finer_than_the_footprint_fades():
    ground, shone = _ground(), light(_ground().terrain, SUN)
    xy = np.random.default_rng(1).uniform(-5, 5, (20_000, 2))
    deviations = [(ground.brightness(xy, footprint, shone) @ GREY).std() for footprint in (0.002, 0.02, 0.5)]
    assert deviations[0] > 1.2 * deviations[1] > 1.5 * deviations[2]


def test_depth_is_that_of_a_ray_through_every_pixel():
    T = _pose(-3.0, 1.0, 0.4)
    directions, fine = _depth(T)
    lengths = np.linalg.norm(directions, axis=-1)
    some = np.zeros(fine.shape, dtype=bool)
    some[::3, ::2] = True
    rays = (directions / lengths[..., None])[some]
    cast = cast_rays(_ground().terrain, T[:3, 3], rays, 8.0)
    error = np.abs(lengths[some] / fine[some] - cast)[~np.isnan(cast)]
    assert np.median(error) < 0.005
    assert (error > 0.1).mean() < 0.01
    assert (fine[0] <= 0).all()  # the sky
    assert (fine[-1] > 0.4).all()


def test_images_show_the_same_ground_where_geometry_says():
    T_a, T_b = _pose(-3.0, 1.0, 0.4), _pose(-2.9, 1.05, 0.45)
    directions, inverse_depth = _depth(T_a)
    rows, columns = np.mgrid[130:235:2, 20:300:2]
    world = T_a[:3, 3] + directions[rows, columns] / inverse_depth[rows, columns][..., None]
    x, y, z = np.moveaxis(transform(inverse(T_b), world), -1, 0)
    u = -y / x * CAMERA.focal_length + 0.5 * (CAMERA.width - 1)
    v = -z / x * CAMERA.focal_length + 0.5 * (CAMERA.height - 1)
    inside = (u > 5) & (u < CAMERA.width - 6) & (v < CAMERA.height - 6)
    first, second = _detail(_photograph(T_a)), _detail(_photograph(T_b, seed=1))
    seen_b = ndimage.map_coordinates(second, [v[inside], u[inside]], order=1)
    seen_a = first[rows, columns][inside]
    assert _correlation(seen_a, seen_b) > 0.75
    off = ndimage.map_coordinates(second, [v[inside], u[inside] + 8], order=1)
    assert _correlation(seen_a, off) < 0.2


def test_the_sun_changes_the_look():
    T = _pose(-3.0, 1.0, 0.4)
    same, later, evening = (
        _detail(_photograph(T, Sun(40.0 + turn, 35.0), seed=2))[130:] for turn in (0.0, 20.0, 120.0)
    )
    first = _detail(_photograph(T))[130:]
    at_once, after, at_last = (_correlation(first, image) for image in (same, later, evening))
    assert at_once > 0.9
    assert at_once > after > at_last + 0.2


@pytest.mark.parametrize("world", ["etna", "morocco", "mars", "flat", "ripples", "craters"])
def test_every_world_is_well_exposed(world):
    ground = ground_of(make_terrain(world, 1, 24.0, 0.1), world, 1)
    image = photograph(
        ground,
        se3(0, 0, 1.5, 0, np.radians(20), 0),
        light(ground.terrain, SUN),
        CAMERA,
        np.random.default_rng(0),
    )
    assert image.shape == (240, 320)
    assert image.dtype == np.uint8
    assert 70 < image[100:].mean() < 150
    assert 5 < _detail(image)[100:].std() < 40
    assert (image == 255).mean() < 0.01


@pytest.fixture(scope="module")
def mission():
    return simulate_mission("mars", 1, 1)


def test_images_of_a_mission_are_its_frames(mission):
    (few,), (more,) = images_of(mission, every=13), images_of(mission, every=7)
    assert (len(few), len(more)) == (2, 2)
    np.testing.assert_array_equal(few[0], more[0])
    ground = ground_of(mission.terrain, "mars", 1)
    camera = mission.frames[0, 13] @ SETUPS["stereo"].T_body_sensor
    (sun,) = Sky().suns(mission)
    left = SETUPS["stereo"].sensor
    again = photograph(ground, camera, light(mission.terrain, sun), left, np.random.default_rng(5))
    assert _correlation(_detail(again), _detail(few[1])) > 0.9  # but for noise and exposure


def test_a_lidar_takes_no_images(mission):
    assert images_of(replace(mission, sensor="lidar")) == [()]


def test_colours_are_those_of_the_ground(mission):
    (colours,) = colours_of(mission)
    assert colours.shape == (len(mission.clouds[0]), 3)
    assert colours.dtype == np.uint8
    red, green, blue = colours.mean(axis=0)
    assert red > green > blue  # Mars
    (again,) = colours_of(mission)
    np.testing.assert_array_equal(colours, again)
    other = colours_of(replace(mission, seed=2))[0]
    assert _correlation(colours[:, 0], other[:, 0]) < 0.9


def test_frames_stand_on_the_terrain(mission):
    assert mission.frames.shape == (1, 14, 4, 4)
    xyz = mission.frames[0, :, :3, 3]
    assert np.abs(xyz[:, 2] - mission.terrain.height_at(xyz[:, :2])).max() < 0.15
    np.testing.assert_allclose(mission.truth[0][:3, 3], xyz[0], atol=1e-9)
