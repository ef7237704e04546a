"""Missions: folders of submaps, one cloud per file, with odometry and ground truth if known."""

import csv
import logging
import operator
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import overload

from terrainloop.errors import TerrainLoopError
from terrainloop.io.clouds import CLOUD_SUFFIXES, read_cloud
from terrainloop.io.ordering import order_of_names
from terrainloop.io.submap_poses import check_consistent, check_count, check_upright
from terrainloop.io.trajectories import Trajectory, read_trajectory
from terrainloop.submap import Submap

logger = logging.getLogger(__name__)

CLOUDS = "clouds"
"""Folder of a mission in which every file that can be one is a cloud."""

_SIDE_FILES = (".txt", ".csv")  # beside the clouds these hold trajectories and notes
_SESSION_HEADERS = ("session", "pass")
_LARGEST_TABLE = 16 << 20  # bytes


class _IndexError(TerrainLoopError, IndexError):
    """An IndexError too, as any sequence raises it."""


@dataclass(frozen=True, eq=False, repr=False)
class Mission:
    """A folder of submaps, read one by one on demand; iteration yields those that can be read.

    ``mission[0]`` and ``mission[-1]`` read one submap, ``mission[:5]`` those of the first five that can be
    read.

    Attributes
    ----------
    path : Path
    files : tuple of Path
        One cloud per file, in order.
    odometry, truth : Trajectory or None
        Poses of the submaps' frames, one for each file.
    """

    path: Path
    files: tuple[Path, ...]
    odometry: Trajectory | None = None
    truth: Trajectory | None = None

    def __len__(self) -> int:
        return len(self.files)

    def __repr__(self) -> str:
        span = " ... ".join(dict.fromkeys([*self.names[:1], *self.names[-1:]]))
        known = [name for name in ("odometry", "truth") if getattr(self, name) is not None]
        return f"Mission({', '.join([str(self.path), f'{len(self)} clouds', span, *known])})"

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

        Parameters
        ----------
        index : int
            Negative ones count from the end.

        Raises
        ------
        TerrainLoopError
            If that file is broken, or there is none (then it is an IndexError, too).
        """
        if not -len(self) <= index < len(self):
            raise _IndexError(
                expected=f"an index below {len(self)}, the number of clouds in {self.path}",
                found=str(index),
                mend="count from 0",
            )
        index %= len(self)
        return read_cloud(self.files[index], self.stamp(index))

    @overload
    def __getitem__(self, index: int) -> Submap: ...
    @overload
    def __getitem__(self, index: slice) -> list[Submap]: ...
    def __getitem__(self, index: int | slice) -> Submap | list[Submap]:
        try:
            chosen = range(len(self))[index] if isinstance(index, slice) else operator.index(index)
        except (TypeError, ValueError) as error:
            raise TerrainLoopError(
                expected="an integer or a slice as the index of a mission",
                found=f"{index!r:.60}",
                mend="count the clouds from 0, or look a name up in Mission.names",
            ) from error
        return self.read(chosen) if isinstance(chosen, int) else list(self._readable(chosen))

    def __iter__(self) -> Iterator[Submap]:
        broken = len(self)
        for submap in self._readable(range(len(self))):
            broken -= 1
            yield submap
        if broken == len(self):
            raise TerrainLoopError(
                expected=f"clouds that can be read in {self.path}",
                found=f"{broken} broken ones",
                mend="see the warning about each",
            )

    def _readable(self, indices: range) -> Iterator[Submap]:
        return (submap for index in indices if (submap := self._read_if_whole(index)) is not None)

    def _read_if_whole(self, index: int) -> Submap | None:
        try:
            return self.read(index)
        except TerrainLoopError as error:
            logger.warning("left out %s: %s", self.files[index].name, error)
            return None


def load_mission(path: str | Path) -> Mission:
    """Find the clouds and trajectories of a mission folder; the clouds are read later.

    The clouds are those in its folder ``clouds`` or, where there is none, those in the folder itself;
    there ``.txt`` and ``.csv`` files are treated as notes, never as clouds. They are ordered by file
    name, numbers as numbers (see `terrainloop.io.ordering`). ``odometry`` and ``truth`` are looked for as
    ``.tum``, then as ``.txt``.

    Raises
    ------
    TerrainLoopError
        If there is no folder, no cloud, no unique order although there are poses, or a trajectory that does
        not fit: another number of poses, frames that are not gravity-aligned, inverse poses.
    """
    if not isinstance(path, str | os.PathLike) or not os.path.isdir(path):  # noqa: PTH112, which raises
        raise TerrainLoopError(
            expected="a mission folder",
            found=f"no folder at {path!s:.300}",
            mend="give the folder that holds the clouds",
        )
    path = Path(path)
    files = _cloud_files(path)
    sources = {name: file for name in ("odometry", "truth") if (file := _side_file(path, name))}
    trajectories = {name: read_trajectory(file) for name, file in sources.items()}
    for name, trajectory in trajectories.items():
        check_count(trajectory, len(files), sources[name])
        check_upright(trajectory, sources[name])
    order = order_of_names([file.stem for file in files], [t.stamps for t in trajectories.values()])
    for name, trajectory in trajectories.items():
        check_consistent(trajectory, trajectories["odometry"] if len(sources) > 1 else None, sources[name])
    return Mission(path, tuple(files[i] for i in order), **trajectories)


def _cloud_files(path: Path) -> list[Path]:
    inside = path / CLOUDS
    folder = inside if inside.is_dir() else path
    suffixes = [s for s in CLOUD_SUFFIXES if folder == inside or s not in _SIDE_FILES]
    try:
        files = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in suffixes]
    except OSError as error:
        raise TerrainLoopError(
            expected=f"to read the folder {folder}", found=str(error.strerror), mend="check its permissions"
        ) from error
    # What is neither file nor folder, a pipe or a dangling link, counts as a broken cloud.
    files = [file for file in files if not file.name.startswith(".") and not file.is_dir()]
    if not files:
        raise TerrainLoopError(
            expected=f"clouds ({' '.join('*' + s for s in suffixes)}) in {inside} or {path}",
            found=f"none in {folder}",
            mend="put one cloud for each submap there",
        )
    _check_names(files)
    return files


def _check_names(files: list[Path]) -> None:
    """Refuse names that two files share, and those that cannot be written to a table."""
    stem, times = Counter(file.stem for file in files).most_common(1)[0]
    if times > 1:
        raise TerrainLoopError(
            expected="a name of its own for each cloud",
            found=f"{times} files named {stem} in {files[0].parent}",
            mend="remove or rename all but one",
        )
    odd = [file.name for file in files if file.name.encode(errors="replace") != os.fsencode(file.name)]
    if odd:
        raise TerrainLoopError(
            expected=f"file names in UTF-8 in {files[0].parent}", found=ascii(odd[0]), mend="rename that file"
        )


def _side_file(path: Path, name: str) -> Path | None:
    """The trajectory of that name; also if it is not a regular file, which is then refused."""
    return next((file for s in (".tum", ".txt") if os.path.lexists(file := path / (name + s))), None)


def read_sessions(path: Path | str) -> dict[str, str]:
    """Session of each cloud by name, from a CSV with a header and two columns, cloud and session (or pass).

    Raises
    ------
    TerrainLoopError
        If it is not such a table: other columns, a cloud named twice, an empty cell.
    """
    path = Path(path)
    lines = _table_lines(path)
    number, header = lines[0] if lines else (1, [])
    if header[:1] != ["cloud"] or header[1:] not in [[name] for name in _SESSION_HEADERS]:
        raise _bad_sessions(path, number, f"the header {','.join(header)[:60]!r}")
    sessions: dict[str, str] = {}
    for number, cells in lines[1:]:
        if len(cells) != 2 or not all(cells):
            raise _bad_sessions(path, number, f"{','.join(cells)[:60]!r}")
        if cells[0] in sessions:
            raise _bad_sessions(path, number, f"{cells[0][:60]!r} a second time")
        sessions[cells[0]] = cells[1]
    return sessions


def _table_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Numbers and stripped cells of the lines that are not empty."""
    try:
        if path.exists() and not path.is_file():
            raise OSError("not a regular file")  # a pipe would block
        if path.stat().st_size > _LARGEST_TABLE:
            raise OSError(f"{path.stat().st_size >> 20} MiB")
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            return [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(row)]
    except (OSError, ValueError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise TerrainLoopError(
            expected="a CSV with the columns cloud,session",
            found=f"{path}: {reason}",
            mend="give such a file",
        ) from error


def _bad_sessions(path: Path, number: int, found: str) -> TerrainLoopError:
    return TerrainLoopError(
        expected="a header 'cloud,session' and one line for each cloud",
        found=f"{found} in {path}, line {number}",
        mend="correct that line",
    )
