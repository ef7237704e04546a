"""Which columns of a text the lines above it name."""

import re
from collections.abc import Sequence

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds.table import INTENSITY, cells_of, is_comment, is_number

_METRES = r"m|met(?:er|re)s?"
_UNITS = rf"{_METRES}|mm|cm|dm|km|ft|feet|foot|us-?ft|in|inch(?:es)?|deg(?:rees?)?|rad|px|pixels?"
_NAME = re.compile(rf"(.*?)(?:\s*[\[({{<]\s*({_UNITS})\s*[\])}}>]|[ _./-]+({_UNITS}))?")
_LONGEST_NAME = 64
_POINT = r"(?:p|pt|points?|pos|position|xyz|coords?|coordinates?|location|vertex|field)"
_SUFFIX = r"(?:[ _.-]*(?:coords?|coordinates?|pos|position|values?))?"
_INDEXED = r"(?:points?|pos|position|xyz|coords?|coordinates?)[ _.:-]*\[?{}\]?"  # Points:0 of ParaView

_LOCAL, _WORLD, _DEGREES, _OTHER = "local", "world", "degrees", "other"
_MEANINGS = (
    *((_LOCAL + axis, rf"(?:{_POINT}[ _.:-]*)?{axis}{_SUFFIX}") for axis in "xyz"),
    *((_LOCAL + axis, _INDEXED.format(index)) for index, axis in enumerate("xyz")),
    (_WORLD + "x", r"eastings?|east"),
    (_WORLD + "y", r"northings?|north"),
    (_WORLD + "z", r"elevations?|elev|heights?|altitudes?|alt"),
    (_DEGREES, r"lat|lon|long|lng|latitude|longitude"),
    *((name, name) for name in INTENSITY),
    # Not used, but what stands beside them is surely a name, too.
    (
        _OTHER,
        r"[rgb]|red|green|blue|alpha|rgba?|[nvds][xyz]|normal.*|sigma.*|std.*|scalar.*|i|amplitude|range",
    ),
    (
        _OTHER,
        r"t|time.*|stamp|.*timestamp|gps_?time|n?secs?|id|idx|index|row|[enhuv]|label|class(?:ification)?",
    ),
    (_OTHER, r"(?:point|pt)[ _-]*(?:id|no|nr|number)|ring|channel|returns?|confidence|curvature"),
    (_OTHER, r"[xyz](?:[_.-]\w+|\d)"),
)
_PATTERNS = tuple((meaning, re.compile(pattern)) for meaning, pattern in _MEANINGS)


def columns_of(header: Sequence[str], width: int, spare: bool) -> dict[str, int] | None:
    """Columns of x, y, z and, where there is one, the intensity, among `width`; None where none are named.

    Where the last column is `spare`, that is empty throughout, it needs no name.

    Raises
    ------
    TerrainLoopError
        Where a line may name columns, but not clearly one each.
    """
    named = [columns for line in header if (columns := _columns_in(line, width, spare)) is not None]
    if any(columns != named[0] for columns in named):
        raise _not_understood(header[-1], width)
    return named[0] if named else None


def _columns_in(line: str, width: int, spare: bool) -> dict[str, int] | None:
    commented = is_comment(line)
    cells, delimiter = _cells_in(line.lstrip("#/% "))
    if len(cells) == width + 1 and not cells[-1]:
        cells.pop()
    if len(cells) == width - 1 and spare:
        cells.append("")
    fits = len(cells) == width
    meanings = [_meaning(cell) for cell in cells]
    axes, known = _axes(meanings), sum(map(bool, meanings))
    listed = len(cells) >= 3 and 2 * known > len(cells)  # few words of a sentence are known names
    # A sentence can have as many words as there are columns, and three of them be x, y and z.
    if fits and axes and (not commented or delimiter or listed or list(axes.values()) == [0, 1, 2]):
        intensity = next((meanings.index(name) for name in INTENSITY if name in meanings), None)
        return axes if intensity is None else axes | {"intensity": intensity}
    if commented:
        # Above three columns, a few words are a note, and commas may be those of a sentence.
        words = all(re.fullmatch(r"[A-Za-z][\w.]*", cell) for cell in cells)
        names = (delimiter or words) if width > 3 else (delimiter in (";", "\t") or (delimiter and words))
        unclear = listed or (fits and bool(axes or names))
    else:  # only a title of several words above three columns is harmless; one word is that of a format
        unclear = fits or width > 3 or known > 0 or is_number(cells[0]) or len(cells) == 1
    if unclear:
        raise _not_understood(line, width)
    return None


def _cells_in(line: str) -> tuple[list[str], str | None]:
    """The line split by its own delimiter, and that, None for blanks."""
    line = re.sub(r" {2,}", " ", line)
    line = re.sub(r" ([\[({<])", r"\1", line)  # x [m] is one name
    line = re.sub(r"^(?:columns?|fields?|format|header|names?)[ ]?[:=]", "", line, flags=re.IGNORECASE)
    delimiter = next((mark for mark in ";\t," if mark in line), None)
    cells = [cell.strip(" \t\"'") for cell in cells_of(line, delimiter)]
    return cells or [""], delimiter


def _meaning(cell: str) -> str:
    """What a name stands for, empty if it is not known; a coordinate not in metres is none of ours."""
    match = _NAME.fullmatch(cell.lower()) if len(cell) <= _LONGEST_NAME else None
    if match is None:
        return ""
    name, unit = match[1], match[2] or match[3] or "m"
    meaning = next((meaning for meaning, pattern in _PATTERNS if pattern.fullmatch(name)), "")
    foreign = meaning.startswith((_LOCAL, _WORLD)) and not re.fullmatch(_METRES, unit)
    return _OTHER if foreign else meaning


def _axes(meanings: Sequence[str]) -> dict[str, int] | None:
    """Columns of x, y and z if each is there once: so named, or else in other words."""
    for kinds in ((_LOCAL,), (_LOCAL, _WORLD)):
        found = {
            axis: [i for i, m in enumerate(meanings) if m in [k + axis for k in kinds]] for axis in "xyz"
        }
        if all(len(columns) == 1 for columns in found.values()):
            return {axis: column for axis, (column,) in found.items()}
        if _DEGREES in meanings:
            return None
    return None


def _not_understood(line: str, width: int) -> TerrainLoopError:
    return TerrainLoopError(
        expected=f"the names of {width} columns with x, y and z, in metres, once each, or no names",
        found=f"the line {line!r}",
        mend="name the columns so, or remove that line: then the first three columns are read",
    )
