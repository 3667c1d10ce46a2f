"""Requests to stop, raised where nothing is half done.

Python raises an exception for a signal between any two instructions, also after a lock was taken
and before the block that gives it back: then threads wait for ever, and files are closed while
threads read them. So the commands only note a signal. The main thread raises it at the next
`check`, between two pieces of work.
"""

import threading

_requests: list[BaseException] = []
_is_raised = False


def request(error: BaseException) -> None:
    """Ask the main thread to raise `error` at its next `check`. Safe in a signal handler."""
    _requests.append(error)


def is_requested() -> bool:
    """Return True from the request on, also while the program clears up."""
    return bool(_requests)


def is_raised() -> bool:
    """Return True once the request was raised."""
    return _is_raised


def check() -> None:
    """Raise what was requested, once, in the main thread; other threads go on."""
    if _requests and not _is_raised and threading.current_thread() is threading.main_thread():
        raise_now()


def raise_now() -> None:
    """Raise what was requested, wherever the main thread is."""
    global _is_raised
    _is_raised = True
    raise _requests[0]


def reset() -> None:
    """Forget requests; for the command that has handled them."""
    global _is_raised
    _requests.clear()
    _is_raised = False
