"""A run: the content of a command's output folder, written completely or not at all, and read back."""

import errno
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from terrainloop import __version__
from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.io.files import as_path, write_whole_text
from terrainloop.io.results import (
    LoopFile,
    iterate_loops,
    read_loops,
    read_submaps,
    write_loops,
    write_submaps,
)
from terrainloop.io.staging import errors_naming, publish, staging
from terrainloop.io.trajectories import write_tum
from terrainloop.loop import LoopCandidate
from terrainloop.pose_graph import PoseGraph, Solution
from terrainloop.record import SubmapRecord

LOOPS, PAIRS, SUBMAPS, CONFIG, RUN = "loops.csv", "pairs.csv", "submaps.csv", "config.yaml", "run.json"
POSES, GRAPH = "poses.tum", "graph.g2o"
OF_A_RUN = (RUN, LOOPS, PAIRS, SUBMAPS, CONFIG)
"""Files of every run."""
CORRECTED = (POSES, GRAPH)
"""Files of a run whose submaps have odometry."""
DERIVED = (
    *("precision_recall.csv", "precision_recall_curve.csv", "precision_recall.png"),  # evaluate
    *("mission.png", "trajectory.png", "map.png", "match.png"),  # demo
)
"""Files that other commands add; those of an earlier run are stale."""


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """Loop closures found among submaps, with everything that they depend on.

    Attributes
    ----------
    settings : Settings
    parameters : Hyperparameters or None
        Hyperparameters of all maps; None where each submap has its own.
    submaps : tuple of SubmapRecord
        Every submap in order, broken ones too.
    loops : tuple of LoopCandidate
        The accepted ones.
    rejections : mapping of str to int
        Number of rejected pairs, by the first clause of the reason.
    complete : bool
        False where the run was interrupted.
    warnings : tuple of str
        What casts doubt on the run, in words.
    entries : mapping of str to MapEntry
        The mapped submaps by id; empty where the run was read from a folder.
    corrected : Solution or None
        The poses by the pose graph; None without odometry, and where the run was read from a folder.
    folder : Path or None
        Folder that it was written to or read from.
    """

    settings: Settings
    parameters: Hyperparameters | None
    submaps: tuple[SubmapRecord, ...]
    loops: tuple[LoopCandidate, ...]
    rejections: Mapping[str, int] = field(default_factory=dict)
    complete: bool = True
    warnings: tuple[str, ...] = ()
    entries: Mapping[str, MapEntry] = field(default_factory=dict)
    corrected: Solution | None = None
    folder: Path | None = None

    def __repr__(self) -> str:
        return f"Run({len(self.submaps)} submaps, {self.num_pairs} pairs, {len(self.loops)} loops)"

    @property
    def num_pairs(self) -> int:
        """Number of pairs that were compared."""
        return len(self.loops) + sum(self.rejections.values())

    def pairs(self) -> Iterator[LoopCandidate]:
        """Every pair that was compared, read from the run's folder.

        Raises
        ------
        TerrainLoopError
            If the run has no folder, or the file in it is damaged.
        """
        if self.folder is None:
            raise TerrainLoopError(
                expected="a run that was written to a folder",
                found="one whose pairs were not kept",
                mend="give detect_mission an output",
            )
        return iterate_loops(self.folder / PAIRS)

    def with_corrected_poses(self) -> "Run":
        """The run with poses that odometry and loops agree on, or a warning why there are none."""
        graph = PoseGraph.of(self.submaps, self.loops)
        if not graph.names:
            return self
        try:
            solution = graph.solve()
        except TerrainLoopError as error:
            return replace(self, warnings=(*self.warnings, f"no corrected poses: {error}"))
        return replace(self, corrected=solution, warnings=(*self.warnings, *solution.warnings))

    @classmethod
    def read(cls, folder: Path | str) -> "Run":
        """The run that a command wrote to its output folder.

        Raises
        ------
        TerrainLoopError
            If a file is missing or damaged.
        """
        folder = as_path(folder, "a run")
        missing = [name for name in (LOOPS, PAIRS, SUBMAPS, CONFIG) if not (folder / name).is_file()]
        if missing:
            raise TerrainLoopError(
                expected=f"the results of a run in {folder}",
                found=f"no {', '.join(missing)}",
                mend="give the output folder of 'terrainloop detect'",
            )
        about = _About.read(folder / RUN)
        loops = tuple(read_loops(folder / LOOPS))
        if about.loops not in (None, len(loops)):
            raise TerrainLoopError(
                expected=f"{about.loops} loops in {folder / LOOPS}, as {RUN} states",
                found=str(len(loops)),
                mend="detect again",
            )
        return cls(
            settings=Settings.from_yaml(folder / CONFIG),
            parameters=about.hyperparameters,
            submaps=tuple(read_submaps(folder / SUBMAPS)),
            loops=loops,
            rejections=about.rejections,
            complete=about.complete,
            warnings=about.warnings,
            folder=folder,
        )


class Tally:
    """The loops among pairs, and the number of the others by the first clause of the reason."""

    def __init__(self, candidates: Iterable[LoopCandidate] = ()) -> None:
        self._loops: dict[tuple[str, str], LoopCandidate] = {}
        self._rejections: dict[tuple[str, str], str] = {}
        for candidate in candidates:
            self.add(candidate)

    def add(self, candidate: LoopCandidate) -> None:
        """Count one pair; a later verdict on a pair takes the place of the one before."""
        pair = candidate.source, candidate.target
        self._loops.pop(pair, None)
        self._rejections.pop(pair, None)
        if candidate:
            self._loops[pair] = candidate
        else:
            self._rejections[pair] = candidate.reason.partition(":")[0]

    def of(self, run: Run) -> Run:
        """The run with these loops and rejections."""
        rejections = Counter(self._rejections.values())
        return replace(run, loops=tuple(self._loops.values()), rejections=dict(rejections.most_common()))


class RunWriter:
    """Writes a run to a hidden folder while it goes on, and moves it into its own when it is finished.

    Pairs are written as they are decided. What an earlier run left in the folder is replaced when the new one
    is complete; other files are not touched. Errors of the disk name the folder.
    """

    def __init__(self, folder: Path, aside: Path) -> None:
        self._folder, self._aside = folder, aside
        self._pairs = LoopFile(aside / PAIRS)
        self._lines: dict[tuple[str, str], int] = {}  # of the last verdict on each pair
        self._written = 0

    @classmethod
    @contextmanager
    def open(cls, folder: Path) -> Iterator["RunWriter"]:
        """A writer into `folder`; its files are removed at the end, unless `finish` was called."""
        for name in (*OF_A_RUN, *CORRECTED, *DERIVED):
            if (folder / name).is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(folder / name))
        with staging(folder) as aside:
            with errors_naming(folder):
                writer = cls(folder, aside)
            try:
                yield writer
            finally:
                with suppress(OSError):  # of the last lines, on a full disk
                    writer._pairs.close()

    def add(self, candidate: LoopCandidate) -> None:
        """Write one pair; a later verdict on a pair takes the place of the one before."""
        with errors_naming(self._folder):
            self._pairs.write(candidate)
        self._lines[candidate.source, candidate.target] = self._written
        self._written += 1

    def finish(self, run: Run, products: Mapping[str, Callable[[Path], object]] | None = None) -> Run:
        """Write the rest of the run and move all of it into the folder.

        Parameters
        ----------
        run : Run
        products : mapping of str to callable, optional
            Further files of the folder, by name: each is called with the path to write to.
        """
        products = products or {}
        with errors_naming(self._folder):
            self._pairs.close()
            if len(self._lines) < self._written:
                pairs = enumerate(iterate_loops(self._aside / PAIRS))
                last = [pair for line, pair in pairs if self._lines[pair.source, pair.target] == line]
                write_loops(self._aside / PAIRS, last)
            if not run.complete:  # it may have been interrupted between writing a pair and counting it
                run = Tally(iterate_loops(self._aside / PAIRS)).of(run)
            run = replace(run, folder=self._folder)
            write_loops(self._aside / LOOPS, run.loops)
            write_submaps(self._aside / SUBMAPS, run.submaps)
            if run.corrected is not None:
                write_tum(self._aside / POSES, run.corrected.trajectory)
                run.corrected.write_g2o(self._aside / GRAPH)
            for name, write in products.items():
                write(self._aside / name)
            about, settings = _About.of(run).to_json(), run.settings.to_yaml()
            write_whole_text(self._aside / RUN, lambda file: file.write(about))
            write_whole_text(self._aside / CONFIG, lambda file: file.write(settings))
        names = (*reversed(OF_A_RUN), *(CORRECTED if run.corrected is not None else ()), *products)
        publish(self._aside, self._folder, names, stale=(*OF_A_RUN, *CORRECTED, *DERIVED))
        return run


class _About(BaseModel):
    """Content of run.json: what no other file of the run holds. Earlier versions wrote none, or less."""

    model_config = ConfigDict(allow_inf_nan=False)

    terrainloop: str = "unknown"
    complete: bool = True
    hyperparameters: Hyperparameters | None = None
    pairs: int | None = None
    loops: int | None = None
    rejections: dict[str, int] = {}
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, run: Run) -> "_About":
        return cls(
            terrainloop=__version__,
            complete=run.complete,
            hyperparameters=run.parameters,
            pairs=run.num_pairs,
            loops=len(run.loops),
            rejections=dict(run.rejections),
            warnings=run.warnings,
        )

    def to_json(self) -> str:
        return self.model_dump_json(indent=2) + "\n"

    @classmethod
    def read(cls, path: Path) -> "_About":
        """The content of run.json, or the defaults where there is none."""
        try:
            return cls.model_validate_json(path.read_bytes()) if path.exists() else cls()
        except (OSError, ValidationError) as error:
            found = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error.strerror)
            raise TerrainLoopError(
                expected=f"a description of the run in {path}", found=found, mend="detect again"
            ) from error
