"""MapClosures, its authors' own package: ORB on the density of points seen from above.

S. Gupta et al., "Effectively Detecting Loop Closures using Point Cloud Density Maps", ICRA 2024.

Its RANSAC is seeded from the random device of the system: the score of a pair may vary by a few inliers from
run to run.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from reproduce.baselines.method import Match, Method, Observation, Scale, require
from terrainloop.geometry import Array, inverse

# Pixels along a submap's side: the published 0.5 m has about 400 along a local map of 100 m range. The share
# of the largest density below which a pixel counts as empty: 0.05 is published.
CHOICES = ((400, 0.05), (200, 0.05), (200, 0.02))
TARGET_ID, SOURCE_ID = 0, 10  # maps less than 4 apart are not compared


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Points (N, 3) about a middle (3,) in the submap's frame, metres."""

    points: Array
    middle: Array


def methods(scale: Scale) -> tuple[Method, ...]:
    """MapClosures with the resolutions and thresholds of `CHOICES`, everything else as shipped."""
    package, software = require("map_closures.map_closures", "map-closures")
    voxels, _ = require("map_closures.voxel_map", "map-closures")
    return tuple(
        Method(
            "MapClosures",
            {"resolution_m": round(scale.side / pixels, 3), "density_threshold": threshold},
            software,
            partial(_describe, voxels, resolution=scale.side / pixels),
            partial(_score, package, _config(package, scale.side / pixels, threshold)),
        )
        for pixels, threshold in CHOICES
    )


def _config(package: Any, resolution: float, threshold: float) -> Any:
    return package.MapClosuresConfig(density_map_resolution=resolution, density_threshold=threshold)


def _describe(package: Any, observation: Observation, *, resolution: float) -> LocalMap:
    """Downsample as its pipeline does a local map, and centre at z = 0, where it searches for the ground."""
    points = observation.submap.points
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.array([*(low + high)[:2] / 2, np.median(points[:, 2])])
    voxels = package.VoxelMap(resolution, np.inf)
    voxels.add_points(points - middle)
    return LocalMap(voxels.point_cloud(), middle)


def _score(package: Any, config: Any, source: LocalMap, target: LocalMap) -> Match:
    """Score by inliers, with a separate database for every pair, so that scores are independent."""
    database = package.MapClosures(config)
    database.get_best_closure(TARGET_ID, target.points)
    closure = database.get_best_closure(SOURCE_ID, source.points)
    if not closure.number_of_inliers:
        return Match(0.0)
    T = inverse(np.array(closure.pose))  # its pose takes the stored map into the new one
    T[:3, 3] += target.middle - T[:3, :3] @ source.middle
    return Match(float(closure.number_of_inliers), T)
