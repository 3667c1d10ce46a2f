"""`Terrain`: an open .twz file. Reading starts here."""

import contextlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import EFFORTS
from terrainwave.codec.units import CodecParameters, unit_spec
from terrainwave.codes import decode_error, decode_range
from terrainwave.container.reader import Container
from terrainwave.container.source import open_source
from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    LimitExceededError,
    StorageError,
    UnsupportedVersionError,
)
from terrainwave.quadtree import Block, Grid, Region
from terrainwave.quantum import Quantizer
from terrainwave.raster_io.info import RasterInfo
from terrainwave.resample import RESAMPLING, resample
from terrainwave.schedule import run_after_parents

if TYPE_CHECKING:
    import xarray as xr

    from terrainwave.decoder import TreeDecoder
    from terrainwave.meshing import BlockMesher
    from terrainwave.render.static import Picture
    from terrainwave.render.style import Style
    from terrainwave.tri.mesh import BlockMesh, Mesh

Window = tuple[int, int, int, int]
DEFAULT_CACHE_BYTES = 256 << 20
DEFAULT_MAX_BYTES = 4 << 30
# Payloads fetched ahead of decoding, in one coalesced request.
_BATCH = 64


@dataclass(frozen=True)
class Info:
    """What a .twz file says about itself; errors are in physical units."""

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
    units: str | None
    method: str
    effort: str
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


class Terrain:
    """An open .twz file: windows of heights at any level, decoded on demand.

    Parameters
    ----------
    source : path, URL, bytes or binary file object
        What to read. Opening reads the header and the first index page only.
    cache_bytes : int
        Decoded heights kept in memory, least recently used dropped first.
    threads : int, optional
        Threads that decode; the number of processors by default.

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
        self, source: Any, *, cache_bytes: int = DEFAULT_CACHE_BYTES, threads: int | None = None
    ) -> None:
        if threads is not None and threads < 1:
            raise InvalidHeightsError(f"found {threads} threads, expected at least 1")
        self._arguments = (source, cache_bytes, threads)
        self._source = open_source(source)
        try:
            self._container = Container(self._source)
            header = self._container.header
            if header.parameters and header.method not in ("predictive", "rapid"):
                raise UnsupportedVersionError(
                    f"the file has parameters for method {header.method}, which this terrainwave"
                    " does not know: install a newer one"
                )
            # Null means the same as a key that is missing (FORMAT.md §4.2).
            known = {name: value for name, value in header.metadata.items() if value is not None}
            known |= {"n_rows": header.n_rows, "n_cols": header.n_cols, "dtype": header.dtype}
            self._raster = RasterInfo.from_metadata(known)
        except BaseException:
            self._source.close()
            raise
        self.name = source if isinstance(source, str | os.PathLike) else "<bytes>"
        self._grid = header.grid
        self._quantizer = Quantizer(
            dtype=header.dtype,
            numerator=header.quantum.numerator,
            denominator=header.quantum.denominator,
            base=header.base,
            step=header.step,
            rho=header.rho,
            z_min=header.z_min,
            z_max=header.z_max,
        )
        self._cache_bytes = cache_bytes
        self._n_threads = threads or os.cpu_count() or 1
        self._executor: ThreadPoolExecutor | None = None
        self._executor_pid = 0
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        source, cache_bytes, threads = self._arguments
        if not isinstance(source, str | os.PathLike):
            raise TypeError("only a Terrain opened by path or URL can be pickled")
        return _reopen, (source, cache_bytes, threads)

    def close(self) -> None:
        """Close the file and stop the threads."""
        if self._executor is not None:
            self._executor.shutdown()
        self._container.close()

    @cached_property
    def _parameters(self) -> CodecParameters:
        header = self._container.header
        return CodecParameters(
            step=header.step,
            z_min=header.z_min,
            z_max=header.z_max,
            forbidden=self._quantizer.quanta_of_value(self._raster.nodata),
            rings=header.border_rings,
            effort=header.effort,
        )

    @cached_property
    def _decoder(self) -> "TreeDecoder":
        # Imported when heights are first read: opening a file and `info` need no numba.
        from terrainwave.tile_decoder import make_decoder

        return make_decoder(
            self._container.header.method,
            self._container.header.parameters,
            self._grid,
            self._parameters,
            self._container.payloads,
            self._cache_bytes,
        )

    @cached_property
    def _mesher(self) -> "BlockMesher":
        from terrainwave.mesh_sections import parts_of_blocks
        from terrainwave.meshing import BlockMesher

        header = self._container.header
        return BlockMesher(
            self._grid,
            self._decoder,
            lambda block: self._container.codes(block)[2],
            header.mesh_tolerance,
            has_voids=self._raster.mask_kind != "none",
            kind=header.mesh,
            part=parts_of_blocks(self._grid, self._container.mesh),
        )

    @property
    def _pyramid(self) -> str:
        from terrainwave.codec.registry import PYRAMIDS

        return PYRAMIDS[self._container.header.method]

    # What the file says.

    @property
    def grid(self) -> Grid:
        """Return the quadtree of levels and blocks."""
        return self._grid

    @property
    def shape(self) -> tuple[int, int]:
        """Return the numbers of rows and columns of the full grid."""
        return self._grid.n_rows, self._grid.n_cols

    @property
    def dtype(self) -> np.dtype[Any]:
        """Return the type of the heights as stored in the source raster."""
        return np.dtype(self._raster.dtype)

    @property
    def raster_info(self) -> RasterInfo:
        """Return what the source raster said about itself."""
        return self._raster

    @property
    def nodata(self) -> int | float | None:
        """Return the source's nodata value, if it declared one."""
        return self._raster.nodata

    @property
    def crs(self) -> str | None:
        """Return the coordinate reference system as ``AUTH:CODE`` or WKT2."""
        return self._raster.crs

    @property
    def n_levels(self) -> int:
        """Return the number of resolution levels; level 0 is the coarsest, -1 the full grid."""
        return self._grid.k_max + 1

    @property
    def max_error(self) -> float:
        """Return the bound that was asked for, in physical units (after scale and offset)."""
        return self._container.header.max_error * abs(self._raster.scale)

    @property
    def effective_error(self) -> float:
        """Return the bound that holds, in physical units; at most `max_error`."""
        return self._container.header.effective_bound * abs(self._raster.scale)

    def level_index(self, level: int) -> int:
        """Return `level` counted from 0; negative levels count from the full grid, as Python does.

        Raises
        ------
        InvalidHeightsError
            If there is no such level.
        """
        index = level + self.n_levels if level < 0 else level
        if not 0 <= index < self.n_levels:
            raise InvalidHeightsError(
                f"found level {level}, expected 0 … {self.n_levels - 1}"
                f" or -1 (full) … -{self.n_levels}"
            )
        return index

    def level_shape(self, level: int = -1) -> tuple[int, int]:
        """Return the numbers of rows and columns of a level."""
        return self._grid.level_shape(self.level_index(level))

    def transform(self, level: int = -1, window: Window | None = None) -> tuple[float, ...]:
        """Return the affine transform (a, b, c, d, e, f) of a level or of a window of it.

        Levels are samples at positions: the centre of the first pixel is the same on every level,
        the pixel grows by 2^j. x = a * col + b * row + c at pixel corners, as rasterio counts.
        """
        a, b, c, d, e, f = self._raster.transform
        stride = self._grid.stride(self.level_index(level))
        shift = (1 - stride) / 2  # from the corner of the full grid's first pixel to the level's
        row, col = (0, 0) if window is None else window[:2]
        corner_col, corner_row = shift + col * stride, shift + row * stride
        return (
            a * stride, b * stride, c + a * corner_col + b * corner_row,
            d * stride, e * stride, f + d * corner_col + e * corner_row,
        )  # fmt: skip

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return (left, bottom, right, top) of the raster's pixels in its CRS."""
        a, b, c, d, e, f = self._raster.transform
        n_rows, n_cols = self.shape
        xs = [c + a * col + b * row for row in (0, n_rows) for col in (0, n_cols)]
        ys = [f + d * col + e * row for row in (0, n_rows) for col in (0, n_cols)]
        return min(xs), min(ys), max(xs), max(ys)

    def info(self) -> Info:
        """Return a summary of the file, from its header alone."""
        header, raster = self._container.header, self._raster
        n_samples = header.n_rows * header.n_cols
        quantum = self._quantizer.quantum * abs(raster.scale)
        has_heights = header.z_min <= header.z_max
        physical = [
            self._quantizer.height_of(quantum) * raster.scale + raster.offset
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
            rounding_error=self._quantizer.rho * abs(raster.scale),
            units=raster.units,
            method=header.method,
            effort=EFFORTS[min(header.effort, len(EFFORTS) - 1)],
            block=header.block,
            border_rings=header.border_rings,
            mesh=header.mesh,
            mesh_tolerance=header.mesh_tolerance / 16 * quantum,
            n_levels=self.n_levels,
            level_shapes=tuple(self._grid.level_shape(level) for level in range(self.n_levels)),
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
        )

    def block_error(self, block: Block) -> float:
        """Return the stored measured error of a block's bilinear surface, in physical units.

        No valid original under the block is further from the bilinear interpolation of its
        decoded samples (DESIGN §3.9).
        """
        code = self._container.codes(block)[2]
        return decode_error(code) * self._quantizer.quantum * abs(self._raster.scale)

    def block_box(self, block: Block) -> tuple[float, float]:
        """Return lowest and highest height of a block and all below it, in physical units.

        Every original under the block lies between, and so does the bilinear surface of each block
        at or below it. A block without valid samples has the box of its parent.
        """
        header, scale = self._container.header, self._raster.scale
        low, high = self._box_quanta(block)
        unit = header.quantum.numerator / header.quantum.denominator * scale
        ends = [(quanta + header.base) * unit + self._raster.offset for quanta in (low, high)]
        return min(ends), max(ends)

    def _box_quanta(self, block: Block) -> tuple[int, int]:
        header = self._container.header
        outer = (header.z_min, header.z_max) if block.level == 0 else self._box_quanta(block.parent)
        below, above = self._container.codes(block)[:2]
        return decode_range(below, above, *outer)

    @property
    def mesh_kind(self) -> str:
        """Return the kind of the file's meshes, ``"none"`` if it has none."""
        return self._container.header.mesh

    def mesh_error(self, block: Block) -> float:
        """Return the stored measured error of a block's mesh, in physical units.

        No valid original that the mesh covers is further from it.

        Raises
        ------
        InvalidHeightsError
            If the file has no meshes.
        """
        if self.mesh_kind == "none":
            raise InvalidHeightsError("the file has no meshes: add them with terrainwave mesh")
        code = self._container.codes(block)[3]
        return decode_error(code) * self._quantizer.quantum * abs(self._raster.scale)

    def level_errors(self) -> list[float]:
        """Return the largest stored error of the blocks of each level, the coarsest level first."""
        codes = [0] * self.n_levels
        for segment in self._container.present_segments():
            for block, row in segment.block_rows.items():
                codes[block.level] = max(codes[block.level], int(segment.page.codes[row, 2]))
        unit = self._quantizer.quantum * abs(self._raster.scale)
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
        quality: float | None = None,
        max_bytes: int = DEFAULT_MAX_BYTES,
    ) -> NDArray[Any]:
        """Read heights in the file's dtype, the void value in voids.

        Parameters
        ----------
        window : tuple (row, col, n_rows, n_cols) or rasterio Window, optional
            Part of the level to read, in samples of that level; clipped to it.
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
        quality : float, optional
            Of a file of method cdf53, read only so many bits per sample of the window: the best
            heights of that many bytes (`read_early` tells how many it were). No bound holds then.
        max_bytes : int
            Refuse a larger result.

        Returns
        -------
        heights : ndarray, shape (n_rows, n_cols)
            A copy. On the full grid every valid sample is within `effective_error` of the original;
            of floats on a decimal grid (0.1, 0.01 …) this holds for the decimal numbers, and the
            floats nearest to two of them may differ by one float spacing more.

        Raises
        ------
        InvalidHeightsError
            If an argument is out of range or the window misses the level.
        LimitExceededError
            If the result would be larger than `max_bytes`.
        CorruptStreamError
            If a block is damaged and `on_error` is ``"raise"``; the message names it.
        """
        if on_error not in ("raise", "mask"):
            raise InvalidHeightsError(f"found on_error {on_error!r}, expected 'raise' or 'mask'")
        if resampling not in RESAMPLING:
            raise InvalidHeightsError(
                f"found resampling {resampling!r}, expected one of {', '.join(RESAMPLING)}"
            )
        index = self.level_index(level)
        region = self.region(window, bounds=bounds, level=level)
        self._check_size(out_shape or region.shape, max_bytes)
        if quality is not None:
            if out_shape is not None:
                raise InvalidHeightsError("found quality and out_shape, expected one of them")
            heights, valid, _ = self._read_early(index, region, quality, on_error)
        elif out_shape is None:
            heights, valid = self._read_raw(index, region, on_error)
        else:
            heights, valid = resample(
                lambda shift, part: self._read_raw(index - shift, part, on_error),
                region,
                out_shape,
                resampling,
                index,
                self._grid,
                max_bytes,
            )
        heights[~valid] = self._raster.void_value
        if masked:
            fill = None if self._raster.nodata is None else self.dtype.type(self._raster.nodata)
            return np.ma.MaskedArray(heights, mask=~valid, fill_value=fill)
        return heights

    def read_with_mask(
        self, window: Any = None, *, level: int = -1, on_error: str = "raise"
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights and validity of a window of a level; arguments as in `read`.

        What `read` cannot tell: a raster with a mask of its own may hold any value in its voids.
        """
        region = self.region(window, level=level)
        heights, valid = self._read_raw(self.level_index(level), region, on_error)
        heights[~valid] = self._raster.void_value
        return heights, valid

    def read_early(
        self, window: Any = None, *, quality: float, level: int = -1, on_error: str = "raise"
    ) -> "EarlyHeights":
        """Return the best heights of a window that so many bits per sample give.

        Parameters
        ----------
        window, level, on_error
            As in `read`.
        quality : float
            Bits per sample of the window to read of payloads; > 0. The heads of all tiles needed
            are read in any case.

        Raises
        ------
        InvalidHeightsError
            If the file is not of method cdf53, whose streams alone can be read in part, or
            `quality` is out of range.
        """
        region = self.region(window, level=level)
        found = self._read_early(self.level_index(level), region, quality, on_error)
        found.heights[~found.valid] = self._raster.void_value
        return found

    def _read_early(
        self, level: int, region: Region, quality: float, on_error: str
    ) -> "EarlyHeights":
        header = self._container.header
        if header.method != "cdf53":
            raise InvalidHeightsError(
                f"found quality and a file of method {header.method}, expected one of method cdf53:"
                " other streams cannot be read in part"
            )
        if not (np.isfinite(quality) and quality > 0):
            raise InvalidHeightsError(f"found quality {quality}, expected a number > 0")
        from terrainwave.decoder import units_of
        from terrainwave.early import EarlyPayloads
        from terrainwave.tile_decoder import TileDecoder

        max_bytes = int(quality * region.n_rows * region.n_cols / 8)
        payloads = EarlyPayloads(self._container, units_of(self._grid, level, region), max_bytes)
        decoder = TileDecoder(
            self._grid, self._parameters, payloads, self._cache_bytes, are_prefixes=True
        )
        heights, valid = self._read_raw(level, region, on_error, decoder)
        return EarlyHeights(heights, valid, payloads.n_bytes)

    def region(
        self, window: Any = None, *, bounds: Sequence[float] | None = None, level: int = -1
    ) -> Region:
        """Return the part of a level that a window or bounds name, clipped to the level.

        Raises
        ------
        InvalidHeightsError
            If both are given, one is malformed, or they miss the level.
        """
        index = self.level_index(level)
        n_rows, n_cols = self._grid.level_shape(index)
        whole = Region(0, 0, n_rows, n_cols)
        if bounds is not None:
            if window is not None:
                raise InvalidHeightsError("found both window and bounds, expected one of them")
            asked = self._bounds_region(bounds, index)
        elif window is None:
            asked = whole
        else:
            asked = _region_of_window(window)
        region = asked.intersect(whole)
        if region.n_rows <= 0 or region.n_cols <= 0:
            raise InvalidHeightsError(
                f"the window (row {asked.row}, column {asked.col}, {asked.n_rows} x {asked.n_cols})"
                f" does not meet the level's {n_rows} x {n_cols} samples"
            )
        return region

    def sample(
        self, points: Iterable[tuple[float, float]] | NDArray[np.float64], *, level: int = -1
    ) -> NDArray[np.float64]:
        """Return bilinear heights at world coordinates, in physical units.

        Parameters
        ----------
        points : sequence of (x, y), or array of shape (n_points, 2)
            Places in the file's CRS.

        Returns
        -------
        heights : ndarray of float64, shape (n_points,)
            NaN outside the outermost samples and where a sample needed is void. The error bound
            holds at samples, not between them.
        """
        listed = points if isinstance(points, np.ndarray) else list(points)
        places = np.asarray(listed, dtype=np.float64).reshape(-1, 2)
        index = self.level_index(level)
        rows, cols = self._to_samples(places, index)
        n_rows, n_cols = self._grid.level_shape(index)
        inside = (rows >= 0) & (rows <= n_rows - 1) & (cols >= 0) & (cols <= n_cols - 1)
        heights = np.full(len(places), np.nan)
        if inside.any():
            heights[inside] = self._bilinear(index, rows[inside], cols[inside])
        return heights

    # Meshes.

    def mesh(
        self,
        window: Any = None,
        *,
        bounds: Sequence[float] | None = None,
        level: int = -1,
        max_error: float | None = None,
        max_triangles: int | None = None,
        optimise: int = 0,
    ) -> "Mesh":
        """Return one connected watertight mesh of an area.

        Parameters
        ----------
        window, bounds : optional
            The area as in `read`, here between the centres of its outermost pixels.
        level : int
            The finest level to use, as in `read`. A coarse level's mesh ends at its last sample: up
            to 2^j - 1 rows and columns of the full grid lie beyond it.
        max_error : float, optional
            Largest vertical distance from any valid original sample, in physical units. Blocks of
            several levels are mixed to reach it with few triangles; whatever the file's kind of
            meshes, they are made anew as `halves`, of the decoded heights. By default the stored
            meshes of `level` are taken as they are.
        max_triangles : int, optional
            Find the smallest error, up to 2 %, whose mesh has at most as many triangles; not
            beyond `max_error`, if that is given too.
        optimise : int
            Sweeps of half-edge collapses over blocks of the full grid: one nearly halves the
            triangles. They too are of meshes made anew as `halves`.

        Returns
        -------
        Mesh
            Its `error` holds at every valid sample it covers. It covers the quads of four valid
            samples and the triangles of three.

        Raises
        ------
        InvalidHeightsError
            If an argument is out of range, the area is less than 2 x 2 samples, or `max_error` is
            less than the file's own error.
        CorruptStreamError
            If a block is damaged.
        """
        from terrainwave.extraction import Area, extract

        index = self.level_index(level)
        region = self.region(window, bounds=bounds, level=level)
        if min(region.shape) < 2:
            raise InvalidHeightsError(
                f"found an area of {region.n_rows} x {region.n_cols} samples, expected at least"
                " 2 x 2: a mesh lies between samples"
            )
        if max_triangles is not None and max_triangles < 1:
            raise InvalidHeightsError(f"found max_triangles {max_triangles}, expected at least 1")
        if max_error is not None and not (np.isfinite(max_error) and max_error >= 0):
            raise InvalidHeightsError(f"found max_error {max_error}, expected a number >= 0")
        if optimise < 0:
            raise InvalidHeightsError(f"found optimise {optimise}, expected 0 or more sweeps")
        area = Area(region, index, int(optimise))
        return extract(self, area, max_error, max_triangles, self._n_threads)

    def block_mesh(self, block: Block) -> "BlockMesh":
        """Return the mesh of a block as `mesh_error` measures it, in samples and quanta.

        Places count from the block's first sample; the mesh may reach past the raster's edge.
        """
        if self.mesh_kind == "none":
            raise InvalidHeightsError("the file has no meshes: add them with terrainwave mesh")
        if not self._grid.contains(block):
            raise InvalidHeightsError(f"found {block}, expected a block of the file's levels")
        return self._mesher.mesh(block)

    # To other libraries.

    def to_xarray(self, *, level: int = -1, mask_and_scale: bool = True) -> "xr.DataArray":
        """Return a level as a DataArray that reads windows of it when they are computed.

        It has the coordinates of `xarray.open_dataset` and lives as long as this Terrain is open.

        Parameters
        ----------
        level : int
            Resolution level, as in `read`.
        mask_and_scale : bool
            Voids become NaN, scale and offset are applied; else values as stored.

        Raises
        ------
        TerrainwaveError
            If xarray is not installed.
        """
        from terrainwave.tri.export import need

        need("xarray", extra="xarray")
        from terrainwave.ext.xarray_backend import terrain_dataset

        return terrain_dataset(self, level, mask_and_scale=mask_and_scale)["heights"]

    def _repr_html_(self) -> str:
        from terrainwave.ext.html import terrain_html

        return terrain_html(self)

    # Pictures.

    def plot(
        self,
        ax: Any = None,
        *,
        bounds: Sequence[float] | None = None,
        cmap: str = "gist_earth",
        shade: float = 0.7,
    ) -> Any:
        """Draw a map, coloured by height and hillshaded; needs matplotlib.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to draw; a new figure by default.
        bounds : (left, bottom, right, top), optional
            What to show, in the CRS; by default all. A level fit for the figure is read.
        cmap : str
            matplotlib's name of the colours of heights.
        shade : float
            Share of the hillshade, 0 … 1.

        Returns
        -------
        ax : matplotlib Axes
            In coordinates of the CRS; a rotated raster is drawn along its rows.
        """
        from terrainwave.render.static import plot

        return plot(self, ax, cmap=cmap, shade=shade, bounds=bounds)

    def view(
        self,
        *,
        size: tuple[int, int] = (960, 640),
        camera: str | None = None,
        max_pixel_error: float = 1.0,
        style: "Style | None" = None,
        **options: Any,
    ) -> "Picture | None":
        """Open a window and fly over the terrain; in notebooks return a picture.

        Parameters
        ----------
        size : tuple of int
            Width and height in pixels.
        camera : str, optional
            ``x,y,z,heading,pitch,fov`` as `terrainwave view` prints it; by default all is shown.
        max_pixel_error : float
            τ: largest distance on screen from the full terrain, pixels.
        style : terrainwave.render.style.Style, optional
            Colours, light and haze.
        options
            ``mode``, ``error``, ``drape``, ``exaggeration``, ``radius`` as on the command line.

        Returns
        -------
        Picture, optional
            Where no window can be opened; notebooks show it, `Picture.save` writes a PNG. None
            after a window was closed.

        Raises
        ------
        TerrainwaveError
            If there is neither a window nor OpenGL without one; the line says what to install.
        """
        from terrainwave.render.static import view
        from terrainwave.render.style import Style

        return view(
            self, size=size, camera=camera, style=style or Style(),
            max_pixel_error=max_pixel_error, **options,
        )  # fmt: skip

    def check(self) -> Iterator[str]:
        """Check all checksums and decode every unit; yield what is wrong, in plain words."""
        yield from self._container.check()
        for key in self._grid.root_keys():
            yield from self._check_below(key)

    def _check_below(self, key: Block) -> Iterator[str]:
        try:
            self._decoder.unit(key)
        except CorruptStreamError as exc:
            yield str(exc)
            return  # what lies below cannot be decoded either
        blocks = self._grid.key_blocks(key)
        for block in blocks:
            if block.level < self._grid.k_max and not self._is_absent(block):
                yield from self._check_below(block)

    def _is_absent(self, block: Block) -> bool:
        """Say whether `block` heads a segment that is left out: all below it is void.

        A file of a few hundred bytes may claim 2^50 void samples.
        """
        if self._grid.segment_head(block) != block:
            return False
        try:
            return self._container.segment(block).page.is_empty
        except CorruptStreamError:
            return False  # its units will say so

    def _bounds_region(self, bounds: Sequence[float], level: int) -> Region:
        left, bottom, right, top = (float(value) for value in bounds)
        if not (left < right and bottom < top):
            raise InvalidHeightsError(
                f"found bounds {tuple(bounds)}, expected left < right and bottom < top"
            )
        corners = np.array([(x, y) for x in (left, right) for y in (bottom, top)])
        rows, cols = self._to_samples(corners, level)
        if not (np.isfinite(rows).all() and np.isfinite(cols).all()):
            raise InvalidHeightsError(
                f"found bounds {tuple(bounds)}, expected finite ones that the affine transform"
                f" {self._raster.transform} can place; read by window instead"
            )
        # Samples are pixel centres: half a pixel away begins the next pixel. A thousandth of a
        # pixel forgives the rounding of coordinates that name pixel edges.
        first_row, last_row = round_half_up(rows.min() + 0.001), round_half_up(rows.max() - 0.001)
        first_col, last_col = round_half_up(cols.min() + 0.001), round_half_up(cols.max() - 0.001)
        return Region(first_row, first_col, last_row - first_row + 1, last_col - first_col + 1)

    def _to_samples(
        self, places: NDArray[np.float64], level: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return fractional (rows, cols) of world coordinates on a level; integers are centres."""
        a, b, c, d, e, f = self.transform(level)
        determinant = a * e - b * d
        if determinant == 0:
            raise InvalidHeightsError(
                "the affine transform cannot be inverted; read by window instead"
            )
        # Extreme numbers of a file or a caller become NaN or infinite: no place in the raster.
        with np.errstate(all="ignore"):
            x, y = places[:, 0] - c, places[:, 1] - f
            return (a * y - d * x) / determinant - 0.5, (e * x - b * y) / determinant - 0.5

    def _check_size(self, shape: tuple[int, int], max_bytes: int) -> None:
        n_bytes = int(shape[0]) * int(shape[1]) * self.dtype.itemsize
        if n_bytes > max_bytes:
            raise LimitExceededError(
                f"the window holds {shape[0]} x {shape[1]} samples, {n_bytes:,} bytes; more than"
                f" max_bytes = {max_bytes:,}: read a smaller window or a coarser level"
            )

    def _read_raw(
        self,
        level: int,
        region: Region,
        on_error: str,
        decoder: "TreeDecoder | None" = None,
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return raw heights and validity of a region of a level, unit by unit."""
        decoder = decoder or self._decoder
        heights = np.zeros(region.shape, dtype=self.dtype)
        mask = np.zeros(region.shape, dtype=np.bool_)

        def fill(key: Block) -> None:
            spec = unit_spec(self._grid, self._parameters, key)
            part = spec.core.intersect(region)
            try:
                unit = decoder.unit(key)
            except CorruptStreamError:
                if on_error == "raise":
                    raise
                return
            there, here = part.slices_in(region), part.slices_in(spec.region)
            self._quantizer.dequantize(unit.heights[here], heights[there])
            mask[there] = unit.mask[here]

        # Imported late: numba.
        from terrainwave.decoder import units_of

        keys = units_of(self._grid, level, region)
        for first in range(0, len(keys), _BATCH):
            batch = keys[first : first + _BATCH]
            needed = list(dict.fromkeys([*decoder.prefetch(batch), *batch]))
            if len(needed) == 1 or self._n_threads == 1:
                for key in batch:
                    fill(key)
            else:
                self._run(_fill_or_decode(decoder, set(batch), fill), needed)
        return heights, mask

    def _bilinear(
        self, level: int, rows: NDArray[np.float64], cols: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        n_rows, n_cols = self._grid.level_shape(level)
        top, left = np.floor(rows).astype(np.int64), np.floor(cols).astype(np.int64)
        down, right = rows - top, cols - left
        total, is_void = np.zeros(rows.size), np.zeros(rows.size, dtype=np.bool_)
        for row, row_weight in ((top, 1 - down), (np.minimum(top + 1, n_rows - 1), down)):
            for col, col_weight in ((left, 1 - right), (np.minimum(left + 1, n_cols - 1), right)):
                heights, valid = self._gather(level, row, col)
                weight = row_weight * col_weight
                total += np.where(valid, heights, 0.0) * weight
                is_void |= ~valid & (weight > 0)
        total = total * self._raster.scale + self._raster.offset
        total[is_void] = np.nan
        return total

    def _gather(
        self, level: int, rows: NDArray[np.int64], cols: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        side = self._grid.block if level == 0 else 2 * self._grid.block
        n_rows, n_cols = self._grid.level_blocks(max(level - 1, 0))
        unit_rows, unit_cols = (
            np.minimum(rows // side, n_rows - 1),
            np.minimum(cols // side, n_cols - 1),
        )
        quanta, valid = np.zeros(rows.size, dtype=np.int32), np.zeros(rows.size, dtype=np.bool_)
        for row, col in sorted(set(zip(unit_rows.tolist(), unit_cols.tolist(), strict=True))):
            key = Block(level - 1, row, col)
            spec, unit = unit_spec(self._grid, self._parameters, key), self._decoder.unit(key)
            here = (unit_rows == row) & (unit_cols == col)
            at = rows[here] - spec.region.row, cols[here] - spec.region.col
            quanta[here], valid[here] = unit.heights[at], unit.mask[at]
        heights = self._quantizer.dequantize(quanta[None, :])[0]
        return heights.astype(np.float64), valid

    def _run(self, work: Callable[[Block], None], keys: list[Block]) -> None:
        """Call `work` for every unit, those above it first, in the terrain's threads."""
        from terrainwave.decoder import unit_key

        with self._lock:
            # A fork takes no threads along: its first read starts some.
            if self._executor is None or self._executor_pid != os.getpid():
                self._executor = ThreadPoolExecutor(
                    self._n_threads, thread_name_prefix="terrainwave"
                )
                self._executor_pid = os.getpid()
            executor = self._executor

        def submit(function: Callable[[Block], None], key: Block) -> Future[None]:
            try:
                return executor.submit(function, key)
            except RuntimeError as error:  # its threads have been stopped
                raise StorageError(f"{self.name} is closed") from error

        run_after_parents(
            submit, self._n_threads + 1, keys,
            lambda key: None if key.is_root_key else unit_key(key), work,
        )  # fmt: skip


def _fill_or_decode(
    decoder: "TreeDecoder", keys: set[Block], fill: Callable[[Block], None]
) -> Callable[[Block], None]:
    """Return a function that fills `keys` and decodes what is above them."""

    def work(key: Block) -> None:
        if key in keys:
            fill(key)
        else:
            # What is damaged above a key is reported with it.
            with contextlib.suppress(CorruptStreamError):
                decoder.unit(key)

    return work


def _reopen(source: Any, cache_bytes: int, threads: int | None) -> Terrain:
    return Terrain(source, cache_bytes=cache_bytes, threads=threads)


def round_half_up(value: float) -> int:
    """Return the nearest integer, the upper of two."""
    return int(np.floor(value + 0.5))


def _region_of_window(window: Any) -> Region:
    try:
        if hasattr(window, "row_off"):  # rasterio.windows.Window
            window = (window.row_off, window.col_off, window.height, window.width)
        row, col, n_rows, n_cols = (int(number) for number in window)
        is_whole = (row, col, n_rows, n_cols) == tuple(window)
    except (TypeError, ValueError, OverflowError):  # no numbers, not four, NaN, infinite
        is_whole = False
    if not is_whole:
        raise InvalidHeightsError(
            f"found window {window!r}, expected (row, col, n_rows, n_cols) in whole samples"
        )
    return Region(row, col, n_rows, n_cols)
