"""``terrainloop evaluate``: a run, or a trajectory, against ground truth."""

import math
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console

from terrainloop.cli.terminal import Json, Quiet, Terminal, Verbose, count_of, table_of
from terrainloop.errors import TerrainLoopError

if TYPE_CHECKING:
    from terrainloop.evaluation.summary import Evaluation
    from terrainloop.evaluation.trajectory_error import Span, TrajectoryError

OVERLAPS = {"box": "bounding-box IoU", "observed": "IoU of the observed ground"}
CRITERIA = ("pose", "overlap and pose", "overlap")


ALIGNED = {
    "yaw": "Aligned to the truth by a rotation about z and a translation.",
    "se3": "Aligned to the truth by a rotation and a translation.",
    "first": "Aligned to the truth by the first pose.",
    "none": "Not aligned to the truth.",
}
LOOPS, TRAJECTORIES = "Loops of a run", "Trajectories"


HELP = """Evaluate a run against ground-truth poses: loops, revisits, precision and recall.

The absolute trajectory error (ATE) and the relative pose error (RPE) are reported for poses.tum and
trajectory.tum of the run, and for odometry.tum there or beside the truth; for a trajectory in place
of a run, nothing else is.

Writes precision_recall.csv, precision_recall_curve.csv and precision_recall.png into the folder of
the run. Pairs of consecutive submaps are left out because odometry already connects them. Run
detect with --all-pairs to score every other pair."""


def command(
    run: Annotated[
        Path, typer.Argument(help="Output folder of 'terrainloop detect', or a trajectory, TUM or KITTI.")
    ],
    truth: Annotated[
        Path,
        typer.Option(
            "--truth",
            help="True poses, TUM or KITTI: one line per cloud for a run, with the stamps of one clock for a "
            "trajectory.",
        ),
    ],
    min_overlap: Annotated[
        float,
        typer.Option(
            "--min-overlap",
            min=0.0,
            max=1.0,
            rich_help_panel=LOOPS,
            help="A pair is true if its bounding-box IoU exceeds this (the paper: 0.3, Morocco 0.1).",
        ),
    ] = 0.3,
    position_tolerance: Annotated[
        float | None,
        typer.Option(
            "--position-tolerance",
            rich_help_panel=LOOPS,
            help="Horizontal error, in metres, below which a pose is right. "
            "Default: 1 m, bounded by 2 % and 10 % of the size of the submaps.",
        ),
    ] = None,
    yaw_tolerance: Annotated[
        float,
        typer.Option(
            "--yaw-tolerance",
            rich_help_panel=LOOPS,
            help="Error of yaw, in degrees, below which a pose is right.",
        ),
    ] = 5.0,
    sessions: Annotated[
        Path | None,
        typer.Option(
            "--sessions",
            rich_help_panel=LOOPS,
            help="CSV 'cloud,session': leave out pairs of one session.",
        ),
    ] = None,
    clouds: Annotated[
        Path | None,
        typer.Option(
            "--clouds",
            rich_help_panel=LOOPS,
            help="Mission folder: use the overlap of the observed ground, too.",
        ),
    ] = None,
    align: Annotated[
        Literal["yaw", "se3", "first", "none"],
        typer.Option(
            "--align",
            rich_help_panel=TRAJECTORIES,
            help="Alignment to the truth: rotation about z and translation, any rotation and translation, by "
            "the first pose, or none.",
        ),
    ] = "yaw",
    rpe_distance: Annotated[
        float | None,
        typer.Option(
            "--rpe-distance",
            rich_help_panel=TRAJECTORIES,
            help="Distance of relative errors, metres along the trajectory. Default: 10 m, and one pose for "
            "the submaps of a run.",
        ),
    ] = None,
    rpe_poses: Annotated[
        int | None,
        typer.Option(
            "--rpe-poses",
            rich_help_panel=TRAJECTORIES,
            help="The same as a number of poses.",
        ),
    ] = None,
    stamp_tolerance: Annotated[
        float,
        typer.Option(
            "--stamp-tolerance",
            min=0.0,
            rich_help_panel=TRAJECTORIES,
            help="Largest difference of the stamps of two poses that are compared, seconds.",
        ),
    ] = 0.01,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop evaluate``."""
    from terrainloop.evaluation.run_trajectories import run_trajectory_errors
    from terrainloop.evaluation.summary import evaluate_run
    from terrainloop.evaluation.trajectory_error import trajectory_error
    from terrainloop.io.trajectories import read_trajectory
    from terrainloop.report import can_draw

    terminal = Terminal.open(as_json, quiet, verbose)
    span = _span(rpe_distance, rpe_poses)
    if _is_trajectory(run):
        estimate, true = read_trajectory(run), read_trajectory(truth)
        error = trajectory_error(estimate, true, align=align, span=span, stamp_tolerance=stamp_tolerance)
        terminal.result(error.as_dict(), lambda console: show_trajectory(console, error))
        return
    evaluation = evaluate_run(
        run,
        truth,
        min_overlap=min_overlap,
        position_tolerance=position_tolerance,
        yaw_tolerance=math.radians(yaw_tolerance),
        sessions=sessions,
        clouds=clouds,
    )
    evaluation.write(run)
    if can_draw():
        from terrainloop.report.figures import figure_precision_recall, save_figure

        save_figure(figure_precision_recall(evaluation), run / "precision_recall.png")
    errors = run_trajectory_errors(
        run, truth, evaluation, align=align, span=span, stamp_tolerance=stamp_tolerance
    )

    result = evaluation.as_dict() | {"trajectories": {name: e.as_dict() for name, e in errors.items()}}
    terminal.result(result, lambda console: show(console, evaluation, errors))


def _is_trajectory(path: Path) -> bool:
    return path.is_file() or (path.suffix == ".tum" and not path.exists())


def _span(distance: float | None, poses: int | None) -> "Span | None":
    """What the two options say of relative errors; None by default."""
    from terrainloop.evaluation.trajectory_error import Span

    if distance is not None and poses is not None:
        raise TerrainLoopError(
            expected="either --rpe-distance or --rpe-poses", found="both", mend="leave one of them out"
        )
    if distance is not None:
        return Span(distance, "m")
    return None if poses is None else Span(poses, "poses")


def show_trajectory(console: Console, error: "TrajectoryError") -> None:
    """Absolute and relative errors as a table, and how the trajectory was aligned."""
    ate, rpe = count_of(len(error.absolute), "pose"), count_of(len(error.relative), "pair")
    kinds = [("ATE", error.absolute, ate), (f"RPE over {error.span}", error.relative, rpe)]
    rows = [
        [f"{kind}, {unit}", count, *(_number(value, 3) for value in astuple(numbers))]
        for kind, magnitudes, count in kinds
        for unit, numbers in zip(("m", "deg"), magnitudes.statistics, strict=True)
    ]
    console.print(table_of("Trajectory errors", ["", "of", "rms", "mean", "median", "max"], rows))
    console.print(f"\n{ALIGNED[error.alignment]} Length of the true path: {error.length:.1f} m.")


def show(console: Console, evaluation: "Evaluation", trajectories: "Mapping[str, TrajectoryError]") -> None:
    """The result in sentences, then the tables and their meaning, then the errors of trajectories."""
    for sentence in _sentences(evaluation):
        console.print(sentence)
    if evaluation.pairs:
        console.print()
        _show_table(console, evaluation)
        _show_metrics(console, evaluation)
        _show_legend(console, evaluation)
    for name, error in trajectories.items():
        console.print(f"{name}: {error}.")


def _sentences(evaluation: "Evaluation") -> list[str]:
    """The answer first: right and wrong loops, what was found, errors of the poses."""
    result, tolerance = evaluation.as_dict(), evaluation.tolerance
    left_out = (
        f"{count_of(result['pairs'], 'pair')} evaluated; {result['pairs_left_out']} left out: consecutive "
        "submaps" + (" or one session." if evaluation.truth.sessions else ".")
    )
    if not evaluation.pairs:
        return [f"Nothing to evaluate: {left_out}"]
    sentences = [
        f"{count_of(result['accepted'], 'loop')} accepted: {result['accepted_right_pose']} right, "
        f"{result['accepted_wrong_pose']} wrong by pose (within {tolerance.position:g} m and "
        f"{math.degrees(tolerance.yaw):g} deg).",
        *_retrieval_sentences(evaluation),
    ]
    if result["accepted"]:
        sentences.append(
            f"Within 2 m and 5 deg: {100 * result['share_within_2m_5deg']:.1f} % of the accepted loops; "
            f"yaw within 10 deg: {100 * result['share_yaw_within_10deg']:.1f} %."
        )
    if result["accepted_right_pose"]:
        sentences.append(
            f"Median error of the right loops: {result['right_pose_median_position_error_m']:.3f} m, "
            f"{result['right_pose_median_height_error_m']:.3f} m in height, "
            f"{result['right_pose_median_yaw_error_deg']:.2f} deg of yaw."
        )
    return [*sentences, left_out]


def _retrieval_sentences(evaluation: "Evaluation") -> list[str]:
    """What was found and closed, by bounding boxes and, where clouds were given, by the observed ground."""
    box, *observed = evaluation.as_dict()["retrieval"]
    at_one = _ratio(box["precision_at_one"], box["answered_right"], box["answered"])
    return [
        f"Found {box['true_pairs_found']} of {count_of(box['true_pairs'], 'pair')} that share over "
        f"{100 * evaluation.min_overlap:g} % of their ground ({OVERLAPS['box']}).",
        f"Closed {box['closed']} of {count_of(box['revisits'], 'revisit')} by at least one right loop.",
        f"Best match per query: R@1 {_recall_at_one(box)}, P@1 {at_one}.",
        *(
            f"By {OVERLAPS['observed']}: found {row['true_pairs_found']} of {row['true_pairs']}, "
            f"closed {row['closed']} of {row['revisits']}, R@1 {_recall_at_one(row)}."
            for row in observed
        ),
    ]


def _recall_at_one(row: dict[str, Any]) -> str:
    return _ratio(row["recall_at_one"], row["right_at_one"], row["queries"])


def _show_table(console: Console, evaluation: "Evaluation") -> None:
    """Precision and recall at fixed thresholds, by pose and, beside it, by overlap."""
    name = evaluation.score_name
    heads = [
        f"{name} >=",
        "right poses",
        "wrong poses",
        "precision by pose",
        "recall by pose",
        "precision by overlap",
        "recall by overlap",
    ]
    rows = [
        [
            f"{row[f'min_{name}']:g}",
            str(row["right_poses"]),
            str(row["wrong_poses"]),
            *(_number(row[key], 3) for key in ("pose_precision", "pose_recall", "precision", "recall")),
        ]
        for row in evaluation.table
    ]
    title = f"Pairs above a threshold; recall of those with {OVERLAPS['box']} > {evaluation.min_overlap:g}"
    console.print(table_of(title, heads, rows))


def _show_metrics(console: Console, evaluation: "Evaluation") -> None:
    """Each curve in three numbers."""
    heads = ["right by", "recall at full precision", "max F1", "average precision"]
    for overlap in evaluation.overlaps:
        chosen = {name: evaluation.metrics[overlap, name] for name in CRITERIA}
        rows = [
            [name, str(m.recall_at_full_precision), str(m.max_f1), str(m.average_precision)]
            for name, m in chosen.items()
        ]
        true = count_of(chosen["pose"].true_pairs, "true pair")
        console.print()
        console.print(table_of(f"{true}: {OVERLAPS[overlap]} > {evaluation.min_overlap:g}", heads, rows))


def _show_legend(console: Console, evaluation: "Evaluation") -> None:
    result = evaluation.as_dict()
    below = result["accepted_less_overlap"] + result["accepted_disjoint"]
    console.print(
        "\nBy pose, a match is right if its pose is; a pair that shares less ground but has the right pose "
        "is neither found nor false. By overlap, the criterion of the paper, every match of a pair that "
        f"shares no more than {evaluation.min_overlap:g} is false, whatever its pose: here {below} of the "
        f"{count_of(result['accepted'], 'accepted loop')}. In parentheses: 95 % bootstrap intervals."
    )
    for band, recall in result["recall_before_first_disjoint"].items():
        count = result["pairs_by_overlap"][band]
        if count:
            console.print(
                f"IoU {band}: {100 * recall:.0f} % of {count_of(count, 'pair')} "
                "score above every pair that shares nothing."
            )


def _ratio(value: float, part: int, whole: int) -> str:
    return f"{_number(value, 2)} ({part} of {whole})"


def _number(value: float, digits: int) -> str:
    """A number, or a dash if it is undefined."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
