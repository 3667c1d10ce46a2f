"""Caches of kernels: numba's own, in the folders that `kernel_places` says.

A locator is numba's way to say where the cache of a function lies and what it holds for. What else
is private to numba is checked before any of it is used (`missing_names`).
"""

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from typing import Any

from numba.core import caching, config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.compiler import CompileResult
from numba.core.registry import CPUDispatcher

from terrainwave.coding.kernel_places import ADVICE, KernelPlace, keep, lose, place_of
from terrainwave.coding.private_names import missing

# Settings of numba that change the code which it makes of a kernel, and that its own key does not
# have: that has the processor and its features.
_SETTINGS = (
    "BOUNDSCHECK",
    "OPT",
    "LOOP_VECTORIZE",
    "SLP_VECTORIZE",
    "DISABLE_INTEL_SVML",
    "LLVM_REFPRUNE_PASS",
    "LLVM_REFPRUNE_FLAGS",
    "DEBUGINFO_DEFAULT",
    "EXTEND_VARIABLE_LIFETIMES",
    "ENABLE_PROFILING",
    "JIT_COVERAGE",
)

_log = logging.getLogger(__name__)


def _settings() -> tuple[str, ...]:
    """Return the settings of numba that change generated code.

    A process that checks bounds must not take kernels without checks, nor the other way round.
    """
    return tuple(str(getattr(config, name, None) or 0) for name in _SETTINGS)


class _Locator(_CacheLocator):
    """Says where the cache of a function lies, and what it holds for."""

    def __init__(self, folder: str, stamp: Any, function: Callable[..., Any]) -> None:
        self._folder = folder
        self._stamp = stamp
        self._py_file = function.__code__.co_filename
        self._line = function.__code__.co_firstlineno

    def from_function(self, py_func: Any, py_file: Any) -> "_Locator":  # noqa: ARG002, numba's
        """Return the locator of a function: it is made for one."""
        return self

    def get_cache_path(self) -> str:
        """Return the folder."""
        return self._folder

    def get_source_stamp(self) -> Any:
        """Return what an entry must have been made with."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Return what tells apart functions of one name."""
        return str(self._line)


class _Stored(CompileResultCacheImpl):
    """What a file of the cache holds: also what it was compiled for.

    Two processes that compile a function at once may give two files one number. Then the index says
    that a file holds code for certain types, a processor and settings, and it holds other code.
    """

    def reduce(self, compiled: Any) -> Any:
        """Return what is stored."""
        return (compiled.codegen.magic_tuple(), _settings()), super().reduce(compiled)

    def rebuild(self, target_context: Any, stored: Any) -> Any:
        """Return what was stored, or refuse it."""
        made_for, data = stored
        if made_for != (target_context.codegen().magic_tuple(), _settings()):
            raise ValueError("compiled for another processor, or by other settings of numba")
        return super().rebuild(target_context, data)


class _Entries(FunctionCache):
    """Numba's cache of a function, in the folder that a locator says."""

    _impl_class: Any = _Stored

    def __init__(self, kernel: "KernelCache", folder: str | None) -> None:
        self._kernel = kernel
        if folder is not None:
            locator = _Locator(folder, kernel.stamp, kernel.function)
            self._impl_class = type("_Here", (_Stored,), {"_locator_classes": [locator]})
        super().__init__(kernel.function)
        if folder is None:  # where numba finds one, the sources of callees count, too
            self._cache_file._source_stamp = self._cache_file._source_stamp, kernel.stamp

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return what has been compiled for some types, or None; refuse what is damaged."""
        found = super().load_overload(signature, target_context)
        if found is not None and found.signature.args != tuple(
            getattr(signature, "args", signature)
        ):
            raise ValueError("compiled for other types")
        return found

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, ...]:
        own = *self._kernel.key_of(signature), *_settings()
        return (*super()._index_key(signature, codegen), *own)


class KernelCache:
    """What a dispatcher of numba's has for a cache: that of one kernel.

    Parameters
    ----------
    function : callable
        As Python has it.
    stamp_of : callable
        Returns, for the path of the function's file, what must not change as long as an entry
        holds. Raises OSError if there is no such file.
    key_of : callable
        Returns, for types of arguments, what an entry must have in common with them besides.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        stamp_of: Callable[[str], str],
        key_of: Callable[[Any], tuple[Any, ...]],
    ) -> None:
        self.function = function
        self.key_of = key_of
        self.stamp = self._reason = ""
        source = function.__code__.co_filename
        try:
            # Now, not when it is compiled: by then others may have replaced the sources.
            self.stamp = stamp_of(source)
        except OSError as error:  # in a zip, for one
            reason = error.strerror or error
            self._reason = f"{source} cannot be read ({reason}); install the package as files"

    @property
    def place(self) -> KernelPlace:
        """Where entries are."""
        return self._found[0]

    @cached_property
    def _found(self) -> tuple[KernelPlace, tuple[_Entries, ...]]:
        if self._reason:
            return KernelPlace((), reason=self._reason), ()
        if not getattr(config, "CACHE_LOCATOR_CLASSES", ""):
            place = place_of(self.function.__code__.co_filename)
            return place, tuple(_Entries(self, folder) for folder in place.folders)
        try:
            entries = _Entries(self, None)
        except RuntimeError as error:  # none of them finds a place
            reason = f"NUMBA_CACHE_LOCATOR_CLASSES is set, and {error}; unset it"
            return KernelPlace((), reason=reason), ()
        return KernelPlace((entries.cache_path,), entries.cache_path), (entries,)

    @property
    def cache_path(self) -> str | None:
        """Where what is compiled now is kept."""
        return None if self.place.kept_in is None else self.place.folders[-1]

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return what has been compiled for some types, or None."""
        for entries in self._found[1]:
            try:
                found = entries.load_overload(signature, target_context)
            except Exception:  # noqa: BLE001  not readable, or damaged: it is compiled again
                found = None
                if entries.cache_path == self.cache_path:
                    with suppress(OSError):
                        entries.flush()
            if found is not None:
                return found
        return None

    def save_overload(self, signature: Any, data: Any) -> None:
        """Keep what has been compiled for some types."""
        if self.place.kept_in is None:
            lose(self.place.reason)
            return
        try:
            self._found[1][-1].save_overload(signature, data)
        except OSError as error:  # a full disk, for one: the kernel is there all the same
            reason = error.strerror or error
            lose(f"{self.place.kept_in} cannot be written ({reason}); {ADVICE}")
        else:
            _log.debug("compiled a kernel and kept it in %s", self.place.kept_in)
            keep()

    def flush(self) -> None:
        """Forget what is kept."""
        if self.place.kept_in is not None:
            self._found[1][-1].flush()

    def enable(self) -> None:
        """Do nothing: it is there to be used."""

    def disable(self) -> None:
        """Do nothing: ``TERRAINWAVE_NUMBA_CACHE=0`` does it."""


def missing_names() -> list[str]:
    """Return the names of numba's that are used here, and are not where they were."""
    return missing(
        {
            caching.Cache: (
                "_impl_class",
                "_index_key(self, sig, codegen)",
                "load_overload(self, sig, target_context)",
                "save_overload(self, sig, data)",
                "flush(self)",
            ),
            CompileResultCacheImpl: (
                "_locator_classes",
                "reduce(self, cres)",
                "rebuild(self, target_context, payload)",
            ),
            CompileResult: ("codegen", "signature"),
            caching.IndexDataCacheFile: ("_source_stamp",),
            FunctionCache: ("_cache_file", "cache_path"),
            _CacheLocator: ("get_cache_path", "get_source_stamp", "get_disambiguator"),
            CPUDispatcher: ("_cache",),
        }
    )
