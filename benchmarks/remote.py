"""What windows over http take beside a COG: ``python -m benchmarks.remote dem.tif --work DIR``.

The raster is mirrored to 16384 x 16384 samples and compressed, once; GDAL makes a COG (LERC_ZSTD,
blocks of 512, overviews, the same bound) of the same GeoTIFF, and rasterio reads it by /vsicurl/
with what GDAL documents for COGs (`SETTINGS`). A local server answers ranges after a delay, as a
distant one would, and notes when each request was in flight. Random windows are read, and the one
in the centre, where four segments meet. Each is opened, read and closed in a process forked for it,
in turns: no connection, header or cache is at hand on either side.
"""

import multiprocessing
import time
from collections import namedtuple
from collections.abc import Iterator
from math import inf
from pathlib import Path
from statistics import median

import click
import numpy as np
import rasterio
from rasterio.windows import Window

from benchmarks import common
from benchmarks.rasters import load_raster, mirrored_file, write_cog
from benchmarks.slow_server import SlowServer, total
from benchmarks.windows import read_cog, read_terrain

_SEED = 20260101

# A statistic of each number by itself, over all windows; seconds on the wall and of the reader's
# processor.
Row = namedtuple(
    "Row",
    "reader raster max_error window n_windows delay_s file_bytes statistic requests rounds bytes "
    "seconds cpu_seconds",
)
# What GDAL documents for COGs over http; without its HEAD request windows took longer.
SETTINGS = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".tif",
    "GDAL_INGESTED_BYTES_AT_OPEN": "32768",
    "GDAL_HTTP_MERGE_CONSECUTIVE_RANGES": "YES",
    "VSI_CACHE": "TRUE",
}
READERS = {"terrainwave": read_terrain, "cog": read_cog}


def timed_read(reader: str, address: str, window: Window) -> tuple[float, float]:
    """Return what it takes to open a file, read a window and close it: wall clock, processor."""
    start, cpu_start = time.perf_counter(), time.process_time()
    READERS[reader](address, window)
    return time.perf_counter() - start, time.process_time() - cpu_start


def exchanges(server: SlowServer, reader: str, name: str, window: Window) -> tuple:
    """Return requests, rounds, bytes and seconds of a window read in a process of its own."""
    n_before = len(server.log)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        seconds = pool.apply(timed_read, (reader, server.url(name), window))
    return *total(server.log[n_before:]), *seconds


def measure(path: Path, source: Path, windows, delay: float, max_error: float) -> Iterator[Row]:
    """Yield centre, median and worst of both readers; `source` is what `path` was made of."""
    files = {"terrainwave": path, "cog": path.with_suffix(".cog.tif")}
    if not files["cog"].exists():
        write_cog(source, files["cog"], max_error)
    found: dict[str, list[tuple]] = {reader: [] for reader in READERS}
    with rasterio.Env(**SETTINGS), SlowServer(path.parent, delay, inf) as server:
        for window in windows:
            original = load_raster(source, window=window).heights.astype(np.float64)
            for reader, read in READERS.items():  # off the clock; kernels get warm, too
                if np.abs(read(files[reader], window) - original).max() > max_error:
                    raise click.ClickException(f"{reader} broke the bound in {window}")
            for reader, costs in found.items():
                costs.append(exchanges(server, reader, files[reader].name, window))
    statistics = {"centre": lambda column: column[0], "median": median, "worst": max}
    for reader, costs in found.items():
        head = reader, source.stem, max_error, windows[0].height, len(windows), delay
        for name, statistic in statistics.items():
            numbers = (round(statistic(column), 4) for column in zip(*costs, strict=True))
            yield Row(*head, files[reader].stat().st_size, name, *numbers)


def windows_of(size: int, side: int, n_windows: int) -> list[Window]:
    """Return the window in the centre and random ones, `n_windows` in all."""
    places = np.random.default_rng(_SEED).integers(0, size - side + 1, (n_windows - 1, 2))
    corners = [((size - side) // 2,) * 2, *places.tolist()]
    return [Window(col, row, side, side) for row, col in corners]


@common.command("remote_cog.csv")
@common.dem_argument
@common.option("--size", type=common.COUNT, default=16384, help="Rows and columns.")
@common.option("--max-error", default=1.0)
@common.option("--window", "side", type=common.COUNT, default=512)
@common.option("--windows", "n_windows", type=common.COUNT, default=100)
@common.option("--delay", default=0.05, help="Seconds per request.")
def main(dem, size, max_error, side, n_windows, delay, folder, out) -> None:
    """Measure, print and write the CSV."""
    path = mirrored_file(dem, size, folder, max_error=max_error, mesh="none", threads=2)
    source, windows = folder / f"{dem.stem}-{size}.tif", windows_of(size, side, n_windows)
    common.write_rows(out, measure(path, source, windows, delay, max_error))


if __name__ == "__main__":
    main()
