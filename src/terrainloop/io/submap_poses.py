"""Poses of submaps: one for each cloud in the order of their names, in frames that are gravity-aligned."""

import logging
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse
from terrainloop.io.ordering import order_of_names
from terrainloop.io.trajectories import Trajectory, read_trajectory

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

TILTED = np.radians(30.0)
"""No frame is gravity-aligned beyond this tilt: inertial sensors know gravity to a degree or two."""

_DOUBTFUL = np.radians(10.0)  # reported, not refused
_EXPLAINED = np.radians(5.0)  # refused where the quaternions with w first are upright to a tenth of that
_SAME = 0.3  # share of a step by which odometry and truth may differ, drift included
_DIFFERENT = 0.5  # share of a step that neither drift nor slip explains
_LONGER = 2.0  # path length over that of the inverse poses at which one suspects them to be inverse
_FEWEST = 4  # poses from which a path is judged


def read_submap_poses(path: str | Path, names: Sequence[str]) -> Trajectory:
    """Read the poses T_world_submap of submaps and check them against the conventions.

    Parameters
    ----------
    path : path
        As `read_trajectory` reads it, one pose for each submap.
    names : sequence of str, (N,)
        Of the submaps, in the order of the poses.

    Raises
    ------
    TerrainLoopError
        If the number of poses differs from that of the names, the order is ambiguous (see
        `order_of_names`), or the frames are not gravity-aligned (see `check_upright`).
    """
    trajectory = read_trajectory(path)
    check_count(trajectory, len(names), path)
    order = order_of_names(names, [trajectory.stamps])
    if order != list(range(len(names))):
        at = next(i for i, j in enumerate(order) if i != j)
        raise TerrainLoopError(
            expected=f"poses in the order of the submaps in {path}",
            found=f"the stamp of {names[order[at]]!r} where {names[at]!r} is due",
            mend="give one pose for each submap, in their order",
        )
    check_upright(trajectory, path)
    return trajectory


def check_count(trajectory: Trajectory, count: int, path: str | Path) -> None:
    """Refuse more or fewer poses than clouds."""
    if len(trajectory) != count:
        raise TerrainLoopError(
            expected=f"{count} poses, one for each cloud",
            found=f"{len(trajectory)} in {path}",
            mend="give one line for each cloud, in the order of the file names",
        )


def check_upright(trajectory: Trajectory, path: str | Path) -> None:
    """Refuse poses whose frames are not gravity-aligned, naming the likely cause.

    A frame is tilted by the angle between its z axis and that of the world. More than 30 degrees are refused:
    no error of an inertial sensor reaches that. From 5 degrees on they are refused if the same quaternions
    read with w first are upright within a tenth of it. More than 10 degrees are reported otherwise.

    Raises
    ------
    TerrainLoopError
    """
    rotations = trajectory.poses[:, :3, :3]
    tilts = _tilts(rotations)
    worst = float(tilts.max(initial=0.0))
    x, y, z, w = Rotation.from_matrix(rotations).as_quat().T
    w_first = float(_tilts(Rotation.from_quat(np.stack([y, z, w, x], axis=-1)).as_matrix()).max(initial=0.0))
    explained = worst > _EXPLAINED and w_first < worst / 10
    if worst > TILTED or explained:
        cause, mend = ("quaternions with w first", "write qx qy qz qw") if explained else _cause(rotations)
        raise TerrainLoopError(
            expected="poses of gravity-aligned submap frames, z up",
            found=f"a tilt of {np.degrees(worst):.0f} deg at pose {int(np.argmax(tilts)) + 1} in {path}, "
            f"most likely {cause}",
            mend=mend,
        )
    if worst > _DOUBTFUL:
        logger.warning(
            "%s: frames are tilted by up to %.0f deg, but submap frames are gravity-aligned by contract",
            path,
            np.degrees(worst),
        )


def check_consistent(trajectory: Trajectory, other: Trajectory | None, path: str | Path) -> None:
    """Look for inverse poses, T_submap_world: they are as upright as the poses themselves.

    Where another trajectory of the same submaps is known, inverse poses are those whose inverses alone move
    as the other one does, and are refused; trajectories that move in different ways are reported.
    Otherwise the path is measured: the origin of the world, as seen from a rover that drives and turns,
    travels further than the rover. That is reported only, for a rover that circles the origin of the world
    is an exception; straight drives show nothing.

    Raises
    ------
    TerrainLoopError
    """
    if len(trajectory) < _FEWEST:
        return
    inverted = np.array([inverse(pose) for pose in trajectory.poses])
    if other is not None:
        as_given, as_inverse = (_disagreement(poses, other.poses) for poses in (trajectory.poses, inverted))
        if as_inverse < _SAME < as_given:
            raise TerrainLoopError(
                expected="poses T_world_submap",
                found=f"inverse poses, T_submap_world, in {path} or in the other trajectory of the mission: "
                "only inverted do the two agree",
                mend="invert the poses of that file",
            )
        if as_given > _DIFFERENT:
            logger.warning(
                "%s: its steps and those of the other trajectory differ by %.0f %% in the median: "
                "are both in the order of the clouds, in metres and of the same frames?",
                path,
                100 * as_given,
            )
    length, length_inverted = _length(trajectory.poses), _length(inverted)
    if length > _LONGER * length_inverted:
        logger.warning(
            "%s: the path of these poses is %.0f m long, that of their inverses %.0f m: "
            "are they T_submap_world instead of T_world_submap?",
            path,
            length,
            length_inverted,
        )


def _tilts(rotations: Array) -> Array:
    """Angle of each z axis to the vertical, radians; accurate for small ones."""
    return np.asarray(np.arctan2(np.hypot(rotations[:, 0, 2], rotations[:, 1, 2]), rotations[:, 2, 2]))


def _cause(rotations: Array) -> tuple[str, str]:
    """Which convention the most tilted poses follow, and what to do about it."""
    straight = np.cos(TILTED)
    if np.median(rotations[:, 2, 2]) < -straight:
        return "frames with z down (NED)", "rotate the frames by 180 deg about x"
    if np.median(rotations[:, 2, 1]) < -straight:
        return "camera frames (z forward, y down)", "give the poses of the clouds' frames, z up"
    if np.median(rotations[:, 1, 1]) > straight and rotations[:, 2, 2].max() > np.cos(_DOUBTFUL):
        return "a world whose y axis is vertical (KITTI cameras)", "rotate the world so that z is up"
    return "sensor poses instead of those of the clouds' frames", "give the poses of frames with z up"


def _disagreement(poses: Array, others: Array) -> float:
    """Median difference of the steps of two trajectories, as a share of the longer step."""
    steps, other = (np.array([(inverse(a) @ b)[:3, 3] for a, b in pairwise(p)]) for p in (poses, others))
    longer = np.maximum(np.linalg.norm(steps, axis=1), np.linalg.norm(other, axis=1))
    return float(np.median(np.linalg.norm(steps - other, axis=1) / np.maximum(longer, 1e-9)))


def _length(poses: Array) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum())
