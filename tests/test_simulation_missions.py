import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import yaml

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse, transform, yaw_of
from terrainloop.io.clouds import read_cloud
from terrainloop.io.missions import load_mission
from terrainloop.io.trajectories import read_trajectory
from terrainloop.simulation.missions import simulate_mission, thin, write_mission
from terrainloop.simulation.odometry import Drift, estimate, true_poses
from terrainloop.simulation.paths import revisiting_path
from terrainloop.simulation.setups import SETUPS
from terrainloop.simulation.terrain import make_terrain

_simulated = functools.cache(simulate_mission)


@pytest.fixture(scope="module")
def mission():
    return _simulated("mars", 1, 2)


@pytest.fixture(scope="module")
def drive():
    """Path and true poses of 16 submaps on a coarse terrain."""
    path = revisiting_path(np.random.default_rng(0), 112.0, 0.5)
    return true_poses(make_terrain("etna", 0, 50.0, 0.1), path)


def _view_boxes(path, frames, reach=8.0, half_angle=0.61):
    """Axis-aligned boxes (M, 4) around what a camera sees of flat ground from each submap's frames."""
    bearings = path.heading[:, None] + np.linspace(-half_angle, half_angle, 7)
    directions = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
    seen = path.xy[:, None] + reach / np.cos(bearings - path.heading[:, None])[..., None] * directions
    seen = np.concatenate([seen, path.xy[:, None]], axis=1).reshape(-1, frames * 8, 2)
    return np.concatenate([seen.min(axis=1), seen.max(axis=1)], axis=1)


def _iou(boxes):
    low, high = np.maximum(boxes[:, None, :2], boxes[:, :2]), np.minimum(boxes[:, None, 2:], boxes[:, 2:])
    shared = np.clip(high - low, 0, None).prod(-1)
    area = (boxes[:, 2:] - boxes[:, :2]).prod(-1)
    return shared / (area[:, None] + area - shared)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("submaps", [16, 30, 60])
def test_the_path_revisits_in_both_directions_and_crosses(submaps, seed):
    path = revisiting_path(np.random.default_rng(seed), submaps * 7.0, 0.5)
    first, second = np.triu_indices(submaps, 2)
    overlap = _iou(_view_boxes(path, 14))[first, second]
    heading = path.heading[::14]
    turn = np.abs((heading[second] - heading[first] + np.pi) % (2 * np.pi) - np.pi)
    loops = np.degrees(turn[overlap > 0.3])
    assert (loops < 45).sum() >= 2
    assert (loops > 135).sum() >= 2
    assert ((loops >= 45) & (loops <= 135)).sum() >= 2
    assert (overlap == 0).mean() > (0.3 if submaps == 16 else 0.5)
    assert {"first", "turn", "opposite", "same"} == set(path.legs)


@pytest.mark.parametrize("submaps", [1, 8, 16, 60])
def test_the_path_is_drivable(submaps):
    path = revisiting_path(np.random.default_rng(2), submaps * 7.0, 0.5)
    steps = np.diff(path.xy, axis=0)
    assert len(path.xy) == len(path.heading) == len(path.legs) == submaps * 14
    lengths = np.linalg.norm(steps, axis=1)
    assert 0.47 < lengths.min() <= lengths.max() < 0.501
    along = np.arctan2(steps[:, 1], steps[:, 0])
    off = (along - 0.5 * (np.unwrap(path.heading)[1:] + np.unwrap(path.heading)[:-1]) + np.pi) % (2 * np.pi)
    assert np.abs(off - np.pi).max() < np.radians(5)
    turns = np.abs(np.diff(np.unwrap(path.heading)))
    assert turns.max() < 0.5 / 0.8  # never tighter than 0.8 m


def test_later_passes_run_beside_the_first():
    path = revisiting_path(np.random.default_rng(3), 420.0, 0.5)
    legs = np.array(path.legs)
    first = path.xy[legs == "first"]
    for leg in ("same", "opposite"):
        aside = [np.linalg.norm(first - point, axis=1).min() for point in path.xy[legs == leg]]
        assert 0.2 < np.median(aside) < 1.6


def test_the_rover_stands_on_the_ground(drive):
    terrain = make_terrain("etna", 0, 50.0, 0.1)
    assert np.abs(drive[:, 2, 3] - terrain.height_at(drive[:, :2, 3])).max() < 0.15
    ahead = transform(np.eye(4), drive[:, :3, 3] + 0.4 * drive[:, :3, 0])
    assert np.abs(ahead[:, 2] - terrain.height_at(ahead[:, :2])).mean() < 0.05
    np.testing.assert_allclose(np.linalg.det(drive[:, :3, :3]), 1.0, atol=1e-9)


def test_without_errors_odometry_is_the_truth(drive):
    made = estimate(drive, 14, Drift(0.0, 0.0, 10.0, 0.0, 0.0), np.random.default_rng(0))
    np.testing.assert_allclose(made.odometry, made.truth, atol=1e-9)
    for i in (0, 13, 14, 100, 223):
        np.testing.assert_allclose(made.truth[i // 14] @ made.local[i], drive[i], atol=1e-9)
        assert made.odometry[i // 14][2, 2] == 1.0


def test_truth_puts_each_first_frame_where_it_was(drive):
    made = estimate(drive, 14, Drift(jitter_deg=0.0), np.random.default_rng(0))
    for m in range(16):
        np.testing.assert_allclose(made.truth[m] @ made.local[14 * m], drive[14 * m], atol=1e-9)


def test_drift_and_tilt_are_of_the_order_stated(drive):
    steps, turns, tilts = [], [], []
    for seed in range(40):
        made = estimate(drive, 14, Drift(), np.random.default_rng(seed))
        last = inverse(made.truth[0]) @ drive[13]
        travelled = np.linalg.norm(np.diff(drive[:14, :3, 3], axis=0), axis=1).sum()
        steps.append((made.local[13] - last)[:3, 3] / travelled)
        turns.append(np.degrees(yaw_of(made.local[13] @ inverse(last))) / travelled)
        tilts.append(np.degrees(np.arccos(np.clip(made.truth[:, 2, 2], -1, 1))))
    assert 0.004 < np.sqrt(np.mean(np.square(steps))) < 0.010
    assert 0.05 < np.sqrt(np.mean(np.square(turns))) < 0.15
    assert np.sqrt(np.mean(np.square(tilts))) == pytest.approx(0.4 * np.sqrt(2), rel=0.15)


def test_drift_adds_up_over_the_mission(drive):
    ends = [estimate(drive, 14, Drift(), np.random.default_rng(seed)) for seed in range(20)]
    errors = [np.linalg.norm((made.odometry[-1] - made.truth[-1])[:3, 3]) for made in ends]
    assert 0.3 < np.median(errors) < 4.0


@pytest.mark.parametrize(
    ("world", "sensor"),
    [
        *((world, "stereo") for world in ("etna", "morocco", "mars", "flat", "ripples", "built")),
        ("etna", "lidar"),
    ],
)
def test_worlds_and_sensors_make_missions(world, sensor):
    mission = _simulated(world, 2, 1, sensor)
    (cloud,) = mission.clouds
    assert cloud.dtype == np.float32
    assert 50_000 < len(cloud) < 200_000
    assert np.isfinite(cloud).all()
    assert mission.odometry.shape == mission.truth.shape == (1, 4, 4)
    assert mission.legs == ("first",)
    world_points = transform(mission.truth[0], cloud)
    assert mission.terrain.contains(world_points[:, :2]).mean() > 0.999
    close = np.linalg.norm(cloud[:, :2], axis=1) < 3.5
    error = world_points[close, 2] - mission.terrain.height_at(world_points[close, :2])
    assert np.median(np.abs(error)) < (0.012 if sensor == "stereo" else 0.03)


def test_error_grows_away_from_the_start(mission):
    cloud = mission.clouds[0]
    points = transform(mission.truth[0], cloud)
    error = np.abs(points[:, 2] - mission.terrain.height_at(points[:, :2]))
    distance = np.linalg.norm(cloud[:, :2], axis=1)
    near, far = np.median(error[distance < 3.5]), np.median(error[distance > 8.0])
    assert near < 0.01
    assert 2 * near < far < 0.1


def test_a_submap_looks_ahead_from_the_ground_it_starts_on(mission):
    for cloud in mission.clouds:
        assert np.median(cloud[:, 0]) > 2
        assert 9 < np.ptp(cloud[:, 0]) < 20
        assert 6 < np.ptp(cloud[:, 1]) < 20
        near = np.linalg.norm(cloud[:, :2], axis=1) < 2.5
        assert abs(np.median(cloud[near, 2])) < 0.3


def test_same_seed_same_mission_whatever_the_threads(mission, monkeypatch):
    single = functools.partial(ThreadPoolExecutor, max_workers=1)
    monkeypatch.setattr("terrainloop.simulation.missions.ThreadPoolExecutor", single)
    seen = []
    again = simulate_mission("mars", 1, 2, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    assert all(a.tobytes() == b.tobytes() for a, b in zip(again.clouds, mission.clouds, strict=True))
    assert again.odometry.tobytes() == mission.odometry.tobytes()
    other = _simulated("mars", 2, 1, "stereo")
    assert other.clouds[0].tobytes() != mission.clouds[0].tobytes()


def test_a_written_mission_reads_back(mission, tmp_path):
    write_mission(mission, tmp_path)
    names = sorted(file.name for file in (tmp_path / "clouds").iterdir())
    assert names == ["000000.ply", "000001.ply"]
    np.testing.assert_array_equal(read_cloud(tmp_path / "clouds" / names[1]).points, mission.clouds[1])
    for name, poses in (("odometry", mission.odometry), ("truth", mission.truth)):
        np.testing.assert_allclose(read_trajectory(tmp_path / f"{name}.tum").poses, poses, atol=1e-9)
    said = yaml.safe_load((tmp_path / "simulation.yaml").read_text())
    assert (said["world"], said["seed"], said["sensor"], said["submaps"]) == ("mars", 1, "stereo", 2)
    assert said["setup"]["sensor"]["baseline"] == SETUPS["stereo"].sensor.baseline
    assert said["legs"] == list(mission.legs)


def test_thinning_averages_each_voxel():
    points = np.array([[0.0, 0.0, 0.0], [0.02, 0.04, 0.06], [0.5, 0.0, 0.0]])
    np.testing.assert_allclose(thin(points, 0.1), [[0.01, 0.02, 0.03], [0.5, 0.0, 0.0]])


@pytest.mark.parametrize(
    "arguments", [{"world": "moon"}, {"sensor": "sonar"}, {"submaps": 0}, {"submaps": -3}, {"seed": -1}]
)
def test_bad_arguments_are_named(arguments):
    with pytest.raises(TerrainLoopError, match="expected"):
        simulate_mission(**{"submaps": 1, **arguments})


def _shortened(mission, count):
    changes = {
        name: getattr(mission, name)[:count] for name in ("clouds", "odometry", "truth", "legs", "frames")
    }
    return replace(mission, **changes)


def test_a_shorter_mission_replaces_a_longer_one_and_leaves_the_rest(mission, tmp_path):
    write_mission(mission, tmp_path)
    for name in ("notes.txt", "map.npz", "clouds/readme.md"):
        (tmp_path / name).write_text("the user's")
    write_mission(_shortened(mission, 1), tmp_path)
    assert len(load_mission(tmp_path)) == 1
    files = sorted(file.relative_to(tmp_path).as_posix() for file in tmp_path.rglob("*") if file.is_file())
    ours = ["clouds/000000.ply", "odometry.tum", "simulation.yaml", "truth.tum"]
    assert files == sorted([*ours, "notes.txt", "map.npz", "clouds/readme.md"])
    write_mission(mission, tmp_path)
    assert len(load_mission(tmp_path)) == 2


@pytest.mark.parametrize(
    ("name", "described"),
    [
        ("clouds/scan.pcd", False),
        ("clouds/000000.ply", False),
        ("scan.LAZ", False),
        ("odometry.tum", False),
        ("clouds/000002.ply", True),
        ("clouds/0.ply", True),
        ("clouds/notes.csv", True),
    ],
)
def test_what_simulate_did_not_write_is_neither_deleted_nor_joined(mission, tmp_path, name, described):
    if described:
        write_mission(mission, tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("the user's")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    with pytest.raises(TerrainLoopError, match=f"{name}, which.*did not write.*another folder"):
        write_mission(_shortened(mission, 1), tmp_path)
    assert before == {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}


@pytest.mark.parametrize("content", ["submaps: 99", "[1, 2]", "words", "{", "submaps: 1" + "0" * 300, ""])
def test_a_description_of_something_else_makes_nothing_ours(mission, tmp_path, content):
    write_mission(mission, tmp_path)
    (tmp_path / "simulation.yaml").write_text(content)
    with pytest.raises(TerrainLoopError, match="did not write"):
        write_mission(mission, tmp_path)
    assert len(load_mission(tmp_path)) == 2


@pytest.mark.parametrize("submaps", [10_001, 10**8, 10**400])
def test_more_submaps_than_anyone_simulates_are_refused(submaps):
    with pytest.raises(TerrainLoopError, match="at most 10000 submaps"):
        simulate_mission(submaps=submaps)


@pytest.mark.parametrize("sensor", ["stereo", "lidar"])
def test_terrain_beyond_the_memory_is_refused_before_it_is_made(sensor, monkeypatch):
    monkeypatch.setattr("terrainloop.resources.available_memory", lambda: 1e9)
    with pytest.raises(TerrainLoopError, match=r"memory for a terrain .* simulate a shorter drive"):
        simulate_mission(submaps=1000, sensor=sensor)
