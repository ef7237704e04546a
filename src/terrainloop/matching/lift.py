"""From an SE(2) alignment to SE(3): height and tilt from the elevations, and the covariance.

Everything is estimated about a pivot, the middle of the shared ground, where a tilt moves nothing
sideways; only then is it referred to the frames' origins, which may be far away (UTM).
"""

import numpy as np

from terrainloop.geometry import Array, inverse, se3, transform, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.covariance import block_covariance
from terrainloop.matching.ssd import ground_of, shared_ground, warp

# Variance of (x, y, z) per squared metre of way, and of (w_x, w_y, yaw), in that of a submap's strain.
# Measured on simulated drives: heading drifts, the direction of gravity does not.
MOTION_BY_STRAIN = (2.0, 2.0, 0.5)
ROTATION_BY_STRAIN = (0.7, 0.7, 8.0)
FEWEST = 10  # pixels that tell a tilt
CLIP = 3.0  # robust standard deviations beyond which an elevation difference is an outlier


def lift_to_se3(
    source: GradientMap,
    target: GradientMap,
    T_planar: Array,
    pivot: Array,
    covariance_planar: Array,
    *,
    strain_variance: float = 0.0,
    step: int = 1,
) -> tuple[Array, Array]:
    """SE(3) transform and covariance from an SE(2) alignment.

    Over the shared ground the target's elevation minus the source's is, to first order in a small
    tilt w about the target's horizontal axes, z + w_x y - w_y x about the pivot: a plane.

    Parameters
    ----------
    source, target : GradientMap
    T_planar : array, (3, 3)
        SE(2) T_target_source.
    pivot : array, (2,)
        About which the alignment turns, in the target frame, metres; best in the middle of the shared
        ground.
    covariance_planar : array, (3, 3)
        Of (x, y, yaw) at the pivot, metres and radians.
    strain_variance : float
        Of each submap, where they are not rigid (see `terrainloop.matching.refine.Refinement`).
    step : int
        Look at every step-th row and column of the target only.

    Returns
    -------
    T_target_source : array, (4, 4)
    covariance : array, (6, 6)
        Of (x, y, z, roll, pitch, yaw); NaN where too little ground is shared to tell the tilt.
    """
    both = shared_ground(source, target, T_planar, step)
    ground = ground_of(both, target, step)
    height = warp(source.elevation, source, target, T_planar, step)[both].astype(float)
    difference = target.elevation[::step, ::step][both] - height
    plane = _fit_plane(ground - pivot, difference, target.parameters.length_scale)
    if plane is None:
        no_tilt = se3(T_planar[0, 2], T_planar[1, 2], 0.0, 0.0, 0.0, yaw_of(T_planar))
        return no_tilt, np.full((6, 6), np.nan)
    (z, w_x, w_y), covariance_plane = plane
    R = (se3(0, 0, 0, w_x, w_y, 0) @ se3(0, 0, 0, 0, 0, yaw_of(T_planar)))[:3, :3]
    arm = R @ np.array([*transform(inverse(T_planar), pivot), height.mean()])  # source origin to pivot
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.array([*pivot, height.mean() + z]) - arm
    covariance = np.zeros((6, 6))
    covariance[np.ix_([0, 1, 5], [0, 1, 5])] = covariance_planar
    covariance[np.ix_([2, 3, 4], [2, 3, 4])] = covariance_plane
    reach = _reach(target, pivot) ** 2 + _reach(source, transform(inverse(T_planar), pivot)) ** 2
    by_strain = [*(reach * factor for factor in MOTION_BY_STRAIN), *ROTATION_BY_STRAIN]
    covariance += strain_variance * np.diag(by_strain)
    return T, _at_source_origin(covariance, arm, yaw_of(T))


def _fit_plane(ground: Array, difference: Array, length_scale: float) -> tuple[Array, Array] | None:
    """(z, w_x, w_y) by least squares with outliers clipped once, and covariance; None if undetermined."""
    if len(ground) < FEWEST:
        return None
    design = np.stack([np.ones(len(ground)), ground[:, 1], -ground[:, 0]], axis=1)
    keep = np.ones(len(difference), dtype=bool)
    for _ in range(2):
        plane = np.linalg.lstsq(design[keep], difference[keep], rcond=None)[0]
        residual = difference - design @ plane
        spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
        kept, keep = keep, np.abs(residual) <= max(CLIP * spread, 1e-9)
    covariance = block_covariance(
        design[kept], residual[kept], design[kept].T @ design[kept], ground[kept], length_scale
    )
    return None if np.isnan(covariance).any() else (np.asarray(plane, dtype=float), covariance)


def covariance_of_inliers(matched: Array, residuals: Array, floor: float) -> Array:
    """Covariance of a least-squares SE(2) fit of keypoints, from its own scatter.

    Parameters
    ----------
    matched : array, (n, 2)
        Inlying keypoints of the source, in the target frame relative to the pivot, metres.
    residuals : array, (n, 2)
        Their distances to the target's keypoints, metres.
    floor : float
        The least standard deviation of a keypoint, metres.

    Returns
    -------
    array, (3, 3)
        Of (x, y, yaw) at the pivot.
    """
    jacobian = np.zeros((2 * len(matched), 3))
    jacobian[0::2, 0] = jacobian[1::2, 1] = 1.0
    jacobian[0::2, 2], jacobian[1::2, 2] = -matched[:, 1], matched[:, 0]
    scatter = (residuals**2).sum() / max(2 * len(matched) - 3, 1)
    information = jacobian.T @ jacobian + 1e-9 * np.eye(3)  # inliers in one spot leave yaw open
    return np.asarray(max(scatter, floor**2) * np.linalg.inv(information))


def _reach(gradient_map: GradientMap, place: Array) -> float:
    """From a place to the origin of the map's frame, or to where the map is nearest to it, metres.

    Over this way a submap that is not rigid has carried its errors along.
    """
    low = np.array(gradient_map.origin)
    rows, columns = gradient_map.mask.shape
    anchor = np.clip(0.0, low, low + gradient_map.resolution * np.array([columns - 1, rows - 1]))
    return float(np.hypot(*(place - anchor)))


def _at_source_origin(covariance: Array, arm: Array, yaw: float) -> Array:
    """From (x, y, z, w_x, w_y, yaw) at the pivot to (x, y, z, roll, pitch, yaw) of the transform.

    The translation is pivot - arm, and a rotation w turns the arm by w x arm; roll and pitch turn
    about the source's axes, w_x and w_y about the target's.
    """
    jacobian = np.eye(6)
    jacobian[:3, 3:] = [[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]]
    c, s = np.cos(yaw), np.sin(yaw)
    jacobian[3:5, 3:5] = [[c, s], [-s, c]]
    moved = jacobian @ covariance @ jacobian.T
    return (moved + moved.T) / 2  # rounding breaks the symmetry
