"""Signals that end a program: the command stops between two pieces of work and cleans up.

A command ends with status 0 to 2, or by a signal. After its end signals have no effect: a signal's
status means that the command was interrupted.
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

# Ctrl-C, the signal of schedulers and containers, and a closed terminal (not on Windows).
_SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
# Seconds after which a signal is raised anywhere: the program may wait for a server.
_PATIENCE = 2.0
# Seconds until the next try if nothing may be raised where the program is.
_AGAIN = 0.1
# Packages that take locks outside of `with`, or leave objects half made. The viewer's window checks
# for requests in each frame.
_NEVER_IN = ("numba", "llvmlite", "importlib", "ctypes", "pyglet", "moderngl", "moderngl_window")


class Terminated(KeyboardInterrupt):
    """Request to end the process; `status` is the one that shells expect after a signal."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number
        self.status = 128 + number


class _Repeater:
    """Thread that sends signals again after some seconds.

    It runs from the start: when a handler runs, the main thread may hold a lock of `threading`.
    """

    def __init__(self) -> None:
        self._asked: queue.SimpleQueue[tuple[int, float] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="terrainwave-signals", daemon=True)
        self._thread.start()

    def send(self, number: int, seconds: float) -> None:
        """Send a signal to the main thread after some seconds. Safe in a signal handler."""
        self._asked.put((number, seconds))

    def close(self) -> None:
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

    A handler that is not the default stays, such as nohup's. Only the first signal counts. With
    `is_process`, signals after the block are ignored: the status is that of the block.
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
        # The repeater is closed first: its signals need a handler.
        if repeater is not None:
            repeater.close()
        for number, before in changed.items():
            signal.signal(number, signal.SIG_IGN if is_process else before)
        interrupts.reset()


def _is_never_interrupted(frame: FrameType | None) -> bool:
    while frame is not None:
        if str(frame.f_globals.get("__name__")).partition(".")[0] in _NEVER_IN:
            return True
        frame = frame.f_back
    return False


def _send_to_main_thread(number: int) -> None:
    """Send a signal to the main thread; this also interrupts its system calls."""
    if sys.platform == "win32":
        import _thread

        _thread.interrupt_main(number)
    else:
        main = threading.main_thread().ident
        if main is not None:
            signal.pthread_kill(main, number)
