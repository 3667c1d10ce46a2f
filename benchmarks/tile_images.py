"""Bytes and time of terrain-RGB tiles: ``python -m benchmarks.tile_images DIR``.

Each raster is compressed at 1 m, and tiles of its two finest zooms, spread evenly, are written as
PNG and as lossless WebP, and as WebP with heights rounded by zoom. Times are processor time of
encoding a tile's pixels; decoded pixels are compared.
"""

import io
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from pmtiles.tile import tileid_to_zxy

import terrainwave
from benchmarks import common
from terrainwave.errors import InvalidHeightsError
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.archive import tile_numbers
from terrainwave.globe.lonlat import Globe

Row = namedtuple(
    "Row", "raster encoding tile_size n_tiles png_bytes webp_bytes webp_per_png png_ms webp_ms "
    "rounded_bytes rounded_per_png"
)  # fmt: skip


def encoded(pixels: list[np.ndarray], image: str) -> tuple[int, float]:
    """Return bytes of all tiles, and seconds of a tile; raise if pixels come back changed."""
    n_bytes, start = [], time.process_time()
    for one in pixels:
        out = io.BytesIO()
        Image.fromarray(one).save(out, image, **tiling.TILE_IMAGES[image])
        n_bytes.append(out)
    seconds = (time.process_time() - start) / len(pixels)
    for one, out in zip(pixels, n_bytes, strict=True):
        if not np.array_equal(one, pixels_of(out.getvalue())):
            raise SystemExit(f"{image}: pixels changed")
    return sum(len(out.getvalue()) for out in n_bytes), seconds


def pixels_of(image: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(image)).convert("RGB"))


def tiles_of(globe: Globe, look: tiling.Look, most: int) -> list[np.ndarray]:
    """Return the pixels of at most `most` tiles of each of the two finest zooms."""
    last, found = tiling.max_zoom(globe, look.tile_size), []
    for zoom in range(max(last - 1, 0), last + 1):
        numbers = tile_numbers(globe, zoom, 0)
        for number in numbers[:: -(-len(numbers) // most)]:
            tile = tiling.rgb_tile(globe, *tileid_to_zxy(number), 0, look)
            found += [pixels_of(tile.image)] if tile else []
    return found


def measure(paths: list[Path], most: int, folder: Path) -> Iterator[Row]:
    """Yield a row of each raster, encoding and size of tiles."""
    for raster in paths:
        file = folder / f"{raster.stem}.twz"
        if not file.exists():
            terrainwave.compress(raster, file, max_error=1)
        with terrainwave.open(file) as terrain:
            try:
                globe = Globe(terrain)
            except InvalidHeightsError:
                continue  # no place on a globe
            for encoding in tiling.ENCODINGS:
                for size in tiling.TILE_SIZES:
                    look = tiling.look_of(encoding=encoding, tile_size=size)
                    tiles = tiles_of(globe, look, most)
                    png, png_s = encoded(tiles, tiling.PNG)
                    webp, webp_s = encoded(tiles, tiling.WEBP)
                    rounded, _ = encoded(
                        tiles_of(globe, look._replace(round_by_zoom=True), most), tiling.WEBP
                    )
                    yield Row(
                        raster.stem, encoding, size, len(tiles), png, webp, round(webp / png, 3),
                        round(1e3 * png_s, 1), round(1e3 * webp_s, 1), rounded,
                        round(rounded / png, 3),
                    )  # fmt: skip


@common.command("tile_images.csv")
@common.rasters_argument
@common.option("--most", type=common.COUNT, default=6, help="Tiles of a zoom.")
def main(paths, most, folder, out) -> None:
    """Measure tiles."""
    rows = common.write_rows(out, measure(paths, most, folder))
    for name in ("webp_per_png", "rounded_per_png"):
        print(f"{name}: {common.geometric_mean([getattr(row, name) for row in rows]):.3f}")


if __name__ == "__main__":
    main()
