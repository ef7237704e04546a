"""Posed scans from folders: clouds, KITTI, trajectories of either kind, missions."""

import numpy as np
import pytest
from conftest import PLACES

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse, se3
from terrainloop.io.clouds import read_scan, write_cloud
from terrainloop.io.gravity import T_BODY_OPTICAL, why_not_upright
from terrainloop.io.pose_track import PoseTrack
from terrainloop.io.recordings import open_recording
from terrainloop.io.trajectories import Trajectory, write_tum
from terrainloop.scan import PosedScan, Scan

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-5, 5, (150, 3)).round(3)
YAWS = np.linspace(0, 2, 6)
POSES = np.array([se3(i, 0.5 * i, 0, 0, 0, yaw) for i, yaw in enumerate(YAWS)])


def write_scans(folder, names, suffix=".ply"):
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        points = POINTS + np.array([0, 0, number])
        if suffix == ".bin":
            np.column_stack([points, np.arange(len(points))]).astype("<f4").tofile(folder / f"{name}.bin")
        else:
            write_cloud(folder / f"{name}{suffix}", points)


def write_kitti(path, poses):
    np.savetxt(path, poses[:, :3].reshape(-1, 12))


def numbers(count=6):
    return [f"{i:06d}" for i in range(count)]


def check(scans, poses=POSES, stamps=None):
    assert len(scans) == len(poses)
    for number, (posed, pose) in enumerate(zip(scans, poses, strict=True)):
        np.testing.assert_allclose(posed.scan.points, POINTS + np.array([0, 0, number]), atol=1e-5)
        np.testing.assert_allclose(posed.T_world_sensor, pose, atol=1e-9)
    if stamps is not None:
        np.testing.assert_allclose([posed.scan.stamp for posed in scans], stamps)


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".xyz"])
@pytest.mark.parametrize("inside", ["", "scans", "clouds"])
def test_one_pose_for_each_scan(suffix, inside, tmp_path):
    write_scans(tmp_path / inside, numbers(), suffix)
    write_tum(tmp_path / "poses.tum", Trajectory(10.0 + np.arange(6), POSES))
    recording = open_recording(tmp_path)
    assert recording.kind == "folder of scans (cloud files)"
    check(list(recording.scans()), stamps=10.0 + np.arange(6))


def test_kitti(tmp_path):
    """Poses of the camera, in its world; its frame beside that of the scanner; times."""
    T_camera_scanner = inverse(T_BODY_OPTICAL) @ se3(0.1, 0, -0.3, 0, 0, 0)
    write_scans(tmp_path / "velodyne", numbers(), ".bin")
    write_kitti(tmp_path / "poses.txt", T_camera_scanner @ POSES @ inverse(T_camera_scanner))
    times = 0.1 * np.arange(6)
    np.savetxt(tmp_path / "times.txt", times)
    rows = {"P0": np.eye(4)[:3], "Tr": T_camera_scanner[:3]}
    text = "".join(f"{name}: {' '.join(map(repr, row.ravel().tolist()))}\n" for name, row in rows.items())
    (tmp_path / "calib.txt").write_text(text)
    for path in (tmp_path, tmp_path / "velodyne"):
        recording = open_recording(path)
        assert recording.sensor == "lidar"
        assert recording.kind == "folder of scans (KITTI)"
        check(list(recording.scans()), POSES, times)
        assert len(recording.description.remarks) == 2
    scan = next(recording.scans()).scan
    np.testing.assert_array_equal(scan.intensity, np.arange(len(POINTS)))
    (tmp_path / "calib.txt").unlink()
    (missing,) = open_recording(tmp_path).description.missing
    assert "y axis vertical" in missing.what
    assert "calib.txt" in missing.fix


def test_stamps_in_names_are_interpolated(tmp_path):
    stamps = 100 + np.array([0.25, 1.5, 2.0, 2.75, 9.0])
    write_scans(tmp_path, [f"{stamp:.6f}" for stamp in stamps])
    poses = np.array([se3(i, 0, 0, 0, 0, 0.2 * i) for i in range(7)])
    write_tum(tmp_path / "odometry.tum", Trajectory(100.0 + np.arange(7), poses))
    recording = open_recording(tmp_path)
    expected = [se3(t, 0, 0, 0, 0, 0.2 * t) for t in stamps[:4] - 100]
    check(list(recording.scans()), expected, stamps[:4])
    assert sum(recording.dropped.values()) == 1


def test_nanoseconds_in_names(tmp_path):
    stamps = 1_700_000_000 + np.array([0.25, 1.5])
    write_scans(tmp_path, [str(int(stamp * 1e9)) for stamp in stamps])
    poses = np.array([se3(i, 0, 0, 0, 0, 0) for i in range(7)])
    write_tum(tmp_path / "poses.tum", Trajectory(1_700_000_000.0 + np.arange(7), poses))
    check(list(open_recording(tmp_path).scans()), [se3(t, 0, 0, 0, 0, 0) for t in (0.25, 1.5)], stamps)


def test_poses_that_do_not_fit_are_refused(tmp_path):
    write_scans(tmp_path, numbers())
    write_tum(tmp_path / "poses.tum", Trajectory(1e9 + np.arange(5), POSES[:5]))
    with pytest.raises(TerrainLoopError, match=r"6 poses, one for each scan, .* found 5 poses"):
        open_recording(tmp_path)


@pytest.mark.parametrize("prefix", ["", "scan_", "run_1_"])
def test_counters_in_names_are_no_stamps(prefix, tmp_path):
    """Although they are within the time span of the poses."""
    write_scans(tmp_path, [prefix + name for name in numbers()])
    poses = np.array([se3(i, 0, 0, 0, 0, 0) for i in range(20)])
    write_tum(tmp_path / "poses.tum", Trajectory(np.arange(20.0), poses))
    with pytest.raises(TerrainLoopError, match="6 poses, one for each scan"):
        open_recording(tmp_path)


def test_poses_of_a_camera_and_of_its_body(tmp_path):
    write_scans(tmp_path, numbers())
    write_tum(tmp_path / "poses.tum", Trajectory(np.arange(6.0), POSES @ T_BODY_OPTICAL))
    check(list(open_recording(tmp_path).scans()), POSES @ T_BODY_OPTICAL)
    write_tum(tmp_path / "poses.tum", Trajectory(np.arange(6.0), POSES))
    check(list(open_recording(tmp_path, sensor_frame="optical").scans()), POSES @ T_BODY_OPTICAL)
    with pytest.raises(TerrainLoopError, match="only bags know frames by name"):
        open_recording(tmp_path, sensor_frame="lidar")


def test_without_poses(tmp_path):
    write_scans(tmp_path, numbers())
    recording = open_recording(tmp_path)
    assert recording.count == 6
    assert str(recording.description.missing[0]).startswith("no poses of the scans: put one of poses.tum")
    with pytest.raises(TerrainLoopError, match="no poses"):
        list(recording.scans())


def test_broken_scans_are_dropped_and_counted(tmp_path, caplog):
    write_scans(tmp_path, numbers())
    (tmp_path / "000002.ply").write_bytes(b"ply\nnothing")
    np.save(tmp_path / "000003.npy", np.full((5, 3), np.nan))
    (tmp_path / "000003.ply").unlink()
    write_tum(tmp_path / "poses.tum", Trajectory(np.arange(6.0), POSES))
    recording = open_recording(tmp_path)
    assert len(list(recording.scans())) == 4
    assert recording.dropped == {"damaged": 1, "without points": 1}
    assert "000002.ply" in caplog.text


def test_all_scans_broken(tmp_path):
    tmp_path.joinpath("0.ply").write_bytes(b"ply")
    write_tum(tmp_path / "poses.tum", Trajectory([0.0], POSES[:1]))
    with pytest.raises(TerrainLoopError, match="no scan that can be used: 1 damaged"):
        list(open_recording(tmp_path).scans())


def test_a_mission_is_recognised(mission_folder):
    recording = open_recording(mission_folder)
    assert recording.kind == "mission of submaps"
    uses = {stream.name: stream.use for stream in recording.description.streams}
    assert uses == {"clouds": "submaps", "odometry": "odometry", "truth": "evaluation"}
    assert recording.count == len(PLACES)
    assert [posed.scan.stamp for posed in recording.scans()] == [0, 1, 3, 4]  # one is broken
    assert recording.dropped == {"damaged": 1}


def test_a_mission_with_truth_alone(tmp_path):
    write_scans(tmp_path / "clouds", numbers())
    write_tum(tmp_path / "truth.tum", Trajectory(np.arange(6.0), POSES))
    recording = open_recording(tmp_path)
    assert recording.kind == "mission of submaps"
    assert recording.description.missing[0].what.startswith("no odometry.tum")
    write_tum(tmp_path / "odometry.tum", Trajectory(np.arange(6.0), POSES))
    check(list(open_recording(tmp_path).scans()))


def test_scans_with_poses_and_truth_are_no_mission(tmp_path):
    write_scans(tmp_path, numbers())
    for name in ("poses.tum", "truth.tum"):
        write_tum(tmp_path / name, Trajectory(np.arange(6.0), POSES))
    recording = open_recording(tmp_path)
    assert recording.kind == "folder of scans (cloud files)"
    check(list(recording.scans()))


def test_hidden_files_are_no_scans(tmp_path):
    write_scans(tmp_path, [".0", ".1"])
    with pytest.raises(TerrainLoopError, match="found neither"):
        open_recording(tmp_path)


def test_folders_without_scans(tmp_path):
    with pytest.raises(TerrainLoopError, match=r"a bag, or scans .*; found neither"):
        open_recording(tmp_path)
    with pytest.raises(TerrainLoopError, match="as a topic is named"):
        open_recording(tmp_path, cloud_topic="/points")


def test_kitti_scans_are_checked(tmp_path):
    (tmp_path / "0.bin").write_bytes(bytes(17))
    with pytest.raises(TerrainLoopError, match="17 bytes, not a multiple of 16"):
        read_scan(tmp_path / "0.bin")
    with pytest.raises(TerrainLoopError, match=r"suffixes .* \.bin"):
        read_scan(tmp_path / "0.pcap")


def test_scans_need_not_be_gravity_aligned(tmp_path):
    """Unlike submaps: they are in the frame of the sensor."""
    wall = np.column_stack([RNG.uniform(-5, 5, 200), np.zeros(200), RNG.uniform(-5, 5, 200)])
    write_cloud(tmp_path / "wall.ply", wall)
    assert len(read_scan(tmp_path / "wall.ply", 3.0)) == 200


# Poses


def test_a_track_interpolates_as_a_screw_about_a_fixed_axis():
    track = PoseTrack.of(Trajectory(np.arange(6.0)[::-1], POSES[::-1]))
    assert track.span == (0.0, 5.0)
    assert not track.still
    np.testing.assert_allclose(track.at(2.0), POSES[2], atol=1e-12)
    middle = track.at(2.5)
    np.testing.assert_allclose(middle, se3(2.5, 1.25, 0, 0, 0, (YAWS[2] + YAWS[3]) / 2), atol=1e-12)
    assert track.at(-0.1) is None
    assert track.at(5.1) is None
    assert track.covariance_at(2.0) is None


def test_a_track_knows_the_nearest_covariance():
    covariances = np.array([np.eye(6), np.full((6, 6), np.nan), 3 * np.eye(6)])
    track = PoseTrack(np.arange(3.0), np.zeros((3, 3)), np.tile([0, 0, 0, 1.0], (3, 1)), covariances)
    assert track.still
    np.testing.assert_array_equal(track.covariance_at(0.4), np.eye(6))
    assert track.covariance_at(1.2) is None
    np.testing.assert_array_equal(track.covariance_at(9.0), 3 * np.eye(6))


def test_a_track_needs_poses():
    with pytest.raises(TerrainLoopError, match="at least one pose"):
        PoseTrack(np.empty(0), np.empty((0, 3)), np.empty((0, 4)))


@pytest.mark.parametrize("slope", [0, 20, 40])
def test_slopes_do_not_count_as_tilt(slope):
    rotations = np.array([se3(0, 0, 0, 0, np.radians(slope), yaw)[:3, :3] for yaw in YAWS])
    assert not why_not_upright(rotations, "base_link")
    assert not why_not_upright(rotations @ T_BODY_OPTICAL[:3, :3], "camera_optical")
    assert why_not_upright(rotations @ T_BODY_OPTICAL[:3, :3], "base_link")


@pytest.mark.parametrize(
    "arguments",
    [(2 * np.eye(4),), (np.eye(3),), (np.eye(4), np.eye(5)), (np.eye(4), np.full((6, 6), np.nan))],
)
def test_posed_scans_are_checked(arguments):
    with pytest.raises(TerrainLoopError, match="expected"):
        PosedScan(Scan(POINTS), *arguments)


def test_posed_scans_describe_themselves():
    posed = PosedScan(Scan(POINTS, 2), POSES[1], np.eye(6))
    assert repr(posed) == "PosedScan(Scan(150 points, stamp 2.000000) at (1.00, 0.50, 0.00) m)"
    assert not posed.T_world_sensor.flags.writeable
    assert not posed.covariance.flags.writeable
