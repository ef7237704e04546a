"""How many threads or processes share the work. Results never depend on it."""

import operator
import os

from terrainloop.errors import TerrainLoopError


def available_workers() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def usable_workers(workers: int) -> int:
    """The number asked for, but no more than there are processors: more would only cost memory.

    Parameters
    ----------
    workers : int
        At least one.

    Raises
    ------
    TerrainLoopError
        If it is no such number.
    """
    try:
        number = operator.index(workers)
    except TypeError:
        number = 0
    if number < 1:
        raise TerrainLoopError(
            expected="a number of workers of at least 1", found=repr(workers)[:40], mend="give 1 or more"
        )
    return min(number, available_workers())
