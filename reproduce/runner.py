"""Runs every method on every mission, each in a process of its own with one thread; resumes.

A task leaves OUT/MISSION/METHOD-K.csv (source, target, score, transform) and a JSON record beside it with
settings, software and times; K numbers the choices of settings. A task is skipped if its results exist and
their record has the key of the present code, mission, settings and processor.
"""

import csv
import json
import os
import pickle
import resource
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from queue import Queue
from typing import Any

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.provenance import fingerprint, processor
from reproduce.baselines import ours
from reproduce.baselines.method import Match, Method, Scale
from reproduce.kept import code_key, is_current, versions
from reproduce.missions import Drive
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import parameters_of, se3
from terrainloop.io.files import write_whole_text
from terrainloop.io.results import POSE_COLUMNS

ROOT = Path(__file__).parent.parent
PROCESSORS = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Task:
    """One method with one choice of settings on one mission.

    Attributes
    ----------
    drive : Drive
    module : str
        Name by which `methods_of` finds it ...
    variant : int
        ... and its index there.
    method : Method
    folder : Path
        Folder of the mission's results.
    """

    drive: Drive
    module: str
    variant: int
    method: Method
    folder: Path

    @property
    def short_module(self) -> str:
        return self.module.rpartition(".")[2]

    @property
    def stem(self) -> str:
        return f"{self.short_module}-{self.variant}"

    @property
    def csv(self) -> Path:
        return self.folder / f"{self.stem}.csv"

    @property
    def json(self) -> Path:
        return self.folder / f"{self.stem}.json"

    @cached_property
    def key(self) -> str:
        """Fingerprint of everything that its results depend on; its times depend on the processor."""
        return fingerprint(
            code=code_key(),
            mission=self.drive.key,
            module=self.module,
            variant=self.variant,
            settings=dict(self.method.settings),
            software=self.method.software,
            processor=processor(),
        )

    @property
    def done(self) -> bool:
        """Whether its results exist, under its key."""
        return self.csv.exists() and is_current(self.json, self.key)


@dataclass(frozen=True, eq=False)
class Scored:
    """A pair as a method scored it; what `terrainloop.evaluation.pairs` takes."""

    source: str
    target: str
    score: float
    T_target_source: np.ndarray


def methods_of(module: str, drive: Drive, scale: Scale) -> tuple[Method, ...]:
    """Our own by the name of its settings, else all variants of the baseline in a Python module."""
    if module in ours.SETTINGS:
        return (ours.method_of(module, drive.submaps),)
    return import_module(module).methods(scale)


def tasks_of(drive: Drive, modules: Iterable[str], out: Path, *, first_only: bool) -> list[Task]:
    """Every method and variant on a mission; those that cannot run here are left out, with a message.

    With `first_only`, the first variant of each method.
    """
    tasks = []
    for module in modules:
        try:
            methods = methods_of(module, drive, drive.scale)
        except (TerrainLoopError, ImportError) as error:
            print(f"{drive.name}: left out {module.rpartition('.')[2]}: {error}")
            continue
        names = [method.name for method in methods]
        tasks += [
            Task(drive, module, k, method, out / drive.name)
            for k, method in enumerate(methods)
            if not first_only or names.index(method.name) == k
        ]
    return tasks


def run_all(tasks: Sequence[Task], workers: int) -> list[Task]:
    """Run all tasks that are not done, as many at a time as there are workers; return the finished ones."""
    waiting = [task for task in tasks if not task.done]
    print(f"{len(tasks)} tasks, {len(tasks) - len(waiting)} of them done before", flush=True)
    processors: Queue[int] = Queue()
    for worker in range(workers):
        processors.put(PROCESSORS[worker % len(PROCESSORS)])
    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(run_apart, task, processors): task for task in waiting}
        for number, future in enumerate(as_completed(futures), start=1):
            task = futures[future]
            print(f"[{number}/{len(waiting)}] {task.drive.name} {task.stem}: {future.result()}", flush=True)
    return [task for task in tasks if task.done]


def run_apart(task: Task, processors: Queue[int]) -> str:
    """Run a task in its own process; report the outcome in one line, with the output kept if it failed."""
    task.folder.mkdir(parents=True, exist_ok=True)
    processor = processors.get()
    order = {
        "name": task.drive.name,
        "mission": str(task.drive.path.resolve()),
        "min_overlap": task.drive.min_overlap,
        "scale": asdict(task.drive.scale),
        "module": task.module,
        "variant": task.variant,
        "folder": str(task.folder.resolve()),
        "processor": processor,
    }
    paths = [str(ROOT), *filter(None, sys.path)]
    log = task.folder / f"{task.stem}.log"
    begin = time.perf_counter()
    try:
        with log.open("w", encoding="utf-8") as output:
            run = subprocess.run(
                [sys.executable, "-m", "reproduce.runner", json.dumps(order)],
                env=os.environ | ONE_THREAD | {"PYTHONPATH": os.pathsep.join(paths)},
                stdout=output,
                stderr=subprocess.STDOUT,
            )
    finally:
        processors.put(processor)
    if run.returncode == 0:
        log.unlink()
        return f"{time.perf_counter() - begin:.0f} s"
    said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f"failed (exit {run.returncode}): {said[-1] if said else 'said nothing'}; see {log}"


def execute(task: Task) -> None:
    """Describe the submaps in order, score the pairs, write both files completely or not at all."""
    method, names = task.method, task.drive.mission.names
    kept, describing = [], Stopwatch()
    for observation in task.drive.observations():
        with describing:
            kept.append(method.describe(observation))
    scored, pairing = [], Stopwatch()
    for i, j in task.drive.pairs():
        with pairing:
            match = method.score(kept[i], kept[j])
        scored.append((names[i], names[j], match))
    spent = {
        "describe_ms": describing.median("processor"),
        "describe_wall_ms": describing.median("wall"),
        "pair_ms": pairing.median("processor"),
        "pair_wall_ms": pairing.median("wall"),
        "megabytes": megabytes(kept),
    }
    write_whole_text(task.csv, lambda file: _write_pairs(file, scored))
    record = {
        "mission": task.drive.name,
        "method": method.name,
        "settings": dict(method.settings),
        "software": method.software,
        "key": task.key,
        "pairs": len(scored),
        **spent,
        "versions": versions(),
    }
    write_whole_text(task.json, lambda file: json.dump(record, file, indent=2))


class Stopwatch:
    """Milliseconds of each ``with`` block: on the wall, and of the processor for all threads and children.

    The table prints the second: other work on the machine does not lengthen it, and threads that a library
    starts in spite of the settings do not shorten it.
    """

    def __init__(self):
        self.laps = {"wall": [], "processor": []}

    def __enter__(self):
        self.begun = self._now()

    def __exit__(self, *_):
        for name, now in self._now().items():
            self.laps[name].append(1e3 * (now - self.begun[name]))

    def median(self, name: str) -> float | None:
        return float(np.median(self.laps[name])) if self.laps[name] else None

    @staticmethod
    def _now() -> dict[str, float]:
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return {
            "wall": time.perf_counter(),
            "processor": time.process_time() + children.ru_utime + children.ru_stime,
        }


def megabytes(kept: Sequence[Any]) -> float | None:
    """Median size of the pickled description of a submap; None if it cannot be pickled."""
    try:
        return float(np.median([len(pickle.dumps(one)) for one in kept])) / 1e6
    except (TypeError, AttributeError, pickle.PicklingError):
        return None


def _write_pairs(file, scored: Iterable[tuple[str, str, Match]]) -> None:
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["source", "target", "score", *POSE_COLUMNS])
    for source, target, match in scored:
        pose = parameters_of(match.T_target_source)
        writer.writerow([source, target, *(repr(float(value)) for value in (match.score, *pose))])


def read_pairs(path: Path) -> list[Scored]:
    with path.open(newline="", encoding="utf-8") as file:
        return [
            Scored(
                row["source"],
                row["target"],
                float(row["score"]),
                se3(*(float(row[column]) for column in POSE_COLUMNS)),
            )
            for row in csv.DictReader(file)
        ]


def main(order: Mapping[str, Any]) -> None:
    if hasattr(os, "sched_setaffinity"):  # TBB starts as many threads as there are processors
        os.sched_setaffinity(0, {order["processor"]})
    drive = Drive(order["name"], Path(order["mission"]), order["min_overlap"])
    method = methods_of(order["module"], drive, Scale(**order["scale"]))[order["variant"]]
    cv2.setNumThreads(1)
    with threadpool_limits(1):
        execute(Task(drive, order["module"], order["variant"], method, Path(order["folder"])))


if __name__ == "__main__":
    try:
        main(json.loads(sys.argv[1]))
    except TerrainLoopError as error:
        sys.exit(str(error))
