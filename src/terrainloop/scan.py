"""Scans: what a sensor saw at one time, before scans are joined into submaps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrainloop.arrays import ReadOnlyArrays, read_only
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import MAX_COORDINATE, is_rigid


@dataclass(frozen=True, eq=False, repr=False)
class Scan(ReadOnlyArrays):
    """Points of one scan or one depth image, in the frame of the sensor.

    Parameters
    ----------
    points : array_like, (N, 3)
        Metres. Rows with NaN, infinity or coordinates that are none are dropped; N may be zero.
    stamp : float
        Seconds.
    intensity : array_like, (N,), optional
        One value per point; rows dropped from `points` are dropped here too.

    Raises
    ------
    TerrainLoopError
        If the shapes do not fit, or the stamp is not finite.
    """

    points: NDArray[np.float64]
    stamp: float = 0.0
    intensity: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        points = _numbers(self.points, "points (N, 3)")
        if points.ndim != 2 or points.shape[1] != 3:
            raise _refused("points (N, 3)", f"an array of shape {points.shape}")
        if not isinstance(self.stamp, int | float | np.number) or not np.isfinite(self.stamp):
            raise _refused("a finite stamp in seconds", f"{self.stamp!r:.40}")
        usable = (np.abs(points) < MAX_COORDINATE).all(axis=1)  # False for NaN, too
        object.__setattr__(self, "points", read_only(points[usable]))
        object.__setattr__(self, "stamp", float(self.stamp))
        if self.intensity is not None:
            intensity = _numbers(self.intensity, "intensity (N,)")
            if intensity.shape != (len(points),):
                raise _refused(f"one intensity for each of {len(points)} points", f"shape {intensity.shape}")
            object.__setattr__(self, "intensity", read_only(intensity[usable]))

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"Scan({len(self)} points, stamp {self.stamp:.6f})"


@dataclass(frozen=True, eq=False, repr=False)
class PosedScan(ReadOnlyArrays):
    """A scan and the pose that odometry gives its sensor.

    Parameters
    ----------
    scan : Scan
    T_world_sensor : array_like, (4, 4)
        In a world with z up; metres.
    covariance : array_like, (6, 6), optional
        Covariance of the odometry's pose as it was published, in the order of ROS: x, y, z and the rotations
        about the fixed axes x, y, z of the world; metres and radians.

    Raises
    ------
    TerrainLoopError
        If the pose is not rigid, or the covariance of another shape or not finite.
    """

    scan: Scan
    T_world_sensor: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        pose = _numbers(self.T_world_sensor, "a pose (4, 4)")
        if not is_rigid(pose):
            raise _refused("a rigid transform (4, 4)", f"an array of shape {pose.shape} that is none")
        object.__setattr__(self, "T_world_sensor", read_only(pose))
        if self.covariance is not None:
            covariance = _numbers(self.covariance, "a covariance (6, 6)")
            if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
                raise _refused("a finite covariance (6, 6)", f"an array of shape {covariance.shape}")
            object.__setattr__(self, "covariance", read_only(covariance))

    def __repr__(self) -> str:
        x, y, z = self.T_world_sensor[:3, 3]
        return f"PosedScan({self.scan!r} at ({x:.2f}, {y:.2f}, {z:.2f}) m)"


def _numbers(values: object, expected: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise _refused(expected, str(error)) from error
    if array.dtype.kind not in "iuf":
        raise _refused(expected, f"values of type {array.dtype}")
    return array.astype(np.float64)


def _refused(expected: str, found: str) -> TerrainLoopError:
    return TerrainLoopError(expected=expected, found=found, mend="see the documentation of Scan")
