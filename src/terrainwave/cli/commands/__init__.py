"""Commands, one module each: parse, call, print."""

import click

from terrainwave._version import __version__
from terrainwave.cli.commands import (
    capsule,
    compress,
    decompress,
    demo,
    doctor,
    info,
    mesh,
    patch,
    publish,
    render,
    serve,
    tiles,
    verify,
    warmup,
)
from terrainwave.cli.output import Commands


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="terrainwave")
def main() -> None:
    """Compress elevation rasters to small .twz files, each height within a bound you choose."""


for _command in (
    compress.compress,
    patch.patch,
    decompress.decompress,
    mesh.mesh,
    info.info,
    verify.verify,
    capsule.capsule,
    warmup.warmup,
    doctor.doctor,
    demo.demo,
    render.render,
    render.view,
    serve.serve,
    publish.publish,
    publish.site,
    tiles.tiles,
):
    main.add_command(_command)
