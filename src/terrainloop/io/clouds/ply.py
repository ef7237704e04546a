"""PLY, ascii and binary, with any elements and lists around the vertices."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
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

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    """A property in NumPy's types; `length` is the type of the count where it is a list."""

    name: str
    type: str
    length: str = ""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(p.length for p in self.properties)

    @property
    def least(self) -> int:
        """Bytes that one takes at least in binary."""
        return sum(int((p.length or p.type)[1]) for p in self.properties)


def read_ply(path: Path) -> Table:
    """Read the element ``vertex``."""
    data = path.read_bytes()
    header, start = split_header(data, b"end_header")
    order, elements = _parse_header([[word.lower() for word in words] for words in header])
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise ValueError(f"{names.count('vertex')} elements 'vertex'")
    if order == "=":
        return Table(_read_ascii(data[start:], elements))
    return Table(_read_binary(data, start, elements, order))


def _parse_header(header: list[list[str]]) -> tuple[str, list[_Element]]:
    """Byte order and elements."""
    order, elements = "", list[_Element]()
    if header[0] != ["ply"]:
        raise ValueError("no 'ply' in the first line")
    for words in header[1:]:
        match words:
            case ["comment" | "obj_info" | "end_header", *_]:
                pass
            case ["format", encoding, *_] if encoding in _ORDERS:
                order = _ORDERS[encoding]
            case ["element", name, count]:
                elements.append(_Element(name, count_of(count), []))
            case ["property", "list", length, kind, name] if elements and _TYPES.get(length, "f")[0] != "f":
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case _:
                raise ValueError(f"the line {' '.join(words)!r} in the header")
    if not order:
        raise ValueError("no format in the header")
    return order, elements


def _read_ascii(body: bytes, elements: Sequence[_Element]) -> dict[str, NDArray[Any]]:
    lines = [line for line in without_comments(lines_of(body)) if not line.startswith("comment")]
    announced = sum(element.count for element in elements if element.properties)
    if len(lines) != announced:
        raise ValueError(f"the header announces {announced} lines, {len(lines)} follow")
    start = 0
    for element in elements:
        if element.name == "vertex":
            check_count(element.count, len(lines[start : start + element.count]))
            lines = lines[start : start + element.count]
            if element.has_lists:
                lines = [_without_lists(line, element.properties) for line in lines]
            scalars = [p for p in element.properties if not p.length]
            fields = {p.name: (column, p.type) for column, p in enumerate(scalars)}
            if len(fields) < len(scalars):
                raise ValueError("a property of the vertices occurs twice")
            return columns_in_text(lines, fields, len(scalars))
        start += element.count if element.properties else 0
    raise AssertionError("a vertex element was checked to be there")


def _without_lists(line: str, properties: Sequence[_Property]) -> str:
    words, position, scalars = line.split(), 0, []
    for p in properties:
        if position >= len(words):
            break
        if p.length:
            position += count_of(words[position])
        else:
            scalars.append(words[position])
        position += 1
    if position != len(words):
        raise ValueError(f"lists that do not fit the line {line!r}")
    return " ".join(scalars)


def _read_binary(
    data: bytes, start: int, elements: Sequence[_Element], order: str
) -> dict[str, NDArray[Any]]:
    index = [element.name for element in elements].index("vertex")
    for element in elements[:index]:
        _, start = _records(data, start, element, order)
    vertices = elements[index]
    check_count(vertices.count, vertices.count)
    columns, start = _records(data, start, vertices, order)
    behind = sum(element.count * element.least for element in elements[index + 1 :])
    left = len(data) - start
    if behind > left:
        raise ValueError(f"at least {behind} bytes announced behind the vertices, {left} follow")
    if not behind and len(data[start:].strip(PADDING)) >= vertices.least:
        raise ValueError(f"{vertices.count} vertices announced, {left} bytes more follow")
    return columns


def _records(data: bytes, start: int, element: _Element, order: str) -> tuple[dict[str, NDArray[Any]], int]:
    """Scalars of an element that starts at `start`, and where it ends."""
    if element.count * element.least > len(data) - start:
        raise ValueError(f"{element.count} elements {element.name} announced in {len(data) - start} bytes")
    if element.has_lists:
        return _walk(data, start, element, order)
    if not element.properties:
        return {}, start
    dtype = np.dtype([(p.name, order + p.type) for p in element.properties])
    records = np.frombuffer(data, dtype, element.count, start)
    return {p.name: records[p.name] for p in element.properties}, start + records.nbytes


def _walk(data: bytes, start: int, element: _Element, order: str) -> tuple[dict[str, NDArray[Any]], int]:
    """`_records` where lists make them of unequal length."""
    codes = [np.dtype(p.length or p.type).char for p in element.properties]
    readers = [struct.Struct(order + code) for code in codes]
    items = [int(p.type[1]) if p.length else 0 for p in element.properties]
    rows = []
    for _ in range(element.count):
        row = []
        for reader, item in zip(readers, items, strict=True):
            (value,) = reader.unpack_from(data, start)
            start += reader.size
            if not item:
                row.append(value)
            elif value < 0:
                raise ValueError(f"a list of {value} items")
            else:
                start += value * item
        rows.append(row)
    if start > len(data):
        raise ValueError("the last list ends beyond the file")
    scalars = [p for p in element.properties if not p.length]
    table = np.array(rows, dtype=np.float64).reshape(element.count, len(scalars))
    return {p.name: column.astype(p.type) for p, column in zip(scalars, table.T, strict=True)}, start
