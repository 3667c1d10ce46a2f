"""Hold the reader in JavaScript against Python, on real rasters.

python js/tools/against_python.py compare DIR   equal bits of all levels, in Node and in Chromium
python js/tools/against_python.py speed DIR     processor time of both and of geotiff.js, in turns

DIR has GeoTIFFs; `--work` keeps the files that are made of them. Each raster is compressed with
every bound of `--max-error`, for the comparison by every method, for the speed by rapid and
predictive. Both need node, the comparison Chromium, chromedriver and selenium
besides; `speed` needs ``npm install --prefix js/testing --no-package-lock``.

`speed` opens files that are in memory and reads all of them, or a window of 512 x 512 samples
anywhere, by one thread on one core: our files in Node and in Python, and in Node with geotiff.js
and its LERC decoder the COG (LERC_ZSTD, blocks of 512, overviews, the same bound) that GDAL makes
of the same GeoTIFF. What each gives is compared with what Python, or GDAL, reads of that file.
"""

import argparse
import contextlib
import hashlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rasterio
from rasterio.windows import Window

import terrainwave
from terrainwave.names import METHODS

JS = Path(__file__).parents[1]
sys.path.insert(0, str(JS.parent))
from benchmarks import common  # noqa: E402  (lies beside js, and is not installed)
from benchmarks.rasters import write_cog  # noqa: E402
from benchmarks.windows import corners  # noqa: E402

TIMED = ("rapid", "predictive")
N_ROUNDS = 5
N_WARM = 3  # rounds that don't count: both compile
SIDE = 512
WHOLE = "whole"

# Milliseconds of processor time: medians, and the most.
Row = namedtuple(
    "Row",
    "raster max_error method n_samples what python_ms node_ms geotiff_ms python_most_ms "
    "node_most_ms geotiff_most_ms speed_over_python time_over_geotiff n_runs",
)
READ = """
    const [path, done] = [arguments[0], arguments[arguments.length - 1]];
    Promise.all([import("/js/src/index.js"), import("/js/testing/levels.js")])
      .then(async ([{ open }, { levelDigests }]) => levelDigests(await open(path)))
      .then(done, (error) => done(String(error)));
"""


def make_files(
    rasters: Path, work: Path, bounds: list[float], methods: tuple[str, ...]
) -> list[Path]:
    """Compress what is not in `work` yet; return the files. What a method refuses is printed."""
    found = []
    for raster in sorted(rasters.glob("*.tif")):
        for bound in bounds:
            for method in methods:
                made = work / f"{raster.stem}-{bound:g}-{method}.twz"
                try:
                    if not made.exists():
                        terrainwave.compress(raster, made, max_error=bound, method=method)
                except terrainwave.TerrainwaveError as error:
                    print(f"{made.name} is left out: {error}")
                    continue
                found.append(made)
    return found


def method_of(path: Path) -> str:
    """Return the method of a file."""
    return path.stem.rsplit("-", 1)[1]


def digests(path: Path) -> list[list[str]]:
    """Return SHA-256 of heights and of validity, by level."""
    found = []
    with terrainwave.open(path) as terrain:
        for level in range(terrain.n_levels):
            arrays = terrain.read_with_mask(level=level)
            found.append([hashlib.sha256(array.tobytes()).hexdigest() for array in arrays])
    return found


class Node:
    """A process that answers questions about files, warm from one to the next."""

    def __init__(self) -> None:
        command = ["node", str(JS / "testing" / "serve.js")]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def ask(self, what: str, path: Path, window: dict[str, int] | None = None) -> Any:
        """Return the answer to a question about a file."""
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(
            json.dumps({"what": what, "path": str(path), "window": window}) + "\n"
        )
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin
        self.process.stdin.close()
        self.process.wait(30)


@contextlib.contextmanager
def browser(work: Path) -> Iterator[Any]:
    """Yield a function from a file in `work` to what a page in Chromium reads of it."""
    sys.path.insert(0, str(JS.parent / "tests"))
    from ext.browser import chromium
    from ext.static_server import static_server

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "js").symlink_to(JS)
        (Path(folder) / "files").symlink_to(work.absolute())
        with static_server(folder) as server, chromium() as driver:
            driver.set_script_timeout(600)
            driver.get(f"{server.address}/js/package.json")
            yield lambda path: driver.execute_async_script(
                READ, f"{server.address}/files/{path.name}"
            )


def compare(files: list[Path], work: Path) -> int:
    """Print a table; return how many files are read otherwise than by Python."""
    n_wrong = 0
    node = Node()
    print(f"{'file':54} {'method':10} levels  Node   Chromium")
    with browser(work) as read:
        for path in files:
            expected = digests(path)
            equal = [node.ask("digests", path) == expected, read(path) == expected]
            n_wrong += not all(equal)
            words = ["equal" if is_equal else "WRONG" for is_equal in equal]
            method = method_of(path)
            print(
                f"{path.name:54} {method:10} {len(expected):6}  {words[0]}  {words[1]}", flush=True
            )
    node.close()
    print(f"{len(files)} files, {n_wrong} of which differ")
    return n_wrong


def digest(heights: Any) -> str:
    """Return the SHA-256 of an array."""
    return hashlib.sha256(heights.tobytes()).hexdigest()


def seconds_of_python(data: bytes, window: Window | None) -> tuple[float, str]:
    """Return the processor time of opening a file and reading it by one thread, and its digest."""
    place = window and (window.row_off, window.col_off, window.height, window.width)
    before = time.process_time()
    with terrainwave.open(data, threads=1, native=False) as terrain:
        heights = terrain.read(place)
    return time.process_time() - before, digest(heights)


def seconds_of_all(node: Node, path: Path, cog: Path, window: Window | None) -> list[float]:
    """Return what Python, our reader in Node and geotiff.js take; each must give what it should."""
    python, expected = seconds_of_python(path.read_bytes(), window)
    with rasterio.open(cog) as dataset:
        expected_of_cog = digest(dataset.read(1, window=window))
    place = window and {
        "row": window.row_off, "col": window.col_off, "nRows": window.height, "nCols": window.width
    }  # fmt: skip
    found = [node.ask("terrainwave", path, place), node.ask("geotiff", cog, place)]
    if [answer["digest"] for answer in found] != [expected, expected_of_cog]:
        raise SystemExit(f"{path.name}, {window}: not what Python and GDAL read")
    return [python, *(answer["seconds"] for answer in found)]


def speed_rows(rasters: Path, files: list[Path], work: Path) -> Iterator[Row]:
    """Yield the rows of all files: all of each, and windows of those that are large enough."""
    node, n_warm = Node(), 4 * N_WARM  # engines of JavaScript take longer to begin with
    for path in files:
        name, bound, _ = path.stem.rsplit("-", 2)
        cog = work / f"{name}-{bound}-cog.tif"
        if not cog.exists():
            write_cog(rasters / f"{name}.tif", cog, float(bound))
        with rasterio.open(cog) as dataset:
            shape = dataset.shape
        windows: dict[str, list[Window | None]] = {WHOLE: [None] * (n_warm + N_ROUNDS)}
        if min(shape) >= SIDE:
            places = corners(shape, SIDE, "any", n_warm + N_ROUNDS)
            windows[f"{SIDE}²"] = [Window(col, row, SIDE, SIDE) for row, col in places]
        for what, of_rounds in windows.items():
            found = [seconds_of_all(node, path, cog, window) for window in of_rounds][n_warm:]
            columns = list(zip(*found, strict=True))
            medians = [statistics.median(column) for column in columns]
            numbers = [1000 * number for number in [*medians, *map(max, columns)]]
            python, script, peer = medians
            yield Row(
                name, bound, method_of(path), shape[0] * shape[1], what,
                *(round(number, 2) for number in numbers),
                round(python / script, 3), round(script / peer, 3), N_ROUNDS,
            )  # fmt: skip
        n_warm = N_WARM
    node.close()


def speed(rasters: Path, files: list[Path], work: Path, out: Path) -> int:
    """Write a CSV of times and print it; return how many are below 0.7 of Python's speed."""
    common.pin_to_cores()
    rows = common.write_rows(out, speed_rows(rasters, files, work))
    for method, what in sorted({(row.method, row.what) for row in rows}):
        for field in ("speed_over_python", "time_over_geotiff"):
            own = [row for row in rows if (row.method, row.what) == (method, what)]
            ratios = [getattr(row, field) for row in own]
            middle = statistics.median(ratios)
            print(f"{method}, {what}: {field} {min(ratios)} to {max(ratios)}, median {middle:.3f}")
    return sum(row.speed_over_python < 0.7 for row in rows if row.what == WHOLE)


def main() -> int:
    """Run one of the two; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["compare", "speed"])
    parser.add_argument("rasters", type=Path)
    parser.add_argument("--max-error", type=float, nargs="+", default=[0, 1])
    parser.add_argument("--work", type=Path)
    results = JS.parent / "benchmarks" / "results"
    parser.add_argument("--out", type=Path, default=results / "javascript.csv")
    told = parser.parse_args()
    with contextlib.ExitStack() as stack:
        work = told.work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        work.mkdir(parents=True, exist_ok=True)
        methods = tuple(METHODS) if told.what == "compare" else TIMED
        files = make_files(told.rasters, work, told.max_error, methods)
        if told.what == "compare":
            return min(compare(files, work), 1)
        return min(speed(told.rasters, files, work, told.out), 1)


if __name__ == "__main__":
    raise SystemExit(main())
