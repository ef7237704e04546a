"""Whether the promise holds: scores and false loops among places that share no ground, and revisits found.

    python benchmarks/false_alarms.py                         every row below, 21 places each
    python benchmarks/false_alarms.py --only craters ruts     rows whose world or sensor contains a word
    python benchmarks/false_alarms.py --attacks DIR           also the missions that DIR/attack.py makes

A row is a world seen by a sensor. One mission shows every place once: each of its pairs is unrelated, so a
share of 10^-s of them may score above s, and the mission may accept 0.01 false loops. Another shows half as
many places twice. Both are written to a folder and decided by `detect_mission`, as 'terrainloop detect
--all-pairs' does. Results are kept in ~/.cache/terrainloop-benchmarks under a fingerprint of code, settings
and seed.
"""

import argparse
import csv
import json
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from provenance import fingerprint, package, processor
from scipy.stats import binomtest

from terrainloop import Settings, detect_mission
from terrainloop.evaluation.pairs import evaluate_pairs
from terrainloop.evaluation.truth import GroundTruth
from terrainloop.io.trajectories import read_trajectory
from terrainloop.simulation.names import WORLDS
from terrainloop.simulation.places import APART, simulate_places, write_places
from terrainloop.simulation.sensors import SpinningLidar, StereoCamera, Survey
from terrainloop.simulation.setups import SETUPS

CACHE = Path.home() / ".cache" / "terrainloop-benchmarks"
SETTINGS = Settings(skip_recent=0)  # --all-pairs
LEVELS = (1, 2, 3)

FRAME = replace(SETUPS["stereo"], submap_length=0.5)
FUSED = replace(SETUPS["stereo"], submap_length=6.0, frame_spacing=1.0)
DOWNWARD = SpinningLidar(rings=64, elevations_deg=(-45.0, -7.0), max_range=8.0)
SCAN = replace(SETUPS["lidar"], submap_length=1.0, voxel=0.05, sensor=DOWNWARD)
SENSORS = {
    "survey": SETUPS["survey"],
    "survey, 3 cm noise": replace(SETUPS["survey"], sensor=Survey(noise=0.03)),
    "stereo frame": FRAME,
    "stereo frame, bias 0.05 px": replace(FRAME, sensor=StereoCamera(bias=0.05)),
    "stereo frame, bias 0.2 px": replace(FRAME, sensor=StereoCamera(bias=0.2)),
    "6 stereo frames": FUSED,
    "6 stereo frames, bias 0.2 px": replace(FUSED, sensor=StereoCamera(bias=0.2)),
    "lidar scan": SCAN,
    "lidar scan, bias 1.5 cm": replace(SCAN, sensor=replace(DOWNWARD, range_bias=0.015)),
    "lidar scan, bias 0.1 deg": replace(SCAN, sensor=replace(DOWNWARD, elevation_bias_deg=0.1)),
}
ROWS = (
    *((world, "survey") for world in WORLDS),
    ("boulders", "survey, 3 cm noise"),
    *(("flat", sensor) for sensor in SENSORS if not sensor.startswith("survey")),
    *product(("etna", "craters"), ("6 stereo frames", "6 stereo frames, bias 0.2 px")),
    *(("etna", sensor) for sensor in SENSORS if sensor.startswith("lidar")),
)
ATTACK = "attack.py"


@dataclass(frozen=True)
class Job:
    """One mission of a row; of `attack.py` where its folder is given."""

    world: str
    sensor: str
    seed: int
    places: int
    revisits: bool
    attacks: Path | None

    @property
    def key(self):
        conditions = {field.name: getattr(self, field.name) for field in fields(self)[:-1]}
        if self.attacks is None:
            conditions["setup"] = asdict(SENSORS[self.sensor])
        roots = [] if self.attacks is None else sorted(self.attacks.glob("*.py"))
        settings = SETTINGS.model_dump()
        return fingerprint(*package(), Path(__file__), *roots, settings=settings, **conditions)

    def write(self, folder):
        if self.attacks is None:
            made = simulate_places(self.world, self.seed, self.places, SENSORS[self.sensor], self.revisits)
            write_places(made, folder)
            return
        command = [sys.executable, ATTACK, self.world, folder, "--places", self.places, "--seed", self.seed]
        command += ["--revisits"] * self.revisits
        subprocess.run(list(map(str, command)), cwd=self.attacks, check=True, stdout=subprocess.DEVNULL)


def decided(job):
    """Scores of unrelated pairs and what became of them; of revisits, how many were found."""
    kept = CACHE / f"{job.key[:16]}.json"
    if not kept.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(decide(job)))
    return json.loads(kept.read_text())


def decide(job):
    cv2.setNumThreads(1)
    pairs = []
    with TemporaryDirectory() as folder:
        job.write(Path(folder))
        run = detect_mission(folder, SETTINGS, on_pair=pairs.append)
        poses = read_trajectory(Path(folder) / "truth.tum").poses if job.revisits else None
    places = (
        range(len(run.submaps)) if poses is None else np.rint(poses[:, 0, 3] / APART).astype(int).tolist()
    )
    place = {record.name: at for record, at in zip(run.submaps, places, strict=True)}
    unrelated = [pair for pair in pairs if place[pair.source] != place[pair.target]]
    result = {
        "scores": [float(pair.score) for pair in unrelated],
        "false": sum(map(bool, unrelated)),
        "broken": sum(record.status == "broken" for record in run.submaps),
    }
    if poses is not None:
        accepted = [pair for pair in pairs if pair and place[pair.source] == place[pair.target]]
        right = sum(pair.pose_is_right for pair in evaluate_pairs(accepted, truth_of(run, poses, places)))
        result |= {"possible": job.places, "found": right, "wrong": len(accepted) - right}
    return result


def truth_of(run, poses, places):
    """Truth with all first visits before the second ones: consecutive submaps count as connected."""
    second = [place in places[:index] for index, place in enumerate(places)]
    order = np.argsort(second, kind="stable")
    return GroundTruth([run.submaps[index] for index in order], poses[order])


def summary(world, sensor, once, twice):
    """The row of the table, from the results of its missions."""
    scores = np.concatenate([result["scores"] for result in once])
    row = {"world": world, "sensor": sensor, "pairs": len(scores)}
    for level in LEVELS:
        above = int((scores > level).sum())
        interval = binomtest(above, len(scores)).proportion_ci(method="wilson")
        row |= {
            f"above_{level}": above,
            f"promised_{level}": len(scores) * 10.0**-level,
            f"low_{level}": interval.low * len(scores),
            f"high_{level}": interval.high * len(scores),
        }
    row |= {"largest": scores.max(), "false_loops": sum(result["false"] for result in once)}
    row["broken"] = sum(result["broken"] for result in [*once, *twice])
    for name in ("possible", "found", "wrong", "false"):
        row[f"revisits_{name}"] = sum(result[name] for result in twice)
    return row


def cells(row):
    """The row as Markdown."""
    levels = [
        f"{row[f'above_{n}']} / {row[f'promised_{n}']:.3g} ({row[f'low_{n}']:.2g}-{row[f'high_{n}']:.2g})"
        for n in LEVELS
    ]
    found = f"{row['revisits_found']} of {row['revisits_possible']}"
    wrong = f"{row['revisits_wrong']} + {row['revisits_false']}"
    first = [row["world"], row["sensor"], str(row["pairs"]), *levels, f"{row['largest']:.1f}"]
    return f"| {' | '.join([*first, str(row['false_loops']), found, wrong])} |"


HEADER = (
    "| world | sensor | pairs | score above 1: seen / promised (95 %) | above 2 | above 3 | largest "
    "| false loops | revisits found | wrong pose + wrong place |"
)


def rows_of(attacks, only):
    """(world, sensor, folder of attack.py or None) of each row that is asked for."""
    rows = [(world, sensor, None) for world, sensor in ROWS]
    if attacks is not None:
        command = [sys.executable, ATTACK, "--list"]
        listed = subprocess.run(command, cwd=attacks, check=True, capture_output=True, text=True).stdout
        rows += [(name, ATTACK, attacks) for name in listed.split()]
    if only:
        rows = [row for row in rows if any(word in f"{row[0]}, {row[1]}" for word in only)]
    return rows


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="rows whose world or sensor contains one")
    parser.add_argument("--places", type=int, default=21, help="per mission, 4 or more; 21 make 210 pairs")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="missions per row")
    parser.add_argument("--attacks", type=Path, metavar="DIR", help="folder of attack.py")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--csv", type=Path, help="file for the table, unrounded")
    args = parser.parse_args()
    attacks = args.attacks and args.attacks.resolve()
    rows = rows_of(attacks, args.only)
    if not rows or args.places < 4:
        parser.error("--only matches no row" if not rows else "--places must be 4 or more")
    missions = [(seed, args.places, False) for seed in args.seeds]
    missions += [(seed, args.places // 2, True) for seed in args.seeds]
    print(f"{processor()}; {args.places} places; seeds {args.seeds}\n\n{HEADER}\n{'|---' * 10}|", flush=True)
    table = []
    # Threads of the maps' solver do not survive a fork.
    with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
        jobs = [Job(*row[:2], *mission, row[2]) for row in rows for mission in missions]
        results = pool.map(decided, jobs)
        for world, sensor, _ in rows:
            of_row = [next(results) for _ in missions]
            half = len(args.seeds)
            table.append(summary(world, sensor, of_row[:half], of_row[half:]))
            print(cells(table[-1]), flush=True)
    if args.csv:
        with args.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, table[0].keys())
            writer.writeheader()
            writer.writerows(table)


if __name__ == "__main__":
    main()
