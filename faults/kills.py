"""Kill commands that write with signal 9, and look at what is there then and after the next run."""

import fcntl
import os
import random
import shutil
import signal
import sys
import time
from collections import Counter, namedtuple
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO

from faults.commands import (
    OLD,
    PATIENCE,
    Command,
    Run,
    moments,
    temporary_in,
)

# How many kills, and what lay at the target after them: nothing, what was there before, what the
# command writes, something else. Then in how many trials files were left over by the kill and by
# the next run; next runs that failed; files of others that were changed or removed.
Row = namedtuple(
    "Row",
    "moment command kills absent old whole broken leftovers leftovers_after_next failed_next "
    "others_touched hangs seconds",
)
_OPENED_TO_WRITE = os.O_WRONLY | os.O_RDWR
_CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod")
MAIN_COMMANDS = ("compress", "patch", "mesh --store", "decompress")
_MOST_OPENS = 30  # of the moments before files are opened to be written; fewer of few kills


def rows(commands: list[Command], work: Path, n: int, seed: int) -> Iterator[Row]:
    """Kill each command at `n` moments of its run, fewer of its end, and file operations.

    Commands that are not `MAIN_COMMANDS` are killed at a quarter of the moments.
    """
    temporary_in(work / "temporary")
    generator = random.Random(seed)
    for plain in commands:
        command, operations = measured(plain, work)
        n_own = n if plain.name in MAIN_COMMANDS else -(-n // 4)
        whole = moments(generator, n_own, 0, command.seconds)
        yield _row("by the clock", command, work, [_after(seconds) for seconds in whole])
        last = moments(generator, -(-n_own // 3), 0, 1)  # most where the renaming is
        yield _row(
            "from fsync on",
            command,
            work,
            [_after_fsync(command.last * share**3) for share in last],
        )
        opens = [k for k, kind in enumerate(operations) if kind == "open"]
        chosen = {k for k, kind in enumerate(operations) if kind in _CHANGES}
        chosen |= set(generator.sample(opens, min(len(opens), _MOST_OPENS, 2 * n)))
        kills = [_before_operation(k) for k in sorted(chosen)]
        yield _row("before a file operation", command, work, kills)


def measured(command: Command, work: Path) -> tuple[Command, list[str]]:
    """Return the command with what an undisturbed run does, and the file operations of one."""
    found = []
    for _ in range(3):
        folder = fresh(work, command, command.starts[-1])
        told = _Pipe()
        run = Run(command.arguments, folder, partial(_tell, told, folder))
        ended = run.wait()
        if ended.status != 0:
            raise RuntimeError(f"{command.name} fails undisturbed: {ended}")
        events = told.read_all().split()
        synced = [float(event[6:]) for event in events if event.startswith("fsync=")]
        found.append((ended.seconds, run.start + ended.seconds - synced[0]))
        content = (folder / command.target).read_bytes()
        if command.expected and content != command.expected:
            raise RuntimeError(f"{command.name} writes other bytes the second time")
        command = replace(command, expected=content)
    seconds, last = (sorted(column)[1] for column in zip(*found))
    operations = [event for event in events if not event.startswith("fsync=")]
    return replace(command, seconds=seconds, last=last), operations


# --- kills ---

# Starts a command in a folder and kills it; returns whether it lived until then, None for a hang.
Kill = Callable[[Command, Path], "bool | None"]


def _after(seconds: float) -> Kill:
    """Return a kill so long after the start."""

    def kill(command: Command, folder: Path) -> bool | None:
        run = Run(command.arguments, folder)
        time.sleep(seconds)
        return run.kill()

    return kill


def _after_fsync(seconds: float) -> Kill:
    """Return an end so long after the first fsync, by an alarm: a signal 9 would come too late.

    Nothing of the process runs after it either.
    """

    def kill(command: Command, folder: Path) -> bool | None:
        status = Run(command.arguments, folder, lambda: _set_alarm(seconds)).wait().status
        return None if status is None else status == -signal.SIGALRM

    return kill


def _set_alarm(seconds: float) -> None:
    fsync = os.fsync

    def alarming(handle: int) -> None:
        signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-6))
        fsync(handle)

    os.fsync = alarming


def _before_operation(number: int) -> Kill:
    """Return a kill just before a file operation of its own, counted from 0."""

    def kill(command: Command, folder: Path) -> bool | None:
        status = Run(command.arguments, folder, lambda: _die_at(number, folder)).wait().status
        return None if status is None else status == -signal.SIGKILL

    return kill


def _die_at(number: int, folder: Path) -> None:
    """Let this process kill itself before a file operation."""
    n_left = number

    def count(_: str) -> None:
        nonlocal n_left
        n_left -= 1
        if n_left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(PATIENCE)  # the signal may find another thread

    _on_operations(folder, count)


def _on_operations(folder: Path, call: Callable[[str], None]) -> None:
    """Call a function before each file operation of Python in a folder, with its kind."""

    def hook(event: str, arguments: tuple) -> None:
        if event in _CHANGES:
            call(event)
        elif event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            name, _, flags = arguments
            if flags & _OPENED_TO_WRITE and os.fsdecode(name).startswith(str(folder)):
                call(event)

    sys.addaudithook(hook)


def _tell(told: "_Pipe", folder: Path) -> None:
    """Let this process tell its file operations, and when it calls fsync on a file."""
    fsync = os.fsync

    def telling(handle: int) -> None:
        told.write(f"fsync={time.monotonic()}")
        fsync(handle)

    os.fsync = telling
    _on_operations(folder, told.write)


class _Pipe:
    """Lines from a fork."""

    def __init__(self) -> None:
        self._out, self._in = os.pipe()

    def write(self, line: str) -> None:
        """Write a line."""
        os.write(self._in, line.encode() + b"\n")

    def read_all(self) -> str:
        """Return all that was written, and close."""
        data = b""
        os.close(self._in)
        while part := os.read(self._out, 65536):
            data += part
        os.close(self._out)
        return data.decode()


# --- trials ---


def _row(moment: str, command: Command, work: Path, kills: list[Kill]) -> Row:
    start = time.monotonic()
    found: Counter = Counter()
    for number, kill in enumerate(kills):
        found.update(_trial(command, work, command.starts[number % len(command.starts)], kill))
    counted = [field for field in Row._fields if field not in ("moment", "command", "seconds")]
    seconds = round(time.monotonic() - start, 1)
    return Row(moment, command.name, *(found[field] for field in counted), seconds)


def _trial(command: Command, work: Path, before: bytes, kill: Kill) -> Iterator[str]:
    """Kill a command once; yield what there is to count."""
    folder = fresh(work, command, before)
    with bystanders(folder, command.target) as others:
        was_alive = kill(command, folder)
        if was_alive is None:
            yield "hangs"
        if was_alive:
            yield "kills"
            yield state(folder / command.target, command.expected, before)
            if left_over(folder, work, command, others):
                yield "leftovers"
        ended = Run(command.arguments, folder).wait()
        if ended.status is None:
            yield "hangs"
        if ended.status != 0 or state(folder / command.target, command.expected) != "whole":
            yield "failed_next"
        if left_over(folder, work, command, others):
            yield "leftovers_after_next"
        if others != contents(folder, set(others)):
            yield "others_touched"


def fresh(work: Path, command: Command, before: bytes) -> Path:
    """Return an empty folder with the bytes at the target; nothing there if there are none."""
    folder = work / "trial"
    for path in (folder, work / "temporary"):
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(exist_ok=True)
    if before:
        (folder / command.target).write_bytes(before)
    return folder


def state(target: Path, expected: bytes, before: bytes = OLD) -> str:
    """Say what lies at a target: nothing, what the command writes, what was there, or else."""
    if not target.exists():
        return "absent" if before in (b"", OLD) else "broken"
    content = target.read_bytes()
    return "whole" if content == expected else "old" if content == before else "broken"


def contents(folder: Path, names: set[str]) -> dict[str, bytes]:
    """Return files of a folder, by their paths in it."""
    return {name: (folder / name).read_bytes() for name in names if (folder / name).exists()}


def left_over(folder: Path, work: Path, command: Command, others: dict[str, bytes]) -> list[str]:
    """Return what lies beside the target, or among temporary files, and is nobody else's."""
    known = {command.target, *others, *(str(Path(name).parent) for name in others)}
    here = [str(path.relative_to(folder)) for path in folder.rglob("*")]
    return [name for name in here if name not in known] + os.listdir(work / "temporary")


@contextmanager
def bystanders(folder: Path, target: str) -> Iterator[dict[str, bytes]]:
    """Put files of others beside a target, some held by a living writer of the same target."""
    number = "0123456789abcdef"
    held = [f".{target}.{number}.twz-part", *_scratch(folder, target, number)]
    names = [
        f".{target}.notes.twz-part",
        f".b{target}.{number}.twz-part",
        f"{target}.{number}.twz-part",
        f"{target}.bak",
    ]
    with ExitStack() as stack:
        for name in held + names:
            path = folder / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(name.encode())
            if name in held:
                file: IO[bytes] = stack.enter_context(path.open("rb"))
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield contents(folder, {*held, *names})


def _scratch(folder: Path, target: str, number: str) -> list[str]:
    """Return the names of a scratch directory's lock and of a file in it."""
    return [f".{target}.{number}.twz-lock", f".{target}.{number}.twz-scratch/segment"]
