"""Command verify: comparison of .twz files with their rasters."""

from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import TWZ_ENDINGS, count_of
from terrainwave.cli.batch import Done, FileJob, find_original, finish, run, with_files_of_folders
from terrainwave.cli.commands.info import files_before
from terrainwave.cli.options import (
    BOUND,
    THREADS_OPTION,
    Input,
    OfKind,
    complete_files,
    on_command_line,
)
from terrainwave.cli.output import (
    Bar,
    CommandWithoutTarget,
    announce_compiling,
    in_options,
    plain,
    print_grid,
    print_json,
    print_note,
    reading,
)
from terrainwave.container.sources.addresses import display_name
from terrainwave.option_sets import NODATA, WINDOW
from terrainwave.place.meaning import KINDS
from terrainwave.progress import ProgressCallback


@click.command(cls=CommandWithoutTarget)
@click.argument("paths", nargs=-1, metavar="FILE [ORIGINAL]", shell_complete=complete_files)
@click.option(
    "--originals",
    type=click.Path(file_okay=False, exists=True),
    metavar="DIR",
    help="Folder with the rasters of several FILEs, by the same names.",
)
@click.option("--max-error", type=BOUND, help="Check this bound instead of the file's own.")
@click.option(
    "--band", type=click.IntRange(min=1), default=1, show_default=True, help="Band of ORIGINAL."
)
@click.option("--nodata", type=OfKind(NODATA), help="Value that marks voids of ORIGINAL.")
@click.option("--heights-are", type=click.Choice(KINDS),
              help="Meaning of ORIGINAL's numbers. Default: from its metadata.")  # fmt: skip
@click.option("--part", is_flag=True,
              help="ORIGINAL covers a part of FILE, such as the raster of a patch: compare that"
              " part only.")  # fmt: skip
@click.option(
    "--root",
    metavar="HEX",
    help="Published root of FILE's heights, as info prints it: without ORIGINAL.",
)
@click.option(
    "--window",
    type=OfKind(WINDOW),
    help="Check this part of FILE alone, by the digests of the squares of 4096 x 4096 samples that"
    " it touches: without ORIGINAL.",
)
@click.option("--mesh", is_flag=True, help="Check errors, borders and coverage of all meshes, too.")
@THREADS_OPTION
@click.option("--quiet", "-q", is_flag=True, help="Print nothing; the exit status is the result.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def verify(paths: tuple[str, ...], originals: str | None, **options: Any) -> None:
    """Compare FILE (.twz) with its ORIGINAL raster; without ORIGINAL, check all of FILE.

    Several FILEs, all of them .twz, are checked one by one; a folder means all .twz files below it.
    With --originals DIR each is compared with the raster of its name in DIR, or in the same folder
    below it.
    """
    if not paths:
        raise click.UsageError("Missing argument 'FILE'.")
    is_folder = Path(paths[0]).is_dir()
    are_files = all(Path(path).suffix.lower() in TWZ_ENDINGS for path in paths)
    if originals is not None or is_folder or (are_files and len(paths) > 1):
        _verify_all(paths, None if originals is None else Path(originals), **options)
    elif len(paths) > 2:
        raise click.UsageError(
            f"found {len(paths)} names that are not all .twz, expected FILE and ORIGINAL, or"
            " files and --originals DIR"
        )
    else:
        _verify(*paths, **options)


def _verify(
    path: str, original: str | None = None, *, quiet: bool, as_json: bool, **options: Any
) -> None:
    import terrainwave

    ctx = click.get_current_context()
    _refuse_meshes_of_a_part(**options)
    if original is None:
        _refuse_unfit_without_original()
    file = Input().convert(path, None, ctx)
    raster = None if original is None else Input().convert(original, None, ctx)
    for name in ("root", "window"):
        if original is not None and options[name] is not None:
            raise click.UsageError(
                f"found --{name} and ORIGINAL, expected one of them: heights are compared with"
                " FILE's digests"
            )
    announce_compiling(quiet=quiet)
    with reading(file), Bar(quiet=quiet) as bar:
        report = terrainwave.verify(file, raster, progress=bar, **options)
    if as_json:
        print_json(report.to_dict())
    elif not quiet:
        _print_report(report, options["root"], options["window"] is not None)
    finish(int(not report.ok))


def _refuse_unfit_without_original() -> None:
    for name in ("band", "nodata", "heights_are", "max_error", "part"):
        if name in on_command_line():
            raise click.UsageError(
                f"found --{name.replace('_', '-')} without ORIGINAL, expected both: nothing is"
                " compared otherwise"
            )


def _refuse_meshes_of_a_part(*, part: bool, mesh: bool, **_: Any) -> None:
    if part and mesh:
        raise click.UsageError(
            "found both --part and --mesh, expected one of them: meshes are checked as a whole"
        )


def _verify_all(
    files: tuple[str, ...],
    originals: Path | None,
    *,
    threads: int | None,
    quiet: bool,
    as_json: bool,
    **options: Any,
) -> None:
    import terrainwave
    from terrainwave.verification.original import place_text

    def verify_one(job: FileJob, threads: int, progress: ProgressCallback) -> Done:
        folder = folders[job.source]
        original = None if originals is None else find_original(job.source, originals / folder)
        with reading(job.source):
            report = terrainwave.verify(
                job.source, original, threads=threads, progress=progress, **options
            )
        found = "ok" if report.ok else f"not ok, {'; '.join(map(in_options, report.problems))}"
        if report.errors is not None:
            found += f", {count_of(report.errors.n_valid, 'height')} compared"
            if report.window is not None:
                found += f" in {place_text(*report.window)}"
            if not report.errors.n_valid:
                print_note(
                    f"{display_name(job.source)}: no height was compared: none is valid in both"
                )
        return Done(
            f"{plain(display_name(job.source))}: {found}", report.to_dict(), is_good=report.ok
        )

    _refuse_meshes_of_a_part(**options)
    for name in ("root", "window"):
        if options[name] is not None:
            raise click.UsageError(f"found --{name} and several files, expected one FILE")
    if originals is None:
        _refuse_unfit_without_original()
    announce_compiling(quiet=quiet)
    folders = dict(with_files_of_folders(files, TWZ_ENDINGS))
    finish(
        run(
            [FileJob(file) for file in folders], verify_one, word="ok", threads=threads,
            as_json=as_json, quiet=quiet,
        )
    )  # fmt: skip


def _print_report(report: Any, root: str | None, is_window: bool) -> None:
    from terrainwave.verification.original import place_text

    for problem in report.problems:
        click.echo(f"problem: {in_options(problem)}")
    if report.errors is not None:
        errors = report.errors
        measured = (
            f": max error {errors.max_error:.6g} (bound {report.bound:.6g}), RMSE {errors.rmse:.6g}"
        )
        where = "" if report.window is None else f" in {place_text(*report.window)} of the file"
        click.echo(
            f"{count_of(errors.n_valid, 'height')} compared{where}{measured * (errors.n_valid > 0)}"
        )
        if not report.problems and not report.is_strict:
            click.echo(
                "every height is within the bound as a decimal number (such as 0.01); the float"
                " nearest to it may be off by one float spacing more (compress --strict avoids"
                " this)"
            )
        elif report.is_strict and errors.n_valid:
            click.echo("every height is within the bound")
    if report.ok and report.errors is not None and not report.errors.n_valid:
        print_note("no height was compared: no sample is valid in both")
    if report.original is None:
        click.echo("no heights compared: give the ORIGINAL raster for that")
        if report.ok and (root or report.root):
            where = " around the window" * is_window
            click.echo(_digests_in_words(report.root, root, where))
        if report.earlier:
            click.echo(f"made from {files_before(report.earlier)}")
    if report.mesh is not None:
        _print_meshes(report.mesh)
    click.echo("ok" if report.ok else "not ok")


def _digests_in_words(own: str | None, published: str | None, where: str) -> str:
    if published is not None:
        return f"the heights{where} and where they lie are those of the published root"
    return (
        f"consistent: the heights{where} are those of the file's own digests, root {own} (--root"
        " compares with a published root)"
    )


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
