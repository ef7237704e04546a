"""Rigid transforms as homogeneous matrices: SE(2) is (3, 3), SE(3) is (4, 4), float64.

``T_target_source`` takes points of the source frame into the target frame. Compose with ``@``.

A tangent vector of SE(3) is (wx, wy, wz, vx, vy, vz), rotation first, and perturbs on the right, in the body
frame: T exp(xi). That is GTSAM's convention (``Pose3::Expmap``); g2o files hold the translation first.
"""

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError

Array = NDArray[np.float64]

MAX_COORDINATE = 1e9  # metres; beyond it a coordinate is an error, not a place on a planet
MAX_SKEW = 1e-2  # largest entry of R R' - I that rounded digits explain


def se2(x: float, y: float, yaw: float) -> Array:
    """SE(2) transform (3, 3) from a translation in metres and a yaw in radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def rotation_about(centre: ArrayLike, yaw: float) -> Array:
    """SE(2) transform (3, 3): a rotation in radians about a point (2,) in metres."""
    T = se2(0.0, 0.0, yaw)
    T[:2, 2] = centre - T[:2, :2] @ np.asarray(centre)
    return T


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


def levelled(T: Array) -> Array:
    """The upright pose (4, 4) with the same position and yaw."""
    x, y, z = T[:3, 3]
    return se3(x, y, z, 0.0, 0.0, yaw_of(T))


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


def is_rigid(T: Array) -> bool:
    """Whether a matrix (4, 4) is a rotation and a translation with finite, plausible coordinates."""
    if T.shape != (4, 4) or not (np.abs(T) <= MAX_COORDINATE).all():
        return False
    R = T[:3, :3]
    if not (np.abs(R) <= 1 + MAX_SKEW).all() or (T[3] != (0.0, 0.0, 0.0, 1.0)).any():
        return False
    return bool((np.abs(R @ R.T - np.eye(3)) <= MAX_SKEW).all() and np.linalg.det(R) > 0)


def translation(offset: ArrayLike) -> Array:
    """SE(3) transform (4, 4) without rotation, from an offset (3,) in metres."""
    T = np.eye(4)
    T[:3, 3] = offset
    return T


def transform(T: Array, points: ArrayLike) -> Array:
    """Apply an SE(2) or SE(3) transform to points (..., 2) or (..., 3)."""
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
    rotation = (s.conj() * t).sum(axis=-1)
    rotation = np.where(rotation == 0, 1.0, rotation) / np.where(rotation == 0, 1.0, np.abs(rotation))
    shift = target_centroid - rotation * source_centroid
    T = np.zeros((*rotation.shape, 3, 3))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = rotation.real, -rotation.imag, shift.real
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = rotation.imag, rotation.real, shift.imag
    T[..., 2, 2] = 1.0
    return T


def exp_se3(tangent: ArrayLike) -> Array:
    """Exponential map of SE(3): the transform (4, 4) of a tangent vector (6,), rotation first.

    With w the rotation vector and t its length, the translation is V v, where
    V = I + (1 - cos t) / t^2 [w] + (t - sin t) / t^3 [w]^2 (Barfoot 2017, eq. 7.37).
    """
    w, v = np.split(np.asarray(tangent, dtype=float), 2)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(w).as_matrix()
    T[:3, 3] = _left_jacobian(w) @ v
    return T


def log_se3(T: Array) -> Array:
    """Logarithm of an SE(3) transform: the tangent vector (6,) whose rotation is shorter than pi."""
    w = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return np.concatenate([w, np.linalg.solve(_left_jacobian(w), T[:3, 3])])


def adjoint_se3(T: Array) -> Array:
    """Adjoint (6, 6) of an SE(3) transform, rotation first: T exp(xi) = exp(Ad xi) T."""
    R = T[:3, :3]
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = R
    adjoint[3:, :3] = cross_matrix(T[:3, 3]) @ R
    return adjoint


def cross_matrix(vector: ArrayLike) -> Array:
    """Matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = np.asarray(vector, dtype=float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


TangentOrder = Literal["gtsam", "g2o"]


def tangent_covariance(T: Array, covariance: Array, order: TangentOrder = "gtsam") -> Array:
    """Convert the covariance of a transform's parameters to that of its tangent vector.

    Parameters
    ----------
    T : array, (4, 4)
        SE(3), its pitch not +-90 degrees.
    covariance : array, (6, 6)
        Covariance of (x, y, z, roll, pitch, yaw), the parameters of `T` (see `se3`), metres and radians.
    order : {"gtsam", "g2o"}
        Rotation first, as in GTSAM's noise models, or translation first, as in g2o files.

    Returns
    -------
    array, (6, 6)
        Covariance of the tangent vector xi in T exp(xi).

    Raises
    ------
    TerrainLoopError
        For another order: rows and columns in the wrong one look just as plausible.
    """
    if order not in get_args(TangentOrder):
        raise TerrainLoopError(
            expected="the order 'gtsam' or 'g2o'", found=f"{order!r:.60}", mend="name one of the two"
        )
    _, _, _, roll, pitch, _ = parameters_of(T)
    jacobian = np.zeros((6, 6))
    jacobian[:3, 3:] = _body_rates(roll, pitch)
    jacobian[3:, :3] = T[:3, :3].T
    if order == "g2o":
        jacobian = np.roll(jacobian, 3, axis=0)
    return jacobian @ covariance @ jacobian.T


def _body_rates(roll: float, pitch: float) -> Array:
    """Angular velocity in the body frame (3,) by the rates of (roll, pitch, yaw), for Rz Ry Rx."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    return np.array([[1.0, 0.0, -sp], [0.0, cr, cp * sr], [0.0, -sr, cp * cr]])


def _left_jacobian(w: Array) -> Array:
    """V of `exp_se3`, by its series where the rotation is too small for the closed form."""
    t, W = float(np.linalg.norm(w)), cross_matrix(w)
    if t < 1e-4:
        return np.eye(3) + W / 2 + W @ W / 6
    return np.eye(3) + (1 - np.cos(t)) / t**2 * W + (t - np.sin(t)) / t**3 * W @ W
