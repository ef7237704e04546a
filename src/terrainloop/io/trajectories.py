"""Trajectories: poses with stamps, read from TUM and KITTI files and written as TUM."""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.io.files import as_path, write_whole

Array = NDArray[np.float64]

_TUM, _KITTI = 8, 12  # columns
_LOOSEST = 1e-2  # deviation of a quaternion's norm from 1, or of R R' from I, that rounded digits explain
_FARTHEST = 1e8  # metres; ten times the coordinates of any frame on a planet
_LARGEST_FILE = 256 << 20  # bytes; some two million poses
_LONGEST_LINE = 4096  # characters; twelve numbers and a comment
_LONGEST_QUOTE = 60  # characters of a file that an error quotes


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Poses in the order they were taken.

    Attributes
    ----------
    stamps : array, (N,)
        Seconds, or indices.
    poses : array, (N, 4, 4)
        T_world_frame at each stamp, metres.

    Raises
    ------
    TerrainLoopError
        If the shapes do not fit or a number is not finite.
    """

    stamps: Array
    poses: Array

    def __post_init__(self) -> None:
        stamps, poses = _floating(self.stamps), _floating(self.poses)
        if stamps.ndim != 1 or poses.shape != (len(stamps), 4, 4):
            raise TerrainLoopError(
                expected="stamps of shape (N,) and poses of shape (N, 4, 4)",
                found=f"shapes {stamps.shape} and {poses.shape}",
                mend="give one stamp for each pose",
            )
        if not (np.isfinite(stamps).all() and np.isfinite(poses).all()):
            raise TerrainLoopError(
                expected="finite stamps and poses",
                found="NaN or infinity",
                mend="leave out poses that are not known",
            )
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "poses", poses)

    def __len__(self) -> int:
        return len(self.stamps)

    def __repr__(self) -> str:
        span = f", stamps {self.stamps[0]:.15g} to {self.stamps[-1]:.15g}" if len(self) else ""
        return f"Trajectory({len(self)} poses{span})"


def _floating(values: object) -> Array:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TerrainLoopError(
            expected="arrays of numbers as stamps and poses",
            found=type(values).__name__,
            mend="give stamps of shape (N,) and poses of shape (N, 4, 4)",
        ) from error


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a TUM or a KITTI trajectory, distinguished by the number of columns.

    Parameters
    ----------
    path : path
        Lines ``stamp tx ty tz qx qy qz qw`` (TUM), or the first three rows of the pose matrix in twelve
        numbers (KITTI; the stamps are then the indices). ``#`` starts a comment.

    Raises
    ------
    TerrainLoopError
        Naming the file, the line and the columns expected. Quaternions and rotation matrices are refused
        where their norms are further from one than rounded digits explain.
    """
    path = as_path(path, "a trajectory")
    lines, table = _table(path)
    translations = table[:, 1:4] if table.shape[1] == _TUM else table[:, 3::4]
    far = np.abs(translations).max(axis=1) > _FARTHEST
    _refuse(far, path, lines, f"coordinates in metres, below {_FARTHEST:.0e}")
    if table.shape[1] == _TUM:
        stamps, rotations = table[:, 0], _from_quaternions(table[:, 4:], path, lines)
    else:
        stamps = np.arange(float(len(table)))
        rotations = _from_matrices(table.reshape(-1, 3, 4)[..., :3], path, lines)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations.as_matrix(), translations
    return Trajectory(stamps, poses)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write ``stamp tx ty tz qx qy qz qw`` lines, with every digit; the file is whole or not there."""
    quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat(canonical=True)
    table = np.column_stack([trajectory.stamps, trajectory.poses[:, :3, 3], quaternions])
    text = "".join(" ".join(map(repr, row)) + "\n" for row in table.tolist())
    write_whole(path, lambda file: file.write(text.encode()))


def _from_quaternions(quaternions: Array, path: Path, lines: list[int]) -> Rotation:
    norms = np.linalg.norm(np.clip(quaternions, -2.0, 2.0), axis=1)  # clipped: squares may overflow
    _refuse(np.abs(norms - 1) > _LOOSEST, path, lines, "a quaternion qx qy qz qw of norm 1")
    return Rotation.from_quat(quaternions)


def _from_matrices(matrices: Array, path: Path, lines: list[int]) -> Rotation:
    bounded = np.clip(matrices, -2.0, 2.0)
    skew = np.abs(bounded @ bounded.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2)) > _LOOSEST
    mirrored = np.linalg.det(bounded) < 0
    _refuse(skew | mirrored, path, lines, "a rotation matrix in columns 1-3, 5-7 and 9-11")
    return Rotation.from_matrix(matrices)


def _refuse(bad: NDArray[np.bool_], path: Path, lines: list[int], expected: str) -> None:
    if bad.any():
        raise _bad_line(path, lines[int(np.argmax(bad))], expected, "another one")


def _table(path: Path) -> tuple[list[int], Array]:
    """Line numbers and numbers of all lines that are not comments, all of the same known width."""
    lines, values, width = [], array("d"), 0
    for number, cells in _rows(path):
        width = width or len(cells)
        lines.append(number)
        values.extend(_floats(path, number, cells, width))
    if not lines:
        raise _bad_line(path, 1, _columns_of(None), "no line of numbers")
    return lines, np.array(values).reshape(-1, width)


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Cells of each line that has any, line by line and within bounds: lines of binary data may never end."""
    try:
        if path.exists() and not path.is_file():
            raise OSError("not a regular file")  # a pipe would block
        if path.stat().st_size > _LARGEST_FILE:
            raise OSError(f"{path.stat().st_size >> 20} MiB, more than {_LARGEST_FILE >> 20}")
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE + 1), ""), start=1):
                if len(line) > _LONGEST_LINE:
                    raise OSError(f"line {number} has more than {_LONGEST_LINE} characters")
                if cells := line.partition("#")[0].split():
                    yield number, cells
    except (OSError, UnicodeError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise TerrainLoopError(
            expected="a trajectory in text", found=f"{path}: {reason}", mend="give a TUM or KITTI file"
        ) from error


def _floats(path: Path, number: int, cells: list[str], width: int) -> list[float]:
    known = width in (_TUM, _KITTI)
    if not known or len(cells) != width:
        raise _bad_line(path, number, _columns_of(width if known else None), f"{len(cells)} columns")
    values = [_number(cell) for cell in cells]
    if not np.isfinite(values).all():
        cell = cells[int(np.argmin(np.isfinite(values)))]
        raise _bad_line(path, number, _columns_of(width), repr(cell[:_LONGEST_QUOTE]))
    return values


def _number(cell: str) -> float:
    """A number, or NaN if the cell is not one; Python alone reads 1_5 as 15."""
    try:
        return np.nan if "_" in cell else float(cell)
    except ValueError:
        return np.nan


def _columns_of(width: int | None) -> str:
    tum, kitti = "'stamp tx ty tz qx qy qz qw' (TUM)", "12 numbers of a pose matrix (KITTI)"
    return {_TUM: tum, _KITTI: kitti}.get(width or 0, f"{tum} or {kitti}") + ", all finite"


def _bad_line(path: Path, number: int, expected: str, found: str) -> TerrainLoopError:
    return TerrainLoopError(
        expected=expected, found=f"{found} in {path}, line {number}", mend="correct or remove that line"
    )
