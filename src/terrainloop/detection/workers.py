"""Processes that share a list of independent tasks, whatever happens to one of them."""

import logging
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import connection, get_context, parent_process
from threading import Thread
from typing import TypeVar

from threadpoolctl import threadpool_limits

Result = TypeVar("Result")

AHEAD = 2  # tasks per worker that are handed out before their result is asked for


def map_in_processes(
    task: Callable[[int], Result], count: int, workers: int, on_death: Callable[[int], Result]
) -> Iterator[Result]:
    """The results of task(0) ... task(count - 1), in order, from as many processes as there are workers.

    Workers end with their parent, however that ends. Where a worker dies, for lack of memory say, the next
    task runs alone in a new process; if that dies as well, `on_death` gives the result.

    Parameters
    ----------
    task : callable
        Can be pickled, as can its results; raises nothing.
    count, workers : int
    on_death : callable
    """
    if workers == 1:
        with threadpool_limits(1, user_api="blas"):
            yield from map(task, range(count))
        return
    done = 0
    while done < count:
        for result in _until_death(task, range(done, count), workers):
            yield result
            done += 1
        if done < count:
            yield next(_until_death(task, range(done, done + 1), 1), None) or on_death(done)
            done += 1


def _until_death(task: Callable[[int], Result], indices: range, workers: int) -> Iterator[Result]:
    """The results of `_in_order`, up to the death of a worker."""
    with suppress(BrokenProcessPool):
        yield from _in_order(task, indices, workers)


def _in_order(task: Callable[[int], Result], indices: range, workers: int) -> Iterator[Result]:
    """Results in order, few tasks being under way at a time, so that few results wait."""
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_start_worker)
    under_way: deque[Future[Result]] = deque()
    try:
        for index in indices:
            under_way.append(pool.submit(task, index))
            if len(under_way) >= AHEAD * workers:
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    """One BLAS thread each; what would be logged is in the results; the parent answers Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(1, user_api="blas")
    logging.disable()
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
