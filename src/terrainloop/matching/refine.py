"""The pose at which two gradient maps agree best over the ground they share, by Gauss-Newton."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from terrainloop.geometry import Array, se2
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.covariance import block_covariance
from terrainloop.matching.ssd import ground_of, shared_ground, warp

STEPS = 10
CAUCHY = 2.5  # robust standard deviations at which a residual counts half
FEWEST = 50  # places
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

    def step(self) -> tuple[Array, float]:
        """The pose (3, 3) one step of Gauss-Newton further, and how far that moves the ground, metres."""
        dx, dy, turn = self._solve(self.motion)[0][:3]
        moved = np.hypot(dx, dy) + abs(turn) * self._radius
        return self._move(dx, dy, turn) @ self.T_target_source, float(moved)

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
    tolerance : float
        Motion below which it has settled, in length scales over the map.

    Returns
    -------
    Refinement or None
        None where the maps share too little ground.
    """
    at = _linearise(source, target, T_target_source, places)
    for _ in range(STEPS):
        if at is None:
            return None
        T, moved = at.step()
        at = _linearise(source, target, T, places)
        if moved < tolerance * target.parameters.length_scale:
            break
    return at


def _linearise(source: GradientMap, target: GradientMap, T: Array, places: int) -> Refinement | None:
    """The problem at a pose; None if too little ground is shared."""
    length_scale = target.parameters.length_scale
    step = max(1, round(length_scale / PLACES_PER_LENGTH_SCALE / target.resolution))
    both = shared_ground(source, target, T, step)
    shared = cv2.erode(both.astype(np.uint8), np.ones((3, 3)), borderValue=0).astype(bool)  # has slopes
    known = np.flatnonzero(shared)
    if len(known) < FEWEST:
        return None
    every = -(-len(known) // places)
    chosen, ground = known[::every], ground_of(shared, target, step)[::every]

    def at_places(images: NDArray[Any]) -> Array:
        return images.reshape(len(images), -1)[:, chosen].astype(float)

    warped = [warp(image, source, target, T, step) for image in (source.gradient_x, source.gradient_y)]
    field = np.tensordot(T[:2, :2], np.stack(warped), axes=1)  # (2, rows, columns), in the target's axes
    by_y, by_x = map(at_places, np.gradient(field, step * target.resolution, axis=(1, 2)))
    g = at_places(field)
    observed = at_places(np.stack([target.gradient_x[::step, ::step], target.gradient_y[::step, ::step]]))
    variance = target.gradient_variance[::step, ::step] + warp(
        source.gradient_variance, source, target, T, step
    )
    weight = 1.0 / at_places(variance[None])

    pivot = ground.mean(axis=0)
    u, v = (ground - pivot).T
    # A motion (dx, dy, turn) carries the field along: it falls by its slope along the way, and turns.
    by_turn = by_y * u - by_x * v - np.stack([-g[1], g[0]])
    slope_x = np.stack([np.ones_like(u), np.zeros_like(u)])
    residual = observed - g
    normalised = residual * np.sqrt(weight)
    spread = 1.4826 * np.median(np.abs(normalised - np.median(normalised)))
    return Refinement(
        T_target_source=T,
        pivot=pivot,
        ground=ground,
        residual=residual,
        weights=weight / (1.0 + (normalised / (CAUCHY * max(spread, 1e-12))) ** 2),
        motion=np.stack([by_x, by_y, by_turn, -slope_x, -slope_x[::-1]], axis=-1),
        strain=np.stack([by_x * u, by_y * v, by_x * v + by_y * u], axis=-1),
        length_scale=length_scale,
    )
