"""What threads gain when a raster is compressed and read: ``python -m benchmarks.threads dem.tif``.

The raster, mirrored, in sizes: `compress` in one process, kernels warm, 1, 2, 4 … threads in turns.
"bare" is without meshes and proof, "whole" with both; "read" opens that file and reads all of it,
without the native library. On a machine that lends the threads of one core as processors nothing
can be gained, so it is measured as well what a loop of a kernel gains.
"""

import os
import time
from collections import namedtuple
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numba

import terrainwave
from benchmarks import common
from benchmarks.rasters import make_mirrored

# Wall clock, medians; `gain` over one thread. A task "loop" is the same work in each thread.
Row = namedtuple("Row", "raster size task max_error threads n_runs seconds msamples_s gain")
COMMANDS = {"bare": {"mesh": "none", "verify": False}, "whole": {}}
N_RUNS = 3
_N_STEPS = 300_000_000


@numba.njit(nogil=True)
def loop(n_steps: int) -> int:
    """Keep a core busy."""
    total = 0
    for step in range(n_steps):
        total ^= (step * step) >> 3
    return total


def loops(threads: int) -> None:
    """Run a loop in each of some threads."""
    with ThreadPoolExecutor(threads) as executor:
        list(executor.map(loop, [_N_STEPS] * threads))


def measure(dem: Path, sizes, numbers, bound: float, folder: Path) -> Iterator[Row]:
    """Yield the rows of a raster."""
    loop(1)
    yield from rows_of(("", "", "loop", ""), numbers, loops, n_samples=0)
    for size in sizes:
        source, target = folder / "mirrored.tif", folder / "threads.twz"
        source.unlink(missing_ok=True)
        make_mirrored(dem, source, size)
        for name, options in COMMANDS.items():
            compress = partial(
                terrainwave.compress, source, target, max_error=bound, overwrite=True, **options
            )
            compress(threads=1)
            yield from rows_of((dem.stem, size, name, bound), numbers, compress, size * size)
        yield from rows_of(
            (dem.stem, size, "read", bound), numbers, partial(read, target), size * size
        )


def read(path: Path, threads: int) -> None:
    """Open a file and read all of it."""
    with terrainwave.open(path, threads=threads, native=False) as terrain:
        terrain.read()


def rows_of(case, numbers, task, n_samples: int) -> Iterator[Row]:
    """Yield the rows of a task, which takes a number of `threads`."""
    tasks = [partial(task, threads=n) for n in numbers]
    found = common.take_turns(lambda: tasks, N_RUNS, clock=time.perf_counter)
    for n, timed in zip(numbers, found, strict=True):
        work = n if not n_samples else 1
        yield Row(
            *case, n, timed.n_runs, round(timed.seconds, 3),
            round(n_samples / timed.seconds / 1e6, 2) if n_samples else "",
            round(work * found[0].seconds / timed.seconds, 2),
        )  # fmt: skip


@common.command("threads.csv")
@common.dem_argument
@common.option("--size", "sizes", type=common.COUNT, multiple=True, default=(1201, 4096, 8192))
@common.option("--max-error", "bound", default=1.0)
def main(dem, sizes, bound, folder, out) -> None:
    """Measure 1, 2, 4 … threads, up to the processors that there are."""
    numbers = [1]
    while 2 * numbers[-1] <= len(os.sched_getaffinity(0)):
        numbers.append(2 * numbers[-1])
    common.write_rows(out, measure(dem, sizes, numbers, bound, folder))


if __name__ == "__main__":
    main()
