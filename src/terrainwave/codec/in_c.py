"""The encoders of the native library; masks by them, as `masks` codes them by kernels of numba."""

import ctypes
import weakref
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.memory import Spares, new_heights
from terrainwave.codec.refiner import Mask, as_array
from terrainwave.coding.native_library import NativeError, NativeLibrary, address, loaded
from terrainwave.grid.quadtree import Region

if TYPE_CHECKING:
    from terrainwave.codec.masks import Above

POINTER, INT = ctypes.c_void_p, ctypes.c_int32
_HANDLE = ctypes.POINTER(POINTER)
_SLACK = 256  # PAYLOAD_SLACK of native/src/internal.h


class _MaskJob(ctypes.Structure):
    """A mask that is encoded (mask_job of native/src/encode_mask.h)."""

    _fields_ = [
        ("size", ctypes.c_size_t),
        *((name, INT) for name in ("n_rows", "n_cols", "p", "q", "is_finest", "has_above")),
        *((name, INT) for name in ("above_rows", "above_cols", "above_row", "above_col")),
        *((name, POINTER) for name in ("own_above", "valid_above", "own", "mask", "section")),
        ("n_section", ctypes.c_uint64),
        *((name, POINTER) for name in ("cells", "models", "bits")),
        ("capacity", ctypes.c_uint64),
        ("n_bits", ctypes.c_uint64),
        ("is_full", INT),
    ]


_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "twz_python_tables_new": (INT, INT, INT, POINTER, POINTER, POINTER, POINTER, _HANDLE),
    "twz_python_encoder_new": (_HANDLE,),
    "twz_python_encode": (POINTER, POINTER, POINTER),
    "twz_python_decode": (POINTER, POINTER, POINTER),
    "twz_python_encode_mask": (POINTER, POINTER),
    "twz_python_code_tables": (POINTER,),
}


@cache
def library() -> NativeLibrary:
    """Return the library, which is there, with the functions that encode."""
    found = loaded()
    assert found is not None
    found.declare(_SIGNATURES)
    return found


@cache
def function(name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of the library that returns no status."""
    return library().plain(name, result, *arguments)


def call(name: str, *arguments: Any) -> None:
    """Call a function that encodes.

    Raises
    ------
    MemoryError
        If the library finds no memory.
    ValueError
        If it refuses the arguments.
    """
    try:
        library().call(name, *arguments)
    except NativeError as error:
        raise (MemoryError if error.is_memory else ValueError)(str(error)) from error


def padded(data: bytes) -> NDArray[np.uint8]:
    """Return bytes with those behind them that decoders may touch."""
    found = np.zeros(len(data) + _SLACK, dtype=np.uint8)
    found[: len(data)] = np.frombuffer(data, dtype=np.uint8)
    return found


class Owned:
    """Memory that the library has allocated, freed with this object.

    Raises
    ------
    MemoryError
        If there is no memory for it.
    """

    def __init__(self, make: str, free: str, *arguments: Any) -> None:
        made = POINTER()
        call(make, *arguments, ctypes.byref(made))
        assert made.value is not None
        self.address: int = made.value
        release = function(free, None, POINTER)
        weakref.finalize(self, release, self.address).atexit = False


# One for each thread that encodes at a time.
ENCODERS = Spares(lambda: Owned("twz_python_encoder_new", "twz_python_encoder_free"))


def code_known(
    own: Mask | None,
    mask: Mask,
    region: Region,
    above: "Above | None",
    is_finest: bool,
    section: bytes = b"",
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """Do as `masks.code_known`; of a section, read it."""
    n_rows, n_cols = region.shape
    cells = _used_memory(n_rows * n_cols)[: n_rows * n_cols]
    models, bits = (_used_memory(room_for(region)) for _ in range(2))
    job = _MaskJob(
        size=ctypes.sizeof(_MaskJob), n_rows=n_rows, n_cols=n_cols, p=region.row & 1,
        q=region.col & 1, is_finest=is_finest, cells=address(cells),
        models=address(models), bits=address(bits), capacity=len(models),
    )  # fmt: skip
    arrays: list[NDArray[Any]] = []
    if section:
        arrays = [padded(section)]
        job.section, job.n_section = address(arrays[0]), len(section)
    if own is not None:
        arrays = [np.ascontiguousarray(own), np.ascontiguousarray(mask)]
        job.own, job.mask = (address(array) for array in arrays)
    if above is not None:
        known = above.validity.own_mask, above.validity.mask
        parts = [np.ascontiguousarray(as_array(part, above.region.shape)) for part in known]
        arrays += parts
        job.own_above, job.valid_above = (address(part) for part in parts)
        job.has_above, (job.above_rows, job.above_cols) = 1, above.region.shape
        job.above_row = (region.row + 1 >> 1) - above.region.row
        job.above_col = (region.col + 1 >> 1) - above.region.col
    with ENCODERS.lent() as encoder:
        call("twz_python_encode_mask", encoder.address, ctypes.byref(job))
    return cells.reshape(region.shape), models[: job.n_bits], bits[: job.n_bits]


def room_for(region: Region) -> int:
    """Return how many bits a unit may take: each sample, its group's, and fills."""
    return 3 * (region.n_rows * region.n_cols + 32)


def _used_memory(n: int) -> NDArray[np.uint8]:
    return new_heights((1, -(-n // 4))).ravel().view(np.uint8)


def read_section(
    section: bytes, region: Region, above: "Above | None", is_finest: bool
) -> NDArray[np.uint8]:
    """Do as `masks.read_section`, which says what is wrong with damaged ones."""
    nothing = np.zeros((1, 1), dtype=np.bool_)
    try:
        return code_known(None, nothing, region, above, is_finest, section)[0]
    except ValueError:
        from terrainwave.codec import masks

        return masks.read_section.__wrapped__(  # type: ignore[attr-defined]
            section, region, above, is_finest
        )


def write_bits(
    models: NDArray[np.uint8],
    bits: NDArray[np.uint8],
    freqs: NDArray[np.uint32],
    words: NDArray[np.uint16],
    states: NDArray[np.uint32],
) -> int:
    """Do as `masks.write_bits`."""
    coded = np.empty(words.size, dtype="<u2")
    write = function(
        "twz_python_mask_words", ctypes.c_uint64, POINTER, POINTER, ctypes.c_uint64, POINTER,
        ctypes.c_uint32, POINTER, POINTER,
    )  # fmt: skip
    freqs, models = np.ascontiguousarray(freqs), np.ascontiguousarray(models)
    at: int = write(
        address(models), address(np.ascontiguousarray(bits)), models.size,
        address(freqs), states.size, address(states), address(coded),
    )  # fmt: skip
    words[at:] = coded[at:]
    return at
