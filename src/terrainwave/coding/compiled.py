"""Configuration of numba, all in this module, which `jit` imports for the first kernel called.

There are two compilers of kernels: the fast one of `compiler`, and numba's own. The fast one takes
0.6 of the time (docs/decisions/0019-how-kernels-are-compiled.md), but uses private parts of numba.
So it is used only with numba releases that CI has tested, and if all names that it needs exist.
With other releases kernels are as fast, and produce the same bytes.
"""

import hashlib
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from typing import Any

import numba
from numba import njit, typeof, types
from numba.core import config, event
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from terrainwave.coding.kernel_places import KernelPlace
from terrainwave.errors import InvalidArgumentError, TerrainwaveWarning

# Minor releases that CI runs (.github/workflows/test.yml: a test compares).
TRIED = ("0.65", "0.66", "0.67", "0.68")

# Selects one of the two; for tests, and to try another release of numba.
VARIABLE = "TERRAINWAVE_COMPILER"


def _chosen() -> tuple[str, type[CPUDispatcher]]:
    """Return the compiler's name and dispatcher; warn if it is not the fast one."""
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "fast", "plain"):
        raise InvalidArgumentError(f"{VARIABLE}: found {asked}, expected fast, plain or nothing")
    if asked == "plain" or config.DISABLE_JIT:
        return "plain", CPUDispatcher
    minor = ".".join(numba.__version__.split(".")[:2])
    if minor not in TRIED and not asked:
        return "plain", _own(f"terrainwave was tried with numba {TRIED[0]} to {TRIED[-1]}")
    try:
        from terrainwave.coding import compiler

        missing = compiler.missing_names()
    except (ImportError, AttributeError, TypeError) as error:
        missing = [str(error)]
    if missing:
        return "plain", _own(f"it lacks what terrainwave's compiler needs: {', '.join(missing)}")
    return "fast", compiler.Kernel


def _own(why: str) -> type[CPUDispatcher]:
    """Return numba's own dispatcher, and warn with the reason."""
    warnings.warn(
        f"numba is {numba.__version__}, and {why}; kernels are compiled by numba alone, which takes"
        " longer the first time and changes nothing else",
        TerrainwaveWarning,
        stacklevel=2,
    )
    return CPUDispatcher


COMPILER, Kernel = _chosen()


def _keeping() -> tuple[Any, str]:
    """Return the class of caches, or None with the reason."""
    if os.environ.get("TERRAINWAVE_NUMBA_CACHE", "1") == "0":
        return None, "TERRAINWAVE_NUMBA_CACHE is 0; unset it"
    if config.DISABLE_JIT:
        return None, "NUMBA_DISABLE_JIT is set; unset it"
    try:
        from terrainwave.coding import kernel_cache

        missing = kernel_cache.missing_names()
    except (ImportError, AttributeError, TypeError) as error:
        missing = [str(error)]
    if not missing:
        return kernel_cache.KernelCache, ""
    # Without our stamp an entry would outlive its sources: a broken bound.
    why = f"numba {numba.__version__} keeps kernels in another way ({', '.join(missing)})"
    warnings.warn(
        f"compiled kernels are not kept: {why}; every run compiles them again",
        TerrainwaveWarning,
        stacklevel=2,
    )
    return None, f"{why}; install a release of numba that terrainwave was tried with"


KernelCache, WHY_NOT_KEPT = _keeping()

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
    if not WHY_NOT_KEPT:
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
    if WHY_NOT_KEPT:
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
