"""Missions of places that share no ground, on which every loop is false, and revisits of such places."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import translation
from terrainloop.io.clouds import write_cloud
from terrainloop.io.trajectories import Trajectory, write_tum
from terrainloop.simulation.missions import submap_cloud
from terrainloop.simulation.odometry import estimate, true_poses
from terrainloop.simulation.paths import Path
from terrainloop.simulation.setups import Setup, checked_setup
from terrainloop.simulation.terrain import Terrain, make_terrain

Array = NDArray[np.float64]

APART = 1000.0  # metres between two places in the frame of the truth
REVISIT_OFFSET = 0.25  # of a sensor's range, by which the middle of the view moves between two visits


@dataclass(frozen=True)
class SimulatedPlaces:
    """Submaps of places that share no ground.

    Attributes
    ----------
    clouds : list of array, (N, 3) float32
        Points of each submap in its gravity-aligned frame, in metres; second visits after all first ones.
    place : tuple of int
        Index of the place of each submap.
    truth : array, (M, 4, 4)
        T_world_submap of each; places are `APART` along x.
    terrains : tuple of Terrain
        The ground of each place, about its own origin.
    """

    clouds: list[NDArray[np.float32]]
    place: tuple[int, ...]
    truth: Array
    terrains: tuple[Terrain, ...]


def simulate_places(
    world: str, seed: int = 0, places: int = 16, sensor: str | Setup = "survey", revisits: bool = False
) -> SimulatedPlaces:
    """Look once, or twice, at each of several independent draws of a world.

    A submap is a straight drive of the setup's length with any heading. The second visit of a place has its
    own heading and sees ground whose middle is a quarter of the sensor's range away.

    Parameters
    ----------
    world : str
        One of `names.WORLDS`.
    seed : int
        Not negative. Each place draws from its own stream, whatever the number of places.
    places : int
        How many.
    sensor : str or Setup
        One of `names.SENSORS`, or a setup of one's own.
    revisits : bool
        Two submaps per place instead of one.

    Returns
    -------
    SimulatedPlaces
        With ``places`` submaps, or twice as many.

    Raises
    ------
    TerrainLoopError
        Unknown world or sensor, negative seed, or no places.
    """
    setup = checked_setup(sensor, places, seed)
    streams = [stream.spawn(3) for stream in SeedSequence(seed).spawn(places)]
    side = 2 * _reach(setup)
    terrains = tuple(make_terrain(world, ground, side, setup.terrain_resolution) for ground, *_ in streams)
    clouds, truth = [], []
    visits = [(visit, place) for visit in range(1 + revisits) for place in range(places)]
    with ThreadPoolExecutor() as pool:
        for visit, place in visits:
            cloud, T_place_submap = _visit(setup, terrains[place], visit, streams[place][1 + visit], pool)
            clouds.append(cloud)
            truth.append(translation([place * APART, 0.0, 0.0]) @ T_place_submap)
    return SimulatedPlaces(clouds, tuple(place for _, place in visits), np.stack(truth), terrains)


def _reach(setup: Setup) -> float:
    """Distance from the middle of a place to the farthest ground that a visit sees, metres."""
    return (1 + REVISIT_OFFSET) * setup.sensor.max_range + 0.5 * setup.submap_length + 1.0


def _visit(
    setup: Setup, terrain: Terrain, visit: int, stream: SeedSequence, pool: ThreadPoolExecutor
) -> tuple[NDArray[np.float32], Array]:
    """The cloud of a submap and its true pose T_place_submap."""
    for_path, for_odometry, for_sensor = stream.spawn(3)
    true = true_poses(terrain, _straight_path(setup, np.random.default_rng(for_path), visit))
    frames = estimate(true, setup.frames, setup.drift, np.random.default_rng(for_odometry))
    return submap_cloud(setup, terrain, true, frames.local, for_sensor, pool), frames.truth[0]


def _straight_path(setup: Setup, rng: Generator, visit: int) -> Path:
    """A straight drive with any heading; the middle of what the sensor sees is at the origin, or beside."""
    heading, side = rng.uniform(0, 2 * np.pi, 2)
    ahead, aside = (np.array([np.cos(angle), np.sin(angle)]) for angle in (heading, side))
    middle = visit * REVISIT_OFFSET * setup.sensor.max_range * aside
    stations = setup.frame_spacing * (np.arange(setup.frames) - 0.5 * (setup.frames - 1))
    xy = middle + (stations - setup.sensor.view_centre)[:, None] * ahead
    return Path(xy, np.full(setup.frames, heading), ("first",) * setup.frames)


def write_places(places: SimulatedPlaces, path: FilePath | str) -> None:
    """Write a mission of places to a new folder: ``clouds/*.ply`` and ``truth.tum``.

    Raises
    ------
    TerrainLoopError
        If the folder exists and is not empty.
    """
    folder = FilePath(path)
    if folder.exists() and any(folder.iterdir()):
        raise TerrainLoopError(expected="a new folder", found=f"files in {folder}", mend="name another")
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    for index, cloud in enumerate(places.clouds):
        write_cloud(folder / "clouds" / f"{index:06d}.ply", cloud)
    write_tum(folder / "truth.tum", Trajectory(np.arange(len(places.truth), dtype=float), places.truth))
