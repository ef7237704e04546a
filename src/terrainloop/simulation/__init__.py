"""Simulated missions with ground truth: terrain, sensors, rover paths that revisit, unrelated places."""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING

from terrainloop.simulation.names import SENSORS, WORLDS

if TYPE_CHECKING:
    from terrainloop.simulation.missions import SimulatedMission, simulate_mission, write_mission
    from terrainloop.simulation.places import SimulatedPlaces, simulate_places, write_places
    from terrainloop.simulation.setups import SETUPS, Setup
    from terrainloop.simulation.terrain import Terrain, make_terrain

_HOME = {
    "SETUPS": "setups",
    "Setup": "setups",
    "SimulatedMission": "missions",
    "SimulatedPlaces": "places",
    "Terrain": "terrain",
    "make_terrain": "terrain",
    "simulate_mission": "missions",
    "simulate_places": "places",
    "write_mission": "missions",
    "write_places": "places",
}

__all__ = [
    "SENSORS",
    "SETUPS",
    "WORLDS",
    "Setup",
    "SimulatedMission",
    "SimulatedPlaces",
    "Terrain",
    "make_terrain",
    "simulate_mission",
    "simulate_places",
    "write_mission",
    "write_places",
]


def __getattr__(name: str) -> object:
    # Loaded when first asked for, so that the command line answers --help at once.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(_import_module(f"{__name__}.{_HOME[name]}"), name)
