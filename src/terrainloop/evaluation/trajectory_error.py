"""Errors of a trajectory against ground truth: absolute (ATE) and relative (RPE).

The definitions are those of Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems" (IROS 2012),
with the alignments of Zhang and Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation for
Visual(-Inertial) Odometry" (IROS 2018); see docs/evaluation.md.
"""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.trajectory_alignment import (
    STAMP_TOLERANCE,
    Alignment,
    Indices,
    alignment,
    associate,
)
from terrainloop.geometry import MAX_COORDINATE, MAX_SKEW, Array
from terrainloop.io.trajectories import Trajectory

RPE_DISTANCE = 10.0  # metres
SPAN_TOLERANCE = 0.1  # share of that distance by which the path between two poses may deviate from it


@dataclass(frozen=True)
class Span:
    """Separation of the two poses that a relative error compares.

    Attributes
    ----------
    length : float
        Metres along the estimated trajectory, or a whole number of poses.
    unit : {"m", "poses"}

    Raises
    ------
    TerrainLoopError
        If the length is not positive and finite, not whole for poses, or the unit is another one.
    """

    length: float = RPE_DISTANCE
    unit: Literal["m", "poses"] = "m"

    def __post_init__(self) -> None:
        whole = self.unit == "m" or float(self.length).is_integer()  # False for infinity and NaN
        if self.unit not in ("m", "poses") or not 0 < self.length < np.inf or not whole:
            raise TerrainLoopError(
                expected="a positive distance in 'm' or a positive whole number of 'poses'",
                found=f"{self.length!r:.60} {self.unit!s:.60}",
                mend="10 m and 1 pose are common",
            )

    def __str__(self) -> str:
        return "1 pose" if (self.length, self.unit) == (1, "poses") else f"{self.length:g} {self.unit}"


@dataclass(frozen=True)
class Statistics:
    """Root mean square, mean, median and maximum of errors; NaN without any."""

    rms: float
    mean: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: ArrayLike) -> "Statistics":
        """The statistics of errors (N,), in their unit."""
        values = np.asarray(errors, dtype=float)
        if not values.size:
            return cls(np.nan, np.nan, np.nan, np.nan)
        return cls(
            rms=float(np.sqrt(np.mean(values**2))),
            mean=float(values.mean()),
            median=float(np.median(values)),
            max=float(values.max()),
        )


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Magnitudes of error transforms.

    Attributes
    ----------
    translation : array, (N,)
        Metres.
    rotation : array, (N,)
        Angle of the rotation, radians.
    """

    translation: Array
    rotation: Array

    def __len__(self) -> int:
        return len(self.translation)

    def __str__(self) -> str:
        if not len(self):
            return "undefined"
        translation, rotation = self.statistics
        return f"{translation.rms:.3g} m and {rotation.rms:.3g} deg rms"

    @classmethod
    def between(cls, poses: Array, others: Array) -> "PoseErrors":
        """The magnitude of pose^-1 other for each two of (N, 4, 4)."""
        errors = _relative(poses, others)
        rotations = Rotation.from_matrix(errors[:, :3, :3])
        return cls(np.linalg.norm(errors[:, :3, 3], axis=1), np.asarray(rotations.magnitude()))

    @property
    def statistics(self) -> tuple[Statistics, Statistics]:
        """Of the translation in metres, and of the rotation in degrees."""
        return Statistics.of(self.translation), Statistics.of(np.degrees(self.rotation))


@dataclass(frozen=True, eq=False)
class TrajectoryError:
    """Absolute and relative errors of a trajectory.

    Attributes
    ----------
    alignment : {"yaw", "se3", "first", "none"}
    T_truth_estimate : array, (4, 4)
        The alignment: takes the world of the estimate into that of the ground truth.
    stamps : array, (N,)
        Stamps of the associated poses of the estimate, increasing.
    length : float
        Length of the true path through the associated poses, metres.
    absolute : PoseErrors, (N,)
        Of each aligned pose.
    span : Span
    relative : PoseErrors, (P,)
        Of each motion over the span; there may be none.
    """

    alignment: Alignment
    T_truth_estimate: Array
    stamps: Array
    length: float
    absolute: PoseErrors
    span: Span
    relative: PoseErrors

    def __str__(self) -> str:
        return (
            f"ATE {self.absolute} (poses: {len(self.absolute)}, alignment: {self.alignment}); "
            f"RPE over {self.span} {self.relative} (pairs: {len(self.relative)})"
        )

    def as_dict(self) -> dict[str, Any]:
        """Everything that is reported, as in the JSON output; NaN where a number is undefined."""
        ate, ate_rotation = self.absolute.statistics
        rpe, rpe_rotation = self.relative.statistics
        return {
            "poses": len(self.absolute),
            "length_m": self.length,
            "align": self.alignment,
            "ate_m": asdict(ate),
            "ate_deg": asdict(ate_rotation),
            "rpe_delta": self.span.length,
            "rpe_delta_unit": self.span.unit,
            "rpe_pairs": len(self.relative),
            "rpe_m": asdict(rpe),
            "rpe_deg": asdict(rpe_rotation),
        }


def trajectory_error(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    align: Alignment = "yaw",
    span: Span | None = None,
    stamp_tolerance: float = STAMP_TOLERANCE,
) -> TrajectoryError:
    """Absolute and relative errors of a trajectory against ground truth.

    With Q_i the true poses, P_i the associated poses of the estimate and S the alignment, the absolute errors
    are the magnitudes of Q_i^-1 S P_i, and the relative errors those of (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), which
    do not depend on the alignment.

    Parameters
    ----------
    estimate, truth : Trajectory
        T_world_frame of one frame, each in its own world, with stamps of one clock.
    align : {"yaw", "se3", "first", "none"}
        See `alignment`.
    span : Span, optional
        Separation of the poses i and j; by default 10 m.
    stamp_tolerance : float
        Seconds between two poses that are associated, see `associate`.

    Raises
    ------
    TerrainLoopError
        If a pose is not a rigid transform, no stamps agree, or the alignment is undetermined.
    """
    span = span or Span()
    _check_rigid(estimate, "the trajectory")
    _check_rigid(truth, "the ground truth")
    rows, true_rows = associate(estimate.stamps, truth.stamps, stamp_tolerance)
    poses, true_poses = estimate.poses[rows], truth.poses[true_rows]
    T_truth_estimate = alignment(poses, true_poses, align)
    first, second = span_pairs(poses[:, :3, 3], span)
    return TrajectoryError(
        alignment=align,
        T_truth_estimate=T_truth_estimate,
        stamps=estimate.stamps[rows],
        length=float(_travelled(true_poses[:, :3, 3])[-1]),
        absolute=PoseErrors.between(true_poses, T_truth_estimate @ poses),
        span=span,
        relative=PoseErrors.between(
            _relative(true_poses[first], true_poses[second]), _relative(poses[first], poses[second])
        ),
    )


def span_pairs(positions: Array, span: Span) -> tuple[Indices, Indices]:
    """All pairs of poses that a span separates.

    Over a distance, each pose is paired with the later one for which the length of the path between them is
    closest to that distance, unless it deviates by more than a tenth. These are the pairs of
    ``evo_rpe --delta_unit m --all_pairs``.

    Parameters
    ----------
    positions : array, (N, 3)
        Metres, in the order of time.
    span : Span

    Returns
    -------
    array, (P,), and array, (P,)
        Indices of the first and the second pose of each pair.
    """
    first = np.arange(len(positions), dtype=np.intp)
    if span.unit == "poses":
        first = first[: max(len(positions) - int(span.length), 0)]
        return first, first + int(span.length)
    travelled = _travelled(positions)
    first = first[:-1]
    beyond = np.clip(np.searchsorted(travelled, travelled[:-1] + span.length), first + 1, len(positions) - 1)
    # Of poses in one place, the earliest.
    before = np.maximum(np.searchsorted(travelled, travelled[np.maximum(beyond - 1, 0)]), first + 1)
    deviation, deviation_before = (
        np.abs(travelled[second] - travelled[first] - span.length) for second in (beyond, before)
    )
    second = np.where(deviation_before <= deviation, before, beyond)
    kept = np.minimum(deviation, deviation_before) <= SPAN_TOLERANCE * span.length
    return first[kept], second[kept]


def _travelled(positions: Array) -> Array:
    """Length of the path (N,) from the first of positions (N, 3) to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def _relative(poses: Array, others: Array) -> Array:
    """The transforms pose^-1 other (N, 4, 4)."""
    R_inverse = poses[:, :3, :3].swapaxes(1, 2)
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3] = R_inverse @ others[:, :3, :3]
    T[:, :3, 3:] = R_inverse @ (others[:, :3, 3:] - poses[:, :3, 3:])
    return T


def _check_rigid(trajectory: Trajectory, name: str) -> None:
    """`geometry.is_rigid` for all poses at once."""
    bounded = np.clip(trajectory.poses, -MAX_COORDINATE, MAX_COORDINATE)
    R = bounded[:, :3, :3]
    skew = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    affine = (trajectory.poses[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(axis=1)
    rigid = (
        (skew <= MAX_SKEW) & (np.linalg.det(R) > 0) & affine & (bounded == trajectory.poses).all(axis=(1, 2))
    )
    if not rigid.all():
        raise TerrainLoopError(
            expected=f"rigid transforms with coordinates below {MAX_COORDINATE:.0e} m as poses of {name}",
            found=f"another matrix at pose {int(np.argmin(rigid)) + 1}",
            mend="give rotation matrices of determinant 1, and metres",
        )
