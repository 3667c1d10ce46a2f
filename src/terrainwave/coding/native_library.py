"""The native library, where the package has one, and what it does instead of numba.

Units are encoded, and heights read, by C where the library is there, else by kernels that numba
compiles: bytes and heights are the same. `also_in_c` is the one place that chooses an encoder.
"""

import ctypes
import importlib
import os
import warnings
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar, cast

from terrainwave import native_sources
from terrainwave.errors import InvalidArgumentError, TerrainwaveWarning

SWITCH = "TERRAINWAVE_NATIVE"  # 0 in the environment: not used

OK, CORRUPT, NO_MEMORY = 0, 1, 4  # of twz_status

_Function = TypeVar("_Function", bound=Callable[..., Any])


class Failure(ctypes.Structure):
    """The status and the message of a call (twz_error)."""

    _fields_ = [
        ("status", ctypes.c_int),
        ("text", ctypes.c_char * 240),
        ("reserved", ctypes.c_uint64 * 2),
    ]


class NativeError(Exception):
    """The library has returned an error."""

    def __init__(self, error: Failure) -> None:
        super().__init__(error.text.decode("utf-8", "replace"))
        self.is_damage = error.status == CORRUPT
        self.is_memory = error.status == NO_MEMORY


class MissingLibraryError(Exception):
    """The package has no library; the message says why."""


class NativeLibrary:
    """A shared library. Functions that return a status are declared first; they raise.

    Raises
    ------
    OSError
        If it cannot be loaded.
    AttributeError
        If a function is missing.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._library = ctypes.CDLL(path)  # lets other threads run during each call
        self._functions: dict[str, Callable[..., int]] = {}
        self.digest: str = self.plain("twz_python_sources", ctypes.c_char_p)().decode("ascii")

    def plain(self, name: str, result: Any, *arguments: Any) -> Callable[..., Any]:
        """Return a function of the library."""
        function = self._library[name]
        function.restype, function.argtypes = result, arguments
        return function

    def declare(self, signatures: dict[str, tuple[Any, ...]]) -> None:
        """Declare functions that return a status; all arguments but the last, the error."""
        for name, arguments in signatures.items():
            error = ctypes.POINTER(Failure)
            self._functions[name] = self.plain(name, ctypes.c_int, *arguments, error)

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function that is declared; raise NativeError if it fails."""
        error = Failure()
        if self._functions[name](*arguments, ctypes.byref(error)) != OK:
            raise NativeError(error)

    def make(self, name: str, *arguments: Any) -> int:
        """Call a function that makes something, and return its address."""
        made = ctypes.c_void_p()
        self.call(name, *arguments, ctypes.byref(made))
        assert made.value is not None
        return made.value


def find_library() -> NativeLibrary:
    """Load the package's library.

    Raises
    ------
    MissingLibraryError
        If the package has none.
    OSError
        If it cannot be loaded, or is built of other sources; the message says what to do.
    """
    path, root = native_sources.LIBRARY, native_sources.clone()
    remedy = (
        f"pip install --editable {root}" if root else "pip install --force-reinstall terrainwave"
    )
    if not path.exists():
        reason = native_sources.read_note().get("missing", "nothing has built it so far")
        if root:
            reason += f"; with a C compiler installed: {remedy}"
        raise MissingLibraryError(f"found no library in the package: {reason}")
    try:
        library = NativeLibrary(str(path))
    except (OSError, AttributeError) as error:
        raise OSError(f"{path} cannot be loaded ({error}); to replace it: {remedy}") from None
    expected = native_sources.expected_digest()
    if library.digest != expected:
        raise OSError(
            f"{path} is built of other sources (found digest {library.digest}, expected"
            f" {expected}); to build it again: {remedy}"
        )
    return library


@cache
def loaded() -> NativeLibrary | None:
    """Return the package's library; None without one that fits.

    A library that does not fit is reported by one warning.
    """
    try:
        return find_library()
    except MissingLibraryError:
        return None
    except OSError as error:
        warnings.warn(
            f"the native library is not used, with the same results: {error}",
            TerrainwaveWarning,
            stacklevel=3,
        )
        return None


def address(array: Any) -> int:
    """Return the address of a contiguous array; `ctypes.data` takes three times as long."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    except (TypeError, ValueError):  # read-only or empty
        return int(array.ctypes.data)


def is_wanted() -> bool:
    """Return whether the environment lets the library be used.

    Raises
    ------
    InvalidArgumentError
        If the variable is neither 0 nor 1.
    """
    word = os.environ.get(SWITCH) or "1"
    if word not in ("0", "1"):
        raise InvalidArgumentError(f"found {SWITCH}={word}, expected 0 or 1")
    return word == "1"


@cache
def is_used() -> bool:
    """Return whether the package has a library that fits and is wanted; asked once."""
    return is_wanted() and loaded() is not None


def also_in_c(module: str) -> Callable[[_Function], _Function]:
    """Let a function of `module` with the same name, which calls the library, do this one's work.

    Where the library is installed, fits, and is wanted. That function returns the same values.
    """

    def decorate(function: _Function) -> _Function:
        name, known = function.__name__, list[Callable[..., Any]]()

        @wraps(function)
        def chosen(*arguments: Any, **options: Any) -> Any:
            if not is_used():
                return function(*arguments, **options)
            if not known:
                # Not by `sys.modules`: another thread may still be importing it.
                known.append(getattr(importlib.import_module(module), name))
            return known[0](*arguments, **options)

        return cast(_Function, chosen)

    return decorate
