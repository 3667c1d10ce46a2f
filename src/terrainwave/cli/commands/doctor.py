"""The command doctor: does this system's GDAL read .twz files."""

from dataclasses import asdict

import click

from terrainwave.cli.output import (
    Command,
    plain,
    print_json,
)


@click.command(cls=Command)
@click.option("--json", "as_json", is_flag=True, help="Print what was found as JSON.")
def doctor(as_json: bool) -> int:
    """Tell whether this system's GDAL, and with it QGIS, reads .twz files, and what to do.

    The GDAL is the one whose command gdalinfo is on the PATH. The status is 1 if it does not.
    """
    from terrainwave.cli.doctor import diagnose

    found = diagnose()
    if as_json:
        print_json(asdict(found))
    else:
        for line in found.lines():
            click.echo(plain(line))
    return 0 if found.reads_twz else 1
