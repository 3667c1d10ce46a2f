"""Costs of 10^11 samples in several formats: ``python -m benchmarks.country DEM``.

The raster is mirrored to a square, and what one thread takes for it is multiplied: `compress` with
its proof, making a COG (LERC_ZSTD, the same bound), and from the compressed file, by
``terrainwave tiles``, terrain-RGB tiles (.pmtiles, lossless WebP) and quantized-mesh tiles; then
reading all heights, of tiles those of the finest zoom. Meshes are not read back to heights. A first
view has 1024 x 1024 samples of full resolution in the middle: a file and a COG are opened and read
by http, and of tiles as many are counted as such a view can touch, each of the median size.
"""

import io
import sys
import time
from collections import namedtuple
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from math import inf
from pathlib import Path
from statistics import median

import numpy as np
import rasterio
from PIL import Image
from pmtiles.reader import MmapSource, all_tiles
from rasterio.windows import Window

import terrainwave
from benchmarks import common
from benchmarks.rasters import make_mirrored, write_cog, write_pair
from benchmarks.remote import SETTINGS, exchanges
from benchmarks.slow_server import SlowServer
from benchmarks.windows import READERS
from terrainwave.globe.tile_scheme import CELLS

SAMPLES, VIEWS, VIEW = 10**11, 10**6, 1024
# Of 10^11 samples: bytes, and hours of one processor; of a million first views: requests and bytes.
Row = namedtuple(
    "Row", "format raster max_error stored_gb write_hours read_hours million_requests sent_gb"
)


def seconds_of(call: Callable[[], object]) -> float:
    """Return the processor time of a call, the second time it is made."""
    call()
    start = time.process_time()
    call()
    return time.process_time() - start


def seconds_of_tiles(*arguments: object) -> float:
    """Return the processor time of ``terrainwave tiles``, the second time it runs."""
    words = [sys.executable, "-c", common.CLI, "tiles", *map(str, arguments)]
    words += ["--threads", "1", "--overwrite", "--quiet"]
    return [common.run_and_measure(words).cpu_seconds for _ in range(2)][-1]


def read_archive(images: list[bytes]) -> None:
    """Decode terrain-RGB images to heights."""
    for image in images:
        red, green, blue = np.asarray(Image.open(io.BytesIO(image)).convert("RGB"), np.float32).T
        red * 6553.6 + green * 25.6 + blue * 0.1 - 10000


def measure(dem: Path, size: int, bound: float, folder: Path) -> Iterator[Row]:
    """Yield the row of each format."""
    source, share = folder / f"{dem.stem}-{size}.tif", SAMPLES / size**2

    def row(name: str, n_bytes: int, write: float, read: float, n: int, sent: float) -> Row:
        all_samples = n_bytes * share / 1e9, write * share / 3600, read * share / 3600
        numbers = *all_samples, n * VIEWS / 1e6, sent * VIEWS / 1e9
        # What is not read takes nothing.
        return Row(name, dem.stem, bound, *(f"{one:.3g}" if one else "" for one in numbers))

    make_mirrored(dem, source, size)
    files = write_pair(source, folder / "country", bound)
    options = {"max_error": bound, "threads": 1, "overwrite": True}
    writes = {
        "terrainwave": partial(terrainwave.compress, source, files["terrainwave"], **options),
        "cog": partial(write_cog, source, files["cog"], bound),
    }
    corner, compressing = (size - VIEW) // 2, 0.0
    with rasterio.Env(**SETTINGS), SlowServer(folder, 0, inf) as server:
        for name, read in READERS.items():
            written, whole = seconds_of(writes[name]), seconds_of(partial(read, files[name]))
            view = Window(corner, corner, VIEW, VIEW)
            n, _, sent, *_ = exchanges(server, name, files[name].name, view)
            yield row(name, files[name].stat().st_size, written, whole, n, sent)
            compressing = written if name == "terrainwave" else compressing
    archive, meshes = folder / "country.pmtiles", folder / "meshes"
    tiling = seconds_of_tiles(files["terrainwave"], archive)
    with archive.open("rb") as file:
        found = list(all_tiles(MmapSource(file)))
    finest = max(zoom for (zoom, _, _), _ in found)
    images = [image for (zoom, _, _), image in found if zoom == finest]
    reading, views = seconds_of(partial(read_archive, images)), _of_view(map(len, images), 256)
    n_bytes = archive.stat().st_size
    yield row(
        "terrain-RGB tiles, by `terrainwave tiles`", n_bytes, compressing + tiling, reading, *views
    )
    tiling = seconds_of_tiles(files["terrainwave"], meshes)
    sizes = {path: path.stat().st_size for path in meshes.rglob("*.terrain")}
    finest = max(int(path.relative_to(meshes).parts[0]) for path in sizes)
    views = _of_view((sizes[path] for path in meshes.glob(f"{finest}/**/*.terrain")), CELLS)
    yield row(
        "quantized-mesh tiles, likewise", sum(sizes.values()), compressing + tiling, 0, *views
    )


def _of_view(sizes: Iterable[int], side: int) -> tuple[int, float]:
    """Return how many tiles of `side` samples a view can touch, and their bytes."""
    n = (-(-VIEW // side) + 1) ** 2
    return n, n * median(sizes)


@common.command("country.csv")
@common.dem_argument
@common.option("--size", type=common.COUNT, default=4096, help="Rows and columns.")
@common.option("--max-error", default=0.1)
def main(dem, size, max_error, folder, out) -> None:
    """Measure, print and write the CSV."""
    common.pin_to_cores()
    common.write_rows(out, measure(dem, size, max_error, folder))


if __name__ == "__main__":
    main()
