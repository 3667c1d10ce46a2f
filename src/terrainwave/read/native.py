"""Windows decoded by the native library, where the package terrainwave-native is installed.

It decodes the same heights as `read.decoder` does, without kernels that have to be compiled. What
it cannot read, and what is damaged, is left to that one: it says what is wrong, in its own words.
"""

import ctypes
import importlib
import os
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.container.header import KNOWN_FEATURES, Header
from terrainwave.container.ranges import ByteRange
from terrainwave.container.reader import Container
from terrainwave.errors import TerrainwaveWarning
from terrainwave.forks import renew_after_fork
from terrainwave.grid.quadtree import Region

PACKAGE = "terrainwave_native"
SWITCH = "TERRAINWAVE_NATIVE"  # 0 in the environment: not used
ABI = 1  # PYTHON_ABI of native/python/shim.c

_OK, _CORRUPT, _UNSUPPORTED = 0, 1, 2
_MAX_BYTES = 4 << 30
# Samples of the parts that a window is read in, which the library holds at a time.
_MOST_SAMPLES = 1 << 24
# Units of scattered samples whose payloads are fetched in one call.
_AT_A_TIME = 64
# Ranges that are asked for in one call.
_MOST_RANGES = 256


class _Error(ctypes.Structure):
    _fields_ = [("status", ctypes.c_int), ("text", ctypes.c_char * 240)]


class _Options(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("allocator", ctypes.c_void_p * 3),
        ("locks", ctypes.c_void_p * 3),
        ("cache_bytes", ctypes.c_uint64),
        ("max_bytes", ctypes.c_uint64),
        ("kernels", ctypes.c_int),
    ]


class _Range(ctypes.Structure):
    _fields_ = [
        ("offset", ctypes.c_uint64),
        ("length", ctypes.c_uint64),
        ("likely", ctypes.c_uint64),
    ]


class _Box(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint32) for name in ("row", "col", "n_rows", "n_cols")]


class NativeError(Exception):
    """The library has returned an error."""

    def __init__(self, error: _Error) -> None:
        super().__init__(error.text.decode("utf-8", "replace"))
        self.is_damage = error.status == _CORRUPT


_POINTER, _SIZE, _STRIDE = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_ssize_t
_HANDLE = ctypes.POINTER(ctypes.c_void_p)
_N = ctypes.POINTER(ctypes.c_size_t)
_RANGES, _BOX, _FAILURE = map(ctypes.POINTER, (_Range, _Box, _Error))
# Of functions that return a status, all but the last argument, which is the error.
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "twz_file_new": (ctypes.POINTER(_Options), ctypes.c_uint64, _HANDLE),
    "twz_file_need": (_POINTER, _RANGES, _SIZE, _N),
    "twz_file_feed": (_POINTER, ctypes.c_uint64, ctypes.c_char_p, _SIZE),
    "twz_window_new": (_POINTER, ctypes.c_int, _BOX, _HANDLE),
    "twz_window_need": (_POINTER, _RANGES, _SIZE, _N),
    "twz_window_feed": (_POINTER, ctypes.c_uint64, ctypes.c_char_p, _SIZE),
    "twz_window_decode": (_POINTER, _POINTER),
    "twz_window_read": (_POINTER, _POINTER, _STRIDE, _POINTER, _STRIDE),
    "twz_window_read_own": (_POINTER, _POINTER, _STRIDE),
    "twz_pool_new": (_SIZE, _HANDLE),
}


class Library:
    """The functions of a shared library; those that can fail raise.

    Raises
    ------
    OSError
        If it cannot be loaded.
    AttributeError
        If a function is missing.
    """

    def __init__(self, path: str) -> None:
        self._library = ctypes.CDLL(path)  # lets other threads run during each call
        self.abi: int = self._plain("twz_python_abi", ctypes.c_int)()
        self.features: int = self._plain("twz_python_features", ctypes.c_uint32)()
        if self.abi != ABI:
            return
        self._functions = {
            name: self._plain(name, ctypes.c_int, *arguments, _FAILURE)
            for name, arguments in _SIGNATURES.items()
        }
        self.free_window = self._plain("twz_window_free", None, _POINTER)
        self.free_file = self._plain("twz_file_free", None, _POINTER)
        self.free_pool = self._plain("twz_pool_free", None, _POINTER)
        self.workers_of = self._plain("twz_pool_workers", _POINTER, _POINTER)
        self.new_locks = self._plain("twz_python_locks_new", _POINTER)
        self.allocator = self._plain("twz_python_allocator", _POINTER)()
        self.free_locks = self._plain("twz_python_locks_free", None, _POINTER)

    def _plain(self, name: str, result: Any, *arguments: Any) -> Callable[..., Any]:
        """Return a function of the library."""
        function = self._library[name]
        function.restype, function.argtypes = result, arguments
        return function

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function of `_SIGNATURES`; raise what it says is wrong."""
        error = _Error()
        if self._functions[name](*arguments, ctypes.byref(error)) != _OK:
            raise NativeError(error)

    def make(self, name: str, *arguments: Any) -> int:
        """Call a function that makes something, and return its address."""
        made = ctypes.c_void_p()
        self.call(name, *arguments, ctypes.byref(made))
        assert made.value is not None
        return made.value

    def needed(self, name: str, handle: int) -> list[ByteRange]:
        """Return which bytes a file or a window needs next."""
        ranges, n = (_Range * _MOST_RANGES)(), ctypes.c_size_t()
        self.call(name, handle, ranges, _MOST_RANGES, ctypes.byref(n))
        return [ByteRange(part.offset, part.length) for part in ranges[: n.value]]


@cache
def installed() -> Library | None:
    """Return the library of the package terrainwave-native; None where there is none that fits.

    One that is there and does not fit is told in one warning.
    """
    try:
        path = str(importlib.import_module(PACKAGE).LIBRARY)
    except ImportError:
        return None
    try:
        library = Library(path)
    except (OSError, AttributeError) as error:
        _tell(f"the library of terrainwave-native cannot be loaded ({error})")
        return None
    if library.abi != ABI:
        _tell(
            f"terrainwave-native has an interface of version {library.abi}, expected version {ABI}"
        )
        return None
    unknown = KNOWN_FEATURES & ~library.features
    if unknown:
        _tell(f"terrainwave-native does not know features {unknown:#x} of the format")
        return None
    return library


def _tell(found: str) -> None:
    warnings.warn(
        f"{found}: terrainwave decodes by itself, at the same heights. Install the terrainwave"
        " and terrainwave-native of one release, or set TERRAINWAVE_NATIVE=0: pip install -U"
        ' "terrainwave[native]"',
        TerrainwaveWarning,
        stacklevel=3,
    )


def is_wanted() -> bool:
    """Say whether the environment lets the library be used."""
    return os.environ.get(SWITCH, "1") != "0"


class _Handles:
    """What the library has allocated for one open file."""

    def __init__(self, library: Library, size: int, cache_bytes: int, n_threads: int) -> None:
        self.library = library
        self.file = self.pool = self.workers = None
        self.pool_lock = threading.Lock()
        self.n_users = 0
        self._process = os.getpid()
        self.locks = library.new_locks()
        try:
            if self.locks is None:
                raise MemoryError("no memory for locks")
            options = _Options(ctypes.sizeof(_Options))
            options.allocator = (ctypes.c_void_p * 3).from_address(library.allocator)
            options.locks = (ctypes.c_void_p * 3).from_address(self.locks)
            options.cache_bytes, options.max_bytes = max(cache_bytes, 0), _MAX_BYTES
            self.file = library.make("twz_file_new", ctypes.byref(options), size)
            if n_threads > 1:
                self.pool = library.make("twz_pool_new", n_threads)
                self.workers = library.workers_of(self.pool)
        except BaseException:
            self.free()
            raise

    def free(self) -> None:
        """Free all; nobody uses any of it. In a child of a fork it stays: threads are missing."""
        if os.getpid() == self._process:
            self.library.free_pool(self.pool)
            self.library.free_file(self.file)
            self.library.free_locks(self.locks)
        self.file = self.pool = self.locks = None


class NativeFile:
    """Windows and samples of an open file, as raw heights. Thread-safe.

    Parameters
    ----------
    cache_bytes : int
        Decoded heights that the library keeps.
    n_threads : int
        Threads that decode.

    Notes
    -----
    A window takes the time of one thread where another window is being decoded: the library's
    threads work at one at a time.
    """

    def __init__(
        self, library: Library, container: Container, *, cache_bytes: int, n_threads: int
    ) -> None:
        self._library = library
        self._container = container
        self._cache_bytes, self._n_threads = cache_bytes, n_threads
        self._is_closed = False
        self.renew()
        renew_after_fork(self)

    def renew(self) -> None:
        """Begin anew after a fork: threads are gone, and locks may be held for ever."""
        self._lock = threading.Lock()
        self._handles: _Handles | None = None
        self._refusal: Exception | None = None

    def close(self) -> None:
        """Free what the library has allocated, as soon as nobody reads."""
        with self._lock:
            self._is_closed = True
            self._free_if_unused()

    def _free_if_unused(self) -> None:
        if self._is_closed and self._handles is not None and self._handles.n_users == 0:
            self._finalizer()
            self._handles = None

    @property
    def _header(self) -> Header:
        return self._container.header

    @contextmanager
    def _opened(self) -> Iterator[_Handles]:
        """Lend the open file; it stays until the end of the `with` block."""
        with self._lock:
            if self._handles is None:
                self._handles = self._open()
            handles = self._handles
            handles.n_users += 1
        try:
            yield handles
        finally:
            with self._lock:
                handles.n_users -= 1
                self._free_if_unused()

    def _open(self) -> _Handles:
        if self._refusal is not None:
            raise self._refusal
        size = self._container.source.size
        try:
            handles = _Handles(self._library, size, self._cache_bytes, self._n_threads)
        except NativeError as error:
            self._refusal = error
            raise
        self._finalizer = weakref.finalize(self, handles.free)
        self._finalizer.atexit = False
        try:
            self._fetch([handles.file], "twz_file_need", "twz_file_feed")
        except NativeError as error:
            self._finalizer()
            self._refusal = error
            raise
        except BaseException:
            self._finalizer()
            raise
        return handles

    def _fetch(self, handles: Sequence[Any], need: str, feed: str) -> None:
        """Give files or windows the bytes they need, all in one request a round."""
        reader, known = self._container.rounds(), list[ByteRange]()
        while wanted := [(one, self._library.needed(need, one)) for one in handles]:
            missing = list(dict.fromkeys(part for _, parts in wanted for part in parts))
            if not missing:
                return
            known += missing
            reader.fetch(known)
            for one, parts in wanted:
                for part in parts:
                    self._library.call(feed, one, part.offset, reader.take(part), part.length)

    def read(
        self, level: int, region: Region, *, is_own: bool
    ) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return raw heights of a region of a level and what is void, as `WindowReader.read`."""
        heights = np.empty(region.shape, dtype=np.dtype(self._header.dtype))
        void: NDArray[np.bool_] | None = None
        for part in self._parts(level, region):
            at = part.slices_in(region)
            (valid,) = self._read_parts(level, [(part, heights[at])], is_own=is_own)
            if void is None and not valid.all():
                void = np.zeros(region.shape, dtype=np.bool_)
            if void is not None:
                np.logical_not(valid, out=void[at])
        return heights, void

    def samples(
        self, level: int, rows: NDArray[np.int64], cols: NDArray[np.int64], *, is_own: bool
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return raw heights of single samples of a level, and which are valid."""
        found = np.zeros(rows.size, dtype=np.dtype(self._header.dtype))
        valid = np.zeros(rows.size, dtype=np.bool_)
        side = self._side(level)
        units = np.stack([rows // side, cols // side], axis=1)
        places, numbers = np.unique(units, axis=0, return_inverse=True)
        order = np.argsort(numbers.ravel(), kind="stable")
        members = np.split(order, np.cumsum(np.bincount(numbers.ravel()))[:-1])
        for first in range(0, len(places), _AT_A_TIME):
            batch = members[first : first + _AT_A_TIME]
            parts = []
            for here in batch:
                box = _box_around(rows[here], cols[here])
                parts.append((box, np.empty(box.shape, dtype=found.dtype)))
            masks = self._read_parts(level, parts, is_own=is_own)
            for here, (box, heights), mask in zip(batch, parts, masks, strict=True):
                at = rows[here] - box.row, cols[here] - box.col
                found[here], valid[here] = heights[at], mask[at]
        return found, valid

    def _side(self, level: int) -> int:
        """Return the samples on a side of a unit."""
        block = self._header.grid.block
        return block if level == 0 else 2 * block

    def _parts(self, level: int, region: Region) -> Iterator[Region]:
        """Yield parts of a region of some units each, which fill it."""
        side = self._side(level)
        last_row, last_col = region.row + region.n_rows, region.col + region.n_cols
        most = max(_MOST_SAMPLES // side**2, 1)
        n_across = min((last_col - 1) // side - region.col // side + 1, most)
        n_down = most // n_across
        row = region.row
        while row < last_row:
            below = min((row // side + n_down) * side, last_row)
            col = region.col
            while col < last_col:
                right = min((col // side + n_across) * side, last_col)
                yield Region(row, col, below - row, right - col)
                col = right
            row = below

    def _read_parts(
        self, level: int, parts: Sequence[tuple[Region, NDArray[Any]]], *, is_own: bool
    ) -> list[NDArray[np.bool_]]:
        """Fill the arrays of some regions of a level with raw heights; return what is valid."""
        library = self._library
        # On the full grid, and where the file does not tell fills, what is valid is so by itself.
        is_own &= self._header.has_fills and level < self._header.grid.k_max
        masks = []
        with self._opened() as handles, ExitStack() as windows:
            made = []
            for region, _ in parts:
                box = _Box(region.row, region.col, region.n_rows, region.n_cols)
                window = library.make("twz_window_new", handles.file, level, ctypes.byref(box))
                windows.callback(library.free_window, window)
                made.append(window)
            self._fetch(made, "twz_window_need", "twz_window_feed")
            for window, (region, heights) in zip(made, parts, strict=True):
                self._decode(handles, window)
                valid = np.empty(region.shape, dtype=np.bool_)
                to, stride = heights.ctypes.data, heights.strides[0]
                mask = None if is_own else valid.ctypes.data
                library.call("twz_window_read", window, to, stride, mask, 0)
                if is_own:
                    library.call("twz_window_read_own", window, valid.ctypes.data, 0)
                masks.append(valid)
        return masks

    def _decode(self, handles: _Handles, window: int) -> None:
        if handles.workers is None or not handles.pool_lock.acquire(blocking=False):
            self._library.call("twz_window_decode", window, None)
            return
        try:
            self._library.call("twz_window_decode", window, handles.workers)
        finally:
            handles.pool_lock.release()


def _box_around(rows: NDArray[np.int64], cols: NDArray[np.int64]) -> Region:
    row, col = int(rows.min()), int(cols.min())
    return Region(row, col, int(rows.max()) - row + 1, int(cols.max()) - col + 1)
