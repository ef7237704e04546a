"""Ground truth of a mission: where each submap is, which submaps share ground, which revisit a place."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from reprlib import repr as shown  # quotes a name, and cuts one that is too long for a message

import numpy as np
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.overlap import box_iou, world_boxes
from terrainloop.geometry import MAX_COORDINATE, Array, is_rigid
from terrainloop.io.submap_poses import check_upright
from terrainloop.io.trajectories import Trajectory
from terrainloop.record import SubmapRecord

MIN_OVERLAP = 0.3  # IoU above which a pair is a true match (paper, section VI-A)


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """True poses of all submaps of a mission, checked.

    Attributes
    ----------
    records : sequence of SubmapRecord, (M,)
        Every submap of the mission, in order.
    poses : array, (M, 4, 4)
        True T_world_submap of each, metres, gravity-aligned.
    sessions : mapping of str to str, optional
        Session of each submap by name.
    observed : array, (M, M), optional
        Overlap of the observed ground, see `overlap.observed_iou`.

    Raises
    ------
    TerrainLoopError
        If names repeat, a hull has no area, a pose is not a gravity-aligned rigid transform, or a submap
        lacks its pose or its session.
    """

    records: Sequence[SubmapRecord]
    poses: Array
    sessions: Mapping[str, str] | None = None
    observed: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "poses", np.asarray(self.poses, dtype=float))
        _check_records(self.records)
        _check_poses(self.poses, self.records)
        absent = [r.name for r in self.records if self.sessions is not None and r.name not in self.sessions]
        if absent:
            raise TerrainLoopError(
                expected="a session for every submap in the sessions file",
                found=f"none for {shown(absent[0])}",
                mend="add a line 'cloud,session' for each cloud of the run",
            )

    @cached_property
    def index(self) -> dict[str, int]:
        """Position of each submap in the mission, by name."""
        return {record.name: number for number, record in enumerate(self.records)}

    @cached_property
    def box_overlap(self) -> Array:
        """Bounding-box IoU of every two submaps (M, M); 0 for broken ones, which have no box."""
        whole = [number for number, record in enumerate(self.records) if record.status == "ok"]
        iou = np.zeros((len(self.records), len(self.records)))
        boxes = world_boxes([self.records[number].hull for number in whole], self.poses[whole])
        iou[np.ix_(whole, whole)] = box_iou(boxes)
        return iou

    def are_connected(self, i: int, j: int) -> bool:
        """Whether odometry already connects two submaps: consecutive ones, and those of one session."""
        if self.sessions is None:
            return abs(i - j) <= 1
        one, other = (self.sessions[self.records[number].name] for number in (i, j))
        return abs(i - j) <= 1 or one == other

    def revisits(self, min_overlap: float, observed: bool = False) -> NDArray[np.intp]:
        """Indices of the submaps that overlap an earlier one to which odometry does not connect them.

        Parameters
        ----------
        min_overlap : float
            Intersection over union to be exceeded.
        observed : bool
            Use the overlap of the observed ground instead of that of the bounding boxes.
        """
        overlap = self.observed if observed and self.observed is not None else self.box_overlap
        later, earlier = np.nonzero(np.tril(overlap > min_overlap, k=-1))
        return np.unique(
            [i for i, j in zip(later.tolist(), earlier.tolist(), strict=True) if not self.are_connected(i, j)]
        ).astype(np.intp)


def _check_records(records: Sequence[SubmapRecord]) -> None:
    names = Counter(record.name for record in records)
    repeated = [name for name, times in names.items() if times > 1]
    if repeated:
        raise TerrainLoopError(
            expected="every submap once in submaps.csv",
            found=f"{shown(repeated[0])} {names[repeated[0]]} times",
            mend="use the file as 'terrainloop detect' wrote it",
        )
    for record in records:
        if record.status == "ok" and not _has_area(record.hull):
            raise TerrainLoopError(
                expected="a hull of three or more finite corners that enclose an area, for each submap",
                found=f"{shown(record.hull.tolist())} for {shown(record.name)}",
                mend="use submaps.csv as 'terrainloop detect' wrote it",
            )


def _has_area(hull: Array) -> bool:
    if len(hull) < 3 or not (np.abs(hull) <= MAX_COORDINATE).all():  # False for NaN too
        return False
    x, y = (hull - hull[0]).T
    return bool(x @ np.roll(y, -1) != y @ np.roll(x, -1))


def _check_poses(poses: Array, records: Sequence[SubmapRecord]) -> None:
    if len(poses) != len(records):
        raise TerrainLoopError(
            expected=f"one true pose for each of the {len(records)} submaps",
            found=f"{len(poses)} poses",
            mend="give the truth of this mission, one line per cloud, broken clouds included",
        )
    for pose, record in zip(poses, records, strict=True):
        if not is_rigid(pose):
            raise TerrainLoopError(
                expected="true poses with a rotation and finite coordinates below 1e9 m",
                found=f"no such pose for {shown(record.name)}",
                mend="correct that line of the truth",
            )
    check_upright(Trajectory(np.arange(len(poses), dtype=float), np.asarray(poses)), "the truth")
