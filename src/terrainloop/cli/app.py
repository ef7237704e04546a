"""``terrainloop``: the commands of the program."""

from typing import Annotated

import typer

from terrainloop import __version__
from terrainloop.cli import config, demo, detect, evaluate, info, map, match, simulate, slam

app = typer.Typer(
    name="terrainloop",
    help="Loop closures from the shape of the ground.",
    epilog=(
        "Exit codes: 0 done, 1 a fault of terrainloop, 2 bad input or usage, 130 and 143 interrupted "
        "(Ctrl-C, SIGTERM)."
    ),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"terrainloop {__version__}")
        raise typer.Exit


@app.callback(help=app.info.help)
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Loop closures from the shape of the ground."""


for _module in (demo, map, match, detect, slam, info, evaluate, simulate, config):
    # Not from docstrings, which Python leaves out when it optimises.
    app.command(_module.__name__.rpartition(".")[2], help=_module.HELP)(_module.command)
