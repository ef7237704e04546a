"""How well two gradient maps agree once aligned: the paper's SSD metric h."""

from dataclasses import dataclass

import numpy as np

from terrainloop.geometry import Array
from terrainloop.matching.overlay import Overlay


@dataclass(frozen=True)
class Ssd:
    """Agreement of two aligned gradient maps over the ground that both have observed.

    Attributes
    ----------
    value : float
        h of the paper: sum of (I_g^q - I_g^d)^2 / (I_v^q I_v^d), m^-4. It grows with the overlap.
    ratio : float
        The same over what two unrelated maps with these gradients and weights would give, so that
        overlap, relief and noise drop out: 0 for identical ground, 1 for unrelated.
    overlap : float
        Intersection over union of the observed areas, 0 to 1.
    """

    value: float
    ratio: float
    overlap: float


def compute_ssd(overlay: Overlay) -> Ssd:
    """*ComputeSSDMetric* of Algorithm 1, on the pixels of the target; the query q is the source.

    Where the overlay skips pixels, the sum is scaled to all of them.
    """
    if not overlay.shared.any():
        return Ssd(value=0.0, ratio=np.inf, overlap=0.0)
    source, target = overlay.source, overlay.target
    g_q, v_q = overlay.of_source(source.magnitude), overlay.of_source(source.variance)
    g_d, v_d = overlay.of_target(target.magnitude), overlay.of_target(target.variance)
    weights = overlay.step**2 / (v_q * v_d)
    value = float(weights @ (g_q - g_d) ** 2)
    unrelated = float(weights @ (_centred(g_q, weights) ** 2 + _centred(g_d, weights) ** 2))
    return Ssd(value, value / unrelated if unrelated > 0 else np.inf, overlay.overlap)


def _centred(values: Array, weights: Array) -> Array:
    return values - np.average(values, weights=weights)
