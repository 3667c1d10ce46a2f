"""`DescribedFile`: an open .twz file with its header and its index; no heights."""

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import (
    MASK,
    ON_ERROR,
    RAISE,
    check_choice,
    check_flags,
    checked_threads,
    checked_whole,
    in_one_line,
)
from terrainwave.codec.registry import check_file_tables
from terrainwave.container.header import Header
from terrainwave.container.page import UNMEASURED, decode_error, decode_range
from terrainwave.container.reader import Container
from terrainwave.container.sources.addresses import display_name
from terrainwave.container.sources.opening import open_source
from terrainwave.grid.affine import bounds, coordinates, is_turned, of_level, pixel_size
from terrainwave.grid.quadtree import Block, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.names import METHODS
from terrainwave.place.units import HeightUnit
from terrainwave.place.units import height_unit as unit_of
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.read.places import LevelPlace, LevelWindow, region_of_window

if TYPE_CHECKING:
    from affine import Affine

    from terrainwave.container.reader import Parts

DEFAULT_CACHE_BYTES = 256 << 20


class DescribedFile:
    """An open .twz file: its grid, its position, its error bounds. Opening needs no numba."""

    def __init__(
        self,
        source: Any,
        *,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
        threads: int | None = None,
        native: bool = True,
        on_error: str = RAISE,
    ) -> None:
        check_flags(native=native)
        check_choice("on_error", on_error, ON_ERROR)
        self.n_threads = checked_threads(threads)
        cache_bytes = checked_whole("cache_bytes", cache_bytes, least=0)
        self._arguments = (source, cache_bytes, threads, native, on_error)
        self._may_be_native = native
        self.on_error = on_error
        self._source = open_source(source)
        try:
            self.container = Container(self._source, may_be_cut=on_error == MASK)
            header = self.container.header
            check_file_tables(header.method, header.file_tables)
            # Null means the same as a missing key (FORMAT.md §4.2).
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
        source, cache_bytes, threads, native, on_error = self._arguments
        if not isinstance(source, str | os.PathLike):
            raise TypeError("only what was opened by path or URL can be pickled")
        made = partial(
            type(self), cache_bytes=cache_bytes, threads=threads, native=native, on_error=on_error
        )
        return made, (source,)

    def close(self) -> None:
        """Close the file."""
        self.container.close()

    @property
    def pyramid(self) -> str:
        """Return how coarse levels are made (`names.Method.pyramid`)."""
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
        """Return the source raster's metadata: size, type, nodata, position, units."""
        return self._raster

    @property
    def nodata(self) -> int | float | None:
        """Return the source's nodata value, if it declared one."""
        return self._raster.nodata

    @property
    def units(self) -> str | None:
        """Return the unit of heights: the band's, else that of the CRS's vertical axis."""
        return self.height_unit.name

    @cached_property
    def height_unit(self) -> HeightUnit:
        """Return the unit of heights, and its origin."""
        return unit_of(self._raster.units, self._raster.crs, self._raster.heights_are)

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
        """Return the requested bound, in physical units (after scale and offset).

        It includes the bound of an earlier lossy file that the heights came from.
        """
        return self.header.max_error * abs(self._raster.scale)

    @property
    def effective_error(self) -> float:
        """Return the effective bound, in physical units; at most `max_error`."""
        return self.header.effective_error * abs(self._raster.scale)

    @property
    def quanta_error(self) -> float:
        """Return the bound of the heights used in meshes, in physical units.

        It is `effective_error`, except in exact files of heights without a grid, whose meshes use
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
        n = self.n_levels
        names = f"0 (coarsest) to {n - 1}, or -1 (full grid) to -{n}"
        if n == 1:
            names = "0 or -1: the file has one level, the full grid"
        found = checked_whole("level", level, least=-n, most=n - 1, expected=names)
        return found + n if found < 0 else found

    def level_shape(self, level: int = -1) -> tuple[int, int]:
        """Return the numbers of rows and columns of a level."""
        return self.grid.level_shape(self.level_index(level))

    @property
    def transform(self) -> "Affine":
        """Return the affine transform of the full grid, as rasterio's datasets have it.

        x = a col + b row + c and y = d col + e row + f at pixel corners. `transform_of` returns
        that of levels and windows.
        """
        return _affine(*self._raster.transform)

    def transform_of(self, level: int = -1, window: Any = None) -> "Affine":
        """Return the affine transform of a level, or of a window of it.

        Levels are samples at positions: the centre of the first pixel is the same on every level,
        the pixel grows by 2^j.

        Parameters
        ----------
        level : int
            Resolution level, as in `read`.
        window : optional
            A window as in `read`, but not clipped.

        Raises
        ------
        InvalidArgumentError
            If there is no such level, or `window` is not a window.
        """
        row, col = 0, 0
        if window is not None:
            row, col, _, _ = region_of_window(window, self.level_shape(level))
        a, b, c, d, e, f = self.level_place(level, row, col).transform
        return _affine(a, b, c, d, e, f)

    def level_place(self, level: int = -1, row: int = 0, col: int = 0) -> LevelPlace:
        """Return shape and position of a level, from a sample on, and the raster's bounds."""
        index = self.level_index(level)
        transform = of_level(self._raster.transform, self.grid.stride(index), row, col)
        return LevelPlace(index, self.grid.level_shape(index), transform, self.bounds)

    def is_turned(self, level: int = -1) -> bool:
        """Return whether x or y changes along both the rows and the columns of a level."""
        return is_turned(self.level_place(level).transform, self.level_shape(level))

    def coordinates(
        self, level: int = -1, window: Any = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x and y of samples, equal to rioxarray's to the last bit.

        Parameters
        ----------
        level : int
            Resolution level, as in `read`.
        window : optional
            A window as in `read`. Returns x and y of each of its samples, for levels that are
            turned (`is_turned`). By default x of columns and y of rows.

        Returns
        -------
        x, y : ndarray of float64
            Of shape (n_cols,) and (n_rows,), or that of the window.
        """
        transform = self.level_place(level).transform
        if window is not None:
            row, col, n_rows, n_cols = region_of_window(window, self.level_shape(level))
            rows, cols = np.mgrid[row : row + n_rows, col : col + n_cols].astype(np.float64)
            return coordinates(transform, rows, cols)
        rows, cols = (np.arange(size, dtype=np.float64) for size in self.level_shape(level))
        x, _ = coordinates(transform, np.zeros_like(cols), cols)
        _, y = coordinates(transform, rows, np.zeros_like(rows))
        return x, y

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return (left, bottom, right, top) of the raster's pixels in its CRS."""
        return bounds(self._raster.transform, self.shape)

    def parts(self) -> "Parts":
        """Return the bytes of each part of the file; reads the whole index."""
        from terrainwave.container.reader import parts_of

        parts = parts_of(self.container)
        if METHODS[self.header.method].is_tiled:  # of several levels together
            return replace(parts, heights=(sum(parts.heights),))
        return parts

    def block_error(self, block: Block) -> float:
        """Return the stored error of a block's bilinear surface, in physical units.

        No valid original under the block is further from the bilinear interpolation of its
        decoded samples. It was measured; in a faithful file it is an upper bound.
        """
        code = self.container.codes(block)[2]
        return decode_error(code) * self.quantizer.quantum * abs(self._raster.scale)

    def block_box(self, block: Block) -> tuple[float, float]:
        """Return the lowest and highest height of a block and all below it, in physical units.

        Every original under the block lies between, and so does the bilinear surface of each block
        at or below it. A block without valid samples has the box of its parent.
        """
        header, scale = self.header, self._raster.scale
        low, high = self.box_quanta(block)
        unit = header.quantum.numerator / header.quantum.denominator * scale
        ends = [(quanta + header.base) * unit + self._raster.offset for quanta in (low, high)]
        return min(ends), max(ends)

    def box_quanta(self, block: Block) -> tuple[int, int]:
        """Return a block's lowest and highest height from the index, in quanta."""
        header, key = self.header, block.parent
        # Relative to the box of the key if the segment of the key lists that block, else to the
        # raster's.
        is_first = block.level == 0 or self.grid.segment_head(key) == key
        outer = (header.z_min, header.z_max) if is_first else self.box_quanta(key)
        below, above = self.container.codes(block)[:2]
        return decode_range(below, above, *outer)

    @property
    def mesh_kind(self) -> str:
        """Return the kind of the file's meshes, ``"none"`` if it has none."""
        return self.header.mesh

    @property
    def has_measured_meshes(self) -> bool:
        """Return whether the file stores errors of the meshes of all its levels."""
        if self.mesh_kind == "none":
            return False
        return not (self.container.segment(None).page.codes[:, 3] == UNMEASURED).any()

    def stored_mesh_error(self, block: Block) -> float | None:
        """Return the stored error of a block's mesh, an upper bound, in physical units.

        No valid original that the mesh covers is further from it. None if the file has none.
        """
        code = UNMEASURED if self.mesh_kind == "none" else self.container.codes(block)[3]
        if code == UNMEASURED:
            return None
        return decode_error(code) * self.quantizer.quantum * abs(self._raster.scale)

    def level_errors(self) -> list[float]:
        """Return the largest stored error of the blocks of each level, the coarsest level first."""
        codes = [0] * self.n_levels
        for segment in self.container.present_segments():
            for block, row in segment.layout.block_rows.items():
                codes[block.level] = max(codes[block.level], int(segment.page.codes[row, 2]))
        unit = self.quantizer.quantum * abs(self._raster.scale)
        return [decode_error(code) * unit for code in codes]

    def region(
        self, window: Any = None, *, bounds: Sequence[float] | None = None, level: int = -1
    ) -> Region:
        """Return the part of a level that a window or bounds name, clipped to the level.

        Raises
        ------
        InvalidArgumentError
            If both are given, one is malformed, or they miss the level.
        """
        return self.checked_window(window, bounds=bounds, level=level).region

    def checked_window(
        self, window: Any = None, *, bounds: Sequence[float] | None = None, level: int = -1
    ) -> LevelWindow:
        """Return the part as `region` does, with its level and what was cut off.

        Arguments and errors are those of `region`. They are checked only here.
        """
        return self.level_place(level).window(window, bounds)


def _affine(*transform: float) -> "Affine":
    """Return a transform of the library `affine`, which is loaded when one is wanted."""
    from affine import Affine

    return Affine(*transform)
