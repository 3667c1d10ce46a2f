"""The Zarr v3 codec ``terrainwave``: an array's chunks as .twz files, each within `max_error`.

An array-to-bytes codec (Zarr v3 specification, "Codecs"), passed as ``serializer=``. Every chunk is
a whole .twz file (FORMAT.md) of its two last dimensions, without meshes.
"""

import asyncio
import math
import warnings
from collections.abc import Iterable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from zarr.abc.codec import ArrayBytesCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer, NDBuffer

from terrainwave.arguments import check_effort
from terrainwave.errors import (
    BoundViolationError,
    CorruptStreamError,
    InvalidHeightsError,
    TerrainwaveError,
    TerrainwaveWarning,
    UnsupportedVersionError,
)
from terrainwave.file import TerrainFile
from terrainwave.grid.quantum import as_fraction
from terrainwave.grid.steps import FixedSteps
from terrainwave.raster_io.raster_info import SUPPORTED_DTYPES, fit_nodata, stored_nodata
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.undeclared_voids import note_on_marks
from terrainwave.write.compress import compress_to_bytes

CODEC_NAME = "terrainwave"
# Values of `nodata` that JSON has no numbers for, as Zarr names them.
_NOT_FINITE = ("NaN", "Infinity", "-Infinity")
# Zarr codes several chunks at a time; a chunk of this size justifies threads of its own.
_THREADED_SAMPLES = 1 << 22
# Chunks that a zarr task decodes before it encodes are ones that it writes in part.
_has_decoded: ContextVar[bool] = ContextVar("_has_decoded", default=False)


@dataclass(frozen=True)
class TerrainwaveCodec(ArrayBytesCodec):
    """Code chunks of heights with a proved bound on the error of every sample.

    Parameters
    ----------
    max_error : float
        Largest allowed error in the array's units; >= 0. 0 is lossless: every bit of a height
        comes back, the sign of -0.0 too.
    nodata : float, optional
        Samples of this value come back exactly, and so does NaN. By default the array's fill value,
        unless that is 0, which is Zarr's own default and an ordinary height.
    effort : str
        ``"fast"``, ``"default"`` or ``"best"``.
    stable : bool
        Keep `max_error` however often chunks are written in parts, appended to or copied: heights
        are rounded to fixed steps, and a write does not change other samples, bit for bit. Without
        it the bound holds only for chunks that are written once and as a whole, which are smaller
        (docs/integrations.md).

    Raises
    ------
    InvalidHeightsError
        If a parameter is out of range.

    Notes
    -----
    Chunks are two-dimensional, or have further leading dimensions of length 1. Each is decoded and
    compared before its bytes are returned. Heights without a fixed step (floats that lie further
    apart than `max_error`, heights whose step is the nodata value) are kept exactly, together with
    their whole chunk.
    """

    is_fixed_size = False

    max_error: float
    nodata: float | None
    effort: str
    stable: bool

    def __init__(
        self,
        *,
        max_error: float,
        nodata: float | None = None,
        effort: str = "default",
        stable: bool = True,
    ) -> None:
        max_error, nodata = _plain(max_error), _plain(nodata)
        is_number = isinstance(max_error, int | float) and not isinstance(max_error, bool)
        if not (is_number and math.isfinite(max_error) and max_error >= 0):
            raise InvalidHeightsError(f"found max_error {max_error!r}, expected a number >= 0")
        if nodata is not None and (isinstance(nodata, bool) or not isinstance(nodata, int | float)):
            raise InvalidHeightsError(f"found nodata {nodata!r}, expected a number or None")
        check_effort(effort)
        if not isinstance(stable, bool):
            raise InvalidHeightsError(f"found stable {stable!r}, expected True or False")
        object.__setattr__(self, "max_error", max_error)
        object.__setattr__(self, "nodata", nodata)
        object.__setattr__(self, "effort", effort)
        # Without loss nothing ever changes.
        object.__setattr__(self, "stable", stable or max_error == 0)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the codec in array metadata."""
        configuration = data.get("configuration") or {}
        unknown = sorted(set(configuration) - {"max_error", "nodata", "effort", "stable"})
        if data.get("name") != CODEC_NAME or unknown or "max_error" not in configuration:
            given = f"unknown {', '.join(unknown)}" if unknown else repr(dict(data))
            raise InvalidHeightsError(
                f"found {given} in the metadata of the codec {CODEC_NAME}, expected max_error and,"
                " if need be, nodata, effort and stable"
            )
        known = dict(configuration)
        if known.get("nodata") in _NOT_FINITE:
            known["nodata"] = float(known["nodata"])
        return cls(**known)

    def to_dict(self) -> dict[str, Any]:
        """Return the codec's entry in array metadata."""
        configuration: dict[str, Any] = {"max_error": self.max_error, "stable": self.stable}
        if self.nodata is not None:
            is_finite = math.isfinite(self.nodata)
            names = (name for name in _NOT_FINITE if repr(float(name)) == repr(self.nodata))
            configuration["nodata"] = self.nodata if is_finite else next(names)
        if self.effort != "default":
            configuration["effort"] = self.effort
        return {"name": CODEC_NAME, "configuration": configuration}

    def validate(self, *, shape: tuple[int, ...], dtype: Any, chunk_grid: Any) -> None:
        """Raise for types and shapes that cannot be coded, when the array is created."""
        native = np.dtype(dtype.to_native_dtype()).newbyteorder("=")
        if native.name not in SUPPORTED_DTYPES:
            raise InvalidHeightsError(
                f"found an array of {native.name}, the codec {CODEC_NAME} takes"
                f" {', '.join(SUPPORTED_DTYPES)}"
            )
        if self.nodata is not None:
            _, problem = fit_nodata(self.nodata, native)
            if problem:
                raise InvalidHeightsError(f"{problem}: choose another nodata")
        _grid_shape(getattr(chunk_grid, "chunk_shape", shape))

    async def decode(
        self, chunks_and_specs: Iterable[tuple[Buffer | None, ArraySpec]]
    ) -> Iterable[NDBuffer | None]:
        """Decode a batch of chunks."""
        batch = list(chunks_and_specs)
        if any(chunk is not None for chunk, _ in batch):
            _has_decoded.set(True)
        return await super().decode(batch)

    async def encode(
        self, chunks_and_specs: Iterable[tuple[NDBuffer | None, ArraySpec]]
    ) -> Iterable[Buffer | None]:
        """Encode a batch of chunks; warn if parts of them were decoded with a loss before."""
        if not self.stable and _has_decoded.get():
            warnings.warn(
                "a chunk was written in part: the rest of it was decoded and coded again, which can"
                f" move each of its heights by up to {self.max_error:g} more; write chunks as a"
                f" whole, or make the array with {type(self).__name__}(..., stable=True)",
                TerrainwaveWarning,
                stacklevel=2,
            )
        return await super().encode(chunks_and_specs)

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        return await asyncio.to_thread(self._encode_sync, chunk_data, chunk_spec)

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        return await asyncio.to_thread(self._decode_sync, chunk_data, chunk_spec)

    def _encode_sync(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        heights = np.asarray(chunk_data.as_numpy_array()).reshape(_grid_shape(chunk_spec.shape))
        mark = self._mark_of(heights.dtype, chunk_spec.fill_value)
        is_stepped = self.stable and self.max_error > 0
        if is_stepped:
            own = heights
            heights, is_stepped = self._rounded(heights, mark)
            _warn_of_marks(own, heights, _nodata_of(own, mark))
        data = compress_to_bytes(
            heights,
            # With a height without a step in the chunk, all are kept exactly.
            max_error=self.max_error if is_stepped or not self.stable else 0,
            nodata=_nodata_of(heights, mark),
            effort=self.effort,
            stable=is_stepped,
            threads=_n_threads(heights.size),
        )
        return chunk_spec.prototype.buffer.from_bytes(data)

    def _decode_sync(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        dtype = np.dtype(chunk_spec.dtype.to_native_dtype())
        shape = _grid_shape(chunk_spec.shape)
        try:
            with TerrainFile(
                chunk_data.to_bytes(), threads=_n_threads(math.prod(shape))
            ) as terrain:
                # Before anything is allocated: the array's metadata are trusted, the chunk is not.
                if (terrain.shape, terrain.dtype) != (shape, dtype.newbyteorder("=")):
                    raise CorruptStreamError(
                        f"found {terrain.dtype} of shape {terrain.shape}, expected"
                        f" {dtype.newbyteorder('=')} of shape {shape}"
                    )
                heights = terrain.read(max_bytes=math.prod(shape) * dtype.itemsize)
        except TerrainwaveError as error:
            is_other = isinstance(error, UnsupportedVersionError)
            what = "cannot be read" if is_other else "is damaged"
            raise type(error)(f"a chunk of the codec {CODEC_NAME} {what}: {error}") from error
        decoded = heights.astype(dtype, copy=False).reshape(chunk_spec.shape)
        prototype: Any = chunk_spec.prototype  # its array protocol is narrower than numpy's
        return prototype.nd_buffer.from_ndarray_like(decoded)

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Raise, because sizes depend on the heights."""
        raise NotImplementedError

    def _mark_of(self, dtype: np.dtype[Any], fill_value: Any) -> float | int | None:
        """Return the value that marks voids in an array; None if only NaN does."""
        chosen = fill_value if self.nodata is None else self.nodata
        if chosen is None or (self.nodata is None and chosen == 0):
            return None
        return fit_nodata(np.asarray(chosen).item(), dtype)[0]

    def _rounded(
        self, heights: NDArray[Any], mark: float | int | None
    ) -> tuple[NDArray[Any], bool]:
        """Return heights on fixed steps, and whether all have one.

        Each sample is rounded independently of its chunk.

        Coding rounds them, too, but not if one of a chunk's heights has no step: the others would
        then be stored exactly, and rounded once that height is gone.
        """
        dtype = heights.dtype.newbyteorder("=")
        nodata = None if mark is None or math.isnan(mark) else stored_nodata(mark, dtype).item()
        steps = FixedSteps.of(as_fraction(self.max_error), dtype.name, nodata)
        if steps is None:
            return heights, False
        rounded = steps.rounded(heights)
        with np.errstate(invalid="ignore"):  # NaN, and infinite heights, which are refused later
            apart = np.abs(rounded.astype(np.float64) - heights.astype(np.float64))
        if (apart > self.max_error).any():
            raise BoundViolationError(
                f"a height was rounded by {np.nanmax(apart):g}, more than {self.max_error:g}: this"
                " is a fault of terrainwave, please report it. Nothing was written"
            )
        is_valid = ~np.isnan(rounded) if dtype.kind == "f" else np.ones(rounded.shape, np.bool_)
        if nodata is not None:
            is_valid &= rounded != nodata
        return rounded, steps.hold(rounded[is_valid])


def _plain(number: Any) -> Any:
    """Return a numpy number as a Python number, which metadata can hold."""
    return number.item() if isinstance(number, np.generic) else number


def _nodata_of(heights: NDArray[Any], mark: float | int | None) -> float | int | None:
    """Return the value that marks voids in a chunk; None for NaN or none at all."""
    if mark is None or heights.dtype.kind != "f" or not np.isnan(heights).any():
        return mark
    if (heights == stored_nodata(mark, heights.dtype)).any():
        raise InvalidHeightsError(
            f"found both NaN and {mark:g} in a chunk, expected one mark of voids: replace one"
            " by the other"
        )
    return None


def _warn_of_marks(own: NDArray[Any], rounded: NDArray[Any], nodata: float | int | None) -> None:
    """Warn of rounded values that look like voids; `compress` warns of those that are not rounded.

    The codec cannot see the array's attributes, such as xarray's ``_FillValue``.
    """
    with RasterSource(own, nodata=nodata) as source:
        _, valid = source.read(0, 0, *own.shape)
        ends = [(part[valid].min(), part[valid].max()) for part in (own, rounded) if valid.any()]
        if ends and ends[0] != ends[1]:
            for note in note_on_marks(source, *map(float, ends[0])):
                warnings.warn(note, TerrainwaveWarning, stacklevel=2)


def _grid_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return rows and columns of a chunk; dimensions before them must have the length 1."""
    if len(shape) < 2 or any(length != 1 for length in shape[:-2]):
        raise InvalidHeightsError(
            f"found chunks of shape {tuple(shape)}, the codec {CODEC_NAME} takes rows and columns:"
            " expected chunks of shape (n_rows, n_cols) or (1, ..., n_rows, n_cols)"
        )
    return shape[-2], shape[-1]


def _n_threads(n_samples: int) -> int | None:
    return None if n_samples >= _THREADED_SAMPLES else 1
