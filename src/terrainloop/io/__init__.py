"""Files: clouds, trajectories, missions, recordings and results."""

from terrainloop.io.clouds import CLOUD_SUFFIXES, read_cloud, read_crs, read_scan, write_cloud
from terrainloop.io.missions import Mission, load_mission
from terrainloop.io.recordings import Recording, open_recording
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
    "Recording",
    "Trajectory",
    "load_mission",
    "open_recording",
    "read_cloud",
    "read_crs",
    "read_loops",
    "read_scan",
    "read_submaps",
    "read_trajectory",
    "write_cloud",
    "write_loops",
    "write_submaps",
    "write_tum",
]
