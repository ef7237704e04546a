"""The one interface of everything that is compared: describe each submap once, score each pair."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array
from terrainloop.submap import Submap

NO_TRANSFORM = np.full((4, 4), np.nan)
NOT_COMPARABLE = -np.inf  # score of a pair that a method could not compare


@dataclass(frozen=True, eq=False)
class Observation:
    """All that a method may know of a submap; the truth is not in it.

    Attributes
    ----------
    submap : Submap
    T_odometry_submap : array, (4, 4), or None
        Its pose by odometry alone.
    colours : array, (N, 3) uint8, or None
        RGB of the submap's points.
    images : tuple of array, (rows, columns) uint8
        Left camera images, in the order driven; none for a LiDAR.
    """

    submap: Submap
    T_odometry_submap: Array | None = None
    colours: NDArray[np.uint8] | None = None
    images: tuple[NDArray[np.uint8], ...] = ()


@dataclass(frozen=True, eq=False)
class Match:
    """What a method says of a pair.

    Attributes
    ----------
    score : float
        Higher is surer; `NOT_COMPARABLE` where the method could not compare the two.
    T_target_source : array, (4, 4)
        Takes points of source into the frame of target, metres; NaN where the method gives none.
    """

    score: float
    T_target_source: Array = field(default_factory=NO_TRANSFORM.copy)


@dataclass(frozen=True, eq=False)
class Method:
    """A method with one choice of its settings.

    Attributes
    ----------
    name : str
        As tables print it, the same for every choice of settings.
    settings : mapping of str to number or str
        What was chosen, as tables print it.
    software : str
        Package and version that does the work, or the publication that was followed.
    describe : callable
        Observation -> what is kept of the submap; done once for each, in the order driven.
    score : callable
        (kept of source, kept of target) -> Match; the source is the later submap. The same two give the
        same match, whatever was scored before.
    """

    name: str
    settings: Mapping[str, Any]
    software: str
    describe: Callable[[Observation], Any]
    score: Callable[[Any, Any], Match]


@dataclass(frozen=True)
class Scale:
    """What the settings of a method are scaled to.

    Attributes
    ----------
    spacing : float
        Median distance of a point to its nearest neighbour, metres.
    side : float
        Root of the median area that a submap's bounding box covers, metres.
    """

    spacing: float
    side: float

    @classmethod
    def of(cls, submaps: Sequence[Submap]) -> "Scale":
        """Measured on the submaps of a mission."""
        sides = [np.sqrt(np.ptp(submap.points[:, :2], axis=0).prod()) for submap in submaps]
        spacings = []
        for submap in submaps:
            some = submap.points[:: max(1, len(submap) // 1000)]
            spacings.append(np.median(np.asarray(KDTree(submap.points).query(some, k=2)[0])[:, 1]))
        return cls(spacing=float(np.median(spacings)), side=float(np.median(sides)))


def require(module: str, package: str) -> tuple[ModuleType, str]:
    """An optional module, and its package with version.

    Raises
    ------
    TerrainLoopError
        If it is not installed or cannot be imported, in one line.
    """
    try:
        return import_module(module), f"{package} {version(package)}"
    except ImportError as error:
        absent = isinstance(error, ModuleNotFoundError)
        raise TerrainLoopError(
            expected=f"the package {package}, which this baseline runs",
            found=" ".join(str(error).split()),
            mend=f"pip install {package}" if absent else "install the system library that it names",
        ) from error
