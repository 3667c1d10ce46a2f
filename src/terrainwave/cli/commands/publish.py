"""Commands publish and site: folders for static web servers."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import count_of
from terrainwave.cli.options import PAGE_SEA_LEVEL_OPTION, RADIUS_OPTION, Directory, NamedInput
from terrainwave.cli.output import Bar, Command, announce_compiling, plain, print_json
from terrainwave.names import TILE_ENCODINGS


@click.command(cls=Command)
@click.argument("files", nargs=-1, type=NamedInput())
@click.argument("directory", type=Directory())
@RADIUS_OPTION
@click.option(
    "--encoding",
    type=click.Choice(TILE_ENCODINGS),
    default=TILE_ENCODINGS[0],
    show_default=True,
    help="Encoding of the tiles that the page makes. mapbox has steps of 0.1 m above -10000 m,"
    " terrarium steps of 1/256 m above -32768 m.",
)
@PAGE_SEA_LEVEL_OPTION
@click.option("--overwrite", is_flag=True, help="Replace an existing published folder.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def publish(
    files: tuple[str, ...], directory: str, quiet: bool, as_json: bool, **options: Any
) -> None:
    """Write FILES (.twz) and a page that flies over them to DIRECTORY, for static web hosts.

    The page reads the files by byte ranges and makes map tiles in the browser.
    """
    if not files:
        raise click.UsageError(f"found {plain(directory)} alone, expected FILES and DIRECTORY")
    from terrainwave.ext.publish import publish_site
    from terrainwave.place.system import need_pyproj

    need_pyproj(extra="publish", purpose="publish")
    announce_compiling(quiet=quiet)
    with Bar(quiet=quiet) as bar:
        published = publish_site(list(files), directory, progress=bar, **options)
    if as_json:
        terrains = [asdict(terrain) for terrain in published]
        print_json({"path": str(Path(directory)), "terrains": terrains})
    elif not quiet:
        n_bytes = sum(terrain.n_bytes for terrain in published)
        click.echo(f"{plain(directory)}: {count_of(len(published), 'terrain')}, {n_bytes:,} bytes")


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
