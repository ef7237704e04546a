"""The paper's figures, each with its numbers as CSV beside it."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reproduce.missions import Drive
from reproduce.results import Result
from reproduce.visual import ALIKE, Frames
from terrainloop.evaluation.pairs import EvaluatedPair
from terrainloop.evaluation.precision_recall import OperatingPoint, precision_recall
from terrainloop.geometry import transform
from terrainloop.io.files import write_whole_text
from terrainloop.report.figures import SOURCE_COLOUR, TARGET_COLOUR, save_figure

INLIER_THRESHOLDS = tuple(range(1, 21))  # the paper's
DRAWN_POINTS = 15_000  # of a submap; more are not visible at this size
COLUMNS = 3  # of panels
GREY = "0.55"


Look = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Plate:
    """A figure and the numbers in it."""

    figure: Figure
    rows: list[dict[str, Any]]

    def save(self, folder: Path, stem: str) -> None:
        save_figure(self.figure, folder / f"{stem}.png")
        write_rows(folder / f"{stem}.csv", self.rows)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    def write(file):
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)

    write_whole_text(path, write)


def trajectories(drives: Sequence[Drive]) -> Plate:
    """True positions of the submaps, coloured by time; circle at the start, square at the end (Fig. 6)."""
    figure, panels = _panels(len(drives), height=3.6)
    rows = []
    for axes, drive in zip(panels, drives, strict=True):
        x, y = drive.poses[:, :2, 3].T
        axes.plot(x, y, color="0.85", linewidth=1, zorder=0)
        dots = axes.scatter(x, y, c=np.linspace(0, 1, len(x)), cmap="viridis", s=16)
        mark = {"s": 90, "facecolors": "none", "edgecolors": SOURCE_COLOUR, "linewidths": 1.8}
        axes.scatter(x[0], y[0], marker="o", **mark)
        axes.scatter(x[-1], y[-1], marker="s", **mark)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="x, m", ylabel="y, m")
        _title(axes, drive.name)
        rows += [{"mission": drive.name, "submap": i, "x_m": x[i], "y_m": y[i]} for i in range(len(x))]
    figure.colorbar(dots, ax=panels, label="share of the drive", shrink=0.7)
    return Plate(figure, rows)


def visual_curves(frames: Sequence[Frames], control: Sequence[Frames]) -> Plate:
    """Precision and recall of visual loop closure over the images (Fig. 7), and of its control."""
    figure = Figure(figsize=(13, 5.0), layout="constrained")
    rows = []
    panels = {
        f"same place, headings within {np.degrees(ALIKE):.0f} deg": [(one, one.alike) for one in frames],
        "same place, any heading": [(one, one.near) for one in frames],
        "control: the images just before are not left out": [(one, one.alike) for one in control],
    }
    for axes, (title, pairs) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        for one, truth in pairs:
            scores, is_true, is_right = one.judged(truth)
            points = precision_recall(scores, is_true, is_right=is_right)
            label = f"{one.name} ({is_true.sum()} of {len(is_true)} images)"
            axes.plot(*_steps(points), drawstyle="steps-pre", label=label)
            rows += [{"mission": one.name, "true": title, **_counts(point)} for point in points]
        _unit_axes(axes, "recall")
        axes.set_xlim(-0.03, 1.03)
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.15), "ncols": 2}
        axes.legend(fontsize=7, title="images to be found", title_fontsize=7, **below)
        _title(axes, title)
    return Plate(figure, rows)


def precision_recall_curves(
    chosen: Mapping[str, Sequence[Result]], criterion: str, looks: Mapping[str, Look], title: str
) -> Plate:
    """Precision against recall over every distinct score, a panel for each mission (Fig. 8)."""
    figure, panels = _panels(len(chosen) + 1, height=3.1)  # the last one is for the legend
    figure.suptitle(title, fontsize=10)
    rows, lines = [], {}
    for axes, (name, results) in zip(panels, chosen.items(), strict=False):
        for result in results:
            points = result.criteria["boxes"][criterion].curve()
            recall, precision = _steps(points)
            (lines[result.method],) = axes.plot(
                recall, precision, drawstyle="steps-pre", **looks[result.method]
            )
            rows += [_row_of_curve(result, criterion, point) for point in points]
        _unit_axes(axes, "recall")
        axes.set_xlim(-0.03, 1.03)
        _title(axes, f"{name}: {results[0].metrics(criterion).true_pairs} true pairs" if results else name)
    panels[-1].axis("off")
    panels[-1].legend(lines.values(), lines.keys(), loc="center", frameon=False)
    return Plate(figure, rows)


def _steps(points: Sequence[OperatingPoint]) -> tuple[list[float], list[float]]:
    """Recall and precision, from recall 0 on: the area beneath the steps is the average precision."""
    recall, precision = [p.recall for p in points], [p.precision for p in points]
    return [0.0, *recall], [*precision[:1], *precision]


def _row_of_curve(result: Result, criterion: str, point: OperatingPoint) -> dict[str, Any]:
    return {
        "mission": result.drive.name,
        "method": result.method,
        "settings": result.settings,
        "right_by": criterion,
        **_counts(point),
    }


def _counts(point: OperatingPoint) -> dict[str, float]:
    return {"threshold": point.threshold, "precision": point.precision, "recall": point.recall} | {
        key: getattr(point, key) for key in ("true_positives", "false_positives", "false_negatives")
    }


def precision_by_inliers(results: Sequence[Result]) -> Plate:
    """Precision against the minimum number of inliers, for each mission and all together (Fig. 9)."""
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.add_subplot()
    counted = {}
    for result in results:
        criterion = result.criteria["boxes"]["overlap"]
        counted[result.drive.name] = (criterion.scores, criterion.is_true)
    everything = tuple(np.concatenate(column) for column in zip(*counted.values(), strict=True))
    rows = []
    for name, (scores, is_true) in {**counted, "all": everything}.items():
        points = precision_recall(scores, is_true, INLIER_THRESHOLDS)
        whole = name == "all"
        axes.plot(
            INLIER_THRESHOLDS,
            [point.precision for point in points],
            "o-" if whole else "-",
            color=TARGET_COLOUR if whole else None,
            linewidth=2.4 if whole else 1.0,
            alpha=1.0 if whole else 0.7,
            markersize=5,
            label="all missions" if whole else name,
        )
        rows += [
            {
                "mission": name,
                "min_inliers": int(point.threshold),
                "precision": point.precision,
                "recall": point.recall,
                "matched": point.true_positives + point.false_positives,
            }
            for point in points
        ]
    _unit_axes(axes, "least number of inliers")
    axes.set_xlim(0.5, 20.5)
    axes.set_xticks(INLIER_THRESHOLDS)
    axes.legend(fontsize=8, loc="lower right")
    _title(axes, "paper preset")
    return Plate(figure, rows)


def aligned_clouds(result: Result) -> Plate:
    """The highest-scoring pair that a method registered correctly, by odometry and by that pose (Fig. 10).

    From above: source red, target blue, the others grey; '+' at the origins of the frames.
    """
    drive = result.drive
    pair = max(result.registered, key=lambda pair: pair.candidate.score)
    source, target = (drive.mission.names.index(n) for n in (pair.candidate.source, pair.candidate.target))
    odometry = drive.mission.odometry
    poses = drive.poses if odometry is None else odometry.poses
    closed = poses.copy()
    closed[source] = poses[target] @ pair.candidate.T_target_source
    figure = Figure(figsize=(13, 5.4), layout="constrained")
    titles = ("where the truth has them" if odometry is None else "by odometry", "by the loop closure")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, T_world_submap, title in zip(panels, (poses, closed), titles, strict=True):
        _draw_clouds(axes, drive, T_world_submap, source, target)
        _title(
            axes, f"{drive.name}, {pair.candidate.source} (red) to {pair.candidate.target} (blue): {title}"
        )
    return Plate(figure, [_row_of_loop(drive, result.method, pair)])


def _draw_clouds(axes: Axes, drive: Drive, poses: np.ndarray, source: int, target: int) -> None:
    others = [i for i in range(len(poses)) if i not in (source, target)]
    for i in [*others, target, source]:
        colour = {source: SOURCE_COLOUR, target: TARGET_COLOUR}.get(i, GREY)
        points = drive.submaps[i].points
        x, y, _ = transform(poses[i], points[:: max(1, len(points) // DRAWN_POINTS)]).T
        axes.plot(x, y, ".", color=colour, markersize=0.6, alpha=0.35 if colour != GREY else 0.12)
    for name, pose in zip(drive.mission.names, poses, strict=True):
        axes.plot(*pose[:2, 3], "+", color="black", markersize=9)
        label = name.lstrip("0") or "0"
        axes.annotate(label, pose[:2, 3], fontsize=8, xytext=(4, 4), textcoords="offset points")
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")


def _row_of_loop(drive: Drive, method: str, pair: EvaluatedPair) -> dict[str, Any]:
    return {
        "mission": drive.name,
        "method": method,
        "source": pair.candidate.source,
        "target": pair.candidate.target,
        "score": pair.candidate.score,
        "overlap": pair.overlap,
        "position_error_m": pair.position_error,
        "yaw_error_deg": float(np.degrees(pair.yaw_error)),
        "height_error_m": pair.height_error,
    }


def looks_of(methods: Sequence[str]) -> dict[str, Look]:
    """Line styles of each method, the same in every figure: the first is thick, behind the others."""
    colours = [*colormaps["tab10"].colors, *colormaps["Dark2"].colors]
    looks: dict[str, Look] = {}
    for method, colour in zip(methods, colours, strict=False):
        looks[method] = {"color": colour, "linewidth": 1.5 if looks else 3.5}
    return looks


def _panels(count: int, height: float) -> tuple[Figure, list[Axes]]:
    columns = min(count, COLUMNS)
    rows = -(-count // columns)
    figure = Figure(figsize=(3.7 * columns, height * rows), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, k + 1) for k in range(count)]


def _unit_axes(axes: Axes, xlabel: str) -> None:
    axes.set(xlabel=xlabel, ylabel="precision", ylim=(-0.03, 1.03))
    axes.grid(alpha=0.3)


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, fontsize=9)
