"""Refinement: the pose at which two gradient maps agree best over their overlap, by Gauss-Newton."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from terrainloop import _core
from terrainloop.config import Calibration
from terrainloop.geometry import Array, rotation_about, se2
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.covariance import block_covariance

SAMPLES_PER_LENGTH_SCALE = 3  # denser samples are redundant


@dataclass(frozen=True)
class Effort:
    """How much effort a refinement makes.

    Attributes
    ----------
    samples : int
        Maximum number of sample points.
    steps : int
        Maximum number of Gauss-Newton steps.
    tolerance : float
        RMS motion of the ground at which it has converged, in length scales.
    """

    samples: int
    steps: int
    tolerance: float


THOROUGH = Effort(samples=20_000, steps=10, tolerance=1e-3)
ROUGH = Effort(samples=2000, steps=3, tolerance=0.02)
"""Enough to rank hypotheses (docs/matching.md, section 2)."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined pose, linearised there.

    Attributes
    ----------
    T_target_source : array, (3, 3)
        SE(2).
    pivot : array, (2,)
        Centroid of the sample points in the target frame, metres.
    positions : array, (N, 2)
        Sample points in the target frame, metres.
    residual, weights, slopes : array, (2, N)
        Residuals of the two components of the gradient, their weights, and the derivatives of weights times
        residuals by the residuals; zero where a larger residual counts less.
    motion : array, (2, N, 5)
        Jacobian of the residual by x, y, yaw about the pivot, and the difference in slope along x and y.
    length_scale : float
        Metres.
    calibration : Calibration
    """

    T_target_source: Array
    pivot: Array
    positions: Array
    residual: Array
    weights: Array
    slopes: Array
    motion: Array
    length_scale: float
    calibration: Calibration

    @cached_property
    def covariance(self) -> Array:
        """(3, 3) of (x, y, yaw) about the pivot, metres and radians, if the submaps are rigid.

        The information is that of the slopes of Cauchy's influence function, not of its weights, as for every
        M-estimator (P. J. Huber, Robust Statistics, 1981, chapter 7).
        """
        flat = self.motion.reshape(-1, self.motion.shape[-1])
        normal = (flat * self.slopes.reshape(-1, 1)).T @ flat
        remaining = self.weights * (self.residual + self.motion @ self._solve(self.motion)[0])
        block = self.calibration.block * self.length_scale
        covariance = block_covariance(self.motion, remaining, normal, self.positions, block)
        return self.calibration.noise_factor * covariance[:3, :3]

    def weakest(self, distance: float) -> tuple[Array, Array]:
        """The two poses (3, 3) at a distance, in metres, along the least constrained direction."""
        radius = float(np.sqrt(((self.positions - self.pivot) ** 2).sum(axis=1).mean()))
        _, normal = self._solve(self.motion / (1.0, 1.0, radius, 1.0, 1.0))
        slopes = np.linalg.solve(normal[3:, 3:], normal[3:, :3])
        x, y, yaw = np.linalg.eigh(normal[:3, :3] - normal[:3, 3:] @ slopes)[1][:, 0]
        away = distance * np.array([x, y, yaw / radius])
        return self._moved(*away), self._moved(*-away)

    def _moved(self, dx: float, dy: float, yaw: float) -> Array:
        """The pose (3, 3) after a rotation about the pivot and a shift in the target frame."""
        return se2(dx, dy, 0.0) @ rotation_about(self.pivot, yaw) @ self.T_target_source

    def _solve(self, jacobian: Array) -> tuple[Array, Array]:
        """Least-squares parameters (P,) and the normal matrix (P, P)."""
        flat = jacobian.reshape(-1, jacobian.shape[-1])
        weighted = flat * self.weights.reshape(-1, 1)
        normal = weighted.T @ flat
        fitted = np.linalg.lstsq(normal, weighted.T @ self.residual.ravel(), rcond=None)[0]
        return np.asarray(-fitted, dtype=float), normal


def refine(
    source: GradientMap,
    target: GradientMap,
    T_target_source: Array,
    calibration: Calibration,
    effort: Effort = THOROUGH,
) -> Refinement | None:
    """Minimise the weighted differences of the gradient vectors, from an alignment near the optimum.

    With R, T the rotation and transform sought, the residual at a sample point x of the target is

        r(x) = g_target(x) - R g_source(T^-1 x) - c

    with c one difference in slope for the whole map (a tilt between the frames). Its weight is the
    inverse of the sum of the two gradient variances, times Cauchy's.

    Parameters
    ----------
    source, target : GradientMap
    T_target_source : array, (3, 3)
        SE(2), off by less than about half a length scale.
    calibration : Calibration
    effort : Effort

    Returns
    -------
    Refinement or None
        None where the maps share too little ground.
    """
    length_scale = target.parameters.length_scale
    refined = _core.settle(
        _gradients_of(source),
        _gradients_of(target),
        T_target_source,
        step=max(1, round(length_scale / SAMPLES_PER_LENGTH_SCALE / target.resolution)),
        places=effort.samples,
        steps=effort.steps,
        tolerance=effort.tolerance * length_scale,
    )
    return None if refined is None else Refinement(*refined, length_scale, calibration)


def _gradients_of(gradient_map: GradientMap) -> tuple[Any, ...]:
    """The images of a map in the form that the core expects."""
    images = gradient_map.gradient_x, gradient_map.gradient_y, gradient_map.gradient_variance
    return (
        *(np.ascontiguousarray(image, dtype=np.float32) for image in images),
        np.ascontiguousarray(gradient_map.mask, dtype=np.uint8),
        gradient_map.origin,
        gradient_map.resolution,
    )
