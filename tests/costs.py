"""What a call costs, by counts that a busy machine does not change."""

import sys
import tracemalloc


def peak_memory(function):
    """Return the most bytes that Python and numpy held at once during a call."""
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def n_calls(function):
    """Return how many functions this thread called meanwhile, those in C, too."""
    count = 0

    def see(_, event, __):
        nonlocal count
        count += event in {"call", "c_call"}

    before = sys.getprofile()
    sys.setprofile(see)
    try:
        function()
    finally:
        sys.setprofile(before)
    return count
