"""Bags of all three kinds for tests, written by rosbags."""

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

KINDS = ("ros1", "sqlite3", "mcap")
CLOUD, ODOMETRY = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry"
SECOND = 10**9
START = 1_700_000_000
XYZI = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7)]  # name, offset, datatype
LEVEL = (0.0, 0.0, 0.0, 1.0)


class Messages:
    """Makes messages of the types of one ROS."""

    def __init__(self, kind):
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        self.make = {
            name.rpartition("/")[2]: made for name, made in self.store.types.items() if "_msgs/" in name
        }

    def header(self, seconds, frame):
        nanoseconds = round(seconds * SECOND)
        stamp = self.store.types["builtin_interfaces/msg/Time"](
            sec=nanoseconds // SECOND, nanosec=nanoseconds % SECOND
        )
        return self.make["Header"](stamp=stamp, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def cloud(self, seconds, points, frame="lidar", **changes):
        rows = np.asarray(points, "<f4")
        if rows.shape[1] == 3:
            rows = np.column_stack([rows, np.arange(len(rows), dtype="<f4")])
        values = {
            "height": 1,
            "width": len(rows),
            "fields": XYZI,
            "is_bigendian": False,
            "point_step": 16,
            "row_step": 16 * len(rows),
            "data": rows.tobytes(),
            "is_dense": True,
        } | changes
        values["fields"] = [
            self.make["PointField"](name=name, offset=offset, datatype=kind, count=1)
            for name, offset, kind in values["fields"]
        ]
        values["data"] = np.frombuffer(values["data"], np.uint8)
        return self.make["PointCloud2"](header=self.header(seconds, frame), **values)

    def pose(self, xyz, quaternion=LEVEL):
        point = self.make["Point"](**dict(zip("xyz", map(float, xyz), strict=True)))
        return self.make["Pose"](position=point, orientation=self.quaternion(quaternion))

    def quaternion(self, quaternion):
        return self.make["Quaternion"](**dict(zip("xyzw", map(float, quaternion), strict=True)))

    def vector(self, xyz):
        return self.make["Vector3"](**dict(zip("xyz", map(float, xyz), strict=True)))

    def odometry(self, seconds, xyz, quaternion=LEVEL, child="base_link", covariance=None, frame="odom"):
        covariance = np.zeros(36) if covariance is None else np.asarray(covariance, float).reshape(36)
        pose = self.make["PoseWithCovariance"](pose=self.pose(xyz, quaternion), covariance=covariance)
        twist = self.make["Twist"](linear=self.vector((0, 0, 0)), angular=self.vector((0, 0, 0)))
        speed = self.make["TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
        return self.make["Odometry"](
            header=self.header(seconds, frame), child_frame_id=child, pose=pose, twist=speed
        )

    def pose_stamped(self, seconds, xyz, quaternion=LEVEL, frame="odom"):
        return self.make["PoseStamped"](header=self.header(seconds, frame), pose=self.pose(xyz, quaternion))

    def pose_with_covariance(self, seconds, xyz, covariance, frame="odom"):
        pose = self.make["PoseWithCovariance"](pose=self.pose(xyz), covariance=np.reshape(covariance, 36))
        return self.make["PoseWithCovarianceStamped"](header=self.header(seconds, frame), pose=pose)

    def tf(self, *transforms):
        """Transforms (seconds, parent, child, xyz, quaternion) in one message."""
        made = [
            self.make["TransformStamped"](
                header=self.header(seconds, parent),
                child_frame_id=child,
                transform=self.make["Transform"](
                    translation=self.vector(xyz), rotation=self.quaternion(quaternion)
                ),
            )
            for seconds, parent, child, xyz, quaternion in transforms
        ]
        return self.store.types[TF](transforms=made)

    def image(self, seconds, depth, encoding, frame="camera_depth_optical_frame", bigendian=0):
        return self.make["Image"](
            header=self.header(seconds, frame),
            height=depth.shape[0],
            width=depth.shape[1],
            encoding=encoding,
            is_bigendian=bigendian,
            step=depth.shape[1] * depth.itemsize,
            data=np.frombuffer(depth.tobytes(), np.uint8),
        )

    def camera_info(self, seconds, fx, cx, cy, width, height, frame="camera_depth_optical_frame"):
        names = {
            "d": np.zeros(5),
            "k": np.array([fx, 0, cx, 0, fx, cy, 0, 0, 1.0]),
            "r": np.eye(3).reshape(9),
        }
        names["p"] = np.array([fx, 0, cx, 0, 0, fx, cy, 0, 0, 0, 1, 0.0])
        roi = self.make["RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make["CameraInfo"](
            header=self.header(seconds, frame),
            height=height,
            width=width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **{name.upper() if self.ros1 else name: value for name, value in names.items()},
        )


TF = "tf2_msgs/msg/TFMessage"


def write_bag(folder, kind, messages_of, compression=None):
    """Write messages (topic, bag time in seconds, message) that `messages_of` makes, and return the path."""
    make = Messages(kind)
    if kind == "ros1":
        make.store.register({TF: get_typestore(Stores.ROS2_HUMBLE).fielddefs[TF]})
        path = folder / "a.bag"
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression])
    else:
        path = folder / kind
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if compression:
            writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    serialize = make.store.serialize_ros1 if kind == "ros1" else make.store.serialize_cdr
    with writer:
        connections = {}
        for topic, seconds, message in messages_of(make):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=make.store)
            writer.write(connections[topic], round(seconds * SECOND), serialize(message, name))
    return path


def yaw(angle):
    """Quaternion of a rotation about z."""
    return (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2))
