"""Which poses of two trajectories belong together, and how one is brought into the world of the other."""

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array, fit_se2, inverse

Alignment = Literal["yaw", "se3", "first", "none"]
Indices = NDArray[np.intp]

STAMP_TOLERANCE = 0.01  # seconds between two poses that are associated

_UNDETERMINED = 1e-10  # squared width over squared length of a path: 1 mm in 100 m


def associate(
    stamps: ArrayLike, others: ArrayLike, tolerance: float = STAMP_TOLERANCE
) -> tuple[Indices, Indices]:
    """Pair the stamps of two trajectories one to one.

    Each stamp of the shorter trajectory is paired with the nearest of the longer one (the earlier of two
    equally near), if that is within the tolerance. Where several claim the same stamp, the nearest keeps it.

    Parameters
    ----------
    stamps, others : array_like, (N,) and (M,)
        Seconds, in any order.
    tolerance : float
        Largest difference, seconds.

    Returns
    -------
    array, (K,), and array, (K,)
        Indices of the pairs into `stamps` and `others`, in the order of time.

    Raises
    ------
    TerrainLoopError
        If the tolerance is negative or not finite, or there is no pair.
    """
    if not 0 <= tolerance < np.inf:
        raise TerrainLoopError(
            expected="a tolerance of the stamps of 0 s or more", found=f"{tolerance}", mend="0.01 s is common"
        )
    a, b = np.asarray(stamps, dtype=float), np.asarray(others, dtype=float)
    if len(a) > len(b):
        of_others, of_stamps = associate(b, a, tolerance)
        return of_stamps, of_others
    claimed = _nearest(a, b) if len(a) else np.empty(0, dtype=np.intp)
    difference = np.abs(a - b[claimed])
    by_difference = np.lexsort((a, difference))
    by_difference = by_difference[difference[by_difference] <= tolerance]
    _, winners = np.unique(claimed[by_difference], return_index=True)
    rows = by_difference[winners]
    if not rows.size:
        raise TerrainLoopError(
            expected=f"stamps of the trajectory and of the ground truth within {tolerance:g} s of each other",
            found=f"{_range_of(a)} and {_range_of(b)}",
            mend="give both in seconds of one clock, or a larger tolerance",
        )
    rows = rows[np.argsort(a[rows], kind="stable")]
    return rows, claimed[rows]


def _nearest(stamps: Array, others: Array) -> Indices:
    """Index of the nearest of `others` (M,) for each of `stamps` (N,); of two equally near, the earlier."""
    order = np.argsort(others, kind="stable")
    later = np.clip(np.searchsorted(others[order], stamps), 1, max(len(others) - 1, 1))
    earlier = later - 1
    later = np.minimum(later, len(others) - 1)
    nearer = stamps - others[order[earlier]] <= others[order[later]] - stamps
    return order[np.where(nearer, earlier, later)]


def _range_of(stamps: Array) -> str:
    return f"{stamps.min():.15g} to {stamps.max():.15g}" if len(stamps) else "no stamps"


def alignment(poses: Array, true_poses: Array, align: Alignment) -> Array:
    """The transform S that brings a trajectory into the world of the ground truth.

    - "se3": the rotation and translation that minimise the sum of squared distances of the positions
      (Umeyama, PAMI 13(4), 1991, without scale).
    - "yaw": the same among rotations about z, which is all that gravity leaves open.
    - "first": Q_0 P_0^-1, so that the first poses agree.
    - "none": the identity.

    Parameters
    ----------
    poses, true_poses : array, (N, 4, 4)
        Associated poses.
    align : {"yaw", "se3", "first", "none"}

    Returns
    -------
    array, (4, 4)
        T_truth_estimate.

    Raises
    ------
    TerrainLoopError
        For another alignment, and where the positions leave the rotation undetermined: fewer than three, or
        in a line, for "se3"; fewer than two, or all in one place, for "yaw".
    """
    if align not in get_args(Alignment):
        raise TerrainLoopError(
            expected=f"an alignment, one of {', '.join(get_args(Alignment))}",
            found=f"{align!r:.60}",
            mend="use 'yaw' where both trajectories are gravity-aligned, else 'se3'",
        )
    if align == "none":
        return np.eye(4)
    if align == "first":
        return true_poses[0] @ inverse(poses[0])
    fit = _fit_se3 if align == "se3" else _fit_yaw
    return fit(poses[:, :3, 3], true_poses[:, :3, 3])


def _fit_se3(source: Array, target: Array) -> Array:
    """Umeyama 1991, eqs. 39-41, without scale: a rotation, even where a reflection would fit better."""
    source_centroid, target_centroid = source.mean(axis=0), target.mean(axis=0)
    U, spread, Vt = np.linalg.svd((target - target_centroid).T @ (source - source_centroid))
    sign = 1.0 if np.linalg.det(U) * np.linalg.det(Vt) > 0 else -1.0
    # Half the gap between the two largest eigenvalues of Horn's quaternion matrix (JOSA A 4(4), 1987).
    _check_determined(spread[1] + sign * spread[2], spread[0], "three or more positions off one line")
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, sign]) @ Vt
    T[:3, 3] = target_centroid - T[:3, :3] @ source_centroid
    return T


def _fit_yaw(source: Array, target: Array) -> Array:
    """Yaw from the horizontal positions, as in `fit_se2`; translation along z from the mean heights."""
    s, t = (points[:, :2] - points[:, :2].mean(axis=0) for points in (source, target))
    cross, dot = (s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0]).sum(), (s * t).sum()
    scale = float(np.linalg.norm(s) * np.linalg.norm(t))
    _check_determined(np.hypot(cross, dot), scale, "two or more positions apart in x and y")
    planar = fit_se2(source[:, :2], target[:, :2])
    T = np.eye(4)
    T[:2, :2], T[:2, 3] = planar[:2, :2], planar[:2, 2]
    T[2, 3] = (target[:, 2] - source[:, 2]).mean()
    return T


def _check_determined(gap: float, scale: float, expected: str) -> None:
    if not gap > _UNDETERMINED * scale:
        raise TerrainLoopError(
            expected=f"{expected}, in both trajectories, to align them",
            found="positions that leave the rotation undetermined",
            mend="align by 'first' or 'none' (or 'yaw', for a straight path)",
        )
