"""Drives as bags of ROS 1 and ROS 2, by rosbags."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array
from terrainloop.io.trajectories import write_tum
from terrainloop.simulation.drives import Drive, trajectories

TRANSFORMS = "tf2_msgs/msg/TFMessage"
WORLD, BODY, SENSOR = "odom", "base_link", "sensor"
EPOCH = 1_700_000_000  # seconds, of stamp zero
FLOAT32 = 7  # of sensor_msgs/PointField


def write_bag(drive: Drive, path: Path | str, kind: str = "mcap") -> None:
    """Write a bag with PointCloud2, Odometry and /tf_static, and the true poses beside it.

    Parameters
    ----------
    drive : Drive
    path : Path or str
        The folder of a ROS 2 bag, or the file of a ROS 1 bag; must not exist. Beside it is written
        ``NAME_truth.tum``: the poses of the sensor at the stamps of the bag.
    kind : {"mcap", "sqlite3", "ros1"}

    Raises
    ------
    TerrainLoopError
        If there is something at the path, or for another kind.
    """
    path = Path(path)
    if path.exists():
        raise TerrainLoopError(
            expected=f"nothing at {path}", found="a file or a folder", mend="name another path"
        )
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if TRANSFORMS not in store.types:  # ROS 1 has it in a package of its own
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    path.parent.mkdir(parents=True, exist_ok=True)
    connections: dict[str, Any] = {}
    with _writer(path, kind) as writer:
        for topic, stamp, message in _messages(drive, store.types, ros1=kind == "ros1"):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(connections[topic], stamp, serialize(message, message.__msgtype__))
    truth = trajectories(drive)["truth.tum"]
    write_tum(path.parent / f"{path.stem}_truth.tum", type(truth)(truth.stamps + EPOCH, truth.poses))


def _writer(path: Path, kind: str) -> Any:
    plugins = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
    if kind == "ros1":
        return Ros1Writer(path)
    if kind not in plugins:
        raise TerrainLoopError(
            expected="mcap, sqlite3 or ros1", found=f"{kind!r:.40}", mend="name one of these kinds of bag"
        )
    return Ros2Writer(path, version=9, storage_plugin=plugins[kind])


def _messages(drive: Drive, types: Any, *, ros1: bool) -> Iterator[tuple[str, int, Any]]:
    """Topic, stamp in nanoseconds and message."""

    def header(stamp: int, frame: str) -> Any:
        seconds, rest = divmod(stamp, 10**9)
        time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **({"seq": 0} if ros1 else {}))

    first = EPOCH * 10**9
    mounted = _transform(types, header(first, BODY), drive.setup.T_body_sensor)
    yield "/tf_static", first, types[TRANSFORMS](transforms=[mounted])
    for posed, T in zip(drive.scans(), drive.odometry, strict=True):
        stamp = first + round(posed.scan.stamp * 1e9)
        yield "/odom", stamp, _odometry(types, header(stamp, WORLD), T)
        yield "/points", stamp, _cloud(types, header(stamp, SENSOR), posed.scan.points)


def _pose(types: Any, T: Array, position: str) -> tuple[Any, Any]:
    """Position of a type, and quaternion."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    px, py, pz = T[:3, 3].tolist()
    return types[position](x=px, y=py, z=pz), types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _transform(types: Any, header: Any, T: Array) -> Any:
    translation, rotation = _pose(types, T, "geometry_msgs/msg/Vector3")
    transform = types["geometry_msgs/msg/Transform"](translation=translation, rotation=rotation)
    return types["geometry_msgs/msg/TransformStamped"](
        header=header, child_frame_id=SENSOR, transform=transform
    )


def _odometry(types: Any, header: Any, T: Array) -> Any:
    position, orientation = _pose(types, T, "geometry_msgs/msg/Point")
    pose = types["geometry_msgs/msg/Pose"](position=position, orientation=orientation)
    still = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    unknown = np.zeros(36)
    return types["nav_msgs/msg/Odometry"](
        header=header,
        child_frame_id=BODY,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=unknown),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=still, angular=still), covariance=unknown
        ),
    )


def _cloud(types: Any, header: Any, points: Array) -> Any:
    field = types["sensor_msgs/msg/PointField"]
    fields = [
        field(name=name, offset=4 * k, datatype=FLOAT32, count=1) for k, name in enumerate(("x", "y", "z"))
    ]
    return types["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=np.ascontiguousarray(points, dtype="<f4").view(np.uint8).reshape(-1),
        is_dense=True,
    )
