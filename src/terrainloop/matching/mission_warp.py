"""How rigid the submaps of a mission are, pooled over its loops.

A submap that odometry stitched is warped, and so is the difference in elevation of two of them over the
ground that they share: the part of it that is no plane. One loop says little about the variance of the warp,
all loops of a mission together say much, and one odometry made them all.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from terrainloop.config import Calibration
from terrainloop.loop import LoopCandidate, Warp

STEPS = 10  # in which the weights of the samples settle


def warp_variance(warps: Iterable[Warp], calibration: Calibration) -> float:
    """Variance of the warp of one submap, dimensionless; of the usual one where nothing is known.

    The mean of the samples less their noise, together no less than zero, and of a prior that is worth a few
    of them. A sample counts less the noisier it is: as the inverse of its variance about a warp of the size
    found, or of the usual one if that is larger.
    """
    usual, prior = calibration.usual_warp**2, calibration.usual_warp_samples
    squares, noise = np.array([(w.squares, w.noise) for w in warps]).reshape(-1, 2, 3).swapaxes(0, 1)
    known = ~np.isnan(noise)
    excess, noise = (squares - noise)[known], noise[known]
    variance = usual
    for _ in range(STEPS):
        weights = (1.0 + noise / max(variance, usual)) ** -2.0
        variance = (prior * usual + max(float(weights @ excess), 0.0)) / (prior + float(weights.sum()))
    return variance


def with_mission_warp(
    loops: Sequence[LoopCandidate], calibration: Calibration, *, earlier: Sequence[LoopCandidate] = ()
) -> list[LoopCandidate]:
    """Loops with the covariance that the warp pooled over them and earlier loops gives."""
    warps = [loop.warp for loop in (*earlier, *loops) if loop.warp is not None]
    variance = warp_variance(warps, calibration)
    return [
        loop if loop.warp is None else replace(loop, covariance=loop.warp.covariance(variance))
        for loop in loops
    ]
