"""A small mission with ground truth, and runs over it that are written by hand."""

import numpy as np

from terrainloop.config import Settings
from terrainloop.geometry import inverse, se3
from terrainloop.io.results import write_loops, write_submaps
from terrainloop.io.trajectories import Trajectory, write_tum
from terrainloop.loop import LoopCandidate
from terrainloop.record import SubmapRecord

SQUARE = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
# Hulls off the origins of their frames, as those of clouds are.
HULL = SQUARE + np.array([0.5, 0.0])
NAMES = "abcde"
POSES = np.array(
    [
        se3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        se3(20.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        se3(40.0, 0.0, 0.0, 0.0, 0.0, 2.0),  # broken
        se3(1.0, 0.0, 0.3, 0.0, 0.0, np.pi),  # on a, and the other way round
        se3(0.0, 30.0, 0.0, 0.02, -0.01, -2.0),
    ]
)


def record(name, hull=HULL):
    return SubmapRecord(name, 0.0, 500, "ok", hull)


RECORDS = [SubmapRecord("c", 0.0, 0, "broken") if name == "c" else record(name) for name in NAMES]


def candidate(source, target, T, *, accepted=True, score=9.0):
    return LoopCandidate(
        source, target, T, np.eye(6), 9, 1.0, 0.1, 0.5, score, accepted, "constructed"
    )  # fmt: skip


def true_pose(source, target, poses=POSES):
    i, j = NAMES.index(source), NAMES.index(target)
    return inverse(poses[j]) @ poses[i]


def right(source, target, **options):
    return candidate(source, target, true_pose(source, target), **options)


def wrong(source, target, **options):
    return candidate(source, target, se3(7.0, 0, 0, 0, 0, 0) @ true_pose(source, target), **options)


def write_run(folder, candidates, records=RECORDS, poses=POSES):
    """The files of a run and its truth; returns the path of the truth."""
    folder.mkdir(exist_ok=True)
    write_submaps(folder / "submaps.csv", records)
    write_loops(folder / "pairs.csv", candidates)
    write_loops(folder / "loops.csv", [candidate for candidate in candidates if candidate])
    (folder / "config.yaml").write_text(Settings().to_yaml(), encoding="utf-8")
    write_tum(folder / "truth.tum", Trajectory(np.arange(len(poses)), poses))
    return folder / "truth.tum"
