"""``terrainloop evaluate``: precision and recall against the truth."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console

from terrainloop.cli.terminal import Json, Quiet, Terminal, Verbose, table_of
from terrainloop.errors import TerrainLoopError

if TYPE_CHECKING:
    from terrainloop.evaluation.judge import JudgedPair
    from terrainloop.evaluation.precision_recall import OperatingPoint

INLIER_THRESHOLDS: Sequence[int] = tuple(range(1, 21))  # the paper's
SCORE_THRESHOLDS: Sequence[int] = (0, 1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 50)


def command(
    run: Annotated[Path, typer.Argument(help="Output folder of 'terrainloop detect'.")],
    truth: Annotated[Path, typer.Option("--truth", help="True poses, TUM or KITTI, one line a cloud.")],
    min_overlap: Annotated[
        float,
        typer.Option(
            "--min-overlap",
            min=0.0,
            max=1.0,
            help="A true match has a larger bounding-box IoU than this (the paper: 0.3, Morocco 0.1).",
        ),
    ] = 0.3,
    sessions: Annotated[
        Path | None,
        typer.Option("--sessions", help="CSV 'cloud,session': leave out pairs of one session."),
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Hold a run's pairs against true poses: precision and recall over the score or the inlier threshold.

    Consecutive submaps are left out: odometry joins them anyway. Detect with --all-pairs to score
    every other pair.
    """
    from terrainloop.config import Settings
    from terrainloop.evaluation.judge import judge
    from terrainloop.evaluation.precision_recall import precision_recall
    from terrainloop.io.results import read_loops, read_submaps
    from terrainloop.io.trajectories import read_trajectory
    from terrainloop.report.figures import figure_precision_recall, save_figure

    terminal = Terminal.open(as_json, quiet, verbose)
    pairs = judge(
        read_loops(run / "pairs.csv"),
        read_submaps(run / "submaps.csv"),
        read_trajectory(truth).poses,
        _read_sessions(sessions) if sessions else None,
    )
    match = Settings.from_yaml(run / "config.yaml").match
    if match.decision == "evidence":
        name, thresholds, values = "score", SCORE_THRESHOLDS, [pair.candidate.score for pair in pairs]
    else:  # Algorithm 1 returns the inliers of an acceptable transform only
        name, thresholds = "inliers", INLIER_THRESHOLDS
        fit = [pair.candidate.ssd_ratio <= match.max_ssd_ratio for pair in pairs]
        values = [pair.candidate.inliers * fits for pair, fits in zip(pairs, fit, strict=True)]
    points = precision_recall(values, [pair.overlap > min_overlap for pair in pairs], thresholds)
    by_pose = precision_recall(values, [pair.pose_is_right for pair in pairs], thresholds)
    rows = [_row(name, point, posed.precision) for point, posed in zip(points, by_pose, strict=True)]
    figure = figure_precision_recall(points, f"true match: IoU > {min_overlap:g}", f"least {name}")
    save_figure(figure, run / "precision_recall.png")
    _write_rows(run / "precision_recall.csv", rows)
    summary = summarise(pairs, min_overlap) | {"precision_recall": rows}
    terminal.result(summary, lambda console: show(console, summary))


def summarise(pairs: Sequence["JudgedPair"], min_overlap: float) -> dict[str, Any]:
    """What the command reports beside the curve."""
    from terrainloop.evaluation.precision_recall import recall_at_full_precision

    accepted = [pair for pair in pairs if pair.candidate]
    right = [pair for pair in accepted if pair.overlap > min_overlap]
    disjoint = [pair.candidate.score for pair in pairs if pair.overlap == 0]
    bands = {
        f"{low:g}-{high:g}": [pair.candidate.score for pair in pairs if low < pair.overlap <= high]
        for low, high in ((0.1, 0.3), (0.3, 1.0))
    }
    return {
        "pairs": len(pairs),
        "true_pairs": sum(pair.overlap > min_overlap for pair in pairs),
        "disjoint_pairs": len(disjoint),
        "min_overlap": min_overlap,
        "accepted": len(accepted),
        "accepted_true": len(right),
        "accepted_less_overlap": sum(0 < pair.overlap <= min_overlap for pair in accepted),
        "accepted_disjoint": sum(pair.overlap == 0 for pair in accepted),
        "accepted_wrong_pose": sum(not pair.pose_is_right for pair in accepted),
        "median_position_error_m": _median([pair.position_error for pair in right]),
        "median_height_error_m": _median([pair.height_error for pair in right]),
        "median_yaw_error_deg": float(np.degrees(_median([pair.yaw_error for pair in right]))),
        "recall_before_first_disjoint": {
            band: recall_at_full_precision(scores, disjoint) for band, scores in bands.items()
        },
        "pairs_by_overlap": {band: len(scores) for band, scores in bands.items()},
    }


def show(console: Console, summary: dict[str, Any]) -> None:
    """The summary and the curve, as text."""
    rows = [
        [
            f"{next(iter(row.values())):g}",
            f"{row['precision']:.3f}",
            f"{row['recall']:.3f}",
            str(row["true_positives"]),
            str(row["false_positives"]),
            str(row["false_negatives"]),
            f"{row['pose_precision']:.3f}",
        ]
        for row in summary["precision_recall"]
    ]
    title = f"True match: bounding-box IoU > {summary['min_overlap']:g}"
    threshold = next(iter(summary["precision_recall"][0])).removeprefix("min_")
    heads = [f"{threshold} >=", "precision", "recall", "TP", "FP", "FN", "right pose"]
    console.print(table_of(title, heads, rows))
    console.print(
        f"\n{summary['pairs']} pairs scored, {summary['true_pairs']} of them true. "
        f"Accepted: {summary['accepted_true']} true, {summary['accepted_less_overlap']} that share less, "
        f"{summary['accepted_disjoint']} that share nothing; "
        f"{summary['accepted_wrong_pose']} with a wrong pose."
    )
    if summary["accepted_true"]:
        console.print(
            f"Median error of the true ones: {summary['median_position_error_m']:.3f} m, "
            f"{summary['median_yaw_error_deg']:.2f} deg, {summary['median_height_error_m']:.3f} m in z."
        )
    for band, recall in summary["recall_before_first_disjoint"].items():
        count = summary["pairs_by_overlap"][band]
        if count:
            console.print(
                f"IoU {band}: {recall:.0%} of {count} pairs score above every pair that shares nothing."
            )


def _row(name: str, point: "OperatingPoint", pose_precision: float) -> dict[str, float]:
    return {
        f"min_{name}": int(point.threshold),
        "precision": point.precision,
        "recall": point.recall,
        "true_positives": point.true_positives,
        "false_positives": point.false_positives,
        "false_negatives": point.false_negatives,
        "pose_precision": pose_precision,
    }


def _write_rows(path: Path, rows: Sequence[dict[str, float]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _read_sessions(path: Path) -> dict[str, str]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row]
        return dict(rows[1:])
    except (OSError, ValueError, IndexError) as error:
        raise TerrainLoopError(
            expected=f"a header and two columns, cloud and session, in {path}",
            found=str(error),
            mend="mend the file",
        ) from error


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")
