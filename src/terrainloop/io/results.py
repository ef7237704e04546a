"""Results as CSV: loop candidates (`loops.csv`, `pairs.csv`) and the submaps they join (`submaps.csv`)."""

import csv
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TextIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import parameters_of, se3
from terrainloop.loop import LoopCandidate
from terrainloop.submap import Submap


@dataclass(frozen=True, eq=False)
class SubmapRecord:
    """One line of `submaps.csv`.

    Attributes
    ----------
    name : str
    stamp : float
    points : int
        That were used, 0 where broken.
    status : {"ok", "broken"}
    hull : array, (M, 2)
        Corners, anticlockwise, of the convex hull of x and y in the submap's own frame, metres, rounded to
        millimetres; none where broken.
    notes : str
        Repairs and warnings, or what is wrong.
    """

    name: str
    stamp: float
    points: int
    status: Literal["ok", "broken"]
    hull: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    notes: str = ""


def submap_record(submap: Submap) -> SubmapRecord:
    """What `submaps.csv` keeps of a submap."""
    xy = submap.points[:, :2]
    corners = xy[ConvexHull(xy - xy[0]).vertices]
    hull = np.round(corners, 3) + 0.0  # no negative zeros
    notes = "; ".join([*submap.repairs, *submap.warnings])
    return SubmapRecord(submap.name, submap.stamp, len(submap), "ok", hull, notes)


def write_submaps(path: str | Path, records: Iterable[SubmapRecord]) -> None:
    """Write `submaps.csv`: one line a submap, whole or not at all; the hull as WKT."""
    rows = ([r.name, r.stamp, r.points, r.status, r.hull, r.notes] for r in records)
    _write_table(Path(path), _SUBMAP_COLUMNS, rows)


def read_submaps(path: str | Path) -> list[SubmapRecord]:
    """Read what `write_submaps` wrote; raises `TerrainLoopError` naming file, line and column."""
    rows = _read_table(Path(path), _SUBMAP_COLUMNS)
    return [SubmapRecord(hull=row.pop("hull_m"), **row) for row in rows]


def write_loops(path: str | Path, candidates: Iterable[LoopCandidate]) -> None:
    """Write `loops.csv` or `pairs.csv`: one line a candidate, every digit kept, whole or not at all.

    The transform is T_target_source as x, y, z (metres), roll, pitch, yaw (radians; Rz Ry Rx); its
    covariance is the upper triangle, row by row. Columns are only ever added, at the end.
    """
    rows = (
        [
            *(c.source, c.target, *parameters_of(c.T_target_source)),
            *(c.inliers, c.ssd, c.overlap, c.score, c.accepted, c.reason),
            *c.covariance[_UPPER],
            *(c.ssd_ratio, c.found_by, c.correlation),
        ]
        for c in candidates
    )
    _write_table(Path(path), _LOOP_COLUMNS, rows)


def read_loops(path: str | Path) -> list[LoopCandidate]:
    """Read what `write_loops` wrote; raises `TerrainLoopError` naming file, line and column."""
    return [_candidate(row) for row in _read_table(Path(path), _LOOP_COLUMNS)]


def _candidate(row: dict[str, Any]) -> LoopCandidate:
    T_target_source = se3(*[row.pop(name) for name in POSE_COLUMNS])
    covariance = np.empty((6, 6))
    covariance[_UPPER] = [row.pop(name) for name in _COVARIANCE_COLUMNS]
    covariance.T[_UPPER] = covariance[_UPPER]
    return LoopCandidate(T_target_source=T_target_source, covariance=covariance, **row)


Kind = tuple[Callable[[Any], str], Callable[[str], Any]]
"""How the values of a column are written and read."""


def _one_of(values: dict[str, Any]) -> Callable[[str], Any]:
    def read(text: str) -> Any:
        if text not in values:
            raise ValueError(f"{text!r} is none of {', '.join(values)}")
        return values[text]

    return read


def _polygon_text(hull: NDArray[np.float64]) -> str:
    ring = ", ".join(f"{x:.3f} {y:.3f}" for x, y in [*hull, *hull[:1]])
    return f"POLYGON (({ring}))" if ring else ""


def _polygon_of(text: str) -> NDArray[np.float64]:
    if not text:
        return np.empty((0, 2))
    ring = re.fullmatch(r"POLYGON \(\((.+)\)\)", text)
    if ring is None:
        raise ValueError(f"no polygon in {text[:40]!r}")
    return np.array([[float(x), float(y)] for x, y in map(str.split, ring[1].split(",")[:-1])])


_TEXT: Kind = (str, str)
_COUNT: Kind = (lambda value: str(int(value)), int)
_NUMBER: Kind = (lambda value: repr(float(value)), float)
_FLAG: Kind = (lambda value: "true" if value else "false", _one_of({"true": True, "false": False}))
_STATUS: Kind = (str, _one_of({"ok": "ok", "broken": "broken"}))
_POLYGON: Kind = (_polygon_text, _polygon_of)

_UPPER = np.triu_indices(6)
_PARAMETERS = ("x", "y", "z", "roll", "pitch", "yaw")
POSE_COLUMNS = ("tx_m", "ty_m", "tz_m", "roll_rad", "pitch_rad", "yaw_rad")
_COVARIANCE_COLUMNS = [f"cov_{_PARAMETERS[i]}_{_PARAMETERS[j]}" for i, j in zip(*_UPPER, strict=True)]
_LOOP_COLUMNS: dict[str, Kind] = {
    "source": _TEXT,
    "target": _TEXT,
    **dict.fromkeys(POSE_COLUMNS, _NUMBER),
    "inliers": _COUNT,
    **dict.fromkeys(("ssd", "overlap", "score"), _NUMBER),
    "accepted": _FLAG,
    "reason": _TEXT,
    **dict.fromkeys(_COVARIANCE_COLUMNS, _NUMBER),
    "ssd_ratio": _NUMBER,
    "found_by": _TEXT,
    "correlation": _NUMBER,
}
_SUBMAP_COLUMNS: dict[str, Kind] = {
    "name": _TEXT,
    "stamp": _NUMBER,
    "points": _COUNT,
    "status": _STATUS,
    "hull_m": _POLYGON,
    "notes": _TEXT,
}


def write_whole(path: Path, write: Callable[[TextIO], object]) -> None:
    """Write a file aside and move it into place, so that a killed run never leaves half a file."""
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with aside.open("w", encoding="utf-8", newline="") as file:
            write(file)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def _write_table(path: Path, columns: dict[str, Kind], rows: Iterable[Sequence[Any]]) -> None:
    def write(file: TextIO) -> None:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in rows:
            writer.writerow([written(v) for (written, _), v in zip(columns.values(), row, strict=True)])

    write_whole(path, write)


def _read_table(path: Path, columns: dict[str, Kind]) -> list[dict[str, Any]]:
    """Rows by column name; columns that were added behind these by others are passed over."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.reader(file, strict=True)
            lines = [(reader.line_num, cells) for cells in reader if cells]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TerrainLoopError(
            expected="a CSV file", found=f"{path}: {error}", mend="give a file that terrainloop wrote"
        ) from error
    header = lines[0][1] if lines else []
    if header[: len(columns)] != list(columns):
        raise TerrainLoopError(
            expected=f"the columns {','.join(columns)}",
            found=f"{','.join(header) or 'none'} in {path}, line 1",
            mend="give a file that terrainloop wrote",
        )
    return [_parse_row(path, number, columns, cells) for number, cells in lines[1:]]


def _parse_row(path: Path, number: int, columns: dict[str, Kind], cells: list[str]) -> dict[str, Any]:
    def parse(index: int, name: str, read: Callable[[str], Any]) -> Any:
        try:
            return read(cells[index])
        except (ValueError, IndexError) as error:
            raise TerrainLoopError(
                expected=f"a value in column {name}",
                found=f"{error} in {path}, line {number}",
                mend="correct that line or write the file again",
            ) from error

    return {name: parse(index, name, read) for index, (name, (_, read)) in enumerate(columns.items())}
