"""From an SE(2) alignment to SE(3): height and tilt from the elevations, and the covariance.

Everything is estimated about a pivot, the middle of the overlap, where a tilt causes no horizontal motion;
only then is it referred to the maps' local origins.
"""

from dataclasses import dataclass

import numpy as np

from terrainloop.config import Calibration
from terrainloop.geometry import Array, cross_matrix, inverse, se3, transform, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.covariance import block_covariance
from terrainloop.matching.overlay import Overlay

MIN_PIXELS = 10  # needed to determine a tilt
OUTLIER = 3.0  # robust standard deviations beyond which an elevation difference is an outlier


@dataclass(frozen=True, eq=False)
class PlanarPrecision:
    """How well an SE(2) alignment is known.

    Attributes
    ----------
    pivot : array, (2,)
        Point of the target frame that the covariance refers to, metres; best in the middle of the overlap.
    covariance : array, (3, 3)
        Covariance of (x, y, yaw) at the pivot, metres and radians.
    strain_variance : float
        Variance of the strain of each submap; zero if rigid (see
        `terrainloop.matching.refine.Refinement`).
    """

    pivot: Array
    covariance: Array
    strain_variance: float = 0.0


def lift_to_se3(
    overlay: Overlay, precision: PlanarPrecision, calibration: Calibration
) -> tuple[Array, Array]:
    """SE(3) transform and covariance from an SE(2) alignment.

    Over the overlap the target's elevation minus the source's is, to first order in a small
    tilt w about the target's horizontal axes, z + w_x y - w_y x about the pivot: a plane.

    Parameters
    ----------
    overlay : Overlay
        The two maps at the alignment.
    precision : PlanarPrecision
    calibration : Calibration

    Returns
    -------
    T_target_source : array, (4, 4)
    covariance : array, (6, 6)
        Covariance of (x, y, z, roll, pitch, yaw) of the transform between the maps' local origins; NaN where
        the overlap is too small to determine the tilt.
    """
    source, target, T_planar = overlay.source, overlay.target, overlay.T_target_source
    pivot = precision.pivot
    height = overlay.of_source(source.elevation)
    difference = overlay.of_target(target.elevation) - height
    block = calibration.block * target.parameters.length_scale
    plane = _fit_plane(overlay.positions - pivot, difference, block)
    if plane is None:
        no_tilt = se3(T_planar[0, 2], T_planar[1, 2], 0.0, 0.0, 0.0, yaw_of(T_planar))
        return no_tilt, np.full((6, 6), np.nan)
    (z, w_x, w_y), covariance_plane = plane
    R = (se3(0, 0, 0, w_x, w_y, 0) @ se3(0, 0, 0, 0, 0, yaw_of(T_planar)))[:3, :3]
    pivot_source = np.array([*transform(inverse(T_planar), pivot), height.mean()])
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.array([*pivot, height.mean() + z]) - R @ pivot_source
    covariance = np.zeros((6, 6))
    covariance[np.ix_([0, 1, 5], [0, 1, 5])] = precision.covariance
    covariance[np.ix_([2, 3, 4], [2, 3, 4])] = covariance_plane
    reach = _reach(target, pivot) ** 2 + _reach(source, pivot_source[:2]) ** 2
    by_strain = [*(reach * f for f in calibration.motion_by_strain), *calibration.rotation_by_strain]
    covariance += precision.strain_variance * np.diag(by_strain)
    return T, _at_local_origin(covariance, R @ (pivot_source - source.local_origin), yaw_of(T))


def _fit_plane(positions: Array, difference: Array, block: float) -> tuple[Array, Array] | None:
    """(z, w_x, w_y) by least squares with outliers rejected once, and covariance; None if undetermined."""
    if len(positions) < MIN_PIXELS:
        return None
    design = np.stack([np.ones(len(positions)), positions[:, 1], -positions[:, 0]], axis=1)
    keep = np.ones(len(difference), dtype=bool)
    for _ in range(2):
        plane = np.linalg.lstsq(design[keep], difference[keep], rcond=None)[0]
        residual = difference - design @ plane
        spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
        kept, keep = keep, np.abs(residual) <= max(OUTLIER * spread, 1e-9)
    covariance = block_covariance(
        design[kept], residual[kept], design[kept].T @ design[kept], positions[kept], block
    )
    return None if np.isnan(covariance).any() else (np.asarray(plane, dtype=float), covariance)


def covariance_of_inliers(matched: Array, residuals: Array, floor: float) -> Array:
    """Covariance of a least-squares SE(2) fit of keypoints, from its own scatter.

    Parameters
    ----------
    matched : array, (n, 2)
        Inlier keypoints of the source, in the target frame relative to the pivot, metres.
    residuals : array, (n, 2)
        Their differences from the target's keypoints, metres.
    floor : float
        Minimum standard deviation of a keypoint, metres.

    Returns
    -------
    array, (3, 3)
        Covariance of (x, y, yaw) at the pivot.
    """
    jacobian = np.zeros((2 * len(matched), 3))
    jacobian[0::2, 0] = jacobian[1::2, 1] = 1.0
    jacobian[0::2, 2], jacobian[1::2, 2] = -matched[:, 1], matched[:, 0]
    scatter = (residuals**2).sum() / max(2 * len(matched) - 3, 1)
    information = jacobian.T @ jacobian + 1e-9 * np.eye(3)  # coincident inliers leave yaw undetermined
    return np.asarray(max(scatter, floor**2) * np.linalg.inv(information))


def _reach(gradient_map: GradientMap, position: Array) -> float:
    """Distance from a position to the local origin, or to the point of the map nearest to it, metres.

    Over this distance a submap that is not rigid has accumulated its errors.
    """
    low = np.array(gradient_map.origin)
    rows, columns = gradient_map.mask.shape
    high = low + gradient_map.resolution * np.array([columns - 1, rows - 1])
    return float(np.hypot(*(position - np.clip(gradient_map.local_origin[:2], low, high))))


def _at_local_origin(covariance: Array, arm: Array, yaw: float) -> Array:
    """Convert the covariance of (x, y, z, w_x, w_y, yaw) at the pivot to (x, y, z, roll, pitch, yaw).

    The translation is the pivot minus the arm, which leads there from the source's local origin; a rotation w
    changes the arm by w x arm. Roll and pitch are about the source's axes, w_x and w_y about the target's.
    """
    jacobian = np.eye(6)
    jacobian[:3, 3:] = cross_matrix(arm)
    c, s = np.cos(yaw), np.sin(yaw)
    jacobian[3:5, 3:5] = [[c, s], [-s, c]]
    moved = jacobian @ covariance @ jacobian.T
    return (moved + moved.T) / 2  # rounding breaks the symmetry
