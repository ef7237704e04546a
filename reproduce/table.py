"""The tables: method by mission, every choice of settings, times; as CSV, and as Markdown for reading."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reproduce.figures import write_rows
from reproduce.results import CRITERIA, GROUNDS, Result, best_of_each
from terrainloop.evaluation.precision_recall import Metrics
from terrainloop.io.files import write_whole_text

Rows = list[dict[str, Any]]


def main_table(by_mission: Mapping[str, Sequence[Result]]) -> Rows:
    """A row for each mission and method: best by the criterion of the paper, and best by pose."""
    rows: Rows = []
    for mission, results in by_mission.items():
        by_pose = {result.method: result for result in best_of_each(results, "pose")}
        best = best_of_each(results, "overlap")
        rows += [_row(mission, result, by_pose[result.method]) for result in best]
    return rows


def _row(mission: str, result: Result, by_pose: Result) -> dict[str, Any]:
    right, record = by_pose.registered, result.record
    return {
        "mission": mission,
        "method": result.method,
        **_numbers(result.metrics("overlap")),
        **{f"pose_{key}": value for key, value in _numbers(by_pose.metrics("pose")).items()},
        "registered": len(right),
        "position_error_m": _median(pair.position_error for pair in right),
        "yaw_error_deg": float(np.degrees(_median(pair.yaw_error for pair in right))),
        "ms_per_map": record["describe_ms"],
        "ms_per_pair": record["pair_ms"],
        "megabytes_per_map": record["megabytes"],
        "settings": result.settings,
        "pose_settings": by_pose.settings,
        "software": record["software"],
    }


def _numbers(metrics: Metrics) -> dict[str, float]:
    return {
        "true_pairs": metrics.true_pairs,
        "recall_at_full_precision": metrics.recall_at_full_precision.value,
        "recall_low": metrics.recall_at_full_precision.low,
        "recall_high": metrics.recall_at_full_precision.high,
        "max_f1": metrics.max_f1.value,
        "average_precision": metrics.average_precision.value,
        "average_precision_low": metrics.average_precision.low,
        "average_precision_high": metrics.average_precision.high,
    }


def sweep(results: Iterable[Result]) -> Rows:
    """Every choice of settings by every criterion and overlap, without selection."""
    return [
        {
            "mission": result.drive.name,
            "method": result.method,
            "settings": result.settings,
            "ground": ground,
            "right_by": criterion,
            **_numbers(result.metrics(criterion, ground)),
        }
        for result in results
        for ground in GROUNDS
        for criterion in CRITERIA
    ]


def times(by_mission: Mapping[str, Sequence[Result]]) -> Rows:
    """Medians of each method over the missions, and a query against 14 maps: the paper's measure."""
    chosen = [result for results in by_mission.values() for result in best_of_each(results, "overlap")]
    rows: Rows = []
    for method in dict.fromkeys(result.method for result in chosen):
        records = [result.record for result in chosen if result.method == method]
        per_map, per_pair, size = (
            _median(record[key] for record in records if record[key] is not None)
            for key in ("describe_ms", "pair_ms", "megabytes")
        )
        rows.append(
            {
                "method": method,
                "missions": len(records),
                "ms_per_map": per_map,
                "ms_per_pair": per_pair,
                "query_against_14_maps_s": (per_map + 14 * per_pair) / 1e3,
                "megabytes_per_map": size,
            }
        )
    return rows


def save(folder: Path, stem: str, rows: Rows, text: str) -> None:
    write_rows(folder / f"{stem}.csv", rows)
    write_whole_text(folder / f"{stem}.md", lambda file: file.write(text))


def markdown_of_table(rows: Rows, notes: Sequence[str]) -> str:
    """The two numbers of every method and mission at a glance, then each mission in full."""
    missions = list(dict.fromkeys(row["mission"] for row in rows))
    cells = {(row["mission"], row["method"]): row for row in rows}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    parts = list(notes)
    for title, prefix in (("a match is right if the ground is shared", ""), ("... if its pose is", "pose_")):
        body = [
            [method, *(_glance(cells.get((mission, method)), prefix) for mission in missions)]
            for method in methods
        ]
        parts += [
            f"Recall at 100 % precision, average precision; {title}:",
            _markdown(["method", *missions], body),
        ]
    for mission in missions:
        body = [_detail(row) for row in rows if row["mission"] == mission]
        parts += [f"{mission}:", _markdown(_DETAIL_HEADS, body)]
    return "\n\n".join(parts) + "\n"


_DETAIL_HEADS = (
    "method",
    "recall at 100 %",
    "AP (95 %)",
    "by pose: recall at 100 %",
    "AP (95 %)",
    "pose error of the registered",
    "ms per map",
    "ms per pair",
    "MB per map",
    "settings",
)


def _glance(row: Mapping[str, Any] | None, prefix: str) -> str:
    if row is None:
        return "-"
    return f"{row[f'{prefix}recall_at_full_precision']:.2f}, {row[f'{prefix}average_precision']:.2f}"


def _detail(row: Mapping[str, Any]) -> list[str]:
    def precision(prefix: str) -> str:
        value, low, high = (row[f"{prefix}average_precision{end}"] for end in ("", "_low", "_high"))
        return f"{value:.2f} ({low:.2f}-{high:.2f})"

    error = f"{row['position_error_m']:.2f} m, {row['yaw_error_deg']:.1f} deg ({row['registered']})"
    return [
        row["method"],
        f"{row['recall_at_full_precision']:.2f}",
        precision(""),
        f"{row['pose_recall_at_full_precision']:.2f}",
        precision("pose_"),
        error if row["registered"] else "-",
        *(_short(row[key]) for key in ("ms_per_map", "ms_per_pair", "megabytes_per_map")),
        row["settings"],
    ]


def markdown_of_times(rows: Rows, notes: Sequence[str]) -> str:
    heads = ["method", "ms per map", "ms per pair", "one query against 14 maps, s", "MB per map"]
    keys = ("ms_per_map", "ms_per_pair", "query_against_14_maps_s", "megabytes_per_map")
    body = [[row["method"], *(_short(row[key]) for key in keys)] for row in rows]
    return "\n\n".join([*notes, _markdown(heads, body)]) + "\n"


def _short(value: float | None) -> str:
    return "-" if value is None or np.isnan(value) else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _markdown(heads: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *body]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _median(values: Iterable[float]) -> float:
    values = list(values)
    return float(np.median(values)) if values else float("nan")
