"""Available memory and processors."""

import operator
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from terrainloop.errors import TerrainLoopError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_CGROUPS = Path("/sys/fs/cgroup")
# Files of the limit, the usage and the statistics in versions 2 and 1, and the part of the usage that is
# file cache, which the kernel releases when memory is needed.
_VERSIONS = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "memory.stat", "total_inactive_file"),
)

_LESS = "use a coarser resolution, fewer points or fewer workers"


def available_memory() -> float:
    """Bytes that this process can still allocate; infinite where the system does not report them.

    The least of what the machine has free, what the container's memory limit leaves, and what the limit
    on the address space (``ulimit -v``) leaves.
    """
    return max(0.0, min(_free_memory(), _left_in_cgroup(), _left_of_address_space()))


def available_processors() -> int:
    """Number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def usable_workers(workers: int) -> int:
    """The number of workers to start: `workers`, but no more than there are processors.

    Raises
    ------
    TerrainLoopError
        If it is not a whole number of at least one.
    """
    try:
        number = operator.index(workers)
    except TypeError:
        number = 0
    if number < 1 or isinstance(workers, bool):
        raise TerrainLoopError(
            expected="a number of workers of at least 1",
            found=repr(workers)[:40],
            mend="leave it out for one",
        )
    return min(number, available_processors())


@contextmanager
def memory_errors(task: str) -> Iterator[None]:
    """Turn a MemoryError within the block into a TerrainLoopError that names the task."""
    try:
        yield
    except MemoryError as error:
        raise TerrainLoopError(
            expected=f"enough memory for {task}",
            found=f"{_gigabytes(available_memory())} left",
            mend=_LESS,
        ) from error


def check_memory(needed: float, task: str, limit: float | None = None, *, mend: str = _LESS) -> None:
    """Refuse a task that needs more bytes than `limit`, or than are available if that is not given."""
    available = available_memory() if limit is None else min(limit, available_memory())
    if needed > available:
        raise TerrainLoopError(
            expected=f"{_gigabytes(needed)} of memory for {task}",
            found=f"{_gigabytes(available)} available",
            mend=mend,
        )


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:.2g} GB"


def _free_memory() -> float:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError, IndexError):
        pass
    try:  # macOS: all of it, free or not
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return float("inf")


def _left_in_cgroup(root: Path = _CGROUPS, own: Path = Path("/proc/self/cgroup")) -> float:
    """The least that the limits of this process's control groups leave."""
    groups = {root, root / "memory"}
    try:
        for line in own.read_text(encoding="utf-8", errors="replace").splitlines():
            _, kinds, path = line.split(":", 2)
            groups.add(root / kinds / path.lstrip("/"))
    except (OSError, ValueError):
        pass
    return min(_left_in_group(group, *files) for group in groups for files in _VERSIONS)


def _left_in_group(group: Path, limit: str, usage: str, statistics: str, cache: str) -> float:
    try:
        left = int((group / limit).read_text()) - int((group / usage).read_text())
        lines = (line.split() for line in (group / statistics).read_text().splitlines())
        return float(left + sum(int(line[1]) for line in lines if line[:1] == [cache]))
    except (OSError, ValueError, IndexError):  # not this version, or "max"
        return float("inf")


def _left_of_address_space() -> float:
    if resource is None:
        return float("inf")
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return float("inf")
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except (OSError, ValueError):
        return float(limit)
    return float(limit - pages * resource.getpagesize())
