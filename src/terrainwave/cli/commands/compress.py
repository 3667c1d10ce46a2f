"""Command compress: rasters to .twz files."""

import threading
from contextlib import nullcontext
from dataclasses import asdict, replace
from typing import Any

import click

from terrainwave.arguments import TWZ_ENDINGS
from terrainwave.cli.batch import Done, FileJob, Manifest, refuse_options_of_batches, run_to
from terrainwave.cli.options import (
    CommandWithOwnOptions,
    Input,
    OfKind,
    Target,
    batched,
    complete_files,
    declared,
    on_command_line,
    own_option,
    resumable,
    with_own_options,
    writing,
)
from terrainwave.cli.output import (
    Bar,
    announce_compiling,
    note_unit,
    plain,
    print_json,
    print_note,
    print_notes,
    unit_behind,
)
from terrainwave.cli.streams import STREAM, printing_beside, written
from terrainwave.container.sources.addresses import display_name
from terrainwave.option_sets import NODATA
from terrainwave.place.meaning import KINDS
from terrainwave.progress import ProgressCallback
from terrainwave.write.compress_options import Options


@click.command(cls=CommandWithOwnOptions)
@click.argument("paths", nargs=-1, metavar="SOURCE... TARGET", shell_complete=complete_files)
@declared(Options, last="mesh")
@own_option(
    "Set an option of the method or of the kind of meshes. To list them, add"
    " --method METHOD or --mesh KIND before --help."
)
@click.option("--no-mesh", is_flag=True, help="Same as --mesh none.")
@declared(Options, "mesh_error", "block")
@click.option("--nodata", type=OfKind(NODATA),
              help="Value that marks voids, besides the raster's own; only:V replaces"
                   " that, none drops it.")  # fmt: skip
@click.option("--band", type=click.IntRange(min=1), default=1, show_default=True,
              help="Band to compress.")  # fmt: skip
@click.option(
    "--no-georeference",
    is_flag=True,
    help="Compress only the heights and ignore the raster's transform and CRS.",
)
@click.option(
    "--heights-are",
    type=click.Choice(KINDS),
    help="Meaning of the numbers. Depths and radii (distances from the centre of the body) are"
    " stored unchanged and converted to heights on the globe, in meshes and in views. Default:"
    " from the raster's metadata.",
)
@declared(Options, "digest")
@resumable
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Distribute the work over a dask cluster whose workers see SOURCE and TARGET.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@batched
@writing
def compress(
    paths: tuple[str, ...],
    own: tuple[str, ...],
    no_mesh: bool,
    no_georeference: bool,
    to: str | None,
    skip_existing: bool,
    **options: Any,
) -> None:
    """Compress the raster SOURCE to the file TARGET (.twz).

    Several SOURCEs are a mosaic: rasters of one CRS and grid. Samples that no raster covers are
    void; where rasters overlap, the last one counts. A SOURCE or TARGET - is stdin or stdout.
    TARGET may be a URL of writable storage, such as s3://bucket/dem.twz. With --to DIR there is no
    TARGET: each SOURCE becomes a file of its own in DIR.

    A SOURCE may be a .twz file, for a coarser bound, another method, or a mosaic. --max-error is
    then the bound from the original raster.
    """
    refuse_options_of_batches(to, skip_existing=skip_existing, overwrite=options["overwrite"])
    if no_mesh:
        if "mesh" in on_command_line() and options["mesh"] != "none":
            raise click.UsageError("found --no-mesh and --mesh, expected one of them")
        options["mesh"] = "none"
    options = with_own_options(own, options)
    options["georeference"] = not no_georeference
    if to is None:
        _compress(*_sources_and_target(paths), **options)
    else:
        _compress_each(paths, to, skips=skip_existing, **options)


def _compress(
    sources: list[str],
    target: str,
    *,
    scheduler: str | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    import terrainwave
    from terrainwave.ext.distributed import connected

    if not options["georeference"] and len(sources) > 1:
        raise click.UsageError(
            f"found --no-georeference and {len(sources)} SOURCEs, expected one: the rasters of a"
            " mosaic are placed by their georeference"
        )
    if scheduler is not None and not _asked(options).named_method.is_clusterable:
        method = _asked(options).named_method.name
        raise click.UsageError(f"found --scheduler and --method {method}, expected one of them")
    announce_compiling(quiet=quiet)
    with (
        connected(scheduler) if scheduler is not None else nullcontext() as client,
        Bar(quiet=quiet) as bar,
        written(target, ".twz") as path,
    ):
        result = terrainwave.compress(sources, path, client=client, progress=bar, **options)
    with printing_beside(target):
        name = target if target == STREAM else result.path
        _print_result(replace(result, path=name), as_json=as_json, quiet=quiet)


def _compress_each(
    sources: tuple[str, ...],
    directory: str,
    *,
    skips: bool,
    scheduler: str | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    import terrainwave
    from terrainwave.write.job import NO_BOUND

    if scheduler is not None:
        raise click.UsageError("found --scheduler and --to, expected one of them")
    if skips:
        options["overwrite"] = True  # outdated files are made again

    has_told = threading.Event()

    def compress_one(job: FileJob, threads: int, progress: ProgressCallback) -> Done:
        changed = options | {"threads": threads, "keep_origin": True}
        result = terrainwave.compress(job.source, str(job.target), progress=progress, **changed)
        if not result.units and not has_told.is_set():
            has_told.set()
            print_note(
                f"{plain(display_name(job.source))} names no vertical unit: errors are in the unit"
                " of its heights, as those of all rasters without one"
            )
        rules = [note.split(";")[0] for note in result.notes if note.startswith(NO_BOUND)]
        return Done("; ".join([_result_line(result), *rules]), asdict(result))

    run_to(
        sources, directory, ".twz", compress_one, "compressed",
        manifest=_manifest(directory, options) if skips else None,
        threads=options["threads"], as_json=as_json, quiet=quiet,
    )  # fmt: skip


_OF_SOURCE = ("nodata", "band", "georeference", "heights_are")


def _asked(options: dict[str, Any]) -> Options:
    return Options(**{name: options[name] for name in options.keys() & {*Options.names()}})


def _manifest(directory: str, options: dict[str, Any]) -> Manifest:
    from terrainwave.raster_io.dataset import files_of
    from terrainwave.write.origin import difference

    of_files = {name: options[name] for name in options.keys() & {*Options.names(), *_OF_SOURCE}}
    source = {name: options[name] for name in _OF_SOURCE} | {"nodata": repr(options["nodata"])}
    return Manifest(
        directory,
        {"command": "compress", **_asked(options).to_metadata(), **source},
        files_of=files_of,
        # Compared even if the manifest differs: equal heights need no new file.
        compare=lambda source, target, _, progress: difference(
            target, source, progress=progress, **of_files
        ),
    )


def _sources_and_target(paths: tuple[str, ...]) -> tuple[list[str], str]:
    if len(paths) < 2:
        missing = "TARGET" if paths else "SOURCE"
        raise click.UsageError(f"Missing argument '{missing}'.")
    ctx = click.get_current_context()
    target = paths[-1]
    try:
        # A common slip: with `*.tif` the last raster is taken for the target.
        target = Target(TWZ_ENDINGS, or_url=True).convert(target, None, ctx)
    except click.BadParameter as error:
        if not target or "://" in target:  # not a raster
            raise click.BadParameter(error.message, param_hint="TARGET") from error
        raise click.UsageError(
            f"TARGET is the last name: {error.message}; to compress each raster to a file of its"
            " own, add --to DIR"
        ) from error
    return [Input().convert(path, None, ctx) for path in paths[:-1]], target


def _result_line(result: Any) -> str:
    return (
        f"{plain(result.path)}: {result.n_bytes:,} bytes, {result.bits_per_sample:.4g} bits/sample,"
        f" {result.ratio:.4g} times smaller than raw"
    )


def _print_result(result: Any, *, as_json: bool, quiet: bool) -> None:
    if as_json:
        print_json(asdict(result))
    if as_json or quiet:
        return
    measured = "not checked" if result.measured_error is None else f"{result.measured_error:.6g}"
    click.echo(_result_line(result))
    click.echo(
        f"max error asked {result.max_error:.6g}, guaranteed {result.effective_error:.6g},"
        f" measured {measured}{unit_behind(result.units)}"
    )
    note_unit(result.units)
    print_notes(result.notes)
