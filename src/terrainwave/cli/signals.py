"""Signals that end a program: the command stops between two pieces of work and clears up."""

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from terrainwave import interrupts

# Ctrl-C, what schedulers and containers send, and a terminal that is closed (not on Windows).
_SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
# Seconds after which a signal is raised wherever the program is: it may wait for a server.
_PATIENCE = 2.0
# Seconds until another look if the program is where nothing may be raised.
_AGAIN = 0.1
# Packages that take locks without a block which gives them back, or that leave what they make in
# an undefined state.
_NEVER_IN = ("numba", "llvmlite", "importlib")


class Terminated(KeyboardInterrupt):
    """The process shall end; `status` is what shells expect of one that a signal ended."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number
        self.status = 128 + number


@contextmanager
def ending_by_signals() -> Iterator[None]:
    """Raise `Terminated` in the main thread after a signal, at the next `interrupts.check`.

    A handler that is not the default stays, such as nohup's. Only the first signal counts: nothing
    stops the clearing up but SIGKILL, after which the next run clears up.
    """
    asked = 0.0
    timers: list[threading.Timer] = []

    def send_again(number: int, seconds: float) -> None:
        timer = threading.Timer(seconds, _send_to_main_thread, (number,))
        timer.daemon = True
        timers.append(timer)
        timer.start()

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if not interrupts.is_requested():
            asked = time.monotonic()
            interrupts.request(Terminated(number))
            send_again(number, _PATIENCE)
        elif interrupts.is_raised() or time.monotonic() - asked < _PATIENCE:
            return
        elif _is_never_interrupted(frame):
            send_again(number, _AGAIN)
        else:
            interrupts.raise_now()

    changed = {}
    try:
        for number in _SIGNALS:
            before = signal.getsignal(number)
            if before in (signal.SIG_DFL, signal.default_int_handler):
                signal.signal(number, end)
                changed[number] = before
    except ValueError:  # not the main thread: it gets no signals
        pass
    try:
        yield
    finally:
        # First the handlers: they start timers.
        for number, before in changed.items():
            signal.signal(number, before)
        for timer in timers:
            timer.cancel()
        interrupts.reset()


def _is_never_interrupted(frame: FrameType | None) -> bool:
    """Return True if the main thread runs code of a package that an exception would break."""
    while frame is not None:
        if str(frame.f_globals.get("__name__")).partition(".")[0] in _NEVER_IN:
            return True
        frame = frame.f_back
    return False


def _send_to_main_thread(number: int) -> None:
    """Send a signal to the main thread; also ends what the system makes it wait for."""
    if sys.platform == "win32":
        import _thread

        _thread.interrupt_main(number)
    else:
        main = threading.main_thread().ident
        if main is not None:
            signal.pthread_kill(main, number)
