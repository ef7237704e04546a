"""Processes that share a list of independent tasks and survive the failure of one of them."""

import logging
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection, get_context, parent_process, resource_tracker
from threading import Thread
from typing import Any, Generic, TypeVar

from threadpoolctl import threadpool_limits

from terrainloop.errors import TerrainLoopError

Result = TypeVar("Result")

AHEAD = 2  # results per worker that may wait for their turn


def map_in_processes(
    task: Callable[[int], Result], count: int, workers: int, on_death: Callable[[int], Result]
) -> Generator[Result, None, None]:
    """The results of task(0) ... task(count - 1), in order, from as many processes as there are workers.

    Workers end with their parent, however that ends, and when the iterator is closed. A task whose worker
    dies, for example for lack of memory, runs once more, alone; if that worker dies as well, `on_death`
    provides the result.

    Parameters
    ----------
    task : callable
        Picklable, as are its results; raises nothing.
    count, workers : int
    on_death : callable

    Raises
    ------
    TerrainLoopError
        If no process can be started.
    """
    workers = min(workers, count)
    if workers <= 1:
        with threadpool_limits(1, user_api="blas"):
            yield from map(task, range(count))
        return
    crew = _Crew(task, count, workers, on_death)
    try:
        for index in range(count):
            yield crew.result(index)
    finally:
        crew.end()


class _Worker:
    """A process that runs one task at a time."""

    def __init__(self, task: Callable[[int], Any]) -> None:
        context = get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        try:
            with _interrupts_blocked():
                self._process.start()
        finally:
            theirs.close()  # else sending to a process that has ended waits for ever
        # Large arguments of a process end it with a traceback if this one is killed meanwhile.
        self.connection.send(task)
        self.index: int | None = None

    def begin(self, index: int) -> None:
        """Hand over a task; where the process is dead, the next `receive` raises."""
        self.index = index
        with suppress(OSError):
            self.connection.send(index)

    def receive(self) -> list[Any]:
        """Nothing once the process has started, or a result; raises EOFError or OSError where it died."""
        message: list[Any] = self.connection.recv()
        return message

    def end(self) -> None:
        self._process.kill()
        self._process.join()
        self.connection.close()


class _Crew(Generic[Result]):
    """The workers, and the results that wait for their turn."""

    def __init__(
        self, task: Callable[[int], Result], count: int, size: int, on_death: Callable[[int], Result]
    ) -> None:
        self._task, self._size, self._on_death = task, size, on_death
        self._workers: list[_Worker] = []
        self._proven = False  # whether any process has started well
        self._due = deque(range(count))
        self._suspects: list[int] = []  # tasks whose worker died, to be run again, alone
        self._results: dict[int, Result] = {}

    def result(self, index: int) -> Result:
        """The result of a task, which is the next in order."""
        while index not in self._results:
            self._hand_out(index + AHEAD * self._size)
            for ready in connection.wait([worker.connection for worker in self._workers]):
                self._collect(next(worker for worker in self._workers if worker.connection is ready))
        return self._results.pop(index)

    def end(self) -> None:
        for worker in self._workers:
            worker.end()

    def _hand_out(self, limit: int) -> None:
        """Keep the workers busy with the tasks below `limit`, or one with a suspect once all are idle."""
        if self._suspects:
            if all(worker.index is None for worker in self._workers):
                while len(self._workers) > 1:  # their memory may be what was missing
                    self._workers.pop().end()
                if worker := self._idle():
                    worker.begin(self._suspects[0])
            return
        while self._due and self._due[0] < limit and (worker := self._idle()):
            worker.begin(self._due.popleft())

    def _idle(self) -> _Worker | None:
        """A worker without a task, a new one if need be, or None if there can be no more."""
        idle = next((worker for worker in self._workers if worker.index is None), None)
        if idle is None and len(self._workers) < self._size:
            try:
                idle = _Worker(self._task)
                self._workers.append(idle)
            except OSError as error:
                if not self._workers:
                    raise _cannot_start(str(error)) from error
                self._size = len(self._workers)
        return idle

    def _collect(self, worker: _Worker) -> None:
        try:
            message = worker.receive()
        except (EOFError, OSError):
            self._bury(worker)
            return
        self._proven = True
        if message and worker.index is not None:
            (self._results[worker.index],) = message
            self._suspects = [index for index in self._suspects if index != worker.index]
            worker.index = None

    def _bury(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        worker.end()
        if not self._proven:
            raise _cannot_start("one that ended before its first task")
        if worker.index is None:
            return
        if worker.index in self._suspects:
            self._suspects.remove(worker.index)
            self._results[worker.index] = self._on_death(worker.index)
        else:
            self._suspects.append(worker.index)


def _cannot_start(found: str) -> TerrainLoopError:
    return TerrainLoopError(
        expected="worker processes that start",
        found=found,
        mend='use one worker, or start from a script whose own code is below `if __name__ == "__main__":`',
    )


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Processes started within never see Ctrl-C, not even while they start; this one sees it afterwards."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # it would be started with the first process, and unblock the signal
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _serve(tasks: connection.Connection) -> None:
    """Run tasks with one BLAS thread; what would be logged is in the results."""
    Thread(target=_end_with_parent, daemon=True).start()
    logging.disable()
    with suppress(EOFError, OSError), threadpool_limits(1, user_api="blas"):  # no parent any more
        task = tasks.recv()
        tasks.send([])
        while True:
            tasks.send([task(tasks.recv())])


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
