"""The Zarr v3 codec ``terrainwave``: an array's chunks as .twz files, each within `max_error`.

An array-to-bytes codec (Zarr v3 specification, "Codecs"): it goes in as ``serializer=``. Every
chunk is a whole .twz file (FORMAT.md) of its two last dimensions, without meshes.
"""

import asyncio
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from zarr.abc.codec import ArrayBytesCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer, NDBuffer

from terrainwave.arguments import check_effort
from terrainwave.errors import CorruptStreamError, InvalidHeightsError, TerrainwaveError
from terrainwave.file import TerrainFile
from terrainwave.raster_io.info import SUPPORTED_DTYPES, fit_nodata, stored_nodata
from terrainwave.write.compress import compress_to_bytes

CODEC_NAME = "terrainwave"
# Zarr codes several chunks at a time; a chunk as large as this is worth threads of its own.
_THREADED_SAMPLES = 1 << 22


@dataclass(frozen=True)
class TerrainwaveCodec(ArrayBytesCodec):
    """Code chunks of heights with a proved bound on the error of every sample.

    Parameters
    ----------
    max_error : float
        Largest allowed error in the array's units; >= 0. 0 is lossless: every bit comes back.
    nodata : float, optional
        Samples of this value come back exactly, and so does NaN. By default the array's fill
        value, unless that is 0, which is Zarr's own default and a height as any other.
    effort : str
        ``"fast"``, ``"default"`` or ``"best"``.

    Raises
    ------
    InvalidHeightsError
        If a parameter is out of range.

    Notes
    -----
    Chunks are two-dimensional, or have further leading dimensions of length 1. Each is decoded
    and compared before its bytes are returned.
    """

    is_fixed_size = False

    max_error: float
    nodata: float | None
    effort: str

    def __init__(
        self, *, max_error: float, nodata: float | None = None, effort: str = "default"
    ) -> None:
        is_number = isinstance(max_error, int | float) and not isinstance(max_error, bool)
        if not (is_number and math.isfinite(max_error) and max_error >= 0):
            raise InvalidHeightsError(f"found max_error {max_error!r}, expected a number >= 0")
        if nodata is not None and (isinstance(nodata, bool) or not isinstance(nodata, int | float)):
            raise InvalidHeightsError(f"found nodata {nodata!r}, expected a number or None")
        check_effort(effort)
        for name, value in (("max_error", max_error), ("nodata", nodata), ("effort", effort)):
            object.__setattr__(self, name, value)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the codec that array metadata name."""
        configuration = data.get("configuration") or {}
        unknown = sorted(set(configuration) - {"max_error", "nodata", "effort"})
        if data.get("name") != CODEC_NAME or unknown or "max_error" not in configuration:
            given = f"unknown {', '.join(unknown)}" if unknown else repr(dict(data))
            raise InvalidHeightsError(
                f"found {given} in the metadata of the codec {CODEC_NAME}, expected max_error and,"
                " if need be, nodata and effort"
            )
        return cls(**configuration)

    def to_dict(self) -> dict[str, Any]:
        """Return the codec's entry in array metadata."""
        configuration: dict[str, Any] = {"max_error": self.max_error}
        if self.nodata is not None:
            configuration["nodata"] = self.nodata
        if self.effort != "default":
            configuration["effort"] = self.effort
        return {"name": CODEC_NAME, "configuration": configuration}

    def validate(self, *, shape: tuple[int, ...], dtype: Any, chunk_grid: Any) -> None:
        """Refuse types and shapes that cannot be coded, when the array is made."""
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

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        return await asyncio.to_thread(self._encode_sync, chunk_data, chunk_spec)

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        return await asyncio.to_thread(self._decode_sync, chunk_data, chunk_spec)

    def _encode_sync(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        heights = np.asarray(chunk_data.as_numpy_array()).reshape(_grid_shape(chunk_spec.shape))
        data = compress_to_bytes(
            heights,
            max_error=self.max_error,
            nodata=self._nodata_of(heights, chunk_spec.fill_value),
            effort=self.effort,
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
            raise type(error)(f"a chunk of the codec {CODEC_NAME} is damaged: {error}") from error
        heights = heights.astype(dtype, copy=False).reshape(chunk_spec.shape)
        prototype: Any = chunk_spec.prototype  # its protocol of arrays is narrower than numpy's
        return prototype.nd_buffer.from_ndarray_like(heights)

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Refuse: sizes depend on the heights."""
        raise NotImplementedError

    def _nodata_of(self, heights: NDArray[Any], fill_value: Any) -> float | int | None:
        """Return the value that marks voids in a chunk; None for NaN or none at all."""
        chosen = fill_value if self.nodata is None else self.nodata
        if chosen is None or (self.nodata is None and chosen == 0):
            return None
        nodata, _ = fit_nodata(np.asarray(chosen).item(), heights.dtype)
        if nodata is None or heights.dtype.kind != "f" or not np.isnan(heights).any():
            return nodata
        if (heights == stored_nodata(nodata, heights.dtype)).any():
            raise InvalidHeightsError(
                f"found both NaN and {nodata:g} in a chunk, expected one mark of voids: replace one"
                " by the other"
            )
        return None


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
