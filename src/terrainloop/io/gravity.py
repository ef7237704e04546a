"""Whether the world of an odometry has z up, and sensor frames that have z forward."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

T_BODY_OPTICAL = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From the frame of a camera (x right, y down, z forward) into that of a body (x forward, y left, z up)."""

_PLANAR = 1e-4  # metres of height and radians of tilt within which odometry does not know of any ...
_DRIVEN = 1.0  # ... although it has come so many metres from its start
_STEEPEST = np.cos(np.radians(45.0))  # a rover's body is tilted less than this for most of a drive
_UPRIGHT = np.cos(np.radians(30.0))  # of an axis that is vertical for all of a drive


def is_optical(frame: str) -> bool:
    """Whether a frame is that of a camera by its name, as REP 103 asks for."""
    return "optical" in frame.lower()


def why_not_upright(rotations: Array, frame: str) -> str:
    """Why the world of these rotations (N, 3, 3) of a frame does not have z up; empty if it may have.

    The frame is that of a body with z up or, if its name says so, that of a camera with y down; the tilt is
    judged by its median, so slopes do not matter.
    """
    optical = is_optical(frame)
    up = -rotations[:, 2, 1] if optical else rotations[:, 2, 2]
    turned_about_y = rotations[:, 1, 1].min() > _UPRIGHT and rotations[:, 2, 2].min() < _STEEPEST
    if turned_about_y or (optical and np.median(up) < _STEEPEST < np.median(rotations[:, 1, 1])):
        return "its world has the y axis vertical, as that of a camera (z forward, y down)"
    if np.median(up) < -_STEEPEST:
        return "its world or its body has z down (NED)"
    if np.median(up) < _STEEPEST:
        tilt = np.degrees(np.arccos(np.median(up)))
        return f"{frame or 'its frame'} is tilted by {tilt:.0f} deg in the median"
    return ""


def is_planar(positions: Array, rotations: Array) -> bool:
    """Whether positions (N, 3) and rotations (N, 3, 3) of a drive stay in a plane, as those of wheels."""
    driven = np.hypot(*np.ptp(positions[:, :2], axis=0))
    level = np.abs(rotations[:, 2, :2]).max() < _PLANAR and np.ptp(positions[:, 2]) < _PLANAR
    return bool(driven > _DRIVEN and level)
