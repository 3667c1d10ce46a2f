"""Command view: a window to fly in."""

from typing import Any

import click

from terrainwave.cli.drawing import (
    announce_preparation,
    drawing,
    style_of,
    suggest_exaggeration,
)
from terrainwave.cli.options import Input
from terrainwave.cli.output import CommandWithoutTarget, announce_compiling, reading
from terrainwave.extras import with_extra


@click.command(cls=CommandWithoutTarget)
@click.argument("file", type=Input())
@drawing
@click.option(
    "--target-ms",
    type=click.FloatRange(min=0, min_open=True),
    help="Raise the pixel error if a frame takes longer than this, in milliseconds.",
)
@click.option("--fullscreen", is_flag=True, help="Fill the screen.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@with_extra("view")
def view(
    file: str,
    camera: str | None,
    max_pixel_error: float,
    memory: int,
    quiet: bool,
    **options: Any,
) -> None:
    """Open a window and fly over FILE (.twz) or its URL; H shows the keys and settings."""
    import terrainwave
    from terrainwave.render.scene.frame import frame_of
    from terrainwave.render.window.viewer import run

    announce_compiling(quiet=quiet)
    if not quiet:
        announce_preparation(options)
    with reading(file), terrainwave.open(file) as terrain:
        if options["exaggeration"] == 1.0:
            suggest_exaggeration(frame_of(terrain, radius=options["radius"]))
        line = run(
            terrain,
            camera=camera,
            style=style_of(options),
            max_pixel_error=max_pixel_error,
            max_bytes=memory << 20,
            **options,
        )
    if not quiet:
        click.echo(f"--camera {line}")
