"""The reader in JavaScript beside Python, on real rasters, each compressed with every bound.

``python -m benchmarks.against_python compare PLACES``: equal bits of all levels and methods, in
Node and in Chromium. ``… speed PLACES``: processor time of both and of geotiff.js, in turns, for
the methods rapid and predictive. The latter needs ``npm install --prefix js/testing
--no-package-lock``, the former Chromium and chromedriver.

`speed` opens files that are in memory and reads all of them, or a window of 512 x 512 samples
anywhere, by one thread on one core: our files in Node and in Python, and in Node with geotiff.js
and its LERC decoder the COG (LERC_ZSTD, blocks of 512, overviews, the same bound) that GDAL makes
of the same GeoTIFF. What each gives is compared with what Python, or GDAL, reads of that file.
"""

import statistics
import sys
import time
from collections import namedtuple
from collections.abc import Iterable, Iterator
from pathlib import Path

import click
import rasterio
from rasterio.windows import Window

import terrainwave
from benchmarks import common
from benchmarks.javascript import JS, node, seconds_of, windows_of
from benchmarks.rasters import write_cog
from benchmarks.slow_server import SlowServer
from terrainwave.names import METHODS

TIMED = ("rapid", "predictive")
N_ROUNDS = 5
N_WARM = 3  # rounds that don't count: both compile
SIDES = {"whole": None, "512²": 512}

# Milliseconds of processor time: medians, and the most.
Row = namedtuple(
    "Row",
    "raster max_error method n_samples what python_ms node_ms geotiff_ms python_most_ms "
    "node_most_ms geotiff_most_ms speed_over_python time_over_geotiff n_runs",
)
READ = """
    const [name, done] = arguments;
    Promise.all([import("/js/src/index.js"), import("/js/testing/levels.js")])
      .then(async ([{ open }, { digests }]) => digests(await open(`/${name}`)))
      .then(done, (error) => done(String(error)));
"""


def make_files(
    rasters: Iterable[Path], bounds: Iterable[float], methods: Iterable[str], folder: Path
) -> Iterator[tuple[Path, float, str, Path]]:
    """Yield a raster, bound and method with their file; what a method refuses is printed."""
    for raster in rasters:
        for bound in bounds:
            for method in methods:
                made = folder / f"{raster.stem}-{bound:g}-{method}.twz"
                try:
                    if not made.exists():
                        terrainwave.compress(raster, made, max_error=bound, method=method)
                except terrainwave.TerrainwaveError as error:
                    print(f"{made.name} is left out: {error}")
                    continue
                yield raster, bound, method, made


def compare(rasters: list[Path], bounds: list[float], folder: Path) -> int:
    """Print a table; return how many files are read otherwise than by Python."""
    sys.path.insert(0, str(common.ROOT / "tests"))
    from ext.browser import chromium
    from golden_files import digests

    (folder / "js").symlink_to(JS)
    n_wrong = 0
    print(f"{'file':65} levels  Node   Chromium")
    with node() as ask, SlowServer(folder, 0, 0) as server, chromium() as driver:
        driver.set_script_timeout(600)
        driver.get(server.url("js/package.json"))
        for *_, path in make_files(rasters, bounds, METHODS, folder):
            expected = digests(path)
            read = (
                ask({"what": "digests", "path": str(path)}),
                driver.execute_async_script(READ, path.name),
            )
            n_wrong += any(found != expected for found in read)
            words = ["equal" if found == expected else "WRONG" for found in read]
            print(f"{path.name:65} {len(expected):6}  {words[0]}  {words[1]}", flush=True)
    print(f"{n_wrong} files differ")
    return n_wrong


def seconds_of_python(data: bytes, window: Window) -> float:
    """Return the processor time of opening a file and reading it by one thread."""
    before = time.process_time()
    with terrainwave.open(data, threads=1, native=False) as terrain:
        terrain.read((window.row_off, window.col_off, window.height, window.width))
    return time.process_time() - before


def speed_rows(rasters: list[Path], bounds: list[float], folder: Path) -> Iterator[Row]:
    """Yield the rows of all files: all of each, and windows of those that are large enough."""
    n_warm = 4 * N_WARM  # engines of JavaScript take longer to begin with
    with node() as ask:
        for raster, bound, method, path in make_files(rasters, bounds, TIMED, folder):
            cog = folder / f"{raster.stem}-{bound:g}-cog.tif"
            if not cog.exists():
                write_cog(raster, cog, bound)
            with rasterio.open(cog) as dataset:
                shape = dataset.shape
            for what, side in SIDES.items():
                if side and min(shape) < side:
                    continue
                found = [
                    (
                        seconds_of_python(path.read_bytes(), window),
                        *(
                            seconds_of(
                                ask, one, window, 0, {"path": str(one), "clock": "processor"}
                            )
                            for one in (path, cog)
                        ),
                    )
                    for window in windows_of(shape, side, n_warm + N_ROUNDS)
                ]
                columns = list(zip(*found[n_warm:], strict=True))
                python, script, peer = map(statistics.median, columns)
                numbers = [python, script, peer, *map(max, columns)]
                yield Row(
                    raster.stem, bound, method, shape[0] * shape[1], what,
                    *(round(1000 * number, 2) for number in numbers),
                    round(python / script, 3), round(script / peer, 3), N_ROUNDS,
                )  # fmt: skip
            n_warm = N_WARM


def speed(rasters: list[Path], bounds: list[float], folder: Path, out: Path) -> int:
    """Write a CSV of times and print it; return how many are below 0.7 of Python's speed."""
    common.pin_to_cores()
    rows = common.write_rows(out, speed_rows(rasters, bounds, folder))
    for method, what in sorted({(row.method, row.what) for row in rows}):
        for field in ("speed_over_python", "time_over_geotiff"):
            own = [row for row in rows if (row.method, row.what) == (method, what)]
            ratios = [getattr(row, field) for row in own]
            middle = statistics.median(ratios)
            print(f"{method}, {what}: {field} {min(ratios)} to {max(ratios)}, median {middle:.3f}")
    return sum(row.speed_over_python < 0.7 for row in rows if row.what == "whole")


@common.command("javascript.csv")
@click.argument("what", type=click.Choice(["compare", "speed"]))
@common.rasters_argument
@common.bounds_option(0, 1)
def main(what, paths, bounds, folder, out) -> None:
    """Do one of the two; the exit status is 1 where a file differs, or Python is much faster."""
    found = (
        compare(paths, bounds, folder) if what == "compare" else speed(paths, bounds, folder, out)
    )
    sys.exit(min(found, 1))


if __name__ == "__main__":
    main()
