"""Measure peak memory and time on a large raster: ``python -m benchmarks.memory dem.tif``.

The raster is made by mirroring a small one. On each size, by one thread on one core:
`terrainwave compress` as it comes, the same without meshes and proof, and GDAL making a COG
(LERC_ZSTD, blocks of 512, overviews, the same bound, the raster's own type) as `gdal_translate`
does, with its cache as it comes, 5 % of the machine's memory, and with one of 64 MB. Each runs in a
process of its own, whose start counts; they take turns, and medians are given, of memory the most.
This process imports nothing large, because Linux counts the memory of a process at the moment it
starts another towards the *other's* peak. What follows ``--`` goes to ``terrainwave compress``.
"""

import os
import sys
from collections import namedtuple
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

import click

from benchmarks import common

# What `benchmarks.rasters.write_cog` does, without what else that module imports.
_COG = """
import sys
import rasterio.shutil
rasterio.shutil.copy(sys.argv[1], sys.argv[2], driver="COG", COMPRESS="LERC_ZSTD",
                     MAX_Z_ERROR=sys.argv[3], BLOCKSIZE="512", OVERVIEWS="AUTO")
"""

# Who writes: options of `compress`, or what GDAL's environment has besides.
WRITERS: dict[str, Sequence[str] | dict[str, str]] = {
    "terrainwave compress": (),
    "terrainwave compress --mesh none --no-verify": ("--mesh", "none", "--no-verify"),
    "COG": {},
    "COG, GDAL_CACHEMAX=64": {"GDAL_CACHEMAX": "64"},
}

# One line of the CSV.
Row = namedtuple(
    "Row",
    "raster size layout max_error writer n_runs raw_mib n_bytes peak_mib seconds cpu_seconds "
    "most_cpu_seconds",
)


def run(writer: str, source: Path, target: Path, max_error: float, extra: Sequence[str]):
    """Run a writer; return what it took."""
    target.unlink(missing_ok=True)
    more = WRITERS[writer]
    if isinstance(more, dict):
        command = [sys.executable, "-c", _COG, str(source), str(target), repr(max_error)]
        return common.run_and_measure(command, env=os.environ | more)
    words = ["compress", str(source), str(target), "--max-error", str(max_error), "--threads", "1"]
    return common.run_and_measure([sys.executable, "-c", common.CLI, *words, *more, *extra])


def rows_of(
    source: Path, head: tuple, n_runs: int, max_error: float, extra: Sequence[str]
) -> Iterator[Row]:
    """Yield the rows of a raster: one for each writer."""
    used: dict[str, list] = {writer: [] for writer in WRITERS}
    n_bytes: dict[str, int] = {}
    for _ in range(n_runs + 1):
        for writer, found in used.items():
            target = source.with_name("mirrored.tif" if "COG" in writer else "mirrored.twz")
            found.append(run(writer, source, target, max_error, extra))
            n_bytes[writer] = target.stat().st_size
    for writer, found in used.items():
        # The first round may compile.
        seconds, cpu_seconds, peaks = zip(*found[1:], strict=True)
        yield Row(
            *head, max_error, writer, n_runs, round(source.stat().st_size / 2**20, 1),
            n_bytes[writer], round(max(peaks), 1), round(median(seconds), 2),
            round(median(cpu_seconds), 2), round(max(cpu_seconds), 2),
        )  # fmt: skip


@common.command("memory.csv")
@common.dem_argument
@click.argument("extra", nargs=-1, type=click.UNPROCESSED)
@common.option("--size", "sizes", cls=common.ListOption, type=common.COUNT, default=(4096, 16384))
@common.option("--layout", type=click.Choice(("tiled", "striped")), default="tiled")
@common.option("--max-error", default=1.0)
@common.option("--runs", "n_runs", type=common.COUNT, default=2)
def main(dem, extra, sizes, layout, max_error, n_runs, folder, out) -> None:
    """Run the measurement."""
    common.pin_to_cores()
    found: list[Row] = []
    for size in sizes:
        source = folder / f"mirrored-{size}-{layout}.tif"
        if not source.exists():
            places = dem.absolute(), source.absolute()
            common.call_elsewhere("benchmarks.rasters.make_mirrored", *places, size, layout)
        found += rows_of(source, (dem.stem, size, layout), n_runs, max_error, extra)
    common.write_rows(out, found)  # last, for it imports a lot


if __name__ == "__main__":
    main()
