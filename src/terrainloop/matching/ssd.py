"""How well two gradient maps agree once aligned: the paper's SSD metric h."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from terrainloop.geometry import Array, inverse
from terrainloop.gradient_map import GradientMap


@dataclass(frozen=True)
class Ssd:
    """Agreement of two aligned gradient maps over the ground that both know.

    Attributes
    ----------
    value : float
        h of the paper: sum of (I_g^q - I_g^d)^2 / (I_v^q I_v^d), m^-4. It grows with the overlap.
    ratio : float
        The same over what two unrelated maps with these gradients and weights would give, so that
        overlap, relief and noise drop out: 0 for identical ground, 1 for unrelated.
    overlap : float
        Ground that both know over ground that either knows, 0 to 1.
    """

    value: float
    ratio: float
    overlap: float


def compute_ssd(source: GradientMap, target: GradientMap, T_target_source: Array, step: int = 1) -> Ssd:
    """*ComputeSSDMetric* of Algorithm 1, on the pixels of the target.

    Parameters
    ----------
    source, target : GradientMap
        The query q and the stored map d.
    T_target_source : array, (3, 3)
        SE(2) transform that takes source coordinates to the target's.
    step : int
        Look at every step-th row and column of the target only; the sum is scaled to all of them.
    """
    both = shared_ground(source, target, T_target_source, step)
    shared = int(both.sum())
    if shared == 0:
        return Ssd(value=0.0, ratio=np.inf, overlap=0.0)
    source_area = source.mask.sum() * source.resolution**2
    shared_area = shared * (step * target.resolution) ** 2
    overlap = shared_area / (source_area + target.mask.sum() * target.resolution**2 - shared_area)
    g_q = warp(source.magnitude, source, target, T_target_source, step)[both].astype(float)
    v_q = warp(source.variance, source, target, T_target_source, step)[both].astype(float)
    g_d = target.magnitude[::step, ::step][both].astype(float)
    v_d = target.variance[::step, ::step][both].astype(float)
    weights = 1.0 / (v_q * v_d)
    value = step**2 * float(weights @ (g_q - g_d) ** 2)
    unrelated = step**2 * float(weights @ (_centred(g_q, weights) ** 2 + _centred(g_d, weights) ** 2))
    return Ssd(value=value, ratio=value / unrelated if unrelated > 0 else np.inf, overlap=float(overlap))


def shared_ground(
    source: GradientMap, target: GradientMap, T_target_source: Array, step: int = 1
) -> NDArray[np.bool_]:
    """Where both maps know the ground, on every step-th pixel of the target."""
    known = warp(source.mask.astype(np.float32), source, target, T_target_source, step) > 0.999
    both: NDArray[np.bool_] = known & target.mask[::step, ::step]
    return both


def ground_of(pixels: NDArray[np.bool_], target: GradientMap, step: int = 1) -> Array:
    """Positions (N, 2) in metres of pixels marked on every step-th row and column of the target."""
    return np.argwhere(pixels)[:, ::-1] * (step * target.resolution) + np.array(target.origin)


def warp(
    image: NDArray[np.float32],
    source: GradientMap,
    target: GradientMap,
    T_target_source: Array,
    step: int = 1,
) -> NDArray[np.float32]:
    """Resample an image of the source map on every step-th pixel of the target, 0 where it has none."""
    pixels_of_target = _metres_from_pixels(target) @ np.diag([step, step, 1.0])
    lookup = np.linalg.inv(_metres_from_pixels(source)) @ inverse(T_target_source) @ pixels_of_target
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    rows, columns = target.mask[::step, ::step].shape
    return cv2.warpAffine(image, lookup[:2], (columns, rows), flags=flags, borderValue=0.0).astype(
        np.float32, copy=False
    )


def _metres_from_pixels(gradient_map: GradientMap) -> Array:
    x, y = gradient_map.origin
    r = gradient_map.resolution
    return np.array([[r, 0.0, x], [0.0, r, y], [0.0, 0.0, 1.0]])


def _centred(values: Array, weights: Array) -> Array:
    return values - np.average(values, weights=weights)
