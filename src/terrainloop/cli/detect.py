"""``terrainloop detect``: the loop closures of a mission."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console

from terrainloop.cli.terminal import (
    AllowedOption,
    ConfigOption,
    Json,
    PresetOption,
    Quiet,
    SeedOption,
    Terminal,
    Verbose,
    WorkersOption,
    check_folder,
    count_of,
    read_settings,
    table_of,
    worker_count,
)
from terrainloop.errors import printable

if TYPE_CHECKING:
    from terrainloop.detection.run import Run
    from terrainloop.loop import LoopCandidate


HELP = """Find the loop closures among the submaps of a mission.

Writes loops.csv (accepted), pairs.csv (every pair compared, with the reason), submaps.csv (every
cloud, with repairs and errors), run.json (fitted hyperparameters, counts) and config.yaml (all settings)."""


def command(
    mission: Annotated[Path, typer.Argument(help="Folder of clouds, one submap per file, in metres.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")],
    all_pairs: Annotated[
        bool, typer.Option("--all-pairs", help="Also compare consecutive submaps, for evaluation.")
    ] = False,
    max_false_loops: AllowedOption = None,
    preset: PresetOption = "default",
    config: ConfigOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop detect``."""
    from terrainloop.detection.mission import detect_mission

    terminal = Terminal.open(as_json, quiet, verbose)
    check_folder(output)
    settings = read_settings(preset, config, seed, max_false_loops)
    if all_pairs:
        settings = settings.model_copy(update={"skip_recent": 0})
    with terminal.progress() as progress:
        run = detect_mission(
            mission, settings, output=output, workers=worker_count(workers), on_progress=progress
        )
    terminal.result(summarise(run), lambda console: show(console, run))


def summarise(run: "Run") -> dict[str, Any]:
    """The run in numbers, for JSON."""
    from dataclasses import asdict

    from terrainloop.io.results import loop_to_dict

    usable = [record for record in run.submaps if record.status == "ok"]
    return {
        "submaps": len(usable),
        "broken": {record.name: record.notes for record in run.submaps if record.status == "broken"},
        "repaired": {record.name: record.notes for record in usable if record.notes},
        "hyperparameters": None if run.parameters is None else asdict(run.parameters),
        "pairs": run.num_pairs,
        "complete": run.complete,
        "warnings": list(run.warnings),
        "rejections": dict(run.rejections),
        "loops": [loop_to_dict(loop) for loop in run.loops],
        "corrected": run.corrected is not None,
        "output": str(run.folder),
    }


def show(console: Console, run: "Run") -> None:
    """The run as a table and a few sentences."""
    columns = ("source", "target", "x, m", "y, m", "z, m", "yaw", "+/- m", "score", "shared")
    if run.loops:
        console.print(table_of("Loop closures", columns, [_row(loop) for loop in run.loops]))
    usable = [record for record in run.submaps if record.status == "ok"]
    console.print(
        f"\n{count_of(len(run.loops), 'loop closure')} in {count_of(run.num_pairs, 'pair')} "
        f"of {count_of(len(usable), 'submap')}."
    )
    if run.loops:
        console.print("The transform takes points of source into the frame of target; yaw in degrees.")
    if len(usable) < 2:
        console.print("No pair was compared: a loop closure needs two submaps.")
    elif run.num_pairs == 0 and run.complete:
        console.print(
            f"No pair was compared: the {count_of(run.settings.skip_recent, 'submap')} just before each are "
            "skipped. Use --all-pairs to compare them too, or 'terrainloop match A B' for two clouds."
        )
    if not run.complete:
        console.print("Incomplete: interrupted before every pair was compared.")
    if run.parameters is not None:
        p = run.parameters
        console.print(
            f"Fitted: length scale {p.length_scale:.3g} m, relief {p.variance**0.5:.3g} m, "
            f"noise {p.noise:.2g} m."
        )
    for kind, count in run.rejections.items():
        console.print(f"  {count_of(count, 'pair')} rejected: {kind}")
    for record in run.submaps:
        if record.status == "broken":
            console.print(f"  left out {printable(f'{record.name}: {record.notes}')}")
    repaired = sum(bool(record.notes) for record in usable)
    for words in run.warnings:
        console.print(f"Warning: {words}.")
    if repaired:
        console.print(f"  {count_of(repaired, 'submap')} with repairs or warnings: see notes in submaps.csv")
    poses = ", poses.tum and graph.g2o (odometry corrected by the loops)" if run.corrected else ""
    console.print(
        f"Written to {printable(str(run.folder))}: loops.csv, pairs.csv (why each was rejected), "
        f"submaps.csv, config.yaml, run.json{poses}"
    )


def _row(loop: "LoopCandidate") -> list[str]:
    from terrainloop.geometry import parameters_of

    x, y, z, _, _, yaw = parameters_of(loop.T_target_source)
    spread = np.sqrt(max(loop.covariance[0, 0], loop.covariance[1, 1]))
    return [
        loop.source,
        loop.target,
        f"{x:.2f}",
        f"{y:.2f}",
        f"{z:.2f}",
        f"{np.degrees(yaw):.1f}",
        f"{spread:.2f}",
        f"{loop.score:.1f}",
        f"{loop.overlap:.0%}",
    ]
