"""Scored pairs held against true poses: how much ground each pair shares, how far each pose is off."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.overlap import box_iou, world_boxes
from terrainloop.evaluation.precision_recall import Metrics, OperatingPoint, measure, precision_recall
from terrainloop.geometry import Array, inverse, yaw_of
from terrainloop.record import SubmapRecord

POSITION_TOLERANCE = 1.0  # metres within which a pose closes the right loop
YAW_TOLERANCE = float(np.deg2rad(5.0))


class ScoredPair(Protocol):
    """What any method says of a pair of submaps; a LoopCandidate is one."""

    @property
    def source(self) -> str:
        """Name of one submap."""

    @property
    def target(self) -> str:
        """Name of the other."""

    @property
    def score(self) -> float:
        """Higher is surer; minus infinity or NaN where the two could not be compared."""

    @property
    def T_target_source(self) -> Array:
        """Takes points of source into the frame of target (4 x 4); NaN where there is none."""


Pair = TypeVar("Pair", bound=ScoredPair, covariant=True)


@dataclass(frozen=True, eq=False)
class JudgedPair(Generic[Pair]):
    """A scored pair and the truth about it.

    Attributes
    ----------
    candidate : ScoredPair
        As it was given.
    overlap : float
        Intersection over union of the posed submaps' bounding boxes, 0 to 1.
    observed_overlap : float
        The same of the ground that they observed; NaN where it was not given.
    position_error : float
        Horizontal distance between the estimated and the true position of the source in the target
        frame, at the middle of the source, metres; NaN without a transform.
    height_error : float
        The same, vertically.
    yaw_error : float
        Radians.
    """

    candidate: Pair
    overlap: float
    observed_overlap: float
    position_error: float
    height_error: float
    yaw_error: float

    @property
    def pose_is_right(self) -> bool:
        """Whether the estimated pose is that of the place, and not of another that looks alike."""
        return self.position_error < POSITION_TOLERANCE and self.yaw_error < YAW_TOLERANCE


def judge(
    pairs: Sequence[Pair],
    records: Sequence[SubmapRecord],
    poses: Array,
    sessions: Mapping[str, str] | None = None,
    observed: Array | None = None,
) -> list[JudgedPair[Pair]]:
    """Compare scored pairs with the truth, leaving out those that odometry joins anyway.

    Left out are pairs of consecutive submaps (neighbours in `records`) and, where sessions are given,
    pairs of one session.

    Parameters
    ----------
    pairs : sequence of ScoredPair
    records : sequence of SubmapRecord, (M,)
        Every submap of the mission, in order.
    poses : array, (M, 4, 4)
        True T_world_submap of each.
    sessions : mapping of str to str, optional
        Session of each submap by name.
    observed : array, (M, M), optional
        What `overlap.observed_iou` says of the submaps.

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
    _check_names(pairs, order, sessions)
    boxes = _boxes_iou(records, poses)
    judged = []
    for pair in pairs:
        i, j = order[pair.source], order[pair.target]
        same = sessions is not None and sessions[pair.source] == sessions[pair.target]
        if abs(i - j) > 1 and not same:
            truth = inverse(poses[j]) @ poses[i]
            middle = np.array([*records[i].hull.mean(axis=0), 0.0, 1.0])
            offset = (pair.T_target_source @ middle - truth @ middle)[:3]
            judged.append(
                JudgedPair(
                    candidate=pair,
                    overlap=float(boxes[i, j]),
                    observed_overlap=float("nan") if observed is None else float(observed[i, j]),
                    position_error=float(np.hypot(*offset[:2])),
                    height_error=float(abs(offset[2])),
                    yaw_error=abs(yaw_of(inverse(truth) @ pair.T_target_source)),
                )
            )
    return judged


@dataclass(frozen=True, eq=False)
class Reading:
    """Judged pairs as one reading of right and wrong counts them.

    Attributes
    ----------
    scores : array, (P,)
    is_true : array, (P,) bool
        Whether the two share enough ground; what recall is a share of.
    is_right : array, (P,) bool
        Whether the match of a true pair is right; those of other pairs are all false.
    submaps : array, (P, 2) of str
        Source and target.
    """

    scores: Array
    is_true: NDArray[np.bool_]
    is_right: NDArray[np.bool_]
    submaps: NDArray[np.str_]

    def curve(self) -> list[OperatingPoint]:
        """Precision and recall at every distinct score, from high to low."""
        return precision_recall(self.scores, self.is_true, is_right=self.is_right)

    def metrics(self) -> Metrics:
        """The curve in three numbers, with intervals."""
        return measure(self.scores, self.is_true, self.submaps, self.is_right)


def readings(
    pairs: Sequence[JudgedPair[ScoredPair]],
    min_overlap: float,
    observed: bool = False,
    scores: ArrayLike | None = None,
) -> dict[str, Reading]:
    """The ways in which matches are called right.

    In all of them a pair is true if it shares more than `min_overlap`. A match is right

    - by "overlap", if its pair is true: the paper's reading;
    - by "overlap and pose", if its pair is true and its pose right: the strictest;
    - by "pose", if its pose is right. Pairs that share less but were given the right pose count for
      nothing here, neither as found nor as false: they close a loop where there is one.

    Parameters
    ----------
    pairs : sequence of JudgedPair
    min_overlap : float
        Intersection over union.
    observed : bool
        Take that of the observed ground, rather than that of the bounding boxes.
    scores : array_like, (P,), optional
        In place of the pairs' own.
    """
    overlap = np.array([pair.observed_overlap if observed else pair.overlap for pair in pairs])
    is_true = overlap > min_overlap
    pose = np.array([pair.pose_is_right for pair in pairs], dtype=bool)
    own = [pair.candidate.score for pair in pairs] if scores is None else scores
    values = np.asarray(own, dtype=float)
    submaps = np.array([(pair.candidate.source, pair.candidate.target) for pair in pairs], dtype=str)
    submaps = submaps.reshape(-1, 2)
    counted = is_true | ~pose
    return {
        "overlap": Reading(values, is_true, is_true, submaps),
        "overlap and pose": Reading(values, is_true, pose, submaps),
        "pose": Reading(values[counted], is_true[counted], pose[counted], submaps[counted]),
    }


def _boxes_iou(records: Sequence[SubmapRecord], poses: Array) -> Array:
    """Of every two submaps (M, M); broken ones have no box and share nothing."""
    whole = [number for number, record in enumerate(records) if record.status == "ok"]
    iou = np.zeros((len(records), len(records)))
    iou[np.ix_(whole, whole)] = box_iou(world_boxes([records[number].hull for number in whole], poses[whole]))
    return iou


def _check_names(
    pairs: Sequence[ScoredPair], order: Mapping[str, int], sessions: Mapping[str, str] | None
) -> None:
    names = {name for pair in pairs for name in (pair.source, pair.target)}
    for known, what in ((order, "submaps.csv"), (sessions, "the sessions file")):
        if known is not None and not names <= set(known):
            raise TerrainLoopError(
                expected=f"every submap of pairs.csv in {what}",
                found=f"no {sorted(names - set(known))[0]!r}",
                mend="give files of one and the same run",
            )
