"""A planet in one file: ``python -m benchmarks.planet shared/data``.

A raster of 1,296,000 x 648,000 samples (one second of arc, EPSG:4326), or a part of it by
``--share``, as a VRT of 26,000 entries of 3600 x 3600: real tiles from the rasters of a directory
over all latitudes, some over each other, one across 180 degrees; one dense area; for the seas a
constant 0, a GeoTIFF whose blocks have no bytes; void elsewhere. The real heights do not lie where
they were measured: what counts is how many there are, and where.

Every stage is a process of its own with two threads. `window` rows open the file, and read 512 x
512 samples of the finest level and of every level by an open file, from disk and from a server on
this machine, whose requests are counted, and the rounds of them: those that are out at the same
time. `orbit` is a picture of the whole, `low` one from 9000 m, `low 192` the same with `--memory
192`, `ground` from 100 m above the ground. `first picture` opens what `publish` made in Chromium
(`benchmarks.first_picture`). `levels` is the part of `compress` before the first unit is coded,
with the most bytes that its temporary files had on the disk. `verify original` compares with the
VRT. `decompress` writes the full grid of an 8th of the planet or less, else the finest level that
is as small.
"""

import shutil
import subprocess
import sys
import threading
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click

from benchmarks import common
from benchmarks.slow_server import SlowServer, total

DEGREE = 3600
N_ENTRIES, N_TILES = 26_000, 200
TILE = 1201
THREADS = "2"
# West, east, south and north of the seas, in degrees: as much of them as entries are left for.
SEAS = (
    (-180, -125, -60, 60), (150, 180, -60, 50), (-60, -15, -60, 60), (50, 110, -60, 0),
    (110, 150, -60, -40), (-15, 20, -60, -35), (20, 50, -60, -40), (-125, -80, -60, -10),
    (-180, 180, 75, 85),
)  # fmt: skip
# Where the dense area begins: north-west of it, in degrees.
DENSE = (60.0, 60.0)
STAGES = (
    "compress", "verify", "verify original", "window", "mesh", "tiles", "publish", "first picture",
    "orbit", "low", "low 192", "ground", "decompress", "levels",
)  # fmt: skip
# The part of rows and columns that is decompressed; seconds of a round trip to the server, and bits
# a second to the page.
DECOMPRESSED, LATENCY, BITS = 8, 0.05, 20e6

_WINDOWS = """
import sys
import terrainwave
with terrainwave.open(sys.argv[1], threads=2) as terrain:
    for level in range(terrain.n_levels):
        scale = 2 ** (terrain.n_levels - 1 - level)
        row, col = (int(text) // scale for text in sys.argv[2:4])
        shape = terrain.level_shape(level)
        row, col = (max(min(n, size - 512), 0) for n, size in zip((row, col), shape))
        terrain.read((row, col, min(512, shape[0]), min(512, shape[1])), level=level)
"""
_OPEN = """
import sys
import terrainwave
terrainwave.open(sys.argv[1]).close()
"""
_FINEST = """
import sys
import terrainwave
with terrainwave.open(sys.argv[1], threads=2) as terrain:
    terrain.read((*map(int, sys.argv[2:4]), 512, 512))
"""
WINDOWS = {"open": _OPEN, "finest": _FINEST, "levels": _WINDOWS}
_GROUND = """
import sys
import terrainwave
from terrainwave.cli import main
twz, lon, lat, above, view, *more = sys.argv[1:]
with terrainwave.open(twz) as terrain:
    height = terrain.sample([(float(lon), float(lat))])[0] + float(above)
main(["render", twz, *more, "--camera", f"{lon},{lat},{height},{view}"])
"""
_LEVELS = """
import sys
import terrainwave
def stop(progress):
    if progress.stage == "encoding":
        sys.exit()
tif, twz, temporary = sys.argv[1:]
terrainwave.compress(tif, twz, max_error=1, threads=2, temp_dir=temporary, progress=stop)
"""
_FIRST_PICTURE = """
import sys
from pathlib import Path
from benchmarks.first_picture import WATCH, first_picture
from ext.browser import chromium
with chromium() as driver:
    driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WATCH})
    print(*first_picture(driver, Path(sys.argv[1]), *map(float, sys.argv[2:])))
"""

# One line of the CSV.
Row = namedtuple(
    "Row", "share dense stage n_samples seconds cpu_seconds peak_mib requests rounds n_bytes"
)


def make(data: str | Path, folder: str | Path, share: int, dense: int) -> None:
    """Write the rasters and the VRT that names them."""
    import numpy as np
    import rasterio

    from benchmarks.rasters import make_mirrored

    profile = {
        "driver": "GTiff", "count": 1, "dtype": "int16", "tiled": True, "blockxsize": 256,
        "blockysize": 256, "compress": "deflate",
    }  # fmt: skip
    names, data, folder = [], Path(data), Path(folder)
    for path in sorted(data.glob("*.tif")):
        with rasterio.open(path) as dataset:
            heights = dataset.read(1, out_dtype="float64", masked=True).filled(-32768)
        heights = np.clip(np.rint(heights[:TILE, :TILE]), -32768, 9000).astype(np.int16)
        shape = {"height": heights.shape[0], "width": heights.shape[1]}
        with rasterio.open(folder / path.name, "w", **profile, **shape) as sink:
            sink.write(heights, 1)
        names.append((path.name, *heights.shape))
    sea = {"height": DEGREE, "width": DEGREE, "SPARSE_OK": True}
    rasterio.open(folder / "sea.tif", "w", **profile, **sea).close()
    moon = next(data.glob("moon*.tif"))
    make_mirrored(moon, folder / "dense.tif", dense)
    text = "".join(_entries(names, share, dense))
    n_rows, n_cols = 180 * DEGREE // share, 360 * DEGREE // share
    (folder / "planet.vrt").write_text(
        f'<VRTDataset rasterXSize="{n_cols}" rasterYSize="{n_rows}"><SRS>EPSG:4326</SRS>'
        f"<GeoTransform>-180,{1 / DEGREE * share!r},0,90,0,{-1 / DEGREE * share!r}</GeoTransform>"
        '<VRTRasterBand dataType="Int16" band="1"><NoDataValue>-32768</NoDataValue>'
        f"{text}</VRTRasterBand></VRTDataset>"
    )


def _entries(names: list[tuple[str, int, int]], share: int, dense: int) -> Iterator[str]:
    """Yield the sources of the VRT, the seas first: what overlaps them lies above."""
    from benchmarks.rasters import vrt_source

    side = DEGREE // share
    cells = [
        (90 - north, 180 + west)
        for first_lon, last_lon, first_lat, last_lat in SEAS
        for west in range(first_lon, last_lon)
        for north in range(first_lat + 1, last_lat + 1)
    ]
    for row, col in cells[: N_ENTRIES - N_TILES - 2]:
        yield vrt_source("sea.tif", (0, 0, side, side), row * side, col * side)
    n_tiles = max(N_TILES // share**2, 12)
    n_rows, n_cols = 180 * side, 360 * side
    for number in range(n_tiles):
        name, height, width = names[number % len(names)]
        row = (n_rows - height) * number // (n_tiles - 1)
        col = (n_cols - width) * (number * 89 % n_tiles) // n_tiles
        yield vrt_source(name, (0, 0, height, width), row, col)
        if number % 10 == 0:  # over the one before, by half
            row = min(row + height // 2, n_rows - height)
            yield vrt_source(name, (0, 0, height, width), row, col + width // 2)
    name, height, width = names[0]
    half, row = width // 2, n_rows // 3
    yield vrt_source(name, (0, 0, height, half), row, n_cols - half)
    yield vrt_source(name, (0, half, height, width - half), row, 0)
    row, col = dense_place(share)
    yield vrt_source("dense.tif", (0, 0, dense, dense), row, col)


def dense_place(share: int) -> tuple[int, int]:
    """Return the row and column at which the dense area begins."""
    north, west = DENSE
    return int((90 - north) * DEGREE / share), int((180 + west) * DEGREE / share)


def commands(folder: Path, share: int) -> dict[str, list[str]]:
    """Return the command of every stage that is one."""
    row, col = (place + 1000 for place in dense_place(share))
    twz, tif = str(folder / "planet.twz"), str(folder / "planet.vrt")
    common_options = ["--overwrite", "--quiet", "--threads", THREADS]
    lat, lon = (90 - row / DEGREE * share), (col / DEGREE * share - 180)
    window = ["--window", f"{row},{col},2048,2048"]
    picture = [str(folder / "picture.png"), *common_options]
    level = ["--level", str(-1 - _n_coarser(share))]
    low = ["--camera", f"{lon},{lat},9000,135,-30,60"]
    found = {
        "compress": ["compress", tif, twz, "--max-error", "1", *common_options],
        "verify": ["verify", twz, "--quiet", "--threads", THREADS],
        "verify original": ["verify", twz, tif, "--quiet", "--threads", THREADS],
        "mesh": ["mesh", twz, str(folder / "planet.ply"), *window, *common_options],
        "tiles": ["tiles", twz, str(folder / "tiles"), "--max-zoom", "4", *common_options],
        "publish": ["publish", twz, str(folder / "site"), "--overwrite", "--quiet"],
        "orbit": ["render", twz, *picture],
        "low": ["render", twz, *picture, *low],
        "low 192": ["render", twz, *picture, *low, "--memory", "192"],
        "decompress": ["decompress", twz, str(folder / "back.tif"), *common_options, *level],
    }
    ground = [twz, str(lon), str(lat), "100", "135,-10,60", *picture]
    return {
        stage: [sys.executable, "-c", common.CLI, *arguments] for stage, arguments in found.items()
    } | {"ground": [sys.executable, "-c", _GROUND, *ground]}


def _n_coarser(share: int) -> int:
    """Return how many levels above the full grid the one lies that is decompressed."""
    return max(DECOMPRESSED.bit_length() - share.bit_length(), 0)


def measured(data: Path, folder: Path, share: int, dense: int, stages: list[str]) -> Iterator[Row]:
    """Yield the rows of all stages; a file that is there is used."""
    if not (folder / "planet.vrt").exists():
        common.call_elsewhere("benchmarks.planet.make", data, folder, share, dense)
    n_samples = 180 * 360 * DEGREE**2 // share**2
    twz = folder / "planet.twz"
    every = commands(folder, share)
    for stage in stages:
        if stage == "window":
            yield from _window_rows(folder, share, dense)
            continue
        if stage in ("first picture", "levels"):
            row_of = _levels_row if stage == "levels" else _first_picture_row
            yield row_of(folder, share, dense)
            continue
        used = common.run_and_measure(every[stage])
        n = n_samples >> 2 * _n_coarser(share) if stage == "decompress" else n_samples
        yield Row(share, dense, stage, n, *map(_rounded, used), 0, 0, twz.stat().st_size)


def _window_rows(folder: Path, share: int, dense: int) -> Iterator[Row]:
    row, col = (str(place + 1000) for place in dense_place(share))
    path = str(folder / "planet.twz")
    for name, code in WINDOWS.items():
        command = [sys.executable, "-c", code]
        n_samples = 0 if name == "open" else 512**2
        used = common.run_and_measure([*command, path, row, col])
        yield Row(share, dense, f"{name} disk", n_samples, *map(_rounded, used), 0, 0, 0)
        with SlowServer(folder, LATENCY, float("inf")) as server:
            used = common.run_and_measure([*command, server.url("planet.twz"), row, col])
        counts = total(server.log)
        yield Row(share, dense, f"{name} http", n_samples, *map(_rounded, used), *counts)


def _levels_row(folder: Path, share: int, dense: int) -> Row:
    """Make all levels, in a folder that is looked at every second; no file comes of it."""
    temporary, ended, most = folder / "temporary", threading.Event(), 0
    temporary.mkdir()

    def look() -> None:
        nonlocal most
        while not ended.wait(1):
            most = max(most, sum(map(_on_disk, temporary.rglob("*"))))

    thread = threading.Thread(target=look)
    thread.start()
    places = [str(folder / name) for name in ("planet.vrt", "levels.twz", "temporary")]
    try:
        used = common.run_and_measure([sys.executable, "-c", _LEVELS, *places])
    finally:
        ended.set()
        thread.join()
        shutil.rmtree(temporary)
    n_samples = 180 * 360 * DEGREE**2 // share**2
    return Row(share, dense, "levels", n_samples, *map(_rounded, used), 0, 0, most)


def _on_disk(path: Path) -> int:
    try:
        return path.stat().st_blocks * 512
    except FileNotFoundError:  # given up meanwhile
        return 0


def _first_picture_row(folder: Path, share: int, dense: int) -> Row:
    """Open the published page in a browser, whose processor time and memory are not known."""
    arguments = [str(folder / "site"), str(LATENCY), str(BITS)]
    command = [sys.executable, "-c", _FIRST_PICTURE, *arguments]
    told = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.split()
    n_requests, n_bytes, _paint, seconds = map(float, told)
    counts = int(n_requests), 0, int(n_bytes)
    return Row(share, dense, "first picture", 0, _rounded(seconds), 0, 0, *counts)


def _rounded(number: float) -> float:
    return round(number, 2)


@common.command("planet.csv")
@click.argument("data", type=click.Path(path_type=Path, exists=True, file_okay=False))
@common.option("--share", type=click.IntRange(min=1), default=1, help="1: the planet; 8: an 8th.")
@common.option("--dense", type=click.IntRange(min=4096), default=65536)
@common.choices_option("--stages", of=STAGES)
@common.option("--append", is_flag=True, help="Keep the rows of other parts and stages.")
def main(data, share, dense, stages, append, folder, out) -> None:
    """Run the measurement."""
    if append:  # what is measured again goes
        windows = {f"{name} {place}" for name in WINDOWS for place in ("disk", "http")}
        gone = {*stages} | (windows if "window" in stages else set())
        common.keep_rows(out, lambda row: row["share"] != share or row["stage"] not in gone)
    rows = measured(data.absolute(), folder.absolute(), share, dense, stages)
    common.write_rows(out, rows, append=append)


if __name__ == "__main__":
    main()
