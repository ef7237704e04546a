"""A run: what a command leaves in its output folder, written whole or not at all, and read back."""

import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from terrainloop import __version__
from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.io.results import (
    LoopFile,
    iterate_loops,
    read_loops,
    read_submaps,
    write_loops,
    write_submaps,
)
from terrainloop.loop import LoopCandidate
from terrainloop.record import SubmapRecord

LOOPS, PAIRS, SUBMAPS, CONFIG, RUN = "loops.csv", "pairs.csv", "submaps.csv", "config.yaml", "run.json"
OF_A_RUN = (RUN, LOOPS, PAIRS, SUBMAPS, CONFIG)
"""Files of every run."""
DERIVED = ("precision_recall.csv", "precision_recall_curve.csv", "precision_recall.png")
"""Files that other commands add; those of an earlier run are stale."""


@dataclass(frozen=True, eq=False)
class Run:
    """Loops found among submaps, with all that they depend on.

    Attributes
    ----------
    settings : Settings
    parameters : Hyperparameters or None
        Of the database; None where each submap has its own.
    submaps : tuple of SubmapRecord
        Every submap in order, broken ones too.
    loops : tuple of LoopCandidate
        The accepted ones.
    rejections : mapping of str to int
        How many pairs were rejected, by the first clause of the reason.
    complete : bool
        False where the run was interrupted.
    entries : mapping of str to MapEntry
        The mapped submaps by id; empty where the run was read from a folder.
    folder : Path or None
        Where it is written.
    """

    settings: Settings
    parameters: Hyperparameters | None
    submaps: tuple[SubmapRecord, ...]
    loops: tuple[LoopCandidate, ...]
    rejections: Mapping[str, int] = field(default_factory=dict)
    complete: bool = True
    entries: Mapping[str, MapEntry] = field(default_factory=dict)
    folder: Path | None = None

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

    @classmethod
    def read(cls, folder: Path | str) -> "Run":
        """The run that a command wrote to its output folder.

        Raises
        ------
        TerrainLoopError
            If a file is missing or damaged.
        """
        folder = Path(folder)
        missing = [name for name in (LOOPS, PAIRS, SUBMAPS, CONFIG) if not (folder / name).is_file()]
        if missing:
            raise TerrainLoopError(
                expected=f"the results of a run in {folder}",
                found=f"no {', '.join(missing)}",
                mend="give the output folder of 'terrainloop detect'",
            )
        about = _read_about(folder / RUN)
        kept = about.get("hyperparameters")
        return cls(
            settings=Settings.from_yaml(folder / CONFIG),
            parameters=Hyperparameters(**kept) if kept else None,
            submaps=tuple(read_submaps(folder / SUBMAPS)),
            loops=tuple(read_loops(folder / LOOPS)),
            rejections=about.get("rejections", {}),
            complete=about.get("complete", True),
            folder=folder,
        )


class RunWriter:
    """Writes a run aside while it goes on, and moves it into its folder when it is finished.

    Pairs go to disk as they come. What an earlier run left in the folder is replaced; other files are not
    touched.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._aside = folder / f".terrainloop-{os.getpid()}"
        self._rejections: Counter[str] = Counter()

    def __enter__(self) -> "RunWriter":
        self._aside.mkdir(parents=True, exist_ok=True)
        self._pairs = LoopFile(self._aside / PAIRS)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pairs.close()
        shutil.rmtree(self._aside, ignore_errors=True)

    def add(self, candidate: LoopCandidate) -> None:
        """Write one pair."""
        self._pairs.write(candidate)
        if not candidate:
            self._rejections[candidate.reason.partition(":")[0]] += 1

    def finish(self, run: Run) -> Run:
        """Write the rest of the run and move all of it into the folder."""
        run = replace(run, rejections=dict(self._rejections.most_common()), folder=self._folder)
        self._pairs.close()
        write_loops(self._aside / LOOPS, run.loops)
        write_submaps(self._aside / SUBMAPS, run.submaps)
        (self._aside / CONFIG).write_text(run.settings.to_yaml(), encoding="utf-8")
        (self._aside / RUN).write_text(json.dumps(_about(run), indent=2) + "\n", encoding="utf-8")
        for name in (*OF_A_RUN, *DERIVED):
            (self._folder / name).unlink(missing_ok=True)
        for name in reversed(OF_A_RUN):
            (self._aside / name).replace(self._folder / name)
        return run


def _about(run: Run) -> dict[str, Any]:
    """What no other file of the run holds."""
    return {
        "terrainloop": __version__,
        "complete": run.complete,
        "hyperparameters": None if run.parameters is None else asdict(run.parameters),
        "pairs": run.num_pairs,
        "loops": len(run.loops),
        "rejections": dict(run.rejections),
    }


def _read_about(path: Path) -> dict[str, Any]:
    """The content of run.json, or nothing where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if not isinstance(content, dict):
            raise ValueError("it is no JSON object")
        return content
    except (OSError, ValueError) as error:
        raise TerrainLoopError(
            expected=f"a description of the run in {path}", found=str(error), mend="detect again"
        ) from error
