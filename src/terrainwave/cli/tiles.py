"""The command that writes a pyramid of tiles for globes."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import count_of
from terrainwave.cli.commands import THREADS, main, print_json
from terrainwave.cli.options import Directory, Finite, Input, Positive
from terrainwave.cli.output import Bar, announce_compiling, plain, print_grid, reading


@main.command()
@click.argument("file", type=Input())
@click.argument("directory", type=Directory())
@click.option(
    "--max-zoom",
    type=click.IntRange(min=0),
    help="The finest zoom. Default: the first one whose cells are no larger than pixels.",
)
@click.option(
    "--void-height",
    type=Finite(),
    default=0.0,
    show_default=True,
    help="Of voids and what the raster does not cover, in metres above the ellipsoid.",
)
@click.option("--attribution", default="", help="For layer.json: whose data these are.")
@click.option("--radius", type=Positive(), help="Of the planet, in metres, for degrees.")
@click.option("--threads", type=THREADS, help="Threads; all processors by default.")
@click.option("--overwrite", is_flag=True, help="Replace an existing directory of tiles.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def tiles(
    file: str, directory: str, threads: int | None, quiet: bool, as_json: bool, **options: Any
) -> None:
    """Write FILE (.twz) to DIRECTORY as Cesium terrain: quantized-mesh tiles and layer.json.

    Serve DIRECTORY over HTTP and give its address to CesiumTerrainProvider.fromUrl.
    """
    import terrainwave
    from terrainwave.globe.cesium import write_tiles

    announce_compiling(quiet=quiet)
    with (
        reading(file),
        terrainwave.open(file, threads=threads) as terrain,
        Bar(quiet=quiet) as bar,
    ):
        summaries = write_tiles(terrain, directory, threads=threads, progress=bar, **options)
    if as_json:
        zooms = [asdict(zoom) for zoom in summaries]
        print_json({"path": str(Path(directory)), "zooms": zooms})
    elif not quiet:
        _print_zooms(directory, summaries)


def _print_zooms(directory: str, summaries: Any) -> None:
    header = ["zoom", "tiles", "triangles", "bytes", "Cesium's error", "surface error", "error"]
    rows = [
        [str(zoom.zoom), f"{zoom.n_tiles:,}", f"{zoom.n_triangles:,}", f"{zoom.n_bytes:,}",
         f"{zoom.geometric_error:.5g}", _metres(zoom.surface_error), _metres(zoom.error)]
        for zoom in summaries
    ]  # fmt: skip
    print_grid(header, rows)
    click.echo(
        f"{plain(directory)}: {count_of(sum(zoom.n_tiles for zoom in summaries), 'tile')};"
        " errors in m"
    )


def _metres(error: float | None) -> str:
    return "-" if error is None else f"{error:.5g}"
