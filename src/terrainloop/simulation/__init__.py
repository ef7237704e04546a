"""Simulated missions with ground truth: terrain, sensors, rover paths that revisit."""

from terrainloop.simulation.missions import SENSORS, SimulatedMission, simulate_mission, write_mission
from terrainloop.simulation.terrain import WORLDS, Terrain, make_terrain

__all__ = [
    "SENSORS",
    "WORLDS",
    "SimulatedMission",
    "Terrain",
    "make_terrain",
    "simulate_mission",
    "write_mission",
]
