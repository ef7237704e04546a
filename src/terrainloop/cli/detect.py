"""``terrainloop detect``: the loops of a mission."""

from collections import Counter
from collections.abc import Sequence
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
    count_of,
    read_settings,
    table_of,
    worker_count,
)

if TYPE_CHECKING:
    from terrainloop.config import Settings
    from terrainloop.detection.detector import LoopDetector
    from terrainloop.io.missions import Mission
    from terrainloop.io.results import SubmapRecord
    from terrainloop.loop import LoopCandidate


def command(
    mission: Annotated[Path, typer.Argument(help="Folder of clouds, one submap a file, in metres.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")],
    all_pairs: Annotated[
        bool, typer.Option("--all-pairs", help="Compare consecutive submaps too, for evaluation.")
    ] = False,
    preset: PresetOption = "default",
    config: ConfigOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Find the loop closures among the submaps of a mission.

    Writes loops.csv (accepted), pairs.csv (every pair compared, with the reason), submaps.csv (every
    cloud, with repairs and errors) and config.yaml (the settings as run).
    """
    from terrainloop.io.missions import load_mission

    terminal = Terminal.open(as_json, quiet, verbose)
    settings = read_settings(preset, config, seed)
    if all_pairs:
        settings = settings.model_copy(update={"skip_recent": 0})
    detector, records = run_detection(load_mission(mission), settings, output, workers, terminal)
    summary = summarise(detector.candidates, records)
    terminal.result(
        summary | {"output": str(output)}, lambda console: show(console, detector, records, output)
    )


def run_detection(
    mission: "Mission", settings: "Settings", output: Path, workers: int, terminal: Terminal
) -> tuple["LoopDetector", list["SubmapRecord"]]:
    """Detect with progress bars and write the results."""
    from terrainloop.detection.mission import detect_mission
    from terrainloop.io.results import write_loops, write_submaps

    output.mkdir(parents=True, exist_ok=True)
    with terminal.progress() as progress:
        detector, records = detect_mission(
            mission, settings, workers=worker_count(workers), on_progress=progress
        )
    (output / "config.yaml").write_text(settings.to_yaml(), encoding="utf-8")
    write_submaps(output / "submaps.csv", records)
    write_loops(output / "pairs.csv", detector.candidates)
    write_loops(output / "loops.csv", [candidate for candidate in detector.candidates if candidate])
    return detector, records


def summarise(candidates: Sequence["LoopCandidate"], records: Sequence["SubmapRecord"]) -> dict[str, Any]:
    """The run in numbers, for JSON."""
    from terrainloop.geometry import parameters_of

    return {
        "submaps": sum(record.status == "ok" for record in records),
        "broken": {record.name: record.notes for record in records if record.status == "broken"},
        "repaired": {r.name: r.notes for r in records if r.status == "ok" and r.notes},
        "pairs": len(candidates),
        "loops": [
            {
                "source": loop.source,
                "target": loop.target,
                "transform": dict(
                    zip(
                        ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad"),
                        parameters_of(loop.T_target_source).tolist(),
                        strict=True,
                    )
                ),
                "inliers": loop.inliers,
                "ssd_ratio": loop.ssd_ratio,
                "overlap": loop.overlap,
                "score": loop.score,
                "found_by": loop.found_by,
                "correlation": loop.correlation,
                "reason": loop.reason,
            }
            for loop in candidates
            if loop
        ],
    }


def show(console: Console, detector: "LoopDetector", records: Sequence["SubmapRecord"], output: Path) -> None:
    """The run as a table and a few sentences."""
    loops = [candidate for candidate in detector.candidates if candidate]
    columns = ("source", "target", "x, m", "y, m", "z, m", "yaw", "+/- m", "score", "shared")
    console.print(table_of("Loop closures", columns, [_row(loop) for loop in loops]))
    usable = sum(record.status == "ok" for record in records)
    console.print(
        f"\n{count_of(len(loops), 'loop closure')} in {count_of(len(detector.candidates), 'pair')} "
        f"of {count_of(usable, 'submap')}. "
        "The transform takes points of source into the frame of target; yaw in degrees."
    )
    for count, kind in rejections(detector.candidates):
        console.print(f"  {count_of(count, 'pair')} rejected: {kind}")
    for record in records:
        if record.status == "broken":
            console.print(f"  left out {record.name}: {record.notes}")
    repaired = sum(record.status == "ok" and bool(record.notes) for record in records)
    if repaired:
        console.print(f"  {count_of(repaired, 'submap')} repaired on the way in: see notes in submaps.csv")
    console.print(
        f"Written to {output}: loops.csv, pairs.csv (why each was rejected), submaps.csv, config.yaml"
    )


def rejections(candidates: Sequence["LoopCandidate"]) -> list[tuple[int, str]]:
    """How many pairs were rejected for which kind of reason, most frequent first."""
    kinds = Counter(candidate.reason.partition(":")[0] for candidate in candidates if not candidate)
    return [(count, kind) for kind, count in kinds.most_common()]


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
