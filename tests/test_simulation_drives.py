"""Simulated drives: posed scans of the terrain, odometry that drifts, and bags and folders of them."""

import json

import numpy as np
import pytest

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import transform, yaw_of
from terrainloop.io.recordings import open_recording
from terrainloop.io.trajectories import read_trajectory
from terrainloop.simulation.bags import EPOCH, write_bag
from terrainloop.simulation.drives import simulate_drive, trajectories, write_scans


@pytest.fixture(scope="module")
def drive():
    return simulate_drive("etna", 3, length=25.0, sensor="lidar", max_points=600)


@pytest.fixture(scope="module")
def scans(drive):
    return list(drive.scans())


def test_scans_lie_on_the_terrain_from_the_true_poses(drive, scans):
    truth = trajectories(drive)["truth.tum"].poses
    for posed, T in list(zip(scans, truth, strict=True))[::5]:
        world = transform(T, posed.scan.points)
        error = np.abs(world[:, 2] - drive.terrain.height_at(world[:, :2]))
        assert np.median(error) < 0.06
        assert len(world) == 600


def test_scans_are_the_same_at_every_call(drive, scans):
    again = next(iter(drive.scans()))
    np.testing.assert_array_equal(again.scan.points, scans[0].scan.points)
    assert [posed.scan.stamp for posed in scans] == drive.stamps.tolist()
    assert np.diff(drive.stamps) == pytest.approx(2.0)  # a metre, half a metre per second


def test_odometry_begins_at_the_truth_and_drifts(drive):
    np.testing.assert_allclose(drive.odometry[0], drive.truth[0], atol=1e-9)
    assert drive.length == pytest.approx(25.0, rel=0.1)
    off = [simulate_drive("flat", seed, length=100.0).off_at_the_end / 100.0 for seed in range(5)]
    assert 0.004 < np.sqrt(np.mean(np.square(off))) < 0.03


def test_a_drive_comes_back_in_both_directions():
    drive = simulate_drive("flat", 1, length=140.0)
    position, heading = drive.truth[:, :2, 3], np.array([yaw_of(T) for T in drive.truth])
    near = np.linalg.norm(position[:, None] - position[None], axis=2) < 1.5
    near &= np.abs(np.subtract.outer(drive.stamps, drive.stamps)) > 30.0
    turned = np.abs(np.angle(np.exp(1j * np.subtract.outer(heading, heading))))
    assert (near & (turned < 0.5)).any()
    assert (near & (turned > 2.6)).any()


@pytest.mark.parametrize("sensor", ["stereo", "lidar"])
def test_either_sensor_sees_ground(sensor):
    drive = simulate_drive("mars", 0, length=8.0, sensor=sensor, max_points=2000)
    assert len(next(drive.scans()).scan) == 2000


@pytest.mark.parametrize("options", [{"length": -1.0}, {"length": np.nan}, {"max_points": 0}, {"seed": -1}])
def test_impossible_drives_are_refused(options):
    with pytest.raises(TerrainLoopError):
        simulate_drive("flat", **{"seed": 0, **options})


def same(read, drive, scans, since=0.0):
    poses = trajectories(drive)["odometry.tum"].poses
    assert len(read) == len(scans)
    for posed, scan, T in zip(read, scans, poses, strict=True):
        assert posed.scan.stamp == pytest.approx(scan.scan.stamp + since, abs=1e-6)
        np.testing.assert_allclose(posed.scan.points, scan.scan.points, atol=1e-5)
        np.testing.assert_allclose(posed.T_world_sensor, T, atol=1e-6)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_bags_are_read_back(drive, scans, tmp_path, kind):
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    write_bag(drive, path, kind)
    same(list(open_recording(path).scans()), drive, scans, since=EPOCH)
    truth = read_trajectory(tmp_path / "drive_truth.tum")
    np.testing.assert_allclose(truth.poses, trajectories(drive)["truth.tum"].poses, atol=1e-9)
    with pytest.raises(TerrainLoopError, match="nothing at"):
        write_bag(drive, path, kind)


def test_another_kind_of_bag_is_refused(drive, tmp_path):
    with pytest.raises(TerrainLoopError, match="mcap, sqlite3 or ros1"):
        write_bag(drive, tmp_path / "x", "ros3")


def test_folders_are_read_back(drive, scans, tmp_path):
    write_scans(drive, tmp_path)
    same(list(open_recording(tmp_path).scans()), drive, scans)
    with pytest.raises(TerrainLoopError, match="a folder without scans"):
        write_scans(drive, tmp_path)


def test_the_command_writes_drives(tmp_path, cli):
    _, text, _ = cli("simulate", "-o", tmp_path / "a", "--world", "flat", "--length", "7", "--json")
    told = json.loads(text)
    assert told["scans"] == 14
    assert len(list(open_recording(tmp_path / "a").scans())) == 14
    cli("simulate", "-o", tmp_path / "b", "--world", "flat", "--length", "7", "--bag", "mcap")
    assert len(list(open_recording(tmp_path / "b").scans())) == 14


def test_a_bag_needs_a_length(tmp_path, cli):
    code, _, error = cli("simulate", "-o", tmp_path / "b", "--bag", "mcap")
    assert code == 2
    assert "--length" in error
