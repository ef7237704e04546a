"""Loop closures from the shape of the ground, by Gaussian-process gradient maps."""

from importlib import import_module as _import_module
from importlib.metadata import PackageNotFoundError as _PackageNotFoundError
from importlib.metadata import version as _version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from terrainloop.config import Settings
    from terrainloop.detection.detector import LoopDetector
    from terrainloop.detection.mission import detect_mission
    from terrainloop.detection.run import Run
    from terrainloop.entry import MapEntry
    from terrainloop.errors import TerrainLoopError
    from terrainloop.gp.hyperparameters import fit_hyperparameters
    from terrainloop.gp.kernel import Hyperparameters
    from terrainloop.gp.process import ElevationProcess
    from terrainloop.gradient_map import GradientMap
    from terrainloop.io.clouds import read_cloud, read_crs, read_scan, write_cloud
    from terrainloop.io.missions import Mission, load_mission
    from terrainloop.io.recordings import Recording, open_recording
    from terrainloop.loop import LoopCandidate
    from terrainloop.matching.register import register
    from terrainloop.pose_graph import PoseGraph, Solution
    from terrainloop.scan import PosedScan, Scan
    from terrainloop.slam.mapper import Mapper
    from terrainloop.slam.run import SlamRun, run_slam
    from terrainloop.slam.submapping import Submapper
    from terrainloop.submap import Submap

_HOME = {
    "ElevationProcess": "gp.process",
    "GradientMap": "gradient_map",
    "Hyperparameters": "gp.kernel",
    "LoopCandidate": "loop",
    "LoopDetector": "detection.detector",
    "MapEntry": "entry",
    "Mapper": "slam.mapper",
    "Mission": "io.missions",
    "PoseGraph": "pose_graph",
    "PosedScan": "scan",
    "Recording": "io.recordings",
    "Run": "detection.run",
    "Scan": "scan",
    "Settings": "config",
    "SlamRun": "slam.run",
    "Solution": "pose_graph",
    "Submap": "submap",
    "Submapper": "slam.submapping",
    "TerrainLoopError": "errors",
    "detect_mission": "detection.mission",
    "fit_hyperparameters": "gp.hyperparameters",
    "load_mission": "io.missions",
    "open_recording": "io.recordings",
    "read_cloud": "io.clouds",
    "read_crs": "io.clouds",
    "read_scan": "io.clouds",
    "register": "matching.register",
    "run_slam": "slam.run",
    "write_cloud": "io.clouds",
}

__all__ = [
    "ElevationProcess",
    "GradientMap",
    "Hyperparameters",
    "LoopCandidate",
    "LoopDetector",
    "MapEntry",
    "Mapper",
    "Mission",
    "PoseGraph",
    "PosedScan",
    "Recording",
    "Run",
    "Scan",
    "Settings",
    "SlamRun",
    "Solution",
    "Submap",
    "Submapper",
    "TerrainLoopError",
    "detect_mission",
    "fit_hyperparameters",
    "load_mission",
    "open_recording",
    "read_cloud",
    "read_crs",
    "read_scan",
    "register",
    "run_slam",
    "write_cloud",
]

try:
    __version__ = _version("terrainloop")
except _PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "unknown"


def __getattr__(name: str) -> object:
    # Loaded on first use, so that the command line answers --help at once.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(_import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
