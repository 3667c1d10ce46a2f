"""Run commands that write on disks that fill up, at random numbers of bytes."""

import os
import random
import resource
import shutil
import subprocess
import time
from collections import Counter, namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from faults.commands import Command, Ended, Run, temporary_in
from faults.kills import bystanders, contents, fresh, left_over, measured, state

# What ran out; trials; how many were refused, with one line and status 1; runs that had room
# enough; what lay at the target afterwards; files left over; refusals whose last line names no
# reason, and those before which GDAL printed lines of its own.
Row = namedtuple(
    "Row",
    "limit command trials refused enough absent old whole broken leftovers others_touched "
    "unclear more_lines crashes hangs seconds",
)
_PAGE = 4096
_DISK = 64 << 20  # bytes; a file takes up all that is not wanted
_REASONS = ("disk is full", "GB free", "File too large")


def rows(commands: list[Command], work: Path, n: int, seed: int) -> Iterator[Row]:
    """Run each command `n` times on disks of random sizes, and with files limited to some."""
    temporary_in(work / "temporary")
    generator = random.Random(seed)
    for plain in commands:
        command, _ = measured(plain, work)
        for limit, run in (("disk", _on_small_disk), ("size of a file", _with_small_files)):
            if limit == "disk" and not can_mount(work):
                continue
            start, found = time.monotonic(), Counter[str]()
            most = _most_bytes(command, work, limit)
            n_own = n if limit == "disk" else -(-n // 5)
            for number in range(n_own):
                before = command.starts[number % len(command.starts)]
                room = max(round(most * (number + generator.random()) / n_own), _PAGE)
                found.update(_trial(command, work, before, room, run))
            counted = Row._fields[3:-1]
            seconds = round(time.monotonic() - start, 1)
            yield Row(limit, command.name, n_own, *(found[field] for field in counted), seconds)


def _most_bytes(command: Command, work: Path, limit: str) -> int:
    """Return a little more than an undisturbed run takes at once, or its largest file."""
    folder = fresh(work, command, command.starts[-1])
    if limit == "disk":
        with _moved_to_disk(work, folder, _DISK) as place:
            before = shutil.disk_usage(place).used
            most = _largest(command, place, lambda: shutil.disk_usage(place).used) - before
    else:
        most = _largest(command, folder, lambda: max(map(_size, _files(folder)), default=0))
    return round(1.1 * max(most, len(command.expected)))


def _largest(command: Command, folder: Path, measure: Callable[[], int]) -> int:
    """Return the largest of numbers measured while a command runs."""
    run = Run(command.arguments, folder)
    most = 0
    while os.waitid(os.P_PID, run.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        most = max(most, measure())
    run.wait()
    return most


def _files(folder: Path) -> list[Path]:
    return [Path(place) / name for place, _, names in os.walk(folder) for name in names]


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:  # gone by now
        return 0


# Runs a command in a folder where there is room for so many bytes.
Limited = Callable[[Command, Path, int], Ended]


def _with_small_files(command: Command, folder: Path, room: int) -> Ended:
    limits = (room, resource.RLIM_INFINITY)
    before: Callable[[], None] = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits)  # noqa: E731
    return Run(command.arguments, folder, before).wait()


def _on_small_disk(command: Command, folder: Path, room: int) -> Ended:
    """Fill the disk but for `room` bytes, unseen by who asks beforehand how much there is."""
    free = shutil.disk_usage(folder).free
    ballast = folder / "ballast"
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(free - room // _PAGE * _PAGE, 1))
    try:
        return Run(command.arguments, folder, _promise_room).wait()
    finally:
        ballast.unlink()


def _promise_room() -> None:
    """Let a check of the free space pass: the room goes to others while the command runs."""
    usage = shutil.disk_usage("/")
    shutil.disk_usage = lambda _: usage._replace(free=2**40)


def can_mount(work: Path) -> bool:
    """Say whether a small disk of memory can be mounted here."""
    try:
        with mounted(work / "disk", 1 << 20):
            return True
    except (OSError, subprocess.CalledProcessError):
        return False


@contextmanager
def mounted(place: Path, n_bytes: int) -> Iterator[None]:
    """Mount a disk of so many bytes, of memory."""
    place.mkdir(exist_ok=True)
    options = ["-t", "tmpfs", "-o", f"size={n_bytes}", "terrainwave", str(place)]
    subprocess.run(["mount", *options], check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(place)], check=True, capture_output=True)


def _trial(command: Command, work: Path, before: bytes, room: int, run: Limited) -> Iterator[str]:
    """Run a command once with little room; yield what there is to count."""
    folder = fresh(work, command, before)
    on_disk = run is _on_small_disk
    with _moved_to_disk(work, folder, _DISK) if on_disk else _as_it_is(folder) as place:
        with bystanders(place, command.target) as others:
            ended = run(command, place, room)
            yield state(place / command.target, command.expected, before)
            if left_over(place, work, command, others):
                yield "leftovers"
            if others != contents(place, set(others)):
                yield "others_touched"
    if ended.status is None:
        yield "hangs"
    elif ended.is_crash:
        yield "crashes"
    elif ended.status == 0:
        yield "enough"
    else:
        yield "refused"
        lines = ended.printed.splitlines()
        own = [line for line in lines if line.startswith("terrainwave: ")]
        is_clear = own == lines[-1:] and any(reason in own[0] for reason in _REASONS)
        if ended.status != 1 or not is_clear:
            yield "unclear"
        if len(lines) > 1:
            yield "more_lines"


@contextmanager
def _as_it_is(folder: Path) -> Iterator[Path]:
    yield folder


@contextmanager
def _moved_to_disk(work: Path, folder: Path, n_bytes: int) -> Iterator[Path]:
    with mounted(work / "disk", n_bytes):
        shutil.copytree(folder, work / "disk", dirs_exist_ok=True)
        yield work / "disk"
