"""The pose at which two gradient maps agree best over the ground they share, by Gauss-Newton."""

import cv2
import numpy as np

from terrainloop.geometry import Array, se2
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.ssd import shared_ground, warp

STEPS = 10
CONVERGED = 1e-4  # metres and radians
CAUCHY = 2.5  # robust standard deviations at which a residual counts half
FEWEST = 50  # pixels


def refine(source: GradientMap, target: GradientMap, T_target_source: Array) -> Array:
    """Minimise the weighted differences of the gradient vectors, from an alignment near the best.

    With R, T the rotation and transform sought, the residual at a pixel x of the target is

        r(x) = g_target(x) - R g_source(T^-1 x) - c

    with c one difference in slope for the whole map (a tilt between the frames). Its weight is the
    inverse of the two gradient variances' sum, times Cauchy's.

    Parameters
    ----------
    source, target : GradientMap
    T_target_source : array, (3, 3)
        SE(2), off by less than about half a length scale.

    Returns
    -------
    array, (3, 3)
        As given where the maps share too little ground.
    """
    T = T_target_source
    for _ in range(STEPS):
        move = _step(source, target, T)
        if move is None:
            return T_target_source
        T = move @ T
        if np.abs(move - np.eye(3)).max() < CONVERGED:
            break
    return T


def _step(source: GradientMap, target: GradientMap, T: Array) -> Array | None:
    """The SE(2) motion, from the left, that Gauss-Newton makes; None if too little ground is shared."""
    both = shared_ground(source, target, T)
    shared = cv2.erode(both.astype(np.uint8), np.ones((3, 3)), borderValue=0).astype(bool)  # has slopes
    if shared.sum() < FEWEST:
        return None
    rotation = T[:2, :2]
    warped = [warp(image, source, target, T) for image in (source.gradient_x, source.gradient_y)]
    field = np.tensordot(rotation, np.stack(warped), axes=1)  # (2, rows, columns), in the target's axes
    by_y, by_x = np.gradient(field, target.resolution, axis=(1, 2))
    g, by_x, by_y = (values[:, shared].astype(float) for values in (field, by_x, by_y))
    residual = np.stack([target.gradient_x[shared], target.gradient_y[shared]]) - g
    variance = target.gradient_variance + warp(source.gradient_variance, source, target, T)
    weight = np.tile(1.0 / variance[shared].astype(float), (2, 1))

    rows, columns = np.nonzero(shared)
    ground = np.stack([columns, rows]) * target.resolution + np.array(target.origin)[:, None]
    pivot = ground.mean(axis=1)
    u, v = ground - pivot[:, None]
    # A motion (dx, dy, turn) carries the field along: it falls by its slope along the way, and turns.
    by_turn = by_y * u - by_x * v - np.stack([-g[1], g[0]])
    tilt_x = np.stack([np.ones_like(u), np.zeros_like(u)])
    columns_of = [by_x, by_y, by_turn, -tilt_x, -tilt_x[::-1]]
    jacobian = np.stack(columns_of, axis=-1).reshape(-1, 5)
    r, w = residual.ravel(), weight.ravel()
    normalised = r * np.sqrt(w)
    spread = 1.4826 * np.median(np.abs(normalised - np.median(normalised)))
    w = w / (1.0 + (normalised / (CAUCHY * max(spread, 1e-12))) ** 2)
    normal = jacobian.T @ (w[:, None] * jacobian)
    dx, dy, turn = -np.linalg.lstsq(normal, jacobian.T @ (w * r), rcond=None)[0][:3]
    move = se2(0.0, 0.0, turn)
    move[:2, 2] = pivot - move[:2, :2] @ pivot + (dx, dy)
    return move
