"""Recordings: scans with poses, from ROS bags, folders of scans or missions of submaps."""

import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from terrainloop.errors import TerrainLoopError
from terrainloop.io.files import as_path
from terrainloop.scan import PosedScan

logger = logging.getLogger(__name__)

Sensor = Literal["lidar", "stereo", "unknown"]
PathOrPaths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]

MISSION_KIND = "mission of submaps"
"""Of a recording whose scans are submaps already."""

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
"""Suffixes, in lower case, of the files of ROS bags."""


@dataclass(frozen=True)
class Stream:
    """One topic of a bag, or one kind of files of a folder.

    Attributes
    ----------
    name, type : str
        Name of the topic or the files, and type of its messages or format.
    count : int
    frame : str
        Frame that the data is in, empty if it is not known.
    start, end : float or None
        Stamps of the first and the last, seconds.
    use : str
        What it is used for, empty if it is not.
    """

    name: str
    type: str
    count: int
    frame: str = ""
    start: float | None = None
    end: float | None = None
    use: str = ""


@dataclass(frozen=True)
class Missing:
    """What keeps a recording from being used, and what to do about it."""

    what: str
    fix: str

    def __str__(self) -> str:
        return f"{self.what}: {self.fix}"


@dataclass(frozen=True)
class Description:
    """What a recording holds, what would be used of it, and what is missing.

    Attributes
    ----------
    kind : str
        In words.
    path : str
    streams : tuple of Stream
    remarks : tuple of str
        What was chosen and assumed, in sentences.
    missing : tuple of Missing
        Empty if the recording can be used.
    """

    kind: str
    path: str
    streams: tuple[Stream, ...]
    remarks: tuple[str, ...] = ()
    missing: tuple[Missing, ...] = ()


@dataclass(eq=False, repr=False)
class Recording:
    """Scans with poses in the order of their stamps, read on demand.

    Attributes
    ----------
    description : Description
    sensor : {"lidar", "stereo", "unknown"}
        What made the scans; "stereo" for every depth image, too.
    count : int
        Number of scans, with those that will be dropped.
    dropped : Counter
        Number of scans that the last iteration left out, by reason in words.
    """

    description: Description
    sensor: Sensor
    count: int
    _read: Callable[[Counter[str]], Iterator[PosedScan]]
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def kind(self) -> str:
        """What the recording is, in words."""
        return self.description.kind

    def __repr__(self) -> str:
        return f"Recording({self.description.path}, {self.kind}, {self.count} scans)"

    def scans(self) -> Iterator[PosedScan]:
        """Iterate over the scans, each with the pose interpolated at its stamp.

        Scans that have no pose, no points or no stamp, or that are damaged, are dropped; `dropped` counts
        them, and a warning reports them at the end.

        Raises
        ------
        TerrainLoopError
            If something is missing, no scan remains, or the recording is damaged.
        """
        for missing in self.description.missing:
            raise self._unusable(missing.what, missing.fix)
        self.dropped.clear()
        used = 0
        for scan in self._read(self.dropped):
            used += 1
            yield scan
        words = "; ".join(f"{count} {reason}" for reason, count in self.dropped.items())
        if not used:
            raise self._unusable(
                f"no scan that can be used: {words or 'none recorded'}", "see what 'terrainloop info' reports"
            )
        if words:
            logger.warning("%s: dropped scans: %s", self.description.path, words)

    def _unusable(self, found: str, mend: str) -> TerrainLoopError:
        return TerrainLoopError(
            expected="scans with odometry", found=f"{self.description.path}: {found}", mend=mend
        )


def no_scans(_dropped: Counter[str]) -> Iterator[PosedScan]:
    """The scans of a recording that lacks what it takes to read them."""
    return iter(())


def open_recording(
    path: PathOrPaths,
    *,
    cloud_topic: str | None = None,
    odometry_topic: str | None = None,
    sensor_frame: str = "auto",
) -> Recording:
    """Open a bag, a folder of scans or a mission of submaps.

    Parameters
    ----------
    path : path or sequence of path
        A ROS 1 bag, a ROS 2 bag (its folder or a file of it, sqlite3 or MCAP), a folder of such files,
        several of them, or a folder of scans with poses (see `docs/inputs.md`).
    cloud_topic, odometry_topic : str, optional
        Topics of a bag; else they are found by type.
    sensor_frame : str
        "auto": the frame that the scans name, by TF into that of the odometry. "optical": the scans are in
        the frame of a camera, z forward, mounted level on the body that the odometry tracks. "body": they are
        in the frame that the odometry tracks. Any other: the name of a frame of TF that the scans are in.

    Raises
    ------
    TerrainLoopError
        If there is nothing to read, it is damaged, or a topic that was named is not there. What is merely
        missing is in the description.
    """
    paths = _paths_of(path)
    if any(map(_holds_bags, paths)):
        from terrainloop.io.bags import open_bag_recording  # rosbags takes a while to import

        return open_bag_recording(paths, cloud_topic, odometry_topic, sensor_frame)
    if cloud_topic is not None or odometry_topic is not None:
        raise TerrainLoopError(
            expected=f"a bag ({' '.join(BAG_SUFFIXES)}), as a topic is named",
            found=f"none at {paths[0]}",
            mend="give the path of a bag, or name no topic",
        )
    if len(paths) > 1 or not paths[0].is_dir():
        raise TerrainLoopError(
            expected=f"a bag ({' '.join(BAG_SUFFIXES)}) or a folder of scans",
            found=f"{'another file' if paths[0].exists() else 'nothing'} at {paths[0]}",
            mend=_MEND_BY_SUFFIX.get(paths[0].suffix.lower(), "give the path of one"),
        )
    from terrainloop.io.scan_folders import open_folder_recording

    return open_folder_recording(paths[0], sensor_frame)


_MEND_BY_SUFFIX = {
    ".xz": "unpack the archive first",
    ".gz": "unpack the archive first",
    ".tar": "unpack the archive first",
    ".zip": "unpack the archive first",
    ".zstd": "give the folder with metadata.yaml, or unpack it with 'unzstd'",
    ".active": "repair it with 'rosbag reindex' and rename it to .bag",
    ".pcap": "convert the packets with the driver of the sensor and record a bag",
}


def _paths_of(path: PathOrPaths) -> list[Path]:
    several = path if isinstance(path, Sequence) and not isinstance(path, str | os.PathLike) else [path]
    paths = [as_path(each, "a recording") for each in several]
    if not paths:
        raise TerrainLoopError(
            expected="the path of a recording", found="an empty list", mend="give at least one"
        )
    return paths


def _holds_bags(path: Path) -> bool:
    if path.suffix.lower() in BAG_SUFFIXES and path.is_file():
        return True
    try:
        return path.is_dir() and any(
            entry.name == "metadata.yaml" or entry.suffix.lower() in BAG_SUFFIXES for entry in path.iterdir()
        )
    except OSError as error:
        raise TerrainLoopError(
            expected=f"to read the folder {path}", found=str(error.strerror), mend="check its permissions"
        ) from error
