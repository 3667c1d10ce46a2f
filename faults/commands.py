"""Commands on small inputs, run in forks of this process: no start-up to wait for.

All temporary data go to files, as those of large rasters do.
"""

import os
import random
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio

from benchmarks.rasters import load_raster
from terrainwave.cli import main
from terrainwave.container import spool
from terrainwave.raster_io import temporary

OLD = b"what was there before"
PATIENCE = 120.0  # seconds, after which a run hangs
_CRASHED = 70  # exit status of an exception that no command turned into a line
_POLL = 0.001


@dataclass(frozen=True)
class Command:
    """A command that writes `target`; `before` are the bytes that it changes, if it needs some.

    One without a target writes nothing. The viewer and the server, which answers at `address`, are
    `is_endless`: a signal ends them.
    """

    name: str
    target: str
    arguments: tuple[str, ...]
    before: bytes = b""
    expected: bytes = b""  # what an undisturbed run writes
    seconds: float = 0.0  # that it takes
    last: float = 0.0  # of these, the seconds from its fsync on
    is_endless: bool = False
    address: str = ""
    ctrl_c: int = 128 + signal.SIGINT  # the status that Ctrl-C ends it with

    @property
    def starts(self) -> tuple[bytes, ...]:
        """What may lie at the target when it begins; nothing is b""."""
        if not self.target:
            return (b"",)
        return (self.before,) if self.before else (b"", OLD)


def synthesised(n_rows: int, n_cols: int, seed: int) -> np.ndarray:
    """Return hills with noise in metres, int16."""
    row, col = np.mgrid[0:n_rows, 0:n_cols]
    hills = 400 * np.sin(row / 97) * np.cos(col / 143) + 90 * np.sin((row + col) / 19)
    return (hills + np.random.default_rng(seed).normal(600, 4, hills.shape)).astype("int16")


def write_raster(path: Path, heights: np.ndarray, row: int = 0, col: int = 0) -> None:
    """Write heights as a GeoTIFF of 30 m pixels whose first sample is at a row and column."""
    place = rasterio.Affine(30, 0, 500000 + 30 * col, 0, -30, 5000000 - 30 * row)
    shape = {"height": heights.shape[0], "width": heights.shape[1], "count": 1}
    kind = {"driver": "GTiff", "dtype": heights.dtype, "crs": "EPSG:32633", "transform": place}
    with rasterio.open(path, "w", **shape, **kind) as dataset:
        dataset.write(heights, 1)


def everything_on_disk() -> None:
    """Make temporary data of small rasters go to files as well."""
    temporary.MEMORY_LIMIT = 0
    spool._BUFFER = spool._KEPT = 4096


def make_inputs(folder: Path, dem: Path | None, side: int) -> None:
    """Write rasters and files that the commands read: heights of `dem`, or synthesised ones."""
    heights = synthesised(side, side, 0) if dem is None else load_raster(dem, side).heights
    part = heights[side // 8 : side // 2, side // 8 : side // 2]
    write_raster(folder / "dem.tif", heights)
    write_raster(folder / "moved.tif", heights[::-1] // 2)
    for name, higher in (("part", 50), ("other_part", 47)):
        # A patch must stay within the range of the file.
        raised = np.clip(part + higher, heights.min(), heights.max()).astype(heights.dtype)
        write_raster(folder / f"{name}.tif", raised, side // 8, side // 8)
    options = ["--max-error", "1", "--block", "64", "--threads", "2", "-q"]
    for name, source, more in (
        ("plain", "dem", ["--no-mesh"]),
        ("meshed", "dem", []),
        ("exact", "dem", ["--max-error", "0", "--block", "32"]),
        ("other", "moved", ["--max-error", "0", "--block", "32"]),
    ):
        names = [str(folder / f"{source}.tif"), str(folder / f"{name}.twz")]
        main(["compress", *names, *options, *more], standalone_mode=False)


def writing_commands(inputs: Path) -> list[Command]:
    """Return the commands; each reads files of `inputs` and writes a name without directory."""
    dem, part, plain, meshed = (
        str(inputs / name) for name in ("dem.tif", "part.tif", "plain.twz", "meshed.twz")
    )
    common = ("--threads", "2", "-q")
    writing = ("--overwrite", *common)
    bound = ("--max-error", "1", "--block", "64")
    old = (inputs / "meshed.twz").read_bytes()
    return [
        Command("compress", "a.twz", ("compress", dem, "a.twz", *bound, *writing)),
        Command("patch", "a.twz", ("patch", "a.twz", part, *common), old),
        Command("mesh --store", "a.twz", ("mesh", plain, "a.twz", "--store", *writing)),
        Command("decompress", "a.tif", ("decompress", meshed, "a.tif", *writing)),
        Command("decompress --cog", "a.tif", ("decompress", meshed, "a.tif", "--cog", *writing)),
        Command("mesh", "a.glb", ("mesh", meshed, "a.glb", "--max-error", "20", *writing)),
    ]


def reading_commands(inputs: Path) -> list[Command]:
    """Return commands that write nothing: verify, the viewer, and a server on a free port."""
    dem, plain, meshed = (str(inputs / name) for name in ("dem.tif", "plain.twz", "meshed.twz"))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    served = ("serve", plain, "--port", str(port), "--threads", "2", "-q")
    return [
        Command("verify", "", ("verify", plain, dem, "--threads", "2", "-q")),
        Command("serve", "", served, seconds=4.0, is_endless=True, ctrl_c=0,
                address=f"http://127.0.0.1:{port}/plain.tif"),
        Command("view", "", ("view", meshed, "--size", "320x240", "-q"), seconds=8.0,
                is_endless=True),
    ]  # fmt: skip


def warm_up(commands: list[Command], folder: Path) -> None:
    """Run the commands in this process, so that forks find all loaded and compiled."""
    here = Path.cwd()
    os.chdir(folder)
    try:
        for command in commands:
            if command.is_endless:
                continue
            if command.before:
                Path(command.target).write_bytes(command.before)
            words = list(command.arguments)
            words[words.index("--threads") + 1] = "1"  # GDAL's threads are not there in forks
            main(words, standalone_mode=False)
    finally:
        os.chdir(here)


# --- runs ---


@dataclass(frozen=True)
class Ended:
    """How a run ended: its exit status, None for a hang, below 0 by a signal; what it printed."""

    status: int | None
    printed: str
    seconds: float

    @property
    def is_crash(self) -> bool:
        """Say whether an exception got through, or a signal that nobody sent ended it."""
        return self.status == _CRASHED or (self.status is not None and self.status < 0)


class Run:
    """A command running in a fork of this process, in a directory of its own.

    Parameters
    ----------
    before : callable
        Called in the fork before the command.
    log : str
        The file beside the directory that takes what it prints.
    """

    def __init__(
        self,
        arguments: tuple[str, ...],
        folder: Path,
        before: Callable[[], None] = lambda: None,
        log: str = "log",
    ) -> None:
        self._log = folder.parent / log
        self._log.write_bytes(b"")
        self.start = time.monotonic()
        self.pid = os.fork()
        if self.pid == 0:
            _become(arguments, folder, self._log, before)

    def wait(self, patience: float = PATIENCE) -> Ended:
        """Return how it ended; one that hangs is killed."""
        end = time.monotonic() + patience
        status: int | None = None
        while True:
            found, code = os.waitpid(self.pid, os.WNOHANG)
            if found:
                status = os.waitstatus_to_exitcode(code)
                break
            if time.monotonic() > end:
                self.kill()
                break
            time.sleep(_POLL)
        seconds = time.monotonic() - self.start
        return Ended(status, self._log.read_text(errors="replace").strip(), seconds)

    def kill(self) -> bool:
        """Kill it with signal 9; return whether that ended it, not itself before."""
        os.kill(self.pid, signal.SIGKILL)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1]) == -signal.SIGKILL


def _become(
    arguments: tuple[str, ...], folder: Path, log: Path, before: Callable[[], None]
) -> None:
    """Run a command in this process, the fork, and end it."""
    status = _CRASHED
    try:
        out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        sys.stdout = sys.stderr = open(1, "w", buffering=1, closefd=False)
        os.chdir(folder)
        before()
        main(list(arguments), prog_name="terrainwave")
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0
    except BaseException as error:  # noqa: BLE001  what got through is counted
        print(f"{type(error).__name__}: {error}")
    finally:
        os._exit(status)


def temporary_in(folder: Path) -> None:
    """Let temporary files without a place go to a folder."""
    folder.mkdir(exist_ok=True)
    tempfile.tempdir = str(folder)


def moments(generator: random.Random, n: int, first: float, last: float) -> list[float]:
    """Return random moments between two, one in each of `n` equal parts."""
    part = (last - first) / n
    return [first + part * (number + generator.random()) for number in range(n)]
