"""``terrainloop demo``: simulate a mission, detect its loops, hold them against the truth."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from terrainloop.cli import detect, match
from terrainloop.cli.terminal import Json, Quiet, Terminal, Verbose, WorkersOption

if TYPE_CHECKING:
    from terrainloop.detection.detector import LoopDetector
    from terrainloop.io.missions import Mission
    from terrainloop.io.results import SubmapRecord


def command(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for mission and results.")] = Path(
        "demo"
    ),
    world: Annotated[str, typer.Option("--world", help="etna, morocco, mars, flat or ripples.")] = "etna",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Another seed, another place.")] = 0,
    submaps: Annotated[int, typer.Option("--submaps", min=3, help="How many; 16 have loops.")] = 16,
    workers: WorkersOption = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Simulate a rover mission, find its loop closures, print the table, draw the pictures."""
    from terrainloop.config import Settings
    from terrainloop.evaluation.judge import judge
    from terrainloop.io.missions import load_mission
    from terrainloop.report import INSTALL_FIGURES, can_draw
    from terrainloop.simulation.missions import simulate_mission, write_mission

    terminal = Terminal.open(as_json, quiet, verbose)
    folder = output / "mission"
    folder.mkdir(parents=True, exist_ok=True)
    with terminal.progress() as progress:
        simulated = simulate_mission(
            world, seed, submaps, progress=lambda done, total: progress("simulated", done, total)
        )
    write_mission(simulated, folder)
    mission, settings = load_mission(folder), Settings()
    detector, records = detect.run_detection(mission, settings, output, workers, terminal)
    pairs = judge(detector.candidates, records, simulated.truth)
    pictures = _draw(output, mission, detector, records) if can_draw() else []
    summary = detect.summarise(detector.candidates, records) | {
        "false_loops": sum(not pair.pose_is_right for pair in pairs if pair.candidate),
        "true_pairs": sum(pair.overlap > 0.3 for pair in pairs),
        "true_pairs_found": sum(pair.overlap > 0.3 for pair in pairs if pair.candidate),
        "output": str(output),
        "pictures": [str(picture) for picture in pictures],
    }

    def show(console: Console) -> None:
        detect.show(console, detector, records, output)
        console.print(
            f"Against the truth: {summary['true_pairs_found']} of {summary['true_pairs']} pairs that share "
            f"over 30 % of their ground found, {summary['false_loops']} false loops."
        )
        drawn = ", ".join(summary["pictures"]) or f"none; matplotlib is missing: {INSTALL_FIGURES}"
        console.print(f"Pictures: {drawn}", markup=False)

    terminal.result(summary, show)


def _draw(
    output: Path, mission: "Mission", detector: "LoopDetector", records: Sequence["SubmapRecord"]
) -> list[Path]:
    """The mission with its loops, one gradient map, and the surest match."""
    from terrainloop.report.figures import figure_map, figure_mission, save_figure

    assert mission.truth is not None
    loops = [candidate for candidate in detector.candidates if candidate]
    best = max(detector.candidates, key=lambda candidate: candidate.score)
    source, target = detector.submaps[best.source], detector.submaps[best.target]
    pictures = [output / "mission.png", output / "map.png", output / "match.png"]
    hulls = [record.hull for record in records]
    title = f"{len(loops)} loop closures, submaps at their true poses"
    figure = figure_mission(mission.names, mission.truth.poses, hulls, loops, title=title)
    save_figure(figure, pictures[0])
    submap = mission.read(mission.names.index(best.source))
    save_figure(figure_map(submap, source.gradient_map), pictures[1])
    match.draw(source, target, best, detector.settings, pictures[2])
    return pictures
