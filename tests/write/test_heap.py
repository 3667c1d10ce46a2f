"""Does a worker keep what its tasks free, and give it back when it is idle?"""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(
    not hasattr(os, "confstr") or "glibc" not in (os.confstr("CS_GNU_LIBC_VERSION") or ""),
    reason="how glibc allocates",
)

# Arrays as tasks make them, of 1 MiB; pages that were mapped for them, and those held, in MiB.
_PROGRAM = """
import resource, threading, time
from terrainwave.write.tasks import heap
import numpy as np

heap._IDLE_SECONDS = 0.2

def n_mapped():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(50):
        arrays = [np.ones(1 << 17) for _ in range(20)]
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def held():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / (1 << 20)

without = n_mapped()
idle = held()
with heap.kept_heap(), heap.kept_heap():
    within = n_mapped()
    kept = held()
with heap.kept_heap():
    again = n_mapped()
time.sleep(1.0)
print(without, within, again, round(kept - idle), round(held() - idle), n_mapped())
"""


def _found(**variables: str) -> list[int]:
    """Return pages mapped without, within and within again; MiB kept and kept later; pages."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("MALLOC")}
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM], env=environment | variables, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return [int(word) for word in done.stdout.split()]


@pytest.mark.full
def test_a_worker_keeps_what_tasks_free_until_it_is_idle():
    without, within, again, kept, later, after = _found(MALLOC_TRIM_THRESHOLD_="65536")
    assert within < without / 10
    assert again < without / 10
    assert kept >= 15
    assert later <= 2
    assert after > without / 2


@pytest.mark.full
@pytest.mark.parametrize("variables", [{}, {"MALLOC_TRIM_THRESHOLD_": str(1 << 30)}])
def test_other_processes_are_left_alone(variables):
    without, within, *_ = _found(**variables)
    assert within > without / 2
