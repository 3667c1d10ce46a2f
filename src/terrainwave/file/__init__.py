"""`TerrainFile`: an open .twz file and its heights. Reading starts here."""

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import (
    EXACT,
    ON_ERROR,
    VOIDS,
    check_choice,
    check_flags,
    checked_number,
    checked_numbers,
    checked_whole,
    shown,
)
from terrainwave.errors import InvalidArgumentError, LimitExceededError
from terrainwave.file.described import DescribedFile
from terrainwave.grid.quadtree import Region
from terrainwave.names import METHODS, methods_that
from terrainwave.read.places import places_of, to_samples
from terrainwave.read.resample import RESAMPLING, resample

if TYPE_CHECKING:
    from terrainwave.file.info import Info
    from terrainwave.read.coded import EvenBlocks
    from terrainwave.read.decoder import TreeDecoder
    from terrainwave.read.lost import Lost
    from terrainwave.read.native import Library
    from terrainwave.read.window_reader import WindowReader

DEFAULT_MAX_BYTES = 4 << 30
# Heights in the dtype of the raster.
RasterHeights = NDArray[np.integer[Any] | np.floating[Any]]


class EarlyHeights(NamedTuple):
    """Heights and validity of a window, and the number of payload bytes read for them."""

    heights: NDArray[Any]
    valid: NDArray[np.bool_]
    n_bytes: int


class TerrainFile(DescribedFile):
    """An open .twz file: windows of heights at any level, decoded on demand.

    Parameters
    ----------
    source : path, URL, bytes or binary file object
        The .twz file. Opening it reads only the header and the first index page.
    cache_bytes : int
        Memory for decoded heights; the least recently used are dropped first.
    threads : int, optional
        Threads that decode; the number of processors by default.
    native : bool
        Read heights with the native library if the package has one. The heights are the same.
        ``TERRAINWAVE_NATIVE=0`` in the environment turns it off everywhere.
    on_error : str
        Default behaviour of reads on damage: ``"raise"``, or ``"mask"``, which leaves damaged
        blocks void and lists them in `lost`. A file that ends too early opens only with ``"mask"``,
        and gives all levels and blocks that it has.

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

    def close(self) -> None:
        """Close the file and stop the threads."""
        if "_windows" in self.__dict__:
            self._windows.close()
        super().close()

    @cached_property
    def decoder(self) -> "TreeDecoder":
        """Return the decoder of the file's units, with its cache; heights are in quanta."""
        # Imported when heights are first read: opening a file and `info` need no numba.
        from terrainwave.read.window_reader import make_decoder

        return make_decoder(self.header, self.container.payloads, self._cache_bytes)

    @cached_property
    def _windows(self) -> "WindowReader":
        from terrainwave.read.window_reader import WindowReader

        library, native = self._library(), None
        if library is not None:
            from terrainwave.read.native import NativeFile

            native = NativeFile(
                library, self.container, cache_bytes=self._cache_bytes, n_threads=self.n_threads
            )
        return WindowReader(
            str(self.name), self.header, self.n_threads, lambda: self.decoder, native
        )

    @property
    def is_native(self) -> bool:
        """True if the native library reads heights: installed, compatible, and not turned off.

        Raises
        ------
        InvalidArgumentError
            If ``TERRAINWAVE_NATIVE`` is neither 0 nor 1.
        """
        return self._library() is not None

    def _library(self) -> "Library | None":
        if not self._may_be_native or self.container.n_missing:
            return None
        from terrainwave.read import native

        return native.installed() if native.is_wanted() else None

    def info(self) -> "Info":
        """Return a summary of the file, only from its header."""
        from terrainwave.file.info import info_of

        return info_of(self)

    def read(
        self,
        window: Any = None,
        *,
        bounds: Sequence[float] | None = None,
        level: int = -1,
        out_shape: tuple[int, int] | None = None,
        resampling: str = "nearest",
        masked: bool = False,
        on_error: str | None = None,
        voids: str = EXACT,
        max_bytes: int = DEFAULT_MAX_BYTES,
    ) -> RasterHeights:
        """Read heights in the file's dtype; voids have the nodata value, NaN or 0.

        Heights are as stored in the raster. If the band has a scale and offset (`info`), physical
        heights are ``scale * stored + offset``.

        Parameters
        ----------
        window : optional
            Part of the level to read, in samples of that level; clipped to it. One of:

            - ``(first_row, first_col, n_rows, n_cols)``: first row and column, then
              numbers of rows and columns. ``(100, 50, 20, 30)`` is rows 100 … 119 of columns
              50 … 79.
            - a rasterio ``Window``, in whole samples;
            - ``numpy.s_[100:120, 50:80]``: a slice of rows and one of columns, without steps.
        bounds : (left, bottom, right, top), optional
            Instead of `window`: read the pixels that touch this rectangle, in the CRS.
        level : int
            Resolution level: -1 the full grid, -2 half, …; 0 the coarsest.
        out_shape : tuple of int, optional
            Resample the window to this shape.
        resampling : str
            ``"nearest"``, ``"bilinear"`` or ``"average"``; used with `out_shape`.
        masked : bool
            Return a masked array, as rasterio does.
        on_error : str
            ``"raise"``, or ``"mask"``: damaged blocks are void (`lost` lists them), and the rest
            is returned. Default: as the file was opened.
        voids : str
            Voids of a coarse level. ``"exact"``: samples where the full grid is void. ``"any"``:
            only samples without valid surroundings; other voids are filled from their surroundings,
            as in meshes.
        max_bytes : int
            Raise if the result is larger.

        Returns
        -------
        heights : ndarray of the raster's dtype (`dtype`), shape (n_rows, n_cols)
            A copy; a `numpy.ma.MaskedArray` if `masked`. The dtype is that of the raster, on every
            level: uint8, int16, uint16, int32, float32 or float64. On the full grid every valid
            sample is within `effective_error` of the original. For floats on a decimal grid (0.1,
            0.01 …) this holds for the decimal numbers; the floats nearest to them may differ by one
            float spacing more (`Info.float_error`), unless the file was made with `strict`.

        Raises
        ------
        InvalidArgumentError
            If an argument is out of range or the window misses the level.
        LimitExceededError
            If the result would be larger than `max_bytes`.
        CorruptStreamError
            If a block is damaged and `on_error` is ``"raise"``; the message names it.
        """
        on_error = self._checked_reading(on_error, voids)
        check_choice("resampling", resampling, RESAMPLING)
        check_flags(masked=masked)
        max_bytes = checked_whole("max_bytes", max_bytes, least=0)
        if out_shape is not None:
            out_shape = checked_numbers("out_shape", out_shape, "n_rows, n_cols", is_whole=True)
            if min(out_shape) < 1:
                raise InvalidArgumentError(
                    f"found `out_shape` {shown(out_shape)}, expected at least (1, 1)"
                )
        asked = self.checked_window(window, bounds=bounds, level=level)
        index, region = asked.level, asked.region
        self._check_size(out_shape or region.shape, max_bytes)
        if out_shape is None:
            value = None if masked else self._raster.void_value
            heights, void = self._windows.read(index, region, on_error, voids, void_value=value)
        else:
            heights, void = resample(
                lambda shift, part: self._windows.read(index - shift, part, on_error, voids),
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
        on_error: str | None = None,
        voids: str = EXACT,
    ) -> tuple[RasterHeights, NDArray[np.bool_]]:
        """Return heights and validity of a window of a level; arguments as in `read`.

        For rasters whose voids are marked by a mask: their heights alone do not show voids.
        """
        on_error = self._checked_reading(on_error, voids)
        asked = self.checked_window(window, level=level)
        return self._filled(*self._windows.read(asked.level, asked.region, on_error, voids))

    def _checked_reading(self, on_error: str | None, voids: str) -> str:
        """Return how to handle damage: as the read requests, else as the file was opened."""
        check_choice("voids", voids, VOIDS)
        if on_error is None:
            return self.on_error
        check_choice("on_error", on_error, ON_ERROR)
        return on_error

    @property
    def lost(self) -> "list[Lost]":
        """Return the damaged blocks that reads have left void so far, coarse levels first.

        Each is ``(level, window, problem)``, with the window in samples of the level:
        ``(first_row, first_col, n_rows, n_cols)``.
        """
        return self._windows.lost

    def _filled(
        self, heights: NDArray[Any], void: NDArray[np.bool_] | None
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights with the void value in voids, and validity."""
        if void is None:
            return heights, np.ones(heights.shape, dtype=np.bool_)
        heights[void] = self._raster.void_value
        return heights, ~void

    def read_early(
        self,
        window: Any = None,
        *,
        quality: float,
        level: int = -1,
        on_error: str | None = None,
        voids: str = EXACT,
    ) -> EarlyHeights:
        """Return the best heights of a window for a number of bits per sample.

        Parameters
        ----------
        window, level, on_error, voids
            As in `read`.
        quality : float
            Bits per sample of the window to read from payloads; > 0. The heads of all tiles in the
            window are always read.

        Raises
        ------
        InvalidArgumentError
            If the file is not of method cdf53, the only one whose streams can be read in part, or
            if `quality` is out of range.
        """
        on_error = self._checked_reading(on_error, voids)
        quality = checked_number("quality", quality, above=0)
        asked, method = self.checked_window(window, level=level), self.header.method
        if not METHODS[method].is_cuttable:
            fit = methods_that(lambda method: method.is_cuttable)
            raise InvalidArgumentError(
                f"found `quality` and a file of method {method}, expected one of method"
                f" {fit}: other streams cannot be read in part"
            )
        from terrainwave.read.early import early_decoder

        decoder, payloads = early_decoder(
            self.container, asked.level, asked.region, quality, cache_bytes=self._cache_bytes
        )
        found = self._windows.read(asked.level, asked.region, on_error, voids, decoder)
        return EarlyHeights(*self._filled(*found), payloads.n_bytes)

    def sample(
        self,
        points: Iterable[tuple[float, float]] | NDArray[np.float64],
        *,
        level: int = -1,
        voids: str = EXACT,
    ) -> NDArray[np.float64]:
        """Return bilinear heights at world coordinates, in physical units.

        Parameters
        ----------
        points : sequence of (x, y), or array of shape (n_points, 2)
            Points in the file's CRS. Longitudes may be of any turn: -170 and 190 are the same, and
            in a raster around the whole globe the first column follows the last.
        level, voids
            As in `read`.

        Returns
        -------
        heights : ndarray of float64, shape (n_points,)
            NaN outside the outermost samples and where a sample needed is void. The error bound
            holds at samples, not between them.
        """
        from terrainwave.place.position import longitude_turn

        places = places_of(points)
        check_choice("voids", voids, VOIDS)
        index, turn = self.level_index(level), longitude_turn(self.crs)
        if turn is not None:
            places = turn.near(places, self.bounds)
        rows, cols = to_samples(places, self.level_place(index).transform)
        is_round = turn is not None and turn.is_whole(self._raster.transform, self.shape[1])
        return self.heights_at(rows, cols, level=index, voids=voids, is_round=is_round)

    def heights_at(
        self,
        rows: NDArray[np.float64],
        cols: NDArray[np.float64],
        *,
        level: int = -1,
        voids: str = EXACT,
        is_round: bool = False,
    ) -> NDArray[np.float64]:
        """Return bilinear heights at fractional rows and columns of a level, in physical units.

        Parameters
        ----------
        rows, cols : ndarray of float64, shape (n_points,)
            Sample (r, c) of the level lies at r, c.
        level, voids
            As in `read`.
        is_round : bool
            The first column follows the last.

        Returns
        -------
        heights : ndarray of float64, shape (n_points,)
            NaN outside the outermost samples and where a sample needed is void.

        Raises
        ------
        InvalidArgumentError
            If the level does not exist.
        CorruptStreamError
            If a block is damaged.
        """
        index = self.level_index(level)
        heights = self._heights_inside(index, rows, cols, voids)
        last = self.grid.level_shape(index)[1] - 1
        beyond = np.isfinite(cols) & ((cols < 0) | (cols > last))
        if is_round and beyond.any():
            # Between the last column and the first one of the next turn.
            n_around = self.shape[1] / self.grid.stride(index)
            across = np.mod(cols[beyond] - last, n_around) / (n_around - last)
            columns = np.repeat([float(last), 0.0], across.size)
            left, right = self._heights_inside(
                index, np.tile(rows[beyond], 2), columns, voids
            ).reshape(2, -1)
            heights[beyond] = left * (1 - across) + right * across
        return heights

    def _heights_inside(
        self, level: int, rows: NDArray[np.float64], cols: NDArray[np.float64], voids: str
    ) -> NDArray[np.float64]:
        """Return bilinear heights at fractional samples; NaN outside the grid and in voids."""
        n_rows, n_cols = self.grid.level_shape(level)
        inside = (rows >= 0) & (rows <= n_rows - 1) & (cols >= 0) & (cols <= n_cols - 1)
        heights = np.full(len(rows), np.nan)
        if inside.any():
            raw, is_void = self._windows.bilinear(level, rows[inside], cols[inside], voids)
            physical = raw * self._raster.scale + self._raster.offset
            heights[inside] = np.where(is_void, np.nan, physical)
        return heights

    def count_voids(self) -> int:
        """Return the number of void samples of the full grid; decodes all of it, band by band."""
        n_rows, n_cols = self.shape
        n_voids = 0
        for row in range(0, n_rows, self.grid.block):
            _, valid = self.read_with_mask((row, 0, self.grid.block, n_cols))
            n_voids += int(valid.size - np.count_nonzero(valid))
        return n_voids

    def coded_parts(self, region: Region, level: int = -1) -> Iterator[Region]:
        """Yield the parts of a region of a level that may have heights, by the index only.

        All else is void, so little is read of a mostly void file.
        """
        from terrainwave.read.coded import coded_parts

        if METHODS[self.header.method].is_tiled:
            return iter([region])
        return coded_parts(self.container, self.level_index(level), region)

    def even_blocks(self) -> "EvenBlocks | None":
        """Return the finder of blocks of one height; None for tiled methods."""
        from terrainwave.read.coded import EvenBlocks

        if METHODS[self.header.method].is_tiled:
            return None
        return EvenBlocks(self.container, self.decoder)

    def digest(self) -> str | None:
        """Return the root of the file's digests, 64 hexadecimal digits; None if it has none.

        It identifies all decoded heights of the full grid, the voids, and the position of the
        heights: size, type, CRS, transform, units, scale and offset (FORMAT.md §4.9). It does not
        depend on the coding of the file. Nothing is decoded: `verify` compares heights with it.

        Raises
        ------
        CorruptStreamError
            If the digests are damaged.
        """
        tree = self.container.digests()
        return None if tree is None else tree.root(self.header)

    def check(self, root: str | None = None, window: Any = None) -> Iterator[str]:
        """Check all checksums and decode every unit; yield problems, in plain words.

        Heights are compared with the file's digests, if any, and with `root`, a root as `digest`
        returns it. With `window` (row, col, n_rows, n_cols) only that part of the full grid is
        decoded and compared, in squares of 4096 x 4096 samples.
        """
        from terrainwave.read.check import check_units, check_window

        if window is None:
            return check_units(self.container, self.decoder, root)
        region = self.checked_window(window).region
        return check_window(self.container, self.decoder, region, root)

    def _check_size(self, shape: tuple[int, int], max_bytes: int) -> None:
        n_bytes = int(shape[0]) * int(shape[1]) * self.dtype.itemsize
        if n_bytes > max_bytes:
            raise LimitExceededError(
                f"the window holds {shape[0]} x {shape[1]} samples, {n_bytes:,} bytes; more than"
                f" max_bytes = {max_bytes:,}: read a smaller window or a coarser level"
            )
