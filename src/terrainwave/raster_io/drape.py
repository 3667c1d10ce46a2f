"""An orthophoto, warped to the grid of a terrain: a picture for a texture or for a mesh file."""

import math
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from typing import Any, NamedTuple, Self
from urllib.parse import urlsplit
from xml.sax.saxutils import escape

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import CRSError, NotGeoreferencedWarning
from rasterio.io import MemoryFile
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform, transform_bounds

from terrainwave.errors import (
    InvalidHeightsError,
    StorageError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.grid.affine import (
    Footprint,
    Transform,
    determinant,
    pixels_to_places,
    places_to_pixels,
)
from terrainwave.place.crs import parse_crs
from terrainwave.raster_io.dataset import open_dataset
from terrainwave.raster_io.gdal import GDAL_ERRORS, bounded_env, one_line

_TEXEL_BYTES = 4
# Points per side used to project bounds: straight sides become curves.
_DENSITY = 21
# Largest side, in texels, of pictures from tiles: some hundred tiles of 256 pixels.
_MOST_TILED = 2048
_PATIENCE = 2.0  # seconds
# Overviews whose factor exceeds the wanted one by this ratio are used, too.
_ROUNDED = 1.01
# GDAL's HTTP options: a user agent, short timeouts, and no other files.
_WEB = {
    "GDAL_HTTP_USERAGENT": "terrainwave", "GDAL_HTTP_TIMEOUT": 30, "GDAL_HTTP_CONNECTTIMEOUT": 10,
    "GDAL_HTTP_MAX_RETRY": 2, "GDAL_HTTP_RETRY_DELAY": 1,
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
}  # fmt: skip
# Zooms 0 to 19 as one image with overviews; missing tiles are transparent.
_TILES = (
    '<GDAL_WMS><Service name="TMS"><ServerUrl>{url}</ServerUrl></Service><DataWindow>'
    "<UpperLeftX>-{edge}</UpperLeftX><UpperLeftY>{edge}</UpperLeftY>"
    "<LowerRightX>{edge}</LowerRightX><LowerRightY>-{edge}</LowerRightY>"
    "<TileLevel>19</TileLevel><TileCountX>1</TileCountX><TileCountY>1</TileCountY>"
    "<YOrigin>top</YOrigin></DataWindow><Projection>EPSG:3857</Projection>"
    "<BlockSizeX>256</BlockSizeX><BlockSizeY>256</BlockSizeY><BandsCount>4</BandsCount>"
    "<MaxConnections>4</MaxConnections><Timeout>30</Timeout><UserAgent>terrainwave</UserAgent>"
    "<ZeroBlockHttpCodes>204,404</ZeroBlockHttpCodes></GDAL_WMS>"
)
_ANY_CRS = CRS.from_epsg(3857)
# Largest side, in pixels, of a picture in a mesh's file: the limit of WebGL, phones and game
# engines. A power of two, like all sides.
_MOST_IN_FILE = 8192
# Cells per side of the grid used to compare a photo with a mesh's area.
_CELLS = 4096
# Most colours of a map, as opposed to a photo: a palette, and the background.
_FEW_COLORS = 257
_JPEG_QUALITY = 90
_ROWS_AT_ONCE = 256


class Drape(NamedTuple):
    """Picture over a part of a grid.

    `pixels` (uint8, shape (height, width, 4)): red, green, blue, alpha; the first row lies along
    the grid's. The area is in pixels of the full grid, corners counted from 0.
    """

    pixels: NDArray[np.uint8]
    col: float
    row: float
    n_cols: float
    n_rows: float


class Photo:
    """An open image, read in windows warped to a grid. Thread-safe; a context manager.

    A window reads only what it needs: parts of the file or of a sufficiently fine overview; tiles
    of the matching zoom. `path` is a file, or a URL: of a file that is read by ranges, such as a
    COG, or of tiles of 256 x 256 pixels in Web Mercator, with ``{z}``, ``{x}`` and ``{y}``. Bands
    are grey or red, green, blue, with or without alpha, or a palette; 8 bits. `plain_on` is the
    area, in the grid's CRS, that a picture without georeference covers. Without it such a picture
    is refused.

    Raises `InvalidHeightsError` if it is not such an image, has no georeference, or does not
    overlap the grid. Raises `StorageError` if it cannot be read.
    """

    def __init__(
        self,
        path: str,
        *,
        crs: str | None,
        affine: Transform,
        shape: tuple[int, int],
        plain_on: Footprint | None = None,
    ) -> None:
        self.has_tiles = is_tile_url(path)
        self._path, self._affine, self._shape = path, affine, shape
        self._lock = threading.Lock()
        self._file: Any = None
        self._levels: dict[int, Any] = {}
        grid_crs = parse_crs(crs)
        if determinant(affine) == 0:
            raise InvalidHeightsError("the terrain's affine transform cannot be inverted")
        with self._reading():
            self._file = _open(path)
            is_placed = not self._file.transform.is_identity or self._file.crs is not None
            is_placed |= bool(self._file.gcps[0]) or self._file.rpcs is not None
            self._plain_on = None if is_placed else plain_on
            _check(path, self._file, grid_crs, is_plain=self._plain_on is not None)
            # If neither states its CRS, any projected system works for both.
            self._grid_crs = grid_crs or _ANY_CRS
            self._crs = self._grid_crs if self._plain_on else self._file.crs or _ANY_CRS
            placed = self._placed(self._file)
            ends = product((0.0, self._file.height), (0.0, self._file.width))
            xs, ys = zip(*(pixels_to_places(tuple(placed)[:6], *end) for end in ends), strict=True)
            bounds = min(xs), min(ys), max(xs), max(ys)
            self.place = _overlap(path, bounds, self._crs, self._grid_crs, affine, shape)
            col, row, n_cols, n_rows = self.place
            middle = col + n_cols / 2, row + n_rows / 2
            self._finer = _texels_per_pixel(placed, self._crs, self._grid_crs, affine, *middle)
            self.finer = math.sqrt(math.prod(self._finer))

    def _placed(self, file: Any) -> Any:
        if self._plain_on is None:
            return file.transform
        (a, b, c, d, e, f), (n_rows, n_cols) = self._plain_on
        along, down = n_cols / file.width, n_rows / file.height
        return rasterio.Affine(a * along, b * down, c, d * along, e * down, f)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            with self._lock, bounded_env(**_WEB):
                yield
        except TerrainwaveError:
            self.close()
            raise
        except (*GDAL_ERRORS, CRSError) as error:
            raise StorageError(
                f"cannot warp {self._path} to the terrain: {one_line(error)}"
            ) from error

    @property
    def credit(self) -> str | None:
        return urlsplit(self._path).hostname if self.has_tiles else None

    def size(self, max_side: int, max_bytes: int) -> tuple[int, int]:
        _, _, n_cols, n_rows = self.place
        max_side = min(max_side, _MOST_TILED) if self.has_tiles else max_side
        return _size(n_cols * self.finer, n_rows * self.finer, max_side, max_bytes)

    def whole(self, max_side: int, max_bytes: int) -> Drape:
        """Return all of the photo that lies on the grid, at its own resolution if limits allow."""
        return self.part(self.place, self.size(max_side, max_bytes))

    def over_grid(self, max_side: int) -> tuple[Drape, tuple[int, int]]:
        """Return a picture of the whole grid, transparent beyond the photo, and its own size.

        Its sides are powers of two, as engines need for mipmaps: the next ones above the photo's
        own resolution, up to `max_side`, itself a power of two.
        """
        n_rows, n_cols = self._shape
        along, down = self._finer
        # Rounding must not add a texel.
        own = max(math.ceil(n_cols * along - 1e-6), 1), max(math.ceil(n_rows * down - 1e-6), 1)
        if self.has_tiles:
            own = _size(*own, _MOST_TILED, _MOST_TILED**2 * _TEXEL_BYTES)
        width, height = (min(1 << (side - 1).bit_length(), max_side) for side in own)
        return self.part((0.0, 0.0, n_cols, n_rows), (width, height)), own

    def part(self, place: tuple[float, float, float, float], size: tuple[int, int]) -> Drape:
        """Return a part of the grid: column, row, columns and rows, in `size` texels."""
        col, row, n_cols, n_rows = place
        width, height = size
        a, b, _, d, e, _ = self._affine
        along, down = n_cols / width, n_rows / height  # pixels of the grid per texel
        x, y = pixels_to_places(self._affine, row, col)
        placed = rasterio.Affine(a * along, b * down, x, d * along, e * down, y)
        with self._reading():
            # GDAL warps from the full resolution, however coarse the result.
            file = self._level(min(self._finer[0] * along, self._finer[1] * down))
            own = self._crs, self._placed(file)
            pixels = _warped(file, own, self._grid_crs, placed, width, height)
        return Drape(pixels, col, row, n_cols, n_rows)

    def _level(self, coarser: float) -> Any:
        """Return the coarsest overview with at least one pixel per texel, or the file itself."""
        factors = self._file.overviews(1)
        fit = [number for number, factor in enumerate(factors) if factor <= coarser * _ROUNDED]
        if not fit:
            return self._file
        if fit[-1] not in self._levels:
            self._levels[fit[-1]] = _open(self._path, overview_level=fit[-1])
        return self._levels[fit[-1]]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, unless another thread is still reading it."""
        if not self._lock.acquire(timeout=_PATIENCE):
            return
        try:
            for file in (self._file, *self._levels.values()):
                if file is not None:
                    file.close()
        finally:
            self._lock.release()


def is_tile_url(path: str) -> bool:
    return path.startswith(("http://", "https://")) and all(
        part in path for part in ("{z}", "{x}", "{y}")
    )


def check_photo(path: str, *, crs: str | None, footprint: Footprint) -> None:
    """Raise the errors of `texture_of` for this photo of a terrain now, without warping it."""
    Photo(path, crs=crs, affine=footprint.affine, shape=footprint.shape, plain_on=footprint).close()


def texture_of(
    path: str,
    *,
    crs: str | None,
    area: tuple[float, float, float, float],
    plain_on: Footprint | None,
    color: tuple[int, int, int],
) -> tuple[bytes, str]:
    """Return a picture of an area for a mesh's file, upper left corner first, and its media type.

    A PNG if it has at most 257 colours and is not larger than a JPEG, else a JPEG. `color` is where
    the photo is transparent, void or missing. A warning names a photo with more than 8192 pixels
    per side over the area: left, bottom, right, top. A picture without georeference covers
    `plain_on`.
    """
    left, bottom, right, top = area
    affine = ((right - left) / _CELLS, 0.0, left, 0.0, (bottom - top) / _CELLS, top)
    grid = Footprint(affine, (_CELLS, _CELLS))
    with Photo(path, crs=crs, affine=affine, shape=grid.shape, plain_on=plain_on or grid) as photo:
        (pixels, *_), own = photo.over_grid(_MOST_IN_FILE)
    if not pixels[..., 3].any():
        raise InvalidHeightsError(
            f"{path} is void or clear all over the mesh; expected a picture that shows some of it"
        )
    height, width = pixels.shape[:2]
    if max(own) > _MOST_IN_FILE:
        warnings.warn(
            f"{path} has {own[0]} x {own[1]} pixels over the mesh, more than many programs can"
            f" show; the file has {width} x {height}",
            TerrainwaveWarning,
            stacklevel=2,
        )
    pixels = _opaque(pixels, color)
    try:
        lossy = _as_file(pixels, driver="JPEG", quality=_JPEG_QUALITY), "image/jpeg"
        if not _has_few_colors(pixels):
            return lossy
        exact = _as_file(pixels, driver="PNG"), "image/png"
        return min(exact, lossy, key=lambda one: len(one[0]))
    except GDAL_ERRORS as error:
        raise StorageError(f"cannot write {path} as a texture: {one_line(error)}") from error


def _opaque(pixels: NDArray[np.uint8], color: tuple[int, int, int]) -> NDArray[np.uint8]:
    ground = np.array(color, dtype=np.uint16)
    made = np.empty((*pixels.shape[:2], 3), dtype=np.uint8)
    for row in range(0, len(pixels), _ROWS_AT_ONCE):
        part = pixels[row : row + _ROWS_AT_ONCE].astype(np.uint16)
        alpha = part[..., 3:]
        made[row : row + _ROWS_AT_ONCE] = (
            part[..., :3] * alpha + ground * (255 - alpha) + 127
        ) // 255
    return made


def _has_few_colors(pixels: NDArray[np.uint8]) -> bool:
    found = np.empty(0, dtype=np.uint32)
    for row in range(0, len(pixels), _ROWS_AT_ONCE):
        red, green, blue = np.moveaxis(pixels[row : row + _ROWS_AT_ONCE].astype(np.uint32), -1, 0)
        found = np.union1d(found, red << 16 | green << 8 | blue)
        if len(found) > _FEW_COLORS:
            return False
    return True


def _as_file(pixels: NDArray[np.uint8], **profile: Any) -> bytes:
    height, width = pixels.shape[:2]
    with bounded_env(), warnings.catch_warnings(), MemoryFile() as memory:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with memory.open(width=width, height=height, count=3, dtype="uint8", **profile) as file:
            for band in range(3):
                file.write(pixels[..., band], band + 1)
        return bytes(memory.read())


def _open(path: str, **options: Any) -> Any:
    if not is_tile_url(path):
        return rasterio.open(path, **options) if options else open_dataset(path)
    url = escape(path.replace("{z}", "${z}").replace("{x}", "${x}").replace("{y}", "${y}"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return rasterio.open(_TILES.format(url=url, edge=math.pi * 6378137.0), **options)


def _check(path: str, photo: Any, grid_crs: Any, *, is_plain: bool) -> None:
    n_colors = photo.count - (ColorInterp.alpha in photo.colorinterp)
    if n_colors not in (1, 3, 4) or photo.dtypes[0] != "uint8":
        raise InvalidHeightsError(
            f"{path} has {photo.count} bands of {photo.dtypes[0]}; expected a picture of 1 or 3"
            " bands of 8 bits: gdal_translate -ot Byte -scale -b 1 -b 2 -b 3"
        )
    if is_plain:
        return
    if photo.transform.is_identity or photo.transform.determinant == 0:
        raise InvalidHeightsError(
            f"{path} does not say where it lies; expected a georeferenced picture:"
            " gdal_translate -a_srs EPSG:… -a_ullr left top right bottom"
        )
    if (photo.crs is None) != (grid_crs is None):
        without, other = (path, "the terrain") if photo.crs is None else ("the terrain", path)
        raise InvalidHeightsError(
            f"{without} has no coordinate reference system and {other} has one; expected both or"
            " neither: gdal_edit.py -a_srs gives a raster one"
        )


def _overlap(
    path: str,
    bounds: tuple[float, ...],
    photo_crs: Any,
    grid_crs: Any,
    grid: Transform,
    shape: tuple[int, int],
) -> tuple[float, float, float, float]:
    left, bottom, right, top = transform_bounds(photo_crs, grid_crs, *bounds, densify_pts=_DENSITY)
    corners = [places_to_pixels(grid, x, y) for x in (left, right) for y in (bottom, top)]
    rows, cols = zip(*corners, strict=True)
    col, row = max(math.floor(min(cols)), 0), max(math.floor(min(rows)), 0)
    n_cols = min(math.ceil(max(cols)), shape[1]) - col
    n_rows = min(math.ceil(max(rows)), shape[0]) - row
    if n_cols <= 0 or n_rows <= 0:
        raise InvalidHeightsError(
            f"{path} lies beside the terrain: it covers {left:.10g}, {bottom:.10g} …"
            f" {right:.10g}, {top:.10g} in the terrain's coordinates"
        )
    return col, row, n_cols, n_rows


def _texels_per_pixel(
    placed: Any, photo_crs: Any, grid_crs: Any, grid: Transform, col: float, row: float
) -> tuple[float, float]:
    near = ((row, col), (row, col + 1), (row + 1, col))
    places = [pixels_to_places(grid, *pixel) for pixel in near]
    xs, ys = transform(grid_crs, photo_crs, *zip(*places, strict=True))
    first, along, down = (
        places_to_pixels(tuple(placed)[:6], x, y) for x, y in zip(xs, ys, strict=True)
    )
    finer = math.dist(first, along), math.dist(first, down)
    return finer if all(math.isfinite(one) and one > 0 for one in finer) else (1.0, 1.0)


def _size(width: float, height: float, max_side: int, max_bytes: int) -> tuple[int, int]:
    shrink = min(
        1.0,
        max_side / max(width, height),
        math.sqrt(max_bytes / (width * height * _TEXEL_BYTES)),
    )
    return max(int(width * shrink), 1), max(int(height * shrink), 1)


def _warped(
    photo: Any, placed: tuple[Any, Any], grid_crs: Any, affine: Any, width: int, height: int
) -> NDArray[np.uint8]:
    """Return the photo on a grid, (height, width, 4); `placed` is its CRS and transform."""
    has_palette = photo.colorinterp[0] == ColorInterp.palette
    has_alpha = ColorInterp.alpha in photo.colorinterp
    options = {
        "src_crs": placed[0], "src_transform": placed[1], "crs": grid_crs, "transform": affine,
        "width": width, "height": height, "add_alpha": not has_alpha,
        "resampling": Resampling.nearest if has_palette else Resampling.bilinear,
    }  # fmt: skip
    with WarpedVRT(photo, **options) as warped:
        bands = warped.read()
    alpha = bands[photo.colorinterp.index(ColorInterp.alpha) if has_alpha else -1]
    if has_palette:
        table = np.zeros((256, 4), dtype=np.uint8)
        for value, color in photo.colormap(1).items():
            table[value] = color
        pixels = table[bands[0]]
        pixels[..., 3] = np.minimum(pixels[..., 3], alpha)
        return pixels
    is_grey = photo.count - has_alpha == 1
    red, green, blue = (bands[0],) * 3 if is_grey else bands[:3]
    return np.ascontiguousarray(np.stack([red, green, blue, alpha], axis=-1))
