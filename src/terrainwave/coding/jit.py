"""The one place that configures numba."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import event

# Numba does not notice edits in a callee's file; switch caching off while editing.
_CACHE = os.environ.get("TERRAINWAVE_NUMBA_CACHE", "1") != "0"

_KERNEL_PACKAGES = ("coding", "grid", "codec", "tri", "verification")


def _kernel_source_hash() -> str:
    """Return a digest of every source file that may hold a kernel or a constant of one."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(p for d in _KERNEL_PACKAGES for p in root.glob(f"{d}/*.py")):
        digest.update(path.name.encode("utf-8"))
        digest.update(path.read_bytes())
    return digest.hexdigest()


_SOURCE_HASH = _kernel_source_hash() if _CACHE else ""


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` with the project's options; plain Python under NUMBA_DISABLE_JIT.

    A stale compiled kernel is a broken bound, and numba's cache key holds only the kernel's own
    file. The stamp of each cache entry is therefore extended by a digest of all kernel sources.
    """
    return _compile(function, is_inlined=False)


def inlined_kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` as `kernel` does, into its callers.

    For what a hot loop calls with many arguments: each array takes seven registers or places on the
    stack.
    """
    return _compile(function, is_inlined=True)


def _compile(function: Callable[..., Any], *, is_inlined: bool) -> Any:
    options: dict[str, Any] = {"fastmath": False, "nogil": True, "forceinline": is_inlined}
    if _CACHE:
        try:
            dispatcher = njit(cache=True, **options)(function)
            _extend_cache_stamp(dispatcher)
            return dispatcher
        except (RuntimeError, AttributeError):
            # No writable place for the cache (read-only home), or a numba that stores its stamp
            # elsewhere: compile in every process rather than risk a stale kernel.
            pass
    return njit(cache=False, **options)(function)


def _extend_cache_stamp(dispatcher: Any) -> None:
    if not hasattr(dispatcher, "_cache"):
        return  # NUMBA_DISABLE_JIT: the function itself
    cache_file = dispatcher._cache._cache_file
    cache_file._source_stamp = (cache_file._source_stamp, _SOURCE_HASH)


class _FirstCompilation(event.Listener):
    """Calls back once, when numba compiles rather than takes a kernel from its cache."""

    def __init__(self, callback: Callable[[], None]) -> None:
        self._callback: Callable[[], None] | None = callback

    def on_start(self, event: Any) -> None:
        callback, self._callback = self._callback, None
        if callback is not None:
            callback()

    def on_end(self, event: Any) -> None:
        pass


def on_first_compilation(callback: Callable[[], None]) -> None:
    """Call `callback` once, if and when a kernel is compiled in this process."""
    event.register("numba:compile", _FirstCompilation(callback))
