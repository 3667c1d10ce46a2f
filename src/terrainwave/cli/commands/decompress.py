"""The command decompress: .twz files become GeoTIFFs and height tiles."""

from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import (
    AS_IS,
    FILLINGS,
    GEOTIFF_ENDINGS,
    HEIGHT_TILE_ENDINGS,
    VOIDS,
    one_of,
)
from terrainwave.cli.batch import (
    Done,
    Job,
    refuse_options_of_batches,
    refuse_unknown_raster,
    run_to,
)
from terrainwave.cli.manifest import UNKNOWN, Manifest
from terrainwave.cli.options import (
    CUTTABLE,
    VERTICAL_OPTION,
    Input,
    Numbers,
    Positive,
    Target,
    TileSize,
    batched,
    complete_files,
    writing,
)
from terrainwave.cli.output import (
    Bar,
    Command,
    announce_compiling,
    plain,
    print_note,
    reading,
)
from terrainwave.cli.streams import STREAM, printing_beside, written
from terrainwave.progress import ProgressCallback


@click.command(cls=Command)
@click.argument("paths", nargs=-1, metavar="SOURCE TARGET", shell_complete=complete_files)
@click.option(
    "--window", type=Numbers("row,col,n_rows,n_cols", int), help="Part to write; cut to the level."
)
@click.option(
    "--bounds", type=Numbers("left,bottom,right,top", float), help="Part, in the CRS; cut too."
)
@click.option("--level", type=int, default=-1, help="-1 full grid (default), -2 half, 0 coarsest.")
@click.option(
    "--quality",
    type=Positive(),
    help=f"Of a file of method {CUTTABLE}: read only so many bits per sample.",
)
@click.option("--cog", is_flag=True, help="Make a cloud-optimised GeoTIFF.")
@click.option(
    "--size",
    type=TileSize(),
    help="Samples on a side of a height tile, 2^n + 1: the window is resampled to that square."
    " Default: the largest that is not larger than the window; window writes its own samples.",
)
@click.option(
    "--voids",
    metavar="exact|any|lowest|fill|HEIGHT",
    help="Of a coarse level's GeoTIFF, what is void: exact, each sample where the full grid is"
    " (default, if the file tells), or any, samples alone around which nothing is valid; the others"
    " have a height of what is around them. Of a height tile, what voids become: the lowest height"
    " (default), what is around them (fill) or a height.",
)
@VERTICAL_OPTION
@batched
@writing
def decompress(
    paths: tuple[str, ...], to: str | None, skip_existing: bool, quiet: bool, **options: Any
) -> None:
    """Write the file SOURCE (.twz) to the GeoTIFF TARGET (.tif), or to stdout if that is -.

    A TARGET ending in .r16 or .png becomes a 16-bit height tile for game engines instead, with
    TARGET.json beside it that tells its scale and place. With --to DIR there is no TARGET: each
    SOURCE becomes a GeoTIFF in DIR.
    """
    import terrainwave

    refuse_options_of_batches(to, skip_existing=skip_existing, overwrite=options["overwrite"])
    if options["window"] and options["bounds"]:
        raise click.UsageError("found both --window and --bounds, expected one of them")
    if to is not None:
        if skip_existing:
            options["overwrite"] = True

        def decompress_one(job: Job, threads: int, progress: ProgressCallback) -> Done:
            with reading(job.source):
                path = terrainwave.decompress(
                    job.source, str(job.target), progress=progress, **options | {"threads": threads}
                )
            return Done(f"{plain(path)}: {Path(path).stat().st_size:,} bytes")

        run_to(
            paths, to, ".tif", decompress_one, "decompressed",
            manifest=_manifest_of_files(to, options, skips=skip_existing),
            threads=options["threads"], as_json=False, quiet=quiet,
        )  # fmt: skip
        return
    if len(paths) != 2:
        if len(paths) < 2:
            raise click.UsageError(f"Missing argument '{'TARGET' if paths else 'SOURCE'}'.")
        raise click.UsageError(
            f"found {len(paths)} names, expected SOURCE and TARGET; to make a GeoTIFF of each add"
            " --to DIR"
        )
    ctx = click.get_current_context()
    target = Target((*GEOTIFF_ENDINGS, *HEIGHT_TILE_ENDINGS)).convert(paths[1], None, ctx)
    source = Input().convert(paths[0], None, ctx)
    is_tile = Path(target).suffix.lower() in HEIGHT_TILE_ENDINGS
    if options["size"] and not is_tile:
        raise click.UsageError(f"{target}: --size is for height tiles, expected .r16 or .png")
    if options["voids"] not in (None, *VOIDS) and not is_tile:
        found = f"found --voids {options['voids']}"
        if options["voids"] in FILLINGS or options["voids"][-1:].isdigit():
            found = f"{target}: --voids {options['voids']} is for height tiles"
        raise click.UsageError(
            f"{found}, expected {one_of(VOIDS)}, or a name ending in .r16 or .png"
        )
    if options["vertical"] != AS_IS and is_tile:
        raise click.UsageError(
            f"{target}: a height tile keeps the file's datum, expected no --vertical"
        )
    if options["cog"] and is_tile:
        raise click.UsageError(f"{target}: a height tile cannot be a COG, expected no --cog")
    announce_compiling(quiet=quiet)
    with reading(source), Bar(quiet=quiet) as bar, written(target, ".tif") as path:
        terrainwave.decompress(source, path, progress=bar, **options)
        n_bytes = Path(path).stat().st_size
        if target == STREAM and Path(f"{path}.aux.xml").exists():
            print_note("stdout has no .aux.xml beside it: write to a file to keep the CRS")
    if not quiet:
        with printing_beside(target):
            click.echo(f"{plain(target)}: {n_bytes:,} bytes")


def _manifest_of_files(directory: str, options: dict[str, Any], *, skips: bool) -> Manifest:
    """Return what tells which rasters of a batch of `decompress` are as asked for."""
    unrelated = ("overwrite", "threads")

    def compare(source: str, target: str, known: str, progress: ProgressCallback) -> str:
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
