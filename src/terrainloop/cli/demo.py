"""``terrainloop demo``: simulate a mission, detect its loops, compare them with the ground truth."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console

from terrainloop.cli import detect
from terrainloop.cli.terminal import (
    AllowedOption,
    Json,
    Quiet,
    Terminal,
    Verbose,
    WorkersOption,
    alternatives,
    check_folder,
    worker_count,
)
from terrainloop.errors import printable
from terrainloop.simulation.names import WORLDS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from terrainloop.detection.run import Run
    from terrainloop.geometry import Array
    from terrainloop.io.missions import Mission


HELP = "Simulate a rover mission, find its loop closures, compare them with the truth, draw figures."


def command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the mission and the results.")
    ] = Path("demo"),
    world: Annotated[str, typer.Option("--world", help=f"{alternatives(WORLDS)}.")] = "etna",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the terrain and the drive.")] = 0,
    submaps: Annotated[
        int, typer.Option("--submaps", min=3, help="Number of submaps; with 16 there are loop closures.")
    ] = 16,
    max_false_loops: AllowedOption = None,
    workers: WorkersOption = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop demo``."""
    from terrainloop.config import Settings
    from terrainloop.detection.mission import detect_mission
    from terrainloop.io.missions import load_mission
    from terrainloop.report import can_draw
    from terrainloop.simulation.missions import simulate_mission, write_mission, written_before

    terminal = Terminal.open(as_json, quiet, verbose)
    settings = Settings().with_max_false_loops(max_false_loops)
    folder = output / "mission"
    check_folder(folder)
    written_before(folder)  # refuse before the work is done
    number = worker_count(workers)
    with terminal.progress() as progress:
        simulated = simulate_mission(world, seed, submaps, progress=partial(progress, "simulated"))
    write_mission(simulated, folder)
    mission = load_mission(folder)
    with terminal.progress() as progress:
        run = detect_mission(mission, settings, output=output, workers=number, on_progress=progress)
    pictures: list[str] = []
    summary = detect.summarise(run) | _against_truth(run, simulated.truth) | {"pictures": pictures}
    try:
        if run.complete and can_draw():
            from terrainloop.report.figures import save_figure

            for picture, figure in _figures(mission, run):
                save_figure(figure, output / picture)
                pictures.append(str(output / picture))
    finally:  # the results are there even if the pictures fail
        terminal.result(summary, partial(_show, run, summary))


def _against_truth(run: "Run", truth: "Array") -> dict[str, float]:
    """Errors of the trajectory, false loops, true pairs and those of them found, for JSON."""
    from terrainloop.evaluation.pairs import evaluate_pairs
    from terrainloop.evaluation.truth import MIN_OVERLAP, GroundTruth

    pairs = evaluate_pairs(list(run.pairs()), GroundTruth(run.submaps, truth))
    odometry, corrected = _trajectory_errors(run, truth)
    return {
        "odometry_ate_m": odometry,
        "corrected_ate_m": corrected,
        "false_loops": sum(not pair.pose_is_right for pair in pairs if pair.candidate),
        "true_pairs": sum(pair.overlap > MIN_OVERLAP for pair in pairs),
        "true_pairs_found": sum(pair.overlap > MIN_OVERLAP for pair in pairs if pair.candidate),
    }


def _trajectory_errors(run: "Run", truth: "Array") -> tuple[float, float]:
    """Absolute trajectory errors of odometry and of the corrected poses, metres rms; NaN without them."""
    from terrainloop.evaluation.trajectory_error import trajectory_error
    from terrainloop.io.trajectories import Trajectory

    if run.corrected is None:
        return np.nan, np.nan
    graph = run.corrected.graph
    true = Trajectory(np.array([record.stamp for record in run.submaps]), truth)
    before, after = (
        trajectory_error(Trajectory(graph.stamps, poses), true).absolute.statistics[0].rms
        for poses in (graph.odometry, run.corrected.poses)
    )
    return before, after


def _show(run: "Run", summary: dict[str, Any], console: Console) -> None:
    from terrainloop.evaluation.truth import MIN_OVERLAP
    from terrainloop.report import INSTALL_FIGURES, can_draw

    detect.show(console, run)
    console.print(
        f"Against the ground truth: {summary['true_pairs_found']} of {summary['true_pairs']} pairs that "
        f"share over {MIN_OVERLAP:.0%} of their ground found, {summary['false_loops']} false loops."
    )
    if run.corrected is not None:
        before, after = summary["odometry_ate_m"], summary["corrected_ate_m"]
        console.print(
            f"Trajectory: off by {before:.2f} m rms by odometry, by {after:.2f} m corrected by the loops: "
            f"{before / after:.1f} times better."
        )
    without = "none" if can_draw() else f"none; matplotlib is missing: {INSTALL_FIGURES}"
    console.print("Pictures: " + (printable(", ".join(summary["pictures"])) or without))


def _figures(mission: "Mission", run: "Run") -> Iterator[tuple[str, "Figure"]]:
    """The mission with its loops, the trajectory, one gradient map, and the match with the highest score."""
    from terrainloop.io.trajectories import Trajectory
    from terrainloop.report.figures import figure_map, figure_match, figure_mission, figure_trajectory

    assert mission.truth is not None
    best = max(run.pairs(), key=lambda candidate: candidate.score)
    source, target = run.entries[best.source], run.entries[best.target]
    hulls = [record.hull for record in run.submaps]
    title = f"{len(run.loops)} loop closures, submaps at their true poses"
    yield "mission.png", figure_mission(mission.names, mission.truth.poses, hulls, run.loops, title=title)
    if run.corrected is not None:
        graph = run.corrected.graph
        before, after = (Trajectory(graph.stamps, poses) for poses in (graph.odometry, run.corrected.poses))
        true = Trajectory(mission.truth.stamps, mission.truth.poses)
        yield "trajectory.png", figure_trajectory(before, after, run.corrected.loop_ends, true)
    yield "map.png", figure_map(mission.read(mission.names.index(best.source)), source.gradient_map)
    yield "match.png", figure_match(source, target, best, run.settings)
