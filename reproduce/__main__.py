"""The paper's datasets are not public: Etna1 to Etna4 and Morocco are simulated stand-ins here.

Regenerates the paper's figures and tables, with today's peers and with two additional missions (Mars and
EtnaLidar, also simulated): ``python -m reproduce`` from the root of the repository. Real missions are given
with --mission. Every OUT/NAME.png has its numbers in OUT/NAME.csv. Run it again to resume: results
are reused as long as code, missions and settings stay the same.
"""

import argparse
import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.provenance import processor
from reproduce import figures, table
from reproduce.baselines import ours
from reproduce.kept import versions
from reproduce.missions import BEYOND, PAPER, QUICK, SUBMAPS, SUBMAPS_QUICK, Drive, real, simulated
from reproduce.results import Result, best_of_each
from reproduce.runner import ROOT, run_all, tasks_of
from reproduce.visual import frames_of
from terrainloop.errors import TerrainLoopError
from terrainloop.io.files import write_whole_text

STAND_INS = (
    "The paper's datasets are not public: Etna1-4 and Morocco here are simulated stand-ins "
    "(so are Mars and EtnaLidar, which go beyond the paper)."
)
BEST = (
    "Of each baseline the best of its settings on that very mission (recall at 100 % precision, then average "
    "precision): chosen in its favour. Ours and the paper's have one."
)
TIMES = (
    "Processor time, one thread, medians over the submaps and pairs of a mission, then over the missions; "
    "MB of what is kept of a submap, pickled."
)
NONE = "'-': no pair could be compared: there are no images, colours or odometry, or too little was found."
REAL = ROOT.parent / "shared/data/missions/pozo_r20"  # used if it exists
BASELINES = "reproduce.baselines."
PAPERS = ("default", "paper", "shot", "random_score")
PEERS = ("default", "fpfh", "kiss", "map_closures", "scan_context", "odometry_icp", "ibow", "random_score")
NEEDED = {  # modules with the methods that each figure or table shows
    "fig6": (),
    "fig7": (),
    "fig8": PAPERS,
    "fig8_peers": PEERS,
    "fig9": ("paper",),
    "fig10": ("default",),
    "table": tuple(dict.fromkeys((*PAPERS[:-1], *PEERS))),
}


def main() -> None:
    args = arguments()
    print(STAND_INS)
    out = args.output or Path("reproduce-quick" if args.quick else "reproduce-out")
    out.mkdir(parents=True, exist_ok=True)
    drives = drives_of(args, out)
    record_run(args, out, drives)
    keys = dict.fromkeys(key for name in args.only for key in NEEDED[name])
    if args.dense:
        keys["paper_dense"] = None
    modules = [key if key in ours.SETTINGS else BASELINES + key for key in keys]
    tasks = [task for drive in drives for task in tasks_of(drive, modules, out, first_only=args.quick)]
    results = [Result.of(task) for task in run_all(tasks, args.workers)]
    write_figures(args, out, drives, results)
    print(f"figures, tables and their numbers: {out}")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m reproduce", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "-o", "--output", type=Path, help="folder (default: reproduce-out or reproduce-quick)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="two missions of 8 submaps, one choice of settings"
    )
    parser.add_argument("--only", type=_names, default=tuple(NEEDED), help=f"some of {','.join(NEEDED)}")
    parser.add_argument(
        "--mission", type=Path, action="append", default=[], help="a real one, with truth.tum"
    )
    parser.add_argument("--workers", type=int, default=2, help="tasks at a time, one thread each")
    parser.add_argument("--dense", action="store_true", help="the paper's solver as published, too: hours")
    return parser.parse_args()


def _names(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    if unknown := set(names) - set(NEEDED):
        raise argparse.ArgumentTypeError(f"unknown {', '.join(sorted(unknown))}")
    return names


def drives_of(args: argparse.Namespace, out: Path) -> list[Drive]:
    """All missions; simulated ones are made unless they exist."""
    stand_ins, submaps = (QUICK, SUBMAPS_QUICK) if args.quick else ((*PAPER, *BEYOND), SUBMAPS)
    given = [*args.mission, *([REAL] if REAL.exists() and not args.quick else [])]
    reals = [real(path, out / "missions") for path in dict.fromkeys(path.resolve() for path in given)]
    return [*(simulated(stand_in, out / "missions", submaps) for stand_in in stand_ins), *reals]


def record_run(args: argparse.Namespace, out: Path, drives: Sequence[Drive]) -> None:
    """Write everything that the numbers depend on to settings.json."""
    record = {
        "note": STAND_INS,
        "arguments": sys.argv[1:],
        "stand_ins": [asdict(stand_in) for stand_in in (QUICK if args.quick else (*PAPER, *BEYOND))],
        "missions": {
            drive.name: {
                "folder": str(drive.path),
                "submaps": len(drive.mission),
                "pairs": len(drive.pairs()),
                "min_overlap": drive.min_overlap,
                **asdict(drive.scale),
            }
            for drive in drives
        },
        "ours": {key: settings.model_dump() for key, (_, settings) in ours.SETTINGS.items()},
        "versions": versions(),
        "machine": machine(),
        "workers": args.workers,
        "threads_per_task": 1,
    }
    write_whole_text(out / "settings.json", lambda file: json.dump(record, file, indent=2))


def machine() -> dict[str, str | int | None]:
    return {"system": platform.platform(), "processor": processor(), "cores": os.cpu_count()}


def write_figures(
    args: argparse.Namespace, out: Path, drives: Sequence[Drive], results: Sequence[Result]
) -> None:
    """Write each figure and table that was requested."""
    by_mission = {drive.name: [r for r in results if r.drive is drive] for drive in drives}
    if "fig6" in args.only:
        figures.trajectories(drives).save(out, "fig6")
    if "fig7" in args.only and (filmed := [drive for drive in drives if drive.filmed]):
        figures.visual_curves(*frames_of(filmed, out, args.workers)).save(out, "fig7")
    for name, modules in (("fig8", (*PAPERS, "paper_dense")), ("fig8_peers", PEERS)):
        if name in args.only:
            curves(by_mission, modules, out, name)
    papers = [result for result in results if result.method == ours.PAPER_PRESET]
    if "fig9" in args.only and papers:
        figures.precision_by_inliers(papers).save(out, "fig9")
    if "fig10" in args.only and (example := example_of(results)):
        figures.aligned_clouds(example).save(out, "fig10")
    if "table" in args.only:
        tables(by_mission, results, out)


def curves(by_mission: Mapping[str, Sequence[Result]], modules: Sequence[str], out: Path, name: str) -> None:
    """The curves by the paper's criterion, and those where a match is right only if its pose is."""
    methods = dict.fromkeys(r.method for results in by_mission.values() for r in results)
    looks = figures.looks_of(list(methods))
    for criterion, stem in (("overlap", name), ("pose", f"{name}_pose")):
        chosen = {
            mission: best_of_each([r for r in results if r.module in modules], criterion)
            for mission, results in by_mission.items()
        }
        title = f"A match is right by {criterion}. Of each baseline the best settings on each mission"
        figures.precision_recall_curves(chosen, criterion, looks, title).save(out, stem)


def example_of(results: Sequence[Result]) -> Result | None:
    """The default on Etna3, as in the paper's Fig. 10, or on the first mission where it found a place."""
    some = [result for result in results if result.method == ours.DEFAULT and result.registered]
    return min(some, key=lambda result: result.drive.name != "Etna3", default=None)


def tables(by_mission: Mapping[str, Sequence[Result]], results: Sequence[Result], out: Path) -> None:
    rows, spent = table.main_table(by_mission), table.times(by_mission)
    table.save(out, "table", rows, table.markdown_of_table(rows, [STAND_INS, BEST, NONE]))
    table.save(out, "times", spent, table.markdown_of_times(spent, [STAND_INS, TIMES]))
    figures.write_rows(out / "sweep.csv", table.sweep(results))
    print((out / "table.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    try:
        main()
    except TerrainLoopError as error:
        sys.exit(str(error))
