"""The one entry to matching: whether submaps show the same place, and the transform between them."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import Array
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import LoopCandidate
from terrainloop.matching.by_inliers import compare_by_inliers
from terrainloop.matching.decision import compare_by_evidence
from terrainloop.matching.query import Query, RotatedField, rotate, search_grid
from terrainloop.matching.window import Window
from terrainloop.record import SubmapRecord


def register(
    source_map: GradientMap,
    target_map: GradientMap,
    settings: Settings | None = None,
    *,
    names: tuple[str, str] = ("source", "target"),
) -> LoopCandidate:
    """Decide whether two maps show the same place, and estimate the transform between them.

    Parameters
    ----------
    source_map, target_map : GradientMap
    settings : Settings, optional
    names : tuple of str
        Names of source and target; together with the seed they determine the random draws.

    Returns
    -------
    LoopCandidate
        Falsy if rejected; ``.reason`` says why.

    Raises
    ------
    TerrainLoopError
        If one of the two is not a gradient map, or the settings are none.
    """
    settings = Settings.or_default(settings)
    for given in (source_map, target_map):
        if not isinstance(given, GradientMap):
            raise TerrainLoopError(
                expected="two gradient maps",
                found=f"a {type(given).__name__}",
                mend="make maps with GradientMap.from_points, of both clouds with one length scale",
            )
    source, target = (
        MapEntry.of(SubmapRecord(name), gradient_map, settings)
        for name, gradient_map in zip(names, (source_map, target_map), strict=True)
    )
    return compare(source, target, settings)


def compare(source: MapEntry, target: MapEntry, settings: Settings, *, pairs: float = 1) -> LoopCandidate:
    """As `register`, for stored submaps; the parameters are those of `compare_many`."""
    return compare_many(source, [target], settings, pairs=pairs)[0]


def compare_within(
    source: MapEntry, target: MapEntry, window: Window, settings: Settings, *, pairs: float = 1
) -> LoopCandidate:
    """Compare two stored submaps only where they must lie, if they share ground."""
    ((query, _),) = _queries(source, [target], settings)
    candidate = compare_by_evidence(query, target, pairs, settings, window)
    return replace(candidate, found_by="second look")


def compare_many(
    source: MapEntry,
    targets: Sequence[MapEntry],
    settings: Settings,
    *,
    pairs: float | Array = 1,
    workers: int = 1,
) -> list[LoopCandidate]:
    """Compare one submap with several.

    Parameters
    ----------
    source : MapEntry
        The query.
    targets : sequence of MapEntry
    settings : Settings
    pairs : float or array, (N,)
        Number of pairs that `max_false_loops` is shared among, for all targets or for each.
    workers : int
        Threads; the result does not depend on their number.

    Returns
    -------
    list of LoopCandidate
        One per target, in their order.
    """
    with ThreadPoolExecutor(workers) as pool:
        if settings.match.decision == "inliers":
            return list(pool.map(partial(compare_by_inliers, source, settings=settings), targets))
        of_each = np.broadcast_to(pairs, len(targets))
        candidates: dict[int, LoopCandidate] = {}
        for query, indices in _queries(source, targets, settings):
            work = partial(compare_by_evidence, query, settings=settings)
            found = pool.map(work, [targets[index] for index in indices], of_each[indices])
            candidates |= zip(indices, found, strict=True)
    return [candidates[index] for index in range(len(targets))]


def _queries(
    source: MapEntry, targets: Sequence[MapEntry], settings: Settings
) -> Iterator[tuple[Query, list[int]]]:
    """The source as a query for each search grid, with the indices of the targets searched on that grid."""
    grids = [search_grid(source, target, settings) for target in targets]
    rotated: dict[float, RotatedField] = {}
    for grid in sorted(set(grids), key=lambda grid: (grid.spacing, grid.size)):
        if grid.spacing not in rotated:
            field = source.field_at(grid.spacing, settings)
            rotated = {grid.spacing: rotate(field, settings.calibration)}
        query = Query.of(source, grid, rotated[grid.spacing])
        yield query, [index for index, of in enumerate(grids) if of == grid]
