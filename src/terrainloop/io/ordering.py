"""The order of files by their names, refused where the names are ambiguous.

Numbers in names are compared as numbers: ``scan_9`` comes before ``scan_10``. That is unambiguous as long
as every plausible reading of the names yields the same order. Readings that can disagree: ``1.9, 1.10`` are
decimals or versions; ``a_2, b_1`` are ordered by letter or by counter; months have names; dates may start
with the day. Where poses depend on the order, a disagreement is an error unless the stamps of the poses are
those in the names; where nothing depends on it, it is a warning.
"""

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal
from itertools import pairwise
from typing import Any
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Order = list[int]
Key = Callable[[str], Any]

_MINUS = r"(?<![^\W_])-(?=\d)"  # a hyphen before a number and not after a letter or digit
_DECIMAL = r"(?<![\d.])\d+\.\d+(?!\.?\d)|\d+"  # 9.5, but not 1.2.3
_INTEGER = r"\d+"
_COMPOUND = (
    r"\d+(?:[-_.:,T hm]+\d+)*"  # dates, times, seconds and nanoseconds: one quantity in several fields
)
_COUNTING_WORD = (  # in no order of letters; abbreviated or not
    r"(?i)(?<![a-z])(jan(?:uary)?|feb(?:ruary)?|mar(?:ch)?|apr(?:il)?|may|june?|july?|aug(?:ust)?|sept?(?:ember)?"
    r"|oct(?:ober)?|nov(?:ember)?|dec(?:ember)?|(?:mon|tues?|wed(?:nes)?|thu(?:rs)?|fri|sat(?:ur)?|sun)(?:day)?"
    r"|spring|summer|autumn|winter|morning|noon|afternoon|evening|night"
    r"|one|two|three|four|five|six|seven|eight|nine|ten|first|second|third|fourth|fifth|last"
    r"|[ivx]{1,4})(?![a-z])"
)
_DAY_FIRST = (  # 15-01-2024, 15012024
    r"(?<!\d)(?<!\d[-_.])(?:\d{1,2}([-_.])\d{1,2}\1|(?:0[1-9]|[12]\d|3[01])(?:0[1-9]|1[0-2]))"
    r"(?:19|20)\d\d(?!\d)"
)
_SHORT_YEAR = r"(?<!\d)(\d{1,2})([-_.])(\d{1,2})\2(\d\d)(?!\d)"  # 15-01-24, or 24-01-15
_TWELVE_HOURS = r"(?i)\d *[ap]m(?![a-z])"
_LETTERS = r"(|.*[^a-z])([a-z]{1,2})"  # a ... z, aa, ab, as spreadsheets count
_HEXADECIMAL = r"(|.*[^0-9a-f])([0-9a-f]+)"

_TIME_LIKE = 1e8  # from here on a number in a name is a time, not an index
_CLOSE = 0.1  # seconds by which a stamp may differ from the time in a name, where stamps are far apart
_LONGEST = 60  # characters of a name that are quoted


def order_of_names(names: Sequence[str], stamps: Sequence[Array] = ()) -> Order:
    """Indices that put names in natural order.

    Parameters
    ----------
    names : sequence of str, (N,)
        Stems of files, all different.
    stamps : sequence of array, (N,)
        Stamps of each trajectory with one pose for each name in that order. Stamps that are the numbers in
        the names (seconds, also as seconds and nanoseconds, or milli-, micro- or nanoseconds) decide between
        readings.

    Raises
    ------
    TerrainLoopError
        If there are trajectories and the order is ambiguous, or their stamps contradict it.
    """
    confirmed = next((order for s in stamps if (order := _confirmed(names, s)) is not None), None)
    if confirmed is not None:
        return confirmed
    order, doubt = _by_name(names)
    if doubt and stamps:
        raise TerrainLoopError(
            expected="file names with one possible order, as there is a pose for each file in that order",
            found=doubt,
            mend="rename the files so that they begin with a counter of equal width (0001_...)",
        )
    if doubt:
        logger.warning("the order of the files is ambiguous (%s): taken by name", doubt)
    for each in stamps:
        _check_stamps([names[i] for i in order], each)
    return order


def _by_name(names: Sequence[str]) -> tuple[Order, str]:
    """The natural order and, in words, why another is possible; empty if none is."""
    hyphens = [re.search(_MINUS, name) is not None for name in names]
    minus = f"(?:{_MINUS})?" if any(hyphens) else ""
    sign = "" if all(hyphens) else minus  # a hyphen in every name separates
    natural = _key(sign + f"(?:{_DECIMAL})")
    order = _sorted(names, natural)
    ordered = [names[i] for i in order]
    if len(names) < 2:
        return order, ""
    for reading, key in _readings(ordered, sign, minus, natural):
        other = [ordered[i] for i in _sorted(ordered, key)]
        if other != ordered:
            at = next(i for i, (a, b) in enumerate(zip(ordered, other, strict=True)) if a != b)
            return order, f"{_short(ordered[at])} before {_short(other[at])} by name, after it {reading}"
    return order, _unordered_notation(ordered) or _without_order(ordered, natural)


def _readings(names: Sequence[str], sign: str, minus: str, natural: Key) -> Iterator[tuple[str, Key]]:
    """Other readings of the names."""
    yield "as version numbers", _key(sign + _INTEGER)
    yield "as negative numbers", _key(minus + f"(?:{_DECIMAL})")
    yield "ignoring case and forms of letters", lambda name: natural(normalize("NFKC", name).casefold())
    for reading, values in (
        ("by the last number alone", _last_numbers(names, sign, natural)),
        ("as a date that begins with the day", _days_first(names)),
        ("as hexadecimal numbers", _hexadecimal(names)),
        ("as a counter in letters", _letters(names)),
    ):
        if values:
            yield reading, values.__getitem__


def _last_numbers(names: Sequence[str], sign: str, natural: Key) -> dict[str, Any]:
    """The last number of each name, where all have one of their own: it may be the counter."""
    found = {name: re.findall(sign + _COMPOUND, name) for name in names}
    if not all(found.values()):
        return {}
    last = {name: natural(numbers[-1]) for name, numbers in found.items()}
    return last if len(set(last.values())) == len(names) else {}


def _days_first(names: Sequence[str]) -> dict[str, Any]:
    """Year, month and day of each name, where all may be such a date of much the same year."""
    found = [match for name in names if (match := re.search(_SHORT_YEAR, name))]
    dates = [(int(match[4]), int(match[3]), int(match[1])) for match in found]
    if len(dates) < len(names):
        return {}
    (first, _, _), (last, _, _) = min(dates), max(dates)
    possible = last - first < 2 and all(month <= 12 and day <= 31 for _, month, day in dates)
    return dict(zip(names, dates, strict=True)) if possible else {}


def _hexadecimal(names: Sequence[str]) -> dict[str, Any]:
    """The value of each name, where all end in hexadecimal digits, of which some are letters and some not."""
    found = [match for name in names if (match := re.fullmatch(_HEXADECIMAL, name.casefold()))]
    digits = "".join(match[2] for match in found)
    of_one_name = len(found) == len(names) and len({match[1] for match in found}) == 1
    if not of_one_name or digits.isdigit() or digits.isalpha():
        return {}
    return {name: int(match[2], 16) for name, match in zip(names, found, strict=True)}


def _letters(names: Sequence[str]) -> dict[str, Any]:
    """The last letters of each name and their number, where the names differ in one or two letters only."""
    found = [match for name in names if (match := re.fullmatch(_LETTERS, name.casefold()))]
    if len(found) < len(names) or len({match[1] for match in found}) > 1:
        return {}
    return {name: (len(match[2]), match[2]) for name, match in zip(names, found, strict=True)}


def _unordered_notation(names: Sequence[str]) -> str:
    """Notations of time and number that no order of letters or numbers follows."""
    for pattern, notation in (
        (_COUNTING_WORD, "counting words"),
        (_DAY_FIRST, "dates from the day on"),
        (_TWELVE_HOURS, "am or pm"),
    ):
        found = {match.group(): name for name in names if (match := re.search(pattern, name))}
        if len(found) > 1:
            first, *_, last = found.values()
            return f"{notation} in {_short(first)} and {_short(last)}"
    return ""


def _without_order(names: Sequence[str], natural: Key) -> str:
    """Neighbours that are equal but for zeros in front, or that punctuation alone puts in order."""
    for a, b in pairwise(names):
        parts = list(zip(natural(a), natural(b), strict=False))
        differs = next((i for i, (x, y) in enumerate(parts) if x != y), None)
        if differs is None:
            return f"equal numbers in {_short(a)} and {_short(b)}"
        if differs % 2 == 0 and a > b:
            return f"{_short(a)} before {_short(b)} by the text before their numbers, after it by letters"
    return ""


def _confirmed(names: Sequence[str], stamps: Array) -> Order | None:
    """The order in which the times in the names are the stamps, if there is one."""
    gaps = np.diff(stamps)
    if len(gaps) == 0 or gaps.min() <= 0:
        return None
    for times, _ in times_in_names(names):
        order = np.argsort(times, kind="stable")
        if np.abs(times[order] - stamps).max() <= min(_CLOSE, gaps.min() / 4):
            return [int(i) for i in order]
    return None


def times_in_names(names: Sequence[str]) -> Iterator[tuple[Array, bool]]:
    """The last number of each name as seconds, in each reading, and whether it surely is not an index."""
    found = [re.findall(f"(?:{_MINUS})?" + _COMPOUND, name) for name in names]
    if not all(found):
        return
    fields = [re.split(r"[^\d]+", last[-1].lstrip("-")) for last in found]
    signs = np.array([-1.0 if last[-1].startswith("-") else 1.0 for last in found])
    if all(len(parts) >= 2 for parts in fields):
        yield signs * np.array([float(f"{parts[-2]}.{parts[-1]}") for parts in fields]), True
        yield signs * np.array([float(parts[-2]) + 1e-9 * float(parts[-1]) for parts in fields]), True
    plain = signs * np.array([float(".".join(parts[-2:])) for parts in fields])
    for unit in (1.0, 1e-3, 1e-6, 1e-9):
        yield plain * unit, bool((plain * unit >= _TIME_LIKE).all())


def _check_stamps(names: Sequence[str], stamps: Array) -> None:
    """Refuse stamps that decrease, or that equal the times in other names."""
    steps = np.diff(stamps)
    if (steps < 0).any():
        at = int(np.argmax(steps < 0))
        raise TerrainLoopError(
            expected="poses in the order of the file names, and so with increasing stamps",
            found=f"stamp {stamps[at + 1]:.15g} after {stamps[at]:.15g}",
            mend="sort the poses as the files are, or stamp them with the index of the file",
        )
    if (steps == 0).any():
        repeated = stamps[int(np.argmax(steps == 0))]
        logger.warning("the stamp %.15g repeats: poses are taken in the order of the lines", repeated)
    for times, surely in times_in_names(names):
        elsewhere = np.isin(np.round(times, 3), np.round(stamps, 3)) & (np.abs(times - stamps) > _CLOSE)
        if surely and 2 * elsewhere.sum() >= len(names):
            at = int(np.argmax(elsewhere))
            raise TerrainLoopError(
                expected="a pose for each file with the stamp that is in its name",
                found=f"stamp {stamps[at]:.15g} where {_short(names[at])} is due",
                mend="give one pose for each file, in the order of the names",
            )


def _key(number: str) -> Key:
    """Sort by the text between numbers and the numbers, in turn."""
    pattern = re.compile(f"({number})")

    def key(name: str) -> Any:
        return tuple(Decimal(part) if i % 2 else part for i, part in enumerate(pattern.split(name)))

    return key


def _sorted(names: Sequence[str], key: Key) -> Order:
    return sorted(range(len(names)), key=lambda i: (key(names[i]), names[i]))


def _short(name: str) -> str:
    return repr(name if len(name) <= _LONGEST else name[:_LONGEST] + "...")
