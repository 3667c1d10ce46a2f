"""`TerrainFile`: an open .twz file and its heights. Reading starts here."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import (
    VOIDS,
    check_choice,
    check_flags,
    checked_number,
    checked_numbers,
    checked_threads,
    checked_whole,
    in_one_line,
    shown,
)
from terrainwave.codec.registry import check_file_tables, check_layout, newer_layout
from terrainwave.container.codes import decode_error, decode_range
from terrainwave.container.header import LAYOUT_FEATURES, Header
from terrainwave.container.parts import Parts, parts_of
from terrainwave.container.reader import Container
from terrainwave.container.sources.addresses import display_name
from terrainwave.container.sources.opening import open_source
from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
    LimitExceededError,
)
from terrainwave.grid.affine import bounds, coordinates, is_turned, of_level, pixel_size
from terrainwave.grid.quadtree import Block, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.names import EFFORTS, FORMATS, METHODS, methods_that
from terrainwave.place.position import Turn, longitude_turn
from terrainwave.place.units import HeightUnit, height_unit
from terrainwave.raster_io.info import RasterInfo
from terrainwave.read.places import (
    places_of,
    region_of_bounds,
    region_of_window,
    to_samples,
)
from terrainwave.read.resample import RESAMPLING, resample

if TYPE_CHECKING:
    from terrainwave.read.decoder import TreeDecoder
    from terrainwave.read.levels import LevelReader
    from terrainwave.read.native import NativeFile

DEFAULT_CACHE_BYTES = 256 << 20
DEFAULT_MAX_BYTES = 4 << 30
# What becomes of damaged blocks.
ON_ERROR = ("raise", "mask")
# Columns by which a raster may miss the whole turn, and bounds the raster's.
_SAME_COLUMN = 0.01


@dataclass(frozen=True)
class Info:
    """What a .twz file says about itself; errors are in physical units.

    `format` is the first version of the format whose readers know all that the file uses.
    `faithful`: the file follows the paper of its method to the letter.
    `float_error` is how much further apart than `max_error` stored floats may be: one spacing,
    where they name decimal numbers and the file is not strict.
    `moved_error` is the share of `effective_error` that patches, or a file before, have added.
    `units` is the unit of heights and `units_from` who names it: the ``"band"`` or the ``"CRS"``;
    `units_of_crs` is what the CRS's vertical axis says where the band says something else.
    `voids` is how voids are told: ``"none"``, by their ``"nodata"`` value, as ``"nan"``, or by a
    ``"mask"``; it is the way of the source, which may have no void at all.
    """

    path: str
    n_bytes: int
    n_rows: int
    n_cols: int
    dtype: str
    bits_per_sample: float
    ratio: float
    max_error: float
    effective_error: float
    quantum: float
    rounding_error: float
    float_error: float
    moved_error: float
    units: str | None
    units_from: str | None
    units_of_crs: str | None
    method: str
    effort: str
    format: str
    faithful: bool
    block: int
    border_rings: int
    mesh: str
    mesh_tolerance: float
    n_levels: int
    level_shapes: tuple[tuple[int, int], ...]
    crs: str | None
    transform: tuple[float, ...]
    bounds: tuple[float, float, float, float]
    nodata: float | int | None
    scale: float
    offset: float
    area_or_point: str | None
    description: str | None
    minimum: float | None
    maximum: float | None
    voids: str
    tags: dict[str, str]
    band_tags: dict[str, str]
    color_interpretation: str | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values; what JSON cannot say becomes a string."""
        fields = asdict(self)
        if isinstance(self.nodata, float) and not np.isfinite(self.nodata):
            fields["nodata"] = str(self.nodata)
        return fields


class EarlyHeights(NamedTuple):
    """Heights and validity of a window, and the bytes of payloads that were read for them."""

    heights: NDArray[Any]
    valid: NDArray[np.bool_]
    n_bytes: int


class TerrainFile:
    """An open .twz file: windows of heights at any level, decoded on demand.

    Parameters
    ----------
    source : path, URL, bytes or binary file object
        What to read. Opening reads the header and the first index page only.
    cache_bytes : int
        Decoded heights kept in memory, least recently used dropped first.
    threads : int, optional
        Threads that decode; the number of processors by default.
    native : bool
        Read heights by the native library where the package terrainwave-native is installed; the
        heights are the same. ``TERRAINWAVE_NATIVE=0`` in the environment is False for all files.

    Raises
    ------
    InvalidHeightsError
        If `threads` is below 1.
    CorruptStreamError, UnsupportedVersionError
        If the bytes are not a .twz file this version reads.
    StorageError
        If the file or URL cannot be read.

    Notes
    -----
    Thread-safe. Picklable if opened by path or URL. A context manager.
    """

    def __init__(
        self,
        source: Any,
        *,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
        threads: int | None = None,
        native: bool = True,
    ) -> None:
        check_flags(native=native)
        self.n_threads = checked_threads(threads)
        cache_bytes = checked_whole("cache_bytes", cache_bytes, least=0)
        self._arguments = (source, cache_bytes, threads, native)
        self.is_native = native
        self._source = open_source(source)
        try:
            self.container = Container(self._source)
            header = self.container.header
            bits = LAYOUT_FEATURES.items()
            told = sum(layout for layout, bit in bits if header.features & bit)
            check_file_tables(header.method, header.file_tables)
            check_layout(header.method, header.file_tables, told)
            # Null means the same as a key that is missing (FORMAT.md §4.2).
            known = {name: value for name, value in header.metadata.items() if value is not None}
            known |= {"n_rows": header.n_rows, "n_cols": header.n_cols, "dtype": header.dtype}
            self._raster = RasterInfo.from_metadata(known)
        except BaseException:
            self._source.close()
            raise
        self.name = source if isinstance(source, str | os.PathLike) else "<bytes>"
        if isinstance(source, str):
            self.name = display_name(source)
        self.grid = header.grid
        self._cache_bytes = cache_bytes

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def __repr__(self) -> str:
        n_rows, n_cols = self.shape
        return in_one_line(
            f"<{type(self).__name__} {self.name}: {n_rows} x {n_cols} {self.dtype},"
            f" within {self.effective_error:.6g} {self.units or '(unit unknown)'},"
            f" {self._raster.crs_name}>"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        source, cache_bytes, threads, native = self._arguments
        if not isinstance(source, str | os.PathLike):
            raise TypeError("only what was opened by path or URL can be pickled")
        made = partial(type(self), cache_bytes=cache_bytes, threads=threads, native=native)
        return made, (source,)

    def close(self) -> None:
        """Close the file and stop the threads."""
        if "_levels" in self.__dict__:
            self._levels.close()
        self.container.close()

    @cached_property
    def decoder(self) -> "TreeDecoder":
        """Return the decoder of the file's units, with its cache; heights are in quanta."""
        # Imported when heights are first read: opening a file and `info` need no numba.
        from terrainwave.read.tiles import make_decoder

        return make_decoder(self.header, self.container.payloads, self._cache_bytes)

    @cached_property
    def _levels(self) -> "LevelReader":
        from terrainwave.read.levels import LevelReader

        return LevelReader(
            str(self.name),
            self.header,
            self.n_threads,
            self.container.payloads,
            lambda: self.decoder,
            self._native(),
            may_have_voids=self._raster.mask_kind != "none",
        )

    def _native(self) -> "NativeFile | None":
        """Return what reads the file by the native library; None where that is not to be used."""
        from terrainwave.read import native

        library = native.installed() if self.is_native and native.is_wanted() else None
        if library is None:
            return None
        return native.NativeFile(
            library, self.container, cache_bytes=self._cache_bytes, n_threads=self.n_threads
        )

    # What the file says.

    @property
    def pyramid(self) -> str:
        """Return of what heights coarse levels are made (`names.Method.pyramid`)."""
        return METHODS[self.header.method].pyramid

    @property
    def quantizer(self) -> Quantizer:
        """Return the quantizer of the file's heights."""
        return self.header.quantizer

    @property
    def header(self) -> Header:
        """Return the file's header (FORMAT.md §4), in raw units."""
        return self.container.header

    @property
    def shape(self) -> tuple[int, int]:
        """Return the numbers of rows and columns of the full grid."""
        return self.grid.n_rows, self.grid.n_cols

    @property
    def dtype(self) -> np.dtype[Any]:
        """Return the type of the heights as stored in the source raster."""
        return np.dtype(self._raster.dtype)

    @property
    def raster_info(self) -> RasterInfo:
        """Return the source raster's description: size, type, nodata, place, units."""
        return self._raster

    @property
    def nodata(self) -> int | float | None:
        """Return the source's nodata value, if it declared one."""
        return self._raster.nodata

    @property
    def units(self) -> str | None:
        """Return the unit of heights: the band's, else that of the CRS's vertical axis."""
        return self._height_unit.name

    @cached_property
    def _height_unit(self) -> HeightUnit:
        return height_unit(self._raster.units, self._raster.crs)

    @property
    def res(self) -> tuple[float, float]:
        """Return width and height of a pixel of the full grid, in units of the CRS; both > 0."""
        return pixel_size(self._raster.transform)

    @property
    def crs(self) -> str | None:
        """Return the coordinate reference system as ``AUTH:CODE`` or WKT2."""
        return self._raster.crs

    @property
    def n_levels(self) -> int:
        """Return the number of resolution levels; level 0 is the coarsest, -1 the full grid."""
        return self.grid.k_max + 1

    @property
    def max_error(self) -> float:
        """Return the bound that was asked for, in physical units (after scale and offset).

        Patches add to it how far they have moved heights that they knew no original of, and heights
        that came out of a lossy file the bound of that one.
        """
        return self.header.max_error * abs(self._raster.scale)

    @property
    def effective_error(self) -> float:
        """Return the bound that holds, in physical units; at most `max_error`."""
        return self.header.effective_error * abs(self._raster.scale)

    @property
    def quanta_error(self) -> float:
        """Return the bound of the heights that meshes are made of, in physical units.

        `effective_error`, but in exact files of heights on no grid, whose meshes are made of
        heights rounded to the vertical quantum.
        """
        return self.header.quanta_error * abs(self._raster.scale)

    def level_index(self, level: int) -> int:
        """Return `level` counted from 0; negative levels count from the full grid, as Python does.

        Raises
        ------
        InvalidArgumentError
            If there is no such level.
        """
        last = self.n_levels - 1
        expected = f"0 … {last} or -1 (full) … -{self.n_levels}"
        if last == 0:
            expected = "0 or -1: the file has one level, the full grid"
        found = checked_whole("level", level, least=-self.n_levels, most=last, expected=expected)
        return found + self.n_levels if found < 0 else found

    def level_shape(self, level: int = -1) -> tuple[int, int]:
        """Return the numbers of rows and columns of a level."""
        return self.grid.level_shape(self.level_index(level))

    def transform(self, level: int = -1, window: Any = None) -> tuple[float, ...]:
        """Return the affine transform (a, b, c, d, e, f) of a level or of a window of it.

        Levels are samples at positions: the centre of the first pixel is the same on every level,
        the pixel grows by 2^j. x = a * col + b * row + c at pixel corners, as rasterio counts.
        Windows are as in `read`, but not clipped.
        """
        index = self.level_index(level)
        row, col = 0, 0
        if window is not None:
            row, col, _, _ = region_of_window(window, self.grid.level_shape(index))
        return of_level(self._raster.transform, self.grid.stride(index), row, col)

    def is_turned(self, level: int = -1) -> bool:
        """Say whether a place along a row or a column of a level needs both, x and y."""
        return is_turned(self.transform(level), self.level_shape(level))

    def coordinates(
        self, level: int = -1, window: Any = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x and y of samples' places, to the last bit as rioxarray has them.

        Parameters
        ----------
        level : int
            Resolution level, as in `read`.
        window : optional
            A window as in `read`, whose samples are all told: where the level `is_turned`. By
            default x of columns and y of rows.

        Returns
        -------
        x, y : ndarray of float64
            Of shape (n_cols,) and (n_rows,), or that of the window.
        """
        transform = self.transform(level)
        if window is not None:
            row, col, n_rows, n_cols = region_of_window(window, self.level_shape(level))
            rows, cols = np.mgrid[row : row + n_rows, col : col + n_cols].astype(np.float64)
            return coordinates(transform, rows, cols)
        rows, cols = (np.arange(size, dtype=np.float64) for size in self.level_shape(level))
        x, _ = coordinates(transform, np.zeros_like(cols), cols)
        _, y = coordinates(transform, rows, np.zeros_like(rows))
        return x, y

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return (left, bottom, right, top) of the raster's pixels in its CRS."""
        return bounds(self._raster.transform, self.shape)

    def _float_error(self) -> float:
        is_strict = self.quantizer.is_strict(self.header.max_error, self.header.effective_bound)
        return 0.0 if is_strict else self.quantizer.float_error

    def info(self) -> Info:
        """Return a summary of the file, from its header alone."""
        header, raster = self.header, self._raster
        n_samples = header.n_rows * header.n_cols
        quantum = self.quantizer.quantum * abs(raster.scale)
        has_heights = header.z_min <= header.z_max
        physical = [
            self.quantizer.height_of(quantum) * raster.scale + raster.offset
            for quantum in (header.z_min, header.z_max)
        ]
        return Info(
            path=str(self.name),
            n_bytes=self._source.size,
            n_rows=header.n_rows,
            n_cols=header.n_cols,
            dtype=header.dtype,
            bits_per_sample=8 * self._source.size / n_samples,
            ratio=n_samples * self.dtype.itemsize / self._source.size,
            max_error=self.max_error,
            effective_error=self.effective_error,
            quantum=quantum,
            rounding_error=self.quantizer.rho * abs(raster.scale),
            float_error=self._float_error() * abs(raster.scale),
            moved_error=header.moved * quantum,
            units=self.units,
            units_from=self._height_unit.source,
            units_of_crs=self._height_unit.of_crs,
            method=header.method,
            effort=EFFORTS[min(header.effort, len(EFFORTS) - 1)],
            format=format_of(header),
            faithful=header.is_faithful,
            block=header.block,
            border_rings=header.border_rings,
            mesh=header.mesh,
            mesh_tolerance=header.mesh_tolerance / 16 * quantum,
            n_levels=self.n_levels,
            level_shapes=tuple(self.grid.level_shape(level) for level in range(self.n_levels)),
            crs=raster.crs,
            transform=tuple(raster.transform),
            bounds=self.bounds,
            nodata=raster.nodata,
            scale=raster.scale,
            offset=raster.offset,
            area_or_point=raster.area_or_point,
            description=raster.description,
            minimum=min(physical) if has_heights else None,
            maximum=max(physical) if has_heights else None,
            voids=raster.mask_kind,
            tags=dict(raster.tags),
            band_tags=dict(raster.band_tags),
            color_interpretation=raster.color_interpretation,
        )

    def parts(self) -> Parts:
        """Return the bytes of each part of the file; reads the whole index."""
        parts = parts_of(self.container)
        if METHODS[self.header.method].is_tiled:  # of several levels together
            return replace(parts, heights=(sum(parts.heights),))
        return parts

    def count_voids(self) -> int:
        """Return the number of void samples of the full grid; decodes all of it, band by band."""
        n_rows, n_cols = self.shape
        n_voids = 0
        for row in range(0, n_rows, self.grid.block):
            _, valid = self.read_with_mask((row, 0, self.grid.block, n_cols))
            n_voids += int(valid.size - np.count_nonzero(valid))
        return n_voids

    def block_error(self, block: Block) -> float:
        """Return the stored error of a block's bilinear surface, in physical units.

        No valid original under the block is further from the bilinear interpolation of its
        decoded samples. It has been measured; that of a faithful file is an upper bound.
        """
        code = self.container.codes(block)[2]
        return decode_error(code) * self.quantizer.quantum * abs(self._raster.scale)

    def block_box(self, block: Block) -> tuple[float, float]:
        """Return lowest and highest height of a block and all below it, in physical units.

        Every original under the block lies between, and so does the bilinear surface of each block
        at or below it. A block without valid samples has the box of its parent.
        """
        header, scale = self.header, self._raster.scale
        low, high = self.box_quanta(block)
        unit = header.quantum.numerator / header.quantum.denominator * scale
        ends = [(quanta + header.base) * unit + self._raster.offset for quanta in (low, high)]
        return min(ends), max(ends)

    def box_quanta(self, block: Block) -> tuple[int, int]:
        """Return a block's lowest and highest height as the index states them, in quanta."""
        header, key = self.header, block.parent
        # Inside the box of the key if the segment of the key lists that block, else the raster's.
        is_first = block.level == 0 or self.grid.segment_head(key) == key
        outer = (header.z_min, header.z_max) if is_first else self.box_quanta(key)
        below, above = self.container.codes(block)[:2]
        return decode_range(below, above, *outer)

    @property
    def mesh_kind(self) -> str:
        """Return the kind of the file's meshes, ``"none"`` if it has none."""
        return self.header.mesh

    def mesh_error(self, block: Block) -> float:
        """Return the stored error of a block's mesh, an upper bound, in physical units.

        No valid original that the mesh covers is further from it.

        Raises
        ------
        InvalidHeightsError
            If the file has no meshes.
        """
        if self.mesh_kind == "none":
            raise InvalidHeightsError("the file has no meshes: add them with terrainwave mesh")
        code = self.container.codes(block)[3]
        return decode_error(code) * self.quantizer.quantum * abs(self._raster.scale)

    def level_errors(self) -> list[float]:
        """Return the largest stored error of the blocks of each level, the coarsest level first."""
        codes = [0] * self.n_levels
        for segment in self.container.present_segments():
            for block, row in segment.block_rows.items():
                codes[block.level] = max(codes[block.level], int(segment.page.codes[row, 2]))
        unit = self.quantizer.quantum * abs(self._raster.scale)
        return [decode_error(code) * unit for code in codes]

    # Heights.

    def read(
        self,
        window: Any = None,
        *,
        bounds: Sequence[float] | None = None,
        level: int = -1,
        out_shape: tuple[int, int] | None = None,
        resampling: str = "nearest",
        masked: bool = False,
        on_error: str = "raise",
        voids: str | None = None,
        max_bytes: int = DEFAULT_MAX_BYTES,
    ) -> NDArray[Any]:
        """Read heights in the file's dtype, the void value in voids.

        Heights are as stored in the raster: ``scale * stored + offset`` of `info` makes them
        physical, where the band has them.

        Parameters
        ----------
        window : optional
            Part of the level to read, in samples of that level; clipped to it. One of:

            - ``(first_row, first_col, n_rows, n_cols)``: rows before columns, then how many of
              each. ``(100, 50, 20, 30)`` is rows 100 … 119 of columns 50 … 79.
            - a rasterio ``Window``, in whole samples;
            - ``numpy.s_[100:120, 50:80]``: a slice of rows and one of columns, without steps.
        bounds : (left, bottom, right, top), optional
            Instead of `window`: the pixels that touch this rectangle, in the CRS.
        level : int
            Resolution level: -1 the full grid, -2 half, …; 0 the coarsest.
        out_shape : tuple of int, optional
            Resample the window to this shape.
        resampling : str
            ``"nearest"``, ``"bilinear"`` or ``"average"``; used with `out_shape`.
        masked : bool
            Return a masked array, as rasterio does.
        on_error : str
            ``"raise"``, or ``"mask"``: a damaged block reads as void and the rest is returned.
        voids : str, optional
            Which samples of a coarse level are void. ``"exact"``: those where the full grid is
            void, sample by sample. ``"any"``: those alone around which nothing is valid; the others
            have a height that is a fill, as meshes need it. By default exact, if the file tells
            (format 1.1); else any, with one warning. To find exact voids of an older file, the
            finest payloads of the window are read, too.
        max_bytes : int
            Refuse a larger result.

        Returns
        -------
        heights : ndarray, shape (n_rows, n_cols)
            A copy. On the full grid every valid sample is within `effective_error` of the original;
            of floats on a decimal grid (0.1, 0.01 …) this holds for the decimal numbers, and the
            floats nearest to two of them may differ by one float spacing more (`Info.float_error`;
            `compress` with `strict`).

        Raises
        ------
        InvalidArgumentError
            If an argument is out of range or the window misses the level.
        LimitExceededError
            If the result would be larger than `max_bytes`.
        CorruptStreamError
            If a block is damaged and `on_error` is ``"raise"``; the message names it.
        """
        check_choice("on_error", on_error, ON_ERROR)
        check_choice("resampling", resampling, RESAMPLING)
        check_flags(masked=masked)
        max_bytes = checked_whole("max_bytes", max_bytes, least=0)
        if out_shape is not None:
            out_shape = checked_numbers("out_shape", out_shape, "n_rows, n_cols", is_whole=True)
            if min(out_shape) < 1:
                raise InvalidArgumentError(
                    f"found `out_shape` {shown(out_shape)}, expected at least (1, 1)"
                )
        index = self.level_index(level)
        region = self.region(window, bounds=bounds, level=level)
        self._check_size(out_shape or region.shape, max_bytes)
        if out_shape is None:
            heights, void = self._levels.read(index, region, on_error, voids)
        else:
            heights, void = resample(
                lambda shift, part: self._levels.read(index - shift, part, on_error, voids),
                region,
                out_shape,
                resampling,
                index,
                self.grid,
                max_bytes,
            )
        if void is not None:
            heights[void] = self._raster.void_value
        if masked:
            fill = None if self._raster.nodata is None else self.dtype.type(self._raster.nodata)
            mask = np.zeros(heights.shape, dtype=np.bool_) if void is None else void
            return np.ma.MaskedArray(heights, mask=mask, fill_value=fill)
        return heights

    def read_with_mask(
        self,
        window: Any = None,
        *,
        level: int = -1,
        on_error: str = "raise",
        voids: str | None = None,
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights and validity of a window of a level; arguments as in `read`.

        What `read` cannot tell: a raster with a mask of its own may hold any value in its voids.
        """
        check_choice("on_error", on_error, ON_ERROR)
        region = self.region(window, level=level)
        index = self.level_index(level)
        return self._filled(*self._levels.read(index, region, on_error, voids))

    def _filled(
        self, heights: NDArray[Any], void: NDArray[np.bool_] | None
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights with the void value in voids, and validity."""
        if void is not None:
            heights[void] = self._raster.void_value
        return _with_valid(heights, void)

    def read_early(
        self,
        window: Any = None,
        *,
        quality: float,
        level: int = -1,
        on_error: str = "raise",
        voids: str | None = None,
    ) -> "EarlyHeights":
        """Return the best heights of a window that so many bits per sample give.

        Parameters
        ----------
        window, level, on_error, voids
            As in `read`.
        quality : float
            Bits per sample of the window to read of payloads; > 0. The heads of all tiles needed
            are read in any case.

        Raises
        ------
        InvalidArgumentError
            If the file is not of method cdf53, whose streams alone can be read in part, or
            `quality` is out of range.
        """
        check_choice("on_error", on_error, ON_ERROR)
        quality = checked_number("quality", quality, above=0)
        header, index = self.header, self.level_index(level)
        region = self.region(window, level=level)
        if not METHODS[header.method].is_cuttable:
            fit = methods_that(lambda method: method.is_cuttable)
            raise InvalidArgumentError(
                f"found `quality` and a file of method {header.method}, expected one of method"
                f" {fit}: other streams cannot be read in part"
            )
        from terrainwave.read.decoder import units_of
        from terrainwave.read.early import EarlyPayloads
        from terrainwave.read.tiles import make_decoder

        max_bytes = int(quality * region.n_rows * region.n_cols / 8)
        payloads = EarlyPayloads(self.container, units_of(self.grid, index, region), max_bytes)
        decoder = make_decoder(header, payloads, self._cache_bytes, are_prefixes=True)
        found = self._filled(*self._levels.read(index, region, on_error, voids, decoder))
        return EarlyHeights(*found, payloads.n_bytes)

    def region(
        self, window: Any = None, *, bounds: Sequence[float] | None = None, level: int = -1
    ) -> Region:
        """Return the part of a level that a window or bounds name, clipped to the level.

        Raises
        ------
        InvalidArgumentError
            If both are given, one is malformed, or they miss the level.
        """
        index = self.level_index(level)
        n_rows, n_cols = self.grid.level_shape(index)
        whole = Region(0, 0, n_rows, n_cols)
        if bounds is not None:
            if window is not None:
                raise InvalidArgumentError("found both `window` and `bounds`, expected one of them")
            asked = region_of_bounds(bounds, self.transform(index))
        elif window is None:
            asked = whole
        else:
            asked = region_of_window(window, whole.shape)
        region = asked.intersect(whole)
        if region.n_rows <= 0 or region.n_cols <= 0:
            if bounds is not None:
                found, own = (_in_words(box) for box in (bounds, self.bounds))
                raise InvalidArgumentError(
                    f"the `bounds` {found} do not meet the raster's, {own} (left, bottom, right,"
                    " top)"
                )
            raise InvalidArgumentError(
                f"the `window` (row {asked.row}, column {asked.col}, {asked.n_rows} x"
                f" {asked.n_cols}) does not meet the level's {n_rows} x {n_cols} samples"
            )
        return region

    def note_on_cut(
        self, window: Any = None, *, bounds: Sequence[float] | None = None, level: int = -1
    ) -> str | None:
        """Say that a window or bounds reach beyond a level, and what is left of it; None if not.

        `region` cuts them without a word, as `read` tells; who writes a file passes this on.
        """
        index = self.level_index(level)
        n_rows, n_cols = self.grid.level_shape(index)
        region = self.region(window, bounds=bounds, level=level)
        left = (
            f"what lies inside it is taken, {region.n_rows} x {region.n_cols} samples from row"
            f" {region.row}, column {region.col} on"
        )
        if bounds is not None:
            left_x, bottom, right, top = map(float, bounds)
            own = self.bounds
            # What rounding of coordinates in text leaves out counts as nothing.
            slack = _SAME_COLUMN * min(self.res)
            inside = own[0] - slack <= left_x and own[1] - slack <= bottom
            inside &= right <= own[2] + slack and top <= own[3] + slack
            if inside:
                return None
            return f"the `bounds` reach beyond the raster's, {_in_words(own)}: {left}"
        if window is None or region_of_window(window, (n_rows, n_cols)) == region:
            return None
        return f"the `window` reaches beyond the level's {n_rows} x {n_cols} samples: {left}"

    def sample(
        self,
        points: Iterable[tuple[float, float]] | NDArray[np.float64],
        *,
        level: int = -1,
        voids: str | None = None,
    ) -> NDArray[np.float64]:
        """Return bilinear heights at world coordinates, in physical units.

        Parameters
        ----------
        points : sequence of (x, y), or array of shape (n_points, 2)
            Places in the file's CRS. Longitudes may be of any turn: -170 and 190 are the same, and
            a raster around the whole globe goes on from its last column to its first.
        level, voids
            As in `read`.

        Returns
        -------
        heights : ndarray of float64, shape (n_points,)
            NaN outside the outermost samples and where a sample needed is void. The error bound
            holds at samples, not between them.
        """
        places = places_of(points)
        if voids is not None:
            check_choice("voids", voids, VOIDS)
        index = self.level_index(level)
        rows, cols = to_samples(self._of_this_turn(places), self.transform(index))
        heights = self._heights_at(index, rows, cols, voids)
        last = self.grid.level_shape(index)[1] - 1
        beyond = np.isfinite(cols) & ((cols < 0) | (cols > last))
        if self._is_whole_turn and beyond.any():
            # Between the last column and the first one of the next turn.
            turn = self.shape[1] / self.grid.stride(index)
            across = np.mod(cols[beyond] - last, turn) / (turn - last)
            ends = [
                self._heights_at(index, rows[beyond], np.full(across.shape, column), voids)
                for column in (float(last), 0.0)
            ]
            heights[beyond] = ends[0] * (1 - across) + ends[1] * across
        return heights

    def _heights_at(
        self, level: int, rows: NDArray[np.float64], cols: NDArray[np.float64], voids: str | None
    ) -> NDArray[np.float64]:
        """Return bilinear heights at fractional samples; NaN outside the outermost and in voids."""
        n_rows, n_cols = self.grid.level_shape(level)
        inside = (rows >= 0) & (rows <= n_rows - 1) & (cols >= 0) & (cols <= n_cols - 1)
        heights = np.full(len(rows), np.nan)
        if inside.any():
            raw, is_void = self._levels.bilinear(level, rows[inside], cols[inside], voids)
            physical = raw * self._raster.scale + self._raster.offset
            heights[inside] = np.where(is_void, np.nan, physical)
        return heights

    @cached_property
    def _turn(self) -> Turn | None:
        return longitude_turn(self._raster.crs)

    @cached_property
    def _is_whole_turn(self) -> bool:
        """Whether rows are parallels and go around the whole globe."""
        a, b, _, d, _, _ = self._raster.transform
        turn = self._turn
        if turn is None or turn.axis != 0 or not b == d == 0:
            return False
        return abs(turn.length / abs(a) - self.shape[1]) < _SAME_COLUMN

    def _of_this_turn(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places whose longitudes lie within half a turn of the raster's middle; copies."""
        turn = self._turn
        if turn is None:
            return places
        left, bottom, right, top = self.bounds
        middle = ((left + right) / 2, (bottom + top) / 2)[turn.axis]
        moved = places.copy()
        with np.errstate(invalid="ignore"):
            turns = np.rint((places[:, turn.axis] - middle) / turn.length)
            is_far = np.abs(places[:, turn.axis] - middle) > turn.length / 2
            moved[is_far, turn.axis] -= turns[is_far] * turn.length
        return moved

    def check(self) -> Iterator[str]:
        """Check all checksums and decode every unit; yield what is wrong, in plain words."""
        from terrainwave.read.check import check_units

        return check_units(self.container, self.decoder)

    def _check_size(self, shape: tuple[int, int], max_bytes: int) -> None:
        n_bytes = int(shape[0]) * int(shape[1]) * self.dtype.itemsize
        if n_bytes > max_bytes:
            raise LimitExceededError(
                f"the window holds {shape[0]} x {shape[1]} samples, {n_bytes:,} bytes; more than"
                f" max_bytes = {max_bytes:,}: read a smaller window or a coarser level"
            )


def format_of(header: Header) -> str:
    """Return the first version of the format whose readers know all that a file uses.

    Tables by reach are older than their feature bit.
    """
    is_newer = newer_layout(header.method, header.file_tables) > 0
    return FORMATS[-1] if is_newer else header.format


def _with_valid(
    heights: NDArray[Any], void: NDArray[np.bool_] | None
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return heights and validity, of heights and what is void."""
    return heights, np.ones(heights.shape, dtype=np.bool_) if void is None else ~void


def _in_words(box: Sequence[float]) -> str:
    return ", ".join(f"{float(value):.10g}" for value in box)
