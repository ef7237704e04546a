"""Point clouds from files and back, one reader a format, told apart by suffix."""

import io
import re
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping
from itertools import takewhile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.submap import Submap

Columns = Mapping[str, NDArray[Any]]
"""What a file holds, one array a point property, in the type it was stored in."""

_WIDEST = 32  # columns of a text cloud without a header
_INTENSITY = ("intensity", "reflectivity", "scalar_intensity")
_COMMENTS = ("#", "//")
_LONGEST_HEADER = 1 << 16  # bytes
_LZF_BEST = 100  # LZF packs at most 264 bytes into 3
_LAS_CHUNK = 1_000_000  # points
_LAZ = 0x80  # bit of the point format that says compressed
_LAYERED = 6  # first point format that LAZ compresses in layers


def read_cloud(path: str | Path, stamp: float = 0.0) -> Submap:
    """Read one submap, named by the stem of its file.

    Parameters
    ----------
    path : path
        PLY (ascii or binary, with or without faces), PCD (ascii, binary, binary_compressed), LAS, LAZ,
        NPY (rows are points, the first three columns x, y, z), NPZ (array ``points``, or the only 2-D
        array, or arrays ``x``, ``y``, ``z``), or text (XYZ, TXT, CSV): comma, semicolon, tab or space
        separated, comments after ``#`` or ``//``, the columns a header names x, y, z or else the first
        three. The suffix decides, in any case. An intensity is taken where a column is named so.
    stamp : float
        Of the submap, seconds.

    Raises
    ------
    TerrainLoopError
        Naming the file, for whatever is wrong with it.
    """
    path = Path(path)
    reader = _reader_for(path)
    try:
        points, intensity = _cloud_of(reader(path))
        return Submap(points, name=path.stem, stamp=stamp, intensity=intensity)
    except TerrainLoopError as error:
        found = f"{path}: {error.found}"
        raise TerrainLoopError(expected=error.expected, found=found, mend=error.mend) from error
    except Exception as error:  # what readers raise on damaged files is not documented
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise TerrainLoopError(
            expected=f"a whole {path.suffix} file",
            found=f"{path}: {reason}",
            mend="export it again: it is damaged, cut short or of another format than its suffix says",
        ) from error


def write_cloud(path: str | Path, points: ArrayLike) -> None:
    """Write points (N, 3) as PLY, NPY, NPZ or XYZ, by suffix.

    PLY is binary little-endian, in single precision unless that would cost a millimetre.
    """
    path, points = Path(path), np.asarray(points, dtype=np.float64)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise TerrainLoopError(
            expected=f"a path with one of the suffixes {' '.join(_WRITERS)}",
            found=str(path),
            mend="choose one of these formats",
        )
    with path.open("wb") as file:
        writer(file, points)


def _reader_for(path: Path) -> Callable[[Path], Columns]:
    reader = _READERS.get(path.suffix.lower())
    if reader is not None and path.is_file() and path.stat().st_size > 0:
        return reader
    found = (
        "an empty file" if reader and path.is_file() else "another suffix" if path.is_file() else "no file"
    )
    raise TerrainLoopError(
        expected=f"a cloud with one of the suffixes {' '.join(CLOUD_SUFFIXES)}",
        found=f"{found} at {path}",
        mend="give the path of a cloud, or export it in one of these formats",
    )


def _cloud_of(columns: Columns) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Points (N, 3) and, where there is one, the intensity."""
    columns = {name.lower(): values for name, values in columns.items()}
    if not {"x", "y", "z"} <= columns.keys():
        raise TerrainLoopError(
            expected="points with properties x, y and z",
            found=f"the properties {', '.join(columns) or '(none)'}",
            mend="export the coordinates under these names",
        )
    intensity = next((columns[name] for name in _INTENSITY if name in columns), None)
    return np.column_stack([columns[axis] for axis in "xyz"]), intensity


def _by_field(records: NDArray[Any]) -> Columns:
    return {name: records[name] for name in records.dtype.names or ()}


def _first_three(array: NDArray[Any]) -> Columns:
    if array.ndim != 2 or not 3 <= array.shape[1] <= max(array.shape[0], 3):
        raise TerrainLoopError(
            expected="an array of shape (N, 3), the columns x, y and z",
            found=f"shape {array.shape} of {array.dtype}",
            mend="store one row a point",
        )
    return dict(zip("xyz", array.T[:3], strict=True))


def _split_header(data: bytes, last: bytes) -> tuple[list[str], int]:
    """Lines of a text header down to the one that starts with `last`, and where the body starts."""
    end = re.search(rb"^%b[^\n]*\n" % last, data[:_LONGEST_HEADER], re.MULTILINE)
    if end is None:
        raise ValueError(f"no header that ends with a line {last.decode()}")
    return data[: end.end()].decode("ascii", "replace").splitlines(), end.end()


def _records(data: bytes, start: int, dtype: np.dtype[Any], count: int, ascii_: bool) -> NDArray[Any]:
    """`count` records from the body that begins at `start`, from text or binary."""
    if count < 1:
        raise ValueError(f"the header announces {count} points")
    if not ascii_:
        return np.frombuffer(data, dtype, count, start)
    lines = data[start:].decode("ascii").splitlines()[:count]
    if len(lines) < count:
        raise ValueError(f"the header announces {count} points, {len(lines)} lines follow")
    return np.loadtxt(lines, dtype=dtype, comments=None, ndmin=1)


_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def _read_ply(path: Path) -> Columns:
    data = path.read_bytes()
    lines, start = _split_header(data, b"end_header")
    words = [line.split() for line in lines if line.strip()]
    encoding = next((w[1] for w in words if w[0] == "format"), "none")
    if words[0] != ["ply"] or encoding not in _PLY_ORDERS:
        raise ValueError(f"not a PLY header, or of unknown format ({encoding})")
    for name, count, dtype in _ply_elements(words, _PLY_ORDERS[encoding]):
        if name == "vertex":
            return _by_field(_records(data, start, dtype, count, encoding == "ascii"))
        # What stands before the vertices is skipped: lines of text, or bytes.
        if encoding == "ascii":
            start += sum(map(len, data[start:].splitlines(keepends=True)[:count]))
        else:
            start += count * dtype.itemsize
    raise ValueError("no vertices")


def _ply_elements(words: list[list[str]], order: str) -> Iterator[tuple[str, int, np.dtype[Any]]]:
    """Name, count and layout of each element; lists are refused only when one stands in the way."""
    starts = [i for i, word in enumerate(words) if word[0] == "element"]
    for begin, end in zip(starts, [*starts[1:], len(words)], strict=True):
        _, name, count = words[begin]
        properties = [word[1:] for word in words[begin:end] if word[0] == "property"]
        if any(kind == "list" for kind, *_ in properties):
            raise ValueError(f"the element {name} holds lists: only elements after the vertices may")
        yield name, int(count), np.dtype([(label, order + _PLY_TYPES[kind]) for kind, label in properties])


def _read_pcd(path: Path) -> Columns:
    from pypcd4.pypcd4 import MetaData, PointCloud

    data = path.read_bytes()
    header, start = _split_header(data, b"DATA")
    metadata = MetaData.parse_header(header)
    dtype = metadata.build_dtype()
    if metadata.data.value in ("ascii", "binary"):
        return _by_field(_records(data, start, dtype, metadata.points, metadata.data.value == "ascii"))
    (unpacked,) = struct.unpack_from("<4xI", data, start)
    if unpacked != metadata.points * dtype.itemsize or unpacked > _LZF_BEST * len(data):
        raise ValueError(f"{metadata.points} points do not fit {unpacked} bytes packed in {len(data)}")
    return _by_field(PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(data))).pc_data)


def _read_las(path: Path) -> Columns:
    import laspy  # type: ignore[import-untyped]

    _check_las_header(path)
    selection = laspy.DecompressionSelection.base().decompress_z().decompress_intensity()
    try:
        # In chunks and on one thread, so that no count in the header is trusted with an allocation.
        with laspy.open(
            path, laz_backend=laspy.LazBackend.Lazrs, decompression_selection=selection, read_evlrs=False
        ) as reader:
            if reader.header.are_points_compressed and reader.header.point_format.id >= _LAYERED:
                _check_layers(path, reader.header)
            chunks = list(reader.chunk_iterator(_LAS_CHUNK))
    except BaseException as error:
        if type(error).__name__ == "PanicException":  # of lazrs, and no Exception
            raise ValueError(str(error)) from error
        raise
    count, announced = sum(map(len, chunks)), reader.header.point_count
    if count != announced or count == 0:
        raise ValueError(f"the header announces {announced} points, {count} follow")
    names = ("x", "y", "z", "intensity")
    return {name: np.concatenate([np.asarray(chunk[name]) for chunk in chunks]) for name in names}


def _check_las_header(path: Path) -> None:
    """Refuse counts that cannot be: laspy would loop over four billion records, lazrs abort the process."""
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(105)
        points_start, records = struct.unpack_from("<II", header, 96)
        if header[:4] != b"LASF" or points_start > size or 54 * records > points_start:
            raise ValueError("not a LAS header")
        if header[104] & _LAZ:
            file.seek(points_start)
            (table_start,) = struct.unpack("<q", file.read(8))
            if not 0 < table_start <= size - 8:
                raise ValueError("no table of chunks")
            file.seek(table_start)
            _, chunks = struct.unpack("<II", file.read(8))
            if chunks > size:
                raise ValueError(f"{chunks} chunks announced in {size} bytes")


def _check_layers(path: Path, header: Any) -> None:
    """Refuse layers larger than their chunk: lazrs would allocate them, up to 4 GB each."""
    import lazrs  # type: ignore[import-untyped]

    laszip = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
    start = header.offset_to_point_data + 8  # behind the position of the chunk table
    with path.open("rb") as file:
        file.seek(header.offset_to_point_data)
        sizes = [size for _, size in lazrs.read_chunk_table(file, laszip)]
        file.seek(header.offset_to_point_data)
        (table_start,) = struct.unpack("<q", file.read(8))
        whole = start + sum(sizes) == table_start
        for size in sizes:
            file.seek(start + laszip.item_size())  # behind the first point: a count, nine layer sizes
            whole = whole and sum(struct.unpack("<4x9I", file.read(40))) <= size
            start += size
    if not whole:
        raise ValueError("chunks that do not fit their layers or the file")


def _read_npy(path: Path) -> Columns:
    with path.open("rb") as file:
        return _first_three(_array_from(file, path.stat().st_size))


def _read_npz(path: Path) -> Columns:
    with zipfile.ZipFile(path) as archive:
        members = {name.removesuffix(".npy"): archive.getinfo(name) for name in archive.namelist()}

        def load(name: str) -> NDArray[Any]:
            with archive.open(members[name]) as file:
                return _array_from(file, members[name].file_size)

        if "points" in members:
            coordinates = _first_three(load("points"))
        elif {"x", "y", "z"} <= members.keys():
            coordinates = {axis: load(axis) for axis in "xyz"}
        else:
            tables = [array for array in map(load, members) if array.ndim == 2]
            if len(tables) != 1:
                raise ValueError(f"no array 'points' and {len(tables)} 2-D arrays among {list(members)}")
            coordinates = _first_three(tables[0])
        return {**coordinates, **{name: load(name) for name in _INTENSITY if name in members}}


def _array_from(file: IO[bytes], size: int) -> NDArray[Any]:
    """The array of an NPY stream of `size` bytes, never a pickle, nor more than the stream holds."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, dtype = readers[np.lib.format.read_magic(file)](file)
    if dtype.hasobject:
        raise ValueError("a pickled object, which is never loaded")
    if int(np.prod(shape, dtype=object)) * dtype.itemsize > size:
        raise ValueError(f"an array of shape {shape} announced in {size} bytes")
    file.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def _read_text(path: Path) -> Columns:
    lines = [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
    lines = [line for line in lines if line]
    head = list(takewhile(_is_comment, lines))
    body = [line for line in lines if not _is_comment(line)]
    if body and not _starts_with_numbers(body[0]):
        head.append(body.pop(0))
    delimiter = next((mark for mark in ";,\t" if body and mark in body[0]), None)
    named = ([cell.strip(' "').lower() for cell in line.lstrip("#/ ").split(delimiter)] for line in head)
    names = next((cells for cells in named if {"x", "y", "z"} <= set(cells)), ["x", "y", "z"])
    wanted = [name for name in ("x", "y", "z", *_INTENSITY) if name in names]
    columns = [names.index(name) for name in wanted]
    try:
        if not body:
            raise ValueError("no line of numbers")
        width = len(body[0].split(delimiter))
        if width > _WIDEST and names == ["x", "y", "z"]:
            raise ValueError(f"{width} numbers a line and no header: a raster of heights")
        table = np.loadtxt(body, delimiter=delimiter, comments=_COMMENTS, usecols=columns, ndmin=2)
    except ValueError as error:
        raise TerrainLoopError(
            expected="lines of at least three numbers, x y z, after one header line at most",
            found=str(error),
            mend="export plain numbers with decimal points, one point a line",
        ) from error
    return dict(zip(wanted, table.T, strict=True))


def _is_comment(line: str) -> bool:
    return line.startswith(_COMMENTS)


def _starts_with_numbers(line: str) -> bool:
    cells = re.split(r"\s*[;,\s]\s*", line)[:3]
    try:
        return len([float(cell) for cell in cells]) == 3
    except ValueError:
        return False


def _write_ply(file: IO[bytes], points: NDArray[np.float64]) -> None:
    single = points.astype("<f4")
    kind, body = ("float", single) if np.allclose(single, points, 0, 5e-4) else ("double", points)
    properties = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    file.write(header.encode() + body.astype(body.dtype.newbyteorder("<")).tobytes())


_READERS: dict[str, Callable[[Path], Columns]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".xyz": _read_text,
    ".txt": _read_text,
    ".csv": _read_text,
}
_WRITERS: dict[str, Callable[[IO[bytes], NDArray[np.float64]], None]] = {
    ".ply": _write_ply,
    ".npy": np.save,
    ".npz": lambda file, points: np.savez(file, points=points),
    ".xyz": lambda file, points: np.savetxt(file, points, fmt="%.6f"),
}

CLOUD_SUFFIXES = tuple(_READERS)
"""Suffixes, in lower case, of the files that `read_cloud` reads."""
