"""Measure whole commands by raster size: ``python -m benchmarks.scale dem.tif``.

Each raster mirrors `dem.tif` (windows at a time), so all have the same ground: a square of 4096²
samples serves best. Each stage is a process of its own with two threads:

* ``compress`` (--max-error 1), ``verify`` against the raster, ``decompress``;
* ``read``: all of it from Python, in windows of 2048²;
* ``mesh``: ``mesh`` of one window of 2048² of the full grid, the same ground in all sizes;
* ``whole``, ``low``: ``render`` of all of it from above, and low over one place to the horizon.

A raster of 512² comes first: it loads all kernels, and what it takes is what starting costs.
`per_million` is processor time per 10^6 samples (of the window for ``mesh``; for ``whole`` and
``low`` that of a picture), `net_per_million` that of what is above the raster of 512². Small sizes
are medians of some runs. Warm numba's cache before (``terrainwave warmup``).
"""

import statistics
import sys
from collections import namedtuple
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from benchmarks import common

SIZES = (4096, 8192, 16384, 32768, 65536)
START = 512
SIDE = 2048  # of windows
STAGES = ("compress", "verify", "decompress", "read", "mesh", "whole", "low")
THREADS = "2"
# Runs of small sizes; others have one.
N_RUNS = {START: 3, 4096: 3}
# Metres between samples: with them, heights in metres make pictures. Those of the moon raster.
SPACING = 118.45

_READ = """
import sys
import terrainwave
path, side = sys.argv[1], int(sys.argv[2])
with terrainwave.open(path, threads=int(sys.argv[3])) as terrain:
    n_rows, n_cols = terrain.shape
    n_samples = 0
    for row in range(0, n_rows, side):
        for col in range(0, n_cols, side):
            n_samples += terrain.read(window=(row, col, side, side)).size
assert n_samples == n_rows * n_cols
"""

# One line of the CSV.
Row = namedtuple(
    "Row",
    "size stage n_runs n_samples seconds cpu_seconds per_million net_per_million peak_mib n_bytes",
)


def stages_of(source: Path, target: Path, size: int) -> dict[str, tuple[int, list[str]]]:
    """Return how many samples each stage works on (0 of a picture), and its command."""
    python = [sys.executable, "-c"]
    back, mesh, picture = (target.with_suffix(end) for end in (".back.tif", ".ply", ".png"))
    side = min(SIDE, size)
    # Over the same ground whatever the size, and towards the rest of it.
    place = min(size, SIZES[0]) // 2 * SPACING
    common_options = ["--overwrite", "--quiet", "--threads", THREADS]
    compress = ["compress", str(source), str(target), "--max-error", "1"]
    verify = ["verify", str(target), str(source)]
    render = [*python, common.CLI, "render", str(target), str(picture), *common_options]
    return {
        "compress": (size**2, [*python, common.CLI, *compress, *common_options]),
        "verify": (size**2, [*python, common.CLI, *verify, "--quiet", "--threads", THREADS]),
        "decompress": (
            size**2, [*python, common.CLI, "decompress", str(target), str(back), *common_options],
        ),
        "read": (size**2, [*python, _READ, str(target), str(SIDE), THREADS]),
        "mesh": (
            side**2,
            [*python, common.CLI, "mesh", str(target), str(mesh), "--window", f"0,0,{side},{side}",
             *common_options],
        ),
        "whole": (0, render),
        "low": (0, [*render, "--camera", f"{place},{-place},7000,135,-10,60"]),
    }  # fmt: skip


def measure(source: Path, target: Path, size: int, stage: str) -> tuple[int, int, common.Used]:
    """Return the samples a stage works on, its runs and the medians of what they took."""
    n_samples, command = stages_of(source, target, size)[stage]
    n_runs = N_RUNS.get(size, 1)
    runs = [common.run_and_measure(command) for _ in range(n_runs)]
    return n_samples, n_runs, common.Used(*map(statistics.median, zip(*runs)))


def row_of(size: int, stage: str, found: tuple, n_bytes: int, start: float) -> Row:
    """Return a line of the CSV; `start` is the processor time of the stage on a small raster."""
    n_samples, n_runs, used = found
    scale = n_samples / 1e6 or 1.0
    above = used.cpu_seconds - start if n_samples else used.cpu_seconds
    return Row(
        size, stage, n_runs, n_samples, round(used.seconds, 2), round(used.cpu_seconds, 2),
        round(used.cpu_seconds / scale, 4), round(above / scale, 4), round(used.peak_mib, 1),
        n_bytes,
    )  # fmt: skip


def measured(dem: Path, sizes: Sequence[int], stages: Sequence[str], folder: Path) -> Iterator[Row]:
    """Yield the rows of all sizes; files that are there are used, and deleted in the end."""
    starts: dict[str, float] = {}
    for size in sizes:
        source, target = folder / f"mirrored-{size}.tif", folder / f"mirrored-{size}.twz"
        if not source.exists():
            places = dem.absolute(), source.absolute()
            common.call_elsewhere(
                "benchmarks.rasters.make_mirrored", *places, size, "tiled", SPACING
            )
        for stage in stages if target.exists() else dict.fromkeys(["compress", *stages]):
            found = measure(source, target, size, stage)
            start = starts.setdefault(stage, found[-1].cpu_seconds)
            yield row_of(size, stage, found, target.stat().st_size, start)
            target.with_suffix(".back.tif").unlink(missing_ok=True)
        for path in folder.glob(f"mirrored-{size}.*"):
            path.unlink()


@common.command("scale_commands.csv")
@common.dem_argument
@common.option("--sizes", cls=common.ListOption, type=click.IntRange(min=SIDE), default=SIZES)
@common.choices_option("--stages", of=STAGES)
@common.option("--append", is_flag=True, help="Keep the rows that are there.")
def main(dem, sizes, stages, append, folder, out) -> None:
    """Run the measurement."""
    rows = measured(dem, [START, *sizes], stages, folder)
    kept = (row for row in rows if not (append and row.size == START))
    common.write_rows(out, kept, append=append)


if __name__ == "__main__":
    main()
