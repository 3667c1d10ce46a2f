"""What every benchmark shares: command lines, CSVs with the machine beside them, clocks, means.

Imports little: what calls `run_and_measure` must stay small.
"""

import ast
import csv
import functools
import hashlib
import json
import math
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
import warnings
from collections import namedtuple
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path
from statistics import geometric_mean as geometric_mean  # for scripts
from typing import Any

import click

from terrainwave.coding.jit import all_compiled

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
IMAGES = ROOT / "docs" / "images"
# What Python is told to be the command.
CLI = "from terrainwave.cli import main; main()"
# The code that each CSV measures, by groups: paths, and names of CSVs.
CODE = tomllib.loads(Path(__file__).with_name("tables.toml").read_text(encoding="utf-8"))["code"]
PACKAGES = (
    "terrainwave", "numpy", "numba", "scipy", "rasterio", "imagecodecs", "pysz", "xarray", "zarr",
    "numcodecs", "zfpy", "pcodec", "rioxarray", "pydelatin", "pymartini",
)  # fmt: skip

_CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []

# --- command lines ---


class ListOption(click.Option):
    """An option that takes every value up to the next option: ``--max-error 0 1 3``."""

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, multiple=True, **kwargs)


class Command(click.Command):
    """A command whose `ListOption` values need not repeat the option's name."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Write ``--x 1 2`` as ``--x 1 --x 2`` before click sees it.

        A list ends at the next option or at ``--``.
        """
        options = [param for param in self.params if isinstance(param, ListOption)]
        lists = {name for option in options for name in option.opts}
        return super().parse_args(ctx, repeat_option_names(args, lists) if lists else args)


def repeat_option_names(args: list[str], lists: set[str]) -> list[str]:
    """Return `args` with the name of each option in `lists` before each of its values."""
    repeated: list[str] = []
    name = ""
    for arg, following in zip(args, [*args[1:], "--"]):
        if arg in lists:
            name = arg
            if following.startswith("--"):
                repeated.append(arg)  # without a value: click says so
            continue
        name = "" if arg.startswith("--") else name
        repeated += [name, arg] if name else [arg]
    return [arg for arg in repeated if arg != "--"]


def command(out: str = "", base: str = "benchmarks/results") -> Callable[[Callable], click.Command]:
    """Return a decorator: a command with its module's docstring as help.

    It passes `out`, a CSV or a directory, and `folder`, an existing directory for files.
    """

    def decorate(function: Callable) -> click.Command:
        @functools.wraps(function)
        def run(work: Path | None, **more) -> None:
            warnings.filterwarnings("ignore", message="Dataset has no geotransform")
            # As after `terrainwave warmup`.
            with tempfile.TemporaryDirectory() as temporary, all_compiled():
                folder = work or Path(temporary)
                folder.mkdir(parents=True, exist_ok=True)
                function(folder=folder, **more)

        shown = f"{base}/{out}"
        run = option("--out", type=FILE, default=ROOT / base / out, show_default=shown)(run)
        run = click.option("--work", type=FILE, help="Keep the files that are made here.")(run)
        return click.command(cls=Command, help=function.__globals__["__doc__"])(run)

    return decorate


def list_rasters(_context, _parameter, places: Sequence[Path]) -> list[Path]:
    """Return the GeoTIFFs at places: files themselves, directories' sorted by name."""
    found: list[Path] = []
    for place in places:
        found += sorted(place.glob("*.tif")) if place.is_dir() else [place]
    if not found:
        raise click.UsageError("no GeoTIFFs there")
    return found


def bounds_option(*default: float) -> Callable[[Callable], Callable]:
    """Return ``--max-error``, a list of bounds in the rasters' units."""
    bound = click.FloatRange(min=0)
    return option("--max-error", "bounds", cls=ListOption, type=bound, default=default)


def option(*names: str, **more: Any) -> Callable[[Callable], Callable]:
    """Return an option that shows its default."""
    return click.option(*names, **{"show_default": True} | more)


def choices_option(
    *names: str, of: Iterable[str], default: Iterable[str] | None = None
) -> Callable[[Callable], Callable]:
    """Return an option that takes some of the choices; all of them by default."""
    choices = list(of)
    chosen = choices if default is None else list(default)
    return option(*names, cls=ListOption, type=click.Choice(choices), default=chosen)


COUNT = click.IntRange(min=1)
FILE = click.Path(path_type=Path)
EXISTING = click.Path(exists=True, path_type=Path)
# `paths`: the GeoTIFFs at places, files or directories.
rasters_argument = click.argument(
    "paths", nargs=-1, required=True, type=EXISTING, callback=list_rasters, metavar="PLACES..."
)
dem_argument = click.argument("dem", type=click.Path(exists=True, dir_okay=False, path_type=Path))
directory_argument = click.argument(
    "directory", type=click.Path(exists=True, file_okay=False, path_type=Path)
)

# --- results ---


def write_rows(path: Path, rows: Iterable[Any], *, append: bool = False) -> list:
    """Write named tuples to a CSV as they come, with a JSON about the machine; print, return them.

    With `append`, rows that are there stay, and the JSON lists what wrote them under "earlier".
    Files are touched with the first row only.
    """
    goes_on = append and path.exists()
    written: list = []
    with ExitStack() as stack:
        for row in rows:
            if not written:
                path.parent.mkdir(parents=True, exist_ok=True)
                _write_machine(path, goes_on)
                mode = "a" if goes_on else "w"
                file = stack.enter_context(path.open(mode, newline="", encoding="utf-8"))
                writer = csv.writer(file, lineterminator="\n")
                if not goes_on:
                    writer.writerow(row._fields)
                click.echo(f"{path.name}: {','.join(row._fields)}")
            writer.writerow(row)
            file.flush()
            click.echo(",".join(map(str, row)))
            written.append(row)
    return written


def _write_machine(results: Path, goes_on: bool) -> None:
    machine, path = describe_machine(results.stem), results.with_suffix(".json")
    if goes_on and path.exists():
        before = json.loads(path.read_text(encoding="utf-8"))
        earlier = before.pop("earlier", []) + ([before] if before != machine else [])
        machine |= {"earlier": earlier} if earlier else {}
    path.write_text(json.dumps(machine, indent=2) + "\n", encoding="utf-8")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a CSV, numbers as such; none if there is no such file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [{name: _number(text) for name, text in row.items()} for row in csv.DictReader(file)]


def keep_rows(path: Path, is_kept: Callable[[dict[str, Any]], bool]) -> None:
    """Leave of a CSV the rows that are to be kept, each as it is; no file if there are none."""
    if path.exists():
        head, *lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [line for line, row in zip(lines, read_rows(path), strict=True) if is_kept(row)]
        path.write_text("".join([head, *kept]), encoding="utf-8", newline="")
        if not kept:
            path.unlink()


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


# --- the machine ---


def describe_machine(results: str = "") -> dict[str, Any]:
    """Return machine, versions, commit and code for a CSV's JSON; no host name, no paths."""
    import rasterio

    installed = sorted(metadata.distributions(), key=lambda found: found.name)
    return {
        "processor": processor(),
        "n_cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "gdal": rasterio.__gdal_version__,
        "packages": {found.name: found.version for found in installed if found.name in PACKAGES},
        "commit": _commit(),
        "code": code_of(results),
    }


def pin_to_cores(n_cores: int = 1) -> None:
    """Keep this process, and what it starts, on few cores: libraries start threads unasked."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, _CORES[-n_cores:])
    else:
        click.echo(f"cannot pin to {n_cores} of the cores here: some codecs may use more")


@functools.cache
def processor() -> str:
    """Return the name of this machine's processor."""
    try:
        names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    except OSError:
        names = []
    return names[0] if names else platform.processor()


def _commit() -> str | None:
    """Return the commit of this checkout, with "+" if tracked files were changed."""
    git = ["git", "-C", str(ROOT)]
    try:
        commit, changed = (
            subprocess.check_output([*git, *line.split()], text=True, stderr=subprocess.DEVNULL)
            for line in ("rev-parse --short=12 HEAD", "status --porcelain --untracked-files=no")
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit.strip() + ("+" if changed else "")


@functools.cache
def code_of(results: str) -> str:
    """Return a digest of the code that a CSV measures, by name; empty if `CODE` names none."""
    digest = hashlib.sha256()
    patterns = [
        place for group in CODE.values() if results in group["csv"] for place in group["of"]
    ]
    for pattern in patterns:
        for path in sorted(path for path in ROOT.glob(pattern) if path.is_file()):
            digest.update(path.relative_to(ROOT).as_posix().encode())
            digest.update(_code(path))
    return digest.hexdigest()[:16] if patterns else ""


@functools.cache
def _code(path: Path) -> bytes:
    """Return a file, if it is Python, C or JavaScript without what changes no result.

    That is blank lines, lines of comments and docstrings.
    """
    if path.suffix not in (".py", ".c", ".h", ".js"):
        return path.read_bytes()
    text = path.read_text(encoding="utf-8")
    lines = [line.strip() for line in text.splitlines()]
    for node in ast.walk(ast.parse(text)) if path.suffix == ".py" else ():
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            lines[node.body[0].lineno - 1 : node.body[0].end_lineno] = [""] * (
                node.body[0].end_lineno - node.body[0].lineno + 1
            )
    bare = "\n".join(line for line in lines if line and not line.startswith(("# ", "//")))
    return re.sub(r"/\*.*?\*/\n?", "", bare, flags=re.DOTALL).encode()


# --- runs ---


def call_elsewhere(name: str, *arguments: Any) -> None:
    """Call a function by its full name in a process of its own, so that this one stays small.

    Arguments are numbers and texts, paths become texts.
    """
    module, function = name.rsplit(".", 1)
    code = f"import json, sys, {module}; {module}.{function}(*json.loads(sys.argv[1]))"
    given = json.dumps(arguments, default=str)
    subprocess.run([sys.executable, "-c", code, given], check=True, cwd=ROOT)


# What a command took: wall clock, processor time of all its threads, most resident memory.
Used = namedtuple("Used", "seconds cpu_seconds peak_mib")


def run_and_measure(
    command: Sequence[str], watch: Callable[[int], Any] = lambda _pid: None, **options: Any
) -> Used:
    """Run `command`, which must succeed; return what it took; `options` go to `Popen`.

    Processes that the command itself has started and waited for are included. `watch` is given the
    process's number when it has started. The caller must be small: Linux counts the memory of a
    process at the moment it starts another towards that one's peak.
    """
    if not hasattr(os, "wait4"):
        raise click.UsageError("needs os.wait4: Linux or macOS")
    start = time.perf_counter()
    process = subprocess.Popen(command, **options)
    watch(process.pid)
    _pid, wait_status, resources = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(wait_status)
    if process.returncode:
        raise click.ClickException(f"the command ended with status {process.returncode}")
    # ru_maxrss is in KiB on Linux and in bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    cpu_seconds = resources.ru_utime + resources.ru_stime
    return Used(seconds, cpu_seconds, resources.ru_maxrss * unit / 2**20)


# The median seconds of some runs, how many they were, what the last one returned, and the most.
Timed = namedtuple("Timed", "seconds n_runs result most")


def take_turns(
    tasks: Callable[[], Sequence[Callable[[], Any]]], n_rounds: int, *,
    patience: float = math.inf, clock: Callable[[], float] = time.process_time,
) -> list[Timed]:  # fmt: skip
    """Return what tasks took that ran in turns, so that all see the same machine.

    `tasks` is called before each round and gives the functions to run; what it does is not timed.
    No round but the first begins when the tasks have taken `patience` seconds. What a task returned
    in the round before is given up just before it runs, so that all find memory alike: new pages
    for an array cost as much as reading it.
    """
    seconds: list[list[float]] = []
    results: dict[int, Any] = {}
    while not seconds or (len(seconds) < n_rounds and math.fsum(map(sum, seconds)) < patience):
        found = []
        for index, task in enumerate(tasks()):
            results.pop(index, None)
            start = clock()
            result = task()
            found.append(clock() - start)
            results[index] = result
            del result
        seconds.append(found)
    return [
        Timed(statistics.median(column), len(seconds), result, max(column))
        for column, result in zip(zip(*seconds), results.values())
    ]
