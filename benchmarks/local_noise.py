"""Gradients of maps with constant noise, and with noise that follows the scatter, against the true slopes.

    python benchmarks/local_noise.py

Simulated stereo drives along a path, assembled at their true poses, so that only the sensor's noise
remains. The true slopes are those of the terrain smoothed by 7 cm, which is less than the maps resolve.
"""

import numpy as np
from scipy.ndimage import gaussian_filter

from terrainloop.geometry import transform
from terrainloop.gp.hyperparameters import fit_hyperparameters
from terrainloop.gradient_map import GradientMap
from terrainloop.simulation.missions import SETUPS, thin
from terrainloop.simulation.odometry import true_poses
from terrainloop.simulation.paths import revisiting_path
from terrainloop.simulation.terrain import Terrain, make_terrain

SMOOTHED = 0.07  # metres


def drive(world, seed):
    """Points of one submap in the world, and the terrain."""
    setup, rng = SETUPS["stereo"], np.random.default_rng(seed)
    path = revisiting_path(rng, 2 * setup.submap_length, setup.frame_spacing)
    terrain = make_terrain(world, seed, 2 * float(np.abs(path.xy).max() + 10), setup.terrain_resolution)
    poses = true_poses(terrain, path)[: setup.frames] @ setup.T_body_sensor
    frames = [transform(pose, setup.sensor.observe(terrain, pose, rng)) for pose in poses]
    return thin(np.concatenate(frames), setup.voxel), terrain


def slope_errors(made, terrain, known):
    rows, columns = np.nonzero(known)
    xy = np.array(made.origin) + made.resolution * np.stack([columns, rows], axis=-1)
    smooth = gaussian_filter(terrain.height, SMOOTHED / terrain.resolution)
    true = Terrain(smooth, terrain.resolution, terrain.origin).slope_at(xy)
    return np.hypot(made.gradient_x[known] - true[:, 0], made.gradient_y[known] - true[:, 1])


def main():
    print("| world, seed | l, noise | constant: RMSE, 95 % | local: RMSE, 95 % | RMSE | 95 % |")
    print("|---|---|---|---|---|---|")
    for seed, world in enumerate(["etna", "morocco", "mars"] * 2):
        points, terrain = drive(world, seed)
        fitted = fit_hyperparameters([points], workers=2)
        constant, local = (
            GradientMap.from_points(points, **vars(fitted), local_noise=local, workers=2)
            for local in (False, True)
        )
        known = constant.mask & local.mask
        before, after = (slope_errors(made, terrain, known) for made in (constant, local))
        rmse = [np.sqrt(np.mean(errors**2)) for errors in (before, after)]
        far = [np.percentile(errors, 95) for errors in (before, after)]
        print(
            f"| {world} {seed} | {fitted.length_scale:.2f} m, {100 * fitted.noise:.1f} cm "
            f"| {rmse[0]:.4f}, {far[0]:.3f} | {rmse[1]:.4f}, {far[1]:.3f} "
            f"| {100 * (rmse[1] / rmse[0] - 1):+.1f} % | {100 * (far[1] / far[0] - 1):+.1f} % |",
            flush=True,
        )


if __name__ == "__main__":
    main()
