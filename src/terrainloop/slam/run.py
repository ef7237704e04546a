"""A whole recording: from posed scans to a folder with a corrected trajectory and a map."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from terrainloop.config import Settings
from terrainloop.detection.detector import PairSink
from terrainloop.detection.mission import Progress
from terrainloop.detection.run import Run, RunWriter, Tally
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array, transform
from terrainloop.io.clouds import write_cloud
from terrainloop.io.files import as_path
from terrainloop.io.trajectories import Trajectory, write_tum
from terrainloop.loop import LoopCandidate
from terrainloop.matching.mission_warp import with_mission_warp
from terrainloop.resources import usable_workers
from terrainloop.scan import PosedScan
from terrainloop.slam.mapper import Mapper
from terrainloop.slam.mosaic import Mosaic, mosaic
from terrainloop.slam.submapping import PosedSubmap, Submapper

logger = logging.getLogger(__name__)

TRAJECTORY, UNCORRECTED, MAP_CLOUD, MAP_RASTER = "trajectory.tum", "uncorrected.tum", "map.ply", "map.tif"
PRODUCTS = (TRAJECTORY, UNCORRECTED, MAP_CLOUD, MAP_RASTER)
"""Files of SLAM beside those of every run."""


@dataclass(frozen=True, eq=False, repr=False)
class SlamRun:
    """What SLAM made of a recording.

    Attributes
    ----------
    run : Run
        Submaps, loop closures and corrected poses of the submaps.
    odometry, trajectory : Trajectory
        Pose of the sensor at every scan, as recorded and corrected.
    submaps : tuple of PosedSubmap
    """

    run: Run
    odometry: Trajectory
    trajectory: Trajectory
    submaps: tuple[PosedSubmap, ...]

    def __repr__(self) -> str:
        return (
            f"SlamRun({len(self.trajectory)} scans, {len(self.submaps)} submaps, {len(self.run.loops)} loops)"
        )

    @property
    def poses(self) -> Array:
        """T_world_submap (M, 4, 4), corrected."""
        corrected = self.run.corrected
        if corrected is None:
            return np.array([posed.T_world_submap for posed in self.submaps]).reshape(-1, 4, 4)
        return corrected.poses

    @property
    def largest_correction(self) -> float:
        """By how much the loops moved the trajectory at most, metres."""
        moved = self.trajectory.poses[:, :3, 3] - self.odometry.poses[:, :3, 3]
        return float(np.linalg.norm(moved, axis=1).max(initial=0.0))

    @property
    def points(self) -> Array:
        """Points (N, 3) of all submaps in the world."""
        moved = [transform(T, posed.submap.points) for T, posed in zip(self.poses, self.submaps, strict=True)]
        return np.concatenate([np.empty((0, 3)), *moved])

    @property
    def mosaic(self) -> Mosaic:
        """Elevation and gradient of all submaps in the world."""
        return mosaic([entry.gradient_map for entry in self.run.entries.values()], self.poses)


def run_slam(
    scans: Iterable[PosedScan],
    settings: Settings | None = None,
    *,
    submapper: Submapper | None = None,
    output: Path | str | None = None,
    on_pair: PairSink = lambda candidate: None,
    workers: int = 1,
    on_progress: Progress = lambda stage, done, total: None,
    count: int = 0,
) -> SlamRun:
    """Correct the trajectory of a recording by the loop closures that its scans show.

    An interrupt (Ctrl-C) ends the recording early; the result holds what was found by then.

    Parameters
    ----------
    scans : iterable of PosedScan
        In the order of their stamps, as ``open_recording(path).scans()`` gives them.
    settings : Settings, optional
    submapper : Submapper, optional
        How scans are joined into submaps.
    output : path, optional
        Folder for the results, written whole or not at all.
    on_pair : callable
        Called with every LoopCandidate as it is decided, rejected ones too.
    workers : int
        Threads; the result does not depend on their number.
    on_progress : callable
        Called with (stage, done, total) as the work goes on.
    count : int
        Number of scans, for the progress.

    Raises
    ------
    TerrainLoopError
        If no submap can be made of the scans.
    OSError
        If the output cannot be written; it names the folder.
    """
    settings, workers = Settings.or_default(settings), usable_workers(workers)

    def mapped(keep: PairSink) -> SlamRun:
        return _mapped(scans, settings, submapper, keep, workers, on_progress, count)

    if output is None:
        return mapped(on_pair)
    with RunWriter.open(as_path(output, "an output folder")) as writer:

        def keep(candidate: LoopCandidate) -> None:
            writer.add(candidate)
            on_pair(candidate)

        result = mapped(keep)
        products = {
            TRAJECTORY: lambda path: write_tum(path, result.trajectory),
            UNCORRECTED: lambda path: write_tum(path, result.odometry),
            MAP_CLOUD: lambda path: write_cloud(path, result.points),
            MAP_RASTER: lambda path: result.mosaic.write(path),
        }
        run = writer.finish(result.run, products)
        return SlamRun(run, result.odometry, result.trajectory, result.submaps)


def _mapped(
    scans: Iterable[PosedScan],
    settings: Settings,
    submapper: Submapper | None,
    on_pair: Callable[[LoopCandidate], object],
    workers: int,
    on_progress: Progress,
    count: int,
) -> SlamRun:
    tally = Tally()

    def keep(candidate: LoopCandidate) -> None:
        tally.add(candidate)
        on_pair(candidate)

    mapper = Mapper(settings, submapper=submapper, on_pair=keep, workers=workers)
    complete = True
    try:
        for done, posed in enumerate(scans, start=1):
            mapper.add_posed(posed)
            on_progress("scans", done, max(count, done))
    except KeyboardInterrupt:
        logger.warning("interrupted: the result holds what was found by then")
        complete = False
    mapper.finish()
    if not mapper.submaps:
        raise TerrainLoopError(
            expected="scans of which a submap can be made",
            found=f"{len(mapper.odometry)} scans without one",
            mend="check that they show ground within a few metres, and that the pose moves",
        )
    run = Run(
        settings=settings,
        parameters=mapper.detector.parameters,
        submaps=tuple(mapper.records),
        loops=(),
        complete=complete,
        warnings=mapper.detector.warnings,
        entries=mapper.detector.entries,
    )
    run = tally.of(run)
    loops = with_mission_warp(run.loops, settings.calibration)
    run = replace(run, loops=tuple(loops)).with_corrected_poses()
    trajectory = mapper.odometry if run.corrected is None else mapper.corrected(run.corrected)
    return SlamRun(run, mapper.odometry, trajectory, tuple(mapper.submaps))
