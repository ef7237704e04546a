"""Rigid transforms as homogeneous matrices: SE(2) is (3, 3), SE(3) is (4, 4), float64.

``T_target_source`` takes points of the source frame into the target frame. Compose with ``@``.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def se2(x: float, y: float, yaw: float) -> Array:
    """SE(2) transform (3, 3) from a translation in metres and a yaw in radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def yaw_of(T: Array) -> float:
    """Rotation about z, in radians within (-pi, pi], of an SE(2) or SE(3) transform."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def se3(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> Array:
    """SE(3) transform (4, 4) with rotation Rz(yaw) Ry(pitch) Rx(roll); metres and radians."""
    cr, sr = np.cos(roll), np.sin(roll)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def parameters_of(T: Array) -> Array:
    """The six numbers (x, y, z, roll, pitch, yaw) of an SE(3) transform; inverse of `se3`."""
    horizontal = np.hypot(T[0, 0], T[1, 0])
    roll, pitch = np.arctan2(T[2, 1], T[2, 2]), np.arctan2(-T[2, 0], horizontal)
    return np.array([*T[:3, 3], roll, pitch, yaw_of(T)])


def inverse(T: Array) -> Array:
    """Inverse of a rigid transform of either size."""
    R, t = T[:-1, :-1], T[:-1, -1]
    result = np.eye(len(T))
    result[:-1, :-1] = R.T
    result[:-1, -1] = -R.T @ t
    return result


def transform(T: Array, points: ArrayLike) -> Array:
    """Points (..., 2) or (..., 3) taken through an SE(2) or SE(3) transform."""
    return np.asarray(points, dtype=float) @ T[:-1, :-1].T + T[:-1, -1]


def fit_se2(source: ArrayLike, target: ArrayLike) -> Array:
    """Least-squares SE(2) transform of paired points, by centroid alignment.

    In the plane the rotation that the SVD of the cross-covariance yields has a closed form, which
    cannot return a reflection: with both sets centred, yaw = atan2(sum s x t, sum s . t).

    Parameters
    ----------
    source, target : array_like, (..., N, 2)
        Paired points, metres; leading axes hold independent problems.

    Returns
    -------
    array, (..., 3, 3)
        T_target_source minimising the sum of squared distances |target - T source|^2.
    """
    # The plane as complex numbers: a rotation is a product, and s* t = s . t + i s x t.
    source, target = (np.asarray(points, dtype=float) for points in (source, target))
    source, target = (points[..., 0] + 1j * points[..., 1] for points in (source, target))
    source_centroid, target_centroid = source.mean(axis=-1), target.mean(axis=-1)
    s, t = source - source_centroid[..., None], target - target_centroid[..., None]
    turn = (s.conj() * t).sum(axis=-1)
    turn = np.where(turn == 0, 1.0, turn) / np.where(turn == 0, 1.0, np.abs(turn))
    shift = target_centroid - turn * source_centroid
    T = np.zeros((*turn.shape, 3, 3))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = turn.real, -turn.imag, shift.real
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = turn.imag, turn.real, shift.imag
    T[..., 2, 2] = 1.0
    return T
