"""Missions: folders of submaps, one cloud a file, with their odometry and truth where known."""

import csv
import logging
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds import CLOUD_SUFFIXES, read_cloud
from terrainloop.io.trajectories import Trajectory, read_trajectory
from terrainloop.submap import Submap

logger = logging.getLogger(__name__)

_SIDE_FILES = (".txt", ".csv")  # beside the clouds these hold trajectories and notes


@dataclass(frozen=True, eq=False)
class Mission:
    """A folder of submaps, read one by one when asked for; iterate to have those that can be read.

    Attributes
    ----------
    path : Path
    files : tuple of Path
        One cloud each, in order.
    odometry, truth : Trajectory or None
        Poses of the submaps' frames, one a file.
    """

    path: Path
    files: tuple[Path, ...]
    odometry: Trajectory | None = None
    truth: Trajectory | None = None

    def __len__(self) -> int:
        return len(self.files)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all submaps, also of those that cannot be read."""
        return tuple(file.stem for file in self.files)

    def stamp(self, index: int) -> float:
        """Stamp of a submap by the odometry, else the truth, else its index."""
        trajectory = self.odometry or self.truth
        return float(trajectory.stamps[index] if trajectory else index)

    def read(self, index: int) -> Submap:
        """The submap of one file.

        Raises
        ------
        TerrainLoopError
            Where that file is broken.
        """
        return read_cloud(self.files[index], self.stamp(index))

    def __iter__(self) -> Iterator[Submap]:
        broken = 0
        for index in range(len(self)):
            submap = self._read_if_whole(index)
            if submap is None:
                broken += 1
            else:
                yield submap
        if broken == len(self):
            raise TerrainLoopError(
                expected=f"clouds that can be read in {self.path}",
                found=f"{broken} broken ones",
                mend="see what the warnings say about each",
            )

    def _read_if_whole(self, index: int) -> Submap | None:
        try:
            return self.read(index)
        except TerrainLoopError as error:
            logger.warning("left out %s: %s", self.files[index].name, error)
            return None


def load_mission(path: str | Path) -> Mission:
    """Find the clouds and trajectories of a mission folder; the clouds are read later.

    The clouds are those in its folder ``clouds`` or, where there is none, those in the folder itself;
    there ``.txt`` and ``.csv`` files are taken for notes, never for clouds. They are ordered by file
    name. ``odometry`` and ``truth`` are looked for as ``.tum``, then as ``.txt``.

    Raises
    ------
    TerrainLoopError
        Where there is no folder, no cloud, no clear order, or a trajectory that does not fit.
    """
    path = Path(path)
    if not path.is_dir():
        raise TerrainLoopError(
            expected="a mission folder",
            found=f"{'a file' if path.exists() else 'nothing'} at {path}",
            mend="give the folder that holds the clouds",
        )
    files = _cloud_files(path)
    _check_names(files)
    return Mission(
        path, files, _trajectory(path, "odometry", len(files)), _trajectory(path, "truth", len(files))
    )


def _cloud_files(path: Path) -> tuple[Path, ...]:
    inside = path / "clouds"
    folder = inside if inside.is_dir() else path
    suffixes = [s for s in CLOUD_SUFFIXES if folder == inside or s not in _SIDE_FILES]
    files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes and file.is_file()]
    files = [file for file in files if not file.name.startswith(".")]
    if not files:
        raise TerrainLoopError(
            expected=f"clouds ({' '.join('*' + s for s in suffixes)}) in {inside} or {path}",
            found=f"none in {folder}",
            mend="put one cloud a submap there",
        )
    return tuple(sorted(files, key=lambda file: file.name))


def _check_names(files: tuple[Path, ...]) -> None:
    """Refuse what would make a submap or the order ambiguous."""
    stem, times = Counter(file.stem for file in files).most_common(1)[0]
    if times > 1:
        raise TerrainLoopError(
            expected="one cloud a name",
            found=f"{times} files named {stem} in {files[0].parent}",
            mend="remove or rename all but one",
        )
    parts = [re.fullmatch(r"(\D*)(\d+)", file.stem) for file in files]
    counters = [(part[1], int(part[2])) for part in parts if part]
    if len(counters) == len(files) and counters != sorted(counters):
        raise TerrainLoopError(
            expected=f"file names in {files[0].parent} whose alphabetical order is that of their numbers",
            found=f"{files[0].name} ... {files[-1].name}",
            mend="pad the numbers with zeros to equal length",
        )


def _trajectory(path: Path, name: str, count: int) -> Trajectory | None:
    file = next((f for s in (".tum", ".txt") if (f := path / (name + s)).is_file()), None)
    if file is None:
        return None
    trajectory = read_trajectory(file)
    if len(trajectory) != count:
        raise TerrainLoopError(
            expected=f"{count} poses, one a cloud",
            found=f"{len(trajectory)} in {file}",
            mend="give one line a cloud, in the order of the file names",
        )
    return trajectory


def read_sessions(path: Path | str) -> dict[str, str]:
    """Session of each cloud by name, from a CSV with a header and two columns, cloud and session.

    Raises
    ------
    TerrainLoopError
        If it cannot be read as that.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row]
        return dict(rows[1:])
    except (OSError, ValueError, IndexError) as error:
        raise TerrainLoopError(
            expected=f"a header and two columns, cloud and session, in {path}",
            found=str(error),
            mend="mend the file",
        ) from error
