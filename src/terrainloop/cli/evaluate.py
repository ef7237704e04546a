"""``terrainloop evaluate``: precision and recall against the truth."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console

from terrainloop.cli.terminal import Json, Quiet, Terminal, Verbose, count_of, table_of
from terrainloop.errors import TerrainLoopError

if TYPE_CHECKING:
    from terrainloop.config import MatchSettings
    from terrainloop.evaluation.judge import JudgedPair, Reading
    from terrainloop.evaluation.precision_recall import Metrics, OperatingPoint
    from terrainloop.geometry import Array
    from terrainloop.loop import LoopCandidate
    from terrainloop.record import SubmapRecord

    Judged = JudgedPair[LoopCandidate]

INLIER_THRESHOLDS: Sequence[int] = tuple(range(1, 21))  # the paper's
SCORE_THRESHOLDS: Sequence[int] = (0, 1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 50)
_COUNTS = ("precision", "recall", "true_positives", "false_positives", "false_negatives")
TRUTHS = {"box": "Bounding-box IoU", "observed": "IoU of the observed ground"}


HELP = """Hold a run's pairs against true poses: precision and recall over the score or the inlier
threshold.

Consecutive submaps are left out: odometry joins them anyway. Detect with --all-pairs to score
every other pair."""


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
    clouds: Annotated[
        Path | None,
        typer.Option("--clouds", help="Mission folder: judge by the ground that the clouds show, too."),
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop evaluate``."""
    from terrainloop.config import Settings
    from terrainloop.evaluation.judge import judge, readings
    from terrainloop.evaluation.precision_recall import precision_recall
    from terrainloop.io.missions import read_sessions
    from terrainloop.io.results import read_loops, read_submaps
    from terrainloop.io.trajectories import read_trajectory

    terminal = Terminal.open(as_json, quiet, verbose)
    candidates, records = read_loops(run / "pairs.csv"), read_submaps(run / "submaps.csv")
    poses = read_trajectory(truth).poses
    pairs = judge(
        candidates,
        records,
        poses,
        read_sessions(sessions) if sessions else None,
        _observed(clouds, records, poses) if clouds else None,
    )
    name, thresholds, values = _scores(pairs, Settings.from_yaml(run / "config.yaml").match)
    points = precision_recall(values, [pair.overlap > min_overlap for pair in pairs], thresholds)
    by_pose = precision_recall(values, [pair.pose_is_right for pair in pairs], thresholds)
    rows = [_row(name, point, posed.precision) for point, posed in zip(points, by_pose, strict=True)]
    _write_rows(run / "precision_recall.csv", list(rows[0]), [list(row.values()) for row in rows])
    read = {
        (kind, right_by): reading
        for kind in (TRUTHS if clouds else ["box"])
        for right_by, reading in readings(pairs, min_overlap, kind == "observed", values).items()
    }
    _write_rows(
        run / "precision_recall_curve.csv", ["truth", "right_by", f"min_{name}", *_COUNTS], _curve_rows(read)
    )
    metrics = {key: reading.metrics() for key, reading in read.items()}
    _draw(run / "precision_recall.png", points, read, metrics, f"true match: IoU > {min_overlap:g}", name)
    summary = summarise(pairs, min_overlap) | {
        "threshold": name,
        "metrics": [
            {"truth": kind, "right_by": right_by, **asdict(numbers)}
            for (kind, right_by), numbers in metrics.items()
        ],
        "precision_recall": rows,
    }
    terminal.result(summary, lambda console: show(console, summary, metrics))


def summarise(pairs: Sequence["Judged"], min_overlap: float) -> dict[str, Any]:
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


def show(console: Console, summary: dict[str, Any], metrics: Mapping[tuple[str, str], "Metrics"]) -> None:
    """The summary, the curve and its numbers, as text."""
    name = summary["threshold"]
    rows = [
        [
            f"{row[f'min_{name}']:g}",
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
    heads = [f"{name} >=", "precision", "recall", "TP", "FP", "FN", "right pose"]
    console.print(table_of(title, heads, rows))
    _show_metrics(console, metrics, summary["min_overlap"])
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


def _show_metrics(console: Console, metrics: Mapping[tuple[str, str], "Metrics"], min_overlap: float) -> None:
    heads = ["right by", "recall at P = 1", "max F1", "average P"]
    for kind, what in TRUTHS.items():
        rows = [
            [
                right_by,
                str(numbers.recall_at_full_precision),
                str(numbers.max_f1),
                str(numbers.average_precision),
            ]
            for (of, right_by), numbers in metrics.items()
            if of == kind
        ]
        if rows:
            count = count_of(metrics[kind, "overlap"].true_pairs, "true pair")
            console.print()
            console.print(table_of(f"{what} > {min_overlap:g}: {count}", heads, rows))
    console.print(
        "\nIn brackets: 95 % of the bootstrap. By overlap (the paper), pairs that share less are false "
        "even if their pose is right; by pose, such pairs do not count."
    )


def _scores(pairs: Sequence["Judged"], match: "MatchSettings") -> tuple[str, Sequence[int], list[float]]:
    """What is thresholded, at what, and its value for each pair; -inf for those without a transform."""
    if match.decision == "evidence":
        comparable = [bool(np.isfinite(pair.candidate.T_target_source).all()) for pair in pairs]
        values = [pair.candidate.score for pair in pairs]
        name, thresholds = "score", SCORE_THRESHOLDS
    else:  # Algorithm 1 returns the inliers of an acceptable transform only
        comparable = [pair.candidate.ssd_ratio <= match.max_ssd_ratio for pair in pairs]
        values = [float(pair.candidate.inliers) for pair in pairs]
        name, thresholds = "inliers", INLIER_THRESHOLDS
    found = [value if able else -np.inf for value, able in zip(values, comparable, strict=True)]
    return name, thresholds, found


def _observed(folder: Path, records: Sequence["SubmapRecord"], poses: "Array") -> "Array":
    """IoU of the ground that the clouds of a mission observed; broken ones share nothing."""
    from terrainloop.evaluation.overlap import ground_cell, observed_iou
    from terrainloop.io.missions import load_mission

    mission = load_mission(folder)
    if mission.names != tuple(record.name for record in records):
        raise TerrainLoopError(
            expected=f"the {len(records)} clouds of the run in {folder}",
            found=count_of(len(mission), "cloud") if len(mission) != len(records) else "other names",
            mend="give the mission that was detected on",
        )
    whole = [record.status == "ok" for record in records]
    clouds = [mission.read(i).points if ok else np.empty((0, 3)) for i, ok in enumerate(whole)]
    return observed_iou(clouds, poses, ground_cell(clouds))


def _draw(
    path: Path,
    points: Sequence["OperatingPoint"],
    read: Mapping[tuple[str, str], "Reading"],
    metrics: Mapping[tuple[str, str], "Metrics"],
    title: str,
    name: str,
) -> None:
    """The curves by bounding boxes; the fixed thresholds marked on the paper's."""
    from terrainloop.report.figures import figure_precision_recall, save_figure

    curves = {
        f"right by {right_by}: AP {metrics[kind, right_by].average_precision}": reading.curve()
        for (kind, right_by), reading in read.items()
        if kind == "box"
    }
    save_figure(figure_precision_recall(points, title, f"least {name}", curves), path)


def _curve_rows(read: Mapping[tuple[str, str], "Reading"]) -> list[list[Any]]:
    return [
        [*key, point.threshold, *(getattr(point, count) for count in _COUNTS)]
        for key, reading in read.items()
        for point in reading.curve()
    ]


def _row(name: str, point: "OperatingPoint", pose_precision: float) -> dict[str, float]:
    counts = {count: getattr(point, count) for count in _COUNTS}
    return {f"min_{name}": int(point.threshold), **counts, "pose_precision": pose_precision}


def _write_rows(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, *rows])


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")
