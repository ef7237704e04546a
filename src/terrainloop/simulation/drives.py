"""Drives of a simulated rover as streams of posed scans, and as folders and bags of them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse
from terrainloop.io.clouds import write_cloud
from terrainloop.io.staging import errors_naming, publish, staging
from terrainloop.io.trajectories import Trajectory, write_tum
from terrainloop.scan import PosedScan, Scan
from terrainloop.simulation.odometry import Drift, estimate, true_poses
from terrainloop.simulation.paths import revisiting_path
from terrainloop.simulation.setups import Setup, checked_setup
from terrainloop.simulation.terrain import Terrain, make_terrain

Array = NDArray[np.float64]

SPEED = 0.5  # metres per second
DRIFT = Drift(position=0.01, heading_deg=0.15, memory=30.0)
"""Of the odometry of a drive: off by 1-2 % of the way after 300 m (docs/simulation.md)."""


@dataclass(frozen=True, eq=False, repr=False)
class Drive:
    """What a sensor sees on a drive, made scan by scan.

    Attributes
    ----------
    setup : Setup
    terrain : Terrain
    stamps : array, (K,)
        Seconds.
    odometry, truth : array, (K, 4, 4)
        T_odometry_body and T_world_body at every scan. The first poses are equal.
    max_points : int
        Of a scan; more are thinned at random.
    """

    setup: Setup
    terrain: Terrain
    stamps: Array
    odometry: Array
    truth: Array
    max_points: int
    _streams: tuple[SeedSequence, ...]

    def __repr__(self) -> str:
        return f"Drive({len(self.stamps)} scans, {self.length:.0f} m)"

    @property
    def length(self) -> float:
        """Of the true path, metres."""
        return float(np.linalg.norm(np.diff(self.truth[:, :3, 3], axis=0), axis=1).sum())

    @property
    def off_at_the_end(self) -> float:
        """By how far the odometry is off at the end, metres."""
        return float(np.linalg.norm(self.odometry[-1, :3, 3] - self.truth[-1, :3, 3]))

    def scans(self) -> Iterator[PosedScan]:
        """The scans in order, each with the pose of the sensor by odometry; the same at every call."""
        T_body_sensor = self.setup.T_body_sensor
        for stamp, true, seen, stream in zip(
            self.stamps.tolist(), self.truth, self.odometry, self._streams, strict=True
        ):
            rng = np.random.default_rng(stream)
            points = self.setup.sensor.observe(self.terrain, true @ T_body_sensor, rng)
            if len(points) > self.max_points:
                points = points[np.sort(rng.permutation(len(points))[: self.max_points])]
            yield PosedScan(Scan(points, stamp), seen @ T_body_sensor)


def simulate_drive(
    world: str = "etna",
    seed: int = 0,
    *,
    length: float = 300.0,
    sensor: str = "stereo",
    max_points: int = 10_000,
) -> Drive:
    """Drive a rover along a path that comes back, both ways round.

    Parameters
    ----------
    world, sensor : str
        As for `simulate_mission`.
    seed : int
        Not negative. Terrain, path, odometry and sensor draw from independent streams of it.
    length : float
        Metres.
    max_points : int
        Of a scan.

    Raises
    ------
    TerrainLoopError
        Unknown world or sensor, negative seed, or a drive that is too short or does not fit into the memory.
    """
    for name, value in (("length", length), ("max_points", max_points)):
        if not (np.isfinite(value) and value > 0):
            raise TerrainLoopError(expected=f"a positive {name}", found=f"{value!r:.40}", mend="give another")
    blocks = max(1, round(length / checked_setup(sensor, 1, seed).submap_length))
    setup = checked_setup(sensor, blocks, seed)
    for_terrain, for_path, for_odometry, for_sensor = SeedSequence(seed).spawn(4)
    path = revisiting_path(np.random.default_rng(for_path), blocks * setup.submap_length, setup.frame_spacing)
    half_side = np.abs(path.xy).max() + setup.sensor.max_range + 2.0
    terrain = make_terrain(world, for_terrain, 2 * float(half_side), setup.terrain_resolution)
    truth = true_poses(terrain, path)
    drift = replace(DRIFT, gravity_deg=setup.drift.gravity_deg, jitter_deg=setup.drift.jitter_deg)
    seen = estimate(truth, setup.frames, drift, np.random.default_rng(for_odometry))
    block = np.arange(len(truth)) // setup.frames
    odometry = seen.odometry[block] @ seen.local
    return Drive(
        setup=setup,
        terrain=terrain,
        stamps=np.arange(len(truth), dtype=float) * (setup.frame_spacing / SPEED),
        odometry=truth[0] @ inverse(odometry[0]) @ odometry,
        truth=truth,
        max_points=max_points,
        _streams=tuple(for_sensor.spawn(len(truth))),
    )


def write_scans(drive: Drive, folder: Path | str) -> None:
    """Write ``scans/*.npy``, ``odometry.tum`` and ``truth.tum`` (poses of the sensor), whole or not at all.

    Raises
    ------
    TerrainLoopError
        If there are scans in the folder.
    OSError
        Naming the folder, where it cannot be written.
    """
    folder = Path(folder)
    if any((folder / "scans").glob("*")):
        raise TerrainLoopError(
            expected="a folder without scans", found=f"some in {folder}", mend="name another folder"
        )
    names = []
    with staging(folder) as aside, errors_naming(folder):
        (aside / "scans").mkdir()
        for number, posed in enumerate(drive.scans()):
            names.append(f"scans/{number:06d}.npy")
            write_cloud(aside / names[-1], posed.scan.points)
        for name, trajectory in trajectories(drive).items():
            write_tum(aside / name, trajectory)
            names.append(name)
        publish(aside, folder, names, ())


def trajectories(drive: Drive) -> dict[str, Trajectory]:
    """Poses of the sensor by odometry and in truth, by the name of their file."""
    poses = {"odometry.tum": drive.odometry, "truth.tum": drive.truth}
    return {name: Trajectory(drive.stamps, T @ drive.setup.T_body_sensor) for name, T in poses.items()}
