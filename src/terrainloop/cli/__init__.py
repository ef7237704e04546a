"""The command line: one file a command."""

import logging
import sys
from typing import Annotated

import typer

from terrainloop import __version__
from terrainloop.cli import config, demo, detect, evaluate, map, match, simulate
from terrainloop.errors import TerrainLoopError

app = typer.Typer(
    name="terrainloop",
    help="Loop closures from the shape of the ground.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"terrainloop {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Loop closures from the shape of the ground."""


for _module in (demo, map, match, detect, evaluate, simulate, config):
    app.command(_module.__name__.rpartition(".")[2])(_module.command)


def _refused(error: OSError) -> TerrainLoopError:
    """What the system refuses is mostly an output: readers tell themselves what is wrong."""
    return TerrainLoopError(
        expected=f"to read or write {error.filename}",
        found=error.strerror or str(error),
        mend="check the path and its permissions",
    )


def main() -> None:
    """Run a command; exit with 0, 2 for input that cannot be worked with, 1 for a fault of ours."""
    try:
        app()
    except (TerrainLoopError, OSError) as error:
        typer.echo(f"terrainloop: {_refused(error) if isinstance(error, OSError) else error}", err=True)
        sys.exit(2)
    except Exception:
        logging.getLogger(__name__).exception("a fault of ours, please report it with what follows")
        sys.exit(1)
