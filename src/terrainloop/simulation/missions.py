"""Missions of a simulated rover: submaps, odometry and truth, in memory or as a mission folder."""

import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath

import numpy as np
import yaml
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import transform
from terrainloop.io.clouds import CLOUD_SUFFIXES, write_cloud
from terrainloop.io.files import write_whole_text
from terrainloop.io.staging import errors_naming, publish, staging
from terrainloop.io.trajectories import Trajectory, write_tum
from terrainloop.simulation.odometry import estimate, true_poses
from terrainloop.simulation.paths import revisiting_path
from terrainloop.simulation.setups import SETUPS, Setup, checked_setup
from terrainloop.simulation.terrain import Terrain, make_terrain
from terrainloop.strict_yaml import read_yaml

Array = NDArray[np.float64]

_DESCRIPTION = "simulation.yaml"
_TRAJECTORIES = ("odometry.tum", "truth.tum")
_CLOUDS_ONLY = set(CLOUD_SUFFIXES) - {".txt", ".csv"}  # which beside the folder of clouds are notes


@dataclass(frozen=True)
class SimulatedMission:
    """Submaps of a drive with their estimated and true poses.

    A submap frame has its origin on the ground under the rover at the submap's start, x along the
    estimated heading and z against the estimated gravity.

    Attributes
    ----------
    world, sensor : str
        Names, as requested.
    seed : int
        Seed, as requested.
    clouds : list of array, (N, 3) float32
        Points of each submap in its frame, in metres.
    odometry : array, (M, 4, 4)
        T_odometry_submap: poses by dead reckoning, gravity-aligned by construction.
    truth : array, (M, 4, 4)
        T_world_submap: true poses, tilted by the error of the estimated gravity, so that they take the
        points onto the terrain up to noise and to the drift since the submap's start.
    terrain : Terrain
        The ground.
    legs : tuple of str
        For each submap "first", "turn", "opposite" or "same", as driven at its middle.
    frames : array, (M, F, 4, 4)
        T_world_body: true pose of the rover at each frame of each submap.
    """

    world: str
    seed: int
    sensor: str
    clouds: list[NDArray[np.float32]]
    odometry: Array
    truth: Array
    terrain: Terrain
    legs: tuple[str, ...]
    frames: Array


def simulate_mission(
    world: str = "etna",
    seed: int = 0,
    submaps: int = 16,
    sensor: str = "stereo",
    progress: Callable[[int, int], None] | None = None,
) -> SimulatedMission:
    """Drive a rover over a world along a path that revisits.

    Terrain, path, odometry and sensor draw from independent streams of the one seed; the result does
    not depend on the number of threads.

    Parameters
    ----------
    world : str
        One of `names.WORLDS`.
    seed : int
        Not negative.
    submaps : int
        Number of submaps; from about 8 on there are loops, from 16 on in both directions.
    sensor : str
        One of `names.SENSORS`.
    progress : callable, optional
        Called with the number of finished submaps and their total after each.

    Returns
    -------
    SimulatedMission
        Submaps in the order driven.

    Raises
    ------
    TerrainLoopError
        Unknown world or sensor, negative seed, no submaps, or more than fit into the memory.
    """
    setup = checked_setup(sensor, submaps, seed)
    for_terrain, for_path, for_odometry, for_sensor = SeedSequence(seed).spawn(4)
    length = submaps * setup.submap_length
    path = revisiting_path(np.random.default_rng(for_path), length, setup.frame_spacing)
    half_side = np.abs(path.xy).max() + setup.sensor.max_range + 2.0
    terrain = make_terrain(world, for_terrain, 2 * float(half_side), setup.terrain_resolution)
    true = true_poses(terrain, path)
    frames = estimate(true, setup.frames, setup.drift, np.random.default_rng(for_odometry))
    clouds = []
    with ThreadPoolExecutor() as pool:
        for i, stream in enumerate(for_sensor.spawn(submaps)):
            chosen = slice(i * setup.frames, (i + 1) * setup.frames)
            clouds.append(submap_cloud(setup, terrain, true[chosen], frames.local[chosen], stream, pool))
            if progress:
                progress(i + 1, submaps)
    middles = range(setup.frames // 2, len(true), setup.frames)
    legs = tuple(path.legs[i] for i in middles)
    seen_from = true.reshape(submaps, setup.frames, 4, 4)
    return SimulatedMission(
        world, seed, sensor, clouds, frames.odometry, frames.truth, terrain, legs, seen_from
    )


def submap_cloud(
    setup: Setup, terrain: Terrain, true: Array, local: Array, stream: SeedSequence, pool: ThreadPoolExecutor
) -> NDArray[np.float32]:
    """Frames seen from the true poses T_world_body, assembled by the estimated T_submap_body, thinned."""

    def frame(i: int, rng: Generator) -> Array:
        seen = setup.sensor.observe(terrain, true[i] @ setup.T_body_sensor, rng)
        return transform(local[i] @ setup.T_body_sensor, seen)

    generators = [np.random.default_rng(child) for child in stream.spawn(len(true))]
    points = np.concatenate(list(pool.map(frame, range(len(true)), generators)))
    return thin(points, setup.voxel).astype(np.float32)


def thin(points: Array, voxel: float) -> Array:
    """Mean of the points (N, 3) in each cubic voxel."""
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    _, member, counts = np.unique(
        np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)),
        return_inverse=True,
        return_counts=True,
    )
    sums = [np.bincount(member, weights=points[:, i]) for i in range(3)]
    return np.asarray(np.stack(sums, axis=-1) / counts[:, None])


def write_mission(mission: SimulatedMission, path: FilePath | str) -> None:
    """Write a mission folder: ``clouds/*.ply``, ``odometry.tum``, ``truth.tum``, ``simulation.yaml``.

    The first column of the trajectories is the index of the submap. All of it is written, or nothing. What an
    earlier run wrote there is replaced; other files are not touched.

    Raises
    ------
    TerrainLoopError
        If the folder holds a mission that is not simulated (see `written_before`).
    OSError
        Naming the folder, where it cannot be written.
    """
    folder = FilePath(path)
    stale = [file.relative_to(folder) for file in written_before(folder)]
    clouds = [f"clouds/{i:06d}.ply" for i in range(len(mission.clouds))]
    stamps = np.arange(len(mission.clouds), dtype=float)
    with staging(folder) as aside, errors_naming(folder):
        (aside / "clouds").mkdir()
        for name, cloud in zip(clouds, mission.clouds, strict=True):
            write_cloud(aside / name, cloud)
        for name, poses in zip(_TRAJECTORIES, (mission.odometry, mission.truth), strict=True):
            write_tum(aside / name, Trajectory(stamps, poses))
        description = yaml.safe_dump(_description(mission), sort_keys=False)
        write_whole_text(aside / _DESCRIPTION, lambda file: file.write(description))
        publish(aside, folder, [*clouds, *_TRAJECTORIES, _DESCRIPTION], stale)


def written_before(path: FilePath | str) -> list[FilePath]:
    """Clouds and trajectories that an earlier `write_mission` wrote to a folder; none if there is no folder.

    Raises
    ------
    TerrainLoopError
        If the folder holds other clouds, or trajectories without a ``simulation.yaml``.
    """
    folder = FilePath(path)
    count = _submaps_of(folder / _DESCRIPTION)
    clouds = [file for file in (folder / "clouds").glob("*") if file.suffix.lower() in CLOUD_SUFFIXES]
    ours = [file for file in clouds if re.fullmatch(r"\d{6}\.ply", file.name) and int(file.stem) < count]
    others = set(clouds) - set(ours)
    trajectories = [file for name in _TRAJECTORIES if (file := folder / name).exists()]
    if count == 0:
        others |= {*trajectories, *(file for file in folder.glob("*") if file.suffix.lower() in _CLOUDS_ONLY)}
    if others:
        raise TerrainLoopError(
            expected="a folder without a mission, or with one that was simulated",
            found=f"{min(others)}, which 'terrainloop simulate' did not write",
            mend="name another folder",
        )
    return [*trajectories, *ours]


def _submaps_of(description: FilePath) -> int:
    """Number of clouds according to our description; none if there is no such file."""
    try:
        content = read_yaml(description)
    except TerrainLoopError:
        return 0
    ours = (
        isinstance(content, dict)
        and {"world", "seed", "submaps", "sensor", "setup", "legs"} <= content.keys()
    )
    return content["submaps"] if ours and type(content["submaps"]) is int else 0


def _description(mission: SimulatedMission) -> dict[str, object]:
    return {
        "world": mission.world,
        "seed": mission.seed,
        "submaps": len(mission.clouds),
        "sensor": mission.sensor,
        "setup": asdict(SETUPS[mission.sensor]),
        "legs": list(mission.legs),
    }
