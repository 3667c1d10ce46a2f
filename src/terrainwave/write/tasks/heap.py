"""Keep freed memory while tasks run, where glibc allocates.

dask's nannies set MALLOC_TRIM_THRESHOLD_ to 64 KiB to keep idle workers small. The system then
reclaims the pages of nearly every array and clears others for the next one, which costs a worker
nearly as much processor time as the tasks themselves.
"""

import ctypes
import os
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import cache

_VARIABLE = "MALLOC_TRIM_THRESHOLD_"
# From glibc's malloc.h: its default threshold for arrays that are mapped one by one, and the
# largest.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_MMAP_DEFAULT, _MMAP_MOST = 128 << 10, 32 << 20
# Bytes that may stay free at the end of a heap.
_KEPT = 256 << 20
# Seconds without a task after which all free memory is returned.
_IDLE_SECONDS = 2.0


class _Heap:
    """Allocator of this process, configured to keep freed memory while tasks run."""

    def __init__(self, library: ctypes.CDLL, threshold: int) -> None:
        self._library = library
        self._threshold = threshold
        self._lock = threading.Lock()
        self._n_tasks = 0
        self._idle: threading.Timer | None = None

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Keep memory freed in the block, and for a while after it: another task may follow."""
        with self._lock:
            if self._idle is not None:
                self._idle.cancel()
                self._idle = None
            self._n_tasks += 1
            self._set(_KEPT, _MMAP_MOST)
        try:
            yield
        finally:
            with self._lock:
                self._n_tasks -= 1
                if self._n_tasks == 0:
                    self._idle = threading.Timer(_IDLE_SECONDS, self._give_back)
                    self._idle.daemon = True
                    self._idle.start()

    def _give_back(self) -> None:
        with self._lock:
            if self._n_tasks == 0:
                self._set(self._threshold, _MMAP_DEFAULT)
                self._library.malloc_trim(0)

    def _set(self, trim: int, mmap: int) -> None:
        self._library.mallopt(_TRIM_THRESHOLD, trim)
        self._library.mallopt(_MMAP_THRESHOLD, mmap)


def kept_heap() -> AbstractContextManager[None]:
    """Keep the memory that a task frees; also by several threads at a time.

    Without effect unless MALLOC_TRIM_THRESHOLD_ makes glibc return nearly all of it at once.
    """
    heap = _heap()
    return nullcontext() if heap is None else heap.kept()


@cache
def _heap() -> _Heap | None:
    threshold = os.environ.get(_VARIABLE, "")
    if threshold.isdecimal() and int(threshold) < _KEPT:
        with suppress(OSError, TypeError, AttributeError):
            library = ctypes.CDLL(None)
            library.gnu_get_libc_version  # noqa: B018  other libraries have none
            return _Heap(library, int(threshold))
    return None
