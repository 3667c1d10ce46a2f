"""An orthophoto, warped to the grid of a terrain, as one picture for a texture."""

import math
from typing import Any, NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import CRSError
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform, transform_bounds

from terrainwave.errors import InvalidHeightsError, StorageError
from terrainwave.grid.affine import Transform, determinant, pixels_to_places, places_to_pixels
from terrainwave.raster_io.crs import parse_crs
from terrainwave.raster_io.dataset import open_dataset
from terrainwave.raster_io.gdal import GDAL_ERRORS, bounded_env, one_line

_TEXEL_BYTES = 4
# Points per side along which bounds are projected: sides become curves.
_DENSITY = 21
_ANY_CRS = CRS.from_epsg(3857)


class Drape(NamedTuple):
    """A picture over a part of a grid.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (height, width, 4)
        Red, green, blue, alpha; the first row lies along the grid's first row.
    col, row, n_cols, n_rows : float
        What it covers, in pixels of the full grid, corners counted from 0.
    """

    pixels: NDArray[np.uint8]
    col: float
    row: float
    n_cols: float
    n_rows: float


def read_drape(
    path: str,
    *,
    crs: str | None,
    affine: Transform,
    shape: tuple[int, int],
    max_side: int,
    max_bytes: int,
) -> Drape:
    """Return an image file warped to a grid, at its own resolution as far as limits allow.

    Parameters
    ----------
    path : str
        Bands grey or red, green, blue, each with an alpha band or not, or a palette; 8 bits.
    crs : str, optional
        Of the grid, as `parse_crs` reads it.
    affine : tuple of float
        a, b, c, d, e, f of the grid: x = a col + b row + c.
    shape : tuple of int
        Rows and columns of the grid.
    max_side, max_bytes : int
        Of the picture, whose texels take four bytes.

    Raises
    ------
    InvalidHeightsError
        If it is no such image, has no place on the ground, or does not overlap the grid.
    StorageError
        If it cannot be read.
    """
    grid_crs = parse_crs(crs)
    if determinant(affine) == 0:
        raise InvalidHeightsError("the terrain's affine transform cannot be inverted")
    with bounded_env(), open_dataset(path) as photo:
        _check(path, photo, grid_crs)
        # Where neither says what its coordinates are, any projected system does for both.
        photo_crs, grid_crs = photo.crs or _ANY_CRS, grid_crs or _ANY_CRS
        try:
            col, row, n_cols, n_rows = _overlap(path, photo, photo_crs, grid_crs, affine, shape)
            middle = col + n_cols / 2, row + n_rows / 2
            finer = _texels_per_pixel(photo, photo_crs, grid_crs, affine, *middle)
            width, height = _size(n_cols * finer, n_rows * finer, max_side, max_bytes)
            a, b, _, d, e, _ = affine
            along, down = n_cols / width, n_rows / height  # pixels of the grid per texel
            x, y = pixels_to_places(affine, row, col)
            placed = rasterio.Affine(a * along, b * down, x, d * along, e * down, y)
            pixels = _warped(photo, photo_crs, grid_crs, placed, width, height)
        except (*GDAL_ERRORS, CRSError) as error:
            raise StorageError(f"cannot warp {path} to the terrain: {one_line(error)}") from error
    return Drape(pixels, col, row, n_cols, n_rows)


def _check(path: str, photo: Any, grid_crs: Any) -> None:
    """Refuse what cannot be draped."""
    n_colors = photo.count - (ColorInterp.alpha in photo.colorinterp)
    if n_colors not in (1, 3, 4) or photo.dtypes[0] != "uint8":
        raise InvalidHeightsError(
            f"{path} has {photo.count} bands of {photo.dtypes[0]}; expected a picture of 1 or 3"
            " bands of 8 bits: gdal_translate -ot Byte -scale -b 1 -b 2 -b 3"
        )
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
    path: str, photo: Any, photo_crs: Any, grid_crs: Any, grid: Transform, shape: tuple[int, int]
) -> tuple[float, float, float, float]:
    """Return column, row, columns and rows of the grid that the photo covers."""
    left, bottom, right, top = transform_bounds(
        photo_crs, grid_crs, *photo.bounds, densify_pts=_DENSITY
    )
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
    photo: Any, photo_crs: Any, grid_crs: Any, grid: Transform, col: float, row: float
) -> float:
    """Return how many pixels of the photo lie along one of the grid, near a place of it."""
    near = ((row, col), (row, col + 1), (row + 1, col))
    places = [pixels_to_places(grid, *pixel) for pixel in near]
    xs, ys = transform(grid_crs, photo_crs, *zip(*places, strict=True))
    placed = tuple(photo.transform)[:6]
    (row_0, col_0), (row_1, col_1), (row_2, col_2) = (
        places_to_pixels(placed, x, y) for x, y in zip(xs, ys, strict=True)
    )
    area = abs((col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0))
    return math.sqrt(area) if math.isfinite(area) and area > 0 else 1.0


def _size(width: float, height: float, max_side: int, max_bytes: int) -> tuple[int, int]:
    """Return whole numbers of texels within the limits, in the same proportion."""
    shrink = min(
        1.0,
        max_side / max(width, height),
        math.sqrt(max_bytes / (width * height * _TEXEL_BYTES)),
    )
    return max(int(width * shrink), 1), max(int(height * shrink), 1)


def _warped(
    photo: Any, photo_crs: Any, grid_crs: Any, affine: Any, width: int, height: int
) -> NDArray[np.uint8]:
    """Return the photo on a grid, (height, width, 4); its overviews are used."""
    has_palette = photo.colorinterp[0] == ColorInterp.palette
    has_alpha = ColorInterp.alpha in photo.colorinterp
    options = {
        "src_crs": photo_crs, "crs": grid_crs, "transform": affine, "width": width,
        "height": height, "add_alpha": not has_alpha,
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
