"""Trajectory errors of a run: of the odometry, of the corrected poses and of the trajectory of all scans."""

import logging
from pathlib import Path

import numpy as np

from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.summary import Evaluation
from terrainloop.evaluation.trajectory_alignment import STAMP_TOLERANCE, Alignment
from terrainloop.evaluation.trajectory_error import Span, TrajectoryError, trajectory_error
from terrainloop.io.submap_poses import check_count
from terrainloop.io.trajectories import Trajectory, read_trajectory

logger = logging.getLogger(__name__)

ODOMETRY, POSES, TRAJECTORY = "odometry.tum", "poses.tum", "trajectory.tum"


def run_trajectory_errors(
    run: Path,
    truth: Path,
    evaluation: Evaluation,
    *,
    align: Alignment = "yaw",
    span: Span | None = None,
    stamp_tolerance: float = STAMP_TOLERANCE,
) -> dict[str, TrajectoryError]:
    """Errors of every trajectory of a run that is found and can be compared; the others are logged.

    `poses.tum` in the folder of the run has the stamps of its submaps. `odometry.tum`, in the folder of the
    run or else beside the truth, has one line per submap, as the truth has, so its stamps are not needed.
    `trajectory.tum` in the folder of the run is compared with the poses of the truth at its stamps.

    Parameters
    ----------
    run, truth : Path
        Folder and ground truth that were evaluated.
    evaluation : Evaluation
    align, stamp_tolerance
        The parameters of `trajectory_error`.
    span : Span, optional
        Separation of the poses of relative errors; by default one submap, and 10 m for `trajectory.tum`.

    Returns
    -------
    dict of str to TrajectoryError
        By name of the file, in the order above.
    """
    errors = {}
    for path in _trajectories_of(run, truth):
        over = Span() if path.name == TRAJECTORY else Span(1, "poses")
        try:
            errors[path.name] = trajectory_error(
                *_with_truth(path, truth, evaluation),
                align=align,
                span=span or over,
                stamp_tolerance=stamp_tolerance,
            )
        except TerrainLoopError as error:
            logger.warning("%s could not be evaluated: %s", path, error)
    return errors


def _trajectories_of(run: Path, truth: Path) -> list[Path]:
    """The files that exist, odometry first."""
    beside = [] if (run / ODOMETRY).exists() else [truth.parent / ODOMETRY]
    return [path for path in (*beside, run / ODOMETRY, run / POSES, run / TRAJECTORY) if path.exists()]


def _with_truth(path: Path, truth: Path, evaluation: Evaluation) -> tuple[Trajectory, Trajectory]:
    """The trajectory of a file, and the true poses to compare it with."""
    estimate = read_trajectory(path)
    if path.name == TRAJECTORY:
        return estimate, read_trajectory(truth)
    records = evaluation.truth.records
    usable = [number for number, record in enumerate(records) if record.status == "ok"]
    stamps = np.array([records[number].stamp for number in usable], dtype=float)
    if path.name == ODOMETRY:
        check_count(estimate, len(records), path)
        estimate = Trajectory(stamps, estimate.poses[usable])
    return estimate, Trajectory(stamps, evaluation.truth.poses[usable])
