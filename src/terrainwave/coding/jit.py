"""Configuration of numba, all in this module."""

import hashlib
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property, lru_cache
from types import FunctionType
from typing import Any

from numba import njit, typeof, types
from numba.core import config, event
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from terrainwave.coding.dispatchers import COMPILER, WHY_NOT_KEPT, Kernel, KernelCache
from terrainwave.coding.kernel_places import KernelPlace

# Numba does not notice edits in a callee's file; disable caching while editing.
_CACHE = not WHY_NOT_KEPT

# The directory that contains the package.
_ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

# Imports at the start of a line: kernels see no others. The literal start makes the search fast.
_IMPORT = re.compile(r"\nfrom (terrainwave[\w.]*) import (\([^)]*\)|[^\n#]*)")
_NAME = re.compile(r"(\w+)(?: as \w+)?")


def sources_of(path: str) -> list[str]:
    """Return the files whose text can change the results of one file's kernels, sorted.

    The file itself and its imports from the package, recursively. Imports within functions and
    under TYPE_CHECKING don't count: kernels do not see their names.
    """
    sources: set[str] = set()
    waiting = [os.path.abspath(path)]
    while waiting:
        path = waiting.pop()
        if path not in sources:
            sources.add(path)
            waiting.extend(_read(path)[1])
    return sorted(sources)


@lru_cache(None)
def _digest(path: str) -> str:
    """Return a digest of `sources_of` a file, of when the process first asks."""
    digest = hashlib.sha256()
    for source in sources_of(path):
        digest.update(_read(source)[0])
    return digest.hexdigest()


@lru_cache(None)
def _read(path: str) -> tuple[bytes, list[str]]:
    """Return the digest of a file's text, and the files of the package that it imports."""
    with open(path, "rb") as file:
        data = file.read()
    text = "\n" + data.decode("utf-8")
    imported = [
        source for match in _IMPORT.finditer(text) for source in _files_of(match[1], match[2])
    ]
    return hashlib.sha256(data).digest(), imported


def _files_of(module: str, names: str) -> Iterator[str]:
    """Yield the files that define the names of ``from module import names``."""
    place = os.path.join(_ROOT, *module.split("."))
    if os.path.isfile(f"{place}.py"):
        yield f"{place}.py"
        return
    for name in _NAME.findall(names):
        is_module = os.path.isfile(os.path.join(place, f"{name}.py"))
        yield os.path.join(place, f"{name}.py" if is_module else "__init__.py")


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` with the project's options; plain Python under NUMBA_DISABLE_JIT.

    A stale compiled kernel is a broken bound, and numba checks only the kernel's own file. So the
    stamp of each cache entry is a digest of `sources_of` that file.
    """
    return _compile(function, is_inlined=False)


def inlined_kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` as `kernel` does, into its callers.

    For functions with many arguments in hot loops: each array takes seven registers or stack slots.
    """
    return _compile(function, is_inlined=True)


def kernel_part(function: Callable[..., Any]) -> Any:
    """Make `function` a part of the kernels that call it, as if its text stood there.

    Numba copies it in before type inference, which costs less than a call. With two calls it is
    there twice.
    """
    return njit(inline="always", nogil=True)(function)


def rare_kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` as `kernel` does, once plain Python has taken long enough for it.

    For rare calls from Python with little data, which compilation would never repay. Kernels cannot
    call it.
    """
    compiled = kernel(function)
    return compiled if config.DISABLE_JIT else _RareKernel(compiled)


def _compile(function: Callable[..., Any], *, is_inlined: bool) -> Any:
    if config.DISABLE_JIT:
        return function
    options: dict[str, Any] = {
        "nopython": True,
        "boundscheck": None,  # by NUMBA_BOUNDSCHECK
        "fastmath": False,
        "nogil": True,
        "forceinline": is_inlined,
        # Skip the C wrapper, which is slow to compile.
        "no_cfunc_wrapper": True,
    }
    dispatcher = Kernel(function, targetoptions=options)
    if _CACHE:
        dispatcher._cache = KernelCache(function, _digest, _key_of)
    return dispatcher


# Seconds that plain Python may take for a rare kernel in a process: a few files' worth. Then it is
# compiled, in about a second, for this process and all later ones.
_MOST_PLAIN_SECONDS = 0.15
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

    def __init__(self, compiled: CPUDispatcher) -> None:
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
        if self._seconds > 0:
            return self._seconds < _MOST_PLAIN_SECONDS
        found, context = tuple(map(typeof, arguments)), self._compiled.targetctx
        # The lookup updates numba's tables, so not while another thread compiles.
        with global_compiler_lock:
            return self._compiled._cache.load_overload(found, context) is None

    @cached_property
    def _plain(self) -> Callable[..., Any]:
        return _as_plain(self._compiled, {})


def _as_plain(compiled: CPUDispatcher, done: dict[Any, Callable[..., Any]]) -> Callable[..., Any]:
    """Return a kernel as plain Python, with its callees as plain Python, too."""
    function = compiled.py_func
    if function not in done:
        names = dict(function.__globals__)
        plain = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
        done[function] = plain
        for name in function.__code__.co_names:
            if isinstance(names.get(name), CPUDispatcher):
                names[name] = _as_plain(names[name], done)
    return done[function]


def _key_of(signature: Any) -> tuple[Any, ...]:
    """Return the part of a cache entry's key besides the types of arguments.

    In compiled code the fields of a named tuple are positions. A kernel's file need not import the
    class of a named tuple it is given, so the names of the fields are part of the key.
    """
    return COMPILER, *_fields_of(getattr(signature, "args", signature))


def _fields_of(arguments: Iterable[Any]) -> Iterator[tuple[str, ...]]:
    """Yield the field names of each named tuple among argument types, nested ones too."""
    for argument in arguments:
        inner = argument.type if isinstance(argument, types.Optional) else argument
        is_tuple = isinstance(inner, types.BaseTuple)
        if is_tuple:
            yield getattr(inner, "fields", ())
            yield from _fields_of(inner)


def place_of_kernels() -> KernelPlace:
    """Return the cache of this package's kernels, or the reason for its absence."""
    if not _CACHE:
        return KernelPlace((), reason=WHY_NOT_KEPT)
    return KernelCache(place_of_kernels, _digest, _key_of).place


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
