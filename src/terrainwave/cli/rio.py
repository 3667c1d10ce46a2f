"""``rio twz``: terrainwave's commands inside rasterio's command line."""

from contextlib import nullcontext
from typing import Any

import click

from terrainwave._version import __version__
from terrainwave.cli.commands import main
from terrainwave.cli.output import message_of, warnings_as_notes
from terrainwave.errors import TerrainwaveError

_COMMANDS = ("compress", "decompress", "info", "verify", "mesh")


class _Plugin(click.Group):
    """Group in another program: rio prints its errors and exits with their status."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command in rio's GDAL environment."""
        env = (ctx.obj or {}).get("env", nullcontext())
        try:
            with env, warnings_as_notes():
                return super().invoke(ctx)
        except TerrainwaveError as error:
            raise click.ClickException(message_of(error)) from error


@click.group(cls=_Plugin, commands={name: main.commands[name] for name in _COMMANDS})
@click.version_option(__version__, prog_name="terrainwave")
def twz() -> None:
    """Compress elevation rasters to .twz files, each height within a bound you choose."""
