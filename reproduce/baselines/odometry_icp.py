"""Naive baseline: initialise with odometry, refine with ICP, score by the inlier fraction.

ICP is small_gicp's default, generalized ICP (K. Koide, JOSS 2024; A. Segal et al., RSS 2009): point-to-plane
slides on smooth ground and registered 0.6 of the true pairs, generalized ICP all of them. This is the only
method that uses odometry.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

from reproduce.baselines.method import (
    NOT_COMPARABLE,
    Match,
    Method,
    Observation,
    Scale,
    require,
)
from terrainloop.geometry import Array, inverse

VOXEL = 1 / 100  # of the submap's side
ITERATIONS = 100  # maximum
REACHES = (2.0, 4.0)  # maximum correspondence distance, in voxels


@dataclass(frozen=True, eq=False)
class Prepared:
    """A downsampled small_gicp cloud with covariances, its KD-tree, and its pose by odometry."""

    cloud: Any
    tree: Any
    T_odometry_submap: Array | None


def methods(scale: Scale) -> tuple[Method, ...]:
    """ICP with each of `REACHES`."""
    package, software = require("small_gicp", "small-gicp")
    voxel = VOXEL * scale.side
    return tuple(
        Method(
            "odometry + ICP",
            {"voxel_m": round(voxel, 3), "reach_m": round(reach * voxel, 3)},
            software,
            partial(_describe, package, voxel=voxel),
            partial(_score, package, reach=reach * voxel),
        )
        for reach in REACHES
    )


def _describe(package: Any, observation: Observation, *, voxel: float) -> Prepared:
    cloud, tree = package.preprocess_points(observation.submap.points, downsampling_resolution=voxel)
    return Prepared(cloud, tree, observation.T_odometry_submap)


def _score(package: Any, source: Prepared, target: Prepared, *, reach: float) -> Match:
    """Score by the share of source points that have a correspondence once ICP has converged."""
    if source.T_odometry_submap is None or target.T_odometry_submap is None:
        return Match(NOT_COMPARABLE)
    result = package.align(
        target.cloud,
        source.cloud,
        target.tree,
        inverse(target.T_odometry_submap) @ source.T_odometry_submap,
        registration_type="GICP",
        max_correspondence_distance=reach,
        max_iterations=ITERATIONS,
    )
    return Match(result.num_inliers / source.cloud.size(), result.T_target_source)
