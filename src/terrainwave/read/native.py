"""Windows decoded by the native library, where the package has one.

It decodes the same heights as `read.decoder` does, without kernels that have to be compiled. What
it cannot read, and what is damaged, is left to that one: it says what is wrong, in its own words.
"""

import ctypes
import logging
import os
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.native_library import NativeError, NativeLibrary, is_wanted, loaded
from terrainwave.container.reader import Container
from terrainwave.container.sources.ranges import ByteRange, RoundReader
from terrainwave.forks import renew_after_fork
from terrainwave.grid.quadtree import Region

__all__ = ["Library", "NativeError", "NativeFile", "installed", "is_wanted"]

_log = logging.getLogger(__name__)

_N_POINTERS = 5  # of twz_allocator, and of twz_locks

_MAX_BYTES = 4 << 30
# Samples of the parts whose payloads are fetched in one call, and of those that are decoded in one:
# few, so that memory serves again and again; but more where many threads are to have work.
_MOST_FETCHED, _MOST_DECODED = 1 << 24, 1 << 22
_MANY_THREADS = 5
# What is kept of decoded units while a region of several parts is read: not the region itself.
_KEPT_OF_LARGE = 48 << 20
_BILINEAR = 0  # of twz_interpolation
# Ranges that are asked for in one call.
_MOST_RANGES = 256


def _structure(**members: Any) -> Any:
    """Return a structure of the library; members in their order, with their types."""
    return type("_Structure", (ctypes.Structure,), {"_fields_": [*members.items()]})


_U64, _U32, _INT = ctypes.c_uint64, ctypes.c_uint32, ctypes.c_int
_POINTER, _SIZE, _STRIDE = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_ssize_t
_POINTERS = _POINTER * _N_POINTERS
_Options = _structure(
    size=_SIZE, allocator=_POINTERS, locks=_POINTERS, cache_bytes=_U64, max_bytes=_U64, kernels=_INT
)
_Range = _structure(offset=_U64, length=_U64, is_page=_U64, reserved=_U64)
_Box = _structure(row=_U32, col=_U32, n_rows=_U32, n_cols=_U32)
_PointsRequest = _structure(
    size=_SIZE, level=_INT, interpolation=_INT, is_own=_INT, n_points=_SIZE, rows=_POINTER,
    cols=_POINTER, heights=_POINTER, valid=_POINTER,
)  # fmt: skip

_HANDLE = ctypes.POINTER(ctypes.c_void_p)
_N = ctypes.POINTER(ctypes.c_size_t)
_RANGES, _BOX = map(ctypes.POINTER, (_Range, _Box))
# Of functions that return a status, all but the last argument, which is the error.
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "twz_file_new": (ctypes.POINTER(_Options), ctypes.c_uint64, _HANDLE),
    "twz_file_need": (_POINTER, _RANGES, _SIZE, _N),
    "twz_file_feed": (_POINTER, ctypes.c_uint64, ctypes.c_char_p, _SIZE),
    "twz_window_new": (_POINTER, ctypes.c_int, _BOX, _HANDLE),
    "twz_window_need": (_POINTER, _RANGES, _SIZE, _N),
    "twz_window_feed": (_POINTER, ctypes.c_uint64, ctypes.c_char_p, _SIZE),
    "twz_window_decode": (_POINTER, _POINTER),
    "twz_window_decode_into": (_POINTER, _POINTER, _POINTER, _STRIDE, _POINTER, _STRIDE),
    "twz_window_read": (_POINTER, _POINTER, _STRIDE, _POINTER, _STRIDE),
    "twz_window_read_own": (_POINTER, _POINTER, _STRIDE),
    "twz_points_new": (_POINTER, ctypes.POINTER(_PointsRequest), _HANDLE),
    "twz_points_need": (_POINTER, _RANGES, _SIZE, _N),
    "twz_points_feed": (_POINTER, ctypes.c_uint64, ctypes.c_char_p, _SIZE),
    "twz_points_decode": (_POINTER, _POINTER, _N),
    "twz_pool_new": (_SIZE, _HANDLE),
}


class Library:
    """The functions of the library that read; those that can fail raise."""

    def __init__(self, native: NativeLibrary) -> None:
        self.call, self.make = native.call, native.make
        native.declare(_SIGNATURES)
        self.free_window = native.plain("twz_window_free", None, _POINTER)
        self.free_points = native.plain("twz_points_free", None, _POINTER)
        self.free_file = native.plain("twz_file_free", None, _POINTER)
        self.free_pool = native.plain("twz_pool_free", None, _POINTER)
        self.workers_of = native.plain("twz_pool_workers", _POINTER, _POINTER)
        self.new_locks = native.plain("twz_python_locks_new", _POINTER)
        self.limit_cache = native.plain("twz_file_limit_cache", None, _POINTER, ctypes.c_uint64)
        self.allocator = native.plain("twz_python_allocator", _POINTER)()
        self.free_locks = native.plain("twz_python_locks_free", None, _POINTER)


@cache
def installed() -> Library | None:
    """Return the package's library; None without one that fits."""
    native = loaded()
    if native is None:
        return None
    _log.info("the native library reads heights: %s", native.path)
    return Library(native)


class _Handles:
    """Memory that the library has allocated for one open file."""

    def __init__(self, library: Library, size: int, cache_bytes: int, n_threads: int) -> None:
        self.library = library
        self.file = self.pool = self.workers = None
        self.pool_lock = threading.Lock()
        self.n_users = self.n_large = 0
        self.cache_bytes = max(cache_bytes, 0)
        self._process = os.getpid()
        self.locks = library.new_locks()
        try:
            if self.locks is None:
                raise MemoryError("no memory for locks")
            options = _Options(ctypes.sizeof(_Options))
            options.allocator = _POINTERS.from_address(library.allocator)
            options.locks = _POINTERS.from_address(self.locks)
            options.cache_bytes, options.max_bytes = self.cache_bytes, _MAX_BYTES
            self.file = library.make("twz_file_new", ctypes.byref(options), size)
            if n_threads > 1:
                self.pool = library.make("twz_pool_new", n_threads)
                self.workers = library.workers_of(self.pool)
        except BaseException:
            self.free()
            raise

    def limit_cache(self) -> None:
        """Tell the library how much to keep from now on."""
        most = min(self.cache_bytes, _KEPT_OF_LARGE) if self.n_large else self.cache_bytes
        self.library.limit_cache(self.file, most)

    @contextmanager
    def lent_workers(self) -> Iterator[int | None]:
        """Lend the threads; None without threads, or while another call has them."""
        if self.workers is None or not self.pool_lock.acquire(blocking=False):
            yield None
            return
        try:
            yield self.workers
        finally:
            self.pool_lock.release()

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
        self._container, self._header = container, container.header
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

    @contextmanager
    def _opened(self, *, is_large: bool = False) -> Iterator[_Handles]:
        """Lend the open file; it stays until the end of the `with` block.

        While some read a large region, fewer units are kept.
        """
        with self._lock:
            if self._handles is None:
                self._handles = self._open()
            handles = self._handles
            handles.n_users += 1
            handles.n_large += is_large
            handles.limit_cache()
        try:
            yield handles
        finally:
            with self._lock:
                handles.n_users -= 1
                handles.n_large -= is_large
                handles.limit_cache()
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
            self._fetch(self._container.rounds(), "file", handles.file)
        except NativeError as error:
            self._finalizer()
            self._refusal = error
            raise
        except BaseException:
            self._finalizer()
            raise
        return handles

    def _fetch(self, rounds: RoundReader, kind: str, handle: Any) -> None:
        """Give a file or a window the bytes it needs, all in one request a round."""
        ranges, n = (_Range * _MOST_RANGES)(), ctypes.c_size_t()
        while True:
            name = f"twz_{kind}_need"
            self._library.call(name, handle, ranges, _MOST_RANGES, ctypes.byref(n))
            wanted = [(ByteRange(one.offset, one.length), one.is_page) for one in ranges[: n.value]]
            if not wanted:
                return
            # Pages that are here may tell more of what is to be fetched.
            here = [part for part, is_page in wanted if is_page and rounds.has(part)]
            if not here:
                here = [part for part, _ in wanted]
                rounds.fetch(here)
            for part in here:
                data = rounds.take(part)
                self._library.call(f"twz_{kind}_feed", handle, part.offset, data, part.length)

    def window(
        self, level: int, region: Region, *, is_own: bool
    ) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return raw heights of a region of a level and what is void, as `WindowReader.read`."""
        heights = np.empty(region.shape, dtype=np.dtype(self._header.dtype))
        void: NDArray[np.bool_] | None = None
        most = _MOST_DECODED if self._n_threads < _MANY_THREADS else _MOST_FETCHED
        is_large = region.n_rows * region.n_cols > most
        with self._opened(is_large=is_large) as handles:
            for whole in self._parts(level, region, _MOST_FETCHED):
                parts = list(self._parts(level, whole, most))
                rounds = self._container.rounds()
                if len(parts) > 1:
                    with self._window(handles, level, whole) as window:
                        self._fetch(rounds, "window", window)
                for part in parts:
                    at = part.slices_in(region)
                    with self._window(handles, level, part) as window:
                        self._fetch(rounds, "window", window)
                        valid = self._decode(handles, window, level, heights[at], is_own=is_own)
                    if void is None and not valid.all():
                        void = np.zeros(region.shape, dtype=np.bool_)
                    if void is not None:
                        np.logical_not(valid, out=void[at])
        return heights, void

    def bilinear(
        self,
        level: int,
        rows: NDArray[np.float64],
        cols: NDArray[np.float64],
        *,
        is_own: bool,
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return bilinear raw heights at positions inside a level, and which involve a void."""
        places = np.ascontiguousarray(rows), np.ascontiguousarray(cols)
        found = np.empty(rows.size), np.empty(rows.size, dtype=np.bool_)
        arrays = (array.ctypes.data for array in (*places, *found))
        size = ctypes.sizeof(_PointsRequest)
        asked = _PointsRequest(size, level, _BILINEAR, is_own, rows.size, *arrays)
        n_left = ctypes.c_size_t(rows.size)
        with self._opened() as handles:
            points = self._library.make("twz_points_new", handles.file, ctypes.byref(asked))
            try:
                while n_left.value:
                    self._fetch(self._container.rounds(), "points", points)
                    with handles.lent_workers() as workers:
                        self._library.call(
                            "twz_points_decode", points, workers, ctypes.byref(n_left)
                        )
            finally:
                self._library.free_points(points)
        return found[0], ~found[1]

    def _side(self, level: int) -> int:
        block = self._header.grid.block
        return block if level == 0 else 2 * block

    def _parts(self, level: int, region: Region, most: int) -> Iterator[Region]:
        """Yield parts of a region, of about `most` samples or one unit, which fill it.

        They end where those of any region do: between them they have few units above in common.
        """
        side = self._side(level)
        while 4 * side**2 <= most:
            side *= 2
        rows, cols = (
            [first, *range((first // side + 1) * side, first + n, side), first + n]
            for first, n in zip(region[:2], region.shape, strict=True)
        )
        for row, below in pairwise(rows):
            for col, right in pairwise(cols):
                yield Region(row, col, below - row, right - col)

    @contextmanager
    def _window(self, handles: _Handles, level: int, region: Region) -> Iterator[int]:
        """Make a window, and free it at the end of the `with` block."""
        box = _Box(region.row, region.col, region.n_rows, region.n_cols)
        window = self._library.make("twz_window_new", handles.file, level, ctypes.byref(box))
        try:
            yield window
        finally:
            self._library.free_window(window)

    def _decode(
        self, handles: _Handles, window: int, level: int, heights: NDArray[Any], *, is_own: bool
    ) -> NDArray[np.bool_]:
        """Decode a window that has its bytes; fill `heights` and return what is valid.

        Of a large one nothing is kept: its units are decoded where the samples are wanted.
        """
        library = self._library
        # On the full grid, and where the file does not tell fills, what is valid is so by itself.
        is_own &= self._header.has_voids and level < self._header.grid.k_max
        valid = np.empty(heights.shape, dtype=np.bool_)
        out = heights.ctypes.data, heights.strides[0], valid.ctypes.data, 0
        given: tuple[int, ...] = out
        name = "twz_window_decode_into"
        if is_own or heights.size < 4 * self._side(level) ** 2:
            name, given = "twz_window_decode", ()
        with handles.lent_workers() as workers:
            library.call(name, window, workers, *given)
        if not given:
            to, stride, shown, shown_stride = out
            library.call(
                "twz_window_read", window, to, stride, None if is_own else shown, shown_stride
            )
        if is_own:
            library.call("twz_window_read_own", window, valid.ctypes.data, 0)
        return valid
