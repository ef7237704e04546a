"""Point clouds from files and back, one reader per format, chosen by suffix."""

import io
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds.arrays import read_npy, read_npz
from terrainloop.io.clouds.kitti import read_kitti
from terrainloop.io.clouds.pcd import read_pcd
from terrainloop.io.clouds.ply import read_ply
from terrainloop.io.clouds.table import INTENSITY, Columns, Table, check_points
from terrainloop.io.clouds.text import read_text
from terrainloop.io.files import as_path, write_whole
from terrainloop.scan import Scan
from terrainloop.submap import Submap, as_numbers

logger = logging.getLogger(__name__)

__all__ = ["CLOUD_SUFFIXES", "SCAN_SUFFIXES", "read_cloud", "read_crs", "read_scan", "write_cloud"]

Cloud = TypeVar("Cloud")


def read_cloud(path: str | Path, stamp: float = 0.0) -> Submap:
    """Read one submap, named by the stem of its file.

    Parameters
    ----------
    path : path
        PLY (ascii or binary, any elements beside the vertices), PCD (ascii, binary, binary_compressed),
        LAS, LAZ, NPY (rows are points, the first three columns x, y, z), NPZ (array ``points``, or arrays
        ``x``, ``y``, ``z``, or the only 2-D array), or text (XYZ, TXT, CSV): comma, semicolon, tab or
        space separated, comments after ``#`` or ``//``. The suffix decides, in any case.

        A header of a text names its columns if it has one name per column: x, y, z (with ``m`` as unit,
        or as in ``Points:0``), or easting, northing, elevation; a header that cannot be understood is
        refused. Without a header the first three columns are x, y, z. An intensity is read where a column
        is named so.
    stamp : float
        Stamp of the submap, seconds.

    Returns
    -------
    Submap
        Its `repairs` count the points that were dropped: without a value in x, y or z (NaN, ``1.#QNAN``,
        ``NULL``, an empty cell), and in LAS and LAZ those withheld or classified as noise (7 and 18).

    Raises
    ------
    TerrainLoopError
        If anything is wrong with the file, which the error names: damage, coordinates of a LAS or LAZ file
        in degrees or feet, a count in a header that differs from what follows.
    """
    path = as_path(path, "a cloud")

    def submap_of(points: NDArray[Any], intensity: NDArray[Any] | None, repairs: tuple[str, ...]) -> Submap:
        return Submap(points, name=path.stem, stamp=stamp, intensity=intensity, repairs=repairs)

    return _read(path, _READERS, submap_of)


def read_scan(path: str | Path, stamp: float = 0.0) -> Scan:
    """Read one scan in the frame of its sensor, from any file that `read_cloud` reads or KITTI's ``.bin``.

    Parameters
    ----------
    path : path
        ``.bin`` holds x, y, z and intensity in little-endian single precision, as KITTI's Velodyne scans.
    stamp : float
        Stamp of the scan, seconds.

    Raises
    ------
    TerrainLoopError
        If anything is wrong with the file, which the error names.
    """
    path = as_path(path, "a scan")
    return _read(path, _SCAN_READERS, lambda points, intensity, _: Scan(points, stamp, intensity))


def read_crs(path: str | Path) -> int | str | None:
    """The coordinate reference system stated in a cloud, which only LAS and LAZ files can do.

    Returns
    -------
    int or str or None
        An EPSG code where the file states one, else its WKT; None where it states neither.

    Raises
    ------
    TerrainLoopError
        Naming the file, where it cannot be read.
    """
    path = as_path(path, "a cloud")
    _reader_for(path, _READERS)
    if path.suffix.lower() not in (".las", ".laz"):
        return None
    from terrainloop.io.clouds.las import crs_of

    try:
        return crs_of(path)
    except Exception as error:
        raise _damaged(path, error) from error


def write_cloud(path: str | Path, points: ArrayLike) -> None:
    """Write points (N, 3) as PLY, NPY, NPZ or XYZ, by suffix, completely or not at all.

    PLY is binary little-endian, in single precision unless that would cost a millimetre.

    Raises
    ------
    TerrainLoopError
        If the suffix is another, or the points are not of shape (N, 3).
    OSError
        Naming `path`, where it cannot be written.
    """
    path, points = as_path(path, "a cloud"), as_numbers(points)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise TerrainLoopError(
            expected=f"a path with one of the suffixes {' '.join(_WRITERS)}",
            found=str(path),
            mend="choose one of these formats",
        )
    if points.dtype.kind not in "fiu" or points.ndim != 2 or points.shape[1] != 3:
        raise TerrainLoopError(
            expected="numbers of shape (N, 3), the columns x, y and z in metres",
            found=f"shape {points.shape} of {points.dtype}",
            mend="give one row per point",
        )
    content = writer(points.astype(np.float64))
    write_whole(path, lambda file: file.write(content))


def _read(
    path: Path,
    readers: Mapping[str, Callable[[Path], Table]],
    make: Callable[[NDArray[Any], NDArray[Any] | None, tuple[str, ...]], Cloud],
) -> Cloud:
    """What `make` makes of points, intensity and repairs of a file."""
    reader = _reader_for(path, readers)
    table = Table({})
    try:
        with np.errstate(all="ignore"):  # what overflows becomes infinite, and is dropped as such
            table = reader(path)
            check_points(max(map(len, table.columns.values()), default=0), path.stat().st_size)
            points, intensity = _cloud_of(table.columns)
            for repair in table.repairs:
                logger.warning("%s: %s", path.stem, repair)
            return make(points, intensity, table.repairs)
    except TerrainLoopError as error:
        found = "; ".join([f"{path}: {error.found}", *table.repairs])
        raise TerrainLoopError(expected=error.expected, found=found, mend=error.mend) from error
    except Exception as error:  # what readers raise on damaged files is not documented
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> TerrainLoopError:
    if isinstance(error, OSError) and error.filename is not None:
        return TerrainLoopError(
            expected="a file that can be read",
            found=f"{path}: {error.strerror}",
            mend="check its permissions",
        )
    reason = str(error).strip().partition("\n")[0] or type(error).__name__
    return TerrainLoopError(
        expected=f"a whole {path.suffix} file",
        found=f"{path}: {reason}",
        mend="export it again: it is damaged, truncated or of another format than its suffix indicates",
    )


def _reader_for(path: Path, readers: Mapping[str, Callable[[Path], Table]]) -> Callable[[Path], Table]:
    reader = readers.get(path.suffix.lower())
    regular = os.path.isfile(path)  # noqa: PTH113  Path.is_file raises for names that are too long
    if reader is not None and regular and path.stat().st_size > 0:
        return reader
    found = "no file" if not regular else "an empty file" if reader else "another suffix"
    raise TerrainLoopError(
        expected=f"a cloud with one of the suffixes {' '.join(readers)}",
        found=f"{found} at {path}",
        mend="give the path of a cloud, or export it in one of these formats",
    )


def _cloud_of(columns: Columns) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Points (N, 3) and, where there is one, the intensity."""
    names = [name.lower() for name in columns]
    if any(names.count(axis) != 1 for axis in "xyz"):
        raise TerrainLoopError(
            expected="points with one property each x, y and z",
            found=f"the properties {', '.join(names) or '(none)'}",
            mend="export the coordinates under these names",
        )
    columns = dict(zip(names, columns.values(), strict=True))
    intensity = next((columns[name] for name in INTENSITY if name in columns), None)
    return np.column_stack([columns[axis] for axis in "xyz"]), intensity


def _read_las(path: Path) -> Table:
    from terrainloop.io.clouds.las import read_las  # laspy takes a while to import

    return read_las(path)


def _ply(points: NDArray[np.float64]) -> bytes:
    single = points.astype("<f4")
    kind, body = ("float", single) if np.allclose(single, points, 0, 5e-4) else ("double", points)
    properties = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    return header.encode() + body.astype(body.dtype.newbyteorder("<")).tobytes()


def _saved(save: Callable[[io.BytesIO], object]) -> bytes:
    file = io.BytesIO()
    save(file)
    return file.getvalue()


_READERS: dict[str, Callable[[Path], Table]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
    ".npy": read_npy,
    ".npz": read_npz,
    ".xyz": read_text,
    ".txt": read_text,
    ".csv": read_text,
}
_SCAN_READERS = _READERS | {".bin": read_kitti}
_WRITERS: dict[str, Callable[[NDArray[np.float64]], bytes]] = {
    ".ply": _ply,
    ".npy": lambda points: _saved(lambda file: np.save(file, points)),
    ".npz": lambda points: _saved(lambda file: np.savez(file, points=points)),
    ".xyz": lambda points: _saved(lambda file: np.savetxt(file, points, fmt="%.6f")),
}

CLOUD_SUFFIXES = tuple(_READERS)
"""Suffixes, in lower case, of the files that `read_cloud` reads."""

SCAN_SUFFIXES = tuple(_SCAN_READERS)
"""Suffixes, in lower case, of the files that `read_scan` reads."""
