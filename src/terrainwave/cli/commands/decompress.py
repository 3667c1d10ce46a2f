"""Command decompress: .twz files to GeoTIFFs and height tiles."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from terrainwave.arguments import (
    AS_IS,
    FILLINGS,
    GEOTIFF_ENDINGS,
    HEIGHT_TILE_ENDINGS,
    ON_ERROR,
    RAISE,
    TWZ_ENDINGS,
    VOIDS,
    one_of,
)
from terrainwave.cli.batch import (
    UNKNOWN,
    Done,
    FileJob,
    Manifest,
    refuse_options_of_batches,
    refuse_unknown_raster,
    run_to,
)
from terrainwave.cli.options import (
    LEVEL_OPTION,
    POSITIVE,
    VERTICAL_OPTION,
    Input,
    OfKind,
    Target,
    batched,
    check_one_area,
    complete_files,
    writing,
)
from terrainwave.cli.output import (
    Bar,
    Command,
    announce_compiling,
    plain,
    print_json,
    print_note,
    reading,
)
from terrainwave.cli.streams import STREAM, printing_beside, without_lines_of_libtiff, written
from terrainwave.names import methods_that
from terrainwave.option_sets import BOUNDS, TILE_SIZE, WINDOW
from terrainwave.progress import ProgressCallback

if TYPE_CHECKING:
    from terrainwave.read.lost import Losses


@click.command(cls=Command)
@click.argument("paths", nargs=-1, metavar="SOURCE TARGET", shell_complete=complete_files)
@click.option(
    "--window",
    type=OfKind(WINDOW),
    help="Part to write, in samples.",
)
@click.option("--bounds", type=OfKind(BOUNDS), help="Part to write, in the CRS.")
@LEVEL_OPTION
@click.option(
    "--quality",
    type=POSITIVE,
    help="Read only this number of bits per sample, of a file of method"
    f" {methods_that(lambda method: method.is_cuttable)}.",
)
@click.option("--cog", is_flag=True, help="Make a cloud-optimised GeoTIFF.")
@click.option(
    "--size",
    type=OfKind(TILE_SIZE),
    help="Samples on each side of a height tile, 2^n + 1. The command resamples the window to this"
    " square. Default: the largest that fits into the window. window: the samples of the window.",
)
@click.option(
    "--voids",
    metavar="exact|any|lowest|fill|HEIGHT",
    help="Voids in the GeoTIFF of a coarse level: exact, where the full grid is void (default), or"
    " any, only where all samples around are void; other samples then have the height of their"
    " neighbours. Height of voids in a height tile: lowest (default), fill (that of their"
    " neighbours) or a number.",
)
@click.option(
    "--on-error",
    type=click.Choice(ON_ERROR),
    default=RAISE,
    show_default=True,
    help="What to do with damaged blocks: stop, or leave them void and name them. mask also reads"
    " a file that ends too early, as far as it goes.",
)
@VERTICAL_OPTION
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@batched
@writing
def decompress(paths: tuple[str, ...], to: str | None, skip_existing: bool, **options: Any) -> None:
    """Decompress SOURCE (.twz) to the GeoTIFF TARGET (.tif; - is stdout).

    If TARGET ends in .r16 or .png, the command writes a 16-bit height tile for game engines
    instead, and TARGET.json with its scale and position. With --to DIR there is no TARGET: each
    SOURCE becomes a GeoTIFF in DIR.
    """
    refuse_options_of_batches(to, skip_existing=skip_existing, overwrite=options["overwrite"])
    check_one_area(options)
    with without_lines_of_libtiff():
        if to is None:
            _decompress(*_source_and_target(paths), **options)
        else:
            _decompress_each(paths, to, skips=skip_existing, **options)


def _decompress(source: str, target: str, *, as_json: bool, quiet: bool, **options: Any) -> None:
    is_tile = Path(target).suffix.lower() in HEIGHT_TILE_ENDINGS
    (_check_options_of_tile if is_tile else _check_options_of_geotiff)(target, options)
    announce_compiling(quiet=quiet)
    with Bar(quiet=quiet) as bar, written(target, ".tif") as path:
        made = _made(source, path, bar, options)
        if target == STREAM and Path(f"{path}.aux.xml").exists():
            print_note("the GeoTIFF alone cannot hold the CRS: write to a file instead of stdout")
    with printing_beside(target):
        if as_json:
            print_json(made | {"path": target})
        elif not quiet:
            click.echo(f"{plain(target)}: {made['n_bytes']:,} bytes")


def _made(
    source: str, target: str, progress: ProgressCallback, options: dict[str, Any]
) -> dict[str, Any]:
    """Decompress a file; return the fields of the result, with losses if they are no error."""
    import terrainwave

    lost: list[Losses] = []
    with reading(source):
        path = terrainwave.decompress(
            source, target, progress=progress, on_lost=lost.append, **options
        )
    made = {"path": path, "n_bytes": Path(path).stat().st_size}
    if options["on_error"] == RAISE:
        return made
    return made | {"lost": lost[0].to_dict() if lost else None}


def _decompress_each(
    sources: tuple[str, ...],
    directory: str,
    *,
    skips: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    if skips:
        options["overwrite"] = True

    def decompress_one(job: FileJob, threads: int, progress: ProgressCallback) -> Done:
        made = _made(job.source, str(job.target), progress, options | {"threads": threads})
        return Done(f"{plain(made['path'])}: {made['n_bytes']:,} bytes", made)

    run_to(
        sources, directory, ".tif", decompress_one, "decompressed", endings=TWZ_ENDINGS,
        manifest=_manifest(directory, options, skips=skips),
        threads=options["threads"], as_json=as_json, quiet=quiet,
    )  # fmt: skip


def _source_and_target(paths: tuple[str, ...]) -> tuple[str, str]:
    if len(paths) < 2:
        raise click.UsageError(f"Missing argument '{'TARGET' if paths else 'SOURCE'}'.")
    if len(paths) > 2:
        raise click.UsageError(
            f"found {len(paths)} names, expected SOURCE and TARGET; to decompress each file, add"
            " --to DIR"
        )
    ctx = click.get_current_context()
    try:
        target = Target((*GEOTIFF_ENDINGS, *HEIGHT_TILE_ENDINGS)).convert(paths[1], None, ctx)
    except click.BadParameter as error:
        raise click.BadParameter(error.message, param_hint="TARGET") from error
    return Input().convert(paths[0], None, ctx), target


def _check_options_of_geotiff(target: str, options: dict[str, Any]) -> None:
    if options["size"]:
        raise click.UsageError(f"{target}: --size is for height tiles, expected .r16 or .png")
    voids = options["voids"]
    if voids not in (None, *VOIDS):
        found = f"found --voids {voids}"
        if voids in FILLINGS or voids[-1:].isdigit():
            found = f"{target}: --voids {voids} is for height tiles"
        raise click.UsageError(
            f"{found}, expected {one_of(VOIDS)}, or a name ending in .r16 or .png"
        )


def _check_options_of_tile(target: str, options: dict[str, Any]) -> None:
    if options["vertical"] != AS_IS:
        raise click.UsageError(
            f"{target}: found --vertical {options['vertical']}, expected none: a height tile keeps"
            " the file's datum"
        )
    if options["cog"]:
        raise click.UsageError(
            f"{target}: found --cog, expected none: a height tile cannot be a COG"
        )


def _manifest(directory: str, options: dict[str, Any], *, skips: bool) -> Manifest:
    unrelated = ("overwrite", "threads")

    def compare(_: str, target: str, known: str, __: ProgressCallback) -> str:
        if known == UNKNOWN:
            refuse_unknown_raster(target)
        return known

    return Manifest(
        directory,
        {"command": "decompress"}
        | {name: value for name, value in options.items() if name not in unrelated},
        files_of=lambda source: [source],
        compare=compare,
        skips=skips,
    )
