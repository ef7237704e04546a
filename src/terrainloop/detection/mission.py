"""A whole mission at once: maps in parallel processes, then every pair."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
from threadpoolctl import threadpool_limits

from terrainloop.config import Settings
from terrainloop.detection.detector import LoopDetector, fit_database, map_submap
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.io.missions import Mission
from terrainloop.io.results import SubmapRecord, submap_record
from terrainloop.matching.mapped import MappedSubmap
from terrainloop.submap import Submap

FITTED_SUBMAPS = 3  # the database's hyperparameters are fitted on, spread over the mission


@dataclass(frozen=True, eq=False)
class MappedCloud:
    """A cloud of the mission: its record and, unless it is broken, its map."""

    record: SubmapRecord
    mapped: MappedSubmap | None


def detect_mission(
    mission: Mission,
    settings: Settings,
    *,
    workers: int = 1,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> tuple[LoopDetector, list[SubmapRecord]]:
    """Run the detector over a mission, leaving out clouds that are broken.

    Parameters
    ----------
    mission : Mission
    settings : Settings
    workers : int
        Processes for the maps, threads for the pairs; the result does not depend on it.
    on_progress : callable
        Told (stage, done, total) as the work goes on.

    Returns
    -------
    detector : LoopDetector
        With every pair in ``.candidates``.
    records : list of SubmapRecord
        One for every cloud, broken ones too.

    Raises
    ------
    TerrainLoopError
        If no cloud can be used.
    """
    parameters = _fit_mission(mission, settings, workers) if settings.map.fit == "database" else None
    clouds: list[MappedCloud] = []
    for cloud in _map_clouds(mission, settings, parameters, workers):
        clouds.append(cloud)
        on_progress("maps", len(clouds), len(mission))
    usable = [cloud.mapped for cloud in clouds if cloud.mapped is not None]
    if not usable:
        raise TerrainLoopError(
            expected=f"at least one usable cloud in {mission.path}",
            found=f"{len(clouds)} broken, the first: {clouds[0].record.notes}",
            mend="mend the clouds or name another folder",
        )
    compared = max(0, len(usable) - settings.skip_recent)
    expected_pairs = compared * (compared - 1) // 2
    detector = LoopDetector(settings, parameters=parameters, expected_pairs=expected_pairs, workers=workers)
    with threadpool_limits(1, user_api="blas"):
        for done, mapped in enumerate(usable, start=1):
            detector.add_mapped(mapped)
            on_progress("pairs", done, len(usable))
    return detector, [cloud.record for cloud in clouds]


def _fit_mission(mission: Mission, settings: Settings, workers: int) -> Hyperparameters | None:
    """Hyperparameters of a few usable submaps spread over the mission; None if none is usable."""
    spread = np.linspace(0, len(mission) - 1, FITTED_SUBMAPS + 2).astype(int)[1:-1].tolist()
    submaps: list[Submap] = []
    for index in dict.fromkeys([*spread, *range(len(mission))]):
        if len(submaps) < FITTED_SUBMAPS:
            with suppress(TerrainLoopError):
                submaps.append(mission.read(index))
    return fit_database(submaps, settings, workers=workers) if submaps else None


def _map_clouds(
    mission: Mission, settings: Settings, parameters: Hyperparameters | None, workers: int
) -> Iterator[MappedCloud]:
    """Every cloud of the mission in order, mapped in as many processes as there are workers."""
    work = partial(_map_cloud, mission, settings, parameters)
    if workers == 1:
        with threadpool_limits(1, user_api="blas"):
            yield from map(work, range(len(mission)))
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_start_worker) as pool:
        yield from pool.map(work, range(len(mission)))


def _start_worker() -> None:
    """One BLAS thread a process; what would be logged is in the records."""
    threadpool_limits(1, user_api="blas")
    logging.disable()


def _map_cloud(
    mission: Mission, settings: Settings, parameters: Hyperparameters | None, index: int
) -> MappedCloud:
    try:
        submap = mission.read(index)
        return MappedCloud(submap_record(submap), map_submap(submap, settings, parameters))
    except TerrainLoopError as error:
        return MappedCloud(
            SubmapRecord(mission.names[index], float(index), 0, "broken", notes=str(error)), None
        )
