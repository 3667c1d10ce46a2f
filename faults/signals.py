"""Interrupt commands at random moments, and look at how they end and at what is there then."""

import os
import random
import signal
import statistics
import time
from collections import Counter, namedtuple
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from faults.commands import Command, Ended, Run, moments, temporary_in
from faults.kills import fresh, left_over, state

# How many interruptions; runs that they ended, and that had finished before. Then faults: crashes,
# hangs, other statuses, runs that ended by a signal and left another target than before or that
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
    for plain in commands:
        command = _measured(plain, work)
        start = time.monotonic()
        found: Counter = Counter()
        longest = 0.0
        for number, moment in enumerate(moments(generator, n, 0, command.seconds)):
            kind = _SIGNALS[number % len(_SIGNALS)]
            seen, seconds = _trial(command, work, kind, moment)
            longest = max(longest, seconds)
            found.update(seen)
        counts = (found[field] for field in Row._fields[1:-2])
        yield Row(command.name, *counts, round(longest, 2), round(time.monotonic() - start, 1))


def _measured(command: Command, work: Path) -> Command:
    """Return the command with the time that it takes, and what it writes."""
    times = []
    for _ in range(3):
        folder = fresh(work, command, command.starts[-1])
        ended = Run(command.arguments, folder).wait()
        if ended.status != 0:
            raise RuntimeError(f"{command.name} fails undisturbed: {ended}")
        times.append(ended.seconds)
    target = folder / command.target
    return replace(command, seconds=statistics.median(times), expected=target.read_bytes())


def _trial(
    command: Command, work: Path, kind: signal.Signals, moment: float
) -> tuple[list[str], float]:
    """Interrupt a command once; return what there is to count, and the seconds until it ended."""
    before = command.starts[-1]
    folder = fresh(work, command, before)
    run = Run(command.arguments, folder)
    time.sleep(moment)
    sent = time.monotonic()
    os.kill(run.pid, kind)
    ended = run.wait()
    seen = [
        "signals",
        *_faults(ended, kind, state(folder / command.target, command.expected, before)),
    ]
    if left_over(folder, work, command, {}):
        seen.append("left_behind")
    return seen, time.monotonic() - sent


def _faults(ended: Ended, kind: signal.Signals, left: str) -> Iterator[str]:
    if ended.status is None:
        yield "hangs"
    elif ended.status == 0:
        yield "finished"
        if left != "whole":
            yield "broken"
    elif ended.status in (128 + kind, -kind):
        # A process that is not yet, or no longer, a command is ended by the system.
        yield "ended"
        if left not in ("old", "absent") and not (ended.status == -kind and left == "whole"):
            yield "broken"
    elif ended.is_crash:
        yield "crashes"
    else:
        yield "wrong"
