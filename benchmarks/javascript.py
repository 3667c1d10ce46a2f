"""terrainwave beside geotiff.js in Node and in Chromium: ``python -m benchmarks.javascript DIR``.

Seconds of a clock of reading all of a file and a window of 512 x 512 samples anywhere, from memory:
by one thread, opening included, and by workers, of a file that is open, where all workers run and
nothing of what was decoded is kept; and of opening a URL behind 50 ms and 20 Mbit/s and reading a
first tile of 256 x 256 samples. The peer is geotiff.js with its own LERC decoder, on the COGs that
GDAL makes of the same raster with the same bound, LERC_ZSTD and LERC. All take turns; engines are
warm; what each reads is compared with what Python, or GDAL, reads. Needs Chromium, chromedriver and
``npm install --prefix js/testing --no-package-lock``.
"""

import hashlib
import json
import statistics
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import rasterio
from rasterio.windows import Window

import terrainwave
from benchmarks import common
from benchmarks.rasters import write_cog
from benchmarks.slow_server import SlowServer
from benchmarks.windows import corners, read_cog, read_terrain

JS = common.ROOT / "js"
N_WARM = 2
# What is read: samples on a side, or all; by how many workers beside none; through a slow server?
WHATS = {"whole": (None, True, False), "512²": (512, True, False), "first tile": (256, False, True)}
ENGINES = ("Node", "Chromium")
LATENCY, BITS = 0.05, 20e6

# Milliseconds: medians, and the most. `workers` 0: one thread.
Row = namedtuple(
    "Row",
    "raster max_error engine what workers terrainwave_ms lerc_zstd_ms lerc_ms terrainwave_most_ms "
    "lerc_zstd_most_ms lerc_most_ms time_over_lerc_zstd time_over_lerc n_runs",
)
PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<script src="js/testing/node_modules/geotiff/dist-browser/geotiff.js"></script>
<script type="module">
  import * as terrainwave from "./js/src/index.js";
  import { digestOf } from "./js/testing/levels.js";
  import { sides } from "./js/testing/side.js";
  const timed = sides(terrainwave, GeoTIFF, digestOf);
  let [name, bytes] = [null, null]; // the file that was read last
  globalThis.side = async ({ url, path, ...question }) => {
    if (path && path !== name) [name, bytes] = [path, await (await fetch(path)).arrayBuffer()];
    return timed({ name: url ?? path, from: url ?? bytes, ...question });
  };
</script>
"""
ASK = """
    const [question, done] = arguments;
    const ask = () => globalThis.side
      ? globalThis.side(question).then(done, (error) => done({ error: String(error) }))
      : setTimeout(ask, 20);
    ask();
"""
Ask = Callable[[dict[str, Any]], dict[str, Any]]


@contextmanager
def node() -> Iterator[Ask]:
    """Yield what asks a process of Node, warm from one question to the next."""
    process = subprocess.Popen(
        ["node", str(JS / "testing" / "serve.js")], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True,
    )  # fmt: skip

    def ask(question: dict[str, Any]) -> dict[str, Any]:
        process.stdin.write(json.dumps({"what": "side", **question}) + "\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    try:
        yield ask
    finally:
        process.stdin.close()
        process.wait(30)


@contextmanager
def page(server: SlowServer) -> Iterator[Ask]:
    """Yield what asks a page in Chromium, which the server has."""
    sys.path.insert(0, str(common.ROOT / "tests"))
    from ext.browser import chromium

    with chromium() as driver:
        driver.set_script_timeout(600)
        driver.get(server.url("index.html"))
        yield lambda question: driver.execute_async_script(ASK, question)


def expected_of(path: Path, window: Window) -> str:
    """Return the digest of what Python, or GDAL, reads."""
    read = read_terrain if path.suffix == ".twz" else read_cog
    return hashlib.sha256(read(path, window).tobytes()).hexdigest()


def make_files(raster: Path, bound: float, folder: Path) -> dict[str, Path]:
    """Return the files of a raster by what they are called in a row."""
    names = {"terrainwave": "rapid.twz", "lerc_zstd": "LERC_ZSTD.tif", "lerc": "LERC.tif"}
    found = {key: folder / f"{raster.stem}-{bound:g}-{name}" for key, name in names.items()}
    if not found["terrainwave"].exists():
        terrainwave.compress(raster, found["terrainwave"], max_error=bound)
    for key in ("lerc_zstd", "lerc"):
        if not found[key].exists():
            write_cog(raster, found[key], bound, key.upper())
    return found


def seconds_of(ask: Ask, path: Path, window: Window, workers: int, place: dict[str, str]) -> float:
    """Return what one read takes of a file at a `place`, its path or URL, if it is right."""
    question = {
        "who": "terrainwave" if path.suffix == ".twz" else "geotiff", "workers": workers, **place,
        "window": {
            "row": window.row_off, "col": window.col_off, "nRows": window.height,
            "nCols": window.width,
        },
    }  # fmt: skip
    answer = ask(question)
    if answer.get("digest") != expected_of(path, window):
        raise SystemExit(f"{path.name}, {window}: not what Python and GDAL read: {answer}")
    return answer["seconds"]


def windows_of(shape: tuple[int, int], side: int | None, n: int) -> list[Window]:
    """Return a window for each round, the same ones each time."""
    if side is None or min(shape) < side:
        return [Window(0, 0, shape[1], shape[0])] * n
    return [Window(col, row, side, side) for row, col in corners(shape, side, "any", n)]


def measure(rasters, bounds, n_workers, n_runs, folder) -> Iterator[Row]:
    """Yield the rows of each raster, bound, engine and read."""
    with ExitStack() as stack:
        if not (folder / "js").is_symlink():
            (folder / "js").symlink_to(JS)
        (folder / "index.html").write_text(PAGE, encoding="utf-8")
        quick = stack.enter_context(SlowServer(folder, 0, 0))
        slow = stack.enter_context(SlowServer(folder, LATENCY, BITS))
        process = stack.enter_context(node())
        asks = {
            ("Node", False): process, ("Node", True): process,
            ("Chromium", False): stack.enter_context(page(quick)),
            ("Chromium", True): stack.enter_context(page(slow)),
        }  # fmt: skip
        n_asked = 0
        for raster in rasters:
            with rasterio.open(raster) as dataset:
                shape = dataset.shape
            for bound in bounds:
                files = make_files(raster, bound, folder)
                for what, (side, by_workers, is_remote) in WHATS.items():
                    numbers = (0, n_workers) if by_workers else (0,)
                    windows = windows_of(shape, side, N_WARM + n_runs)
                    for engine in ENGINES:
                        for workers in numbers:
                            found: dict[str, list[float]] = {key: [] for key in files}
                            for window in windows:
                                for key, path in files.items():
                                    n_asked += 1  # an address that no cache has
                                    place = {"url": slow.url(f"{path.name}?{n_asked}")}
                                    if not is_remote:
                                        place = {
                                            "path": str(path) if engine == "Node" else path.name
                                        }
                                    ask = asks[engine, is_remote]
                                    taken = seconds_of(ask, path, window, workers, place)
                                    found[key].append(taken)
                            yield row_of(raster, bound, engine, what, workers, found, n_runs)


def row_of(raster, bound, engine, what, workers, found, n_runs) -> Row:
    """Return a row of the seconds of all rounds, whose first ones don't count."""
    kept = {key: seconds[N_WARM:] for key, seconds in found.items()}
    medians = {key: statistics.median(seconds) for key, seconds in kept.items()}
    numbers = [*medians.values(), *(max(seconds) for seconds in kept.values())]
    ours = medians["terrainwave"]
    return Row(
        raster.stem, bound, engine, what, workers, *(round(1000 * number, 2) for number in numbers),
        round(ours / medians["lerc_zstd"], 3), round(ours / medians["lerc"], 3), n_runs,
    )  # fmt: skip


@common.command("javascript_side.csv")
@common.rasters_argument
@common.bounds_option(0, 1)
@common.option("--workers", type=common.COUNT, default=2)
@common.option("--runs", type=common.COUNT, default=5)
def main(paths, bounds, workers, runs, folder, out) -> None:
    """Measure reads in JavaScript."""
    common.write_rows(out, measure(paths, bounds, workers, runs, folder))


if __name__ == "__main__":
    main()
