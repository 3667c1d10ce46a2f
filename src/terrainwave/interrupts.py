"""Requests to stop, raised where nothing is half done.

Python raises an exception for a signal between any two instructions, also after a lock was taken
and before the block that gives it back: then threads wait for ever, and files are closed while
threads read them. So the commands only note a signal. The main thread raises it at the next
`check`, between two pieces of work.
"""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_requests: list[BaseException] = []
_complete: list[str] | None = None  # a list while a command runs
_held: list[str] = []
_is_raised = False


def begin() -> None:
    """Note from now on which files are complete, until the next `reset`."""
    global _complete
    _complete = []


def request(error: BaseException) -> None:
    """Ask the main thread to raise `error` at its next `check`. Safe in a signal handler."""
    _requests.append(error)


def is_requested() -> bool:
    """Return True from the request on, also while the program clears up."""
    return bool(_requests)


def _is_on_its_way() -> bool:
    """Return True if the request was raised, and the main thread now clears up because of it.

    Code of others may have dropped it, by a bare except, or where it was called from C.
    """
    errors, seen = [sys.exc_info()[1]], set[int]()
    while _is_raised and errors:
        error = errors.pop()
        if error is _requests[0]:
            return True
        if error is not None and id(error) not in seen:
            seen.add(id(error))
            errors += error.__cause__, error.__context__
    return False


def check() -> None:
    """Raise what was requested in the main thread, and nothing while that clears up.

    Once it was raised there, other threads raise `KeyboardInterrupt`: the main thread waits for
    them before it closes what they use, and nobody wants their results.
    """
    global _is_raised
    if not _requests:
        return
    if threading.current_thread() is not threading.main_thread():
        if _is_raised:
            raise KeyboardInterrupt
    elif not _is_on_its_way():
        _is_raised = True
        raise _requests[0]


@contextmanager
def publishing(name: str) -> Iterator[None]:
    """Give a finished file its name in the block, which no request cuts; note that it is complete.

    A request that came before is raised here, and the file gets no name.
    """
    check()
    _held.append(name)
    try:
        yield
        note_complete(name)
    finally:
        _held.remove(name)


def note_complete(name: str) -> None:
    """Note that a file is complete under its name."""
    if _complete is not None:
        _complete.append(name)


def is_held() -> bool:
    """Return True while a file gets its name."""
    return bool(_held)


def complete() -> list[str]:
    """Return the names of the files that are complete since `begin`."""
    return list(_complete or ())


def reset() -> None:
    """Forget requests and files; for the command that has handled them."""
    global _is_raised, _complete
    _requests.clear()
    _complete = None
    _is_raised = False
