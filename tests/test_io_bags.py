"""Posed scans of ROS bags of all kinds, whatever is in them."""

import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
from bags_util import KINDS, LEVEL, START, Messages, write_bag, yaw
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import se3, transform
from terrainloop.io.bags.clouds import points_of
from terrainloop.io.bags.depth import Camera, depth_points
from terrainloop.io.bags.hints import no_clouds, no_poses
from terrainloop.io.bags.reader import Topic
from terrainloop.io.gravity import T_BODY_OPTICAL
from terrainloop.io.recordings import open_recording

REAL = Path("/work/shared/data/bags")
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-5, 5, (60, 3)).astype(np.float32).astype(float)
OPTICAL = tuple(Rotation.from_matrix(T_BODY_OPTICAL[:3, :3]).as_quat())


def drive(make, scans=6, tf=(), child="base_link", frame="lidar", covariance=None):
    """Scans at 10 Hz, half way between the poses of a straight drive at 1 m/s that yaws at 0.2 rad/s."""
    if tf:
        yield "/tf_static", START, make.tf(*tf)
    for i in range(scans + 1):
        now = START + 0.1 * i
        pose = make.odometry(now, (0.1 * i, 0, 0), yaw(0.02 * i), child, covariance)
        yield "/odom", now, pose
        if i < scans:
            yield "/points", now + 0.06, make.cloud(now + 0.05, POINTS, frame)


def recorded(path, **options):
    recording = open_recording(path, **options)
    return recording, list(recording.scans())


def expected_pose(seconds):
    """Of the body in `drive`."""
    return se3(seconds, 0, 0, 0, 0, 0.2 * seconds)


@pytest.mark.parametrize("kind", KINDS)
def test_all_kinds_of_bags(kind, tmp_path):
    mount = (0.3, 0.1, 1.2), yaw(0.5)
    covariance = np.diag(np.arange(1.0, 7.0))
    path = write_bag(
        tmp_path,
        kind,
        lambda make: drive(make, tf=[(START, "base_link", "lidar", *mount)], covariance=covariance),
    )
    recording, scans = recorded(path)
    assert recording.sensor == "lidar"
    assert recording.count == len(scans) == 6
    assert not recording.dropped
    uses = {stream.name: stream.use for stream in recording.description.streams}
    assert uses == {"/odom": "odometry", "/points": "scans", "/tf_static": "frames"}
    T_body_sensor = se3(0.3, 0.1, 1.2, 0, 0, 0.5)
    for i, posed in enumerate(scans):
        assert posed.scan.stamp == pytest.approx(START + 0.1 * i + 0.05, abs=1e-6)
        np.testing.assert_allclose(posed.scan.points, POINTS, atol=1e-6)
        np.testing.assert_array_equal(posed.scan.intensity, np.arange(len(POINTS)))
        expected = expected_pose(0.1 * i + 0.05) @ T_body_sensor
        np.testing.assert_allclose(posed.T_world_sensor, expected, atol=1e-5)
        np.testing.assert_allclose(posed.covariance, covariance, rtol=1e-6)
    odometry = next(stream for stream in recording.description.streams if stream.use == "odometry")
    assert odometry.frame == "base_link in odom"
    assert (odometry.start, odometry.end) == pytest.approx((START, START + 0.6), abs=1e-6)
    assert list(map(repr, recording.scans())) == list(map(repr, scans))  # may be read again


@pytest.mark.parametrize(
    ("kind", "compression"),
    [
        *(("ros1", name) for name in ("BZ2", "LZ4")),
        *((kind, name) for kind in ("sqlite3", "mcap") for name in ("FILE", "MESSAGE")),
        ("mcap", "STORAGE"),
    ],
)
def test_compressed_bags(kind, compression, tmp_path):
    path = write_bag(tmp_path, kind, drive, compression)
    assert len(recorded(path)[1]) == 6


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_without_metadata_or_as_a_file(kind, tmp_path):
    path = write_bag(tmp_path, kind, drive)
    file = next(file for file in path.iterdir() if file.suffix != ".yaml")
    assert len(recorded(file)[1]) == 6
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    assert len(recorded(path)[1]) == 6
    (path / "metadata.yaml").unlink()
    assert len(recorded(path)[1]) == 6


def test_messages_that_sqlite_has_not_stored_yet(tmp_path):
    path = write_bag(tmp_path, "sqlite3", drive)
    (path / "sqlite3.db3-wal").write_bytes(b"wal")
    assert any("wal_checkpoint" in words for words in recorded(path)[0].description.remarks)


def test_metadata_that_lists_more_files(tmp_path):
    path = write_bag(tmp_path, "mcap", drive)
    text = (path / "metadata.yaml").read_text()
    text = text.replace("- mcap.mcap\n", "- mcap.mcap\n  - mcap_1.mcap\n", 1)
    (path / "metadata.yaml").write_text(text)
    assert any("missing" in words for words in recorded(path)[0].description.remarks)


@pytest.mark.parametrize("kind", KINDS)
def test_several_files_of_one_recording(kind, tmp_path):
    """Poses in one file and scans in another, or a folder with both."""

    def part(clouds):
        return lambda make: (item for item in drive(make) if (item[0] == "/points") == clouds)

    paths = []
    for name, clouds in (("poses", False), ("scans", True)):
        (tmp_path / name).mkdir()
        paths.append(write_bag(tmp_path / name, kind, part(clouds)))
    assert len(recorded(paths)[1]) == 6
    both = tmp_path / "both"
    both.mkdir()
    for number, path in enumerate(paths):
        for file in [path] if path.is_file() else [f for f in path.iterdir() if f.suffix != ".yaml"]:
            shutil.copy(file, both / f"{number}{file.suffix}")
    assert len(recorded(both)[1]) == 6


def test_bags_of_ros_1_and_2_are_not_mixed(tmp_path):
    paths = [write_bag(tmp_path, kind, drive) for kind in ("ros1", "mcap")]
    with pytest.raises(TerrainLoopError, match=r"ROS 1 or of ROS 2; found both"):
        open_recording(paths)


def test_stamps_of_headers_in_their_order(tmp_path):
    """Bag times are later and disordered; they do not count."""

    def disordered(make):
        for i in range(11):
            yield "/odom", START + 50 + i, make.odometry(START + 0.1 * i, (0.1 * i, 0, 0))
        for number, i in enumerate([1, 0, 3, 2, 5, 4]):
            yield "/points", START + 70 + number, make.cloud(START + 0.1 * i, POINTS, "base_link")

    _, scans = recorded(write_bag(tmp_path, "mcap", disordered))
    np.testing.assert_allclose([s.scan.stamp for s in scans], START + 0.1 * np.arange(6), atol=1e-6)
    np.testing.assert_allclose([s.T_world_sensor[0, 3] for s in scans], 0.1 * np.arange(6), atol=1e-6)


def test_scans_that_cannot_be_used_are_dropped_and_counted(tmp_path, caplog):
    def with_bad_ones(make):
        yield from drive(make)
        yield "/points", START + 1, make.cloud(START + 9, POINTS)
        yield "/points", START + 1.1, make.cloud(START + 0.2, np.zeros((5, 3)))
        yield "/points", START + 1.2, make.cloud(START + 0.3, POINTS, width=9999)
        yield "/points", START + 1.3, make.cloud(0, POINTS)

    recording, scans = recorded(write_bag(tmp_path, "mcap", with_bad_ones))
    assert len(scans) == 6
    assert sorted(recording.dropped.values()) == [1, 1, 1, 1]
    reasons = " ".join(recording.dropped)
    for words in ("time span", "without points", "damaged", "without a stamp"):
        assert words in reasons
        assert words in caplog.text


def test_nothing_is_interpolated_in_gaps(tmp_path):
    def with_gap(make):
        for now in (0.0, 0.1, 0.2, 0.3, 5.0, 5.1):
            yield "/odom", START + now, make.odometry(START + now, (now, 0, 0))
        for now in (0.15, 2.0, 5.05):
            yield "/points", START + now, make.cloud(START + now, POINTS)

    recording, scans = recorded(write_bag(tmp_path, "mcap", with_gap))
    assert [round(s.scan.stamp - START, 2) for s in scans] == [0.15, 5.05]
    assert sum(recording.dropped.values()) == 1


# Frames


def test_a_chain_of_static_and_moving_frames(tmp_path):
    """A sensor on a mast that turns, odometry of an IMU beside the base."""

    def masted(make):
        static = [
            (START, "mast", "lidar", (0.1, 0, 0.2), LEVEL),
            (START, "base_link", "imu", (0.5, 0, 0), yaw(np.pi / 2)),
        ]
        yield "/tf_static", START, make.tf(*static)
        for i in range(11):
            now = START + 0.1 * i
            yield "/odom", now, make.odometry(now, (0.1 * i, 0, 0), child="/imu")
            yield "/tf", now, make.tf((now, "base_link", "mast", (0, 0, 1), yaw(0.1 * i)))
            yield "/tf", now, make.tf((now, "odom", "wheel", (0, 0, 1), yaw(0.5 * i)))
        yield "/points", START + 0.5, make.cloud(START + 0.45, POINTS)

    _, (posed,) = recorded(write_bag(tmp_path, "ros1", masted))
    T_imu_base = np.linalg.inv(se3(0.5, 0, 0, 0, 0, np.pi / 2))
    T_base_sensor = se3(0, 0, 1, 0, 0, 0.45) @ se3(0.1, 0, 0.2, 0, 0, 0)
    expected = se3(0.45, 0, 0, 0, 0, 0) @ T_imu_base @ T_base_sensor
    np.testing.assert_allclose(posed.T_world_sensor, expected, atol=1e-6)


def test_tf_is_the_odometry_where_no_topic_is(tmp_path):
    def tf_only(make):
        yield "/tf_static", START, make.tf((START, "base_link", "lidar", (0, 0, 1), LEVEL))
        for i in range(11):
            now = START + 0.1 * i
            yield "/tf", now, make.tf((now, "odom", "base_link", (0.1 * i, 0, 0), LEVEL))
            yield "/tf", now, make.tf((now, "map", "odom", (5.0 + i, 0, 0), LEVEL))
        yield "/points", START + 0.5, make.cloud(START + 0.45, POINTS)

    recording, (posed,) = recorded(write_bag(tmp_path, "sqlite3", tf_only))
    np.testing.assert_allclose(posed.T_world_sensor, se3(0.45, 0, 1, 0, 0, 0), atol=1e-6)
    assert posed.covariance is None
    assert any("'base_link' in 'odom'" in words for words in recording.description.remarks)


@pytest.mark.parametrize("tf", [False, True])
def test_poses_that_name_no_body(tf, tmp_path):
    """They are those of base_link if TF has it, else those of the sensor."""

    def stamped(make):
        if tf:
            yield "/tf_static", START, make.tf((START, "base_link", "lidar", (0, 0, 1), LEVEL))
        for i in range(3):
            yield "/pose", START + i, make.pose_stamped(START + i, (i, 0, 0))
        yield "/points", START + 0.5, make.cloud(START + 0.5, POINTS)

    recording, (posed,) = recorded(write_bag(tmp_path, "ros1", stamped))
    np.testing.assert_allclose(posed.T_world_sensor, se3(0.5, 0, float(tf), 0, 0, 0), atol=1e-6)
    assert any("names no frame" in words for words in recording.description.remarks)


def test_poses_of_a_body_that_carries_a_camera(tmp_path):
    def stamped(make):
        for i in range(3):
            yield "/pose", START + i, make.pose_stamped(START + i, (i, 0, 0))
        yield "/points", START + 0.5, make.cloud(START + 0.5, POINTS, "camera_optical_frame")

    recording, (posed,) = recorded(write_bag(tmp_path, "ros1", stamped))
    np.testing.assert_allclose(posed.T_world_sensor, se3(0.5, 0, 0, 0, 0, 0) @ T_BODY_OPTICAL, atol=1e-6)
    assert any("a body with z up" in words for words in recording.description.remarks)


def test_poses_with_covariance(tmp_path):
    def poses(make):
        for i in range(3):
            yield "/pose", START + i, make.pose_with_covariance(START + i, (i, 0, 0), np.eye(6) * (i + 1))
        yield "/points", START + 0.9, make.cloud(START + 0.9, POINTS)

    _, (posed,) = recorded(write_bag(tmp_path, "mcap", poses))
    np.testing.assert_array_equal(posed.covariance, np.eye(6) * 2)


@pytest.mark.parametrize(
    "covariance", [np.zeros((6, 6)), -np.eye(6), np.full((6, 6), np.nan), 1e300 * np.eye(6)]
)
def test_covariances_that_are_none(covariance, tmp_path):
    _, scans = recorded(write_bag(tmp_path, "mcap", lambda make: drive(make, covariance=covariance)))
    assert all(posed.covariance is None for posed in scans)


def test_a_camera_by_tf_or_by_its_name_or_as_asked(tmp_path):
    frame = "camera_optical_frame"
    with_tf = write_bag(
        tmp_path,
        "mcap",
        lambda make: drive(make, tf=[(START, "base_link", frame, (0, 0, 1), OPTICAL)], frame=frame),
    )
    without = write_bag(tmp_path, "ros1", lambda make: drive(make, frame=frame))
    unnamed = write_bag(tmp_path, "sqlite3", lambda make: drive(make, frame="cam0"))
    for path, options, height in (
        (with_tf, {}, 1.0),
        (without, {}, 0.0),
        (unnamed, {"sensor_frame": "optical"}, 0.0),
        (with_tf, {"sensor_frame": "optical"}, 0.0),
    ):
        _, scans = recorded(path, **options)
        expected = expected_pose(0.05) @ se3(0, 0, height, 0, 0, 0) @ T_BODY_OPTICAL
        np.testing.assert_allclose(scans[0].T_world_sensor, expected, atol=1e-5)
    assert recorded(without)[0].sensor == "stereo"
    assert any("optical" in words for words in recorded(without)[0].description.remarks)
    body = recorded(with_tf, sensor_frame="body")[1]
    np.testing.assert_allclose(body[0].T_world_sensor, expected_pose(0.05), atol=1e-5)
    named = recorded(with_tf, sensor_frame=frame)[1]
    np.testing.assert_allclose(named[0].T_world_sensor[2, 3], 1.0)
    with pytest.raises(TerrainLoopError, match="TF has base_link, camera_optical_frame"):
        open_recording(with_tf, sensor_frame="lidar")


def test_clouds_in_the_world_of_the_odometry_are_taken_back(tmp_path):
    _, scans = recorded(write_bag(tmp_path, "mcap", lambda make: drive(make, frame="odom")))
    for posed in scans:
        np.testing.assert_allclose(transform(posed.T_world_sensor, posed.scan.points), POINTS, atol=1e-6)
    np.testing.assert_allclose(scans[1].T_world_sensor, expected_pose(0.15), atol=1e-5)


def test_clouds_in_a_map_above_the_odometry_are_taken_back(tmp_path):
    def mapped(make):
        for item in drive(make, frame="map"):
            yield item
            if item[0] == "/odom":
                now = item[1]
                yield "/tf", now, make.tf((now, "map", "odom", (5, 0, 0), LEVEL))
                seconds = now - START
                yield "/tf", now, make.tf((now, "odom", "base_link", (seconds, 0, 0), yaw(0.2 * seconds)))

    _, scans = recorded(write_bag(tmp_path, "mcap", mapped))
    for posed in scans:
        in_odom = transform(posed.T_world_sensor, posed.scan.points)
        np.testing.assert_allclose(in_odom + np.array([5, 0, 0]), POINTS, atol=1e-5)
    np.testing.assert_allclose(scans[1].T_world_sensor, expected_pose(0.15), atol=1e-5)


@pytest.mark.parametrize(("frame", "T_frame_points"), [("body", np.eye(4)), ("optical", T_BODY_OPTICAL)])
def test_tf_as_odometry_of_the_body(frame, T_frame_points, tmp_path):
    def tf_only(make):
        yield "/tf_static", START, make.tf((START, "base_link", "lidar", (0, 0, 1), LEVEL))
        for i in range(11):
            now = START + 0.1 * i
            yield "/tf", now, make.tf((now, "odom", "base_link", (0.1 * i, 0, 0), LEVEL))
        yield "/points", START + 0.5, make.cloud(START + 0.45, POINTS)

    _, (posed,) = recorded(write_bag(tmp_path, "mcap", tf_only), sensor_frame=frame)
    np.testing.assert_allclose(posed.T_world_sensor, se3(0.45, 0, 0, 0, 0, 0) @ T_frame_points, atol=1e-6)


def test_planar_odometry_is_noted(tmp_path):
    def notes(folder, height):
        folder.mkdir()
        path = write_bag(folder, "mcap", lambda make: drive_at(make, height))
        return " ".join(open_recording(path).description.remarks)

    def drive_at(make, height):
        for i in range(4):
            yield "/odom", START + i, make.odometry(START + i, (i, 0, height * i))
            yield "/points", START + i, make.cloud(START + i, POINTS)

    assert "/odom is planar" in notes(tmp_path / "flat", 0.0)
    assert "planar" not in notes(tmp_path / "hilly", 0.1)


def test_frames_that_are_not_joined_are_missing(tmp_path):
    tf = [(START, "base", "camera", (0, 0, 1), LEVEL)]
    recording = open_recording(write_bag(tmp_path, "mcap", lambda make: drive(make, tf=tf)))
    (missing,) = recording.description.missing
    assert missing.what.startswith("no TF that joins the frame 'lidar'")
    with pytest.raises(TerrainLoopError, match="record /tf_static"):
        next(recording.scans())


@pytest.mark.parametrize(
    ("turn", "child", "words"),
    [
        (("x", 180), "base_link", "z down"),
        (("x", 90), "base_link", "tilted by 90 deg"),
        (("y", 90), "camera_optical", "y axis vertical"),
        (("y", 90), "base_link", "y axis vertical"),
    ],
)
def test_a_world_without_z_up_is_missing_gravity(turn, child, words, tmp_path):
    """Of a camera it turns about y, the vertical."""
    axis, end = turn
    angles = np.linspace(0, end, 6) if axis == "y" else np.full(6, end)

    def turned(make):
        for i, angle in enumerate(angles):
            quaternion = Rotation.from_euler(axis, angle, degrees=True).as_quat()
            yield "/odom", START + i, make.odometry(START + i, (0, 0, i), quaternion, child)
            yield "/points", START + i, make.cloud(START + i, POINTS, child)

    recording = open_recording(write_bag(tmp_path, "mcap", turned))
    (missing,) = recording.description.missing
    assert "/odom is not gravity-aligned" in missing.what
    assert words in missing.what


def test_a_camera_posed_in_a_world_with_z_up_is_fine(tmp_path):
    def camera(make):
        for i in range(4):
            yield "/odom", START + i, make.odometry(START + i, (i, 0, 0), OPTICAL, "camera_optical")
            yield "/points", START + i, make.cloud(START + i, POINTS, "camera_optical")

    _, scans = recorded(write_bag(tmp_path, "mcap", camera))
    np.testing.assert_allclose(scans[2].T_world_sensor, se3(2, 0, 0, 0, 0, 0) @ T_BODY_OPTICAL, atol=1e-6)


# Topics


def test_topics_are_found_by_type_or_named(tmp_path):
    def many(make):
        for i in range(11):
            now = START + 0.1 * i
            yield "/truth/odometry", now, make.odometry(now, (9, 0, 0))
            yield "/truth/odometry", now + 0.01, make.odometry(now + 0.01, (9, 0, 0))
            yield "/wheel_pose", now, make.pose_stamped(now, (7, 0, 0))
            yield "/odom", now, make.odometry(now, (0.1 * i, 0, 0))
            yield "/points_filtered", now, make.cloud(now, POINTS)
            yield "/points", now, make.cloud(now, POINTS[:20])
        yield "/goal_pose", START, make.pose_stamped(START, (1, 0, 0))

    path = write_bag(tmp_path, "mcap", many)
    recording, scans = recorded(path)
    assert len(scans[0].scan) == 20
    assert scans[3].T_world_sensor[0, 3] == pytest.approx(0.3)
    notes = " ".join(recording.description.remarks)
    assert "/points is used as scans, not /points_filtered: choose with --cloud-topic" in notes
    assert "/odom is used as odometry, not /wheel_pose, /truth/odometry" in notes
    _, scans = recorded(path, cloud_topic="points_filtered", odometry_topic="/wheel_pose")
    assert len(scans[0].scan) == len(POINTS)
    assert scans[3].T_world_sensor[0, 3] == 7
    with pytest.raises(TerrainLoopError, match=r"name one of /points, /points_filtered"):
        open_recording(path, cloud_topic="/odom")
    with pytest.raises(TerrainLoopError, match="no such topic"):
        open_recording(path, odometry_topic="/nothing")


def test_without_odometry_or_clouds(tmp_path):
    def clouds(make):
        return (item for item in drive(make) if item[0] == "/points")

    def poses(make):
        return (item for item in drive(make) if item[0] == "/odom")

    recording = open_recording(write_bag(tmp_path, "mcap", clouds))
    assert str(recording.description.missing[0]).startswith("no odometry: run an odometry on the scans")
    with pytest.raises(TerrainLoopError, match=r"found .*no odometry; run an odometry on the scans"):
        list(recording.scans())
    (missing,) = open_recording(write_bag(tmp_path, "ros1", poses)).description.missing
    assert missing.what == "no point clouds or depth images"
    assert missing.fix == "record sensor_msgs/PointCloud2 or depth images beside the rest"


def test_two_clocks_are_noticed(tmp_path):
    def apart(make):
        for i in range(3):
            yield "/odom", START + i, make.odometry(10.0 + i, (i, 0, 0))
            yield "/points", START + i, make.cloud(START + i, POINTS)

    (missing,) = open_recording(write_bag(tmp_path, "mcap", apart)).description.missing
    assert "do not meet: stamp both by one clock" in str(missing)


def test_poses_that_are_none_are_left_out(tmp_path):
    def broken(make):
        yield from drive(make)
        yield "/odom", START + 1, make.odometry(START + 0.31, (np.nan, 0, 0))
        yield "/odom", START + 1, make.odometry(START + 0.32, (0, 0, 0), (0, 0, 0, 0))
        yield "/odom", START + 1, make.odometry(START + 0.33, (0, 0, 0), child="other")
        yield "/odom", START + 1, make.odometry(0, (0, 0, 0))

    recording, scans = recorded(write_bag(tmp_path, "mcap", broken))
    np.testing.assert_allclose(scans[3].T_world_sensor, expected_pose(0.35), atol=1e-5)
    assert sum("left out" in words for words in recording.description.remarks) == 4


@pytest.mark.parametrize(
    ("type_", "words"),
    [
        ("velodyne_msgs/msg/VelodyneScan", "packets of a Velodyne driver"),
        ("nebula_msgs/msg/NebulaPackets", "packets of a LiDAR driver"),
        ("pandar_msgs/msg/PandarScan", "packets of a LiDAR driver"),
        ("livox_ros_driver2/msg/CustomMsg", "xfer_format 0"),
        ("point_cloud_interfaces/msg/CompressedPointCloud2", "republish"),
        ("sensor_msgs/msg/LaserScan", "planar laser scans"),
        ("sensor_msgs/msg/CompressedImage", "compressedDepth to raw"),
        ("std_msgs/msg/String", "record sensor_msgs/PointCloud2"),
    ],
)
def test_hints_for_topics_without_points(type_, words):
    assert words in str(no_clouds([Topic("/topic", type_, 3)]))


def test_an_imu_is_no_odometry():
    words = str(no_poses([Topic("/imu", "sensor_msgs/msg/Imu", 3)]))
    assert "no odometry, but an IMU, which gives gravity but no position, on /imu: run an odometry" in words


# Layouts


def cloud_of(points, kind="<f4", offset=0, step=None, rows=1, row_padding=0, order="xyz", **changes):
    """A PointCloud2 with any layout, and the number of bytes of its data."""
    size = np.dtype(kind).itemsize
    step = step or offset + 4 * size
    code = {"f4": 7, "f8": 8, "i2": 3}[kind[1:]]
    fields = [(name, offset + i * size, code) for i, name in enumerate([*order, "intensity"])]
    table = np.zeros(
        len(points),
        np.dtype(
            {
                "names": [f[0] for f in fields],
                "formats": [kind] * 4,
                "offsets": [f[1] for f in fields],
                "itemsize": step,
            }
        ),
    )
    for axis, values in zip("xyz", np.transpose(points), strict=True):
        table[axis] = values
    table["intensity"] = np.arange(len(points))
    width = len(points) // rows
    data = np.frombuffer(table.tobytes(), np.uint8).reshape(rows, width * step)
    data = np.pad(data, ((0, 0), (0, row_padding)), constant_values=255)
    layout = {
        "fields": fields,
        "is_bigendian": kind[0] == ">",
        "point_step": step,
        "height": rows,
        "width": width,
        "row_step": data.shape[1],
        "data": data.tobytes(),
    }
    return Messages("mcap").cloud(0, points, **(layout | changes))


@pytest.mark.parametrize("rows", [1, 4])
@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", ">f8"])
@pytest.mark.parametrize(
    "layout", [{}, {"offset": 3, "step": 48}, {"row_padding": 13}, {"order": "zyx"}], ids=str
)
def test_every_layout_of_a_cloud(rows, kind, layout):
    points, intensity = points_of(cloud_of(POINTS, kind, rows=rows, **layout))
    np.testing.assert_allclose(points, POINTS, rtol=1e-6)
    np.testing.assert_array_equal(intensity, np.arange(len(POINTS)))


def test_organised_clouds_lose_what_is_no_return():
    points = POINTS.copy()
    points[::3] = np.nan
    points[1] = 0
    kept = np.delete(np.arange(len(points)), [1, *range(0, len(points), 3)])
    found, intensity = points_of(cloud_of(points, rows=4))
    np.testing.assert_allclose(found, points[kept], rtol=1e-6)
    np.testing.assert_array_equal(intensity, kept)


def test_rows_without_a_step_and_empty_clouds():
    np.testing.assert_allclose(points_of(cloud_of(POINTS, rows=4, row_step=0))[0], POINTS, rtol=1e-6)
    assert points_of(cloud_of(POINTS, width=0))[0].shape == (0, 3)


def test_clouds_without_intensity():
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    points, intensity = points_of(cloud_of(POINTS, fields=fields))
    np.testing.assert_allclose(points, POINTS, rtol=1e-6)
    assert intensity is None


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 2**31},
        {"height": 2**31, "row_step": 1},
        {"point_step": 0},
        {"point_step": 8},
        {"data": b""},
        {"fields": [("x", 0, 7), ("y", 4, 7)]},
        {"fields": [("x", 0, 7), ("y", 4, 7), ("z", 2**31, 7)]},
        {"fields": [("x", 0, 7), ("y", 4, 7), ("z", 8, 99)]},
    ],
    ids=str,
)
def test_declared_sizes_are_checked(changes):
    with pytest.raises(ValueError, match=r"bytes|without x, y, z"):
        points_of(cloud_of(POINTS, **changes))


# Depth images


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_depth_images(kind, encoding, tmp_path):
    depth = np.full((6, 8), 2.0)
    depth[0, 0], depth[1, 1] = 0, 3
    pixels = (depth * 1000).astype("<u2") if encoding == "16UC1" else depth.astype("<f4")
    if encoding == "32FC1":
        pixels[0, 0] = np.nan

    def images(make):
        for i in range(3):
            now = START + i
            yield "/odom", now, make.odometry(now, (i, 0, 0))
            yield "/camera/depth/image_raw", now, make.image(now, pixels, encoding)
            yield "/camera/depth/camera_info", now, make.camera_info(now, 10.0, 3.5, 2.5, 8, 6)
            yield "/camera/color/image_raw", now, make.image(now, np.zeros((6, 24), "u1"), "rgb8")

    recording, scans = recorded(write_bag(tmp_path, kind, images))
    assert recording.sensor == "stereo"
    uses = {stream.name: stream.use for stream in recording.description.streams}
    assert uses["/camera/depth/camera_info"] == "camera of the scans"
    assert len(scans[0].scan) == 47
    v, u = np.nonzero(depth)
    z = depth[v, u]
    expected = np.column_stack([(u - 3.5) / 10 * z, (v - 2.5) / 10 * z, z])
    np.testing.assert_allclose(scans[0].scan.points, expected)
    np.testing.assert_allclose(scans[1].T_world_sensor, se3(1, 0, 0, 0, 0, 0) @ T_BODY_OPTICAL, atol=1e-6)


def test_depth_images_without_a_camera(tmp_path):
    def images(make):
        for i in range(2):
            yield "/odom", START + i, make.odometry(START + i, (i, 0, 0))
            yield "/depth", START + i, make.image(START + i, np.ones((4, 4), "<u2"), "16UC1")

    (missing,) = open_recording(write_bag(tmp_path, "mcap", images)).description.missing
    assert str(missing).startswith("no CameraInfo with a calibration for /depth")


def test_big_endian_depth_and_other_resolutions():
    camera = Camera(10.0, 10.0, 3.5, 2.5, 16, 12, distorted=False)
    image = Messages("mcap").image(0, np.full((6, 8), 1500, ">u2"), "16UC1", bigendian=1)
    points = depth_points(image, camera)
    np.testing.assert_allclose(points[0], [-1.75 / 5 * 1.5, -1.25 / 5 * 1.5, 1.5])
    for changes in ({"width": 9}, {"height": 2**31}, {"step": 4}, {"width": 4, "step": 8}):
        image = Messages("mcap").image(0, np.full((6, 8), 1500, "<u2"), "16UC1")
        for name, value in changes.items():
            setattr(image, name, value)
        with pytest.raises(ValueError, match=r"in 96 bytes|CameraInfo is for"):
            depth_points(image, camera)


def test_cameras_that_are_not_calibrated():
    make = Messages("mcap")
    assert Camera.of(make.camera_info(0, 0.0, 0, 0, 8, 6)) is None
    info = make.camera_info(0, 10.0, 3.5, 2.5, 8, 6)
    info.p[:], info.d[:] = 0, 0.1
    assert Camera.of(info) == Camera(10.0, 10.0, 3.5, 2.5, 8, 6, distorted=True)


# Damage


@pytest.mark.parametrize(
    ("kind", "words"),
    [("ros1", "rosbag reindex"), ("sqlite3", "sqlite3"), ("mcap", "mcap recover")],
)
@pytest.mark.parametrize("share", [0.02, 0.3, 0.66, 0.99])
def test_truncated_bags_are_refused_with_a_word(kind, words, share, tmp_path, monkeypatch):
    monkeypatch.setattr("terrainloop.io.bags.reader.can_salvage", lambda: False)
    path = write_bag(tmp_path, kind, lambda make: drive(make, scans=40))
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(TerrainLoopError) as caught:
        list(open_recording(file).scans())
    assert any(each in caught.value.mend for each in (words, "copy it again", "file of a ROS 2 bag"))


def test_a_truncated_mcap_is_salvaged(tmp_path):
    pytest.importorskip("mcap", reason="optional")
    file = write_bag(tmp_path, "mcap", lambda make: drive(make, scans=3000)) / "mcap.mcap"
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 2 // 3])
    recording, scans = recorded(file)
    assert 1000 < len(scans) < 2500
    assert any("salvaged" in words for words in recording.description.remarks)
    np.testing.assert_allclose(scans[-1].scan.points, POINTS, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bytes_never_crash(kind, tmp_path):
    """A bag with noise in it is read, or refused by our own error."""
    path = write_bag(tmp_path, kind, drive)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    content = np.frombuffer(file.read_bytes(), np.uint8)
    rng = np.random.default_rng(1)
    outcomes = []
    for _ in range(40):
        noisy = content.copy()
        at = rng.integers(0, len(noisy), 1 + rng.integers(0, 20))
        noisy[at] = rng.integers(0, 256, len(at))
        file.write_bytes(noisy.tobytes())
        try:
            outcomes.append(len(recorded(file)[1]))
        except TerrainLoopError:
            outcomes.append(-1)
    assert len(outcomes) == 40


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "empty.bag").touch()
    (tmp_path / "text.mcap").write_text("hello")
    (tmp_path / "text.db3").write_text("hello" * 1000)
    (tmp_path / "bag.tar.xz").touch()
    (tmp_path / "metadata").mkdir()
    (tmp_path / "metadata" / "metadata.yaml").write_text("a: 1")
    for name in ("empty.bag", "text.mcap", "text.db3", "bag.tar.xz", "metadata", "nothing.bag", "nothing"):
        with pytest.raises(TerrainLoopError, match=r"expected .*; found .*"):
            open_recording(tmp_path / name)
    for path in ([], None, 3):
        with pytest.raises(TerrainLoopError, match="recording"):
            open_recording(path)


def test_a_bag_with_definitions_that_cannot_be_parsed(tmp_path):
    """Standard messages are decoded as the standard has them, whatever the bag says of other types."""
    path = write_bag(tmp_path, "ros1", drive)
    content = path.read_bytes()
    assert content.count(b"float64 x") > 0
    path.write_bytes(content.replace(b"float64 x", b"flout64 x"))
    assert len(recorded(path)[1]) == 6


# Bags of others

READ = {  # what is missing in each, in part
    "ANYbotics+grid_map": "an elevation map",
    "Idate96+m545_traversability_pipeline": "an elevation map",
    "leggedrobotics+traversability_estimation": "an elevation map",
    "MichaelGrupp+evo": "no point clouds or depth images: record sensor_msgs/PointCloud2",
    "foxglove+rosbag": "no point clouds or depth images: record sensor_msgs/PointCloud2",
    "ouster-lidar+ouster-sdk": "packets of an Ouster driver",
    "rosbag-sharing-community+amber": "images without depth",
    "tier4+nebula": "packets of a Velodyne driver",
}


def real_bags():
    files = [path for suffix in ("bag", "mcap", "db3") for path in REAL.rglob(f"*.{suffix}")]
    return sorted(path.relative_to(REAL).as_posix() for path in files)


@pytest.mark.skipif(not REAL.is_dir(), reason="without the bags of others")
@pytest.mark.parametrize("name", real_bags())
def test_bags_of_others(name, monkeypatch):
    monkeypatch.setattr("terrainloop.io.bags.reader.can_salvage", lambda: False)
    owner = name.partition("/")[0]
    if owner not in READ:
        assert owner == "lichtblick-suite+lichtblick"
        with pytest.raises(TerrainLoopError, match=r"Profile is not ros2; record a ROS 2 bag"):
            open_recording(REAL / name)
        return
    recording = open_recording(REAL / name)
    assert READ[owner] in str(recording.description.missing[0])
    assert all(stream.count for stream in recording.description.streams)
    with pytest.raises(TerrainLoopError, match="expected scans with odometry; found"):
        next(recording.scans())


ARCHIVE = REAL / "ros-perception+point_cloud_transport_tutorial" / "rosbag2_d435_pointcloud2_mcap.tar.xz"


@pytest.mark.skipif(not ARCHIVE.is_file(), reason="without the bags of others")
def test_a_bag_of_a_camera_of_others(tmp_path):
    """Its clouds, in the frame of a camera, with the odometry that it lacks."""
    with pytest.raises(TerrainLoopError, match="unpack the archive first"):
        open_recording(ARCHIVE)
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    (bag,) = tmp_path.iterdir()
    recording = open_recording(bag)
    assert (recording.sensor, recording.count) == ("stereo", 263)
    assert recording.description.missing[0].what == "no odometry"
    stream = recording.description.streams[0]
    poses = tmp_path / "poses"
    poses.mkdir()

    def standing(make):
        for now in (stream.start, stream.end):
            yield "/odom", now, make.odometry(now, (0, 0, 1))

    scans = open_recording([bag, write_bag(poses, "mcap", standing)]).scans()
    posed = next(scans)
    depth = posed.scan.points[:, 2]
    assert len(depth) > 10_000
    assert 0 < depth.min() < np.median(depth) < 20
    np.testing.assert_allclose(posed.T_world_sensor, se3(0, 0, 1, 0, 0, 0) @ T_BODY_OPTICAL, atol=1e-9)
