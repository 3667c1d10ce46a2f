"""Interrupt commands at random moments, and look at how they end and at what is there then."""

import os
import random
import signal
import statistics
import subprocess
import threading
import time
import urllib.request
from collections import Counter, namedtuple
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from faults.commands import Command, Ended, Run, moments, temporary_in
from faults.kills import fresh, left_over, state

# How many interruptions; runs that they ended, and that had finished before. Then faults: crashes,
# hangs, other statuses, runs that a signal cut and that left another target than before or that
# finished and left another one than they should, trials after which files were left over.
Row = namedtuple(
    "Row",
    "command signals ended finished crashes hangs wrong broken left_behind longest_s seconds",
)
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def rows(commands: list[Command], work: Path, n: int, seed: int) -> Iterator[Row]:
    """Interrupt each command at `n` moments of its run, by each kind of signal in turns."""
    temporary_in(work / "temporary")
    generator = random.Random(seed)
    # For forks: an exception before their command begins would be a fault of the trial.
    for kind in _SIGNALS:
        signal.signal(kind, signal.SIG_DFL)
    with ExitStack() as stack:
        if any(command.name == "view" for command in commands):
            stack.enter_context(_display())
        for plain in commands:
            command = plain if plain.is_endless else _measured(plain, work)
            start = time.monotonic()
            found: Counter = Counter()
            longest = 0.0
            for number, moment in enumerate(moments(generator, n, 0, command.seconds)):
                kind = _SIGNALS[number % len(_SIGNALS)]
                seen, seconds = _trial(command, work, kind, moment)
                longest = max(longest, seconds)
                found.update(seen)
            counts = (found[field] for field in Row._fields[1:-2])
            took = round(time.monotonic() - start, 1)
            yield Row(command.name, *counts, round(longest, 2), took)


@contextmanager
def _display() -> Iterator[None]:
    """Run an X server without a screen, and name it in the environment."""
    read, write = os.pipe()
    server = ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24", "+extension", "GLX"]
    with subprocess.Popen(server, pass_fds=[write], stderr=subprocess.DEVNULL) as process:
        os.close(write)
        with os.fdopen(read) as number:
            os.environ["DISPLAY"] = f":{number.readline().strip()}"
        try:
            yield
        finally:
            process.terminate()


def _measured(command: Command, work: Path) -> Command:
    """Return the command with the time that it takes, and what it writes."""
    times = []
    for _ in range(3):
        folder = fresh(work, command, command.starts[-1])
        ended = Run(command.arguments, folder).wait()
        if ended.status != 0:
            raise RuntimeError(f"{command.name} fails undisturbed: {ended}")
        times.append(ended.seconds)
    expected = (folder / command.target).read_bytes() if command.target else b""
    return replace(command, seconds=statistics.median(times), expected=expected)


def _trial(
    command: Command, work: Path, kind: signal.Signals, moment: float
) -> tuple[list[str], float]:
    """Interrupt a command once; return what there is to count, and the seconds until it ended."""
    before = command.starts[-1]
    folder = fresh(work, command, before)
    run = Run(command.arguments, folder)
    with _visited(command.address):
        time.sleep(moment)
        sent = time.monotonic()
        os.kill(run.pid, kind)
        ended = run.wait()
    seconds = time.monotonic() - sent
    left = state(folder / command.target, command.expected, before) if command.target else "none"
    seen = ["signals", *_faults(command, ended, kind, left)]
    if left_over(folder, work, command, {}):
        seen.append("left_behind")
    for fault in set(seen) - {"signals", "ended", "finished"}:
        print(f"{command.name}, {kind.name} after {moment:.3f} s: {fault}, {ended}, {left}")
    return seen, seconds


@contextmanager
def _visited(address: str) -> Iterator[None]:
    """Ask a server for the same again and again, so that its threads read when it ends."""
    is_over = threading.Event()

    def ask() -> None:
        while not is_over.wait(0.01):
            try:
                urllib.request.urlopen(address, timeout=5).read()
            except OSError:  # it has not begun, or has ended
                pass

    visitor = threading.Thread(target=ask)
    if address:
        visitor.start()
    try:
        yield
    finally:
        is_over.set()
        if address:
            visitor.join()


def _faults(command: Command, ended: Ended, kind: signal.Signals, left: str) -> Iterator[str]:
    cut = command.ctrl_c if kind is signal.SIGINT else 128 + kind
    if ended.status is None:
        yield "hangs"
    elif ended.status == cut or (ended.status == -kind and not ended.printed):
        # A process that is not yet a command is ended by the system.
        yield "ended"
        if left not in ("old", "absent", "none"):
            yield "broken"
    elif ended.status == 0 and not command.is_endless:
        yield "finished"
        if left not in ("whole", "none"):
            yield "broken"
    elif ended.is_crash:
        yield "crashes"
    else:
        yield "wrong"
