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
    """The data of a submap that a method has access to; ground truth is not included.

    Attributes
    ----------
    submap : Submap
    T_odometry_submap : array, (4, 4), or None
        Pose by odometry alone.
    colours : array, (N, 3) uint8, or None
        RGB of the submap's points.
    images : tuple of array, (rows, columns) uint8
        Left camera images in chronological order; none for a LiDAR.
    """

    submap: Submap
    T_odometry_submap: Array | None = None
    colours: NDArray[np.uint8] | None = None
    images: tuple[NDArray[np.uint8], ...] = ()


@dataclass(frozen=True, eq=False)
class Match:
    """Result of a method for a pair.

    Attributes
    ----------
    score : float
        Higher is more certain; `NOT_COMPARABLE` if the method could not compare the two.
    T_target_source : array, (4, 4)
        Takes points of source into the frame of target, metres; NaN if the method estimates none.
    """

    score: float
    T_target_source: Array = field(default_factory=NO_TRANSFORM.copy)


@dataclass(frozen=True, eq=False)
class Method:
    """A method with one choice of its settings.

    Attributes
    ----------
    name : str
        Name in the tables, the same for every choice of settings.
    settings : mapping of str to number or str
        The choice of settings, as shown in the tables.
    software : str
        Package and version, or the publication that was followed.
    describe : callable
        Observation -> description; called once per submap, in chronological order.
    score : callable
        (description of source, description of target) -> Match; the source is the later submap. The
        result does not depend on the pairs scored before.
    """

    name: str
    settings: Mapping[str, Any]
    software: str
    describe: Callable[[Observation], Any]
    score: Callable[[Any, Any], Match]


@dataclass(frozen=True)
class Scale:
    """Lengths that the settings of a method are scaled to.

    Attributes
    ----------
    spacing : float
        Median distance of a point to its nearest neighbour, metres.
    side : float
        Median side of a square of the area of a submap's bounding box, metres.
    """

    spacing: float
    side: float

    @classmethod
    def of(cls, submaps: Sequence[Submap]) -> "Scale":
        """Measure them on the submaps of a mission."""
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
