"""Text: one point per line, after a header or without."""

import re
from collections.abc import Sequence
from pathlib import Path

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds.names import columns_of
from terrainloop.io.clouds.table import (
    LONGEST_HEADER,
    WIDEST,
    Table,
    cells_of,
    check_count,
    is_comment,
    is_missing,
    is_number,
    lines_of,
    numbers,
    without_comments,
)

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"


def read_text(path: Path) -> Table:
    """Read the columns that the header names, else the first three."""
    try:
        return _read(path.read_bytes().removeprefix(_BYTE_ORDER_MARK))
    except ValueError as error:
        raise TerrainLoopError(
            expected="lines of three or more numbers, x y z, as many in each, after at most one header line",
            found=str(error),
            mend="export plain numbers with decimal points, one point per line, and name the columns x, y, z "
            "or leave the header out",
        ) from error


def _read(text: bytes) -> Table:
    if b"\0" in text:
        raise ValueError("bytes that are not text in UTF-8")
    lines = lines_of(text)
    start = _first_row(lines)
    header, body = lines[:start], without_comments(lines[start:])
    if not body:
        raise ValueError("no line of three numbers")
    if header and re.fullmatch(r"[0-9]{1,18}", header[0].strip()):  # PTS
        check_count(int(header.pop(0)), len(body))
    delimiter = _delimiter(body[0])
    if delimiter != "\t":
        body = [line.strip() for line in body]
    width = len(cells_of(body[0], delimiter))
    if width < 3:
        raise ValueError(f"{width} values in the line {body[0]!r}")
    spare = delimiter is not None and all(line.endswith(delimiter) for line in body)
    columns = columns_of(header, width, spare)
    if columns is None:
        _check_unnamed(body, delimiter, width)
        columns = {"x": 0, "y": 1, "z": 2}
    table = numbers(body, list(columns.values()), width, delimiter)
    return Table(dict(zip(columns, table.T, strict=True)))


def _first_row(lines: Sequence[str]) -> int:
    """Index of the first line of numbers, looked for within bounds: there may be none."""
    left = LONGEST_HEADER
    for index, line in enumerate(lines):
        if len(line) > LONGEST_HEADER:
            raise ValueError(f"a line of {len(line)} characters")
        if _is_row(line):
            return index
        left -= len(line)
        if left < 0:
            raise ValueError(f"more than {LONGEST_HEADER} characters above the first line of numbers")
    return len(lines)


def _delimiter(line: str) -> str | None:
    return next((mark for mark in ";\t," if mark in line.strip()), None)


def _is_row(line: str) -> bool:
    """Whether a line is not a comment and holds three or more numbers or markers of missing ones."""
    if is_comment(line):
        return False
    cells = [cell.strip(' "') for cell in cells_of(line, _delimiter(line))]
    filled = sum(is_number(cell) or (cell != "" and is_missing(cell)) for cell in cells)
    return filled >= 3 or (filled > 0 and filled + cells.count("") >= 3)


def _check_unnamed(body: Sequence[str], delimiter: str | None, width: int) -> None:
    """Refuse columns without names of which the first three are surely not x, y and z."""
    if width > WIDEST:
        raise ValueError(f"{width} numbers per line and no header: a raster of heights")
    if delimiter == "," and width >= 6 and width % 2 == 0 and not any("." in line for line in body):
        raise ValueError(f"{width} integers between commas, which may be decimal commas, in {body[0]!r}")
