"""Poses over time: sorted by stamp, and interpolated between stamps."""

from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from terrainloop.errors import TerrainLoopError
from terrainloop.io.trajectories import Trajectory

Array = NDArray[np.float64]

_SHORTEST_GAP = 1.0  # seconds; poses at most so far apart are always interpolated between ...
_STEPS_OF_GAP = 5.0  # ... and others if their distance in time is at most so many median steps
_STILL = 1e-6  # metres and quaternion units within which a transform is constant


@dataclass(frozen=True, eq=False, repr=False)
class PoseTrack:
    """Poses of a frame, with increasing stamps.

    Parameters
    ----------
    stamps : array, (N,)
        Seconds, in any order; of poses with one stamp the first is kept.
    positions : array, (N, 3)
        Metres.
    quaternions : array, (N, 4)
        x, y, z, w.
    covariances : array, (N, 6, 6), optional
        NaN where none is known.

    Raises
    ------
    TerrainLoopError
        If there is no pose.
    """

    stamps: Array
    positions: Array
    quaternions: Array
    covariances: NDArray[np.floating] | None = None

    def __post_init__(self) -> None:
        stamps, order = np.unique(np.asarray(self.stamps, dtype=np.float64), return_index=True)
        if len(stamps) == 0:
            raise TerrainLoopError(expected="at least one pose", found="none", mend="record odometry")
        object.__setattr__(self, "stamps", stamps)
        for name in ("positions", "quaternions", "covariances"):
            values = getattr(self, name)
            object.__setattr__(self, name, None if values is None else np.asarray(values)[order])

    @classmethod
    def of(cls, trajectory: Trajectory) -> "PoseTrack":
        """The track of a trajectory."""
        quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat()
        return cls(trajectory.stamps, trajectory.poses[:, :3, 3], quaternions)

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def span(self) -> tuple[float, float]:
        """First and last stamp."""
        return float(self.stamps[0]), float(self.stamps[-1])

    @cached_property
    def still(self) -> bool:
        """Whether all poses are the same."""
        signs = np.where(self.quaternions @ self.quaternions[0] < 0, -1.0, 1.0)
        spread = np.ptp(self.positions, axis=0).max(), np.ptp(signs[:, None] * self.quaternions, axis=0).max()
        return bool(max(spread) <= _STILL)

    @cached_property
    def longest_gap(self) -> float:
        """Seconds between two poses beyond which nothing is interpolated."""
        steps = np.diff(self.stamps)
        return max(_SHORTEST_GAP, _STEPS_OF_GAP * float(np.median(steps)) if len(steps) else 0.0)

    @cached_property
    def rotations(self) -> Array:
        """All rotations as matrices, (N, 3, 3)."""
        return Rotation.from_quat(self.quaternions).as_matrix()

    def at(self, stamp: float) -> Array | None:
        """The pose (4, 4) at a stamp: linear in position, slerp in rotation; None outside and in gaps."""
        after = bisect_left(self.stamps, stamp)
        if after < len(self) and self.stamps[after] == stamp:
            return self._pose(self.positions[after], Rotation.from_quat(self.quaternions[after]))
        if not self._covers(after):
            return None
        pair = slice(after - 1, after + 1)
        start, end = self.stamps[pair]
        share = (stamp - start) / (end - start)
        rotation = Slerp([0.0, 1.0], Rotation.from_quat(self.quaternions[pair]))([share])[0]
        before, next_ = self.positions[pair]
        return self._pose(before + share * (next_ - before), rotation)

    def covariance_at(self, stamp: float) -> Array | None:
        """The covariance (6, 6) of the pose nearest in time, if it is known."""
        if self.covariances is None:
            return None
        after = min(bisect_left(self.stamps, stamp), len(self) - 1)
        before = max(after - 1, 0)
        nearest = before if stamp - self.stamps[before] < self.stamps[after] - stamp else after
        covariance = np.array(self.covariances[nearest], dtype=np.float64)
        return covariance if np.isfinite(covariance).all() else None

    def _covers(self, after: int) -> bool:
        inside = 0 < after < len(self)
        return inside and self.stamps[after] - self.stamps[after - 1] <= self.longest_gap

    @staticmethod
    def _pose(position: Array, rotation: Rotation) -> Array:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation.as_matrix(), position
        return T
