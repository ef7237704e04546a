"""From an SE(2) alignment to SE(3): height and tilt from the elevations, and the covariance.

Everything is estimated about a pivot, the middle of the shared ground, where a tilt moves nothing
sideways; only then is it referred to the frames' origins, which may be far away (UTM).
"""

import numpy as np
from numpy.typing import NDArray

from terrainloop.geometry import Array, inverse, se3, transform, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.ssd import shared_ground, warp

CLIP = 3.0  # robust standard deviations beyond which an elevation difference is an outlier


def lift_to_se3(
    source: GradientMap, target: GradientMap, T_planar: Array, matched: Array, residuals: Array
) -> tuple[Array, Array]:
    """SE(3) transform and covariance from an SE(2) alignment.

    Over the shared ground the target's elevation minus the source's is, to first order in a small
    tilt w about the target's horizontal axes, z + w_x y - w_y x about the pivot: a plane.

    Parameters
    ----------
    source, target : GradientMap
    T_planar : array, (3, 3)
        SE(2) T_target_source.
    matched : array, (n, 2)
        Inlying keypoints of the source, in the target frame, metres.
    residuals : array, (n, 2)
        Their distances to the target's keypoints, metres.

    Returns
    -------
    T_target_source : array, (4, 4)
    covariance : array, (6, 6)
        Of (x, y, z, roll, pitch, yaw); NaN where too little ground is shared to tell the tilt.
    """
    both = shared_ground(source, target, T_planar)
    if both.sum() * target.resolution**2 <= 4 * _independent_area(target):
        no_tilt = se3(T_planar[0, 2], T_planar[1, 2], 0.0, 0.0, 0.0, yaw_of(T_planar))
        return no_tilt, np.full((6, 6), np.nan)
    rows, columns = np.nonzero(both)
    ground = np.stack([columns, rows], axis=1) * target.resolution + target.origin
    height = warp(source.elevation, source, target, T_planar)[both].astype(float)
    pivot = ground.mean(axis=0)
    independent = len(ground) * target.resolution**2 / _independent_area(target)
    (z, w_x, w_y), covariance_plane = _fit_plane(ground - pivot, target.elevation[both] - height, independent)

    R = (se3(0, 0, 0, w_x, w_y, 0) @ se3(0, 0, 0, 0, 0, yaw_of(T_planar)))[:3, :3]
    arm = R @ np.array([*transform(inverse(T_planar), pivot), height.mean()])  # source origin to pivot
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.array([*pivot, height.mean() + z]) - arm
    floor = max(source.resolution, target.resolution) / np.sqrt(12)  # a keypoint is no better than that
    covariance_planar = _planar_covariance(matched - pivot, residuals, floor)
    return T, _at_source_origin(covariance_planar, covariance_plane, arm, yaw_of(T))


def _independent_area(gradient_map: GradientMap) -> float:
    """Ground over which residuals are correlated, m^2: the integral of exp(-d^2 / l^2)."""
    return float(np.pi * gradient_map.parameters.length_scale**2)


def _fit_plane(ground: Array, difference: NDArray[np.floating], independent: float) -> tuple[Array, Array]:
    """(z, w_x, w_y) by least squares with outliers clipped once; covariance for `independent` samples."""
    design = np.stack([np.ones(len(ground)), ground[:, 1], -ground[:, 0]], axis=1)
    keep = np.ones(len(difference), dtype=bool)
    for _ in range(2):
        plane = np.linalg.lstsq(design[keep], difference[keep], rcond=None)[0]
        residual = difference - design @ plane
        spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
        kept, keep = keep, np.abs(residual) <= max(CLIP * spread, 1e-9)
    per_sample = (residual[kept] ** 2).sum() / (independent - 3)
    return plane, per_sample * np.linalg.inv(design[kept].T @ design[kept])


def _planar_covariance(matched: Array, residuals: Array, floor: float) -> Array:
    """Covariance (3, 3) of (x, y, yaw) at the pivot of the SE(2) fit, from its own scatter."""
    jacobian = np.zeros((2 * len(matched), 3))
    jacobian[0::2, 0] = jacobian[1::2, 1] = 1.0
    jacobian[0::2, 2], jacobian[1::2, 2] = -matched[:, 1], matched[:, 0]
    scatter = (residuals**2).sum() / max(2 * len(matched) - 3, 1)
    information = jacobian.T @ jacobian + 1e-9 * np.eye(3)  # inliers in one spot leave yaw open
    return max(scatter, floor**2) * np.linalg.inv(information)


def _at_source_origin(covariance_planar: Array, covariance_plane: Array, arm: Array, yaw: float) -> Array:
    """(x, y, yaw) and (z, w_x, w_y) at the pivot into (x, y, z, roll, pitch, yaw) of the transform.

    The translation is pivot - arm, and a rotation w turns the arm by w x arm; roll and pitch turn
    about the source's axes, w_x and w_y about the target's.
    """
    covariance = np.zeros((6, 6))
    covariance[np.ix_([0, 1, 5], [0, 1, 5])] = covariance_planar
    covariance[np.ix_([2, 3, 4], [2, 3, 4])] = covariance_plane
    jacobian = np.eye(6)
    jacobian[:3, 3:] = [[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]]
    c, s = np.cos(yaw), np.sin(yaw)
    jacobian[3:5, 3:5] = [[c, s], [-s, c]]
    moved = jacobian @ covariance @ jacobian.T
    return (moved + moved.T) / 2  # rounding breaks the symmetry
