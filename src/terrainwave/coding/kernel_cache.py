"""Caches of kernels: numba's own, in the folders of `kernel_places`.

A stale kernel is a broken bound, and numba looks only at the kernel's own file. So the stamp of
each cache entry is a digest of all sources of the package, and of the kernel's file.
"""

import hashlib
import logging
import uuid
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

from terrainwave.coding.kernel_places import ADVICE, KernelPlace, keep, lose, place_of

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
_PACKAGE = Path(__file__).parents[1]

_log = logging.getLogger(__name__)


@cache
def _digest_of_package() -> bytes:
    paths = [path for path in sorted(_PACKAGE.rglob("*.py")) if not path.name.startswith(".")]
    texts = [(str(path.relative_to(_PACKAGE)), path.read_bytes()) for path in paths]
    return hashlib.sha256(repr(texts).encode()).digest()


@cache
def stamp_of(path: str) -> str:
    """Return what changes with the sources of a file's kernels.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    return hashlib.sha256(_digest_of_package() + Path(path).read_bytes()).hexdigest()


class _Locator(_CacheLocator):
    """A folder, by numba's interface for it."""

    def __init__(self, folder: str, function: Callable[..., Any]) -> None:
        self._folder = folder
        self._py_file = function.__code__.co_filename
        self._line = function.__code__.co_firstlineno

    def from_function(self, py_func: Any, py_file: Any) -> "_Locator":  # noqa: ARG002, numba's
        return self

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return stamp_of(self._py_file)

    def get_disambiguator(self) -> str:
        """Return a suffix that distinguishes functions of one name."""
        return str(self._line)


class _Entries(FunctionCache):
    """Numba's cache of a function, in a folder unless NUMBA_CACHE_LOCATOR_CLASSES names another."""

    def __init__(self, function: Callable[..., Any], folder: str) -> None:
        locators = {"_locator_classes": [_Locator(folder, function)]}
        self._impl_class: Any = type("_Here", (CompileResultCacheImpl,), locators)
        super().__init__(function)
        files = self._cache_file
        files._source_stamp = stamp_of(function.__code__.co_filename)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save code to a file of a new name, which no process gives to other code.

        Delete those that the index names no more: numba would only write over them.
        """
        files, start = self._cache_file, f"{self._impl.filename_base}."
        files._data_name_pattern = f"{start}{{number}}-{uuid.uuid4().hex[:12]}.nbc"
        super().save_overload(sig, data)
        named = set(files._load_index().values())
        for path in Path(self.cache_path).iterdir():
            if path.name.startswith(start) and path.suffix == ".nbc" and path.name not in named:
                with suppress(OSError):
                    path.unlink()

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, ...]:
        """Return the key of an entry.

        A process that checks bounds must not load kernels without checks, nor the other way round.
        """
        settings = (str(getattr(config, name, None) or 0) for name in _SETTINGS)
        return (*super()._index_key(signature, codegen), *settings)


class KernelCache:
    """Cache of one kernel, with the interface that numba's dispatchers expect."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self._reason = ""
        try:
            # Taken now, because the sources may be replaced before the compilation.
            stamp_of(function.__code__.co_filename)
        except OSError as error:  # in a zip, for example
            source, reason = error.filename, error.strerror or error
            self._reason = f"{source} cannot be read ({reason}); install the package as files"

    @cached_property
    def place(self) -> KernelPlace:
        if self._reason:
            return KernelPlace((), reason=self._reason)
        return place_of(self.function.__code__.co_filename)

    @cached_property
    def _entries(self) -> list[_Entries]:
        try:
            return [_Entries(self.function, folder) for folder in self.place.folders]
        except RuntimeError as error:  # NUMBA_CACHE_LOCATOR_CLASSES names a place that is none
            self.place = KernelPlace((), reason=str(error))
            return []

    @property
    def cache_path(self) -> str | None:
        """Return the folder for newly compiled code."""
        return None if self.place.kept_in is None else self.place.folders[-1]

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the code compiled for some types, or None."""
        for entries in self._entries:
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
            self._entries[-1].save_overload(signature, data)
        except OSError as error:  # for example a full disk: the kernel works anyway
            reason = error.strerror or error
            lose(f"{self.place.kept_in} cannot be written ({reason}); {ADVICE}")
        else:
            _log.debug("compiled a kernel and kept it in %s", self.place.kept_in)
            keep()

    def flush(self) -> None:
        """Delete all entries."""
        if self.place.kept_in is not None:
            self._entries[-1].flush()
