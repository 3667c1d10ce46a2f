"""Command doctor: check of the native library and of the system's GDAL."""

from dataclasses import asdict

import click

from terrainwave.cli.output import CommandWithoutTarget, plain, print_json


@click.command(cls=CommandWithoutTarget)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def doctor(as_json: bool) -> int:
    """Check whether this system's GDAL, and with it QGIS, reads .twz files, and print what to do.

    It also says whether the native library is used, and why if not.

    The command checks the GDAL whose gdalinfo is on the PATH. The status is 1 if it does not read
    .twz files.
    """
    from terrainwave.cli.doctor import diagnose

    found = diagnose()
    if as_json:
        print_json(asdict(found))
    else:
        for line in found.lines():
            click.echo(plain(line))
    return 0 if found.reads_twz else 1
