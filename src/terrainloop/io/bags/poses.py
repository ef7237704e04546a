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
_UPPER_OF_36 = 6 * _UPPER[0] + _UPPER[1]
_NO_COVARIANCE = np.full(len(_UPPER_OF_36), np.nan, dtype=np.float32).tobytes()


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
            self.covariances.frombytes(_upper_of(covariance))

    def track(self) -> PoseTrack:
        """The poses as a track."""
        table = np.array(self.numbers).reshape(-1, 8)
        covariances = _full(np.array(self.covariances, dtype=np.float32).reshape(-1, len(_UPPER[0])))
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


def _upper_of(covariance: Any) -> bytes:
    """The upper triangle of a covariance in single precision; NaN where there is none."""
    if covariance is None:
        return _NO_COVARIANCE
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(covariance, dtype=np.float64)[_UPPER_OF_36].astype(np.float32).tobytes()


def _full(upper: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """Covariances (N, 6, 6), NaN where zeros or negative variances say that there is none; None if all do."""
    covariances = np.empty((len(upper), 6, 6), dtype=np.float32)
    covariances[:, _UPPER[0], _UPPER[1]] = covariances[:, _UPPER[1], _UPPER[0]] = upper
    variances = upper[:, _UPPER[0] == _UPPER[1]]
    known = np.isfinite(upper).all(axis=1) & (variances >= 0).all(axis=1) & (variances > 0).any(axis=1)
    covariances[~known] = np.nan
    return covariances if known.any() else None
