"""Output for people: one-line errors, notes, the progress bar, tables.

Strings may come from untrusted files. `plain` (`arguments.in_one_line`) removes control characters
from all output, and tables hold rich's `Text`, which ignores markup.
"""

import functools
import json
import math
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

import click

from terrainwave import interrupts
from terrainwave.arguments import AS_IS, in_one_line
from terrainwave.cli.signals import Terminated, ending_by_signals
from terrainwave.cli.streams import StdoutError, discard_stdout, prepare_streams
from terrainwave.errors import (
    CorruptStreamError,
    InvalidArgumentError,
    StorageError,
    TerrainwaveError,
    TerrainwaveWarning,
)

if TYPE_CHECKING:
    from terrainwave.option_sets import OptionSet
    from terrainwave.progress import Progress


plain = in_one_line


def print_error(message: object, error: BaseException | None = None) -> None:
    """Print an error on one line of stderr, and each of its notes on another."""
    click.echo(f"terrainwave: {plain(message)}", err=True)
    print_notes(getattr(error, "__notes__", ()))


_printed_notes: dict[str, None] = {}  # in order
_SENTENCES = ("notes", "problems")


def print_note(message: object) -> None:
    """Print a note on stderr, unless this command has printed it already."""
    text = plain(message)
    if text not in _printed_notes:
        _printed_notes[text] = None
        click.echo(f"note: {text}", err=True)


def print_notes(notes: Iterable[str]) -> None:
    for note in notes:
        print_note(in_options(note))


@contextmanager
def reading(path: str) -> Iterator[None]:
    from terrainwave.container.header import NotTwzError
    from terrainwave.container.sources.addresses import display_name

    try:
        yield
    except CorruptStreamError as error:
        advice = (
            "terrainwave compress makes one of a raster"
            if isinstance(error, NotTwzError)
            else "the file is damaged: copy or download it again"
        )
        raise type(error)(f"{display_name(path)}: {error}; {advice}") from error


@contextmanager
def warnings_as_notes() -> Iterator[None]:
    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if isinstance(message, TerrainwaveWarning):
            print_note(message_of(message))
        else:
            usual(message, category, *place, **more)

    _printed_notes.clear()
    with warnings.catch_warnings():
        usual = warnings.showwarning
        warnings.simplefilter("always", TerrainwaveWarning)
        warnings.showwarning = show
        yield


@functools.cache
def own_sets() -> list[type["OptionSet"]]:
    from terrainwave.codec import method_options
    from terrainwave.names import MESH_KINDS, METHODS
    from terrainwave.tri import mesh_options

    kinds = filter(None, map(mesh_options.options_of, MESH_KINDS))
    return [*map(method_options.options_of, METHODS), *kinds]


def _option(argument: str) -> str:
    if any(argument in kind.names() for kind in own_sets()):
        return f"-o {argument}"
    names = {"src": "SOURCE", "dst": "TARGET", "client": "--scheduler"}
    names |= {"height_range": "--range"}
    return names.get(argument, f"--{argument}".replace("_", "-"))


def message_of(error: TerrainwaveError | TerrainwaveWarning) -> str:
    """Return the message of an error or a warning in terms of the command line."""
    return plain(error.message_with(_option))


def in_options(sentence: str) -> str:
    """Return a note or a problem of the package in terms of the command line."""
    return message_of(TerrainwaveWarning(sentence))


class Command(click.Command):
    """Command that reports invalid arguments as wrong usage, wherever they are detected."""

    has_target = True

    def get_short_help_str(self, limit: int = 0) -> str:  # noqa: ARG002  lines are wrapped
        sentence = (self.help or "").split("\n\n")[0].partition(". ")[0]
        return " ".join(sentence.split()).rstrip(".") + "."

    def pointer(self, ctx: click.Context, message: str) -> str:  # noqa: ARG002  of some commands
        return f"{ctx.command_path} --help"

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        with _of_command(ctx):
            return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with _of_command(ctx):
                return super().invoke(ctx)
        except InvalidArgumentError as error:
            raise click.UsageError(message_of(error), ctx) from error
        except BrokenPipeError as error:  # click would exit silently
            raise StorageError(line_of(error)) from error
        except KeyboardInterrupt as ended:
            vars(ended)["left"] = self._left()
            raise

    def _left(self) -> str:
        names = [name for name in interrupts.complete() if "://" in name or os.path.lexists(name)]
        if len(names) > 1:
            return f"; {len(names):,} files are complete, {names[0]} the first"
        if names:
            return f"; {names[0]} is complete"
        return "; the target is untouched" if self.has_target else ""


class CommandWithoutTarget(Command):
    """Command without an output file."""

    has_target = False


@contextmanager
def _of_command(ctx: click.Context) -> Iterator[None]:
    """Attach this command to usage errors: click's parser leaves it out."""
    try:
        yield
    except click.UsageError as error:
        error.ctx = error.ctx or ctx
        raise


class Commands(click.Group):
    """click group whose errors are one line each and which sets the exit status."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run a command as the process's only work, unless a program passes its own arguments."""
        is_process = not args and kwargs.get("args") is None
        return self.main(*args, is_process=is_process, **kwargs)

    def main(
        self, *args: Any, standalone_mode: bool = True, is_process: bool = False, **kwargs: Any
    ) -> Any:
        """Run a command; with `is_process`, signals after its end are ignored."""
        run: Any = super().main
        if not standalone_mode:
            return run(*args, standalone_mode=False, **kwargs)
        prepare_streams()
        try:
            with ending_by_signals(is_process=is_process), warnings_as_notes():
                status = run(*args, standalone_mode=False, **kwargs)
            sys.exit(status if isinstance(status, int) else 0)
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(2)
        except click.UsageError as error:
            message = plain(error.format_message())
            name = "terrainwave" if error.ctx is None else error.ctx.command_path
            see = f"{name} --help"
            if error.ctx is not None and isinstance(error.ctx.command, Command):
                see = error.ctx.command.pointer(error.ctx, message)
            click.echo(f"{name}: {message} (see {see})", err=True)
            sys.exit(2)
        except click.ClickException as error:
            print_error(error.format_message())
            sys.exit(1)
        except click.Abort as error:
            # click turns exceptions of signals into Abort.
            ended = error.__cause__
            number = ended.number if isinstance(ended, Terminated) else signal.SIGINT
            word = "interrupted" if number == signal.SIGINT else "terminated"
            print_error(f"{word}{getattr(ended, 'left', '')}", ended)
            sys.exit(128 + number)
        except StdoutError as error:
            from terrainwave.container.spool import cannot_write

            discard_stdout()
            print_error(cannot_write("stdout", error))
            sys.exit(1)
        except Exception as error:  # noqa: BLE001  whatever comes from below is one line, too
            print_error(line_of(error), error)
            sys.exit(1)


def line_of(error: Exception, *, advice: str = "--threads 1, a smaller --block or --window") -> str:
    """Return an error as one line; `advice` says what to try if memory is short."""
    if isinstance(error, TerrainwaveError):
        return message_of(error)
    if isinstance(error, MemoryError):
        return f"out of memory; try {advice}"
    if os.environ.get("TERRAINWAVE_TRACEBACK") == "1":
        traceback.print_exception(error)
    package = type(error).__module__.partition(".")[0]
    reason = plain(error) or type(error).__name__
    if package == "rasterio":
        from terrainwave.raster_io.gdal import one_line

        return f"GDAL has failed: {plain(one_line(error)) or reason}"
    if package in ("numba", "llvmlite"):
        return (
            f"numba cannot compile for this machine: {reason[:200]}; expected a version of numba"
            " that terrainwave supports: pip install --upgrade terrainwave"
        )
    if isinstance(error, OSError):
        reason = plain(error.strerror or reason)
        if isinstance(error.filename, str | bytes | os.PathLike):
            return f"{plain(os.fsdecode(error.filename))}: {reason}"
        return f"the system reports an error: {reason}"
    return (
        f"unexpected {type(error).__name__}: {reason[:200]}; this is a defect of terrainwave:"
        " please report it with what the command prints under TERRAINWAVE_TRACEBACK=1"
    )


class Bar:
    """A progress bar on a terminal; call it with a `Progress`.

    Without a terminal it prints nothing, or with ``TERRAINWAVE_PROGRESS=lines`` lines for programs
    (a variable, because older versions would refuse an unknown option).
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._bar: Any = None
        self._task: Any = None
        self._stage = ""
        self._line = ""
        self._prints_lines = not quiet and os.environ.get("TERRAINWAVE_PROGRESS") == "lines"
        if not quiet and not self._prints_lines and sys.stderr.isatty():
            self._bar = _rich_bar()

    def __call__(self, progress: "Progress") -> None:
        if self._prints_lines:
            line = f"progress: {progress.stage} {100 * progress.done // max(progress.total, 1)} %"
            if line != self._line:
                self._line = line
                click.echo(line, err=True)
        if self._bar is None:
            return
        if progress.stage != self._stage:
            self._stage = progress.stage
            if self._task is not None:
                self._bar.remove_task(self._task)
            self._task = self._bar.add_task(
                progress.stage, total=progress.total, ratio="", units="", sample_bytes=0.0
            )
        ratio = units = ""
        if progress.n_bytes_in and progress.n_bytes_out:
            ratio = f"{progress.n_bytes_in / progress.n_bytes_out:.1f}:1"
        if progress.n_units_total:
            groups = f"{progress.n_units}/{progress.n_units_total} groups"
            units = f"{groups}, {progress.n_levels} levels"
        elif progress.n_tasks_total:
            units = f"{progress.n_tasks:,}/{progress.n_tasks_total:,} tasks"
        sample_bytes = progress.n_bytes_in / max(progress.done, 1)
        self._bar.update(
            self._task, completed=progress.done, ratio=ratio, units=units, sample_bytes=sample_bytes
        )

    def echo(self, line: str) -> None:
        if self._bar is not None and sys.stdout.isatty():
            self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        else:
            click.echo(line)

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()


def _rich_bar() -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress
    from rich.text import Text

    class Speed(ProgressColumn):
        """Megabytes of heights per second."""

        def render(self, task: Any) -> Text:
            speed = (task.speed or 0) * task.fields["sample_bytes"]
            return Text(f"{speed / 1e6:.1f} MB/s" if speed else "")

    return RichProgress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        Speed(),
        TextColumn("{task.fields[units]}", markup=False),
        TextColumn("{task.fields[ratio]}", markup=False),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        redirect_stdout=False,
        transient=True,
    )


@functools.cache
def announce_compiling(*, quiet: bool = False) -> None:
    """Explain the seconds of a machine's first run, as soon as something is compiled."""
    if quiet:
        return
    from terrainwave.coding.jit import on_first_compilation
    from terrainwave.coding.kernel_places import KernelPlace

    def tell(place: KernelPlace) -> None:
        if place.kept_in is None:  # a note gives the reason
            words = "compiling kernels, for this run only: this takes some seconds"
        else:
            words = "compiling kernels for this machine, once: this takes some seconds"
        if place.instead_of:
            words += f"; they are kept in {place.kept_in}, as {place.instead_of} cannot be written"
        click.echo(plain(words), err=True)

    on_first_compilation(tell)


def print_table(rows: list[tuple[str, object]]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    _print(table, [[Text(name, style="bold"), Text(plain(value))] for name, value in rows])


def print_grid(header: list[str], rows: list[list[str]]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 2, 0, 0))
    for name in header:
        table.add_column(Text(name), justify="right", no_wrap=True)
    _print(table, [[Text(plain(cell)) for cell in row] for row in rows])


def _print(table: Any, rows: list[list[Any]]) -> None:
    from rich.console import Console

    for row in rows:
        table.add_row(*row)
    Console(highlight=False).print(table)


def print_json(fields: dict[str, Any], *, with_notes: bool = True) -> None:
    """Print a result as JSON, with the notes that were printed, as they tell what was left out."""
    if with_notes:
        own = [in_options(note) for note in fields.get("notes", [])]
        fields = fields | {"notes": [*dict.fromkeys((*own, *_printed_notes))]}
    click.echo(json.dumps(_in_options(fields), indent=2, allow_nan=False))


def print_json_line(fields: dict[str, Any]) -> None:
    click.echo(json.dumps(_in_options(fields), allow_nan=False))
    sys.stdout.flush()


def _in_options(fields: dict[str, Any]) -> Any:
    told = {name: [*map(in_options, fields[name])] for name in _SENTENCES if fields.get(name)}
    return plain_json(fields | told)


def plain_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: plain_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def unit_behind(units: str | None) -> str:
    return f" {plain(units)}" if units else ""


def note_unit(units: str | None) -> None:
    if not units:
        print_note("the raster names no vertical unit: errors are in the unit of its heights")


def vertical_in_words(about: dict[str, Any]) -> str:
    if about["heights"] == AS_IS:
        return f"as they are ({plain(about['datum'])})" if "datum" in about else "as they are"
    grids = f" by {', '.join(map(plain, about['grids']))}" if about.get("grids") else ""
    return f"above the ellipsoid{grids}"
