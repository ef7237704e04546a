"""PCD: ascii, binary and binary_compressed."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainloop.io.clouds.table import (
    PADDING,
    Table,
    check_count,
    columns_in_text,
    count_of,
    lines_of,
    split_header,
    without_comments,
)

_TYPES = ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8")
_LZF_BEST = 100  # LZF packs at most 264 bytes into 3


class _Field(NamedTuple):
    """A field of `values` numbers per point in NumPy's type."""

    name: str
    type: str
    values: int

    @property
    def size(self) -> int:
        return int(self.type[1]) * self.values


def read_pcd(path: Path) -> Table:
    """Read the fields of which a point has one value each."""
    data = path.read_bytes()
    header, start = split_header(data, b"DATA")
    entries = {words[0].upper(): words[1:] for words in header if not words[0].startswith("#")}
    fields, count = _fields(entries, len(data)), _count(entries)
    body, encoding = data[start:], " ".join(entries["DATA"]).lower()
    if encoding == "ascii":
        return Table(_read_ascii(body, fields, count))
    if encoding == "binary":
        return Table(_read_binary(body, fields, count))
    if encoding == "binary_compressed":
        return Table(_read_compressed(body, fields, count))
    raise ValueError(f"the encoding {encoding!r}")


def _fields(entries: Mapping[str, Sequence[str]], size: int) -> list[_Field]:
    """The layout of a point; COUNT is 1 each where it is left out."""
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []  # COLUMNS up to version .5
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = [count_of(word) for word in entries.get("COUNT") or ["1"] * len(names)]
    types = [kind.lower() + width for kind, width in zip(kinds, sizes, strict=False)]
    if not 0 < len(names) == len(sizes) == len(kinds) == len(counts) or 0 in counts:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT of unequal lengths, or fields of no values")
    if unknown := set(types).difference(_TYPES):
        raise ValueError(f"a field of type {min(unknown)!r}")
    if sum(counts) > size:
        raise ValueError(f"{sum(counts)} values per point announced in {size} bytes")
    names = [name.lower() for name in names]
    for name in ("x", "y", "z"):
        if names.count(name) > 1:
            raise ValueError(f"{names.count(name)} fields {name!r}")
    return [_Field(*field) for field in zip(names, types, counts, strict=True)]


def _count(entries: Mapping[str, Sequence[str]]) -> int:
    """Number of points: POINTS, or WIDTH times HEIGHT."""
    given = {
        name: count_of(" ".join(entries[name])) for name in ("WIDTH", "HEIGHT", "POINTS") if name in entries
    }
    count = given.get("POINTS", given.get("WIDTH", 0) * given.get("HEIGHT", 1))
    if "WIDTH" in given and given["WIDTH"] * given.get("HEIGHT", 1) != count:
        raise ValueError(f"POINTS {count} but WIDTH {given['WIDTH']} and HEIGHT {given.get('HEIGHT', 1)}")
    check_count(count, count)
    return count


def _read_ascii(body: bytes, fields: Sequence[_Field], count: int) -> dict[str, NDArray[Any]]:
    lines = without_comments(lines_of(body))
    check_count(count, len(lines))
    ends = np.cumsum([field.values for field in fields]).tolist()
    columns = {f.name: (end - 1, f.type) for f, end in zip(fields, ends, strict=True) if f.values == 1}
    return columns_in_text(lines, columns, ends[-1])


def _read_binary(body: bytes, fields: Sequence[_Field], count: int) -> dict[str, NDArray[Any]]:
    """Point after point."""
    ends = np.cumsum([field.size for field in fields]).tolist()
    if len(body) < count * ends[-1] or len(body[count * ends[-1] :].strip(PADDING)) >= ends[-1]:
        raise ValueError(f"{count} points of {ends[-1]} bytes announced, {len(body)} bytes follow")
    points = np.frombuffer(body, np.uint8, count * ends[-1]).reshape(count, ends[-1])
    return {
        field.name: points[:, end - field.size : end].copy().view("<" + field.type)[:, 0]
        for field, end in zip(fields, ends, strict=True)
        if field.values == 1
    }


def _read_compressed(body: bytes, fields: Sequence[_Field], count: int) -> dict[str, NDArray[Any]]:
    """Field after field, packed by LZF."""
    import lzf  # type: ignore[import-not-found]

    packed, unpacked = struct.unpack_from("<II", body)
    size = count * sum(field.size for field in fields)
    if packed > len(body) - 8 or unpacked != size or size > _LZF_BEST * packed:
        raise ValueError(f"{count} points do not fit {unpacked} bytes packed in {len(body) - 8}")
    data = lzf.decompress(body[8 : 8 + packed], unpacked)
    if data is None or len(data) != unpacked:
        raise ValueError("packed data that cannot be unpacked")
    columns, start = {}, 0
    for field in fields:
        if field.values == 1:
            columns[field.name] = np.frombuffer(data, "<" + field.type, count, start)
        start += count * field.size
    return columns
