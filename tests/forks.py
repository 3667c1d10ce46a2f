"""What the child of a fork sees, as the parent's threads are."""

import os
import signal
import sys
import traceback
import warnings

PATIENCE = 20  # seconds, after which a child waits for what nobody will do


def holds_in_a_fork(claim):
    """Say whether `claim` returns something true in a fork of this process, in time."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
        child = os.fork()
    if child == 0:
        signal.alarm(PATIENCE)
        status = 1
        try:
            status = 0 if claim() else 1
        except BaseException:  # noqa: BLE001  the child ends here
            traceback.print_exc(file=sys.__stderr__)
        finally:
            os._exit(status)
    return os.waitpid(child, 0)[1] == 0
