"""``terrainloop simulate``: a mission with known truth."""

from pathlib import Path
from typing import Annotated

import typer

from terrainloop.cli.terminal import Json, Quiet, Terminal, Verbose, alternatives, check_folder, count_of
from terrainloop.errors import TerrainLoopError, printable
from terrainloop.simulation.names import SENSORS, WORLDS

HELP = """Simulate a rover's drive over rough ground, with drifting odometry and the truth.

A mission of submaps for 'terrainloop detect'; with --length, scans for 'terrainloop slam', a folder or
a bag."""


def command(
    output: Annotated[Path, typer.Option("-o", "--output", help="Mission folder to write.")],
    world: Annotated[str, typer.Option("--world", help=f"{alternatives(WORLDS)}.")] = "etna",
    seed: Annotated[int, typer.Option("--seed", help="Seed of the terrain and the drive.")] = 0,
    submaps: Annotated[
        int, typer.Option("--submaps", help="Number of submaps; with 16 there are loop closures.")
    ] = 16,
    sensor: Annotated[str, typer.Option("--sensor", help=f"{alternatives(SENSORS)}.")] = "stereo",
    length: Annotated[
        float | None,
        typer.Option("--length", min=1.0, help="Metres to drive: write its scans instead of submaps."),
    ] = None,
    bag: Annotated[
        str | None, typer.Option("--bag", help="mcap, sqlite3 or ros1: write the scans as a bag.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop simulate``."""
    from terrainloop.simulation.missions import simulate_mission, write_mission, written_before

    terminal = Terminal.open(as_json, quiet, verbose)
    if length is not None:
        _drive(terminal, output, world, seed, sensor, length, bag)
        return
    if bag is not None:
        raise TerrainLoopError(
            expected="--length with --bag, since a bag holds scans", found="none", mend="add --length 300"
        )
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


def _drive(
    terminal: Terminal, output: Path, world: str, seed: int, sensor: str, length: float, bag: str | None
) -> None:
    """Write the scans of a drive."""
    from terrainloop.simulation.drives import simulate_drive, write_scans

    drive = simulate_drive(world, seed, length=length, sensor=sensor)
    if bag is None:
        write_scans(drive, output)
    else:
        from terrainloop.simulation.bags import write_bag

        write_bag(drive, output, bag)
    summary = {
        "output": str(output),
        "world": world,
        "seed": seed,
        "sensor": sensor,
        "scans": len(drive.stamps),
        "length_m": drive.length,
        "odometry_off_m": drive.off_at_the_end,
    }
    terminal.result(
        summary,
        lambda console: console.print(
            f"{count_of(len(drive.stamps), 'scan')} on {drive.length:.0f} m, odometry off by "
            f"{drive.off_at_the_end:.1f} m at the end, written to {printable(str(output))}. "
            f"Next: terrainloop slam {printable(str(output))} -o OUT"
        ),
    )
