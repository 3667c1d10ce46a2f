"""stdin and stdout as files: the name -."""

import errno
import io
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any, TextIO

import click

from terrainwave.errors import StorageError

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


_NAMES = ("stdin", "stdout", "stderr")
_closed: set[str] = set()

# A line of libtiff's own, which names no file: one for each tile that it cannot write.
_OF_LIBTIFF = re.compile(rb"_?tiff\w+: ", re.IGNORECASE)


class StdoutError(OSError):
    """Stdout cannot take what a command writes there."""


class _Stdout(io.FileIO):
    """Descriptor of stdout, whose errors are `StdoutError` whichever library prints."""

    def write(self, data: Any, /) -> int:
        # Unbuffered, nobody else writes the rest of what was written in part.
        left = memoryview(data).cast("B")
        n_bytes = len(left)
        try:
            while left:
                written = super().write(left)
                if written is None:  # a pipe that is full and does not wait
                    raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
                left = left[written:]
            return n_bytes
        except OSError as error:
            raise StdoutError(error.errno, error.strerror) from error


class _Lost(io.TextIOWrapper):
    """Stands for a closed stdout: a note says once that something was printed there."""

    is_noted = False

    def write(self, text: str) -> int:
        if text and not self.is_noted:
            self.is_noted = True
            click.echo("note: stdout is closed: what is printed there is lost", err=True)
        return len(text)


def prepare_streams() -> None:
    """Open what is closed, mark errors of stdout, and escape what an encoding lacks.

    A closed descriptor would be that of the next file which is opened, into which libraries would
    write their messages. Python has None for its stream.
    """
    for number in range(len(_NAMES)):
        try:
            os.fstat(number)
        except OSError:
            # The lowest free number is this one: those below have been opened before.
            os.open(os.devnull, os.O_RDWR)
    for number, name in enumerate(_NAMES):
        if getattr(sys, name) is None:
            _closed.add(name)
            setattr(sys, name, _substitute(number))
    _mark_errors()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def _mark_errors() -> None:
    """Let stdout, if it is the process's own, write by `_Stdout`."""
    ours = sys.stdout
    buffer = getattr(ours, "buffer", None)
    raw = getattr(buffer, "raw", buffer)
    if type(raw) is not io.FileIO or raw.fileno() != 1 or not isinstance(ours, io.TextIOWrapper):
        return
    with suppress(OSError):
        ours.flush()
    new: Any = _Stdout(1, "w", closefd=False)
    sys.stdout = type(ours)(
        new if buffer is raw else io.BufferedWriter(new), encoding=ours.encoding,
        errors=ours.errors, line_buffering=ours.line_buffering, write_through=ours.write_through,
    )  # fmt: skip


def _substitute(number: int) -> TextIO:
    if _NAMES[number] == "stdout":
        return _Lost(io.BufferedWriter(io.FileIO(number, "w", closefd=False)), encoding="utf-8")
    return open(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False)


def check_open(name: str) -> None:
    if name in _closed:
        action = "read" if name == "stdin" else "write"
        raise StorageError(
            f"cannot {action} {name}: it is closed; expected a pipe or a file, or a name instead"
            " of -"
        )


def discard_stdout() -> None:
    with suppress(OSError, ValueError):
        handle = os.open(os.devnull, os.O_WRONLY)
        os.dup2(handle, sys.stdout.fileno())
        os.close(handle)


@contextmanager
def without_lines_of_libtiff() -> Iterator[None]:
    """Drop libtiff's lines on stderr in the block; those of other libraries come after it."""
    ours = sys.stderr
    try:
        is_real = ours.fileno() == 2
    except (OSError, ValueError):
        is_real = False
    if os.environ.get("TERRAINWAVE_TRACEBACK") == "1":
        yield
        return
    ours.flush()
    real = os.dup(2)
    try:
        # In memory, where the system has such files: the disk may be full.
        has_memory = hasattr(os, "memfd_create")
        with (
            os.fdopen(os.memfd_create("stderr"), "w+b") if has_memory else tempfile.TemporaryFile()
        ) as printed:
            if is_real:
                sys.stderr = open(
                    real, "w", buffering=1, encoding=ours.encoding, errors=ours.errors,
                    closefd=False,
                )  # fmt: skip
            os.dup2(printed.fileno(), 2)
            try:
                yield
            finally:
                os.dup2(real, 2)
                sys.stderr = ours
                printed.seek(0)
                for line in printed:
                    if not _OF_LIBTIFF.match(line):
                        os.write(2, line)
    finally:
        os.close(real)
