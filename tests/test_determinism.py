"""The same raster gives the same bytes: threads, order, runs, kinds of sources."""

import hashlib

import numpy as np
import pytest
from commands import environment, python
from containers import open_container
from strategies import terrain_like, write_geotiff
from twz import grouped, twz_bytes

from terrainwave.container.page import page_layout
from terrainwave.grid.crew import Crew
from terrainwave.names import METHODS
from terrainwave.raster_io.source import RasterSource
from terrainwave.write import compress as compression
from terrainwave.write import pyramid

HEIGHTS = terrain_like(261, 70, seed=3)
HEIGHTS[40:90, 20:60] = -32768
OPTIONS = {"max_error": 2, "nodata": -32768, "border_rings": 3}


def options_of(method):
    """Return `OPTIONS`; one ring where the method has no more."""
    return OPTIONS if METHODS[method].has_rings else {**OPTIONS, "border_rings": 1}


@pytest.fixture(scope="module", params=["cdf97", "cdf53", "store"])
def method(request):
    return request.param


@pytest.fixture(scope="module")
def expected(method):
    """Return the bytes made by one thread."""
    return twz_bytes(HEIGHTS, method=method, **options_of(method))


@pytest.mark.parametrize("threads", [1, 2, 7])
def test_the_number_of_threads_does_not_matter(method, expected, threads):
    assert twz_bytes(HEIGHTS, method=method, threads=threads, **options_of(method)) == expected


@pytest.mark.parametrize("limit", [0, 1 << 30], ids=["on disk", "in memory"])
def test_threads_that_scan_a_file_do_not_matter(monkeypatch, tmp_path, limit):
    path = write_geotiff(tmp_path / "a.tif", HEIGHTS, nodata=-32768)
    monkeypatch.setattr("terrainwave.raster_io.temporary.MEMORY_LIMIT", limit)
    monkeypatch.setattr("terrainwave.write.passes.windows.MEMORY_LIMIT", 1 << 30)
    monkeypatch.setattr(RasterSource.blocks, "__defaults__", (700,))  # samples of a window
    assert len(list(RasterSource(path).blocks())) > 20
    first, second = (twz_bytes(path, threads=n, max_error=2) for n in (1, 4))
    assert first == second


class ShuffledCrew(Crew):
    """Does what it is asked to in a random order; results come in the right one."""

    seed = 0

    def map(self, function, *iterables):
        items = list(zip(*iterables))
        results = {}
        for index in np.random.default_rng(self.seed).permutation(len(items)):
            results[index] = function(*items[index])
        return iter([results[index] for index in range(len(items))])

    def grow(self, work, things):
        rng, waiting = np.random.default_rng(self.seed), list(things)
        while waiting:
            waiting += work(waiting.pop(int(rng.integers(len(waiting)))))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_order_of_units_and_windows_does_not_matter(monkeypatch, method, expected, seed):
    monkeypatch.setattr(ShuffledCrew, "seed", seed)
    monkeypatch.setattr(compression, "Crew", ShuffledCrew)
    monkeypatch.setattr(pyramid, "TILE", 32)
    assert twz_bytes(HEIGHTS, method=method, **options_of(method)) == expected


def test_spooling_to_disk_does_not_matter(monkeypatch, method, expected):
    monkeypatch.setattr("terrainwave.raster_io.temporary.MEMORY_LIMIT", 0)
    monkeypatch.setattr("terrainwave.container.spool._BUFFER", 100)
    assert twz_bytes(HEIGHTS, method=method, **options_of(method)) == expected


@pytest.mark.parametrize(
    "same",
    [
        pytest.param(np.asfortranarray(HEIGHTS), id="by columns"),
        pytest.param(HEIGHTS.astype(">i2"), id="big-endian"),
        pytest.param(np.repeat(HEIGHTS, 2, axis=1)[:, ::2], id="strided"),
    ],
)
def test_the_layout_of_an_array_does_not_matter(method, expected, same):
    assert twz_bytes(same, method=method, **options_of(method)) == expected


def test_a_second_run_gives_the_same_bytes():
    heights = HEIGHTS[:9, :8]
    first = twz_bytes(heights, max_error=2, nodata=-32768)
    assert twz_bytes(heights, max_error=2, nodata=-32768) == first


@pytest.mark.full
def test_other_processes_and_hash_seeds_give_the_same_bytes(tmp_path, expected, method):
    np.save(tmp_path / "heights.npy", HEIGHTS)
    code = (
        "import sys, numpy as np, terrainwave as tw;"
        "tw.compress(np.load(sys.argv[1]), sys.argv[2], method=eval(sys.argv[3]), block=32,"
        " max_error=2, nodata=-32768, threads=2, digest=False)"
    )
    target = tmp_path / "there.twz"
    own = grouped(options_of(method) | {"method": method})["method"]
    asked = repr(own) if isinstance(own, str) else own.call()
    elsewhere = environment(PYTHONHASHSEED="77")
    python(code, tmp_path / "heights.npy", target, asked, env=elsewhere, check=True)
    assert hashlib.sha256(target.read_bytes()).digest() == hashlib.sha256(expected).digest()


# More columns than a strip may have: striped sources of that width are spooled in tiles first.
WIDE = terrain_like(70, 1100, seed=4)
PROFILES = {
    "strips of one row": {"blockysize": 1},
    "strips of sixteen": {"blockysize": 16, "compress": "deflate"},
    "tiles": {"tiled": True, "blockxsize": 64, "blockysize": 32},
    "one strip": {"blockysize": 70},
}


@pytest.fixture(scope="module")
def wide_files(tmp_path_factory):
    """Return the file made from each kind of GeoTIFF of one raster."""
    folder = tmp_path_factory.mktemp("wide")
    found = {}
    for name, profile in PROFILES.items():
        path = write_geotiff(folder / f"{name}.tif", WIDE, **profile)
        found[name] = twz_bytes(path, max_error=2)
    return found


@pytest.mark.parametrize("name", [name for name in PROFILES if name != "tiles"])
def test_the_blocks_of_a_geotiff_do_not_matter(wide_files, name):
    assert wide_files[name] == wide_files["tiles"]


def contents(data):
    """Return all payloads and codes of a file."""
    with open_container(data) as container:
        layouts = [page_layout(container.grid, head) for head in container.grid.segment_heads()]
        payloads = [container.payloads(layout.keys) for layout in layouts]
        return payloads, [container.codes(block) for layout in layouts for block in layout.blocks]


def test_an_array_gives_the_payloads_of_a_geotiff(wide_files):
    # Their metadata differ: a GeoTIFF says what its pixels stand for.
    assert contents(twz_bytes(WIDE, max_error=2)) == contents(wide_files["tiles"])
