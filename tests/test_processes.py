"""Tasks shared among processes: whatever dies, each result comes once and in order, and no process stays."""

import os
import signal
import subprocess
import sys
import time
import uuid
from functools import partial
from pathlib import Path

import pytest

from terrainloop.detection import workers as module
from terrainloop.detection.workers import map_in_processes
from terrainloop.errors import TerrainLoopError

PROC = Path("/proc/self/environ")
needs_proc = pytest.mark.skipif(not PROC.exists(), reason="no /proc to find processes in")
MARK = "TERRAINLOOP_TEST_MARK"


def squared(folder, deaths, index):
    """The square, after as many deaths of its process as the task is due."""
    marks = list(folder.glob(f"{index}-*"))
    if len(marks) < deaths.get(index, 0):
        (folder / f"{index}-{len(marks)}").touch()
        if index % 2:
            os._exit(1)
        os.kill(os.getpid(), signal.SIGKILL)
    return index**2


def lost(index):
    return f"lost {index}"


def process_of(index):
    return os.getpid()


@pytest.mark.parametrize(
    "deaths",
    [{}, {0: 1}, {3: 1, 4: 1}, {6: 1}, {0: 2}, {6: 2}, {1: 2, 2: 1, 3: 2}, dict.fromkeys(range(7), 2)],
    ids=str,
)
def test_a_death_costs_at_most_its_own_task(tmp_path, deaths):
    results = list(map_in_processes(partial(squared, tmp_path, deaths), 7, 2, lost))
    assert results == [lost(i) if deaths.get(i, 0) > 1 else i**2 for i in range(7)]


@pytest.mark.parametrize(("count", "workers"), [(0, 3), (1, 3), (3, 1), (5, 8)])
def test_any_number_of_tasks_and_workers(tmp_path, count, workers):
    task = partial(squared, tmp_path, {})
    assert list(map_in_processes(task, count, workers, lost)) == [i**2 for i in range(count)]


def test_a_worker_killed_between_two_tasks_is_replaced():
    results = map_in_processes(process_of, 12, 2, lost)
    processes = []
    for process in results:
        processes.append(process)
        if len(processes) in (1, 5):
            os.kill(process, signal.SIGKILL)
    assert len(processes) == 12
    assert all(isinstance(process, int) for process in processes)


def blocked_signals(index):
    return signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_workers_never_see_an_interrupt_not_even_while_they_start():
    assert all(signal.SIGINT in blocked for blocked in map_in_processes(blocked_signals, 2, 2, lost))
    assert signal.SIGINT not in blocked_signals(0)


def is_running(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@needs_proc
def test_closing_the_iterator_ends_the_workers():
    results = map_in_processes(process_of, 100, 2, lost)
    processes = {next(results) for _ in range(4)}
    results.close()
    assert not any(is_running(process) for process in processes)


def test_fewer_processes_than_asked_for_are_enough(tmp_path, monkeypatch):
    start, started = module._Worker.__init__, []

    def limited(self, task):
        if started:
            raise BlockingIOError(11, "Resource temporarily unavailable")
        started.append(self)
        start(self, task)

    monkeypatch.setattr(module._Worker, "__init__", limited)
    results = map_in_processes(partial(squared, tmp_path, {}), 4, 3, lost)
    assert list(results) == [0, 1, 4, 9]


def test_no_process_at_all_is_an_error(monkeypatch):
    def refused(self, task):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(module._Worker, "__init__", refused)
    with pytest.raises(TerrainLoopError, match=r"processes that start.*temporarily unavailable"):
        list(map_in_processes(process_of, 4, 3, lost))


@pytest.mark.parametrize("size", [1, 10_000_000])
def test_a_script_without_a_guard_gets_an_error_instead_of_broken_results(tmp_path, size):
    """The larger task does not fit in the pipe to a process that ends before it reads."""
    script = tmp_path / "unguarded.py"
    script.write_text(
        "from functools import partial\n"
        "from terrainloop.detection.workers import map_in_processes\n"
        f"print(list(map_in_processes(partial(max, {size} * ' '), 4, 2, repr)))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert "__main__" in done.stderr.splitlines()[-1]
    assert done.stdout == ""


SLEEPERS = """
import functools, pathlib, sys, time
from terrainloop.detection.workers import map_in_processes

def sleep(folder, index):
    (pathlib.Path(folder) / str(index)).touch()
    time.sleep(100)

if __name__ == "__main__":
    list(map_in_processes(functools.partial(sleep, sys.argv[1]), 4, 2, repr))
"""


def marked_processes(mark):
    """Ids of all live processes whose environment holds the mark."""
    return [
        int(environ.parent.name)
        for environ in Path("/proc").glob("[0-9]*/environ")
        if mark.encode() in content_of(environ) and is_running(environ.parent.name)
    ]


def content_of(path):
    try:
        return path.read_bytes()
    except OSError:  # it has ended, or is another user's
        return b""


def wait_until(holds, seconds=60.0):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


@needs_proc
@pytest.mark.parametrize(
    ("number", "to_group"),
    [
        (signal.SIGKILL, False),
        (signal.SIGTERM, False),
        (signal.SIGINT, False),
        (signal.SIGINT, True),
        (signal.SIGTERM, True),
    ],
)
def test_workers_end_with_their_parent_however_that_ends(tmp_path, number, to_group):
    (tmp_path / "sleepers.py").write_text(SLEEPERS)
    mark = uuid.uuid4().hex
    parent = subprocess.Popen(
        [sys.executable, tmp_path / "sleepers.py", tmp_path],
        env={**os.environ, MARK: mark},
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    with parent:
        try:
            wait_until(lambda: (tmp_path / "0").exists() and (tmp_path / "1").exists())
            assert len(marked_processes(mark)) >= 3
            (os.killpg if to_group else os.kill)(parent.pid, number)
            _, err = parent.communicate(timeout=30)
            wait_until(lambda: not marked_processes(mark), 10)
        finally:
            parent.kill()
    assert parent.returncode == -number
    # The script is no command: Python shows where it was interrupted, once, and the workers are silent.
    assert err.count("Traceback") == (number == signal.SIGINT)


KILLED_WHILE_A_WORKER_STARTS = """
import os, signal, sys, threading, time
from functools import partial
from pathlib import Path
from terrainloop.detection.workers import map_in_processes

def kill_parent():
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children")
    while len(children.read_text().split()) < 2:  # the resource tracker is the first
        time.sleep(0.001)
    time.sleep(0.02)
    os.kill(os.getpid(), signal.SIGKILL)

if __name__ == "__main__":
    threading.Thread(target=kill_parent).start()
    list(map_in_processes(partial(pow, 2, mod=bytes(5_000_000)), 4, 2, str))
"""


@needs_proc
def test_a_worker_whose_parent_is_killed_while_it_starts_ends_quietly(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(KILLED_WHILE_A_WORKER_STARTS)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == -signal.SIGKILL
    assert not done.stderr
