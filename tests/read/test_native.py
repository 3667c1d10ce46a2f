"""Does the native library read what terrainwave reads itself, and is it used where it fits alone?

They use the library beside the package, and build it first where that is not done.
"""

import json
import os
import pickle
import subprocess
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock, patch

import numpy as np
import pytest
from commands import environment, python
from conformance import library as reader
from golden_files import GOLDEN
from native_site import found_at
from strategies import terrain_like
from twz import twz_bytes

import terrainwave
from terrainwave.coding import native_library
from terrainwave.container.sources.byte_source import FileSource
from terrainwave.errors import (
    CorruptStreamError,
    StorageError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.file import TerrainFile
from terrainwave.read import native
from terrainwave.read.decoder import TreeDecoder

pytestmark = [pytest.mark.native, pytest.mark.full]

MANIFEST = json.loads((GOLDEN / "v2" / "manifest.json").read_text(encoding="utf-8"))
FILES = sorted(MANIFEST["files"])
NODATA = -32768
HEIGHTS = terrain_like(300, 260, seed=5)
HEIGHTS[40:90, 100:130] = NODATA
HEIGHTS[200, 7] = NODATA


@pytest.fixture
def alone(monkeypatch):
    """Let the library read alone: what decodes units of terrainwave's own fails the test."""

    make = TerrainFile.decoder.func

    def fail(self):
        assert not self.is_native, "terrainwave has decoded units by itself"
        return make(self)

    monkeypatch.setattr(TerrainFile, "decoder", property(fail))


def pair(source, **options):
    """Return a file opened without the library, and one opened with it."""
    return (terrainwave.open(source, native=is_native, **options) for is_native in (False, True))


def windows_of(shape, n, seed):
    """Return the whole of a level, None, and `n` parts of it."""
    rng = np.random.default_rng(seed)
    yield None
    for _ in range(n):
        first = [int(rng.integers(size)) for size in shape]
        rest = [int(rng.integers(1, size - at + 1)) for size, at in zip(shape, first, strict=True)]
        yield (*first, *rest)


def outcome(read, *arguments, **options):
    """Return what a call gives, as bytes, and what it warns of; or the error it raises."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            found = read(*arguments, **options)
        except TerrainwaveError as error:
            return type(error), str(error)
    arrays = found if isinstance(found, tuple) else (found,)
    parts = [(part.dtype, part.shape, np.ma.filled(part).tobytes()) for part in arrays]
    return parts, [str(warning.message) for warning in told]


@pytest.mark.parametrize("name", FILES)
def test_golden_files_decode_to_what_they_always_did(name, with_library, alone):
    with terrainwave.open(GOLDEN / "v2" / name, threads=1) as terrain:
        for level, expected in enumerate(MANIFEST["files"][name]["level"]):
            found = reader.heights_of(terrain, level)
            assert found == {key: expected[key] for key in found}


@pytest.mark.parametrize("name", FILES)
def test_windows_and_samples_are_the_same(name, with_library):
    rng = np.random.default_rng(1)
    one, other = pair(GOLDEN / "v2" / name, threads=2)
    with one, other:
        left, bottom, right, top = one.bounds
        places = np.stack([rng.uniform(left, right, 40), rng.uniform(bottom, top, 40)], axis=1)
        for level in range(one.n_levels):
            for window in windows_of(one.level_shape(level), 3, level):
                for voids in ("any", "exact"):
                    asked = {"window": window, "level": level, "voids": voids}
                    found = outcome(one.read_with_mask, **asked)
                    assert found == outcome(other.read_with_mask, **asked), asked
            for voids in ("any", "exact"):
                asked = {"points": places, "level": level, "voids": voids}
                assert outcome(one.sample, **asked) == outcome(other.sample, **asked)
        for resampling in ("nearest", "bilinear", "average"):
            asked = {"out_shape": (7, 5), "resampling": resampling, "masked": True}
            assert outcome(one.read, **asked) == outcome(other.read, **asked)


@pytest.mark.parametrize("method", ["rapid", "predictive", "cdf97", "cdf53", "store"])
def test_large_windows_are_read_in_parts(method, with_library, alone, monkeypatch):
    rings = {"border_rings": 3} if method == "cdf97" else {}
    data = twz_bytes(HEIGHTS, max_error=2, nodata=NODATA, method=method, block=32, **rings)
    with terrainwave.open(data) as terrain:
        whole = [terrain.read_with_mask(level=level) for level in range(terrain.n_levels)]
    counts = []
    decode = native.NativeFile._decode

    def counted(self, *arguments, **options):
        counts.append(1)
        return decode(self, *arguments, **options)

    monkeypatch.setattr(native.NativeFile, "_decode", counted)
    for most in (1, 4 * 64**2):
        monkeypatch.setattr(native, "_MOST_DECODED", most)
        monkeypatch.setattr(native, "_MOST_FETCHED", 4 * most)
        with terrainwave.open(data, cache_bytes=0) as terrain:
            for level, (heights, valid) in enumerate(whole):
                counts.clear()
                again, is_valid = terrain.read_with_mask(level=level)
                assert np.array_equal(again, heights)
                assert np.array_equal(is_valid, valid)
            assert len(counts) > 5 if most > 1 else len(counts) > 20  # of the finest level


def test_payloads_take_as_many_requests(with_library, tmp_path):
    class Counting(FileSource):
        n_requests = 0

        def read_spans(self, spans):
            self.n_requests += len(spans)
            return super().read_spans(spans)

        def read(self, offset, length):
            self.n_requests += 1
            return super().read(offset, length)

    path = tmp_path / "a.twz"
    path.write_bytes(twz_bytes(HEIGHTS, max_error=0, nodata=NODATA, method="rapid", block=32))
    n_requests = []
    for is_native in (False, True):
        source = Counting(path)
        with terrainwave.open(source, native=is_native) as terrain:
            for window in windows_of(terrain.shape, 10, 2):
                terrain.read(window)
        n_requests.append(source.n_requests)
    assert n_requests[1] <= n_requests[0] + 1


def points_of(terrain, n, seed):
    """Return points inside a raster, on its samples, at its edges and outside."""
    rng = np.random.default_rng(seed)
    n_rows, n_cols = terrain.shape
    rows, cols = rng.uniform(-1, n_rows, n), rng.uniform(-1, n_cols, n)
    rows[::5], cols[::7] = np.rint(rows[::5]), np.rint(cols[::7])
    rows[3::20], cols[4::20] = n_rows - 1, n_cols - 1
    rows[5], cols[6] = np.nan, np.inf
    return rows, cols


@pytest.mark.parametrize("method", ["rapid", "predictive", "cdf97", "cdf53", "store"])
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_heights_at_points_are_equal_to_the_last_bit(method, dtype, with_library, monkeypatch):
    rings = {"border_rings": 3} if method == "cdf97" else {}
    heights = HEIGHTS.astype(dtype) / dtype(1 if dtype is np.int16 else 7)
    heights[HEIGHTS == NODATA] = NODATA
    data = twz_bytes(heights, max_error=1, nodata=NODATA, method=method, block=32, **rings)
    one, other = pair(data, cache_bytes=0)
    with one, other:
        rows, cols = points_of(one, 3000, 7)
        for level in range(one.n_levels):
            for voids in ("any", "exact"):
                shift = 2.0 ** (one.n_levels - 1 - level)
                asked = {"level": level, "voids": voids}
                expected = one.heights_at(rows / shift, cols / shift, **asked)
                found = other.heights_at(rows / shift, cols / shift, **asked)
                assert found.tobytes() == expected.tobytes()
                assert 0 < np.isnan(expected).sum() < expected.size


def test_points_decode_and_fetch_each_unit_once(with_library, tmp_path, monkeypatch):
    class Counting(FileSource):
        n_bytes = 0

        def read(self, offset, length):
            self.n_bytes += length
            return super().read(offset, length)

        def read_spans(self, spans):
            self.n_bytes += sum(length for _, length in spans)
            return super().read_spans(spans)

    path = tmp_path / "a.twz"
    path.write_bytes(twz_bytes(HEIGHTS, max_error=0, nodata=NODATA, method="rapid", block=32))
    decoded = []
    unit = TreeDecoder.unit
    monkeypatch.setattr(
        TreeDecoder, "unit", lambda *arguments: decoded.append(arguments[1]) or unit(*arguments)
    )
    for is_native in (False, True):
        source = Counting(path)
        with terrainwave.open(source, native=is_native, cache_bytes=0) as terrain:
            terrain.heights_at(*points_of(terrain, 5000, 8))
        if is_native:
            # Both readers open the file by its first 16 KiB.
            assert source.n_bytes <= path.stat().st_size + (2 << 14)
        else:
            finest = [key for key in decoded if key.level == terrain.n_levels - 2]
            assert len(finest) == len(set(finest)) > 10


def test_invalid_files_are_refused_in_the_same_words(with_library):
    for name in sorted(MANIFEST["invalid"]):
        data = (GOLDEN / "v2" / "invalid" / name).read_bytes()

        def everything(data, is_native):
            with terrainwave.open(data, threads=1, native=is_native) as terrain:
                finest = terrain.level_shape(-1)
                window = tuple(min(size, 300) for size in finest)
                levels = range(-1, -terrain.n_levels - 1, -1)
                return tuple(terrain.read((0, 0, *window), level=level) for level in levels)

        assert outcome(everything, data, False) == outcome(everything, data, True), name


@pytest.mark.parametrize("method", ["rapid", "store"])
def test_damage_is_told_and_masked_the_same(method, with_library):
    data = twz_bytes(HEIGHTS, max_error=1, nodata=NODATA, method=method, block=32)
    rng = np.random.default_rng(4)
    n_errors = 0
    for place in rng.integers(len(data) // 3, len(data), 12):
        damaged = bytearray(data)
        damaged[place] ^= 0x55
        one, other = pair(bytes(damaged), threads=1)
        with one, other:
            for on_error in ("raise", "mask"):
                for level in (-1, -2):
                    found = outcome(one.read, level=level, on_error=on_error)
                    assert found == outcome(other.read, level=level, on_error=on_error)
                    n_errors += found[0] is CorruptStreamError
    assert n_errors > 5


def test_a_refusal_of_a_sound_file_is_told(with_library, monkeypatch):
    data = twz_bytes(HEIGHTS, max_error=0, nodata=NODATA, method="store", block=32)
    monkeypatch.setattr(
        native.NativeFile,
        "window",
        Mock(
            side_effect=native.NativeError(
                native_library.Failure(native_library.CORRUPT, b"bits of straw")
            )
        ),
    )
    with terrainwave.open(data) as terrain:
        with pytest.warns(TerrainwaveWarning, match=r"bits of straw.*please report it"):
            heights = terrain.read()
    assert np.array_equal(heights, HEIGHTS)


def test_many_threads_read_one_file_which_is_closed_meanwhile(with_library, alone):
    data = twz_bytes(HEIGHTS, max_error=0, nodata=NODATA, method="rapid", block=32)
    with terrainwave.open(data, threads=3, cache_bytes=1 << 18) as terrain:
        windows = list(windows_of(terrain.shape, 200, 3))
        with ThreadPoolExecutor(8) as executor:
            for window, heights in zip(windows, executor.map(terrain.read, windows), strict=True):
                row, col, n_rows, n_cols = window or (0, 0, *terrain.shape)
                assert np.array_equal(heights, HEIGHTS[row : row + n_rows, col : col + n_cols])

    terrain = terrainwave.open(data, threads=2, cache_bytes=0)
    begun = threading.Event()

    def read_on():
        n = 0
        while True:
            try:
                terrain.read((0, 0, 100, 100))
            except (StorageError, AssertionError):
                return n
            n += 1
            begun.set()

    with ThreadPoolExecutor(4) as executor:
        runs = [executor.submit(read_on) for _ in range(4)]
        begun.wait(60)
        terrain.close()
        assert sum(run.result(60) for run in runs) > 0
    with pytest.raises(StorageError, match="closed"):
        terrain._windows._native.window(0, terrain.region((0, 0, 5, 5), level=0), is_own=True)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_children_of_a_fork_read_on(with_library, alone):
    data = twz_bytes(HEIGHTS, max_error=0, nodata=NODATA, method="rapid", block=32)
    with terrainwave.open(data, threads=3) as terrain:
        terrain.read()
        child = os.fork()
        if child == 0:
            is_good = np.array_equal(terrain.read(), HEIGHTS)
            terrain.close()
            os._exit(0 if is_good else 3)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert np.array_equal(terrain.read(), HEIGHTS)


def test_a_first_read_imports_no_compiler(library):
    code = (
        "import sys, terrainwave\n"
        "with terrainwave.open(sys.argv[1]) as terrain:\n"
        "    terrain.read()\n"
        "    terrain.read(level=0, masked=True, voids='any')\n"
        "    terrain.read(out_shape=(9, 9), resampling='average')\n"
        "    terrain.sample([terrain.bounds[:2]])\n"
        "print(*sorted({'numba', 'llvmlite', 'pyproj'} & set(sys.modules)))\n"
    )
    for switch, imported in {"0": "llvmlite numba", "1": ""}.items():
        switched, golden = environment(**{native_library.SWITCH: switch}), GOLDEN / "v2"
        run = python(code, golden / "rapid-int16-lossless.twz", env=switched, check=True)
        assert run.stdout.strip() == imported


def test_an_argument_and_the_environment_turn_it_off(with_library, monkeypatch, tmp_path):
    path = tmp_path / "a.twz"
    path.write_bytes(twz_bytes(HEIGHTS, max_error=0, nodata=NODATA, method="store", block=32))
    used = []
    read = native.NativeFile.window
    monkeypatch.setattr(
        native.NativeFile,
        "window",
        lambda *args, **options: used.append(1) or read(*args, **options),
    )

    def is_used(**options):
        used.clear()
        with terrainwave.open(path, **options) as terrain:
            assert np.array_equal(terrain.read(), HEIGHTS)
            before = len(used)
            with pickle.loads(pickle.dumps(terrain)) as again:
                again.read()
        assert len(used) == 2 * before
        return bool(used)

    assert is_used()
    assert is_used(native=True)
    assert not is_used(native=False)
    monkeypatch.setenv(native_library.SWITCH, "0")
    assert not is_used()
    monkeypatch.setenv(native_library.SWITCH, "1")
    assert is_used()


def warned_once():
    """Read two files, which are made without the library; return the warning that came."""
    with patch.object(native_library, "is_used", lambda: False):
        data = twz_bytes(HEIGHTS, max_error=0, nodata=NODATA, method="store", block=32)
    (first, notes), (second, none) = (outcome(terrainwave.open(data).read) for _ in range(2))
    assert first == second
    assert first[0][2] == HEIGHTS.tobytes()
    assert not none
    (note,) = notes
    return note


def test_another_library_is_told_once_and_not_used(tmp_path):
    source, made = tmp_path / "other.c", tmp_path / "other.so"
    source.write_text("int other(void) { return 1; }\n")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", made, source], check=True)
    with found_at(made):
        assert "twz_python_sources" in warned_once()
