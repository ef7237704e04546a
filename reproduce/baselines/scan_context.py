"""Scan Context, implemented from its publication.

G. Kim and A. Kim, "Scan Context: Egocentric Spatial Descriptor for Place Recognition within 3D Point Cloud
Map", IROS 2018. A submap is cut into rings and sectors about its centre; each bin keeps its highest point.
Two submaps are compared column by column at every rotation.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from reproduce.baselines.method import Match, Method, Observation, Scale
from terrainloop.geometry import Array, se3, transform

RINGS, SECTORS = 20, 60  # as published
# The published 80 m is the range of that LiDAR. Of a submap: the circle within its box, and that about it.
RANGES = (0.5, 0.7)  # of its side


@dataclass(frozen=True, eq=False)
class ScanContext:
    """The descriptor and where it was taken.

    Attributes
    ----------
    heights : array, (RINGS, SECTORS)
        Height of the highest point of each bin above the lowest point of the submap, metres; 0 if empty.
    centre : array, (3,)
        Middle of the submap in x and y, its lowest point in z, in its frame, metres.
    """

    heights: Array
    centre: Array


def methods(scale: Scale) -> tuple[Method, ...]:
    """Scan Context of two maximum ranges."""
    return tuple(
        Method(
            "Scan Context",
            {"max_range_m": round(share * scale.side, 3)},
            "Kim and Kim, IROS 2018",
            partial(_describe, max_range=share * scale.side),
            _score,
        )
        for share in RANGES
    )


def _describe(observation: Observation, max_range: float) -> ScanContext:
    points = observation.submap.points
    centre = np.array([*points[:, :2].mean(axis=0), points[:, 2].min()])
    x, y, z = (points - centre).T
    ring = (np.hypot(x, y) * RINGS / max_range).astype(int)
    sector = (np.arctan2(y, x) % (2 * np.pi) * SECTORS / (2 * np.pi)).astype(int) % SECTORS
    heights = np.zeros((RINGS, SECTORS))
    inside = ring < RINGS
    np.maximum.at(heights, (ring[inside], sector[inside]), z[inside])
    return ScanContext(heights, centre)


def _score(source: ScanContext, target: ScanContext) -> Match:
    """Minus the smallest distance over all shifts (equations 6 and 7), and the yaw of that shift."""
    distances = [
        _distance(np.roll(source.heights, shift, axis=1), target.heights) for shift in range(SECTORS)
    ]
    shift = int(np.argmin(distances))
    T = se3(0.0, 0.0, 0.0, 0.0, 0.0, 2 * np.pi * shift / SECTORS)
    T[:3, 3] = target.centre - transform(T, source.centre)
    return Match(-float(distances[shift]), T)


def _distance(source: Array, target: Array) -> float:
    """Mean cosine distance of the columns that neither submap leaves empty; 1 where there is none."""
    norms = np.linalg.norm(source, axis=0) * np.linalg.norm(target, axis=0)
    seen = norms > 0
    if not seen.any():
        return 1.0
    return float(np.mean(1.0 - (source * target).sum(axis=0)[seen] / norms[seen]))
