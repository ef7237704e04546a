"""``terrainloop config``: print the settings as YAML."""

import typer
from rich.console import Console

from terrainloop.cli.terminal import Json, PresetOption, Quiet, Terminal, Verbose, read_settings

HELP = "Print the settings as YAML, to be edited and passed on with --config."


def command(
    preset: PresetOption = "default",
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop config``."""
    settings = read_settings(preset, None, None)

    def show(console: Console) -> None:
        typer.echo(settings.to_yaml(), nl=False)

    Terminal.open(as_json, quiet, verbose).result(settings.model_dump(mode="json"), show)
