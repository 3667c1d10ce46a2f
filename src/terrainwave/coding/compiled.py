"""Configuration of numba, all in this module, which `jit` imports for the first kernel called.

docs/decisions/0019-how-kernels-are-compiled.md has the reasons.
"""

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numba
from numba import njit, typeof, types
from numba.core import config, event, postproc, transforms
from numba.core.compiler_lock import global_compiler_lock
from numba.core.inline_closurecall import InlineWorker
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
_typed_anew = types.Function.get_call_type
_with_copies = InlineWorker.run_untyped_passes
_in_full = postproc.PostProcessor.run
_typed: dict[Any, Any] = {}
_OF_OPERATIONS = types.Number, types.Boolean, types.Array, types.BaseTuple


def _typed_once(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return the signature of an operation on some types, found once.

    Numba tries each of a dozen templates, and again for each ``+`` of a kernel.
    """
    is_operation = getattr(function.typing_key, "__module__", None) == "_operator" and not kws
    if not (is_operation and all(isinstance(kind, _OF_OPERATIONS) for kind in args)):
        return _typed_anew(function, context, args, kws)
    key = function, args
    if key not in _typed:
        _typed[key] = _typed_anew(function, context, args, kws)
    return _typed[key]


def _without_copies(worker: Any, func: Any, enable_ssa: bool = False) -> Any:
    """Return the IR of a part; nobody else has it, so a copy of a block may be itself."""
    found = _with_copies(worker, func, enable_ssa)
    for block in found.blocks.values():
        block.__deepcopy__ = lambda _memo, block=block: block
    return found


def _processed(processor: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """Process IR after a pass, without the live variables at the start of each block.

    Only generators and interpreted functions need these; numba computes them after most passes.
    """
    func_ir = processor.func_ir
    if func_ir.is_generator:
        _in_full(processor, emit_dels, extend_lifetimes)
        return
    func_ir.blocks = transforms.canonicalize_cfg(func_ir.blocks)
    func_ir.variable_lifetime = postproc.VariableLifetime(func_ir.blocks)
    func_ir.generator_info = None
    if emit_dels:
        processor._insert_var_dels(extend_lifetimes=extend_lifetimes)


_SHORTCUTS: tuple[tuple[Any, str, Any], ...] = (
    (types.Function, "get_call_type", _typed_once),
    (InlineWorker, "run_untyped_passes", _without_copies),
    (postproc.PostProcessor, "run", _processed),
)


@contextmanager
def _quickly() -> Iterator[None]:
    """Compile by shortcuts, and collect no garbage: a compiler makes little.

    The caller must hold the compiler's lock, as shortcuts affect all of numba.
    """
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in _SHORTCUTS]
    was_enabled = gc.isenabled()
    if numba.__version__.rpartition(".")[0] in TRIED:
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
