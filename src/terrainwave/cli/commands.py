"""The commands. Each is short: parse, call, print."""

import json
import math
import shlex
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click

from terrainwave._version import __version__
from terrainwave.arguments import (
    AS_IS,
    FILLINGS,
    GEOTIFF_ENDINGS,
    HEIGHT_TILE_ENDINGS,
    TWZ_ENDINGS,
    VERTICAL,
    VOIDS,
    check_ending,
    count_of,
    crs_name,
    one_of,
)
from terrainwave.cli.batch import (
    Done,
    Job,
    Work,
    find_original,
    finish,
    made,
    plan,
    refuse_options_of_batches,
    refuse_unknown_raster,
    run,
)
from terrainwave.cli.manifest import UNKNOWN, Manifest
from terrainwave.cli.options import (
    BlockSide,
    Bound,
    Directory,
    Finite,
    Input,
    Name,
    NamedInput,
    Nodata,
    Numbers,
    Positive,
    Target,
    TileSize,
    complete_files,
)
from terrainwave.cli.output import (
    Bar,
    Commands,
    announce_compiling,
    plain,
    print_grid,
    print_note,
    print_table,
    reading,
)
from terrainwave.cli.streams import STREAM, printing_beside, written
from terrainwave.container.sources.addresses import display_name
from terrainwave.names import (
    DEFAULT_METHOD,
    EFFORTS,
    FORMATS,
    MESH_CHOICES,
    METHODS,
    SMALLEST_METHOD,
    UNBOUNDED_MESHES,
    WARMUP_TASKS,
    Method,
    methods_that,
)
from terrainwave.progress import ProgressCallback

THREADS = click.IntRange(min=1)
METHOD = click.Choice(["auto", *METHODS])
CUTTABLE = methods_that(lambda method: method.is_cuttable)
FAITHFUL = methods_that(lambda method: method.may_be_faithful)
_EFFORTS = [f"{method.name} {method.effort}" for method in METHODS.values() if method.effort]
EFFORT = (
    f"How much is tried: {'; '.join(_EFFORTS)}; the others have one way."
    f" For archives: best without --method is {SMALLEST_METHOD.name}, whose files are"
    " 0.95 of the default's size (0.78 to 0.99), and are read 5 times as slowly."
)
VERTICAL_OPTION = click.option(
    "--vertical",
    type=click.Choice(VERTICAL),
    default=AS_IS,
    show_default=True,
    help="Heights on the globe: taken as above the ellipsoid, or converted from the CRS's vertical"
    " datum by PROJ's grid.",
)
MESH = click.Choice(["auto", *MESH_CHOICES, "none"])


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="terrainwave")
def main() -> None:
    """Compress elevation rasters to small .twz files, each height within a bound you choose."""


def _writing(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of commands that write a file."""
    for option in (
        click.option(
            "--threads", type=THREADS, help="Threads; by default all processors that it may use."
        ),
        click.option("--overwrite", is_flag=True, help="Replace an existing file."),
        click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes."),
    ):
        command = option(command)
    return command


def _batched(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of commands that take many files at once."""
    for option in (
        click.option(
            "--skip-existing",
            is_flag=True,
            help="With --to: leave out what is there already, of the same source and with the same"
            " options.",
        ),
        click.option(
            "--to",
            type=Directory(),
            metavar="DIR",
            help="Write a file for each SOURCE to this directory; go on past those that fail.",
        ),
    ):
        command = option(command)
    return command


@main.command()
@click.argument("paths", nargs=-1, metavar="SOURCE... TARGET", shell_complete=complete_files)
@click.option(
    "--max-error",
    type=Bound(),
    help="Largest allowed error, in the raster's vertical unit; 0 is lossless."
    " Default: lossless where the heights have a vertical step, else 0.01.",
)
@click.option("--rate", type=Positive(), help=f"With --method {CUTTABLE}: bits per sample.")
@click.option("--psnr", type=Positive(), help=f"With --method {CUTTABLE}: decibels to reach.")
@click.option(
    "--method",
    type=METHOD,
    default="auto",
    show_default=True,
    help=f"auto is {DEFAULT_METHOD.name}; with --effort best it is {SMALLEST_METHOD.name}.",
)
@click.option("--block", type=BlockSide(), default=256, show_default=True, help="Cells per side.")
@click.option(
    "--effort", type=click.Choice(EFFORTS), default="default", show_default=True, help=EFFORT
)
@click.option("--nodata", type=Nodata(), help="Replaces the raster's own nodata value.")
@click.option("--band", type=click.IntRange(min=1), default=1, show_default=True)
@click.option(
    "--no-georeference",
    is_flag=True,
    help="Take the heights without place and CRS, whatever the raster says of them.",
)
@click.option("--border-rings", type=click.Choice(["1", "3"]), default="1", show_default=True)
@click.option("--temp-dir", type=Name(), help="Where large temporary data go.")
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Share the work out to a dask cluster whose workers see SOURCE and TARGET.",
)
@click.option("--no-verify", is_flag=True, help="Skip decoding and comparing every sample.")
@click.option("--mesh", type=MESH, default="auto", show_default=True, help="Triangulation.")
@click.option("--no-mesh", is_flag=True, help="Same as --mesh none.")
@click.option(
    "--mesh-error",
    type=Bound(),
    help="Distance of the finest meshes from the heights. Default: the guaranteed error, or the"
    " heights' vertical step if that is more.",
)
@click.option(
    "--faithful",
    is_flag=True,
    help=f"With --method {FAITHFUL}: follow the method's paper to the letter.",
)
@click.option(
    "--strict",
    is_flag=True,
    help="Floats with a decimal step (0.01 …): the stored floats are within the bound themselves,"
    " not only the decimal numbers, for a larger file.",
)
@click.option(
    "--format",
    type=click.Choice(FORMATS),
    default=FORMATS[-1],
    show_default=True,
    help=f"{FORMATS[0]}: write what the first readers read, too.",
)
@click.option(
    "--stable",
    is_flag=True,
    help="Round heights to fixed steps that follow from --max-error and the raster's type: what was"
    " decompressed and is compressed again with the same bound does not change, for a larger file.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@_batched
@_writing
def compress(
    paths: tuple[str, ...],
    to: str | None,
    skip_existing: bool,
    no_georeference: bool,
    border_rings: str,
    scheduler: str | None,
    no_verify: bool,
    mesh: str,
    no_mesh: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Compress the raster SOURCE to the file TARGET (.twz).

    Several SOURCEs are a mosaic: rasters of one CRS and grid. It is void where none of them is;
    where they overlap, the last counts. A SOURCE or TARGET that is - is stdin or stdout.
    With --to DIR there is no TARGET: each SOURCE becomes a file of its own in DIR.
    """
    import terrainwave

    refuse_options_of_batches(to, skip_existing=skip_existing, overwrite=options["overwrite"])
    method = METHODS.get(options["method"], DEFAULT_METHOD)
    _check_goals(method, options)
    if scheduler is not None and not method.is_clusterable:
        raise click.UsageError(
            f"found --scheduler and --method {method.name}, expected one of them"
        )
    options |= {
        "georeference": not no_georeference,
        "border_rings": int(border_rings),
        "mesh": "none" if no_mesh else mesh,
        "verify": not no_verify,
    }
    if to is not None:
        if scheduler is not None:
            raise click.UsageError("found --scheduler and --to, expected one of them")

        if skip_existing:
            options["overwrite"] = True  # what is there and not the same is made again

        def compress_one(job: Job, threads: int, progress: ProgressCallback) -> Done:
            result = terrainwave.compress(
                job.source, str(job.target), progress=progress,
                **options | {"threads": threads, "keep_origin": True},
            )  # fmt: skip
            return Done(_result_line(result), asdict(result))

        _run_to(
            paths, to, ".twz", compress_one, "compressed",
            manifest=_manifest_of_rasters(to, options) if skip_existing else None,
            threads=options["threads"], as_json=as_json, quiet=quiet,
        )  # fmt: skip
        return
    sources, target = _sources_and_target(paths)
    if no_georeference and len(sources) > 1:
        raise click.UsageError(
            f"found --no-georeference and {len(sources)} SOURCEs, expected one: a mosaic is put"
            " together by their places"
        )
    announce_compiling(quiet=quiet)
    with (
        _cluster(scheduler) as client,
        Bar(quiet=quiet) as bar,
        written(target, ".twz") as path,
    ):
        result = terrainwave.compress(
            sources,
            path,
            client=client,
            progress=bar,
            **options,
        )
    result = replace(result, path=target)
    with printing_beside(target):
        if as_json:
            print_json(asdict(result))
        elif not quiet:
            _print_result(result)


def _run_to(
    sources: tuple[str, ...],
    directory: str,
    ending: str,
    work: Work,
    word: str,
    *,
    manifest: Manifest | None,
    threads: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make a file of each source in a directory, and end with the status of all."""
    if not sources:
        raise click.UsageError("Missing argument 'SOURCE'.")
    jobs = plan(sources, directory, ending)
    announce_compiling(quiet=quiet)
    with made(directory):
        found, status = run(
            jobs, work, word=word, threads=threads, quiet=quiet or as_json,
            manifest=manifest,
        )  # fmt: skip
    if as_json:
        print_json({"files": found})
    finish(status)


def _manifest_of_rasters(directory: str, options: dict[str, Any]) -> Manifest:
    """Return what tells which files of a batch of `compress` are as asked for."""
    from terrainwave.raster_io.files import files_of
    from terrainwave.write.options import Options
    from terrainwave.write.origin import difference

    unrelated = ("temp_dir", "overwrite", "threads")
    of_files = {name: value for name, value in options.items() if name not in unrelated}
    source = {"nodata": repr(of_files["nodata"])}
    source |= {name: of_files[name] for name in ("band", "georeference")}
    asked = Options(**{name: of_files[name] for name in of_files.keys() - source.keys()})
    return Manifest(
        directory,
        {"command": "compress", **asked.to_metadata(), **source},
        files_of=files_of,
        # Whatever the manifest says: heights that are the same need no second file.
        compare=lambda source, target, known, progress: difference(
            target, source, progress=progress, **of_files
        ),
    )


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


def _sources_and_target(paths: tuple[str, ...]) -> tuple[list[str], str]:
    """Return the sources and the target of `compress`, by their order."""
    if len(paths) < 2:
        missing = "TARGET" if paths else "SOURCE"
        raise click.UsageError(f"Missing argument '{missing}'.")
    ctx = click.get_current_context()
    target = paths[-1]
    try:
        # Not only a slip: with `*.tif` the last raster stands where the target does.
        target = Target(TWZ_ENDINGS).convert(target, None, ctx)
    except click.BadParameter as error:
        raise click.UsageError(
            f"TARGET is the last name: {error.message}; to compress each raster to a file of its"
            " own add --to DIR"
        ) from error
    return [Input().convert(path, None, ctx) for path in paths[:-1]], target


def _check_goals(method: Method, options: dict[str, Any]) -> None:
    """Refuse goals of `compress` that exclude each other."""
    given = [name for name in ("max_error", "rate", "psnr") if options[name] is not None]
    names = " and ".join(f"--{name}".replace("_", "-") for name in given)
    if len(given) > 1:
        raise click.UsageError(f"found {names}, expected one of them")
    if given and given != ["max_error"] and not method.is_cuttable:
        raise click.UsageError(f"found {names} without --method {CUTTABLE}, expected --max-error")


def _cluster(scheduler: str | None) -> AbstractContextManager[Any]:
    """Give a client of a dask scheduler; None without an address."""
    if scheduler is None:
        return nullcontext()
    from terrainwave.ext.distributed import connected

    return connected(scheduler)


def _result_line(result: Any) -> str:
    return (
        f"{plain(result.path)}: {result.n_bytes:,} bytes, {result.bits_per_sample:.4g} bits/sample,"
        f" {result.ratio:.4g} times smaller than raw"
    )


def _print_result(result: Any) -> None:
    measured = "not checked" if result.measured_error is None else f"{result.measured_error:.6g}"
    click.echo(_result_line(result))
    click.echo(
        f"max error asked {result.max_error:.6g}, guaranteed {result.effective_error:.6g},"
        f" measured {measured}{_unit(result.units)}"
    )
    _note_unit(result.units)
    for note in result.notes:
        print_note(note)


@main.command()
@click.argument("file", type=NamedInput())
@click.argument("new", type=Input())
@click.option("--nodata", type=Nodata(), help="Replaces the new raster's own nodata value.")
@click.option("--band", type=click.IntRange(min=1), default=1, show_default=True)
@click.option(
    "--original",
    type=Input(),
    help="The raster that FILE was made of, with all earlier patches. Heights beyond NEW are then"
    " coded towards it; without it they stay as they are in FILE.",
)
@click.option("--temp-dir", type=Name(), help="Where large temporary data go.")
@click.option("--threads", type=THREADS, help="Threads; by default all processors that it may use.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def patch(file: str, new: str, quiet: bool, as_json: bool, **options: Any) -> None:
    """Bring FILE (.twz) up to date with the raster NEW, which covers all or part of it."""
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
            f" {result.measured_error:.6g}{_unit(result.units)}, of the whole file"
        )
        _note_unit(result.units)
    for note in result.notes:
        print_note(note)


@main.command()
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
@_batched
@_writing
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

        _run_to(
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


@main.command()
@click.argument("file", type=Input())
@click.argument("target", shell_complete=complete_files)
@click.option(
    "--max-error",
    type=Bound(),
    help="Largest allowed vertical distance of the mesh from the original heights, in the file's"
    " unit. Default: that of the stored meshes.",
)
@click.option("--max-triangles", type=click.IntRange(min=1), help="The best mesh of at most N.")
@click.option("--level", type=int, default=-1, help="-1 full grid (default), -2 half, 0 coarsest.")
@click.option("--window", type=Numbers("row,col,n_rows,n_cols", int), help="Part, in samples.")
@click.option("--bounds", type=Numbers("left,bottom,right,top", float), help="Part, in the CRS.")
@click.option(
    "--optimise/--no-optimise",
    default=True,
    show_default=True,
    help="Spend more time for fewer triangles at the same error.",
)
@click.option(
    "--loose",
    is_flag=True,
    help="The triangulation of the zero trees alone, without a guarantee (Yusov & Turlapov 2010,"
    " §2.4); its error is measured. --level -2 (default) is the finest.",
)
@click.option(
    "--frame",
    type=click.Choice(["local", "native", "ecef"]),
    help="Coordinates: metres from the middle, as in the CRS, or geocentric. Default: local where"
    " the CRS counts degrees, else native.",
)
@click.option("--z-scale", type=Positive(), default=1.0, help="Multiply heights.")
@click.option(
    "--solid",
    type=Finite(),
    help="Make a printable body with a flat base at this height, in the file's unit.",
)
@click.option("--radius", type=Positive(), help="Of the planet, in metres, for degrees.")
@VERTICAL_OPTION
@click.option(
    "--store", is_flag=True, help="Make a copy of FILE with meshes stored in it; TARGET is a .twz."
)
@click.option("--mesh", "kind", type=MESH, help="With --store: triangulation.")
@click.option("--mesh-error", type=Bound(), help="With --store: as for compress.")
@click.option(
    "--original", type=Input(), help="With --store: the raster, to measure errors against."
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@_writing
@click.pass_context
def mesh(context: click.Context, /, file: str, target: str, store: bool, **options: Any) -> None:
    """Write a mesh of FILE (.twz) to TARGET, no further from the original than the bound.

    TARGET's extension tells the format: .ply, .obj, .stl, .glb, .gltf, .vtu, .vtk, or .terrain, a
    Cesium quantized-mesh tile.
    """
    given = {
        name
        for name in options
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
    }
    common = {"threads", "overwrite", "quiet", "as_json"}
    unfit = given - common - _STORE_OPTIONS if store else given & _STORE_OPTIONS
    if unfit:
        names = {"kind": "mesh"}
        flags = ", ".join(sorted(f"--{names.get(name, name)}".replace("_", "-") for name in unfit))
        raise click.UsageError(f"found {flags} {'with' if store else 'without'} --store")
    if options["loose"]:
        goals = sorted(given & {"max_error", "max_triangles", "optimise"})
        if goals:
            flags = ", ".join(f"--{name}".replace("_", "-") for name in goals)
            raise click.UsageError(
                f"found {flags} with --loose, which has no goal: its mesh follows the zero trees"
            )
        options["optimise"] = False
    if store:
        _store_meshes(file, target, **{name: options[name] for name in common | _STORE_OPTIONS})
    else:
        _export_mesh(
            file, target, **{name: options[name] for name in options.keys() - _STORE_OPTIONS}
        )


_STORE_OPTIONS = {"kind", "mesh_error", "original"}


def _store_meshes(
    file: str, target: str, *, kind: str | None, as_json: bool, quiet: bool, **options: Any
) -> None:
    import terrainwave

    if kind == "none":
        raise click.UsageError(
            f"found --mesh none with --store, expected one of auto, {', '.join(MESH_CHOICES)}"
        )
    check_ending(target, TWZ_ENDINGS)
    announce_compiling(quiet=quiet)
    with reading(file), Bar(quiet=quiet) as bar:
        path = terrainwave.store_meshes(file, target, mesh=kind or "auto", progress=bar, **options)
    n_bytes = Path(path).stat().st_size
    if as_json:
        print_json({"path": path, "n_bytes": n_bytes})
    elif not quiet:
        click.echo(f"{plain(path)}: {n_bytes:,} bytes, with meshes")


def _export_mesh(
    file: str,
    target: str,
    *,
    frame: str | None,
    z_scale: float,
    solid: float | None,
    radius: float | None,
    vertical: str,
    optimise: bool,
    loose: bool,
    overwrite: bool,
    threads: int | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    import terrainwave
    from terrainwave.container.publish import refuse_own_source
    from terrainwave.export.files import check_extension, prepare

    if options["window"] and options["bounds"]:
        raise click.UsageError("found both --window and --bounds, expected one of them")
    extension = check_extension(target)
    if extension == ".terrain" and (frame or z_scale != 1 or solid is not None):
        raise click.UsageError(
            "a .terrain tile has a frame of its own: expected no --frame, --z-scale, --solid"
        )
    refuse_own_source(file, target)
    prepare(target, overwrite=overwrite)
    if vertical == "ellipsoid" and frame != "ecef" and extension != ".terrain":
        raise click.UsageError(
            "found --vertical ellipsoid, expected --frame ecef or a .terrain tile with it: other"
            " coordinates keep the file's datum"
        )
    shape = {
        "frame": frame, "z_scale": z_scale, "solid": solid, "radius": radius, "vertical": vertical,
    }  # fmt: skip
    announce_compiling(quiet=quiet)
    with (
        reading(file),
        terrainwave.open(file, threads=threads) as terrain,
        Bar(quiet=quiet) as bar,
    ):
        surface = _mesh_for(
            target,
            lambda max_error: terrain.mesh(
                optimise=int(optimise),
                guarantee=not loose,
                progress=bar,
                **options | {"max_error": max_error},
            ),
            options["max_error"],
            shape,
        )
    saved = surface.save(target, overwrite=overwrite, **shape)
    if as_json:
        print_json(asdict(saved))
    elif not quiet:
        _print_saved(saved, "measured" if loose else "guaranteed")


def _mesh_for(
    target: str, make: Callable[[float | None], Any], bound: float | None, shape: dict[str, Any]
) -> Any:
    """Return a mesh whose error keeps the bound in the file too, where that can be had.

    Rounding in the file adds to a mesh's error: the mesh is made again with so much less.
    """
    from terrainwave.errors import InvalidHeightsError
    from terrainwave.export.files import file_rounding

    first = surface = make(bound)
    if bound is None:
        return first
    for _ in range(_MESH_ATTEMPTS):
        rounding = file_rounding(surface, target, **shape)
        if surface.error + rounding <= bound:
            return surface
        try:
            # The next mesh is another one: its rounding may be somewhat more.
            surface = make(bound - _ROUNDING_SLACK * rounding)
        except InvalidHeightsError:
            break
    print_note(
        f"rounding of coordinates in the file adds to the error, which is more than {bound:g};"
        " .ply, .obj and .vtu keep it"
    )
    return first


_MESH_ATTEMPTS = 3
_ROUNDING_SLACK = 1.25


def vertical_in_words(about: dict[str, Any]) -> str:
    """Return what heights on the globe are, as files tell it in a few fields."""
    if about["heights"] == AS_IS:
        return f"as they are ({plain(about['datum'])})" if "datum" in about else "as they are"
    grids = f" by {', '.join(map(plain, about['grids']))}" if about.get("grids") else ""
    return f"above the ellipsoid{grids}"


def _print_saved(saved: Any, kind_of_error: str) -> None:
    click.echo(
        f"{plain(saved.path)}: {count_of(saved.n_triangles, 'triangle')},"
        f" {saved.n_vertices:,} vertices,"
        f" {saved.n_bytes:,} bytes"
    )
    heights = "" if saved.vertical is None else f", heights {vertical_in_words(saved.vertical)}"
    click.echo(
        f"{kind_of_error} error {saved.error:.6g}{_unit(saved.units)}, frame {saved.frame}{heights}"
    )
    _note_unit(saved.units)
    if saved.curvature:
        print_note(
            f"flat triangles lie up to {saved.curvature:.3g} m below the curved body between"
            " their vertices; the error does not count this"
        )


@main.command()
@click.argument("file", type=Input())
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
@click.option(
    "--errors",
    type=click.Choice(["measured", "recursive"]),
    help="List each level's largest error: as stored, or the upper bound computed from decoded"
    " heights (slow).",
)
@click.option("--voids", is_flag=True, help="Count the voids (slow: decodes all heights).")
@click.option(
    "--parts",
    is_flag=True,
    help="List the bytes of each part by URL too, which takes many requests.",
)
@click.option(
    "--meshes",
    is_flag=True,
    help="List each level's triangles, the bits they take and what zero trees hold (slow: makes all"
    " meshes).",
)
def info(
    file: str, as_json: bool, errors: str | None, voids: bool, parts: bool, meshes: bool
) -> None:
    """Show what the file FILE (.twz) holds."""
    import terrainwave
    from terrainwave.mesh.level_errors import level_errors

    with reading(file), terrainwave.open(file) as terrain:
        summary = terrain.info()
        by_part = terrain.parts() if parts or "://" not in file else None
        by_level = None if errors is None else level_errors(terrain, errors)
        n_voids = terrain.count_voids() if voids else None
        by_mesh = _mesh_levels(terrain) if meshes else None
    if as_json:
        more = {
            "parts": None if by_part is None else asdict(by_part),
            "level_errors": by_level,
            "n_voids": n_voids,
            "meshes": None if by_mesh is None else [level._asdict() for level in by_mesh],
        }
        found = {name: value for name, value in more.items() if value is not None}
        print_json(summary.to_dict() | found)
    else:
        print_table(_info_rows(summary, n_voids))
        if by_part is not None:
            _print_parts(by_part)
        if by_level is not None:
            _print_level_errors(summary.level_shapes, by_level)
        if by_mesh is not None:
            _print_mesh_levels(by_mesh)


def _mesh_levels(terrain: Any) -> Any:
    from terrainwave.mesh.statistics import mesh_levels

    return mesh_levels(terrain)


def _voids_in_words(info: Any, n_voids: int | None) -> str:
    if info.minimum is None:
        return "all samples"
    kind = {
        "none": "none",
        "nodata": f"where heights are {info.nodata}",
        "nan": "where heights are NaN",
        "mask": "by a mask",
    }[info.voids]
    if n_voids is None:
        return kind
    return f"{count_of(n_voids, 'sample')}, {n_voids / (info.n_rows * info.n_cols):.4g} of all"


def _print_parts(parts: Any) -> None:
    """Print the bytes of each part of a file; levels only where each has bytes of its own."""
    rows = [("header and metadata", parts.metadata), ("tables", parts.tables)]
    rows += [("index", parts.index), ("heights", sum(parts.heights))]
    if len(parts.heights) > 1:
        rows += [(f"  level {level}", size) for level, size in enumerate(parts.heights)]
    rows.append(("meshes", parts.meshes))
    total = sum(size for name, size in rows if not name.startswith(" "))
    print_grid(
        ["part", "bytes", "share"],
        [[name, f"{size:,}", f"{100 * size / total:.3g} %"] for name, size in rows],
    )


def _print_mesh_levels(levels: Any) -> None:
    rows = [
        [
            str(found.level),
            f"{found.n_triangles:,}",
            f"{found.label_bits:.3f}",
            "" if found.significant is None else f"{100 * found.significant:.3g} %",
            "" if found.n_loose is None else f"{found.n_loose:,}",
        ]
        for found in levels
    ]
    print_grid(["level", "triangles", "bits/sample", "significant nodes", "loose triangles"], rows)


def _print_level_errors(shapes: Any, errors: list[float]) -> None:
    rows = [
        [str(level), *map(str, shape), f"{error:.6g}"]
        for level, (shape, error) in enumerate(zip(shapes, errors, strict=True))
    ]
    print_grid(["level", "rows", "columns", "largest error"], rows)


def _info_rows(info: Any, n_voids: int | None) -> list[tuple[str, object]]:
    unit = _unit(info.units)
    crs = crs_name(info.crs)
    if crs != info.crs and info.crs:
        crs += " (WKT; --json shows all)"
    levels = ", ".join(f"{rows} x {cols}" for rows, cols in info.level_shapes)
    extent = "none" if info.minimum is None else f"{info.minimum:.6g} to {info.maximum:.6g}{unit}"
    scale = f"{info.scale:g}, offset {info.offset:g}"
    way = "faithful to its paper" if info.faithful else f"effort {info.effort}"
    tolerance = f"within {info.mesh_tolerance:.6g}{unit} of the heights"
    if info.mesh in UNBOUNDED_MESHES:
        tolerance = f"coefficients above {info.mesh_tolerance:.6g}{unit}; errors are measured"
    floats = (
        f"; stored floats may differ by {info.float_error:.3g} more" if info.float_error else ""
    )
    rows = [
        ("file", f"{info.path}, {info.n_bytes:,} bytes"),
        ("size", f"{info.n_rows} rows x {info.n_cols} columns, {info.dtype}"),
        ("bits/sample", f"{info.bits_per_sample:.4g}, {info.ratio:.4g} times smaller than raw"),
        (
            "max error",
            f"asked {info.max_error:.6g}, holds {info.effective_error:.6g}{unit}{floats}",
        ),
        (
            "moved",
            f"{info.moved_error:.6g}{unit} of it by patches, or in a file before"
            if info.moved_error
            else "",
        ),
        ("quantum", f"{info.quantum:.6g}{unit}"),
        ("heights", extent),
        ("unit", _unit_in_words(info)),
        ("voids", _voids_in_words(info, n_voids)),
        ("method", f"{info.method}, {way}, border rings {info.border_rings}"),
        ("format", info.format),
        ("block", f"{info.block} x {info.block} cells"),
        ("mesh", info.mesh if info.mesh == "none" else f"{info.mesh}, {tolerance}"),
        ("levels", f"{info.n_levels}: {levels}"),
        ("nodata", "none" if info.nodata is None else info.nodata),
        ("CRS", crs),
        ("bounds", ", ".join(f"{value:.10g}" for value in info.bounds)),
        ("pixel", f"{info.transform[0]:.10g}, {info.transform[4]:.10g}"),
        ("a pixel is", (info.area_or_point or "").lower()),
        ("scale", scale if (info.scale, info.offset) != (1, 0) else ""),
        ("description", info.description or ""),
        *((f"tag {name}", value) for name, value in info.tags.items()),
        *((f"band tag {name}", value) for name, value in info.band_tags.items()),
        ("colour", info.color_interpretation or ""),
    ]
    return [(name, value) for name, value in rows if value != ""]


def _unit_in_words(info: Any) -> str:
    if info.units is None:
        return "unknown"
    if info.units_of_crs is not None:
        return f"{info.units} (from the band; the CRS says {info.units_of_crs})"
    return f"{info.units} (from the {info.units_from})"


def _unit(units: str | None) -> str:
    """Return the unit to print behind a height, or nothing if it is unknown."""
    return f" {plain(units)}" if units else ""


def _note_unit(units: str | None) -> None:
    if not units:
        print_note("the raster does not name its vertical unit: errors are in that of its heights")


@main.command()
@click.argument("paths", nargs=-1, metavar="FILE [ORIGINAL]", shell_complete=complete_files)
@click.option(
    "--originals",
    type=click.Path(file_okay=False, exists=True),
    metavar="DIR",
    help="Where the rasters of several FILEs are, with the same names.",
)
@click.option("--max-error", type=Bound(), help="Hold the file to this bound instead of its own.")
@click.option("--band", type=click.IntRange(min=1), default=1, help="Band of ORIGINAL.")
@click.option("--nodata", type=Nodata(), help="The nodata value that was given to compress.")
@click.option("--mesh", is_flag=True, help="Check all meshes too: errors, borders, coverage.")
@click.option("--threads", type=THREADS, help="Threads; by default all processors that it may use.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing; the exit status tells.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def verify(
    paths: tuple[str, ...], originals: str | None, quiet: bool, as_json: bool, **options: Any
) -> None:
    """Compare FILE (.twz) with its ORIGINAL raster; without that, check all of FILE.

    Several FILEs, all of them .twz, are checked one by one; with --originals DIR each is compared
    with the raster of its name in DIR.
    """
    import terrainwave

    if not paths:
        raise click.UsageError("Missing argument 'FILE'.")
    are_files = all(Path(path).suffix.lower() in TWZ_ENDINGS for path in paths)
    if originals is not None or (are_files and len(paths) > 1):
        _verify_all(paths, originals, quiet=quiet, as_json=as_json, **options)
        return
    if len(paths) > 2:
        raise click.UsageError(
            f"found {len(paths)} names that are not all .twz, expected FILE and ORIGINAL, or"
            " files and --originals DIR"
        )
    ctx = click.get_current_context()
    file, *rest = (Input().convert(path, None, ctx) for path in paths)
    original = rest[0] if rest else None
    announce_compiling(quiet=quiet)
    with reading(file), Bar(quiet=quiet) as bar:
        report = terrainwave.verify(file, original, progress=bar, **options)
    if as_json:
        print_json(report.to_dict())
    elif not quiet:
        _print_report(report)
    if not report.ok:
        sys.exit(1)


def _verify_all(
    files: tuple[str, ...],
    originals: str | None,
    *,
    threads: int | None,
    quiet: bool,
    as_json: bool,
    **options: Any,
) -> None:
    import terrainwave

    def verify_one(job: Job, threads: int, progress: ProgressCallback) -> Done:
        original = None if originals is None else find_original(job.source, originals)
        with reading(job.source):
            report = terrainwave.verify(
                job.source, original, threads=threads, progress=progress, **options
            )
        found = "ok" if report.ok else f"not ok, {plain('; '.join(report.problems))}"
        if report.errors is not None:
            found += f", {count_of(report.errors.n_valid, 'height')} compared"
            if not report.errors.n_valid:
                print_note(
                    f"{display_name(job.source)}: no height was compared: none is valid in both"
                )
        return Done(
            f"{plain(display_name(job.source))}: {found}", report.to_dict(), is_good=report.ok
        )

    announce_compiling(quiet=quiet)
    found, status = run(
        [Job(file) for file in dict.fromkeys(files)], verify_one, word="ok", threads=threads,
        quiet=quiet or as_json,
    )  # fmt: skip
    if as_json:
        print_json({"files": found})
    finish(status)


def _print_report(report: Any) -> None:
    for problem in report.problems:
        click.echo(f"problem: {plain(problem)}")
    if report.errors is not None:
        errors = report.errors
        click.echo(
            f"{count_of(errors.n_valid, 'height')} compared: max error {errors.max_error:.6g}"
            f" (bound {report.bound:.6g}), RMSE {errors.rmse:.6g}"
        )
        if not report.problems and not report.is_strict:
            click.echo(
                "the bound holds of the numbers that floats stand for; stored floats differ by up"
                " to one float spacing more (compress --strict)"
            )
        elif report.is_strict and errors.n_valid:
            click.echo("the bound holds of the stored values themselves")
    if report.errors is not None and not report.errors.n_valid:
        print_note("no height was compared: there is none that is valid in both")
    if report.original is None:
        click.echo("no heights compared: give the ORIGINAL raster for that")
    if report.mesh is not None:
        _print_meshes(report.mesh)
    click.echo("ok" if report.ok else "not ok")


def _print_meshes(report: Any) -> None:
    rows = [
        [f"level {level.level}", f"{level.n_triangles:,}", f"{level.stored_error:.6g}",
         f"{level.measured_error:.6g}"]
        for level in report.levels
    ]  # fmt: skip
    for area in report.areas:
        asked = "area, stored" if area.max_error is None else f"area, {area.max_error:.6g}"
        name = f"{asked}, optimised" if area.optimise else asked
        rows.append(
            [name, f"{area.n_triangles:,}", f"{area.stated_error:.6g}",
             f"{area.measured_error:.6g}"]
        )  # fmt: skip
    print_grid(["meshes", "triangles", "stated error", f"from {report.against}"], rows)


class Tasks(click.ParamType):
    """Names of tasks, with commas between them."""

    name = "task,task,…"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        """Return the names."""
        names = value if isinstance(value, tuple) else tuple(value.split(","))
        for name in names:
            if name not in WARMUP_TASKS:
                self.fail(f"found {name}, expected of {', '.join(WARMUP_TASKS)}", param, ctx)
        return names


@main.command()
@click.option(
    "--for",
    "tasks",
    type=Tasks(),
    default=",".join(WARMUP_TASKS),
    show_default=True,
    help="What to compile for; compress always is.",
)
@click.option(
    "--to",
    "folder",
    type=Directory(),
    help="Keep the kernels in this folder; NUMBA_CACHE_DIR names it to later runs.",
)
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
def warmup(tasks: tuple[str, ...], folder: str | None, quiet: bool) -> None:
    """Compile all kernels now, so that no later run has to (for container images).

    Kernels are kept beside the package, or in the folder that NUMBA_CACHE_DIR names. Where that
    cannot be written, they are kept in a folder of your own, and the command says which.
    """
    from terrainwave.cli.warmup import compile_kernels, keep_kernels_in

    if folder is not None:
        path = Path(folder).absolute()
        n_kernels = keep_kernels_in(path, tasks, quiet=quiet)
        if not quiet:
            click.echo(f"{n_kernels} kernels are in {plain(path)}; where terrainwave runs, set")
            click.echo(f"NUMBA_CACHE_DIR={plain(shlex.quote(str(path)))}")
        return
    announce_compiling(quiet=quiet)
    for left_out in compile_kernels(tasks):
        print_note(f"left out: {left_out}")


@main.command()
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


@main.command()
@click.argument("directory", type=Directory(), default="terrainwave-demo")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors.")
def demo(directory: str, quiet: bool) -> None:
    """Compress a real elevation model at four bounds, check each, draw a picture; in DIRECTORY."""
    from terrainwave.cli.demo import BOUNDS, run_demo

    announce_compiling(quiet=quiet)
    with Bar(quiet=quiet) as bar:
        result = run_demo(directory, progress=bar)
    if quiet:
        return
    click.echo(
        f"{result.n_rows} x {result.n_cols} heights, GeoTIFF (DEFLATE): {result.n_bytes:,} bytes"
    )
    header = ["bound", "bytes", "bits/sample", "GeoTIFF/twz", "max error", "RMSE"]
    print_grid(header, [result.row(bound) for bound in BOUNDS])
    click.echo(f"checked each; picture: {plain(result.picture)}")


def print_json(fields: dict[str, Any]) -> None:
    """Print a result as JSON."""
    click.echo(json.dumps(plain_json(fields), indent=2, allow_nan=False))


def plain_json(value: Any) -> Any:
    """Return `value` with the numbers that JSON lacks as strings."""
    if isinstance(value, dict):
        return {name: plain_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
