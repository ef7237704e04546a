"""Poses of odometry messages and of TF, as tracks over time."""

from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainloop.geometry import MAX_COORDINATE
from terrainloop.io.pose_track import PoseTrack

ODOMETRY = "nav_msgs/msg/Odometry"
POSE_TYPES = (
    ODOMETRY,
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/TransformStamped",
)
"""Types of messages with a pose in three dimensions, the best first."""

_LOOSEST = 1e-2  # deviation of a quaternion's norm from 1 that rounded digits explain
_UPPER = np.triu_indices(6)


def stamp_of(header: Any) -> float:
    """Seconds of a header's stamp; zero where it is not set."""
    return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)


def frame_of(name: str) -> str:
    """The name of a frame, without the slash that tf of ROS 1 puts in front."""
    return name.strip().lstrip("/")


@dataclass
class TrackBuilder:
    """Collects poses in little memory."""

    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    covariances: "array[float]" = field(default_factory=lambda: array("f"))
    dropped: Counter[str] = field(default_factory=Counter)

    def __len__(self) -> int:
        return len(self.numbers) // 8

    def add(self, stamp: float, position: Any, quaternion: Any, covariance: Any = None) -> None:
        """Add a pose of a message, unless it is none."""
        p, q = position, quaternion
        numbers = (float(p.x), float(p.y), float(p.z), float(q.x), float(q.y), float(q.z), float(q.w))
        if not all(abs(number) <= MAX_COORDINATE for number in numbers):  # False for NaN, too
            self.dropped["are not finite"] += 1
        elif abs(sum(number * number for number in numbers[3:]) - 1) > 2 * _LOOSEST:
            self.dropped["have a quaternion that is not of norm 1"] += 1
        else:
            self.numbers.extend((stamp, *numbers))
            self.covariances.extend(_upper_of(covariance))

    def track(self) -> PoseTrack:
        """The poses as a track."""
        table = np.array(self.numbers).reshape(-1, 8)
        upper = np.array(self.covariances, dtype=np.float32).reshape(-1, len(_UPPER[0]))
        covariances = None
        if np.isfinite(upper).any():
            covariances = np.empty((len(table), 6, 6), dtype=np.float32)
            covariances[:, _UPPER[0], _UPPER[1]] = covariances[:, _UPPER[1], _UPPER[0]] = upper
        return PoseTrack(table[:, 0], table[:, 1:4], table[:, 4:], covariances)


@dataclass(frozen=True)
class StampedPose:
    """The parts of a message that holds a pose."""

    stamp: float
    frame: str
    child: str
    position: Any
    quaternion: Any
    covariance: Any = None


def pose_of(message: Any, kind: str) -> StampedPose:
    """The pose in a message of one of the `POSE_TYPES`; the child is empty where the type names none."""
    stamp, frame = stamp_of(message.header), frame_of(message.header.frame_id)
    if kind == "geometry_msgs/msg/TransformStamped":
        T = message.transform
        return StampedPose(stamp, frame, frame_of(message.child_frame_id), T.translation, T.rotation)
    child = frame_of(message.child_frame_id) if kind == ODOMETRY else ""
    with_covariance = message.pose if hasattr(message.pose, "covariance") else None
    pose = with_covariance.pose if with_covariance is not None else message.pose
    covariance = with_covariance.covariance if with_covariance is not None else None
    return StampedPose(stamp, frame, child, pose.position, pose.orientation, covariance)


def _upper_of(covariance: Any) -> NDArray[np.float64]:
    """The upper triangle of a covariance; NaN where it is not given: zeros, or a negative variance."""
    unknown = np.full(len(_UPPER[0]), np.nan)
    if covariance is None:
        return unknown
    matrix = np.asarray(covariance, dtype=np.float64).reshape(6, 6)
    diagonal = matrix.diagonal()
    known = np.isfinite(matrix).all() and (diagonal >= 0).all() and diagonal.any()
    return matrix[_UPPER] if known else unknown
