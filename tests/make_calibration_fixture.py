"""Makes tests/data/calibration.npz, on which tests/test_calibration.py holds the calibration (some minutes).

    python tests/make_calibration_fixture.py

Four simulated stereo drives of seeds that no reported result used: three whose odometry drifts as usual and
one without drift, whose submaps are rigid. Clouds are thinned to 0.2 m, a third of the length scale, and
rounded to 2 mm, a tenth of the noise. Hyperparameters are fitted once and kept with the clouds.
"""

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from terrainloop import Settings, Submap
from terrainloop.detection.detector import fit_database
from terrainloop.simulation.missions import SETUPS, simulate_mission, thin
from terrainloop.simulation.odometry import Drift

PATH = Path(__file__).parent / "data" / "calibration.npz"
VOXEL = 0.2  # metres
UNIT = 0.002  # metres
RIGID = replace(SETUPS["stereo"], drift=Drift(position=0.0, heading_deg=0.0, jitter_deg=0.0))
MISSIONS = {
    "etna_301": (16, SETUPS["stereo"]),
    "mars_302": (14, SETUPS["stereo"]),
    "morocco_303": (14, SETUPS["stereo"]),
    "rigid_304": (12, RIGID),
}


def packed(clouds, truth):
    """Thinned clouds as differences of whole units, which compress well, with truth and hyperparameters."""
    units = [np.round(thin(cloud.astype(float), VOXEL) / UNIT).astype(np.int16) for cloud in clouds]
    fitted = [Submap(unpacked(np.diff(units[len(units) * k // 4], axis=0, prepend=0))) for k in (1, 2, 3)]
    parameters = fit_database(fitted, Settings())
    return {
        "steps": np.concatenate([np.diff(points, axis=0, prepend=0) for points in units]).T.astype(np.int16),
        "counts": np.array([len(points) for points in units]),
        "truth": np.array(truth),
        "parameters": np.array([parameters.length_scale, parameters.variance, parameters.noise]),
    }


def unpacked(steps):
    """Points (N, 3) in metres from their differences in whole units."""
    return UNIT * np.cumsum(steps, axis=0, dtype=np.int16)


def main():
    """Simulate the missions and write them."""
    arrays = {}
    for name, (submaps, setup) in MISSIONS.items():
        world, seed = ("etna" if setup is RIGID else name.split("_")[0]), int(name.split("_")[1])
        with patch.dict(SETUPS, stereo=setup):
            mission = simulate_mission(world, seed, submaps)
        arrays |= {f"{name}.{key}": value for key, value in packed(mission.clouds, mission.truth).items()}
    PATH.parent.mkdir(exist_ok=True)
    np.savez_compressed(PATH, **arrays)


if __name__ == "__main__":
    main()
