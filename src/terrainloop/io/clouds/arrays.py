"""NumPy's NPY and NPZ."""

import zipfile
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds.table import INTENSITY, WIDEST, Columns, Table

_ANY_BYTES = 1 << 26  # that a member of an archive may unpack to however small it is ...
_BYTES_PER_BYTE = 20  # ... and for each byte that it takes packed


def read_npy(path: Path) -> Table:
    """Read an array (N, 3 or more): x, y, z first."""
    with path.open("rb") as file:
        array = _load(file, path.stat().st_size)
    return Table(_first_three(array))


def read_npz(path: Path) -> Table:
    """Read the array ``points``, or arrays ``x``, ``y`` and ``z``, or the only 2-D array."""
    with zipfile.ZipFile(path) as archive:
        members = _members(archive)

        def load(name: str) -> NDArray[Any]:
            with archive.open(members[name]) as file:
                return _load(file, members[name].file_size)

        def is_table(name: str) -> bool:
            with archive.open(members[name]) as file:
                return len(_header(file).shape) == 2

        if "points" in members:
            columns = _first_three(load("points"))
        elif {"x", "y", "z"} <= members.keys():
            columns = {axis: load(axis) for axis in "xyz"}
        else:
            tables = [name for name in members if is_table(name)]
            if len(tables) != 1:
                raise ValueError(f"no array 'points' and {len(tables)} 2-D arrays among {list(members)}")
            columns = _first_three(load(tables[0]))
        return Table({**columns, **{name: load(name) for name in INTENSITY if name in members}})


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Arrays by name, none of which takes much more memory than the file."""
    arrays = [member for member in archive.infolist() if member.filename.endswith(".npy")]
    members = {member.filename.removesuffix(".npy"): member for member in arrays}
    if len(members) < len(arrays):
        raise ValueError("two arrays of one name")
    for name, member in members.items():
        # zipfile unpacks BZIP2 and LZMA without bound, and NumPy writes neither.
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"the array {name!r} is packed by another method than NumPy's")
        if member.file_size > max(_ANY_BYTES, _BYTES_PER_BYTE * member.compress_size):
            raise ValueError(f"{member.file_size} bytes packed in {member.compress_size}")
    return members


class _Header(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def _header(file: IO[bytes]) -> _Header:
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)
    if version not in readers:  # 3.0 is for structured types alone
        raise ValueError(f"an NPY file of version {version}")
    shape, _, dtype = readers[version](file)
    return _Header(shape, dtype)


def _load(file: IO[bytes], size: int) -> NDArray[Any]:
    """The array of an NPY stream of `size` bytes; its type and size are checked before it is read."""
    shape, dtype = _header(file)
    if dtype.kind not in "fiu":
        raise ValueError(f"an array of {'objects, which are never loaded' if dtype.hasobject else dtype}")
    announced = file.tell() + int(np.prod(shape, dtype=object)) * dtype.itemsize
    if announced != size:
        raise ValueError(f"an array of shape {shape} of {dtype} announced, {size} bytes in all")
    file.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def _first_three(array: NDArray[Any]) -> Columns:
    rows, width = array.shape if array.ndim == 2 else (0, 0)
    if not 3 <= width <= min(max(rows, 3), WIDEST):
        raise TerrainLoopError(
            expected="an array of shape (N, 3) or a few columns more, the first three x, y and z",
            found=f"shape {array.shape} of {array.dtype}",
            mend="store one row per point; a raster of heights is no cloud",
        )
    return dict(zip("xyz", array.T[:3], strict=True))
