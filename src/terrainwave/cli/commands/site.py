"""Command site: a page for static web servers that opens and proves the files of its visitors."""

from dataclasses import asdict
from pathlib import Path

import click

from terrainwave.arguments import count_of
from terrainwave.cli.options import Directory
from terrainwave.cli.output import Bar, Command, announce_compiling, plain, print_json


@click.command(cls=Command)
@click.argument("directory", type=Directory())
@click.option("--overwrite", is_flag=True, help="Replace an existing published folder.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def site(directory: str, overwrite: bool, quiet: bool, as_json: bool) -> None:
    """Write to DIRECTORY a page that opens and proves .twz files, for static web hosts.

    A file that is dropped on the page, or named by a URL, is shown as a map. Dropped with its
    original GeoTIFF, every sample is compared. Files of visitors are not uploaded.
    """
    from terrainwave.ext.publish import write_site
    from terrainwave.place.system import need_pyproj

    need_pyproj(extra="publish", purpose="site")
    announce_compiling(quiet=quiet)
    with Bar(quiet=quiet) as bar:
        samples = write_site(directory, overwrite=overwrite, progress=bar)
    if as_json:
        print_json({"path": str(Path(directory)), "samples": [asdict(one) for one in samples]})
    elif not quiet:
        click.echo(f"{plain(directory)}: the page and {count_of(len(samples), 'sample')}")
