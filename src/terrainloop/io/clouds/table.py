"""What the readers share: named columns, bounds on announced sizes, rows of numbers in text."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = Mapping[str, NDArray[Any]]
"""One array per point property, in the type it was stored in."""

INTENSITY = ("intensity", "reflectivity", "scalar_intensity")
WIDEST = 32
"""Largest number of unnamed columns of a cloud; a wider table is a raster of heights."""

LONGEST_HEADER = 1 << 16
"""Bytes of a header in text."""

PADDING = b"\0\t\n\r "
"""Bytes that may follow the last point."""

_ANY_POINTS = 1_000_000  # a file may hold so many points however small it is ...
_POINTS_PER_BYTE = 2  # ... and so many for each of its bytes; real clouds take a byte per point at least
_COMMENT = re.compile(r"(?:^%|(?:^|\s)(?:#(?![A-Z]+[!?/])|//)).*")  # but not the #N/A of spreadsheets
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_COUNT = re.compile(r"[0-9]{1,18}")
_MISSING = re.compile(
    r"[-+]?(?:1\.?#\w+|inf(?:inity)?|[qs]?nan\d*(?:\(\w*\))?)|#[\w/!?]+|[-*?.]*"
    r"|null|nil|none|n/?a|no[ _-]?data|missing",
    re.ASCII | re.IGNORECASE,
)


@dataclass(frozen=True, eq=False)
class Table:
    """The columns of a file by name, and a description of what was dropped while reading them."""

    columns: Columns
    repairs: tuple[str, ...] = ()


def check_points(count: int, size: int) -> None:
    """Refuse more points than a file of `size` bytes holds, unless it was made to exhaust memory."""
    if count > max(_ANY_POINTS, _POINTS_PER_BYTE * size):
        raise ValueError(f"{count} points in {size} bytes")


def check_count(announced: int, found: int) -> None:
    """Refuse a file whose header announces no points, or other than `found`."""
    if announced != found or not found:
        raise ValueError(f"the header announces {announced} points, {found} follow")


def count_of(word: str) -> int:
    """A count in a header; `int` would also accept signs, underscores and digits of other scripts."""
    if not _COUNT.fullmatch(word):
        raise ValueError(f"{word!r} instead of a count")
    return int(word)


def split_header(data: bytes, last: bytes) -> tuple[list[list[str]], int]:
    """Words of each line of a text header down to the line `last`, and where the body starts."""
    end = re.search(rb"[\r\n][ \t]*%b\b[^\r\n]*(\r*\n|\r)" % last, data[:LONGEST_HEADER], re.IGNORECASE)
    if end is None:
        raise ValueError(f"no header that ends with a line {last.decode()}")
    header = data[: end.start(1)]
    # Where lines end with CR alone, an LF after the last one belongs to the body.
    newline = end[1] if b"\n" in header else end[1][:1]
    lines = re.split(r"[\r\n]+", header.decode("ascii", "replace"))
    return [words for words in map(str.split, lines) if words], end.start(1) + len(newline)


def lines_of(text: bytes) -> list[str]:
    """Lines that are not blank; non-ASCII bytes are replaced, so they never form a number."""
    lines = text.decode("ascii", "replace").replace("\r", "\n").split("\n")
    return [line for line in map(_strip, lines) if line.strip()]


def is_comment(line: str) -> bool:
    """Whether a line is a comment from its start."""
    return _COMMENT.match(line) is not None


def without_comments(lines: Sequence[str]) -> list[str]:
    """Lines without what follows ``#`` or ``//`` at their start or after a blank."""
    stripped = (_strip(_COMMENT.sub("", line)) if re.search("[#%/]", line) else line for line in lines)
    return [line for line in stripped if line.strip()]


def _strip(line: str) -> str:
    return line.strip(" ")  # a tab may separate cells of which the first or last is empty


def cells_of(line: str, delimiter: str | None) -> list[str]:
    """Cells of a line, at the delimiter or else at blanks; quotes protect delimiters."""
    if delimiter is None or '"' not in line:
        return line.split(delimiter)
    return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))


def is_number(cell: str) -> bool:
    """Whether a cell holds a decimal number."""
    return _NUMBER.fullmatch(cell) is not None


def is_missing(cell: str) -> bool:
    """Whether a cell is empty or holds a common marker for a missing value."""
    return _MISSING.fullmatch(cell.strip(" \t\"'")) is not None


def numbers(
    lines: Sequence[str], columns: Sequence[int], width: int, delimiter: str | None = None
) -> NDArray[np.float64]:
    """Numbers (N, len(columns)) of lines that hold `width` cells each, NaN where a value is missing."""
    for line in lines:
        found = len(cells_of(line, delimiter))
        if found != width:
            raise ValueError(f"{found} values instead of {width} in the line {line!r}")
    try:
        table = _parse(lines, columns, delimiter)
    except ValueError:
        chosen = ([cells[column] for column in columns] for cells in (cells_of(x, delimiter) for x in lines))
        marked = ["\t".join("nan" if is_missing(c) else c.strip() for c in cells) for cells in chosen]
        table = _parse(marked, range(len(columns)), "\t")
    if len(table) != len(lines):  # a quote that is not closed swallows lines
        raise ValueError(f"{len(table)} rows in {len(lines)} lines")
    return table


def _parse(lines: Sequence[str], columns: Sequence[int], delimiter: str | None) -> NDArray[np.float64]:
    return np.loadtxt(
        lines, delimiter=delimiter, comments=None, quotechar='"', usecols=list(columns), ndmin=2
    )


def columns_in_text(
    lines: Sequence[str], fields: Mapping[str, tuple[int, str]], width: int
) -> dict[str, NDArray[Any]]:
    """The columns wanted of a cloud, from lines whose fields are (column, NumPy type) by name.

    Numbers of a field declared as single precision are rounded to it, so that a loss of precision is noticed;
    others are kept as written.
    """
    wanted = [name for name in fields if name.lower() in ("x", "y", "z", *INTENSITY)]
    table = numbers(lines, [fields[name][0] for name in wanted], width)
    kinds = ["f4" if fields[name][1] == "f4" else "f8" for name in wanted]
    return {name: values.astype(kind) for name, kind, values in zip(wanted, kinds, table.T, strict=True)}
