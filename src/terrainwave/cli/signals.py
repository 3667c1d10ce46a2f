"""Signals that end a program: the command stops between two pieces of work and clears up.

A command has ended with status 0 to 2, or by a signal. After its end signals change nothing any
more: who sees the status of one knows that the command was cut.
"""

import queue
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
# an undefined state. The viewer's window: each frame checks for requests.
_NEVER_IN = ("numba", "llvmlite", "importlib", "ctypes", "pyglet", "moderngl", "moderngl_window")


class Terminated(KeyboardInterrupt):
    """The process shall end; `status` is what shells expect of one that a signal ended."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number
        self.status = 128 + number


class _Repeater:
    """Sends signals again after some seconds, from a thread that waits for that.

    A handler cannot start one: the main thread may hold a lock that every new thread takes.
    """

    def __init__(self) -> None:
        self._asked: queue.SimpleQueue[tuple[int, float] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="terrainwave-signals", daemon=True)
        self._thread.start()

    def send(self, number: int, seconds: float) -> None:
        """Send a signal to the main thread in some seconds. Safe in a signal handler."""
        self._asked.put((number, seconds))

    def close(self) -> None:
        """Send nothing any more."""
        self._asked.put(None)
        self._thread.join()

    def _run(self) -> None:
        asked = self._asked.get()
        while asked is not None:
            number, seconds = asked
            try:
                asked = self._asked.get(timeout=seconds)
            except queue.Empty:
                _send_to_main_thread(number)
                asked = self._asked.get()


@contextmanager
def ending_by_signals(*, is_process: bool = False) -> Iterator[None]:
    """Raise `Terminated` in the main thread after a signal, at the next `interrupts.check`.

    A handler that is not the default stays, such as nohup's. Only the first signal counts: nothing
    stops the clearing up but SIGKILL, after which the next run clears up.

    Parameters
    ----------
    is_process : bool
        The process ends after the block. Signals are ignored from then on: the status is that of
        the block.
    """
    asked = 0.0
    repeater = None

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        assert repeater is not None
        if not interrupts.is_requested():
            asked = time.monotonic()
            interrupts.request(Terminated(number))
            repeater.send(number, _PATIENCE)
        elif time.monotonic() - asked < _PATIENCE:
            return
        elif interrupts.is_held() or _is_never_interrupted(frame):
            repeater.send(number, _AGAIN)
        else:
            repeater.send(number, _PATIENCE)
            interrupts.check()

    interrupts.begin()
    changed = {}
    if threading.current_thread() is threading.main_thread():  # others get no signals
        repeater = _Repeater()
        for number in _SIGNALS:
            before = signal.getsignal(number)
            if before in (signal.SIG_DFL, signal.default_int_handler):
                signal.signal(number, end)
                changed[number] = before
    try:
        yield
    finally:
        # First the repeater: what it sends must find a handler.
        if repeater is not None:
            repeater.close()
        for number, before in changed.items():
            signal.signal(number, signal.SIG_IGN if is_process else before)
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
