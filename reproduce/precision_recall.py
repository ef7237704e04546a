"""Precision and recall of a preset on simulated and real missions, as in docs/results.md.

    python reproduce/precision_recall.py OUT --preset paper
    python reproduce/precision_recall.py OUT --mission ../shared/data/missions/pozo_r20 --sessions passes.csv

A mission folder given with --mission must hold
truth.tum. Everything goes through the command line, so each step can be run again by hand.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

WORLDS = ("etna", "mars", "morocco")
SHOWN_THRESHOLDS = {"min_inliers": (3, 4, 5, 6, 8), "min_score": (1, 2, 4, 6, 10)}
SHOWN_NUMBERS = ("precision", "pose_precision", "recall")


def terrainloop(*words):
    run = [sys.executable, "-c", "from terrainloop.cli import main; main()", *map(str, words), "--json"]
    return json.loads(subprocess.run(run, check=True, stdout=subprocess.PIPE, text=True).stdout)


def simulated(out, submaps, first_seed):
    for seed, world in enumerate(WORLDS, start=first_seed):
        mission = out / f"{world}_{seed}"
        if not (mission / "truth.tum").exists():
            terrainloop("simulate", "-o", mission, "--world", world, "--seed", seed, "--submaps", submaps)
        yield f"{world} {seed}", mission, []


def score(mission, run, preset, options):
    if not (run / "pairs.csv").exists():
        terrainloop("detect", mission, "-o", run, "--all-pairs", "--preset", preset)
    return terrainloop("evaluate", run, "--truth", mission / "truth.tum", *options)


def _number(value):
    return "-" if value is None else f"{value:.2f}"


def markdown(results):
    key = next(iter(next(iter(results.values()))["precision_recall"][0]))
    shown = SHOWN_THRESHOLDS[key]
    heads = [f"{key.removeprefix('min_')} >= {n}" for n in shown]
    yield (
        "| mission | pairs (true) | "
        + " | ".join(heads)
        + " | best IoU > 0.3 | best IoU 0.1-0.3 | loops (false) | error |"
    )
    yield "|---" * (len(heads) + 6) + "|"
    for name, result in results.items():
        points = {point[key]: point for point in result["precision_recall"]}
        cells = [" / ".join(_number(points[n][number]) for number in SHOWN_NUMBERS) for n in shown]
        best = result["recall_before_first_disjoint"]
        yield (
            f"| {name} | {result['pairs']} ({result['true_pairs']}) | {' | '.join(cells)} "
            f"| {_number(best['0.3-1'])} | {_number(best['0.1-0.3'])} "
            f"| {result['accepted']} ({result['accepted_wrong_pose']}) "
            f"| {_number(result['median_position_error_m'])} m, "
            f"{_number(result['median_yaw_error_deg'])} deg |"
        )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--submaps", type=int, default=16)
    parser.add_argument("--seed", type=int, default=11, help="of the first world; the next ones count on")
    parser.add_argument("--mission", type=Path, help="a real one instead of the simulated ones")
    parser.add_argument("--sessions", help="file in the mission folder: cloud,session")
    args = parser.parse_args()
    if args.mission:
        options = ["--sessions", args.mission / args.sessions] if args.sessions else []
        missions = [(args.mission.name, args.mission, options)]
    else:
        missions = simulated(args.out, args.submaps, args.seed)
    results = {
        name: score(mission, args.out / f"{mission.name}_{args.preset}", args.preset, options)
        for name, mission, options in missions
    }
    (args.out / f"{args.preset}.json").write_text(json.dumps(results, indent=2))
    print("\n".join(markdown(results)))


if __name__ == "__main__":
    main()
