"""Signals that end a program, handled as Ctrl-C: whatever is unfinished is removed."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

# Of schedulers and containers, and of a terminal that is closed; Windows has no such thing.
_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
_AGAIN = 0.05  # seconds
INTERRUPTED = 128 + signal.SIGINT


class Terminated(KeyboardInterrupt):
    """The process shall end; `status` is what shells expect of one that a signal ended."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.status = 128 + number


@contextmanager
def ending_by_signals() -> Iterator[None]:
    """Raise `Terminated` in the main thread where a signal would end the process at once.

    What is set otherwise stays, such as nohup's. A second signal is ignored: nothing stops the
    clearing up but SIGKILL, after which the next run clears up.
    """

    def end(number: int, _: FrameType | None) -> None:
        for other in changed:
            signal.signal(other, signal.SIG_IGN)
        raise Terminated(number)

    def again(lost: Any) -> None:
        """Send a signal once more that Python has dropped, as in what a weak reference calls."""
        if not isinstance(lost.exc_value, Terminated):
            report(lost)
            return
        for other in changed:
            signal.signal(other, end)
        number = lost.exc_value.status - 128
        threading.Timer(_AGAIN, os.kill, (os.getpid(), number)).start()

    changed: list[int] = []
    report, sys.unraisablehook = sys.unraisablehook, again
    try:
        for number in _SIGNALS:
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, end)
                changed.append(number)
    except ValueError:  # not the main thread: it gets no signals
        pass
    try:
        yield
    finally:
        sys.unraisablehook = report
        for number in changed:
            signal.signal(number, signal.SIG_DFL)
