"""NumPy's NPY and NPZ."""

import zipfile
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds.table import INTENSITY, WIDEST, Columns, Table
from terrainloop.io.npz import read_array, read_header, read_member

_ANY_BYTES = 1 << 26  # that a member of an archive may unpack to however small it is ...
_BYTES_PER_BYTE = 20  # ... and for each byte that it takes packed


def read_npy(path: Path) -> Table:
    """Read an array (N, 3 or more): x, y, z first."""
    with path.open("rb") as file:
        array = read_array(file, path.stat().st_size)
    return Table(_first_three(array))


def read_npz(path: Path) -> Table:
    """Read the array ``points``, or arrays ``x``, ``y`` and ``z``, or the only 2-D array."""
    with zipfile.ZipFile(path) as archive:
        members = _members(archive)

        def load(name: str) -> NDArray[Any]:
            return read_member(archive, name, members[name])

        def is_table(name: str) -> bool:
            with archive.open(f"{name}.npy") as file:
                return len(read_header(file).shape) == 2

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


def _members(archive: zipfile.ZipFile) -> dict[str, int]:
    """Arrays by name, and the bytes that each may take: not much more than the file."""
    arrays = [member for member in archive.infolist() if member.filename.endswith(".npy")]
    limits = {
        member.filename.removesuffix(".npy"): max(_ANY_BYTES, _BYTES_PER_BYTE * member.compress_size)
        for member in arrays
    }
    if len(limits) < len(arrays):
        raise ValueError("two arrays of one name")
    return limits


def _first_three(array: NDArray[Any]) -> Columns:
    rows, width = array.shape if array.ndim == 2 else (0, 0)
    if not 3 <= width <= min(max(rows, 3), WIDEST):
        raise TerrainLoopError(
            expected="an array of shape (N, 3) or a few columns more, the first three x, y and z",
            found=f"shape {array.shape} of {array.dtype}",
            mend="store one row per point; a raster of heights is not a cloud",
        )
    return dict(zip("xyz", array.T[:3], strict=True))
