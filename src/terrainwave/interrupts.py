"""Requests to stop, raised only where nothing is half done.

Python raises a signal's exception between any two instructions, for example after a lock is taken
and before the block that releases it: threads then wait forever, or files are closed while threads
read them. So the commands only record a signal. The main thread raises it at the next `check`,
between two pieces of work.
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
    """Start recording which files are complete, until the next `reset`."""
    global _complete
    _complete = []


def request(error: BaseException) -> None:
    """Make the main thread raise `error` at its next `check`. Safe in a signal handler."""
    _requests.append(error)


def is_requested() -> bool:
    """Return True from the request on, also during clean-up."""
    return bool(_requests)


def _is_on_its_way() -> bool:
    """Return True if the request was raised and the main thread is now cleaning up.

    Foreign code may have swallowed it, with a bare except or in a callback from C.
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
    """Raise the requested error in the main thread, but not during its clean-up.

    Once it was raised there, other threads raise `KeyboardInterrupt`: the main thread waits for
    them before it closes what they use.
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
    """Rename a finished file within the block, undisturbed by requests; record it as complete.

    An earlier request is raised first, and the file is not renamed.
    """
    check()
    _held.append(name)
    try:
        yield
        note_complete(name)
    finally:
        _held.remove(name)


def note_complete(name: str) -> None:
    """Record that a file is complete under its name."""
    if _complete is not None:
        _complete.append(name)


def is_held() -> bool:
    """Return True while a file is being renamed."""
    return bool(_held)


def complete() -> list[str]:
    """Return the names of the files completed since `begin`."""
    return list(_complete or ())


def reset() -> None:
    """Forget requests and files, once the command has handled them."""
    global _is_raised, _complete
    _requests.clear()
    _complete = None
    _is_raised = False
