"""Caches of kernels: numba's own, in the folders of `kernel_places`.

A locator is numba's interface for the folder and the validity of a function's cache. Other private
parts of numba are checked before they are used (`missing_names`).
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

# Settings of numba that change the generated code but are not in its own key, which has the
# processor and its features.
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

    A process that checks bounds must not load kernels without checks, nor the other way round.
    """
    return tuple(str(getattr(config, name, None) or 0) for name in _SETTINGS)


class _Locator(_CacheLocator):
    """Folder and validity of a function's cache."""

    def __init__(self, folder: str, stamp: Any, function: Callable[..., Any]) -> None:
        self._folder = folder
        self._stamp = stamp
        self._py_file = function.__code__.co_filename
        self._line = function.__code__.co_firstlineno

    def from_function(self, py_func: Any, py_file: Any) -> "_Locator":  # noqa: ARG002, numba's
        return self

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> Any:
        """Return the stamp that entries must match."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Return a suffix that distinguishes functions of one name."""
        return str(self._line)


class _Stored(CompileResultCacheImpl):
    """Contents of a cache file, including what it was compiled for.

    Two processes that compile a function at once may give two files one number. Then the index may
    list a file for some types, a processor and settings, although it holds other code.
    """

    def reduce(self, compiled: Any) -> Any:
        """Return the contents to store."""
        return (compiled.codegen.magic_tuple(), _settings()), super().reduce(compiled)

    def rebuild(self, target_context: Any, stored: Any) -> Any:
        """Return the stored code, or raise if it does not match."""
        made_for, data = stored
        if made_for != (target_context.codegen().magic_tuple(), _settings()):
            raise ValueError("compiled for another processor, or by other settings of numba")
        return super().rebuild(target_context, data)


class _Entries(FunctionCache):
    """Numba's cache of a function, in a locator's folder."""

    _impl_class: Any = _Stored

    def __init__(self, kernel: "KernelCache", folder: str | None) -> None:
        self._kernel = kernel
        if folder is not None:
            locator = _Locator(folder, kernel.stamp, kernel.function)
            self._impl_class = type("_Here", (_Stored,), {"_locator_classes": [locator]})
        super().__init__(kernel.function)
        if folder is None:  # in numba's own place, the sources of callees count, too
            self._cache_file._source_stamp = self._cache_file._source_stamp, kernel.stamp

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the code compiled for some types, or None; raise if it is damaged."""
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
    """Cache of one kernel, with the interface that numba's dispatchers expect.

    Parameters
    ----------
    function : callable
        The Python function.
    stamp_of : callable
        Returns, for the path of the function's file, a stamp that changes when entries become
        invalid. Raises OSError if there is no such file.
    key_of : callable
        Returns, for argument types, the rest of an entry's key.
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
            # Taken now, because the sources may be replaced before the compilation.
            self.stamp = stamp_of(source)
        except OSError as error:  # in a zip, for example
            reason = error.strerror or error
            self._reason = f"{source} cannot be read ({reason}); install the package as files"

    @property
    def place(self) -> KernelPlace:
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
        except RuntimeError as error:  # no locator finds a place
            reason = f"NUMBA_CACHE_LOCATOR_CLASSES is set, and {error}; unset it"
            return KernelPlace((), reason=reason), ()
        return KernelPlace((entries.cache_path,), entries.cache_path), (entries,)

    @property
    def cache_path(self) -> str | None:
        """Return the folder for newly compiled code."""
        return None if self.place.kept_in is None else self.place.folders[-1]

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the code compiled for some types, or None."""
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
        """Store the code compiled for some types."""
        if self.place.kept_in is None:
            lose(self.place.reason)
            return
        try:
            self._found[1][-1].save_overload(signature, data)
        except OSError as error:  # for example a full disk: the kernel works anyway
            reason = error.strerror or error
            lose(f"{self.place.kept_in} cannot be written ({reason}); {ADVICE}")
        else:
            _log.debug("compiled a kernel and kept it in %s", self.place.kept_in)
            keep()

    def flush(self) -> None:
        """Delete all entries."""
        if self.place.kept_in is not None:
            self._found[1][-1].flush()

    def enable(self) -> None:
        """Do nothing: it is always enabled."""

    def disable(self) -> None:
        """Do nothing: ``TERRAINWAVE_NUMBA_CACHE=0`` disables it."""


def missing_names() -> list[str]:
    """Return the names of numba's internals that are used here and missing."""
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
