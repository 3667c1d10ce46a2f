"""Command tiles: a pyramid of tiles for globes, or one archive for maps."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import ARCHIVE_ENDING, AS_IS, count_of
from terrainwave.cli.options import (
    FINITE,
    RADIUS_OPTION,
    THREADS_OPTION,
    VERTICAL_OPTION,
    Directory,
    Input,
)
from terrainwave.cli.output import (
    Bar,
    Command,
    announce_compiling,
    plain,
    print_grid,
    print_json,
    print_note,
    reading,
    vertical_in_words,
)
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import TILE_ENCODINGS, TILE_IMAGES


@click.command(cls=Command)
@click.argument("file", type=Input())
@click.argument("target", type=Directory(or_ending=ARCHIVE_ENDING))
@click.option(
    "--max-zoom",
    type=click.IntRange(min=0),
    help="Finest zoom. Default, and the finest there is: the first one whose cells, or pixels of"
    " .pmtiles, are no larger than the raster's pixels.",
)
@click.option(
    "--min-zoom",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Coarsest zoom. A directory has the two tiles of zoom 0 as well, which CesiumJS needs.",
)
@click.option(
    "--rim",
    type=click.IntRange(min=0),
    help="For .pmtiles: continue heights by this number of pixels beyond edges and into voids.",
)
@click.option(
    "--void-height",
    type=FINITE,
    help="Height of voids and of places that the raster does not cover, in metres above the"
    " ellipsoid. Default: voids are holes, and other places lie at 0; for .pmtiles all lie 1 m"
    " below the lowest height.",
)
@click.option(
    "--encoding",
    type=click.Choice(TILE_ENCODINGS),
    help="For .pmtiles: encoding of heights. mapbox (default) has steps of 0.1 m above"
    " -10000 m, terrarium steps of 1/256 m above -32768 m.",
)
@click.option("--transparent-voids", is_flag=True, help="For .pmtiles: make voids transparent.")
@click.option(
    "--tile-size",
    type=int,
    help="For .pmtiles: pixels along a tile's side, 256 (default) or 512.",
)
@click.option(
    "--image",
    type=click.Choice(TILE_IMAGES),
    help="For .pmtiles: lossless image format. Files of webp (default) are smaller.",
)
@click.option(
    "--round-by-zoom",
    is_flag=True,
    help="For .pmtiles: round heights to steps of at most the file's bound on the finest zoom,"
    " twice as much on each coarser one, and at most 1/64 of a pixel on the ground; or to the"
    " encoding's step, if that is larger.",
)
@VERTICAL_OPTION
@click.option("--attribution", default="", help="Owner of the data, for the metadata.")
@RADIUS_OPTION
@THREADS_OPTION
@click.option("--overwrite", is_flag=True, help="Replace an existing target.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def tiles(
    file: str, target: str, threads: int | None, quiet: bool, as_json: bool, **options: Any
) -> None:
    """Write map tiles of FILE (.twz) to a directory for CesiumJS, or to an archive (.pmtiles).

    A directory gets quantized-mesh tiles and layer.json: serve it over HTTP and pass its address
    to CesiumTerrainProvider.fromUrl. An archive gets terrain-RGB tiles for MapLibre and other maps.
    """
    import terrainwave

    is_archive = target.lower().endswith(ARCHIVE_ENDING)
    write = _write_archive if is_archive else _write_directory
    announce_compiling(quiet=quiet)
    with (
        reading(file),
        terrainwave.open(file, threads=threads) as terrain,
        Bar(quiet=quiet) as bar,
    ):
        units = terrain.units
        summaries = write(terrain, target, threads=threads, progress=bar, **options)
    if as_json:
        zooms = [asdict(zoom) for zoom in summaries]
        print_json({"path": str(Path(target)), "zooms": zooms})
    elif not quiet:
        _print_zooms(target, summaries, units, is_archive=is_archive)
        if not units:
            print_note(
                "the raster names no vertical unit: heights and errors are as stored, which maps"
                " take for metres"
            )


# Options of an archive only; None or False where they are not given.
_OF_ARCHIVES = ("rim", "encoding", "transparent_voids", "tile_size", "image", "round_by_zoom")


def _write_archive(terrain: Any, target: str, *, vertical: str, **options: Any) -> list[Any]:
    from terrainwave.globe.archive import write_pmtiles

    if vertical != AS_IS:
        raise InvalidArgumentError(
            f"found `vertical` {vertical} for an archive ({ARCHIVE_ENDING}), expected a directory"
            " for Cesium: terrain-RGB tiles keep the file's datum"
        )
    given = {name: value for name, value in options.items() if value is not None}
    return write_pmtiles(terrain, target, **given)


def _write_directory(
    terrain: Any,
    target: str,
    *,
    void_height: float | None,
    **options: Any,
) -> list[Any]:
    from terrainwave.globe.cesium import write_tiles

    for name in _OF_ARCHIVES:
        value = options.pop(name)
        if value is not None and value is not False:
            raise InvalidArgumentError(
                f"found `{name}` for a directory, expected none: it is for an archive, whose name"
                f" ends in {ARCHIVE_ENDING}"
            )
    fill = void_height is not None
    return write_tiles(terrain, target, void_height=void_height or 0.0, fill_voids=fill, **options)


def _print_zooms(target: str, summaries: Any, units: str | None, *, is_archive: bool) -> None:
    header = ["zoom", "tiles", "triangles", "bytes", "Cesium's error", "surface error"]
    if is_archive:
        header = ["zoom", "tiles", "bytes", "step", "surface error", "terrain error"]
    rows = []
    for zoom in summaries:
        row = [str(zoom.zoom), f"{zoom.n_tiles:,}"]
        if is_archive:
            row += [f"{zoom.n_bytes:,}", f"{zoom.step:g}"]
            row += [_metres(zoom.surface_error), _metres(zoom.terrain_error)]
        else:
            row += [f"{zoom.n_triangles:,}", f"{zoom.n_bytes:,}", f"{zoom.geometric_error:.5g}"]
            row += [_metres(zoom.surface_error)]
        rows.append([*row, _metres(zoom.error)])
    print_grid([*header, "error"], rows)
    n_tiles = sum(zoom.n_tiles for zoom in summaries)
    in_metres = "; errors in m" if units else ""
    click.echo(f"{plain(target)}: {count_of(n_tiles, 'tile')}{in_metres}")
    if not is_archive:
        layer = json.loads((Path(target) / "layer.json").read_text(encoding="utf-8"))
        click.echo(f"heights {vertical_in_words(layer['vertical'])}")


def _metres(error: float | None) -> str:
    return "-" if error is None else f"{error:.5g}"
