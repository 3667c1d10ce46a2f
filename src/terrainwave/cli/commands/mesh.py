"""Command mesh: a mesh of a .twz file, or a copy of the file with meshes."""

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import MOST_LODS, TWZ_ENDINGS, check_ending, count_of
from terrainwave.cli.options import (
    BOUND,
    LEVEL_OPTION,
    CommandWithOwnOptions,
    Input,
    OfKind,
    check_one_area,
    complete_files,
    declared,
    on_command_line,
    own_option,
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
    reading,
    unit_behind,
    vertical_in_words,
)
from terrainwave.errors import InvalidArgumentError
from terrainwave.export.shapes import MESH_ENDINGS, TILE, Shape
from terrainwave.names import DEFAULT_MESH, MESH_KINDS
from terrainwave.option_sets import BOUNDS, WINDOW

# Options for --store, for --store and for separate meshes alike, and for separate meshes with a
# goal.
_STORE_OPTIONS = {"mesh", "own", "mesh_error", "original"}
_COMMON_OPTIONS = {"threads", "overwrite", "quiet", "as_json"}
_GOALS = {"max_error", "max_triangles", "optimise"}
# Options that levels of detail determine themselves.
_OF_ONE_MESH = {"max_triangles", "level", "loose"}


@click.command(
    cls=CommandWithOwnOptions,
    help=f"""Write a crack-free mesh of FILE (.twz) to TARGET, within the bound of the original.

    TARGET's extension selects the format: {", ".join(MESH_ENDINGS[:-1])}, or {MESH_ENDINGS[-1]}, a
    Cesium quantized-mesh tile. With --lods N it writes N files, each with twice the error of the
    one before. With --store TARGET is a .twz: a copy of FILE with meshes of all blocks.
    """,
)
@click.argument("file", type=Input())
@click.argument("target", shell_complete=complete_files)
@click.option(
    "--max-error",
    type=BOUND,
    help="Largest allowed vertical distance of the mesh from the original heights, in the file's"
    " unit; in --frame ecef and .terrain with the curvature of the globe. Default: use the stored"
    " meshes and their error.",
)
@click.option("--max-triangles", type=click.IntRange(min=1), metavar="N",
              help="Make the mesh of smallest error with at most N triangles.")  # fmt: skip
@LEVEL_OPTION
@click.option("--window", type=OfKind(WINDOW), help="Part, in samples.")
@click.option("--bounds", type=OfKind(BOUNDS), help="Part, in the CRS.")
@click.option(
    "--optimise/--no-optimise",
    default=True,
    show_default=True,
    help="Spend more time to get fewer triangles with the same error.",
)
@click.option(
    "--loose",
    is_flag=True,
    help="Write only the triangulation of the zero trees, without a guaranteed error (Yusov &"
    " Turlapov 2010, §2.4); its error is measured. --level -2 (default) is the finest.",
)
@declared(Shape)
@click.option(
    "--lods",
    type=click.IntRange(1, MOST_LODS),
    metavar="N",
    help="Write N levels of detail, each to a file of its own: TARGET hills.glb stands for"
    " hills_lod0.glb (the finest, within --max-error), hills_lod1.glb (within twice that) and so"
    " on.",
)
@click.option(
    "--store",
    "stores",
    is_flag=True,
    help="Make a copy of FILE with meshes stored in it; TARGET is a .twz.",
)
@click.option(
    "--mesh",
    type=click.Choice(MESH_KINDS),
    help="With --store: kind of the meshes. Default: halves.",
)
@own_option(
    "With --store: set an option of the kind of meshes. To list them, name it: --mesh KIND --help."
)
@click.option(
    "--mesh-error",
    type=BOUND,
    help="With --store: largest distance of the finest meshes from the decoded heights. Default: as"
    " for compress.",
)
@click.option(
    "--original", type=Input(), help="With --store: the raster to measure the errors against."
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@writing
def mesh(file: str, target: str, stores: bool, **options: Any) -> None:
    _refuse_unfit(stores=stores, loose=options["loose"], lods=options["lods"])
    if stores:
        names = _COMMON_OPTIONS | _STORE_OPTIONS
        _store_meshes(file, target, **{name: options[name] for name in names})
    else:
        names = options.keys() - _STORE_OPTIONS
        _export_mesh(file, target, **{name: options[name] for name in names})


def _refuse_unfit(*, stores: bool, loose: bool, lods: int | None) -> None:
    given = on_command_line() - {"file", "target", "stores"}
    unfit = given - _COMMON_OPTIONS - _STORE_OPTIONS if stores else given & _STORE_OPTIONS
    if unfit:
        expected = "expected none of them: they are for a mesh in a file of its own"
        if not stores:
            expected = "expected --store with it, which stores meshes in a copy of FILE"
        where = "with" if stores else "without"
        raise click.UsageError(f"found {_flags(unfit)} {where} --store, {expected}")
    if lods is not None and given & _OF_ONE_MESH:
        raise click.UsageError(
            f"found {_flags(given & _OF_ONE_MESH)} with --lods, expected none of them: --max-error"
            " is that of the finest level of detail, and each next one has twice the error"
        )
    if loose and given & _GOALS:
        raise click.UsageError(
            f"found {_flags(given & _GOALS)} with --loose, expected none of them: the zero trees"
            " alone determine the mesh"
        )


def _flags(names: Iterable[str]) -> str:
    return ", ".join(
        sorted("-o" if name == "own" else f"--{name}".replace("_", "-") for name in names)
    )


def _store_meshes(
    file: str,
    target: str,
    *,
    mesh: Any,
    own: tuple[str, ...],
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    import terrainwave

    options |= with_own_options(own, {"mesh": mesh or DEFAULT_MESH})
    check_ending(target, TWZ_ENDINGS)
    announce_compiling(quiet=quiet)
    with reading(file), Bar(quiet=quiet) as bar:
        path = terrainwave.store_meshes(file, target, progress=bar, **options)
    n_bytes = Path(path).stat().st_size
    if as_json:
        print_json({"path": path, "n_bytes": n_bytes})
    elif not quiet:
        click.echo(f"{plain(path)}: {n_bytes:,} bytes, with meshes")


def _export_mesh(
    file: str,
    target: str,
    *,
    lods: int | None,
    optimise: bool,
    loose: bool,
    overwrite: bool,
    threads: int | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    import terrainwave
    from terrainwave.container.targets.publication import refuse_own_source
    from terrainwave.export import mesh_files

    shape = {name: options.pop(name) for name in Shape.names()}
    check_one_area(options)
    _check_shape(target, shape)
    if lods is not None:
        del options["level"], options["max_triangles"]
        announce_compiling(quiet=quiet)
        with reading(file), Bar(quiet=quiet) as bar:
            made = terrainwave.save_lods(
                file, target, lods, progress=bar, optimise=int(optimise), threads=threads,
                overwrite=overwrite, **shape | options,
            )  # fmt: skip
        if as_json:
            print_json({"lods": [asdict(saved) for saved in made]})
        elif not quiet:
            _print_lods(made)
        return
    options |= {"optimise": int(optimise and not loose), "guarantee": not loose}
    refuse_own_source(file, target)
    mesh_files.prepare(target, overwrite=overwrite)
    announce_compiling(quiet=quiet)
    with (
        reading(file),
        terrainwave.open(file, threads=threads) as terrain,
        Bar(quiet=quiet) as bar,
    ):
        mesh_files.check_drape(terrain, shape["drape"])

        def make(max_error: float | None) -> Any:
            return terrain.mesh(progress=bar, **options | {"max_error": max_error})

        bound = options["max_error"]
        if bound is None:
            surface = make(None)
        else:
            surface, is_within = mesh_files.mesh_for_file(
                make, target, bound, terrain.quanta_error, **shape
            )
            if not is_within:
                print_note(mesh_files.note_on_rounding(bound))
    saved = surface.save(target, overwrite=overwrite, **shape)
    if as_json:
        print_json(asdict(saved))
    elif not quiet:
        _print_saved(saved, "measured" if loose else "guaranteed")


def _check_shape(target: str, shape: dict[str, Any]) -> None:
    from terrainwave.export.mesh_files import check_extension, check_shape

    try:
        extension = check_extension(target)
    except InvalidArgumentError as error:
        raise click.UsageError(f"{error}, or in .twz with --store") from error
    if shape["vertical"] == "ellipsoid" and shape["frame"] != "ecef" and extension != TILE:
        raise click.UsageError(
            "found --vertical ellipsoid, expected --frame ecef or a .terrain tile with it: other"
            " coordinates keep the file's datum"
        )
    check_shape(Shape(**shape), extension)


def _print_lods(made: list[Any]) -> None:
    for saved in made:
        error = f"{saved.error:.6g}{unit_behind(saved.units)}"
        click.echo(
            f"{plain(saved.path)}: {count_of(saved.n_triangles, 'triangle')},"
            f" {saved.n_bytes:,} bytes, guaranteed error {error}"
        )
    first = made[0]
    click.echo(f"frame {first.frame}{_heights_of(first)}")
    note_unit(first.units)


def _print_saved(saved: Any, kind_of_error: str) -> None:
    click.echo(
        f"{plain(saved.path)}: {count_of(saved.n_triangles, 'triangle')},"
        f" {saved.n_vertices:,} vertices,"
        f" {saved.n_bytes:,} bytes"
    )
    click.echo(
        f"{kind_of_error} error {saved.error:.6g}{unit_behind(saved.units)},"
        f" frame {saved.frame}{_heights_of(saved)}"
    )
    if saved.share is not None:
        click.echo(
            f"{saved.share:.1%} of the samples are within the tolerance of guaranteed meshes"
        )
    note_unit(saved.units)


def _heights_of(saved: Any) -> str:
    return "" if saved.vertical is None else f", heights {vertical_in_words(saved.vertical)}"
