"""The GDAL driver beside a COG and numba: ``python -m benchmarks.gdal_driver DATA --plugin DIR``.

GDAL is the system's, in its own Python, and finds the driver where ``--plugin`` names the folder
(`make native-driver`). The COG is that GDAL's: LERC_ZSTD with the same bound, blocks of 512,
overviews. Whole reads of a dataset just opened, by one thread into an array that is there: in
turns, processor nanoseconds per sample, medians. Then opening, and a window of 512 x 512 samples in
the raster's middle, where most units meet, of a dataset just opened; the first pixel, by
`gdallocationinfo`, whose whole process counts: processor time, too. Requests and seconds on the
wall of that window over http with 50 ms, in a process of its own. `Terrain.read` by one thread is
measured in this Python, its kernels warm.

``--requests``: into ``window_requests.csv``, no times, but the requests and bytes of 40 windows
over http, the one in the middle and random ones, by this GDAL of the COG, by the driver, by Python
and by JavaScript (Node): each by a dataset just opened, then all by one. GDAL opens by two
requests, as it first asks for the size.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Callable, Iterator
from math import inf
from pathlib import Path

import click
import numpy as np
import rasterio

import terrainwave
from benchmarks import common
from benchmarks.slow_server import SlowServer, total

# Processor time, medians: nanoseconds per sample, milliseconds, seconds; `http_s` is on the wall.
Reader = namedtuple(
    "Reader", "bytes whole_ns whole_ns_least open_ms window_ms first_pixel_s requests http_s"
)
Row = namedtuple(
    "Row", "raster max_error gdal n_samples n_runs reader " + " ".join(Reader._fields)
)  # fmt: skip
# Requests and bytes: of opening, of a window of a file just opened, of one of a file already read.
Counts = namedtuple(
    "Counts",
    "raster max_error reader file_bytes n_windows open_most first_median first_worst later_median"
    " later_worst bytes_median bytes_worst later_bytes_median later_bytes_worst",
)
SYSTEM_PYTHON = "/usr/bin/python3"
N_WINDOWS = 40
SEED = 20260101
DELAY = 0.05
SIDE = 512
OF_THIS_PYTHON = {"PYTHONPATH", "PYTHONHOME", "LD_LIBRARY_PATH", "PYTHONWARNINGS"}
# As a program of C++ would: a dataset is opened, and its heights are read into an array.
WORKER = """
import json, sys, time
import numpy as np
from osgeo import gdal
gdal.UseExceptions()
paths, n_runs, box = json.loads(sys.argv[1])
found = {path: {"cpu": [], "open": [], "window": []} for path in paths}
for _ in range(n_runs):
    for path in paths:
        dataset = gdal.Open(path)
        band = dataset.GetRasterBand(1)
        heights = np.zeros((band.YSize, band.XSize), gdal.GetDataTypeName(band.DataType).lower())
        start = time.process_time()
        band.ReadAsArray(buf_obj=heights)
        found[path]["cpu"].append(time.process_time() - start)
        del band, dataset
for _ in range(n_runs):
    for path in paths:
        start = time.process_time()
        dataset = gdal.Open(path)
        opened = time.process_time()
        dataset.ReadAsArray(*box)
        found[path]["open"].append(opened - start)
        found[path]["window"].append(time.process_time() - opened)
        del dataset
print(json.dumps([gdal.VersionInfo("RELEASE_NAME"), found]))
"""
WINDOW = """
import json, sys
from osgeo import gdal
gdal.UseExceptions()
path, box = json.loads(sys.argv[1])
gdal.Open(path).ReadAsArray(*box)
"""

# Prints a line after each opening and after each window, and goes on when it gets one.
GDAL_STEPS = """
import json, sys
from osgeo import gdal
gdal.UseExceptions()
path, boxes, is_same = json.loads(sys.argv[1])
def step():
    print(flush=True)
    sys.stdin.readline()
dataset = None
for box in boxes:
    if dataset is None or not is_same:
        dataset = None
        gdal.VSICurlClearCache()
        dataset = gdal.Open(path)
    step()
    dataset.ReadAsArray(*box)
    step()
"""
NODE_STEPS = """
import { createInterface } from "node:readline";
const { open } = await import(process.argv[1]);
const [url, boxes, isSame] = JSON.parse(process.argv[2]);
const lines = createInterface({ input: process.stdin })[Symbol.asyncIterator]();
const step = () => { console.log(); return lines.next(); };
let terrain = null;
for (const [col, row, nCols, nRows] of boxes) {
  if (!terrain || !isSame) terrain = await open(url, { workers: 0 });
  await step();
  await terrain.read(-1, { row, col, nRows, nCols });
  await step();
}
process.exit(0);
"""


def environment_of(plugin: Path) -> dict[str, str]:
    """Return the variables of the system's programs."""
    kept = {name: value for name, value in os.environ.items() if name not in OF_THIS_PYTHON}
    return kept | {
        "GDAL_DRIVER_PATH": str(plugin),
        "GDAL_NUM_THREADS": "1",
        "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    }


def run(environment: dict[str, str], *command: object) -> str:
    """Run one of the system's programs; return what it prints."""
    ended = subprocess.run(
        list(map(str, command)), env=environment, capture_output=True, text=True, check=False
    )
    if ended.returncode:
        raise click.ClickException(ended.stderr.strip()[-500:])
    return ended.stdout


def first_pixel(environment: dict[str, str], path: Path, n_runs: int) -> float:
    """Return the seconds of a process that tells one height."""
    seconds = []
    for _ in range(n_runs):
        before = os.times()
        run(environment, "gdallocationinfo", "-valonly", path, SIDE // 2, SIDE // 2)
        after = os.times()
        seconds.append(after.children_user + after.children_system - sum(before[2:4]))
    return statistics.median(seconds)


def over_http(path: Path, read: Callable[[str], object]) -> tuple[int, float]:
    """Return requests and seconds of a read of a file's address."""
    with SlowServer(path.parent, DELAY, inf) as server:
        read(server.url(path.name))
        return server.n_requests, server.log[-1].end - server.log[0].start


def terrain_reader(path: Path, box: list[int], n_runs: int) -> Reader:
    """Return what `Terrain` takes, kernels warm, by one thread."""
    column, row, width, height = box
    times, clock = [], time.process_time
    for _ in range(n_runs + 1):
        start = clock()
        with terrainwave.open(path, threads=1) as terrain:
            opened = clock()
            terrain.read((row, column, height, width))
            read = clock()
        with terrainwave.open(path, threads=1) as terrain:
            cpu = clock()
            ns = 1e9 / terrain.read().size * (clock() - cpu)
        times.append((ns, 1e3 * (opened - start), 1e3 * (read - opened)))
    whole, *others = zip(*times[1:], strict=True)  # the first run may have compiled

    def window(url: str) -> None:
        with terrainwave.open(url) as terrain:
            terrain.read((row, column, height, width))

    medians = statistics.median(whole), min(whole), *map(statistics.median, others)
    return Reader(path.stat().st_size, *medians, 0.0, *over_http(path, window))


def steps_of(environment: dict[str, str], *command: object) -> Iterator[None]:
    """Yield after each step of a program, which goes on with the next one."""
    with subprocess.Popen(
        list(map(str, command)), env=environment, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as program:  # fmt: skip
        assert program.stdin is not None
        assert program.stdout is not None
        for _ in program.stdout:
            yield
            program.stdin.write("\n")
            program.stdin.flush()
    if program.returncode:
        raise click.ClickException(f"{command[0]} ended with status {program.returncode}")


def steps_of_terrain(url: str, boxes: list[list[int]], is_same: bool) -> Iterator[None]:
    """Yield after each opening and each window."""
    terrain = terrainwave.open(url)
    for number, (column, row, width, height) in enumerate(boxes):
        if number and not is_same:
            terrain.close()
            terrain = terrainwave.open(url)
        yield
        terrain.read((row, column, height, width))
        yield
    terrain.close()


def counted(server: SlowServer, steps: Iterator[None]) -> np.ndarray:
    """Return requests and bytes, (window, of opening and of reading, 2)."""
    found, n_before = [], len(server.log)
    for _ in steps:
        log, n_before = server.log[n_before:], len(server.log)
        found.append(total(log)[::2])
    return np.array(found).reshape(-1, 2, 2)


def boxes_of(n_rows: int, n_cols: int) -> list[list[int]]:
    """Return the window in the middle and random ones: column, row, width, height."""
    width, height = min(SIDE, n_cols), min(SIDE, n_rows)
    rng = np.random.default_rng(SEED)
    columns = rng.integers(0, n_cols - width + 1, N_WINDOWS - 1).tolist()
    rows = rng.integers(0, n_rows - height + 1, N_WINDOWS - 1).tolist()
    places = [((n_cols - width) // 2, (n_rows - height) // 2), *zip(columns, rows, strict=True)]
    return [[column, row, width, height] for column, row in places]


def count_requests(paths, bounds, plugin: Path, folder: Path) -> Iterator[Counts]:
    """Yield what windows over http take of each reader for each raster and bound."""
    environment = environment_of(plugin)
    readers: dict[str, Callable[[str, list, bool], Iterator[None]]] = {
        reader: lambda url, *rest: steps_of(
            environment, SYSTEM_PYTHON, "-c", GDAL_STEPS, json.dumps([f"/vsicurl/{url}", *rest])
        )
        for reader in ("cog", "driver")
    }
    readers["python"] = steps_of_terrain
    module = common.ROOT / "js" / "src" / "index.js"
    readers["javascript"] = lambda *asked: steps_of(
        dict(os.environ), "node", "--input-type=module", "-e", NODE_STEPS, module, json.dumps(asked)
    )
    for raster in paths:
        with rasterio.open(raster) as source:
            boxes = boxes_of(*source.shape)
        for bound in bounds:
            file, cog = files_of(raster, bound, environment, folder)
            with SlowServer(folder, 0.0, inf) as server:
                for reader, steps in readers.items():
                    path = cog if reader == "cog" else file
                    of_first, of_later = (
                        counted(server, steps(server.url(path.name), boxes, is_same))
                        for is_same in (False, True)
                    )
                    first, later = of_first[:, 1], of_later[1:, 1]
                    of_all = [
                        round(float(statistic(found[:, i])), 1)
                        for i in (0, 1)
                        for found in (first, later)
                        for statistic in (np.median, np.max)
                    ]
                    head = raster.stem, bound, reader, path.stat().st_size, len(boxes)
                    yield Counts(*head, int(of_first[:, 0, 0].max()), *of_all)


def files_of(raster: Path, bound: float, environment: dict, folder: Path) -> tuple[Path, Path]:
    """Return a raster's .twz file and its COG, made if they are not there."""
    name = f"{raster.stem}-{bound:g}"
    file, cog = folder / f"{name}.twz", folder / f"{name}.cog.tif"
    if not file.exists():
        terrainwave.compress(raster, file, max_error=bound, method="rapid", mesh="none")
    if not cog.exists():
        run(
            environment, "gdal_translate", "-q", "-of", "COG", "-co", "COMPRESS=LERC_ZSTD",
            "-co", f"MAX_Z_ERROR={bound}", "-co", "BLOCKSIZE=512", raster, cog,
        )  # fmt: skip
    return file, cog


def measure(paths, bounds, plugin: Path, n_runs: int, folder: Path) -> Iterator[Row]:
    """Yield a row of each reader for each raster and bound."""
    environment = environment_of(plugin)
    for raster in paths:
        with rasterio.open(raster) as source:
            n_rows, n_cols = source.shape
        side = min(SIDE, n_rows, n_cols)
        box = [(n_cols - side) // 2, (n_rows - side) // 2, side, side]
        for bound in bounds:
            file, cog = files_of(raster, bound, environment, folder)
            files = {"driver": file, "cog": cog}
            asked = json.dumps([list(map(str, files.values())), n_runs, box])
            gdal, found = json.loads(run(environment, SYSTEM_PYTHON, "-c", WORKER, asked))
            head = raster.stem, bound, gdal, n_rows * n_cols, n_runs

            def window(url: str, box=box) -> None:
                asked = json.dumps([f"/vsicurl/{url}", box])
                run(environment, SYSTEM_PYTHON, "-c", WINDOW, asked)

            for reader, path in files.items():
                seconds = found[str(path)]
                ns = [one / (n_rows * n_cols) * 1e9 for one in seconds["cpu"]]
                yield _row(
                    head, reader, path.stat().st_size, statistics.median(ns), min(ns),
                    statistics.median(seconds["open"]) * 1e3,
                    statistics.median(seconds["window"]) * 1e3,
                    first_pixel(environment, path, n_runs), *over_http(path, window),
                )  # fmt: skip
            yield _row(head, "numba", *terrain_reader(file, box, n_runs))


def _row(head: tuple, reader: str, *values: float) -> Row:
    return Row(*head, reader, *(round(value, 4) for value in values))


@common.command("gdal_driver.csv")
@common.rasters_argument
@common.bounds_option(1, 10)
@click.option("--plugin", type=common.FILE, required=True, help="The folder with gdal_TWZ.so.")
@common.option("--runs", type=common.COUNT, default=9)
@click.option("--requests", "are_counted", is_flag=True, help="Into window_requests.csv.")
def main(paths, bounds, plugin, runs, are_counted, folder, out) -> None:
    """Measure the driver."""
    if are_counted:
        rows = count_requests(paths, bounds, plugin, folder)
        common.write_rows(out.with_name("window_requests.csv"), rows)
        return
    common.write_rows(out, measure(paths, bounds, plugin, runs, folder))


if __name__ == "__main__":
    main()
    sys.exit(0)
