"""``terrainloop slam``: from a bag or a folder of posed scans to a corrected trajectory and a map."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console

from terrainloop.cli import detect
from terrainloop.cli.info import CloudTopicOption, OdometryTopicOption, SensorFrameOption
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
    worker_count,
)
from terrainloop.errors import printable

if TYPE_CHECKING:
    from terrainloop.evaluation.trajectory_error import TrajectoryError
    from terrainloop.io.trajectories import Trajectory
    from terrainloop.slam.run import SlamRun

HELP = """Correct the trajectory of a bag or a folder of posed scans by the loop closures that its scans show.

Writes trajectory.tum (every scan, corrected), uncorrected.tum (as recorded), poses.tum and graph.g2o
(submaps), loops.csv and pairs.csv, map.ply (points), map.tif (elevation and gradient) and pictures."""


def command(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="INPUT...", help="A bag, its folder, its files, or a folder of scans."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")],
    cloud_topic: CloudTopicOption = None,
    odometry_topic: OdometryTopicOption = None,
    sensor_frame: SensorFrameOption = "auto",
    length: Annotated[
        float | None,
        typer.Option(
            "--length",
            min=0.01,
            help="Metres driven in one submap.",
            show_default="as far as the sensor sees",
        ),
    ] = None,
    min_range: Annotated[
        float,
        typer.Option("--min-range", min=0.0, help="Metres: what is nearer to the sensor is the vehicle."),
    ] = 0.5,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="True poses (TUM or KITTI), to compare with.")
    ] = None,
    max_false_loops: AllowedOption = None,
    preset: PresetOption = "default",
    config: ConfigOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop slam``."""
    from terrainloop.io.recordings import MISSION_KIND, open_recording
    from terrainloop.io.trajectories import read_trajectory
    from terrainloop.slam.run import run_slam
    from terrainloop.slam.submapping import Submapper

    terminal = Terminal.open(as_json, quiet, verbose)
    settings = read_settings(preset, config, seed, max_false_loops)
    check_folder(output)
    true = None if truth is None else read_trajectory(truth)
    recording = open_recording(
        paths, cloud_topic=cloud_topic, odometry_topic=odometry_topic, sensor_frame=sensor_frame
    )
    with terminal.progress() as progress:
        result = run_slam(
            recording.scans(),
            settings,
            submapper=Submapper(length, min_range, settings.seed, each_scan=recording.kind == MISSION_KIND),
            output=output,
            workers=worker_count(workers),
            on_progress=progress,
            count=recording.count,
        )
    summary = summarise(result, dict(recording.dropped))
    errors = {} if true is None else errors_of(result, true)
    summary |= {name: error.as_dict() for name, error in errors.items()}
    try:
        summary["pictures"] = _draw(result, true, output)
    finally:
        terminal.result(summary, partial(_show, result, summary, errors))


def summarise(result: "SlamRun", dropped: dict[str, int]) -> dict[str, Any]:
    """The result in numbers, for JSON."""
    return detect.summarise(result.run) | {"scans": len(result.trajectory), "dropped_scans": dropped}


def errors_of(result: "SlamRun", true: "Trajectory") -> dict[str, "TrajectoryError"]:
    """Errors of the trajectory as recorded and as corrected, aligned by yaw and position."""
    from terrainloop.evaluation.trajectory_error import trajectory_error

    return {
        "before": trajectory_error(result.odometry, true),
        "after": trajectory_error(result.trajectory, true),
    }


def _show(
    result: "SlamRun", summary: dict[str, Any], errors: dict[str, "TrajectoryError"], console: Console
) -> None:
    from terrainloop.report import INSTALL_FIGURES, can_draw
    from terrainloop.slam.run import PRODUCTS

    detect.show(console, result.run)
    console.print(f"SLAM: {', '.join(PRODUCTS)}")
    moved = result.largest_correction
    console.print(
        f"{count_of(len(result.trajectory), 'scan')} in {count_of(len(result.submaps), 'submap')}; "
        f"the loops moved the trajectory by up to {moved:.2f} m."
    )
    for reason, count in summary["dropped_scans"].items():
        console.print(f"  {count_of(count, 'scan')} dropped: {reason}")
    if errors:
        before, after = (errors[name].absolute.statistics[0].rms for name in ("before", "after"))
        console.print(f"Against the truth: {before:.3g} m rms as recorded, {after:.3g} m corrected.")
    without = "none" if can_draw() else f"none; matplotlib is missing: {INSTALL_FIGURES}"
    console.print("Pictures: " + (printable(", ".join(summary["pictures"])) or without))


def _draw(result: "SlamRun", true: "Trajectory | None", output: Path) -> list[str]:
    """Draw what can be drawn into the output; the names of the pictures."""
    from terrainloop.report import can_draw

    if not can_draw():
        return []
    from terrainloop.report.figures import figure_mosaic, figure_trajectory, save_figure

    corrected = result.run.corrected
    ends = np.empty((0, 2, 2)) if corrected is None else corrected.loop_ends
    pictures = {
        "trajectory.png": figure_trajectory(result.odometry, result.trajectory, ends, true),
        "relief.png": figure_mosaic(result.mosaic),
    }
    for name, figure in pictures.items():
        save_figure(figure, output / name)
    return [str(output / name) for name in pictures]
