"""What is kept of a submap once its points are gone, apart from its map."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from terrainloop.submap import Submap


@dataclass(frozen=True, eq=False)
class SubmapRecord:
    """One line of `submaps.csv`.

    Attributes
    ----------
    name : str
    stamp : float
        Seconds, or the index within the mission.
    points : int
        Number of points used, 0 if broken.
    status : {"ok", "broken"}
    hull : array, (M, 2)
        Corners, anticlockwise, of the convex hull of x and y in the submap's own frame, metres, rounded to
        millimetres; empty if broken.
    notes : str
        Repairs and warnings, or what is wrong.
    session : str
        Name of the session the submap belongs to; empty if there is only one.
    odometry : array, (4, 4), or None
        T_world_submap by odometry, where it is known.
    """

    name: str
    stamp: float = 0.0
    points: int = 0
    status: Literal["ok", "broken"] = "ok"
    hull: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    notes: str = ""
    session: str = ""
    odometry: NDArray[np.float64] | None = None

    @classmethod
    def of(cls, submap: Submap, odometry: NDArray[np.float64] | None = None) -> "SubmapRecord":
        """The record of a submap, with its pose by odometry where that is known."""
        return cls(
            name=submap.name,
            stamp=submap.stamp,
            points=len(submap),
            hull=_hull_of(submap.points[:, :2]),
            notes="; ".join([*submap.repairs, *submap.warnings]),
            session=submap.session,
            odometry=odometry,
        )


def _hull_of(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    corners = xy[ConvexHull(xy - xy[0]).vertices]
    return np.round(corners, 3) + 0.0  # no negative zeros
