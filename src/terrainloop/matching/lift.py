"""From an SE(2) alignment to SE(3): height and tilt from the elevations, and the covariance.

Everything is estimated about a pivot, the middle of the overlap, where a tilt causes no horizontal motion;
only then is it referred to the maps' local origins.
"""

from dataclasses import dataclass
from functools import cached_property

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
    source, target, pivot = overlay.source, overlay.target, precision.pivot
    plane = _Plane.of(overlay, pivot, calibration)
    if plane is None or np.isnan(plane.covariance).any():
        nothing, unknown = np.full(3, np.nan), np.full((6, 6), np.nan)
        return _lifted(overlay, pivot, None), Warp(nothing, nothing, unknown, unknown)
    T, pivot_source = _lifted(overlay, pivot, plane), _pivot_in_source(overlay, pivot)
    away = _reach(target, pivot) ** 2 + _reach(source, pivot_source[:2]) ** 2
    reach = away + 2 * calibration.reach_of_radius * plane.ground.radius**2
    by_variance = [*(reach * f for f in calibration.motion_by_warp), *calibration.rotation_by_warp]
    arm = T[:3, :3] @ (pivot_source - source.local_origin)
    warp, noise = plane.warp
    return T, Warp(
        squares=warp**2 / 2,  # of two submaps
        noise=noise / 2,
        rigid=_at_local_origin(plane.covariance_with(precision.covariance), arm, yaw_of(T)),
        by_variance=_at_local_origin(np.diag(by_variance), arm, yaw_of(T)),
    )


def pose_in_se3(overlay: Overlay, pivot: Array, calibration: Calibration) -> Array:
    """The transform (4, 4) of `lift_to_se3` alone, for a pair that needs no covariance."""
    return _lifted(overlay, pivot, _Plane.of(overlay, pivot, calibration))


def _lifted(overlay: Overlay, pivot: Array, plane: "_Plane | None") -> Array:
    """The alignment in SE(3) with the height and tilt of a plane; without them if there is none."""
    T_planar = overlay.T_target_source
    if plane is None:
        return se3(T_planar[0, 2], T_planar[1, 2], 0.0, 0.0, 0.0, yaw_of(T_planar))
    z, w_x, w_y = plane.parameters
    pivot_source = _pivot_in_source(overlay, pivot)
    T = se3(0, 0, 0, w_x, w_y, 0) @ se3(0, 0, 0, 0, 0, yaw_of(T_planar))
    T[:3, 3] = np.array([*pivot, pivot_source[2] + z]) - T[:3, :3] @ pivot_source
    return T


def _pivot_in_source(overlay: Overlay, pivot: Array) -> Array:
    """The pivot (3,) in the frame of the source, at the mean height of the overlap."""
    height = overlay.of_source(overlay.source.elevation).mean()
    return np.array([*transform(inverse(overlay.T_target_source), pivot), height])


@dataclass(frozen=True, eq=False)
class _Ground:
    """Positions (N, 2) about the pivot, elevation differences (N,) there, and slopes (N, 2) of the ground."""

    positions: Array
    difference: Array
    slope: Array

    @classmethod
    def of(cls, overlay: Overlay, pivot: Array) -> "_Ground":
        """The ground of an overlay."""
        source, target = overlay.source, overlay.target
        return cls(
            overlay.positions - pivot,
            overlay.of_target(target.elevation) - overlay.of_source(source.elevation),
            np.stack([overlay.of_target(target.gradient_x), overlay.of_target(target.gradient_y)], axis=1),
        )

    def __getitem__(self, kept: NDArray[np.bool_]) -> "_Ground":
        return _Ground(self.positions[kept], self.difference[kept], self.slope[kept])

    @cached_property
    def design(self) -> Array:
        """Derivative (N, 3) of the elevation difference by (z, w_x, w_y)."""
        x, y = self.positions.T
        return np.stack([np.ones_like(x), y, -x], axis=1)

    @cached_property
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

    @cached_property
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
    ground : _Ground
        Without outliers.
    calibration : Calibration
    block : float
        Side of the independent blocks of ground, metres.
    """

    parameters: Array
    ground: _Ground
    calibration: Calibration
    block: float

    @classmethod
    def of(cls, overlay: Overlay, pivot: Array, calibration: Calibration) -> "_Plane | None":
        """By least squares, after outliers from a bent plane were rejected; None where that is too little."""
        ground = _Ground.of(overlay, pivot)
        if len(ground.positions) < MIN_PIXELS:
            return None
        residual = ground.difference - ground.bent_design @ _fitted(ground, ground.bent_design)
        spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
        kept = ground[np.abs(residual) <= max(OUTLIER * spread, 1e-9)]
        block = calibration.block * overlay.target.parameters.length_scale
        return cls(_fitted(kept, kept.design), kept, calibration, block)

    @cached_property
    def covariance(self) -> Array:
        """(3, 3) of the parameters, by the scatter of the elevations; NaN if they are undetermined."""
        scatter = _covariance(self.ground, self.ground.design, self.parameters, self.block)
        return self.calibration.noise_factor * scatter

    @cached_property
    def warp(self) -> tuple[Array, Array]:
        """Second-degree part (3,), as rises over the radius, and its variances (3,) by noise."""
        bent = _fitted(self.ground, self.ground.bent_design)
        noise = _covariance(self.ground, self.ground.bent_design, bent, self.block)
        return bent[3:], self.calibration.warp_noise_factor * np.diag(noise)[3:]

    def covariance_with(self, alignment: Array) -> Array:
        """(6, 6) of (x, y, z, w_x, w_y, yaw), from that of (x, y, yaw) (3, 3)."""
        by_alignment = np.linalg.lstsq(self.ground.design, self.ground.by_alignment, rcond=None)[0]
        planar, tilt = [0, 1, 5], [2, 3, 4]
        covariance = np.zeros((6, 6))
        covariance[np.ix_(planar, planar)] = alignment
        covariance[np.ix_(tilt, planar)] = by_alignment @ alignment
        covariance[np.ix_(planar, tilt)] = covariance[np.ix_(tilt, planar)].T
        covariance[np.ix_(tilt, tilt)] = self.covariance + by_alignment @ alignment @ by_alignment.T
        return covariance


def _fitted(ground: _Ground, design: Array) -> Array:
    """Parameters (P,) that explain the elevation difference best."""
    return np.asarray(np.linalg.lstsq(design, ground.difference, rcond=None)[0], dtype=float)


def _covariance(ground: _Ground, design: Array, parameters: Array, block: float) -> Array:
    residual = ground.difference - design @ parameters
    return block_covariance(design, residual, design.T @ design, ground.positions, block)


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
