"""A second look at pairs that the trajectory, once loops have tied it down, lays upon each other.

Where a pair must lie is known then: far fewer poses are tried, and fewer pairs, so that less evidence is
needed for the same number of false loops. What chance achieves in such a window is measured on mirror images
in the same windows.
"""

from collections.abc import Mapping
from itertools import groupby

import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import cross_matrix, se2, transform, yaw_of
from terrainloop.loop import LoopCandidate
from terrainloop.matching.mission_null import MissionNull, by_mission_null, mirrored
from terrainloop.matching.register import compare_within
from terrainloop.matching.window import Window
from terrainloop.pose_graph import Solution
from terrainloop.record import hull_overlap

LEAST_OVERLAP = 0.05  # of two footprints at their corrected poses: less is not looked at again
SIGMAS = 3.0  # standard deviations of the trajectory, to either side
LEAST_SHIFT = 0.5  # length scales, ...
LEAST_ROTATION_DEG = 1.0  # ... that a window reaches to either side, however sure the trajectory is
MAX_SHIFT = 8.0  # length scales: where the trajectory is less sure, the first look was no worse


def second_look(
    entries: Mapping[str, MapEntry], solution: Solution, settings: Settings, share: float
) -> list[LoopCandidate]:
    """Pairs that the first look did not accept, compared where the trajectory says that they are.

    Parameters
    ----------
    entries : mapping of str to MapEntry
        By name; those of the submaps of the pose graph.
    solution : Solution
    settings : Settings
    share : float
        Of their `max_false_loops`, that all pairs of this look together may spend.

    Returns
    -------
    list of LoopCandidate
        Accepted and rejected ones, `found_by` "second look".
    """
    match = settings.match.model_copy(update={"max_false_loops": share * settings.match.max_false_loops})
    settings = settings.model_copy(update={"match": match})
    windows = _windows(entries, solution, settings.skip_recent)
    candidates, scores = [], []
    for source, targets in groupby(windows, key=lambda pair: pair[0]):
        query = entries[source]
        image = mirrored(query, settings)
        for _, target, window in targets:
            stored, mirror_window = entries[target], _of_mirror_image(window, query, image)
            candidates.append(compare_within(query, stored, window, settings, pairs=len(windows)))
            mirror = compare_within(image, stored, mirror_window, settings, pairs=np.inf)
            scores.append(-mirror.log_nfa)
    null = MissionNull.of([score for score in scores if not np.isnan(score)], settings.calibration)
    return [by_mission_null(candidate, null, settings, len(windows)) for candidate in candidates]


def _windows(
    entries: Mapping[str, MapEntry], solution: Solution, skip_recent: int
) -> list[tuple[str, str, Window]]:
    """Source, target and window of each pair that is worth a second look, later submaps as sources."""
    graph, found = solution.graph, {(loop.source, loop.target) for loop in solution.loops}
    windows = []
    for i, source in enumerate(graph.names):
        for j, target in enumerate(graph.names[: max(0, i - skip_recent)]):
            if (source, target) in found or not {source, target} <= entries.keys():
                continue
            if solution.components[i] != solution.components[j]:
                continue
            window = _window(entries[source], entries[target], solution, i, j)
            if window is not None:
                windows.append((source, target, window))
    return windows


def _window(source: MapEntry, target: MapEntry, solution: Solution, i: int, j: int) -> Window | None:
    """Where the trajectory says that a source lies in a target; nothing where they share no ground."""
    T = np.linalg.inv(solution.poses[j]) @ solution.poses[i]
    planar = se2(T[0, 3], T[1, 3], yaw_of(T))
    if hull_overlap(transform(planar, source.record.hull), target.record.hull) < LEAST_OVERLAP:
        return None
    local, covariance = solution.relative(j, i)
    centre = np.append(source.field.centre, 0.0) - solution.graph.origins[i]
    jacobian = local[:3, :3] @ np.hstack([-cross_matrix(centre), np.eye(3)])
    position = (jacobian @ covariance @ jacobian.T)[:2, :2]
    length_scale = source.field.length_scale
    shift = SIGMAS * float(np.sqrt(np.linalg.eigvalsh(position)[-1]))
    rotation = SIGMAS * float(np.sqrt(covariance[2, 2]))
    if shift > MAX_SHIFT * length_scale:
        return None
    return Window(
        planar, max(shift, LEAST_SHIFT * length_scale), max(rotation, np.radians(LEAST_ROTATION_DEG))
    )


def _of_mirror_image(window: Window, source: MapEntry, image: MapEntry) -> Window:
    """The same window for the mirror image of a source: its centre is where that of the source is."""
    T = window.T_target_source.copy()
    T[:2, 2] = transform(T, source.field.centre) - T[:2, :2] @ image.field.centre
    return Window(T, window.shift, window.rotation)
