"""The pose at which two gradient maps agree best over the ground they share, by Gauss-Newton."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from terrainloop import _core
from terrainloop.geometry import Array, se2
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.covariance import block_covariance

PLACES_PER_LENGTH_SCALE = 3  # what lies between them, neighbours repeat
USUAL_STRAIN = 0.004  # of a submap, standard deviation; what is assumed before the pair is seen,
USUAL_STRAIN_SAMPLES = 3.0  # and how many samples that assumption is worth


@dataclass(frozen=True, eq=False)
class Refinement:
    """A pose settled on the gradients, linearised there.

    Attributes
    ----------
    T_target_source : array, (3, 3)
        SE(2).
    pivot : array, (2,)
        Middle of the shared ground in the target frame, metres.
    ground : array, (N, 2)
        Places looked at, in the target frame, metres.
    residual, weights : array, (2, N)
        Of the two components of the gradient.
    motion : array, (2, N, 5)
        Jacobian of (x, y, turn about the pivot, difference in slope along x and along y).
    strain : array, (2, N, 3)
        Jacobian of the strain along x, along y, and across.
    length_scale : float
        Metres.
    """

    T_target_source: Array
    pivot: Array
    ground: Array
    residual: Array
    weights: Array
    motion: Array
    strain: Array
    length_scale: float

    @cached_property
    def covariance(self) -> Array:
        """(3, 3) of (x, y, yaw) about the pivot, metres and radians: what noise leaves open to rigid maps."""
        return self._fit(self.motion)[1][:3, :3]

    @cached_property
    def strain_variance(self) -> float:
        """How far a submap is from rigid: variance of its strain, dimensionless.

        From the strain of one submap against the other, less its noise, and what is usual. Along x and
        along y it has twice the variance of one submap's, across once.
        """
        strain, covariance = self._fit(np.concatenate([self.motion, self.strain], axis=-1))
        samples = (strain[5:] ** 2 - np.diag(covariance)[5:]) / (2.0, 2.0, 1.0)
        if np.isnan(samples).any():
            return USUAL_STRAIN**2
        seen = max(float(samples.sum()), 0.0)
        return (USUAL_STRAIN_SAMPLES * USUAL_STRAIN**2 + seen) / (USUAL_STRAIN_SAMPLES + len(samples))

    def weakest(self, distance: float) -> tuple[Array, Array]:
        """The two poses (3, 3) a distance in metres away, in the direction that the gradients tell least."""
        radius = self._radius
        _, normal = self._solve(self.motion / (1.0, 1.0, radius, 1.0, 1.0))
        slopes = np.linalg.solve(normal[3:, 3:], normal[3:, :3])
        x, y, turn = np.linalg.eigh(normal[:3, :3] - normal[:3, 3:] @ slopes)[1][:, 0]
        away = distance * np.array([x, y, turn / radius])
        return self._move(*away) @ self.T_target_source, self._move(*-away) @ self.T_target_source

    @property
    def _radius(self) -> float:
        """Root mean square distance of the ground from the pivot, metres."""
        return float(np.sqrt(((self.ground - self.pivot) ** 2).sum(axis=1).mean()))

    def _move(self, dx: float, dy: float, turn: float) -> Array:
        """The motion (3, 3) in the target frame by a turn about the pivot and a shift."""
        move = se2(0.0, 0.0, turn)
        move[:2, 2] = self.pivot - move[:2, :2] @ self.pivot + (dx, dy)
        return move

    def _solve(self, jacobian: Array) -> tuple[Array, Array]:
        """Least-squares parameters (P,) and the normal matrix (P, P)."""
        flat = jacobian.reshape(-1, jacobian.shape[-1])
        weighted = flat * self.weights.reshape(-1, 1)
        normal = weighted.T @ flat
        fitted = np.linalg.lstsq(normal, weighted.T @ self.residual.ravel(), rcond=None)[0]
        return np.asarray(-fitted, dtype=float), normal

    def _fit(self, jacobian: Array) -> tuple[Array, Array]:
        """Least-squares parameters (P,) and their covariance (P, P)."""
        parameters, normal = self._solve(jacobian)
        left = self.weights * (self.residual + jacobian @ parameters)
        return parameters, block_covariance(jacobian, left, normal, self.ground, self.length_scale)


def refine(
    source: GradientMap,
    target: GradientMap,
    T_target_source: Array,
    *,
    places: int = 20_000,
    steps: int = 10,
    tolerance: float = 1e-3,
) -> Refinement | None:
    """Minimise the weighted differences of the gradient vectors, from an alignment near the best.

    With R, T the rotation and transform sought, the residual at a place x of the target is

        r(x) = g_target(x) - R g_source(T^-1 x) - c

    with c one difference in slope for the whole map (a tilt between the frames). Its weight is the
    inverse of the two gradient variances' sum, times Cauchy's.

    Parameters
    ----------
    source, target : GradientMap
    T_target_source : array, (3, 3)
        SE(2), off by less than about half a length scale.
    places : int
        Looked at, at most.
    steps : int
        Of Gauss-Newton, at most.
    tolerance : float
        Motion below which it has settled, in length scales over the map.

    Returns
    -------
    Refinement or None
        None where the maps share too little ground.
    """
    settled = _core.settle(
        _gradients_of(source),
        _gradients_of(target),
        T_target_source,
        step=max(1, round(target.parameters.length_scale / PLACES_PER_LENGTH_SCALE / target.resolution)),
        places=places,
        steps=steps,
        tolerance=tolerance * target.parameters.length_scale,
    )
    return None if settled is None else Refinement(*settled, length_scale=target.parameters.length_scale)


def _gradients_of(gradient_map: GradientMap) -> tuple[Any, ...]:
    """As the core reads a map."""
    images = gradient_map.gradient_x, gradient_map.gradient_y, gradient_map.gradient_variance
    return (
        *(np.ascontiguousarray(image, dtype=np.float32) for image in images),
        np.ascontiguousarray(gradient_map.mask, dtype=np.uint8),
        gradient_map.origin,
        gradient_map.resolution,
    )
