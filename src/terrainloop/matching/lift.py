"""From an SE(2) alignment to SE(3): height and tilt from the elevations, and the covariance.

Everything is estimated about a pivot, the middle of the overlap, where a tilt causes no horizontal motion;
only then is it referred to the maps' local origins.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrainloop.config import Calibration
from terrainloop.geometry import Array, cross_matrix, inverse, se3, transform, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import Warp
from terrainloop.matching.covariance import block_covariance
from terrainloop.matching.overlay import Overlay

MIN_PIXELS = 10  # needed to determine a tilt
OUTLIER = 3.0  # robust standard deviations beyond which an elevation difference is an outlier


@dataclass(frozen=True, eq=False)
class PlanarPrecision:
    """How well an SE(2) alignment of rigid submaps is known.

    Attributes
    ----------
    pivot : array, (2,)
        Point of the target frame that the covariance refers to, metres; best in the middle of the overlap.
    covariance : array, (3, 3)
        Covariance of (x, y, yaw) at the pivot, metres and radians.
    """

    pivot: Array
    covariance: Array


def lift_to_se3(overlay: Overlay, precision: PlanarPrecision, calibration: Calibration) -> tuple[Array, Warp]:
    """SE(3) transform from an SE(2) alignment, and what its covariance is made of.

    Over the overlap the target's elevation minus the source's is, to first order in a small
    tilt w about the target's horizontal axes, z + w_x y - w_y x about the pivot: a plane. Where the ground
    slopes, an error of the alignment changes that plane; where submaps are not rigid, it is no plane.

    Parameters
    ----------
    overlay : Overlay
        The two maps at the alignment.
    precision : PlanarPrecision
    calibration : Calibration

    Returns
    -------
    T_target_source : array, (4, 4)
    warp : Warp
        Its covariances are those of (x, y, z, roll, pitch, yaw) of the transform between the maps' local
        origins; NaN where the overlap is too small to determine the tilt.
    """
    source, target, T_planar = overlay.source, overlay.target, overlay.T_target_source
    pivot = precision.pivot
    height = overlay.of_source(source.elevation)
    ground = _Ground(
        overlay.positions - pivot,
        overlay.of_target(target.elevation) - height,
        np.stack([overlay.of_target(target.gradient_x), overlay.of_target(target.gradient_y)], axis=1),
    )
    plane = _fit_plane(ground, calibration, target.parameters.length_scale)
    if plane is None:
        no_tilt = se3(T_planar[0, 2], T_planar[1, 2], 0.0, 0.0, 0.0, yaw_of(T_planar))
        nothing, unknown = np.full(3, np.nan), np.full((6, 6), np.nan)
        return no_tilt, Warp(nothing, nothing, unknown, unknown)
    z, w_x, w_y = plane.parameters
    R = (se3(0, 0, 0, w_x, w_y, 0) @ se3(0, 0, 0, 0, 0, yaw_of(T_planar)))[:3, :3]
    pivot_source = np.array([*transform(inverse(T_planar), pivot), height.mean()])
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.array([*pivot, height.mean() + z]) - R @ pivot_source
    away = _reach(target, pivot) ** 2 + _reach(source, pivot_source[:2]) ** 2
    reach = away + 2 * calibration.reach_of_radius * plane.radius**2
    by_variance = [*(reach * f for f in calibration.motion_by_warp), *calibration.rotation_by_warp]
    arm = R @ (pivot_source - source.local_origin)
    return T, Warp(
        squares=plane.warp**2 / 2,  # of two submaps
        noise=plane.warp_noise / 2,
        rigid=_at_local_origin(plane.covariance_with(precision.covariance), arm, yaw_of(T)),
        by_variance=_at_local_origin(np.diag(by_variance), arm, yaw_of(T)),
    )


@dataclass(frozen=True, eq=False)
class _Ground:
    """Positions (N, 2) about the pivot, elevation differences (N,) there, and slopes (N, 2) of the ground."""

    positions: Array
    difference: Array
    slope: Array

    def __getitem__(self, kept: NDArray[np.bool_]) -> "_Ground":
        return _Ground(self.positions[kept], self.difference[kept], self.slope[kept])

    @property
    def design(self) -> Array:
        """Derivative (N, 3) of the elevation difference by (z, w_x, w_y)."""
        x, y = self.positions.T
        return np.stack([np.ones_like(x), y, -x], axis=1)

    @property
    def bent_design(self) -> Array:
        """The design and, as rises over the radius, the second-degree parts (N, 6)."""
        x, y = self.positions.T / self.radius
        bent = np.stack([x**2 - y**2, 2 * x * y, x**2 + y**2 - 1], axis=1)
        return np.concatenate([self.design, self.radius * bent], axis=1)

    @property
    def by_alignment(self) -> Array:
        """Derivative (N, 3) of the elevation difference by (x, y, yaw) of the alignment."""
        (x, y), (slope_x, slope_y) = self.positions.T, self.slope.T
        return np.stack([slope_x, slope_y, x * slope_y - y * slope_x], axis=1)

    @property
    def radius(self) -> float:
        """Root mean square distance from the pivot, metres."""
        return float(np.sqrt((self.positions**2).sum(axis=1).mean()))


@dataclass(frozen=True, eq=False)
class _Plane:
    """The elevation difference as a plane, and what is left of it.

    Attributes
    ----------
    parameters : array, (3,)
        (z, w_x, w_y).
    covariance : array, (3, 3)
        By the scatter of the elevations.
    by_alignment : array, (3, 3)
        Derivative of the parameters by (x, y, yaw) of the alignment.
    warp, warp_noise : array, (3,)
        Second-degree part, as rises over the radius, and its variances by noise; NaN if undetermined.
    radius : float
        Of the ground, metres.
    """

    parameters: Array
    covariance: Array
    by_alignment: Array
    warp: Array
    warp_noise: Array
    radius: float

    def covariance_with(self, alignment: Array) -> Array:
        """(6, 6) of (x, y, z, w_x, w_y, yaw), from that of (x, y, yaw) (3, 3)."""
        planar, tilt = [0, 1, 5], [2, 3, 4]
        covariance = np.zeros((6, 6))
        covariance[np.ix_(planar, planar)] = alignment
        covariance[np.ix_(tilt, planar)] = self.by_alignment @ alignment
        covariance[np.ix_(planar, tilt)] = covariance[np.ix_(tilt, planar)].T
        covariance[np.ix_(tilt, tilt)] = self.covariance + self.by_alignment @ alignment @ self.by_alignment.T
        return covariance


def _fit_plane(ground: _Ground, calibration: Calibration, length_scale: float) -> _Plane | None:
    """The plane by least squares, after outliers from a bent one were rejected; None if undetermined."""
    if len(ground.positions) < MIN_PIXELS:
        return None
    bent = np.linalg.lstsq(ground.bent_design, ground.difference, rcond=None)[0]
    residual = ground.difference - ground.bent_design @ bent
    spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
    kept = ground[np.abs(residual) <= max(OUTLIER * spread, 1e-9)]
    block = calibration.block * length_scale
    plane, covariance = _least_squares(kept, kept.design, block)
    if np.isnan(covariance).any():
        return None
    bent, noise = _least_squares(kept, kept.bent_design, block)
    by_alignment = np.linalg.lstsq(kept.design, kept.by_alignment, rcond=None)[0]
    return _Plane(
        parameters=plane,
        covariance=calibration.noise_factor * covariance,
        by_alignment=np.asarray(by_alignment, dtype=float),
        warp=bent[3:],
        warp_noise=calibration.warp_noise_factor * np.diag(noise)[3:],
        radius=kept.radius,
    )


def _least_squares(ground: _Ground, design: Array, block: float) -> tuple[Array, Array]:
    """Parameters (P,) that explain the elevation difference best, and their covariance (P, P)."""
    parameters = np.linalg.lstsq(design, ground.difference, rcond=None)[0]
    residual = ground.difference - design @ parameters
    covariance = block_covariance(design, residual, design.T @ design, ground.positions, block)
    return np.asarray(parameters, dtype=float), covariance


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
