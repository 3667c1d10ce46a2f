"""Configuration of numba, all in this module, which `jit` imports for the first kernel called.

docs/decisions/0019-how-kernels-are-compiled.md has the reasons.
"""

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numba
from numba import njit, typeof
from numba.core import config, event
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from terrainwave import interrupts
from terrainwave.coding.kernel_cache import KernelCache
from terrainwave.coding.kernel_places import KernelPlace

_OPTIONS = {
    "nopython": True,
    "boundscheck": None,  # by NUMBA_BOUNDSCHECK
    "fastmath": False,
    "nogil": True,
    # Skip the C wrapper, which is slow to compile.
    "no_cfunc_wrapper": True,
}


def _why_not_kept() -> str:
    if os.environ.get("TERRAINWAVE_NUMBA_CACHE", "1") == "0":
        return "TERRAINWAVE_NUMBA_CACHE is 0; unset it"
    return "NUMBA_DISABLE_JIT is set; unset it" if config.DISABLE_JIT else ""


WHY_NOT_KEPT = _why_not_kept()


class Kernel(CPUDispatcher):
    """Numba's dispatcher, quicker to compile."""

    def compile(self, sig: Any) -> Any:
        """Compile for some types, or load the compiled code."""
        interrupts.check()
        with global_compiler_lock, _quickly():
            return super().compile(sig)


# Minor releases that CI runs (.github/workflows/test.yml: a test compares). With others kernels
# take longer to compile, and are the same.
TRIED = ("0.65", "0.66", "0.67", "0.68")


def _shortcuts() -> tuple[tuple[Any, str, Any], ...]:
    if numba.__version__.rpartition(".")[0] not in TRIED:
        return ()
    from terrainwave.coding.shortcuts import SHORTCUTS  # they need names that others may lack

    return SHORTCUTS


_SHORTCUTS = _shortcuts()


@contextmanager
def _quickly() -> Iterator[None]:
    """Compile by shortcuts, and collect no garbage: a compiler makes little.

    The caller must hold the compiler's lock, as shortcuts affect all of numba.
    """
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in _SHORTCUTS]
    was_enabled = gc.isenabled()
    for owner, name, shortcut in _SHORTCUTS:
        setattr(owner, name, shortcut)
    gc.disable()
    try:
        yield
    finally:
        for owner, name, method in before:
            setattr(owner, name, method)
        if was_enabled:
            gc.enable()


def part_of_kernels(function: Callable[..., Any]) -> Any:
    """Return numba's dispatcher of a `jit.kernel_part`."""
    return njit(inline="always", nogil=True)(function)


def compiled(function: Callable[..., Any], *, is_inlined: bool) -> Any:
    """Return numba's dispatcher of a kernel; plain Python under NUMBA_DISABLE_JIT."""
    if config.DISABLE_JIT:
        return function
    dispatcher = Kernel(function, targetoptions=_OPTIONS | {"forceinline": is_inlined})
    if not WHY_NOT_KEPT:
        dispatcher._cache = KernelCache(function)
    return dispatcher


def is_kept(kernel: Any, arguments: tuple[Any, ...]) -> bool:
    """Return whether the cache has a kernel for some arguments."""
    if config.DISABLE_JIT:
        return True  # nothing to compile
    found, context = tuple(map(typeof, arguments)), kernel.targetctx
    # The lookup updates numba's tables, so not while another thread compiles.
    with global_compiler_lock:
        return kernel._cache.load_overload(found, context) is not None


def place_of_kernels() -> KernelPlace:
    """Return the cache of this package's kernels, or the reason for its absence."""
    if WHY_NOT_KEPT:
        return KernelPlace((), reason=WHY_NOT_KEPT)
    return KernelCache(place_of_kernels).place


class _FirstCompilation(event.Listener):
    """Callback on the first compilation of a kernel; cached ones do not count."""

    def __init__(self, callback: Callable[[KernelPlace], None]) -> None:
        self._callback: Callable[[KernelPlace], None] | None = callback

    def on_start(self, event: Any) -> None:
        dispatcher = event.data["dispatcher"]
        if self._callback is None or not isinstance(dispatcher, Kernel):
            return
        callback, self._callback = self._callback, None
        callback(getattr(dispatcher._cache, "place", KernelPlace((), reason=WHY_NOT_KEPT)))

    def on_end(self, event: Any) -> None:
        pass


def on_first_compilation(callback: Callable[[KernelPlace], None]) -> None:
    """Call `callback` once, with the place of the cache, if and when a kernel is compiled."""
    event.register("numba:compile", _FirstCompilation(callback))
