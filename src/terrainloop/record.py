"""What is kept of a submap without its points, apart from its map."""

from dataclasses import dataclass, field
from typing import Literal

import cv2
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
        Repairs and warnings, or the error of a broken cloud.
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


def hull_overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Intersection over union of two convex polygons (K, 2) and (M, 2), anticlockwise, metres, 0 to 1."""
    if not len(a) or not len(b):
        return 0.0
    middle = b.mean(axis=0)  # single precision is enough about it
    first, second = ((corners - middle).astype(np.float32) for corners in (a, b))
    shared, _ = cv2.intersectConvexConvex(first, second)
    return float(shared / max(cv2.contourArea(first) + cv2.contourArea(second) - shared, 1e-30))
