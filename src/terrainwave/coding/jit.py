"""Decorators of kernels.

Importing numba takes longer than reading a file with the native library. So a kernel is handed to
numba, by `compiled`, when it is called for the first time.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, update_wrapper
from importlib.util import find_spec
from types import CodeType, FunctionType
from typing import Any

from terrainwave.coding.kernel_places import KernelPlace


class _Lock:
    """Lock of all kernels that are handed to numba."""

    def __init__(self) -> None:
        from terrainwave.forks import renew_after_fork  # no source of kernels

        self.renew()
        renew_after_fork(self)

    def renew(self) -> None:
        """Begin anew after a fork, which may have left the lock held."""
        self.held = threading.RLock()


_LOCK = _Lock()


class Later:
    """A function whose compiled form is made for its first call.

    Names by which the function calls others then stand for their compiled forms, in its module.

    Attributes
    ----------
    py_func : function
        The function in plain Python, as numba's dispatchers have it.
    """

    def __init__(self, function: Callable[..., Any], make: Callable[..., Any]) -> None:
        update_wrapper(self, function)
        self.py_func: Any = function
        self._make, self._made, self._is_ready = make, None, False

    def __call__(self, *arguments: Any) -> Any:
        return self.made()(*arguments)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the compiled form."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.made(), name)

    def made(self) -> Any:
        """Return the compiled form."""
        if self._is_ready:
            return self._made
        with _LOCK.held:
            if self._made is None:
                self._made = self._make(self.py_func)
                # Functions may call each other in a ring.
                names = self.py_func.__globals__
                for name in _names_in(self.py_func.__code__):
                    if isinstance(names.get(name), Later):
                        names[name] = names[name].made()
                self._is_ready = True
            return self._made


def _names_in(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in the code of a function, and of inner ones."""
    inner = [_names_in(const) for const in code.co_consts if isinstance(const, CodeType)]
    return set(code.co_names).union(*inner)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` with the project's options; plain Python under NUMBA_DISABLE_JIT."""
    return Later(function, lambda own: _compiled().compiled(own, is_inlined=False))


def inlined_kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` as `kernel` does, into its callers.

    For functions with many arguments in hot loops: each array takes seven registers or stack slots.
    """
    return Later(function, lambda own: _compiled().compiled(own, is_inlined=True))


def kernel_part(function: Callable[..., Any]) -> Any:
    """Make `function` a part of the kernels that call it, as if its text stood there.

    Numba copies it in before type inference, which costs less than a call. With two calls it is
    there twice.
    """
    return Later(function, lambda own: _compiled().part_of_kernels(own))


def rare_kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` as `kernel` does, once plain Python has taken long enough for it.

    For rare calls from Python with little data, which compilation would never repay. Kernels cannot
    call it.
    """
    return _RareKernel(kernel(function))


# Seconds that plain Python may take for a rare kernel in a process: a few files' worth. Then it is
# compiled, in about a second, for this process and all later ones.
_MOST_PLAIN_SECONDS = 0.15
# And so many where numba is not even imported, which takes as long.
_SECONDS_OF_IMPORT = 1.0
_is_patient = True


@contextmanager
def all_compiled() -> Iterator[None]:
    """Compile rare kernels, too, when they are called."""
    global _is_patient
    before, _is_patient = _is_patient, False
    try:
        yield
    finally:
        _is_patient = before


class _RareKernel:
    """Result of `rare_kernel`."""

    def __init__(self, compiled: Later) -> None:
        self._compiled = compiled
        self._is_compiled = False
        self._seconds = 0.0

    def __call__(self, *arguments: Any) -> Any:
        if not self._is_compiled:
            self._is_compiled = not (_is_patient and self._is_cheap(arguments))
        if self._is_compiled:
            return self._compiled(*arguments)
        start = time.perf_counter()
        try:
            return self._plain(*arguments)
        finally:
            self._seconds += time.perf_counter() - start

    def _is_cheap(self, arguments: tuple[Any, ...]) -> bool:
        """Return whether to use plain Python: it took little time, and nothing is compiled."""
        if not _has_numba():
            return self._seconds < _SECONDS_OF_IMPORT or find_spec("numba") is None
        if self._seconds > 0:
            return self._seconds < _MOST_PLAIN_SECONDS
        return not _compiled().is_kept(self._compiled.made(), arguments)

    @cached_property
    def _plain(self) -> Callable[..., Any]:
        return _as_plain(self._compiled, {})


def _as_plain(kernel: Any, done: dict[Any, Callable[..., Any]]) -> Callable[..., Any]:
    """Return a kernel as plain Python, with its callees as plain Python, too."""
    function = kernel.py_func
    if function not in done:
        names = dict(function.__globals__)
        plain = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
        done[function] = plain
        for name in function.__code__.co_names:
            if hasattr(names.get(name), "py_func"):
                names[name] = _as_plain(names[name], done)
    return done[function]


def place_of_kernels() -> KernelPlace:
    """Return the cache of this package's kernels, or the reason for its absence."""
    place: KernelPlace = _compiled().place_of_kernels()
    return place


_callbacks: list[Callable[[KernelPlace], None]] = []


def on_first_compilation(callback: Callable[[KernelPlace], None]) -> None:
    """Call `callback` once, with the place of the cache, if and when a kernel is compiled."""
    _callbacks.append(callback)
    if _has_numba():
        _compiled()


def _has_numba() -> bool:
    """Return whether a kernel has been handed to numba, so that it is imported."""
    return "terrainwave.coding.compiled" in sys.modules


def _compiled() -> Any:
    """Return the module that hands kernels to numba."""
    from terrainwave.coding import compiled

    while _callbacks:
        compiled.on_first_compilation(_callbacks.pop())
    return compiled
