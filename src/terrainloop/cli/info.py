"""``terrainloop info``: what is in a recording, and what would be used of it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from terrainloop.cli.terminal import Json, Quiet, Terminal, Verbose, count_of, table_of
from terrainloop.errors import printable

if TYPE_CHECKING:
    from terrainloop.io.recordings import Recording, Stream

HELP = """Show what is in a bag, a folder of scans or a mission, what would be used, and what is missing.

Bags of ROS 1 and ROS 2 (sqlite3 and MCAP), their folders, several files of one recording."""

CloudTopicOption = Annotated[
    str | None,
    typer.Option("--cloud-topic", help="Topic of the scans.", show_default="found by type"),
]
OdometryTopicOption = Annotated[
    str | None,
    typer.Option("--odometry-topic", help="Topic of the poses.", show_default="found by type"),
]
SensorFrameOption = Annotated[
    str,
    typer.Option(
        "--sensor-frame",
        help="Frame of the scans: auto (by TF), optical (a camera, z forward), body (that of the odometry) "
        "or the name of a frame.",
    ),
]


def command(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="INPUT...", help="A bag, its folder, its files, or a folder of scans."),
    ],
    cloud_topic: CloudTopicOption = None,
    odometry_topic: OdometryTopicOption = None,
    sensor_frame: SensorFrameOption = "auto",
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop info``."""
    from terrainloop.io.recordings import open_recording

    terminal = Terminal.open(as_json, quiet, verbose)
    recording = open_recording(
        paths, cloud_topic=cloud_topic, odometry_topic=odometry_topic, sensor_frame=sensor_frame
    )
    terminal.result(summarise(recording), lambda console: show(console, recording))


def summarise(recording: "Recording") -> dict[str, Any]:
    """The description as JSON holds it."""
    from dataclasses import asdict

    description = recording.description
    return {
        "path": description.path,
        "kind": description.kind,
        "sensor": recording.sensor,
        "usable": not description.missing,
        "scans": recording.count,
        "streams": [asdict(stream) for stream in description.streams],
        "remarks": list(description.remarks),
        "missing": [str(missing) for missing in description.missing],
    }


def show(console: Console, recording: "Recording") -> None:
    """The description as a table and sentences."""
    description = recording.description
    columns = ("name", "type", "count", "frame", "from, s", "to, s", "used as")
    title = printable(f"{description.path}: {description.kind}")
    console.print(table_of(title, columns, [_row(stream) for stream in description.streams]))
    console.print()
    for words in description.remarks:
        console.print(printable(f"Note: {words}."))
    for missing in description.missing:
        console.print(printable(f"Missing: {missing}."))
    if description.missing:
        console.print("It cannot be used as it is.")
    else:
        made = "" if recording.sensor == "unknown" else f" of a {_SENSORS[recording.sensor]}"
        console.print(f"It can be used: {count_of(recording.count, 'scan')}{made}.")


_SENSORS = {"lidar": "LiDAR", "stereo": "stereo or depth camera"}


def _row(stream: "Stream") -> list[str]:
    start, end = (
        "" if stamp is None else f"{stamp:.3f}".rstrip("0").rstrip(".")
        for stamp in (stream.start, stream.end)
    )
    names = (printable(text) for text in (stream.name, stream.type))
    return [*names, str(stream.count), printable(stream.frame), start, end, stream.use]
