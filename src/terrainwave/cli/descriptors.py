"""stdin, stdout and stderr of the process: closed ones, full ones, and what they cannot show."""

import io
import os
import re
import sys
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import BinaryIO, TextIO

import click

from terrainwave.errors import StorageError

_NAMES = ("stdin", "stdout", "stderr")
_closed: set[str] = set()
# What writes to stdout; where that is not buffered, nothing else tells its errors from others'.
_PRINTING = {
    ("click.utils", "echo"),
    ("rich.console", "_write_buffer"),
    ("terrainwave.cli.streams", "_write"),
}


# A line of libtiff's own, which names no file: one for each tile that it cannot write.
_OF_LIBTIFF = re.compile(rb"_?tiff\w+: ", re.IGNORECASE)


class StdoutError(OSError):
    """Stdout cannot take what a command writes there."""


class _Lost(io.TextIOWrapper):
    """Stands for a closed stdout: a note says once that something was printed there."""

    is_noted = False

    def write(self, text: str) -> int:
        if text and not self.is_noted:
            self.is_noted = True
            click.echo("note: stdout is closed: what is printed there is lost", err=True)
        return len(text)


def prepare_streams() -> None:
    """Open what is closed, and let stdout and stderr escape what their encoding lacks.

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
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def _substitute(number: int) -> TextIO:
    """Return a stream of a descriptor that stays open as long as the process does."""
    if _NAMES[number] == "stdout":
        return _Lost(io.BufferedWriter(io.FileIO(number, "w", closefd=False)), encoding="utf-8")
    return open(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False)


def check_open(name: str) -> None:
    """Raise `StorageError` if stdin or stdout is closed: a file is to be read or written there."""
    if name in _closed:
        action = "read" if name == "stdin" else "write"
        raise StorageError(
            f"cannot {action} {name}: it is closed; expected a pipe or a file, or a name instead"
            " of -"
        )


def is_of_stdout(error: BaseException) -> bool:
    """Say whether an error is stdout's: what prints has raised it, or a buffer still holds text."""
    if isinstance(error, StdoutError) or not isinstance(error, OSError):
        return isinstance(error, StdoutError)
    if isinstance(error, StorageError):
        return False
    if _raised_in(error) in _PRINTING:
        return True
    try:
        sys.stdout.flush()
    except OSError as again:
        return again.errno == error.errno
    except ValueError:  # it has been closed meanwhile
        return False
    return False


def _raised_in(error: BaseException) -> tuple[str, str]:
    """Return module and function of the innermost frame that an error comes from."""
    module = function = ""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        module, function = str(frame.f_globals.get("__name__")), frame.f_code.co_name
    return module, function


def discard_stdout() -> None:
    """Send what stdout still holds nowhere: Python would try to write it again at its end."""
    with suppress(OSError, ValueError):
        handle = os.open(os.devnull, os.O_WRONLY)
        os.dup2(handle, sys.stdout.fileno())
        os.close(handle)


@contextmanager
def without_lines_of_libtiff() -> Iterator[None]:
    """Drop what libtiff prints on stderr in the block; what other libraries print comes after it.

    Python's own stderr is as it was. ``TERRAINWAVE_TRACEBACK=1`` shows all lines.
    """
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
        with _in_memory() as printed:
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


def _in_memory() -> BinaryIO:
    """Return a file that takes no room on a disk, where the system has such files."""
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("stderr"), "w+b")
    return tempfile.TemporaryFile()
