"""Command demo: a real elevation model at four bounds."""

import os

import click

from terrainwave.cli.options import Directory
from terrainwave.cli.output import Bar, Command, announce_compiling, plain, print_grid
from terrainwave.extras import with_extra


@click.command(cls=Command)
@click.argument("directory", type=Directory(), default="terrainwave-demo")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors.")
@with_extra("demo")
def demo(directory: str, quiet: bool) -> None:
    """Compress a real elevation model at four bounds and draw a picture, in DIRECTORY."""
    from terrainwave.cli.demo import HEADER, run_demo

    announce_compiling(quiet=quiet)
    with Bar(quiet=quiet) as bar:
        raster, rows = run_demo(directory, progress=bar)
    if quiet:
        return
    click.echo(raster)
    print_grid(HEADER, rows)
    click.echo(f"checked each; picture: {plain(os.path.join(directory, 'demo.png'))}")
