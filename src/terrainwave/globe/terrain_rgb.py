"""Terrain-RGB tiles in Web Mercator, their errors, and the TileJSON that describes them.

A pixel of a terrain-RGB tile holds a height in whole steps above the lowest one (`ENCODINGS`):

mapbox: height = -10000 + (R * 65536 + G * 256 + B) * 0.1 (Mapbox Terrain-RGB v1)
terrarium: height = -32768 + R * 256 + G + B / 256 (Mapzen Terrarium)
"""

import io
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import check_choice, check_flags, checked_whole
from terrainwave.errors import InvalidArgumentError, TerrainwaveError
from terrainwave.extras import need
from terrainwave.globe.lonlat import Globe

TILE_SIZE = 256
TILE_SIZES = (TILE_SIZE, 2 * TILE_SIZE)
PNG, WEBP = "png", "webp"
# Options of pillow by image format. `exact` keeps the colours of transparent pixels. Slower methods
# of WebP gain 1 % on most rasters.
TILE_IMAGES: dict[str, dict[str, Any]] = {
    WEBP: {"lossless": True, "exact": True, "method": 1, "quality": 50},
    PNG: {"compress_level": 4},
}
_PURPOSE = "a terrain-RGB tile"
MAX_ZOOM = 22
# The largest latitude of the square Web Mercator world.
MAX_LATITUDE = math.degrees(math.atan(math.sinh(math.pi)))

VOID_DEPTH = 1.0
MAX_RIM = 8
# `RgbTile.voids` where there is no terrain.
ALL_VOID = np.full((TILE_SIZE, TILE_SIZE), 255, dtype=np.uint8)

_HIGHEST_CODE = (1 << 24) - 1
# A step of `Look.round_by_zoom` is at most this share of a pixel's size on the ground: it tilts a
# slope between neighbours by 0.9 degrees at most.
_STEP_SHARE = 1 / 64


class Encoding(NamedTuple):
    """Encoding of heights as pixels; metres."""

    name: str  # as in TileJSON and MapLibre's sources
    lowest: float  # the height of code 0
    unit: float  # from one code to the next; R is a code's highest byte, B its lowest
    # codes from one height to the next, a power of two: heights are multiples of `step`, 0 too
    multiple: int = 1

    @property
    def step(self) -> float:
        return self.unit * self.multiple

    @property
    def highest(self) -> float:
        """The height of the last code."""
        return self.lowest + _HIGHEST_CODE * self.unit

    def beyond(self, low: float, high: float) -> float:
        """Return how far heights from `low` to `high` lie outside the range, 0 at least."""
        return max(self.lowest - low, high - self.highest, 0.0)

    def codes(self, heights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the codes of the nearest heights; NaN stays."""
        of_zero = round(-self.lowest / self.unit) % self.multiple
        codes = ((heights - self.lowest) / self.unit - of_zero) / self.multiple
        return np.clip(np.rint(codes) * self.multiple + of_zero, 0, _HIGHEST_CODE)

    def heights(self, codes: NDArray[np.float64]) -> NDArray[np.float64]:
        return codes * self.unit + self.lowest

    def rounded(self, most: float) -> "Encoding":
        """Return the encoding with the largest step that is at most `most` metres."""
        return self._replace(multiple=1 << max(math.floor(math.log2(most / self.unit)), 0))


ENCODINGS = {
    one.name: one
    for one in (Encoding("mapbox", -10000.0, 0.1), Encoding("terrarium", -32768.0, 1 / 256))
}
MAPBOX = "mapbox"


class Look(NamedTuple):
    """Appearance of heights and voids in tiles."""

    encoding: str = MAPBOX  # one of `ENCODINGS`
    # pixels without heights have alpha 0, all others 255. Colours are not affected.
    transparent_voids: bool = False
    tile_size: int = TILE_SIZE  # pixels along a side
    image: str = PNG  # one of `TILE_IMAGES`
    round_by_zoom: bool = False  # larger steps of heights on coarser zooms

    @property
    def voids(self) -> str:
        return "transparent" if self.transparent_voids else "height"

    def pixels(self, globe: Globe, z: int) -> Encoding:
        """Return the encoding of a zoom's heights, with its step."""
        pixels = encoding_of(self.encoding)
        if not self.round_by_zoom:
            return pixels
        most = max(globe.effective_error, pixels.unit)
        most *= 2.0 ** (max_zoom(globe, self.tile_size) - z)
        size = pixel_size(globe, z, _middle(globe), self.tile_size)
        return pixels.rounded(min(most, size * _STEP_SHARE))


PLAIN = Look()


def encoding_of(name: str) -> Encoding:
    check_choice("encoding", name, ENCODINGS)
    return ENCODINGS[name]


def look_of(
    *,
    encoding: str = MAPBOX,
    transparent_voids: bool = False,
    tile_size: int = TILE_SIZE,
    image: str = PNG,
    round_by_zoom: bool = False,
) -> Look:
    """Return a look of tiles.

    `round_by_zoom` rounds heights to larger steps on coarser zooms: the encoding's step times the
    largest power of two that is at most the file's bound on the finest zoom, twice as much on each
    coarser one, and at most 1/64 of a pixel's size on the ground in the terrain's middle; at least
    the encoding's own step, whatever the bound and the pixels.
    """
    check_flags(transparent_voids=transparent_voids, round_by_zoom=round_by_zoom)
    tile_size = checked_whole("tile_size", tile_size, least=1)
    if tile_size not in TILE_SIZES:
        raise InvalidArgumentError(f"found `tile_size` {tile_size}, expected 256 or 512")
    check_choice("image", image, TILE_IMAGES)
    if image == WEBP and not need("PIL.features", extra="serve", purpose=_PURPOSE).check(WEBP):
        raise TerrainwaveError(
            "this pillow was built without WebP: install one with it, or take `image` png"
        )
    return Look(encoding_of(encoding).name, transparent_voids, tile_size, image, round_by_zoom)


@dataclass(frozen=True)
class RgbTile:
    """A terrain-RGB tile."""

    image: bytes  # `Look.tile_size` pixels square, RGB; RGBA if voids are transparent
    # metres. Largest distance found between the tile's bilinear surface, in the steps of its
    # encoding, and the bilinear surface of the decoded samples it was made from, at the tile's
    # pixels and halfway between them: resampling to Web Mercator and rounding.
    error: float
    # metres. No original under the tile is further from the bilinear surface of those decoded
    # samples (measured when the file was written, `Terrain.block_error`).
    terrain_error: float
    level: int  # the resolution level of the samples, counted from 0
    # shape (tile_size, tile_size); void share of each pixel: 0 nothing, 255 all
    voids: NDArray[np.uint8]


def longitudes_of(z: int, x: NDArray[np.float64]) -> NDArray[np.float64]:
    return x / (1 << z) * 360.0 - 180.0


def latitudes_of(z: int, y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.degrees(np.arctan(np.sinh(math.pi * (1 - 2 * y / (1 << z)))))


def column_of(z: int, longitude: float) -> float:
    return (longitude + 180.0) / 360.0 * (1 << z)


def row_of(z: int, latitude: float) -> float:
    """Return the fractional tile row of a latitude, clipped to the square world."""
    latitude = min(max(latitude, -MAX_LATITUDE), MAX_LATITUDE)
    return (1 - math.asinh(math.tan(math.radians(latitude))) / math.pi) / 2 * (1 << z)


def pixel_size(globe: Globe, z: int, latitude: float, tile_size: int = TILE_SIZE) -> float:
    around = 2 * math.pi * globe.ellipsoid.axis
    return around * math.cos(math.radians(latitude)) / (tile_size << z)


def _middle(globe: Globe) -> float:
    return (globe.extent.south + globe.extent.north) / 2


def max_zoom(globe: Globe, tile_size: int = TILE_SIZE) -> int:
    """Return the first zoom whose pixels are not larger than the terrain's, in its middle."""
    sizes = (pixel_size(globe, z, _middle(globe), tile_size) for z in range(MAX_ZOOM))
    return next((z for z, size in enumerate(sizes) if size <= globe.pixel), MAX_ZOOM)


def meets(globe: Globe, z: int, x: int, y: int, far: float = 0) -> bool:
    """Return whether a tile is at most `far` tiles away from the terrain's bounds."""
    west, south, east, north = globe.extent
    if not row_of(z, north) - far < y + 1 or not row_of(z, south) + far > y:
        return False
    first, last = column_of(z, west) - far, column_of(z, east) + far
    turn = 1 << z
    return any(first < x + 1 + k * turn and last > x + k * turn for k in (-1, 0, 1))


def level_for(globe: Globe, z: int, y: int, tile_size: int = TILE_SIZE) -> int:
    """Return the coarsest level that is not coarser than the tile's pixels, counted from 0."""
    _, south, _, north = globe.extent
    latitude = min(max(float(latitudes_of(z, np.array(y + 0.5))), south), north)
    latitude = min(max(latitude, -MAX_LATITUDE), MAX_LATITUDE)
    return globe.level_for(pixel_size(globe, z, latitude, tile_size))


def rgb_tile(
    globe: Globe,
    z: int,
    x: int,
    y: int,
    rim: int = 0,
    look: Look = PLAIN,
    *,
    void_height: float | None = None,
) -> RgbTile | None:
    """Return the terrain-RGB tile z/x/y (XYZ, Web Mercator), or None if it has no terrain.

    Heights are continued by `rim` pixels, 0 … `MAX_RIM`, beyond the terrain's edges and into voids,
    so that surfaces through the pixels don't fall off within the terrain; `error` does not include
    it. Heights outside the encoding's range become its nearest height. Voids, which the format
    lacks, get `void_height` metres, by default `VOID_DEPTH` below the terrain's lowest. A height
    depends only on its position and z, so that neighbouring tiles match.
    """
    size = look.tile_size
    if not meets(globe, z, x, y, rim / size):
        return None
    level = level_for(globe, z, y, size)
    # Pixel centres are the odd positions of a grid twice as fine, on which errors are measured.
    fine = np.arange(2 * (size + 2 * rim) - 1) / (2 * size) + (0.5 - rim) / size
    longitudes, latitudes = np.meshgrid(longitudes_of(z, x + fine), latitudes_of(z, y + fine))
    rows, cols = globe.to_samples(longitudes.ravel(), latitudes.ravel())
    samples, window = globe.heights_at(rows, cols, level)
    around = samples.reshape(longitudes.shape)
    surface = _without(around, 2 * rim)
    pixels = look.pixels(globe, z)
    drawn = pixels.codes(_without(_grown(around[::2, ::2], rim), rim))
    if window is None or np.isnan(drawn).all():
        return None
    shown = pixels.heights(pixels.codes(surface[::2, ::2]))
    return RgbTile(
        image=_image(drawn, _void_code(globe, pixels, void_height), look),
        error=_largest_distance(shown, surface),
        terrain_error=globe.heights_error(window),
        level=level,
        voids=_void_shares(np.isnan(around), rim),
    )


def void_tile(globe: Globe, look: Look = PLAIN) -> bytes:
    """Return the image of a terrain-RGB tile without terrain."""
    codes = np.full((look.tile_size, look.tile_size), np.nan)
    return _image(codes, _void_code(globe, encoding_of(look.encoding), None), look)


def _void_code(globe: Globe, pixels: Encoding, void_height: float | None) -> float:
    """Return the code of voids: exact, below all heights of the tile unless told otherwise."""
    exact = pixels._replace(multiple=1)
    if void_height is None:
        void_height = height_of_voids(globe) - (pixels.step - exact.step) / 2
    return float(exact.codes(np.array(void_height)))


def check_void_height(height: float, encoding: str) -> None:
    """Raise `InvalidArgumentError` for a height of voids outside an encoding's range."""
    pixels = encoding_of(encoding)
    if not pixels.lowest <= height <= pixels.highest:
        raise InvalidArgumentError(
            f"found `void_height` {height:g}, expected {pixels.lowest:g} to {pixels.highest:g} m,"
            f" which tiles of `encoding` {encoding} can hold"
        )


def note_on_range(globe: Globe, encoding: str) -> str | None:
    """Return a note on heights of a terrain outside an encoding's range, or None."""
    low, high = globe.height_range
    pixels = encoding_of(encoding)
    if pixels.beyond(low, high) <= pixels.step / 2:
        return None
    is_low = low < pixels.lowest
    end, side = (pixels.lowest, "below") if is_low else (pixels.highest, "above")
    others = [one.name for one in ENCODINGS.values() if one.beyond(low, high) <= one.step / 2]
    advice = f"; `encoding` {others[0]} holds them" if others else ""
    return (
        f"heights reach from {low:.10g} to {high:.10g} m, and tiles of `encoding` {encoding} hold"
        f" none {side} {end:.10g} m, which is shown instead{advice}"
    )


def cover_tile(voids: NDArray[np.uint8], color: tuple[int, int, int]) -> bytes:
    """Return a PNG that paints a tile's voids (`RgbTile.voids`) and leaves the terrain clear."""
    image = need("PIL.Image", extra="serve", purpose="a tile of voids")
    painted = np.empty((*voids.shape, 4), dtype=np.uint8)
    painted[..., :3], painted[..., 3] = color, voids
    out = io.BytesIO()
    image.fromarray(painted, "RGBA").save(out, "PNG", compress_level=4)
    return out.getvalue()


def _without(values: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Return a square without the `n` outermost rows and columns of each side."""
    return values[n : len(values) - n, n : len(values) - n]


def _grown(heights: NDArray[np.float64], n_times: int) -> NDArray[np.float64]:
    """Return heights continued `n_times` pixels into NaN, by the mean of known neighbours."""
    for _ in range(n_times):
        is_known = np.isfinite(heights)
        total, count = _sum_of_nine(np.where(is_known, heights, 0.0)), _sum_of_nine(is_known * 1.0)
        means = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
        heights = np.where(is_known, heights, means)
    return heights


def _sum_of_nine(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sums of values and their eight neighbours, with zeros outside."""
    values = np.pad(values, 1)
    values = values[:-2] + values[1:-1] + values[2:]
    return values[:, :-2] + values[:, 1:-1] + values[:, 2:]


def _void_shares(is_void: NDArray[np.bool_], rim: int) -> NDArray[np.uint8]:
    """Return `RgbTile.voids` of a grid twice as fine as the pixels, weighted 1 2 1 across them."""
    shares = np.pad(is_void.astype(np.float64), 1, mode="edge")
    shares = (shares[:-2] + 2 * shares[1:-1] + shares[2:]) / 4
    shares = (shares[:, :-2] + 2 * shares[:, 1:-1] + shares[:, 2:]) / 4
    return np.rint(255 * _without(shares[::2, ::2], rim)).astype(np.uint8)


def height_of_voids(globe: Globe) -> float:
    return globe.height_range[0] - VOID_DEPTH


def _largest_distance(tile: NDArray[np.float64], surface: NDArray[np.float64]) -> float:
    """Return the largest distance of the tile's bilinear surface from `surface`, twice as fine."""
    drawn = np.empty_like(surface)
    drawn[::2, ::2] = tile
    drawn[::2, 1::2] = (tile[:, :-1] + tile[:, 1:]) / 2
    drawn[1::2] = (drawn[:-2:2] + drawn[2::2]) / 2
    distances = np.abs(drawn - surface)
    return float(np.nanmax(distances)) if np.isfinite(distances).any() else 0.0


def _image(codes: NDArray[np.float64], void: float, look: Look) -> bytes:
    """Return an image of codes; NaN gets the code `void`, and alpha 0 if voids are transparent."""
    image = need("PIL.Image", extra="serve", purpose=_PURPOSE)
    is_void = np.isnan(codes)
    whole = np.where(is_void, void, codes).astype(np.uint32)
    parts = [whole >> 16, whole >> 8 & 255, whole & 255]
    if look.transparent_voids:
        parts.append(np.where(is_void, 0, 255))
    pixels = np.stack(parts, axis=-1).astype(np.uint8)
    out = io.BytesIO()
    mode = "RGBA" if look.transparent_voids else "RGB"
    image.fromarray(pixels, mode).save(out, look.image, **TILE_IMAGES[look.image])
    return out.getvalue()


def bounds_of(globe: Globe) -> list[float]:
    """Return the bounds of a terrain's tiles: west, south, east and north, degrees."""
    west, south, east, north = globe.extent
    if east > 180:  # bounds cannot cross 180 degrees: use the whole round, with mostly empty tiles
        west, east = -180.0, 180.0
    return [west, max(south, -MAX_LATITUDE), east, min(north, MAX_LATITUDE)]


def tile_json(globe: Globe, url: str, name: str, encoding: str = MAPBOX) -> dict[str, object]:
    """Return the TileJSON 3.0 of a terrain's terrain-RGB tiles.

    `url` is that of a tile, with ``{z}``, ``{x}`` and ``{y}`` in it; clients may show `name`.
    """
    last = max_zoom(globe)
    return {
        "tilejson": "3.0.0",
        "name": name,
        "scheme": "xyz",
        "tiles": [url],
        "minzoom": 0,
        "maxzoom": last,
        "bounds": bounds_of(globe),
        "center": [*globe.extent.centre, max(last - 3, 0)],
        "encoding": encoding,
        "tileSize": TILE_SIZE,
        "format": "png",
        "units": globe.units,
    }
