"""The command compress: rasters become .twz files."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from typing import Any

import click

from terrainwave.arguments import (
    TWZ_ENDINGS,
)
from terrainwave.cli.batch import (
    Done,
    Job,
    refuse_options_of_batches,
    run_to,
)
from terrainwave.cli.manifest import Manifest
from terrainwave.cli.options import (
    CUTTABLE,
    EFFORT,
    FAITHFUL,
    MESH,
    METHOD,
    BlockSide,
    Bound,
    Input,
    Name,
    Nodata,
    Positive,
    Target,
    batched,
    complete_files,
    writing,
)
from terrainwave.cli.output import (
    Bar,
    Command,
    announce_compiling,
    note_unit,
    plain,
    print_json,
    print_note,
    unit_behind,
)
from terrainwave.cli.streams import printing_beside, written
from terrainwave.names import (
    DEFAULT_METHOD,
    EFFORTS,
    FORMATS,
    METHODS,
    SMALLEST_METHOD,
    Method,
)
from terrainwave.progress import ProgressCallback


@click.command(cls=Command)
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
@batched
@writing
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

        run_to(
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
        f" measured {measured}{unit_behind(result.units)}"
    )
    note_unit(result.units)
    for note in result.notes:
        print_note(note)
