"""Simulated stereo submaps of known ground, for the benchmarks."""

import numpy as np

from terrainloop.geometry import se3, transform
from terrainloop.simulation.sensors import StereoCamera
from terrainloop.simulation.terrain import make_terrain


def stereo_submap(side, count, world="etna", seed=7):
    """Points (count, 3) of stereo frames from all over a square, at their true poses, and the terrain."""
    rng = np.random.default_rng(seed)
    terrain = make_terrain(world, seed, side + 8.0, 0.035)
    camera, frames = StereoCamera(), []
    stations = np.stack(np.meshgrid(*[np.arange(-side / 2, side / 2 + 0.1, 2.5)] * 2), axis=-1).reshape(-1, 2)
    for x, y in stations:
        height = float(terrain.height_at([x, y])) + 1.1
        for yaw in rng.uniform(0, 2 * np.pi) + np.array([0.0, np.pi]):
            pose = se3(x, y, height, 0.0, np.radians(20.0), yaw)
            frames.append(transform(pose, camera.observe(terrain, pose, rng)))
    points = np.concatenate(frames)
    points = points[(np.abs(points[:, :2]) < side / 2).all(axis=1)]
    return points[rng.choice(len(points), count, replace=False)], terrain
