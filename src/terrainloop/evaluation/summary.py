"""A run of `terrainloop detect` evaluated against ground truth: everything that is reported of it."""

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from terrainloop.config import MatchSettings
from terrainloop.detection.run import Run
from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.criteria import Criterion, criteria
from terrainloop.evaluation.overlap import ground_cell, observed_iou
from terrainloop.evaluation.pairs import EvaluatedPair, Tolerance, evaluate_pairs
from terrainloop.evaluation.precision_recall import (
    Metrics,
    OperatingPoint,
    precision_recall,
    recall_at_full_precision,
)
from terrainloop.evaluation.retrieval import Retrieval, retrieval
from terrainloop.evaluation.truth import MIN_OVERLAP, GroundTruth
from terrainloop.geometry import Array, inverse
from terrainloop.io.files import write_whole_text
from terrainloop.io.missions import load_mission, read_sessions
from terrainloop.io.submap_poses import read_submap_poses
from terrainloop.loop import LoopCandidate

OVERLAP_BANDS = ((0.1, 0.3), (0.3, 1.0))  # IoU; the paper's two thresholds bound them
INLIER_THRESHOLDS = tuple(range(1, 21))  # the paper's
SCORE_THRESHOLDS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 50)
COARSE = (2.0, float(np.deg2rad(5.0)))  # metres, radians: success as HOTFLoc++ reports it
COARSE_YAW = float(np.deg2rad(10.0))  # as MPRF reports it

Pairs = Sequence[EvaluatedPair[LoopCandidate]]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Evaluated pairs of a run, and all that is counted of them.

    Attributes
    ----------
    truth : GroundTruth
    pairs : sequence of EvaluatedPair, (P,)
        Those that odometry does not already connect.
    tolerance : Tolerance
        Errors below which a pose is right.
    min_overlap : float
        Intersection over union above which a pair is true.
    score_name : {"score", "inliers"}
        What the run decides by.
    scores : array, (P,)
        Its value for each pair; minus infinity where there is no transform to accept.
    left_out : int
        Pairs of the run that odometry already connects.
    """

    truth: GroundTruth
    pairs: Pairs
    tolerance: Tolerance
    min_overlap: float
    score_name: str
    scores: Array
    left_out: int

    @property
    def overlaps(self) -> tuple[str, ...]:
        """By which overlap pairs are called true: "box" and, where clouds were given, "observed"."""
        return ("box",) if self.truth.observed is None else ("box", "observed")

    @property
    def loops(self) -> Pairs:
        """Accepted pairs."""
        return [pair for pair in self.pairs if pair.candidate]

    @property
    def right_loops(self) -> Pairs:
        """Accepted pairs whose pose is right."""
        return [pair for pair in self.loops if pair.pose_is_right]

    @cached_property
    def criteria(self) -> dict[tuple[str, str], Criterion]:
        """By overlap ("box", "observed") and name ("overlap", "overlap and pose", "pose")."""
        return {
            (overlap, name): criterion
            for overlap in self.overlaps
            for name, criterion in criteria(
                self.pairs, self.min_overlap, overlap == "observed", self.scores
            ).items()
        }

    @cached_property
    def metrics(self) -> dict[tuple[str, str], Metrics]:
        """Of each criterion."""
        return {key: criterion.metrics() for key, criterion in self.criteria.items()}

    @cached_property
    def retrieval(self) -> dict[str, Retrieval]:
        """By overlap."""
        return {
            overlap: retrieval(self.pairs, self.scores, self.truth, self.min_overlap, overlap == "observed")
            for overlap in self.overlaps
        }

    def points(self, criterion: str) -> list[OperatingPoint]:
        """Precision and recall by bounding boxes at the fixed thresholds."""
        thresholds = SCORE_THRESHOLDS if self.score_name == "score" else INLIER_THRESHOLDS
        chosen = self.criteria["box", criterion]
        return precision_recall(chosen.scores, chosen.is_true, thresholds, chosen.is_right)

    @cached_property
    def table(self) -> list[dict[str, Any]]:
        """Counts at the fixed thresholds, a row each, as `precision_recall.csv` has them."""
        right = np.array([pair.pose_is_right for pair in self.pairs], dtype=bool)
        rows = []
        for by_overlap, by_pose in zip(self.points("overlap"), self.points("pose"), strict=True):
            matched = self.scores >= by_overlap.threshold
            counts = int((matched & right).sum()), int((matched & ~right).sum())
            rows.append(
                {
                    f"min_{self.score_name}": int(by_overlap.threshold),
                    **_counts(by_overlap),
                    "pose_precision": _share(counts[0], sum(counts)),
                    "pose_recall": by_pose.recall,
                    "right_poses": counts[0],
                    "wrong_poses": counts[1],
                }
            )
        return rows

    def found(self, overlap: str = "box") -> int:
        """Number of true pairs that were accepted with the right pose."""
        return sum(_overlap(pair, overlap) > self.min_overlap for pair in self.right_loops)

    def as_dict(self) -> dict[str, Any]:
        """Everything that is reported, as JSON has it; NaN where nothing can be claimed."""
        return {
            "pairs": len(self.pairs),
            "pairs_left_out": self.left_out,
            "min_overlap": self.min_overlap,
            "position_tolerance_m": self.tolerance.position,
            "yaw_tolerance_deg": float(np.degrees(self.tolerance.yaw)),
            **_loop_counts(self),
            "retrieval": [{"truth": overlap, **_retrieval_row(self, overlap)} for overlap in self.overlaps],
            **_paper_counts(self),
            "threshold": self.score_name,
            "metrics": [
                {"truth": overlap, "right_by": name, **asdict(metrics)}
                for (overlap, name), metrics in self.metrics.items()
            ],
            "precision_recall": self.table,
        }

    def write(self, folder: Path) -> None:
        """Write `precision_recall.csv` and `precision_recall_curve.csv`."""
        columns = list(self.table[0])
        _write_rows(folder / "precision_recall.csv", columns, [list(row.values()) for row in self.table])
        columns = ["truth", "right_by", f"min_{self.score_name}", *_COUNTS]
        rows = [
            [*key, point.threshold, *_counts(point).values()]
            for key, criterion in self.criteria.items()
            for point in criterion.curve()
        ]
        _write_rows(folder / "precision_recall_curve.csv", columns, rows)


def evaluate_run(
    run: Path,
    truth: Path,
    *,
    min_overlap: float = MIN_OVERLAP,
    position_tolerance: float | None = None,
    yaw_tolerance: float | None = None,
    sessions: Path | None = None,
    clouds: Path | None = None,
) -> Evaluation:
    """Evaluate the output of `terrainloop detect`.

    Parameters
    ----------
    run : Path
        Output folder of the run.
    truth : Path
        True poses, TUM or KITTI, one line per cloud.
    min_overlap : float
        Intersection over union above which a pair is true.
    position_tolerance, yaw_tolerance : float, optional
        Errors below which a pose is right, metres and radians; see `Tolerance.for_submaps`.
    sessions : Path, optional
        CSV of cloud and session: pairs of one session are left out.
    clouds : Path, optional
        The mission: pairs are evaluated by the overlap of the observed ground, too.

    Raises
    ------
    TerrainLoopError
        If a file cannot be read, or the files do not belong to one run.
    """
    if not 0 <= min_overlap <= 1:
        raise TerrainLoopError(
            expected="a minimum overlap between 0 and 1", found=f"{min_overlap:g}", mend="the paper takes 0.3"
        )
    found = Run.read(run)
    with np.errstate(invalid="ignore"):  # an infinite angle is refused when its pair is evaluated
        candidates = list(found.pairs())
    known = GroundTruth(
        found.submaps,
        read_submap_poses(truth, [record.name for record in found.submaps]).poses,
        None if sessions is None else read_sessions(sessions),
    )
    if clouds is not None:
        known = replace(known, observed=_observed_overlap(clouds, known))
    tolerance = Tolerance.for_submaps(found.submaps, position_tolerance, yaw_tolerance)
    pairs = evaluate_pairs(candidates, known, tolerance)
    _check_direction(pairs, known, tolerance)
    name, scores = _thresholded(pairs, found.settings.match)
    return Evaluation(known, pairs, tolerance, min_overlap, name, scores, len(candidates) - len(pairs))


def _observed_overlap(folder: Path, truth: GroundTruth) -> Array:
    """Overlap of the ground that the clouds of a mission observed; broken ones share nothing."""
    mission, names = load_mission(folder), tuple(truth.index)
    if mission.names != names:
        raise TerrainLoopError(
            expected=f"the {len(names)} clouds of the run in {folder}",
            found=f"{len(mission)} there" if len(mission) != len(names) else "other names",
            mend="give the mission that 'terrainloop detect' was run on",
        )
    clouds = [
        mission.read(number).points if record.status == "ok" else np.empty((0, 3))
        for number, record in enumerate(truth.records)
    ]
    return observed_iou(clouds, truth.poses, ground_cell(clouds))


def _check_direction(pairs: Pairs, truth: GroundTruth, tolerance: Tolerance) -> None:
    """Refuse poses given as T_submap_world: most loops are wrong by them, and right by their inverses."""
    loops = [pair.candidate for pair in pairs if pair.candidate]
    wrong = sum(not pair.pose_is_right for pair in pairs if pair.candidate)
    if 2 * wrong <= len(loops):
        return
    inverted = GroundTruth(truth.records, np.array([inverse(pose) for pose in truth.poses]))
    right = sum(pair.pose_is_right for pair in evaluate_pairs(loops, inverted, tolerance))
    if 2 * right > len(loops):
        raise TerrainLoopError(
            expected="true poses that take points of a submap into the world (T_world_submap)",
            found=f"{right} of {len(loops)} loops right by the inverse poses, "
            f"{len(loops) - wrong} by the poses as given",
            mend="invert the poses of the truth",
        )


def _thresholded(pairs: Pairs, match: MatchSettings) -> tuple[str, Array]:
    """Name and values of what the run decides by; minus infinity without an acceptable transform."""
    if match.decision == "evidence":
        comparable = [bool(np.isfinite(pair.candidate.T_target_source).all()) for pair in pairs]
        name, values = "score", [pair.candidate.score for pair in pairs]
    else:  # Algorithm 1 returns the inliers of an acceptable transform only
        comparable = [pair.candidate.ssd_ratio <= match.max_ssd_ratio for pair in pairs]
        name, values = "inliers", [float(pair.candidate.inliers) for pair in pairs]
    return name, np.where(comparable, np.array(values, dtype=float), -np.inf)


def _loop_counts(evaluation: Evaluation) -> dict[str, Any]:
    """Accepted loops by their pose."""
    loops, right = evaluation.loops, evaluation.right_loops
    return {
        "accepted": len(loops),
        "accepted_right_pose": len(right),
        "accepted_wrong_pose": len(loops) - len(right),
        "share_within_2m_5deg": _share(sum(pair.is_within(*COARSE) for pair in loops), len(loops)),
        "share_yaw_within_10deg": _share(sum(pair.yaw_error < COARSE_YAW for pair in loops), len(loops)),
        "right_pose_median_position_error_m": _median([pair.position_error for pair in right]),
        "right_pose_median_height_error_m": _median([pair.height_error for pair in right]),
        "right_pose_median_yaw_error_deg": float(np.degrees(_median([pair.yaw_error for pair in right]))),
    }


def _retrieval_row(evaluation: Evaluation, overlap: str) -> dict[str, Any]:
    counts = evaluation.retrieval[overlap]
    return {
        "true_pairs": sum(_overlap(pair, overlap) > evaluation.min_overlap for pair in evaluation.pairs),
        "true_pairs_found": evaluation.found(overlap),
        **asdict(counts),
        "recall_at_one": counts.recall_at_one,
        "precision_at_one": counts.precision_at_one,
        "closed_share": counts.closed_share,
    }


def _paper_counts(evaluation: Evaluation) -> dict[str, Any]:
    """Pairs by their bounding-box overlap: the criterion of the paper."""
    pairs, loops, least = evaluation.pairs, evaluation.loops, evaluation.min_overlap
    true = [pair for pair in loops if pair.overlap > least]
    disjoint = [pair.candidate.score for pair in pairs if pair.overlap == 0]
    bands = {
        f"{low:g}-{high:g}": [pair.candidate.score for pair in pairs if low < pair.overlap <= high]
        for low, high in OVERLAP_BANDS
    }
    return {
        "true_pairs": sum(pair.overlap > least for pair in pairs),
        "disjoint_pairs": len(disjoint),
        "accepted_true": len(true),
        "accepted_less_overlap": sum(0 < pair.overlap <= least for pair in loops),
        "accepted_disjoint": sum(pair.overlap == 0 for pair in loops),
        "median_position_error_m": _median([pair.position_error for pair in true]),
        "median_height_error_m": _median([pair.height_error for pair in true]),
        "median_yaw_error_deg": float(np.degrees(_median([pair.yaw_error for pair in true]))),
        "recall_before_first_disjoint": {
            band: recall_at_full_precision(scores, disjoint) for band, scores in bands.items()
        },
        "pairs_by_overlap": {band: len(scores) for band, scores in bands.items()},
    }


_COUNTS = ("precision", "recall", "true_positives", "false_positives", "false_negatives")


def _counts(point: OperatingPoint) -> dict[str, float]:
    return {count: getattr(point, count) for count in _COUNTS}


def _overlap(pair: EvaluatedPair[LoopCandidate], overlap: str) -> float:
    return pair.observed_overlap if overlap == "observed" else pair.overlap


def _write_rows(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    def write(file: TextIO) -> None:
        csv.writer(file).writerows([columns, *rows])

    write_whole_text(path, write)


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
