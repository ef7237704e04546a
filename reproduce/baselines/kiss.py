"""KISS-Matcher, its authors' own package: FasterPFH, graph-theoretic pruning, and a robust solver.

H. Lim et al., "KISS-Matcher: Fast and Robust Point Cloud Registration Revisited", ICRA 2025.

It uses TBB, which OMP_NUM_THREADS does not limit: with more than one thread the score of a pair varies by a
few inliers from run to run. In a process pinned to one processor it is reproducible to the bit.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reproduce.baselines.method import Match, Method, Observation, Scale, require
from terrainloop.geometry import Array

# Voxel as a share of the submap's side; radii of normals and of FPFH in voxels. 3 and 5 are the shipped
# ones; ground is smoother than streets, and wider ones were found best on stereo and on LiDAR submaps.
CHOICES = ((1 / 100, 3.0, 5.0), (3 / 200, 4.0, 10.0), (3 / 400, 4.0, 10.0))


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (N, 3) float32 as seen from a viewpoint (3,) in the submap's frame, metres."""

    points: NDArray[np.float32]
    viewpoint: Array


def methods(scale: Scale) -> tuple[Method, ...]:
    """KISS-Matcher at the resolution and radii of `CHOICES`, everything else as shipped."""
    package, software = require("kiss_matcher", "kiss-matcher")
    return tuple(
        Method(
            "KISS-Matcher",
            {"voxel_m": round(share * scale.side, 3), "normal_voxels": normal, "fpfh_voxels": fpfh},
            software,
            partial(_describe, height=scale.side),
            partial(_score, package, _config(package, share * scale.side, normal, fpfh)),
        )
        for share, normal, fpfh in CHOICES
    )


def _config(package: Any, voxel: float, normal: float, fpfh: float) -> Any:
    """The shipped settings without the noise bound of 1 m, which is meant for streets: ours scale."""
    return package.KISSMatcherConfig(
        voxel, normal_r_gain=normal, fpfh_r_gain=fpfh, enable_noise_bound_clamping=False
    )


def _describe(observation: Observation, height: float) -> Cloud:
    """The cloud relative to a viewpoint above its middle: normals are oriented towards the origin.

    The origin of a submap may be below the ground, and some normals would then point down.
    """
    points = observation.submap.points
    low, high = points.min(axis=0), points.max(axis=0)
    viewpoint = np.array([*(low + high)[:2] / 2, high[2] + height])
    return Cloud((points - viewpoint).astype(np.float32), viewpoint)


def _score(package: Any, config: Any, source: Cloud, target: Cloud) -> Match:
    matcher = package.KISSMatcher(config)
    solution = matcher.estimate(source.points, target.points)
    T = np.eye(4)
    T[:3, :3] = solution.rotation
    T[:3, 3] = solution.translation + target.viewpoint - T[:3, :3] @ source.viewpoint
    return Match(float(matcher.get_num_final_inliers()), T)
