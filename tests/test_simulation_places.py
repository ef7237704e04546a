"""Places that share no ground, and revisits that do; errors of sensors that are the same in every frame."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse, se3, transform, translation
from terrainloop.io.missions import load_mission
from terrainloop.simulation import SETUPS
from terrainloop.simulation.names import SENSORS
from terrainloop.simulation.places import APART, simulate_places, write_places
from terrainloop.simulation.sensors import SpinningLidar, StereoCamera
from terrainloop.simulation.terrain import Terrain

PLANE = Terrain(np.zeros((700, 700), dtype=np.float32), 0.04, (-14.0, -14.0))
CAMERA_POSE = se3(-8.0, 0.0, 1.1, 0.0, np.radians(20), 0.0)
LIDAR_POSE = se3(0.0, 0.0, 1.5, 0.0, 0.0, 0.0)
CLEAN = {"smooth_noise": 0.0, "white_noise": 0.0, "locking": 0.0, "blank": 0.0}
FRAME = replace(SETUPS["stereo"], submap_length=0.5)


def test_setups_are_those_named():
    assert tuple(SETUPS) == SENSORS


@pytest.mark.parametrize("world", ["mars", "craters", "built"])
def test_places_are_independent(world):
    made = simulate_places(world, 3, 4)
    x = np.arange(-4.5, 4.5, 0.1)
    xy = np.stack(np.meshgrid(x, x), axis=-1)
    slopes = np.stack([terrain.slope_at(xy)[..., 0].ravel() for terrain in made.terrains])
    assert np.abs(np.corrcoef(slopes)[np.triu_indices(4, 1)]).max() < 0.3
    assert made.place == (0, 1, 2, 3)
    assert (np.diff(made.truth[:, 0, 3]) > APART - 20).all()


@pytest.mark.parametrize("sensor", ["survey", FRAME])
def test_revisits_share_the_ground_that_the_truth_says(sensor):
    made = simulate_places("sparse_rocks", 1, 2, sensor, revisits=True)
    assert made.place == (0, 1, 0, 1)
    for first, second in ((0, 2), (1, 3)):
        T_first_second = inverse(made.truth[first]) @ made.truth[second]
        assert np.linalg.norm(T_first_second[:2, 3]) > 0.5
        moved = transform(T_first_second, made.clouds[second])
        distance, nearest = KDTree(made.clouds[first][:, :2]).query(moved[:, :2])
        shared = distance < 0.05
        assert shared.mean() > 0.3
        assert np.median(np.abs(made.clouds[first][nearest, 2] - moved[:, 2])[shared]) < 0.03


@pytest.mark.parametrize("sensor", ["survey", FRAME])
def test_the_truth_puts_clouds_on_the_terrain_of_their_place(sensor):
    made = simulate_places("boulders", 2, 2, sensor)
    for cloud, T_world_submap, place in zip(made.clouds, made.truth, made.place, strict=True):
        ground = transform(translation([-place * APART, 0.0, 0.0]) @ T_world_submap, cloud)
        error = ground[:, 2] - made.terrains[place].height_at(ground[:, :2])
        assert np.median(np.abs(error)) < 0.02
        assert np.linalg.norm(np.median(ground[:, :2], axis=0)) < 3.0  # about the middle of the place


def test_places_repeat_by_seed_whatever_their_number_and_the_visits():
    three, two = simulate_places("ruts", 5, 3), simulate_places("ruts", 5, 2, revisits=True)
    assert three.clouds[1].tobytes() == two.clouds[1].tobytes()
    assert three.truth[1].tobytes() == two.truth[1].tobytes()
    assert simulate_places("ruts", 6, 1).clouds[0].tobytes() != three.clouds[0].tobytes()


def test_written_places_are_a_mission(tmp_path):
    made = simulate_places("polygons", 0, 2, revisits=True)
    write_places(made, tmp_path / "mission")
    mission = load_mission(tmp_path / "mission")
    assert len(mission) == 4
    np.testing.assert_allclose(mission.truth.poses, made.truth, atol=1e-6)
    with pytest.raises(TerrainLoopError, match="new folder"):
        write_places(made, tmp_path / "mission")


@pytest.mark.parametrize("arguments", [{"world": "moon"}, {"sensor": "sonar"}, {"places": 0}, {"seed": -1}])
def test_bad_arguments_are_named(arguments):
    with pytest.raises(TerrainLoopError, match="expected"):
        simulate_places(**{"world": "flat", "places": 1, **arguments})


def _disparity_error(camera, seed):
    """Error of the disparity on a plane at the columns and rows that are seen."""
    points = camera.observe(PLANE, CAMERA_POSE, np.random.default_rng(seed))
    true_depth = 1.1 / -(points / points[:, :1] @ CAMERA_POSE[:3, :3].T)[:, 2]
    pixels = np.rint(camera.focal_length * -points[:, 1:] / points[:, :1] + [319.5, 239.5]).astype(int)
    error = np.full((camera.height, camera.width), np.nan)
    error[pixels[:, 1], pixels[:, 0]] = (
        camera.focal_length * camera.baseline * (1 / points[:, 0] - 1 / true_depth)
    )
    return error[:, :: camera.column_step]


def test_a_stereo_bias_is_the_same_in_every_frame_and_smooth():
    camera = replace(StereoCamera(), bias=0.2, **CLEAN)
    first, second = (_disparity_error(camera, seed) for seed in (0, 1))
    seen = np.isfinite(first) & np.isfinite(second)
    assert seen.mean() > 0.3
    np.testing.assert_allclose(first[seen], second[seen], atol=0.02)
    np.testing.assert_allclose(first[seen], camera.disparity_bias()[seen], atol=0.02)
    assert first[seen].std() == pytest.approx(0.2, rel=0.25)
    other = replace(camera, bias_seed=1).disparity_bias()
    assert abs(np.corrcoef(other.ravel(), camera.disparity_bias().ravel())[0, 1]) < 0.2
    field = camera.disparity_bias()
    steps = [np.corrcoef(field[:-n].ravel(), field[n:].ravel())[0, 1] for n in (8, 16, 40)]
    expected = np.exp(-(np.array([8, 16, 40]) ** 2) / (4 * 8.0**2))  # of white noise behind a Gaussian
    np.testing.assert_allclose(steps, expected, atol=0.15)


def test_a_lidar_bias_belongs_to_the_ring():
    lidar = SpinningLidar(range_noise=0.0, range_bias=0.03, elevation_bias_deg=0.2)
    range_bias, elevation_bias = lidar.ring_biases()
    assert range_bias.std() == pytest.approx(0.03, rel=0.4)
    assert np.degrees(elevation_bias).std() == pytest.approx(0.2, rel=0.4)
    nominal = np.radians(np.linspace(*lidar.elevations_deg, lidar.rings))
    for seed in (0, 1):
        points = lidar.observe(PLANE, LIDAR_POSE, np.random.default_rng(seed))
        distance = np.linalg.norm(points, axis=1)
        elevation = np.arcsin(points[:, 2] / distance)
        ring = np.abs(elevation[:, None] - nominal).argmin(axis=1)
        np.testing.assert_allclose(elevation, nominal[ring], atol=1e-9)
        true = 1.5 / -np.sin(nominal + elevation_bias)
        np.testing.assert_allclose(distance, (true + range_bias)[ring], atol=0.005)
    assert not np.allclose(replace(lidar, bias_seed=1).ring_biases()[0], range_bias)


def test_sensors_have_no_bias_by_default():
    errors = [_disparity_error(replace(StereoCamera(), **CLEAN), seed) for seed in (0, 1)]
    seen = np.isfinite(errors[0]) & np.isfinite(errors[1])
    assert np.abs(errors[0][seen]).max() < 0.02
    for bias in SpinningLidar().ring_biases():
        np.testing.assert_array_equal(bias, 0.0)
    assert SETUPS["biased_stereo"].sensor.bias > 0
    assert SETUPS["biased_lidar"].sensor.range_bias > 0
