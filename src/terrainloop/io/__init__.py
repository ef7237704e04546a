"""Files: clouds, trajectories, missions and results."""

from terrainloop.io.clouds import CLOUD_SUFFIXES, read_cloud, read_crs, write_cloud
from terrainloop.io.missions import Mission, load_mission
from terrainloop.io.results import (
    read_loops,
    read_submaps,
    write_loops,
    write_submaps,
)
from terrainloop.io.trajectories import Trajectory, read_trajectory, write_tum

__all__ = [
    "CLOUD_SUFFIXES",
    "Mission",
    "Trajectory",
    "load_mission",
    "read_cloud",
    "read_crs",
    "read_loops",
    "read_submaps",
    "read_trajectory",
    "write_cloud",
    "write_loops",
    "write_submaps",
    "write_tum",
]
