"""What to do about topics that hold no scans or poses yet."""

import re
from collections.abc import Iterable, Sequence

from terrainloop.io.bags.reader import Topic
from terrainloop.io.recordings import Missing

_NO_CLOUDS = (  # pattern of types, what they are, what to do
    (
        r"velodyne_msgs/",
        "packets of a Velodyne driver",
        "play them through the driver's converter (velodyne_pointcloud) and record its points",
    ),
    (
        r"(ouster_ros|ouster_sensor_msgs|ouster_msgs)/",
        "packets of an Ouster driver",
        "play them through the driver's converter (ouster_ros, replay.launch) and record /ouster/points",
    ),
    (
        r"(pandar|hesai|nebula|rslidar|robosense|sick|innovusion|seyond)\w*/.*(Scan|Packets?|Udp\w*)$",
        "packets of a LiDAR driver",
        "play them through the driver's converter and record its points",
    ),
    (
        r"livox\w*/msg/CustomMsg$",
        "Livox's own messages",
        "record with xfer_format 0, or convert them with livox_to_pointcloud2",
    ),
    (r"sensor_msgs/msg/PointCloud$", "old PointCloud messages", "convert them with point_cloud_converter"),
    (
        r"/CompressedPointCloud2?$",
        "compressed clouds",
        "decode them with point_cloud_transport's republish and record the result",
    ),
    (
        r"grid_map_msgs/",
        "an elevation map",
        "record the clouds that it was made of, or convert it to a cloud with grid_map_visualization",
    ),
    (
        r"stereo_msgs/msg/DisparityImage$",
        "disparity images",
        "play them through stereo_image_proc (point_cloud) and record its points2",
    ),
    (
        r"sensor_msgs/msg/(Laser|MultiEchoLaser)Scan$",
        "planar laser scans, which hold no terrain unless the laser is tilted",
        "assemble them into PointCloud2 with laser_assembler",
    ),
    (
        r"sensor_msgs/msg/CompressedImage$",
        "compressed images",
        "decode those of depths with image_transport's republish (compressedDepth to raw); from a stereo "
        "pair make clouds with stereo_image_proc",
    ),
    (
        r"sensor_msgs/msg/Image$",
        "images without depth",
        "from a stereo pair make clouds with stereo_image_proc and record its points2",
    ),
)
_NO_POSES = (
    (
        r"sensor_msgs/msg/Imu$",
        "an IMU, which gives gravity but no position,",
        "run an odometry on it (LiDAR-inertial or visual-inertial) and record what it publishes",
    ),
    (
        r"sensor_msgs/msg/NavSatFix$",
        "positions by satellite without attitude",
        "run robot_localization and record /odometry/filtered",
    ),
    (r"nav_msgs/msg/Path$", "a whole path", "record the Odometry that it was made of"),
    (
        r"px4_msgs/msg/VehicleOdometry$",
        "odometry of PX4 with z down (NED)",
        "convert it to nav_msgs/Odometry (ENU), as mavros does",
    ),
    (r"geometry_msgs/msg/Pose$|turtlesim/", "poses without a stamp or a frame", "record nav_msgs/Odometry"),
    (
        r"geometry_msgs/msg/Twist(Stamped)?$",
        "velocities",
        "run robot_localization and record /odometry/filtered",
    ),
)


def no_clouds(topics: Sequence[Topic]) -> Missing:
    """What is missing in a bag without scans, by what is there instead."""
    otherwise = "record sensor_msgs/PointCloud2 or depth images beside the rest"
    return _missing("no point clouds or depth images", topics, _NO_CLOUDS, otherwise)


def no_poses(topics: Sequence[Topic]) -> Missing:
    """What is missing in a bag without poses, by what is there instead."""
    otherwise = "run an odometry on the scans (such as KISS-ICP) and record it beside them"
    return _missing("no odometry", topics, _NO_POSES, otherwise)


def _missing(
    what: str, topics: Sequence[Topic], hints: Iterable[tuple[str, str, str]], otherwise: str
) -> Missing:
    for pattern, instead, fix in hints:
        found = next((topic for topic in topics if topic.count and re.search(pattern, topic.type)), None)
        if found:
            return Missing(f"{what}, but {instead} on {found.name}", fix)
    return Missing(what, otherwise)
