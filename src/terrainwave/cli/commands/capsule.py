"""Command capsule: a file with its format, a reader and checksums."""

from dataclasses import asdict

import click

from terrainwave.cli.options import NamedInput, Target, writing
from terrainwave.cli.output import Bar, Command, plain, print_json, print_note, reading


@click.command(cls=Command)
@click.argument("file", type=NamedInput())
@click.argument("target", type=Target((".zip",), or_stdout=False))
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@writing
def capsule(
    file: str, target: str, threads: int | None, overwrite: bool, quiet: bool, as_json: bool
) -> None:
    """Write FILE (.twz), its format, a reader as C source and checksums to TARGET (.zip).

    For archives: any C compiler reads the heights, without terrainwave. FILE is checked before.
    """
    from terrainwave.capsule import write_capsule

    with reading(file), Bar(quiet=quiet) as bar:
        written = write_capsule(file, target, overwrite=overwrite, threads=threads, progress=bar)
    if as_json:
        print_json(asdict(written))
    elif not quiet:
        click.echo(f"{plain(target)}: {written.n_bytes:,} bytes")
        if written.root:
            click.echo(f"root of heights {written.root}")
    if written.root is None:
        print_note("the file has no digests, so the capsule names no root: compress with --digest")
