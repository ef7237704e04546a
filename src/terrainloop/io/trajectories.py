"""Trajectories: poses with stamps, read from TUM and KITTI files and written as TUM."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError

Array = NDArray[np.float64]

_TUM, _KITTI = 8, 12  # columns
_SHORTEST = 1e-6  # norm of a quaternion that still has a direction
_LOOSEST = 1e-2  # largest entry of R R' - I that rounded digits explain


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses in the order they were taken.

    Attributes
    ----------
    stamps : array, (N,)
        Seconds, or indices.
    poses : array, (N, 4, 4)
        T_world_frame of each, metres.
    """

    stamps: Array
    poses: Array

    def __post_init__(self) -> None:
        stamps, poses = np.asarray(self.stamps, dtype=float), np.asarray(self.poses, dtype=float)
        if stamps.ndim != 1 or poses.shape != (len(stamps), 4, 4):
            raise TerrainLoopError(
                expected="stamps of shape (N,) and poses of shape (N, 4, 4)",
                found=f"shapes {stamps.shape} and {poses.shape}",
                mend="give one stamp a pose",
            )
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "poses", poses)

    def __len__(self) -> int:
        return len(self.stamps)


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a TUM or a KITTI trajectory, told apart by the number of columns.

    Parameters
    ----------
    path : path
        Lines ``stamp tx ty tz qx qy qz qw`` (TUM), or the first three rows of the pose matrix in twelve
        numbers (KITTI; the stamps are then the indices). ``#`` starts a comment.

    Raises
    ------
    TerrainLoopError
        Naming the file, the line and the columns expected.
    """
    path = Path(path)
    numbers, rows = _numbered_rows(path)
    table = np.array(rows)
    if table.shape[1] == _TUM:
        stamps, translations, quaternions = table[:, 0], table[:, 1:4], table[:, 4:]
        zero = np.linalg.norm(quaternions, axis=1) < _SHORTEST
        _refuse(zero, path, numbers, "a quaternion qx qy qz qw that is not zero")
        rotations = Rotation.from_quat(quaternions)
    else:
        matrices = table.reshape(-1, 3, 4)
        stamps, translations, axes = np.arange(float(len(table))), matrices[..., 3], matrices[..., :3]
        skew = np.abs(axes @ axes.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2)) > _LOOSEST
        mirrored = np.linalg.det(axes) < 0
        _refuse(skew | mirrored, path, numbers, "a rotation matrix in columns 1-3, 5-7 and 9-11")
        rotations = Rotation.from_matrix(axes)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations.as_matrix(), translations
    return Trajectory(stamps, poses)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write ``stamp tx ty tz qx qy qz qw`` lines, with all the digits there are."""
    quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat(canonical=True)
    table = np.column_stack([trajectory.stamps, trajectory.poses[:, :3, 3], quaternions])
    lines = [" ".join(map(repr, row)) + "\n" for row in table.tolist()]
    Path(path).write_text("".join(lines), encoding="utf-8")


def _refuse(bad: NDArray[np.bool_], path: Path, numbers: list[int], expected: str) -> None:
    if bad.any():
        raise _bad_line(path, numbers[int(np.argmax(bad))], expected, "none")


def _numbered_rows(path: Path) -> tuple[list[int], list[list[float]]]:
    """Line numbers and numbers of all lines that are not comments, all of the same known width."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TerrainLoopError(
            expected="a trajectory in text", found=f"{path}: {error}", mend="give a TUM or KITTI file"
        ) from error
    cells = {number: line.partition("#")[0].split() for number, line in enumerate(lines, start=1)}
    rows = {number: row for number, row in cells.items() if row}
    if not rows:
        raise _bad_line(path, 1, _columns_of(None), "no line of numbers")
    width = len(next(iter(rows.values())))
    return list(rows), [_floats(path, number, row, width) for number, row in rows.items()]


def _floats(path: Path, number: int, cells: list[str], width: int) -> list[float]:
    known = width in (_TUM, _KITTI)
    if not known or len(cells) != width:
        raise _bad_line(path, number, _columns_of(width if known else None), f"{len(cells)} columns")
    try:
        values = [float(cell) for cell in cells]
    except ValueError as error:
        raise _bad_line(path, number, _columns_of(width), str(error)) from error
    if not np.isfinite(values).all():
        raise _bad_line(path, number, _columns_of(width), " ".join(cells))
    return values


def _columns_of(width: int | None) -> str:
    tum, kitti = "'stamp tx ty tz qx qy qz qw' (TUM)", "12 numbers of a pose matrix (KITTI)"
    return {_TUM: tum, _KITTI: kitti}.get(width or 0, f"{tum} or {kitti}") + ", all finite"


def _bad_line(path: Path, number: int, expected: str, found: str) -> TerrainLoopError:
    return TerrainLoopError(
        expected=expected, found=f"{found} in {path}, line {number}", mend="correct or remove that line"
    )
