"""Command patch: new heights for a .twz file."""

from dataclasses import asdict
from typing import Any

import click

from terrainwave.arguments import count_of
from terrainwave.cli.options import THREADS_OPTION, Input, NamedInput, OfKind, resumable
from terrainwave.cli.output import (
    Bar,
    Command,
    announce_compiling,
    note_unit,
    plain,
    print_json,
    print_notes,
    reading,
    unit_behind,
)
from terrainwave.option_sets import NODATA
from terrainwave.place.meaning import KINDS


@click.command(cls=Command)
@click.argument("file", type=NamedInput())
@click.argument("new", type=Input())
@click.option("--nodata", type=OfKind(NODATA),
              help="Value that marks voids of NEW, as for compress.")  # fmt: skip
@click.option(
    "--heights-are",
    type=click.Choice(KINDS),
    help="Meaning of NEW's numbers, as for compress. Default: from its metadata.",
)
@click.option("--band", type=click.IntRange(min=1), default=1, show_default=True,
              help="Band of NEW.")  # fmt: skip
@click.option(
    "--original",
    type=Input(),
    help="The raster that FILE was made of, with all earlier patches. Heights outside NEW are then"
    " compressed again from this raster; without it they do not change.",
)
@resumable
@THREADS_OPTION
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def patch(file: str, new: str, quiet: bool, as_json: bool, **options: Any) -> None:
    """Update FILE (.twz) with the heights of the raster NEW, which covers all or part of it."""
    import terrainwave

    announce_compiling(quiet=quiet)
    with Bar(quiet=quiet) as bar, reading(file):
        result = terrainwave.patch(file, new, progress=bar, **options)
    if as_json:
        print_json(asdict(result))
        return
    if not quiet:
        click.echo(
            f"{plain(result.path)}: {count_of(result.n_recoded, 'unit')} coded again,"
            f" {result.n_copied:,} copied, {result.n_bytes:,} bytes"
        )
        click.echo(
            f"max error guaranteed {result.effective_error:.6g}, measured"
            f" {result.measured_error:.6g}{unit_behind(result.units)}, of the whole file"
        )
        note_unit(result.units)
    print_notes(result.notes)
