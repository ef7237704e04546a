"""A whole mission at once: maps in parallel processes, then every pair."""

import logging
from collections.abc import Callable, Generator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from terrainloop.config import Settings
from terrainloop.detection.detector import (
    LoopDetector,
    PairSink,
    detrend_submap,
    fit_database,
    map_submap,
    sample_null,
)
from terrainloop.detection.run import Run, RunWriter, Tally
from terrainloop.detection.sensor_pattern import SensorPatterns
from terrainloop.detection.workers import map_in_processes
from terrainloop.entry import MapEntry
from terrainloop.errors import TerrainLoopError, printable
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gp.training import TrainingData
from terrainloop.io.files import as_path
from terrainloop.io.missions import CLOUDS, Mission, load_mission
from terrainloop.loop import LoopCandidate
from terrainloop.matching.mission_null import MissionNull
from terrainloop.matching.mission_warp import with_mission_warp
from terrainloop.record import SubmapRecord
from terrainloop.resources import available_memory, usable_workers
from terrainloop.submap import Submap

logger = logging.getLogger(__name__)

FITTED_SUBMAPS = 3  # spread over the mission, that the hyperparameters of its database are fitted on

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class MappedCloud:
    """A cloud of the mission: its record and, unless it is broken, the submap at rest."""

    record: SubmapRecord
    entry: MapEntry | None

    def __str__(self) -> str:
        if self.entry is None:
            return f"{self.record.name}: left out: {self.record.notes}"
        return self.entry.summary


def detect_mission(
    mission: Mission | Path | str,
    settings: Settings | None = None,
    *,
    output: Path | str | None = None,
    on_pair: PairSink = lambda candidate: None,
    workers: int = 1,
    on_progress: Progress = lambda stage, done, total: None,
) -> Run:
    """Find the loop closures of a mission, leaving out clouds that are broken.

    An interrupt (Ctrl-C) ends the comparison of pairs early; what was found by then is returned and written,
    with ``run.complete`` false. Before the first pair, and whatever else is raised, nothing is written.

    Parameters
    ----------
    mission : Mission or path
        The mission, or its folder.
    settings : Settings, optional
    output : path, optional
        Folder for the results (see `Run.read`), written whole or not at all.
    on_pair : callable
        Called with every LoopCandidate as it is decided, rejected ones too.
    workers : int
        Processes for the maps, threads for the pairs, no more than there are processors; the result does
        not depend on their number.
    on_progress : callable
        Called with (stage, done, total) as the work goes on.

    Returns
    -------
    Run
        With its pairs only where an output is given.

    Raises
    ------
    TerrainLoopError
        If no cloud can be used, or the output is the folder ``clouds`` of the mission.
    OSError
        If the output cannot be written; it names the folder.
    """
    settings, workers = Settings.or_default(settings), usable_workers(workers)
    mission = mission if isinstance(mission, Mission) else load_mission(mission)
    if output is None:
        return _detect(mission, settings, on_pair, workers, on_progress)
    output = as_path(output, "an output folder")
    _check_apart(output, mission)
    with RunWriter.open(output) as writer:

        def keep(candidate: LoopCandidate) -> None:
            writer.add(candidate)
            on_pair(candidate)

        return writer.finish(_detect(mission, settings, keep, workers, on_progress))


def _check_apart(output: Path, mission: Mission) -> None:
    """Refuse the folder ``clouds`` of a mission, in which tables count as clouds."""
    folder = mission.files[0].parent.resolve()
    if folder.name == CLOUDS and output.resolve() == folder:
        raise TerrainLoopError(
            expected="an output folder apart from the clouds",
            found=f"{output}, where tables would be taken for clouds",
            mend="give another folder, such as the mission's",
        )


def _detect(
    mission: Mission, settings: Settings, on_pair: PairSink, workers: int, on_progress: Progress
) -> Run:
    clouds: list[MappedCloud] = []
    with _clouds_not_logged():
        mapping = MissionMapping.of(mission, settings, workers)
        with closing(mapping.clouds(workers)) as mapped:
            for cloud in mapped:
                clouds.append(cloud)
                logger.info("%s", cloud)
                on_progress("maps", len(clouds), len(mission))
    entries = [cloud.entry for cloud in clouds if cloud.entry is not None]
    if not entries:
        raise TerrainLoopError(
            expected=f"at least one usable cloud in {mission.path}",
            found=f"{len(clouds)} broken, the first: {clouds[0].record.notes}",
            mend="correct the clouds or name another folder",
        )
    run = Run(
        settings=settings,
        parameters=mapping.parameters,
        submaps=tuple(cloud.record for cloud in clouds),
        loops=(),
        entries={entry.id: entry for entry in entries},
    )
    return _compare(run, on_pair, workers, on_progress)


def _compare(run: Run, on_pair: PairSink, workers: int, on_progress: Progress) -> Run:
    """The run with its loops, after every submap was compared with the earlier ones."""
    tally = Tally()

    def count(candidate: LoopCandidate) -> None:
        tally.add(candidate)
        on_pair(candidate)

    compared = max(0, len(run.entries) - run.settings.skip_recent)
    entries, patterns, scores = list(run.entries.values()), None, []
    if run.settings.match.decision == "evidence":
        patterns = SensorPatterns(run.settings, entries)
        for words in patterns.warnings:
            logger.warning("%s", words)
        scores = sample_null(
            [patterns.cleaned(entry) for entry in entries],
            run.settings,
            workers=workers,
            on_progress=partial(on_progress, "mirror images"),
        )
        if scores:
            null = MissionNull.of(scores, run.settings.calibration)
            logger.info("%d mirror images compared; %s", len(scores), null)
    detector = LoopDetector(
        run.settings,
        parameters=run.parameters,
        expected_pairs=compared * (compared - 1) // 2,
        null_scores=scores,
        sensor_patterns=patterns,
        on_pair=count,
        workers=workers,
    )
    try:
        with threadpool_limits(1, user_api="blas"):
            for done, entry in enumerate(entries, start=1):
                detector.add_entry(entry)
                on_progress("pairs", done, len(entries))
    except KeyboardInterrupt:
        logger.warning(
            "interrupted after %d of %d submaps: the result holds only the pairs compared by then",
            len(detector.entries),
            len(run.entries),
        )
        run = replace(run, complete=False)
    run = tally.of(run)
    loops = tuple(with_mission_warp(run.loops, run.settings.calibration))
    return replace(run, loops=loops, warnings=detector.warnings).with_corrected_poses()


@contextmanager
def _clouds_not_logged() -> Generator[None, None, None]:
    """What is wrong with clouds is in their records: logged, it would depend on which process reads them."""

    def never(record: logging.LogRecord) -> bool:
        return False

    loggers = [logging.getLogger(part.__module__) for part in (Submap, map_submap)]
    for each in loggers:
        each.addFilter(never)
    try:
        yield
    finally:
        for each in loggers:
            each.removeFilter(never)


@dataclass(frozen=True, eq=False)
class MissionMapping:
    """How the clouds of a mission are mapped.

    Attributes
    ----------
    mission : Mission
    settings : Settings
    parameters : Hyperparameters or None
        Of all maps; None where each cloud has its own.
    prepared : mapping of int to (Submap, TrainingData)
        The clouds that the parameters were fitted on, by index: they are not read again.
    max_memory : float
        Bytes that one map may take.
    """

    mission: Mission
    settings: Settings
    parameters: Hyperparameters | None
    prepared: Mapping[int, tuple[Submap, TrainingData]]
    max_memory: float

    @classmethod
    def of(cls, mission: Mission, settings: Settings, workers: int) -> "MissionMapping":
        """Fit the hyperparameters of a database on a few usable clouds spread over the mission."""
        parameters, prepared = None, {}
        if settings.map.fit == "database" and (prepared := _some_clouds(mission, settings)):
            parameters = fit_database([data for _, data in prepared.values()], settings, workers=workers)
            logger.info(
                "fitted on %s: length scale %.3g m, relief %.3g m, noise %.3g m",
                ", ".join(submap.name for submap, _ in prepared.values()),
                parameters.length_scale,
                parameters.variance**0.5,
                parameters.noise,
            )
        return cls(mission, settings, parameters, prepared, available_memory() / workers)

    def clouds(self, workers: int) -> Generator[MappedCloud, None, None]:
        """Every cloud of the mission in order, mapped in as many processes as there are workers."""
        return map_in_processes(self.cloud, len(self.mission), workers, partial(_killed, self.mission))

    def cloud(self, index: int) -> MappedCloud:
        """A cloud and its map; whatever is wrong with it, the mission goes on without it."""
        mission = self.mission
        try:
            submap, data = self.prepared.get(index) or (mission.read(index), None)
            entry = map_submap(
                submap,
                self.settings,
                self.parameters,
                data=data,
                odometry=None if mission.odometry is None else mission.odometry.poses[index],
                max_memory=self.max_memory,
            )
            return MappedCloud(entry.record, entry)
        except TerrainLoopError as error:
            return _broken(mission, index, str(error))
        except MemoryError:
            return _broken(
                mission, index, "not enough memory for its map: use fewer workers, or cut the cloud"
            )
        except Exception as error:  # not even a fault of ours may end a mission of hours
            return _broken(mission, index, f"a fault of terrainloop, please report it: {error!r:.300}")


def _some_clouds(mission: Mission, settings: Settings) -> dict[int, tuple[Submap, TrainingData]]:
    """A few usable clouds spread over the mission, and what the Gaussian process sees of them."""
    spread = np.linspace(0, len(mission) - 1, FITTED_SUBMAPS + 2).astype(int)[1:-1].tolist()
    clouds: dict[int, tuple[Submap, TrainingData]] = {}
    for index in dict.fromkeys([*spread, *range(len(mission))]):
        if len(clouds) < FITTED_SUBMAPS:
            with suppress(TerrainLoopError):
                submap = mission.read(index)
                clouds[index] = submap, detrend_submap(submap, settings)
    return clouds


def _killed(mission: Mission, index: int) -> MappedCloud:
    return _broken(mission, index, "the process that mapped it was killed, most likely for lack of memory")


def _broken(mission: Mission, index: int, notes: str) -> MappedCloud:
    name, stamp = printable(mission.names[index]), mission.stamp(index)
    return MappedCloud(SubmapRecord(name, stamp, 0, "broken", notes=notes), None)
