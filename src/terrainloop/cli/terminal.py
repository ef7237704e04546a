"""What all commands share: options, printing, progress bars."""

import json
import logging
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer
from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from terrainloop.errors import TerrainLoopError, printable
from terrainloop.resources import usable_workers

if TYPE_CHECKING:
    from terrainloop.config import Settings

Json = Annotated[bool, typer.Option("--json", help="Print only the result, as JSON, on stdout.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Verbose output: each cloud, its fit and its repairs.")
]
PresetOption = Annotated[str, typer.Option("--preset", help="default, or paper (the published pipeline).")]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", help="YAML settings (see 'terrainloop config'); not together with --preset."),
]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Seed of the random number generator.")]
AllowedOption = Annotated[
    float | None,
    typer.Option(
        "--max-false-loops",
        help="Expected number of false loop closures per mission.",
        show_default="that of the settings",
    ),
]
WorkersOption = Annotated[
    int,
    typer.Option(
        "--workers",
        min=0,
        help="Parallel workers, at most one per core; 0: one per core. Results do not change.",
    ),
]


@dataclass(frozen=True)
class Terminal:
    """Where a command writes: results to stdout, the rest to stderr."""

    as_json: bool
    quiet: bool
    remarks: Console

    @classmethod
    def open(cls, as_json: bool, quiet: bool, verbose: bool) -> "Terminal":
        """Set up logging as requested, and return the terminal."""
        level = logging.ERROR if quiet else logging.INFO if verbose else logging.WARNING
        remarks = console_of(sys.stderr)
        logging.basicConfig(level=level, format="%(message)s", handlers=[_Remarks(remarks)], force=True)
        return cls(as_json, quiet, remarks)

    def result(self, value: Any, show: Callable[[Console], None]) -> None:
        """Print the result once: as JSON if requested, else by `show` unless quiet."""
        if self.as_json:
            typer.echo(json.dumps(_plain(value), indent=2, allow_nan=False))
        elif not self.quiet:
            show(console_of(sys.stdout))

    @contextmanager
    def progress(self) -> Iterator[Callable[[str, int, int], None]]:
        """A bar for each stage; yields the callable (stage, done, total) that moves them."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        hidden = self.quiet or self.as_json
        with Progress(*columns, console=self.remarks, disable=hidden) as bars:
            tasks: dict[str, Any] = {}

            def move(stage: str, done: int, total: int) -> None:
                if stage not in tasks:
                    tasks[stage] = bars.add_task(stage, total=total)
                bars.update(tasks[stage], completed=done, total=total)

            yield move


def console_of(stream: TextIO) -> Console:
    """A console that prints text as it is: brackets are not markup, and long lines are not broken."""
    return Console(file=stream, highlight=False, markup=False, soft_wrap=True)


class _Remarks(logging.Handler):
    """Log messages as lines on a console, above its progress bars."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        message = printable(record.getMessage())
        if record.exc_info:
            message += "\n" + logging.Formatter().formatException(record.exc_info)
        self._console.print(f"{record.levelname.lower()}: {message}")


def _plain(value: Any) -> Any:
    """The value with NaN and infinity, which JSON lacks, as null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table_of(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A right-aligned table that never truncates a cell: if too wide, headers wrap, then it overflows."""
    table = Table(title=Text(title), title_justify="left", show_edge=False, pad_edge=False)
    for index, column in enumerate(columns):
        least = max(map(cell_len, [*column.split(), *(row[index] for row in rows)]), default=1)
        table.add_column(Text(column), justify="right", overflow="fold", min_width=least)
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def read_settings(
    preset: str, config: Path | None, seed: int | None, max_false_loops: float | None = None
) -> "Settings":
    """Settings from the options that all detecting commands share."""
    from terrainloop.config import Settings

    if config is not None and preset != "default":
        raise TerrainLoopError(
            expected="either --preset or --config", found="both", mend="put the preset's changes in the file"
        )
    settings = Settings.from_yaml(config) if config is not None else Settings.preset(preset)
    settings = settings.with_max_false_loops(max_false_loops)
    return settings if seed is None else settings.model_copy(update={"seed": seed})


def check_output(path: Path, suffixes: Sequence[str]) -> None:
    """Refuse a file that could not be written, before the work is done."""
    if path.suffix.lower() not in suffixes:
        raise TerrainLoopError(
            expected=f"an output that ends in {' or '.join(suffixes)}", found=str(path), mend="rename it"
        )
    if path.is_dir():
        raise TerrainLoopError(
            expected=f"a file to write at {path}", found="a folder", mend="give another name"
        )
    if not path.parent.is_dir():
        raise TerrainLoopError(
            expected=f"a folder for {path.name}", found=f"no folder {path.parent}", mend="make it first"
        )
    _check_writable(path.parent)
    if path.exists():
        _check_writable(path)


def check_folder(folder: Path) -> None:
    """Refuse an output folder that could not be made or written to, before the work is done."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise TerrainLoopError(
            expected=f"a folder for the results at {folder}",
            found=f"a file at {existing}",
            mend="give another folder",
        )
    _check_writable(existing)


def _check_writable(path: Path) -> None:
    if not os.access(path, os.W_OK):
        raise TerrainLoopError(
            expected=f"permission to write to {path}", found="none", mend="write elsewhere, or change it"
        )


def worker_count(workers: int) -> int:
    """The requested number, at most one per core; 0: one per core that this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return usable_workers(workers or usable)


def alternatives(names: Sequence[str]) -> str:
    """The names in a list whose last one follows an "or"."""
    return f"{', '.join(names[:-1])} or {names[-1]}"


def count_of(number: int, noun: str) -> str:
    """Number and noun, the noun in the plural where it must be."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
