"""Results as CSV: loop candidates (`loops.csv`, `pairs.csv`) and the submaps they join (`submaps.csv`)."""

import csv
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import parameters_of, se3
from terrainloop.io.files import write_whole_text
from terrainloop.loop import LoopCandidate
from terrainloop.record import SubmapRecord


def write_submaps(path: str | Path, records: Iterable[SubmapRecord]) -> None:
    """Write `submaps.csv`: one line per submap, whole or not at all; the hull as WKT."""
    rows = ([r.name, r.stamp, r.points, r.status, r.hull, r.notes, r.session] for r in records)
    _write_table(Path(path), _SUBMAP_COLUMNS, rows)


def read_submaps(path: str | Path) -> list[SubmapRecord]:
    """Read what `write_submaps` wrote; raises `TerrainLoopError` naming file, line and column."""
    rows = _read_table(Path(path), _SUBMAP_COLUMNS, _SUBMAP_ADDED)
    return [SubmapRecord(hull=row.pop("hull_m"), **row) for row in rows]


class LoopFile:
    """`loops.csv` or `pairs.csv`, written one line per candidate with all digits.

    The transform is T_target_source as x, y, z (metres), roll, pitch, yaw (radians; Rz Ry Rx). The covariance
    of the parameters of the transform between the two local origins is stored as its upper triangle, row by
    row; the origins are zero unless a frame's origin is far from its submap. New columns are only ever added
    at the end.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(_LOOP_COLUMNS)

    def write(self, candidate: LoopCandidate) -> None:
        """Add a candidate."""
        self._writer.writerow(_written(_LOOP_COLUMNS, _loop_row(candidate)))

    def close(self) -> None:
        """Finish the file; nothing is done if it is finished already."""
        self._file.close()


def write_loops(path: str | Path, candidates: Iterable[LoopCandidate]) -> None:
    """Write `loops.csv` or `pairs.csv` (see `LoopFile`), whole or not at all."""
    _write_table(Path(path), _LOOP_COLUMNS, map(_loop_row, candidates))


def read_loops(path: str | Path) -> list[LoopCandidate]:
    """Read what `write_loops` wrote; raises `TerrainLoopError` naming file, line and column."""
    return list(iterate_loops(path))


def iterate_loops(path: str | Path) -> Iterator[LoopCandidate]:
    """As `read_loops`, one at a time: pairs.csv may be larger than the memory."""
    return map(_candidate, _read_table(Path(path), _LOOP_COLUMNS, _LOOP_ADDED))


def loop_to_dict(candidate: LoopCandidate) -> dict[str, Any]:
    """A candidate for JSON, with the parameters of its transform beside the matrix."""
    parameters = parameters_of(candidate.T_target_source).tolist()
    values = {f.name: getattr(candidate, f.name) for f in fields(candidate) if f.name != "warp"}
    plain = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}
    return plain | {
        "transform": dict(
            zip(("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad"), parameters, strict=True)
        )
    }


def _loop_row(c: LoopCandidate) -> list[Any]:
    return [
        *(c.source, c.target, *parameters_of(c.T_target_source)),
        *(c.inliers, c.ssd, c.overlap, c.score, c.accepted, c.reason),
        *c.covariance[_UPPER],
        *(c.ssd_ratio, c.found_by, c.correlation, c.log_nfa, c.inlier_score),
        *(*c.source_origin, *c.target_origin),
    ]


def _candidate(row: dict[str, Any]) -> LoopCandidate:
    T_target_source = se3(*[row.pop(name) for name in POSE_COLUMNS])
    covariance = np.empty((6, 6))
    covariance[_UPPER] = [row.pop(name) for name in _COVARIANCE_COLUMNS]
    covariance.T[_UPPER] = covariance[_UPPER]
    for end in ("source", "target"):
        origin = [row.pop(f"{end}_origin_{axis}_m", 0.0) for axis in "xyz"]
        row[f"{end}_origin"] = np.array(origin)
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
_LOOP_ADDED: dict[str, Kind] = dict.fromkeys(
    [
        "log_nfa",
        "inlier_score",
        *(f"{end}_origin_{axis}_m" for end in ("source", "target") for axis in "xyz"),
    ],
    _NUMBER,
)
_LOOP_COLUMNS |= _LOOP_ADDED
_SUBMAP_COLUMNS: dict[str, Kind] = {
    "name": _TEXT,
    "stamp": _NUMBER,
    "points": _COUNT,
    "status": _STATUS,
    "hull_m": _POLYGON,
    "notes": _TEXT,
}
_SUBMAP_ADDED: dict[str, Kind] = {"session": _TEXT}
_SUBMAP_COLUMNS |= _SUBMAP_ADDED


def _written(columns: dict[str, Kind], row: Sequence[Any]) -> list[str]:
    return [write(value) for (write, _), value in zip(columns.values(), row, strict=True)]


def _write_table(path: Path, columns: dict[str, Kind], rows: Iterable[Sequence[Any]]) -> None:
    def write(file: TextIO) -> None:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(_written(columns, row) for row in rows)

    write_whole_text(path, write)


def _read_table(path: Path, columns: dict[str, Kind], added: Collection[str]) -> Iterator[dict[str, Any]]:
    """Rows by column name; the `added` columns may be missing, and those after all of these are ignored."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.reader(file, strict=True)
            header = next(reader, [])
            known = _known_columns(path, header, columns, added)
            for cells in reader:
                if cells:
                    yield _parse_row(path, reader.line_num, known, cells)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TerrainLoopError(
            expected="a CSV file", found=f"{path}: {error}", mend="give a file that terrainloop wrote"
        ) from error


def _known_columns(
    path: Path, header: list[str], columns: dict[str, Kind], added: Collection[str]
) -> dict[str, Kind]:
    known = dict(list(columns.items())[: len(header)])
    if header[: len(known)] != list(known) or len(known) < len(columns) - len(added):
        raise TerrainLoopError(
            expected=f"the columns {','.join(columns)}",
            found=f"{','.join(header) or 'none'} in {path}, line 1",
            mend="give a file that terrainloop wrote",
        )
    return known


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
