"""``terrainloop match``: two clouds, loop or not."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console

from terrainloop.cli.terminal import (
    ConfigOption,
    Json,
    PresetOption,
    Quiet,
    SeedOption,
    Terminal,
    Verbose,
    WorkersOption,
    read_settings,
    worker_count,
)

if TYPE_CHECKING:
    from terrainloop.config import Settings
    from terrainloop.loop import LoopCandidate
    from terrainloop.matching.mapped import MappedSubmap


def command(
    source: Annotated[Path, typer.Argument(help="Cloud A, metres, gravity-aligned.")],
    target: Annotated[Path, typer.Argument(help="Cloud B, metres, gravity-aligned.")],
    figure: Annotated[Path | None, typer.Option("--figure", help="Draw the match, PNG.")] = None,
    preset: PresetOption = "default",
    config: ConfigOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Match cloud A against cloud B: a loop closure or not, and the transform from A to B."""
    from terrainloop.detection.detector import fit_database, map_submap
    from terrainloop.io.clouds import read_cloud
    from terrainloop.matching.register import compare

    terminal = Terminal.open(as_json, quiet, verbose)
    settings = read_settings(preset, config, seed)
    submaps = [read_cloud(source), read_cloud(target)]
    with terminal.progress() as progress:
        progress("maps", 0, 2)
        shared = settings.map.fit == "database"
        parameters = fit_database(submaps, settings, workers=worker_count(workers)) if shared else None
        mapped = []
        for done, submap in enumerate(submaps, start=1):
            mapped.append(map_submap(submap, settings, parameters, workers=worker_count(workers)))
            progress("maps", done, 2)
    candidate = compare(mapped[0], mapped[1], settings)
    if figure is not None:
        draw(mapped[0], mapped[1], candidate, settings, figure)
    terminal.result(_summary(candidate), lambda console: _show(console, candidate))


def draw(
    source: "MappedSubmap",
    target: "MappedSubmap",
    candidate: "LoopCandidate",
    settings: "Settings",
    path: Path,
) -> None:
    """The picture of a pair that was compared."""
    from terrainloop.geometry import se2, yaw_of
    from terrainloop.matching.correspondences import associate
    from terrainloop.matching.ransac import get_inliers, inlier_radius_of
    from terrainloop.report.figures import figure_match, save_figure

    associations = associate(source.features, target.features)
    T = candidate.T_target_source
    planar = se2(T[0, 3], T[1, 3], yaw_of(T))
    radius = inlier_radius_of(settings, target.gradient_map)
    inliers = get_inliers(associations, planar[None], radius)[0]
    save_figure(
        figure_match(source.gradient_map, target.gradient_map, candidate, associations, inliers), path
    )


def _summary(candidate: "LoopCandidate") -> dict[str, Any]:
    return {
        "source": candidate.source,
        "target": candidate.target,
        "accepted": candidate.accepted,
        "reason": candidate.reason,
        "T_target_source": candidate.T_target_source.tolist(),
        "covariance": candidate.covariance.tolist(),
        "inliers": candidate.inliers,
        "ssd": candidate.ssd,
        "ssd_ratio": candidate.ssd_ratio,
        "overlap": candidate.overlap,
        "score": candidate.score,
        "found_by": candidate.found_by,
        "correlation": candidate.correlation,
    }


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
    console.print(
        f"  overlap {candidate.overlap:.0%}; takes points of {candidate.source} into {candidate.target}"
    )
