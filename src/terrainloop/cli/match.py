"""``terrainloop match``: two clouds, loop or not."""

import logging
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    check_output,
    read_settings,
    worker_count,
)

if TYPE_CHECKING:
    from terrainloop.loop import LoopCandidate

logger = logging.getLogger(__name__)


HELP = "Match cloud A against cloud B: a loop closure or not, and the transform from A to B."


def command(
    source: Annotated[Path, typer.Argument(help="Cloud A, metres, gravity-aligned.")],
    target: Annotated[Path, typer.Argument(help="Cloud B, metres, gravity-aligned.")],
    figure: Annotated[Path | None, typer.Option("--figure", help="Draw the match, PNG.")] = None,
    max_false_loops: AllowedOption = None,
    preset: PresetOption = "default",
    config: ConfigOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop match``."""
    from terrainloop.detection.detector import map_pair
    from terrainloop.io.clouds import read_cloud
    from terrainloop.io.results import loop_to_dict
    from terrainloop.matching.register import compare

    terminal = Terminal.open(as_json, quiet, verbose)
    settings = read_settings(preset, config, seed, max_false_loops)
    if figure is not None:
        check_output(figure, (".png",))
        import_module("terrainloop.report.figures")  # refuses where matplotlib is missing
    submaps = read_cloud(source), read_cloud(target)
    with terminal.progress() as progress:
        progress("match", 0, 2)
        entries = map_pair(*submaps, settings, workers=worker_count(workers))
        for entry in entries:
            logger.info("%s", entry.summary)
        progress("match", 1, 2)
        candidate = compare(*entries, settings)
        progress("match", 2, 2)
    terminal.result(loop_to_dict(candidate), lambda console: _show(console, candidate))
    if figure is not None:
        from terrainloop.report.figures import figure_match, save_figure

        save_figure(figure_match(*entries, candidate, settings), figure)


def _show(console: Console, candidate: "LoopCandidate") -> None:
    from terrainloop.geometry import parameters_of

    verdict = "loop closure" if candidate else "no loop closure"
    console.print(f"{candidate.source} to {candidate.target}: {verdict}: {candidate.reason}")
    if not candidate:
        return
    values, spread = parameters_of(candidate.T_target_source), np.sqrt(np.diag(candidate.covariance))
    for name, value, sigma in zip(("x", "y", "z"), values[:3], spread[:3], strict=True):
        console.print(f"  {name:6}{value:10.3f} +/- {sigma:.3f} m")
    for name, value, sigma in zip(
        ("roll", "pitch", "yaw"), np.degrees(values[3:]), np.degrees(spread[3:]), strict=True
    ):
        console.print(f"  {name:6}{value:10.3f} +/- {sigma:.3f} deg")
    if candidate.source_origin.any() or candidate.target_origin.any():
        console.print("  the +/- are those about points near the clouds: their frames' origins are far away")
    console.print(
        f"  overlap {candidate.overlap:.0%}; takes points of {candidate.source} into {candidate.target}"
    )
