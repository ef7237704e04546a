"""The mapper: scans in as they come; submaps, loop closures and a corrected trajectory out."""

import logging
from collections.abc import Callable

import numpy as np

from terrainloop.config import Settings
from terrainloop.detection.detector import LoopDetector, fit_database, map_submap
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array, exp_se3, inverse, log_se3
from terrainloop.io.trajectories import Trajectory
from terrainloop.loop import LoopCandidate
from terrainloop.matching.mission_warp import with_mission_warp
from terrainloop.pose_graph import PoseGraph, Solution, require_gtsam
from terrainloop.record import SubmapRecord
from terrainloop.scan import PosedScan, Scan
from terrainloop.slam.second_look import second_look
from terrainloop.slam.submapping import PosedSubmap, Submapper

logger = logging.getLogger(__name__)

FITTED_SUBMAPS = 3  # first submaps, that the hyperparameters of all maps are fitted on
FIRST_LOOK = 0.5  # share of max_false_loops
SECOND_LOOKS = (0.3, 0.15, 0.05)  # shares of the looks that follow


class Mapper:
    """Submap SLAM: joins scans into submaps, finds loops among them, corrects the trajectory.

    Parameters
    ----------
    settings : Settings, optional
    submapper : Submapper, optional
        How scans are joined; by default as far as the sensor sees.
    on_pair : callable, optional
        Called with every LoopCandidate as it is decided, rejected ones too.
    workers : int
        Threads; the result does not depend on their number.

    Attributes
    ----------
    detector : LoopDetector
        With the maps of all submaps.
    submaps : list of PosedSubmap
        In order; their points are those of `map.ply`.
    solution : Solution or None
        The pose graph since the last loop; None before the first.
    settings : Settings
        Half of `max_false_loops` is for the first look, which the detector takes, half for those that follow.

    Examples
    --------
    >>> mapper = Mapper()
    >>> for posed in recording.scans():  # doctest: +SKIP
    ...     for loop in mapper.add(posed.scan, posed.T_world_sensor):
    ...         print(loop.source, loop.target, mapper.trajectory.poses[-1])
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        submapper: Submapper | None = None,
        on_pair: Callable[[LoopCandidate], object] = lambda candidate: None,
        workers: int = 1,
    ) -> None:
        require_gtsam()
        self.settings = Settings.or_default(settings)
        allowed = FIRST_LOOK * self.settings.match.max_false_loops
        self.detector = LoopDetector(self.settings, max_false_loops=allowed, on_pair=on_pair, workers=workers)
        self._on_pair = on_pair
        self.submaps: list[PosedSubmap] = []
        self.records: list[SubmapRecord] = []
        self.solution: Solution | None = None
        self._submapper = submapper or Submapper(seed=self.settings.seed)
        self._waiting: list[PosedSubmap] = []
        self._stamps: list[float] = []
        self._poses: list[Array] = []

    def __repr__(self) -> str:
        return (
            f"Mapper({len(self._poses)} scans, {len(self.records)} submaps, {len(self.detector.loops)} loops)"
        )

    def add(self, scan: Scan, T_world_sensor: Array) -> list[LoopCandidate]:
        """Take another scan, with the pose of the sensor by odometry.

        Parameters
        ----------
        scan : Scan
            Stamped later than the one before.
        T_world_sensor : array, (4, 4)
            By odometry, in a world with z up.

        Returns
        -------
        list of LoopCandidate
            The accepted loops of a submap that this scan completes.

        Raises
        ------
        TerrainLoopError
            If the pose is not rigid, or the scan is older than the one before; the mapper is then as it was.
        """
        return self.add_posed(PosedScan(scan, T_world_sensor))

    def add_posed(self, posed: PosedScan) -> list[LoopCandidate]:
        """As `add`."""
        scan = posed.scan
        if self._stamps and not scan.stamp > self._stamps[-1]:
            raise TerrainLoopError(
                expected=f"a scan that is later than the one before, at {self._stamps[-1]:.6f} s",
                found=f"one of {scan.stamp:.6f} s",
                mend="give scans in the order of their stamps",
            )
        self._stamps.append(scan.stamp)
        self._poses.append(posed.T_world_sensor)
        return self._add(self._submapper.add(posed))

    def finish(self) -> list[LoopCandidate]:
        """The loops of what is left at the end of a drive, and those of a second look at all pairs."""
        loops = self._add(self._submapper.finish()) + self._map_waiting()
        return loops + self._look_again()

    @property
    def odometry(self) -> Trajectory:
        """Pose of the sensor at every scan, by odometry."""
        return Trajectory(np.array(self._stamps), np.array(self._poses).reshape(-1, 4, 4))

    @property
    def trajectory(self) -> Trajectory:
        """Pose of the sensor at every scan, corrected by the loops so far."""
        return self.odometry if self.solution is None else self.corrected(self.solution)

    def corrected(self, solution: Solution) -> Trajectory:
        """Pose of the sensor at every scan, moved as a pose graph moved the submaps before and after it."""
        odometry, graph = self.odometry, solution.graph
        poses = _corrected(odometry, graph.stamps, graph.odometry, solution.poses)
        return Trajectory(odometry.stamps, poses)

    def _add(self, finished: PosedSubmap | None) -> list[LoopCandidate]:
        if finished is None:
            return []
        self._waiting.append(finished)
        known = self.detector.parameters is not None or self.detector.settings.map.fit != "database"
        return self._map_waiting() if known or len(self._waiting) == FITTED_SUBMAPS else []

    def _map_waiting(self) -> list[LoopCandidate]:
        """Map the submaps that wait, the first ones with hyperparameters fitted to them; find their loops."""
        detector, waiting, loops = self.detector, self._waiting, []
        self._waiting = []
        if waiting and detector.parameters is None and detector.settings.map.fit == "database":
            clouds = [posed.submap for posed in waiting]
            detector.parameters = fit_database(clouds, detector.settings, workers=detector.workers)
        for posed in waiting:
            try:
                entry = map_submap(
                    posed.submap,
                    detector.settings,
                    detector.parameters,
                    odometry=posed.T_world_submap,
                    workers=detector.workers,
                )
            except TerrainLoopError as error:
                logger.warning("%s is left out: %s", posed.submap.name, error)
                continue
            self.submaps.append(posed)
            self.records.append(entry.record)
            loops += detector.add_entry(entry)
        if loops:
            self._solve()
        return loops

    def _look_again(self) -> list[LoopCandidate]:
        """Loops that the corrected trajectory makes plausible, until there are no more."""
        detector, settings, added = self.detector, self.settings, []
        if settings.match.decision != "evidence":
            return []
        for share in SECOND_LOOKS:
            if self.solution is None:
                break
            candidates = second_look(detector.cleaned, self.solution, settings, share)
            for candidate in candidates:
                self._on_pair(candidate)
            loops = [candidate for candidate in candidates if candidate]
            if not loops:
                break
            detector.loops += loops
            added += loops
            self._solve()
        return added

    def _solve(self) -> None:
        loops = with_mission_warp(self.detector.loops, self.detector.settings.calibration)
        self.solution = PoseGraph.of(self.records, loops).solve()


def _corrected(odometry: Trajectory, stamps: Array, before: Array, after: Array) -> Array:
    """Poses (N, 4, 4) of odometry, moved as the submaps before and after each were.

    Parameters
    ----------
    odometry : Trajectory
        N poses.
    stamps : array, (M,)
        Of the submaps.
    before, after : array, (M, 4, 4)
        Poses of the submaps by odometry and corrected.
    """
    corrections = after @ np.linalg.inv(before)
    second = np.clip(np.searchsorted(stamps, odometry.stamps), 1, max(len(stamps) - 1, 1))
    first = second - 1
    second = np.minimum(second, len(stamps) - 1)
    span = np.maximum(stamps[second] - stamps[first], 1e-9)
    share = np.clip((odometry.stamps - stamps[first]) / span, 0.0, 1.0)
    a, b = corrections[first] @ odometry.poses, corrections[second] @ odometry.poses
    steps = zip(a, b, share, strict=True)
    return np.array([A @ exp_se3(w * log_se3(inverse(A) @ B)) for A, B, w in steps]).reshape(-1, 4, 4)
