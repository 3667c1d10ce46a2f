"""stdin and stdout as files: the name -."""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

import click

from terrainwave.cli.descriptors import check_open

STREAM = "-"
_KEY = "terrainwave.stdin"


def read_stream(ctx: click.Context) -> str:
    if ctx.meta.get(_KEY):
        raise click.UsageError("found - twice, expected one: stdin can be read once", ctx)
    ctx.meta[_KEY] = True
    return str(ctx.with_resource(_stdin_file()))


@contextmanager
def _stdin_file() -> Iterator[Path]:
    # Imported here, because help needs no numpy.
    from terrainwave.container.targets.publication import system_scratch

    check_open("stdin")
    with system_scratch() as directory:
        path = directory / "stdin"
        with path.open("wb") as file:
            shutil.copyfileobj(sys.stdin.buffer, file)
        yield path


@contextmanager
def written(target: str, ending: str) -> Iterator[str]:
    """Yield the path to write for `target`; nothing goes to stdout if the block raises."""
    if target != STREAM:
        yield target
        return
    check_open("stdout")
    if sys.stdout.isatty():
        raise click.UsageError("found - and a terminal, expected stdout to be a pipe or a file")
    from terrainwave.container.targets.publication import system_scratch

    with system_scratch() as directory:
        path = directory / f"stdout{ending}"
        yield str(path)
        with path.open("rb") as file:
            shutil.copyfileobj(file, sys.stdout.buffer)
        sys.stdout.buffer.flush()


@contextmanager
def printing_beside(target: str) -> Iterator[None]:
    if target != STREAM:
        yield
        return
    with redirect_stdout(sys.stderr):
        yield
