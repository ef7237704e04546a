"""What the machine can spare: memory and processors."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path

from terrainloop.errors import TerrainLoopError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_CGROUPS = (  # limit and usage of version 2, then of version 1, where a container sees its own
    ("memory.max", "memory.current"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
)


def available_memory() -> float:
    """Bytes that this process can still allocate; infinite where the system does not report them.

    The least of what the machine has free, what the container's memory limit leaves, and what the limit
    on the address space (``ulimit -v``) leaves.
    """
    return max(0.0, min(_free_memory(), _left_in_cgroup(), _left_of_address_space()))


def check_workers(workers: int) -> int:
    """The number of threads to start: `workers`, but no more than the machine has processors.

    Raises
    ------
    TerrainLoopError
        If it is not a whole number of at least one.
    """
    if isinstance(workers, bool) or not isinstance(workers, Integral) or workers < 1:
        raise TerrainLoopError(
            expected="a number of workers of at least 1", found=repr(workers), mend="leave it out for one"
        )
    return min(int(workers), os.cpu_count() or 1)


@contextmanager
def memory_errors(task: str) -> Iterator[None]:
    """Turn a MemoryError within the block into a TerrainLoopError that names the task."""
    try:
        yield
    except MemoryError as error:
        raise TerrainLoopError(
            expected=f"enough memory for {task}",
            found=f"{_gigabytes(available_memory())} left",
            mend="use a coarser resolution, fewer points or fewer workers",
        ) from error


def check_memory(needed: float, task: str, limit: float | None = None) -> None:
    """Refuse a task that needs more bytes than `limit`, or than are available if that is not given."""
    available = available_memory() if limit is None else min(limit, available_memory())
    if needed > available:
        raise TerrainLoopError(
            expected=f"{_gigabytes(needed)} of memory for {task}",
            found=f"{_gigabytes(available)} available",
            mend="use a coarser resolution, fewer points or fewer workers",
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


def _left_in_cgroup(root: Path = Path("/sys/fs/cgroup")) -> float:
    for limit, usage in _CGROUPS:
        try:
            return float(int((root / limit).read_text()) - int((root / usage).read_text()))
        except (OSError, ValueError):  # not this version, or "max"
            continue
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
