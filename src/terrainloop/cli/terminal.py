"""What every command shares: its options, its voice, its progress bars."""

import json
import logging
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.cells import cell_len
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from terrainloop.errors import TerrainLoopError

if TYPE_CHECKING:
    from terrainloop.config import Settings

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON, nothing else, on stdout.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Verbose output: what is fitted and decided on the way.")
]
PresetOption = Annotated[str, typer.Option("--preset", help="default, or paper: the pipeline as published.")]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="YAML settings, see 'terrainloop config'. Excludes --preset.")
]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Seed of the random number generator.")]
AllowedOption = Annotated[
    float | None,
    typer.Option(
        "--max-false-loops", help="Expected number of false loop closures per mission [default: 0.01]."
    ),
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="Parallel workers; 0: one per core. Results do not change.")
]


class _WideConsole(Console):
    """A console that lets a table run over the edge; Rich crops it, and with it numbers."""

    def print(self, *objects: Any, **options: Any) -> None:
        super().print(*objects, **{"crop": False, **options})


@dataclass(frozen=True)
class Terminal:
    """Where a command writes: results to stdout, the rest to stderr."""

    as_json: bool
    quiet: bool

    @classmethod
    def open(cls, as_json: bool, quiet: bool, verbose: bool) -> "Terminal":
        """Set up logging as the user asked, and return the terminal."""
        level = logging.ERROR if quiet else logging.INFO if verbose else logging.WARNING
        handler = RichHandler(console=Console(stderr=True), show_path=False, show_time=False)
        logging.basicConfig(level=level, format="%(message)s", handlers=[handler], force=True)
        return cls(as_json, quiet)

    def result(self, value: Any, show: Callable[[Console], None]) -> None:
        """Print the result once: as JSON if asked for, else as `show` does unless quiet."""
        if self.as_json:
            typer.echo(json.dumps(_plain(value), indent=2, allow_nan=False))
        elif not self.quiet:
            show(_WideConsole(highlight=False, markup=False))

    def say(self, text: str) -> None:
        """A remark on stderr."""
        if not self.quiet:
            Console(stderr=True, highlight=False, markup=False).print(text)

    @contextmanager
    def progress(self) -> Iterator[Callable[[str, int, int], None]]:
        """A bar for each stage; yields the callable (stage, done, total) that moves them."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        hidden = self.quiet or self.as_json
        with Progress(*columns, console=Console(stderr=True), disable=hidden) as bars:
            tasks: dict[str, Any] = {}

            def move(stage: str, done: int, total: int) -> None:
                if stage not in tasks:
                    tasks[stage] = bars.add_task(stage, total=total)
                bars.update(tasks[stage], completed=done, total=total)

            yield move


def _plain(value: Any) -> Any:
    """The value with NaN and infinity, which JSON lacks, as null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table_of(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A right-aligned table that never cuts a cell: where it is too wide, headers wrap, then it overflows."""
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
    """Settings from the options that every detecting command has."""
    from terrainloop.config import Settings

    if config is not None and preset != "default":
        raise TerrainLoopError(
            expected="either --preset or --config", found="both", mend="put the preset's changes in the file"
        )
    settings = Settings.from_yaml(config) if config is not None else Settings.preset(preset)
    settings = settings.with_max_false_loops(max_false_loops)
    return settings if seed is None else settings.model_copy(update={"seed": seed})


def check_output(path: Path, suffixes: Sequence[str]) -> None:
    """Refuse an output that could not be written, before the work is done."""
    if path.suffix.lower() not in suffixes:
        raise TerrainLoopError(
            expected=f"an output that ends in {' or '.join(suffixes)}", found=str(path), mend="rename it"
        )
    if not path.parent.is_dir():
        raise TerrainLoopError(
            expected=f"a folder for {path.name}", found=f"no folder {path.parent}", mend="make it first"
        )


def worker_count(workers: int) -> int:
    """As asked for, or one per core."""
    if workers:
        return workers
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def count_of(number: int, noun: str) -> str:
    """Number and noun, the noun in the plural where it must be."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
