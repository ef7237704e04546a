"""``terrainloop simulate``: a mission with known truth."""

from pathlib import Path
from typing import Annotated

import typer

from terrainloop.cli.terminal import Json, Quiet, Terminal, Verbose, alternatives, check_folder, count_of
from terrainloop.errors import printable
from terrainloop.simulation.names import SENSORS, WORLDS

HELP = "Simulate a rover's drive over rough ground: clouds, drifting odometry.tum, truth.tum."


def command(
    output: Annotated[Path, typer.Option("-o", "--output", help="Mission folder to write.")],
    world: Annotated[str, typer.Option("--world", help=f"{alternatives(WORLDS)}.")] = "etna",
    seed: Annotated[int, typer.Option("--seed", help="Seed of the terrain and the drive.")] = 0,
    submaps: Annotated[
        int, typer.Option("--submaps", help="Number of submaps; with 16 there are loop closures.")
    ] = 16,
    sensor: Annotated[str, typer.Option("--sensor", help=f"{alternatives(SENSORS)}.")] = "stereo",
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop simulate``."""
    from terrainloop.simulation.missions import simulate_mission, write_mission, written_before

    terminal = Terminal.open(as_json, quiet, verbose)
    check_folder(output)
    written_before(output)  # refuse before the work is done
    with terminal.progress() as progress:
        mission = simulate_mission(
            world, seed, submaps, sensor, progress=lambda done, total: progress("submaps", done, total)
        )
    write_mission(mission, output)
    points = sum(len(cloud) for cloud in mission.clouds)
    summary = {
        "output": str(output),
        "world": world,
        "seed": seed,
        "sensor": sensor,
        "submaps": len(mission.clouds),
        "points": points,
    }
    terminal.result(
        summary,
        lambda console: console.print(
            f"{count_of(len(mission.clouds), 'submap')}, {points:,} points, "
            f"written to {printable(str(output))}. Next: terrainloop detect {printable(str(output))} -o OUT"
        ),
    )
