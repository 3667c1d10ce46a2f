"""Configuration of numba, all in this module, which `jit` imports for the first kernel called."""

import hashlib
import os
import re
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from typing import Any

from numba import njit, typeof, types
from numba.core import config, event
from numba.core.compiler_lock import global_compiler_lock

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
    for source in sorted({*sources_of(path), *sources_of(__file__)}):
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


def part_of_kernels(function: Callable[..., Any]) -> Any:
    """Return numba's dispatcher of a `jit.kernel_part`."""
    return njit(inline="always", nogil=True)(function)


def compiled(function: Callable[..., Any], *, is_inlined: bool) -> Any:
    """Return numba's dispatcher of a kernel; plain Python under NUMBA_DISABLE_JIT.

    A stale compiled kernel is a broken bound, and numba checks only the kernel's own file. So the
    stamp of each cache entry is a digest of `sources_of` that file, and of this one.
    """
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


def is_kept(kernel: Any, arguments: tuple[Any, ...]) -> bool:
    """Return whether the cache has a kernel for some arguments."""
    if config.DISABLE_JIT:
        return True  # nothing to compile
    found, context = tuple(map(typeof, arguments)), kernel.targetctx
    # The lookup updates numba's tables, so not while another thread compiles.
    with global_compiler_lock:
        return kernel._cache.load_overload(found, context) is not None


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
