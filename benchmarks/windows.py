"""Time window reads: ``python -m benchmarks.windows dem.tif``.

The raster is mirrored to 4096 x 4096 samples where it is smaller and compressed; then random
windows are read, each by a newly opened `Terrain`, so that nothing decoded is at hand. Opening is
part of the time; the file itself is in the system's cache.

Exit status: 0 good; 2 wrong usage.
"""

import csv
import json
import statistics
import tempfile
import time
from pathlib import Path

import click
import numpy as np

from benchmarks.lists import ListCommand, ListOption
from benchmarks.machine import describe_machine
from benchmarks.memory import make_mirrored

FIELDS = (
    "raster", "size", "max_error", "method", "effort", "block", "window", "threads", "n_windows",
    "median_ms", "p90_ms", "most_ms", "median_cpu_ms",
)  # fmt: skip
_SEED = 20260101


def window_times(
    path: Path, side: int, n_windows: int, threads: int
) -> tuple[list[float], list[float]]:
    """Return the seconds that each of some random windows took, and those of CPU time, sorted.

    On a busy machine the latter say more.
    """
    import terrainwave

    places = np.random.default_rng(_SEED)
    seconds, busy = [], []
    # The first read compiles or loads what it needs and is not counted.
    for _ in range(n_windows + 1):
        start, start_busy = time.perf_counter(), time.process_time()
        with terrainwave.open(path, threads=threads) as terrain:
            n_rows, n_cols = terrain.shape
            row, col = places.integers(0, n_rows - side + 1), places.integers(0, n_cols - side + 1)
            terrain.read((int(row), int(col), side, side))
            seconds.append(time.perf_counter() - start)
            busy.append(time.process_time() - start_busy)
    return sorted(seconds[1:]), sorted(busy[1:])


@click.command(cls=ListCommand)
@click.argument("raster", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--size", type=int, default=4096, show_default=True, help="Rows and columns.")
@click.option("--window", "side", type=int, default=512, show_default=True)
@click.option("--windows", "n_windows", type=int, default=100, show_default=True)
@click.option("--max-error", "max_errors", cls=ListOption, type=float, default=(0.0, 1.0, 10.0))
@click.option("--effort", "efforts", cls=ListOption, default=("fast", "default"))
@click.option("--block", "blocks", cls=ListOption, type=int, default=(256,))
@click.option("--method", default="auto", show_default=True)
@click.option("--threads", type=int, default=2, show_default=True)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/windows.csv"),
    show_default=True,
)
def main(
    raster, size, side, n_windows, max_errors, efforts, blocks, method, threads, out
) -> None:  # fmt: skip
    """Write the times of random window reads to a CSV."""
    import terrainwave

    with tempfile.TemporaryDirectory() as folder, out.open("w", newline="") as file:
        source, target = Path(folder) / "mirrored.tif", Path(folder) / "windows.twz"
        make_mirrored(raster, source, size, "tiled")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FIELDS)
        for max_error in max_errors:
            for effort in efforts:
                for block in blocks:
                    made = terrainwave.compress(
                        source, target, max_error=max_error, method=method, effort=effort,
                        block=block, verify=False, overwrite=True,
                    )  # fmt: skip
                    seconds, busy = window_times(target, side, n_windows, threads)
                    found = (
                        statistics.median(seconds),
                        seconds[int(0.9 * len(seconds))],
                        seconds[-1],
                        statistics.median(busy),
                    )
                    row = (
                        raster.stem, size, max_error, made.method, effort, block, side, threads,
                        n_windows, *(round(1e3 * value, 1) for value in found),
                    )  # fmt: skip
                    writer.writerow(row)
                    file.flush()
                    click.echo(",".join(map(str, row)))
    text = json.dumps(describe_machine(), indent=2) + "\n"
    out.with_suffix(".json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
