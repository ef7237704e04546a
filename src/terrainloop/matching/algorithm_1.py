"""Algorithm 1 of Le Gentil et al. (IROS 2020), line by line: the reference for tests of `ransac`."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrainloop.geometry import Array, fit_se2
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.correspondences import Associations
from terrainloop.matching.overlay import Overlay
from terrainloop.matching.ransac import get_inliers
from terrainloop.matching.ssd import Ssd, compute_ssd


@dataclass(frozen=True, eq=False)
class Algorithm1Result:
    """T, n and h of Algorithm 1; T and h are None where no transformation was accepted."""

    T: Array | None
    n: int
    h: Ssd | None


def algorithm_1(
    I_q: GradientMap,
    I_d: GradientMap,
    A: Associations,
    draws: NDArray[np.integer],
    inlier_radius: float,
    accept_transformation: Callable[[int, Ssd], bool],
) -> Algorithm1Result:
    """Loop-closure classification by SE(2) registration of two Gaussian gradient maps.

    Parameters
    ----------
    I_q, I_d : GradientMap
        Query (source) and stored map (target): gradient images I_g with their variance I_v.
    A : Associations
        Keypoint associations between the two.
    draws : array of int, (N, 2)
        What *SelectRandomAsso* selects at each of the N iterations.
    inlier_radius : float
        Largest distance of an inlier, metres.
    accept_transformation : callable
        *AcceptTransformation* on the number of inliers and the SSD metric.
    """
    T, n, h = None, 0, None
    for a, b in draws:  # foreach until Max Nb Iterations: {a, b} = SelectRandomAsso(A)
        if np.linalg.norm(A.source[a] - A.source[b]) <= inlier_radius:
            continue  # not in the paper: two keypoints this close do not constrain the rotation
        T_i = fit_se2(A.source[[a, b]], A.target[[a, b]])  # GetSE2Transform({a, b})
        A_i = get_inliers(A, T_i[None], inlier_radius)[0]  # GetInliers(A, T_i)
        if A_i.sum() < 2:
            continue  # not in the paper: one association does not determine a transform
        T_i = fit_se2(A.source[A_i], A.target[A_i])  # GetSE2Transform(A_i)
        h_i = compute_ssd(Overlay(I_q, I_d, T_i))  # ComputeSSDMetric(T_i, I_g^d, I_g^q, I_v^d, I_v^q)
        if accept_transformation(int(A_i.sum()), h_i) and A_i.sum() > n:
            n, h, T = int(A_i.sum()), h_i, T_i
    return Algorithm1Result(T, n, h)
