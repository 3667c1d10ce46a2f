"""Decode files whose units are gathered in tiles (method cdf53), on demand, through a cache."""

from collections.abc import Callable, Sequence

import numpy as np

from terrainwave.cache import Cache
from terrainwave.codec.cdf53 import LevelHeights, decode_tile
from terrainwave.codec.refiner import Decoded, Heights
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.tiles import TileLayout
from terrainwave.codec.units import unit_spec
from terrainwave.container.header import Header
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.names import METHODS
from terrainwave.read.decoder import TreeDecoder, unit_name

Tile = list[LevelHeights]


class TileDecoder(TreeDecoder):
    """Decoded units of a file of tiles, by key; a `TreeDecoder` to those who use it.

    Parameters
    ----------
    are_prefixes : bool
        Whether `payloads` returns payloads that may end early (`Terrain.read` with a quality).
    """

    def __init__(
        self,
        grid: Grid,
        parameters: CodecParameters,
        payloads: Callable[[Sequence[Block]], list[bytes]],
        cache_bytes: int,
        *,
        are_prefixes: bool = False,
    ) -> None:
        # Half for units, half for tiles.
        super().__init__(grid, None, parameters, payloads, cache_bytes // 2)
        self._layout = TileLayout(grid)
        self._are_prefixes = are_prefixes
        self._tiles: Cache[Block, Tile] = Cache(cache_bytes // 2, size_of=_n_bytes)

    def prefetch(self, keys: Sequence[Block]) -> list[Block]:
        """Fetch the payloads of the tiles that decoding `keys` will need, in one call.

        Returns none: a unit needs tiles and no other unit.
        """
        needed: dict[Block, None] = {}
        for key in keys:
            tile: Block | None = self._layout.key_of(key)
            while tile is not None and tile not in needed and self._tiles.get(tile) is None:
                needed[tile] = None
                tile = self._layout.above(tile)
        self._fetch(list(needed))
        return []

    def _decode(self, key: Block, out: Heights | None = None) -> Decoded:
        tile_key = self._layout.key_of(key)
        if key != tile_key and self._payload(key):
            raise CorruptStreamError(
                f"{unit_name(key)} is damaged: it has a payload, which is its tile's to hold"
            )
        region = unit_spec(self.grid, self._parameters, key).region
        tile = self._tile(tile_key)
        level = tile[key.level + 1 - max(tile_key.level + 1, 0)]
        return final_heights(level.part(region), self._parameters)

    def _tile(self, key: Block) -> Tile:
        """Return a decoded tile; those above it are decoded as needed."""
        # Tiles above never wait for those below.
        return self._tiles.get_or_make(key, lambda: self._decode_tile(key))

    def _decode_tile(self, key: Block) -> Tile:
        spec = self._layout.spec(key)
        above = self._layout.above(key)
        outer = None
        if above is not None and spec.outer is not None:
            outer = self._tile(above)[-1].part(spec.outer)
        try:
            return decode_tile(spec, outer, self._payload(key), is_prefix=self._are_prefixes)
        except CorruptStreamError as exc:
            raise type(exc)(f"the tile of {unit_name(key)} is damaged: {exc}") from exc


def make_decoder(
    header: Header, payloads: Callable[[Sequence[Block]], list[bytes]], cache_bytes: int
) -> TreeDecoder:
    """Return the decoder of a file that has this header."""
    if METHODS[header.method].is_tiled:
        return TileDecoder(header.grid, header.codec_parameters, payloads, cache_bytes)
    refiner = refiner_by_name(header.method, header.parameters)
    return TreeDecoder(header.grid, refiner, header.codec_parameters, payloads, cache_bytes)


def _n_bytes(tile: Tile) -> int:
    return sum(level.heights.nbytes + level.mask.nbytes for level in tile)


def final_heights(level: LevelHeights, parameters: CodecParameters) -> Decoded:
    """Return a level's final heights: quanta in the raster's range, off the nodata value.

    A height that would read as nodata goes up, or down where there is no room (format-cdf53.md,
    C.6).
    """
    wide = level.heights.astype(np.int64) * parameters.step
    heights = np.clip(wide, parameters.z_min, parameters.z_max).astype(np.int32)
    low, high = parameters.forbidden
    if low <= high:
        collides = level.mask & (heights >= low) & (heights <= high)
        heights[collides] = low - 1 if high >= parameters.z_max else high + 1
    return Decoded(heights, level.mask.copy(), None)
