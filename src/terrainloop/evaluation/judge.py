"""Loop candidates held against true poses: how much ground each pair shares, how far each pose is off."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.overlap import box_iou, world_boxes
from terrainloop.geometry import Array, inverse, yaw_of
from terrainloop.io.results import SubmapRecord
from terrainloop.loop import LoopCandidate

POSITION_TOLERANCE = 1.0  # metres within which a pose closes the right loop
YAW_TOLERANCE = np.deg2rad(5.0)


@dataclass(frozen=True)
class JudgedPair:
    """A candidate and the truth about it.

    Attributes
    ----------
    candidate : LoopCandidate
    overlap : float
        Intersection over union of the posed submaps' bounding boxes, 0 to 1.
    position_error : float
        Horizontal distance between the estimated and the true position of the source in the target
        frame, at the middle of the source, metres; NaN without a transform.
    height_error : float
        The same, vertically.
    yaw_error : float
        Radians.
    """

    candidate: LoopCandidate
    overlap: float
    position_error: float
    height_error: float
    yaw_error: float

    @property
    def pose_is_right(self) -> bool:
        """Whether the estimated pose is that of the place, and not of another that looks alike."""
        return self.position_error < POSITION_TOLERANCE and self.yaw_error < YAW_TOLERANCE


def judge(
    candidates: Sequence[LoopCandidate],
    records: Sequence[SubmapRecord],
    poses: Array,
    sessions: Mapping[str, str] | None = None,
) -> list[JudgedPair]:
    """Compare candidates with the truth, leaving out pairs that odometry joins anyway.

    Left out are pairs of consecutive submaps and, where sessions are given, pairs of one session.

    Parameters
    ----------
    candidates : sequence of LoopCandidate
    records : sequence of SubmapRecord, (M,)
        Every submap of the mission, in order.
    poses : array, (M, 4, 4)
        True T_world_submap of each.
    sessions : mapping of str to str, optional
        Session of each submap by name.

    Raises
    ------
    TerrainLoopError
        If there is not one pose a submap, or a name is unknown.
    """
    if len(poses) != len(records):
        raise TerrainLoopError(
            expected=f"one true pose for each of the {len(records)} submaps",
            found=f"{len(poses)} poses",
            mend="give the truth of this very mission, one line a cloud",
        )
    order = {record.name: number for number, record in enumerate(records)}
    _check_names(candidates, order, sessions)
    whole = [number for number, record in enumerate(records) if record.status == "ok"]
    overlap = np.zeros((len(records), len(records)))
    boxes = world_boxes([records[number].hull for number in whole], poses[whole])
    overlap[np.ix_(whole, whole)] = box_iou(boxes)
    judged = []
    for candidate in candidates:
        i, j = order[candidate.source], order[candidate.target]
        same = sessions is not None and sessions[candidate.source] == sessions[candidate.target]
        if abs(i - j) > 1 and not same:
            truth = inverse(poses[j]) @ poses[i]
            middle = np.array([*records[i].hull.mean(axis=0), 0.0, 1.0])
            offset = (candidate.T_target_source @ middle - truth @ middle)[:3]
            judged.append(
                JudgedPair(
                    candidate=candidate,
                    overlap=float(overlap[i, j]),
                    position_error=float(np.hypot(*offset[:2])),
                    height_error=float(abs(offset[2])),
                    yaw_error=abs(yaw_of(inverse(truth) @ candidate.T_target_source)),
                )
            )
    return judged


def _check_names(
    candidates: Sequence[LoopCandidate], order: Mapping[str, int], sessions: Mapping[str, str] | None
) -> None:
    names = {name for candidate in candidates for name in (candidate.source, candidate.target)}
    for known, what in ((order, "submaps.csv"), (sessions, "the sessions file")):
        if known is not None and not names <= set(known):
            raise TerrainLoopError(
                expected=f"every submap of pairs.csv in {what}",
                found=f"no {sorted(names - set(known))[0]!r}",
                mend="give files of one and the same run",
            )
