"""``terrainloop map``: one gradient map."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from terrainloop.cli.terminal import (
    ConfigOption,
    Json,
    PresetOption,
    Quiet,
    SeedOption,
    Terminal,
    Verbose,
    WorkersOption,
    check_output,
    read_settings,
    worker_count,
)
from terrainloop.errors import printable

if TYPE_CHECKING:
    from terrainloop.gradient_map import GradientMap
    from terrainloop.submap import Submap


HELP = "Make the gradient map of one gravity-aligned cloud: elevation, gradient, variance."


def command(
    cloud: Annotated[Path, typer.Argument(help="Point cloud: PLY, PCD, LAS, LAZ, NPY, NPZ, XYZ; metres.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="map.npz, or map.tif for a GeoTIFF.")],
    png: Annotated[bool, typer.Option("--png", help="Draw it too, beside the output.")] = False,
    preset: PresetOption = "default",
    config: ConfigOption = None,
    seed: SeedOption = None,
    workers: WorkersOption = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run ``terrainloop map``."""
    from terrainloop.detection.detector import map_submap
    from terrainloop.io.clouds import read_cloud

    terminal = Terminal.open(as_json, quiet, verbose)
    settings = read_settings(preset, config, seed)
    check_output(output, (".npz", ".tif", ".tiff"))
    picture = output.with_suffix(".png")
    if png:
        check_output(picture, (".png",))
        import_module("terrainloop.report.figures")  # refuses where matplotlib is missing
    submap = read_cloud(cloud)
    with terminal.progress() as progress:
        progress("map", 0, 1)
        gradient_map = map_submap(submap, settings, workers=worker_count(workers)).gradient_map
        progress("map", 1, 1)
    _write(gradient_map, output, cloud)
    written = [str(output)]
    try:
        if png:
            from terrainloop.report.figures import figure_map, save_figure

            save_figure(figure_map(submap, gradient_map), picture)
            written.append(str(picture))
    finally:  # the map is there, whatever becomes of its picture
        terminal.result(
            _summary(submap, gradient_map) | {"written": written},
            lambda console: _show(console, submap, gradient_map, written),
        )


def _summary(submap: "Submap", gradient_map: "GradientMap") -> dict[str, Any]:
    rows, columns = gradient_map.mask.shape
    return {
        "cloud": submap.name,
        "points": len(submap),
        "repairs": list(submap.repairs),
        "warnings": [*submap.warnings, *gradient_map.warnings],
        "rows": rows,
        "columns": columns,
        "resolution_m": gradient_map.resolution,
        "origin_m": list(gradient_map.origin),
        "length_scale_m": gradient_map.parameters.length_scale,
        "variance_m2": gradient_map.parameters.variance,
        "noise_m": gradient_map.parameters.noise,
        "known_share": float(gradient_map.mask.mean()),
    }


def _show(console: Console, submap: "Submap", gradient_map: "GradientMap", written: list[str]) -> None:
    parameters, (rows, columns) = gradient_map.parameters, gradient_map.mask.shape
    console.print(
        f"{len(submap)} points -> {columns} x {rows} pixels of {gradient_map.resolution:.3g} m, "
        f"{gradient_map.mask.mean():.0%} observed\n"
        f"length scale {parameters.length_scale:.3g} m, relief {parameters.variance**0.5:.3g} m, "
        f"noise {parameters.noise:.3g} m\nwritten: {printable(', '.join(written))}"
    )


def _write(gradient_map: "GradientMap", output: Path, cloud: Path) -> None:
    if output.suffix.lower() == ".npz":
        gradient_map.save(output)
        return
    from terrainloop.io.clouds import read_crs
    from terrainloop.io.rasters import write_geotiff

    bands = ("elevation", "gradient_x", "gradient_y", "magnitude", "variance", "gradient_variance")
    images = {name: getattr(gradient_map, name) for name in bands}
    write_geotiff(
        output,
        images,
        gradient_map.origin,
        gradient_map.resolution,
        mask=gradient_map.mask,
        crs=read_crs(cloud),
    )
