"""Signals that end a program, handled as Ctrl-C: whatever is unfinished is removed."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

# Of schedulers and containers, and of a terminal that is closed; Windows has no such thing.
_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
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

    def end(number: int, frame: FrameType | None) -> None:
        for other in changed:
            signal.signal(other, signal.SIG_IGN)
        raise Terminated(number)

    changed: list[int] = []
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
        for number in changed:
            signal.signal(number, signal.SIG_DFL)
