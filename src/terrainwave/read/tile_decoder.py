"""Decode files whose units are gathered in tiles (method cdf53), on demand, through a cache."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from terrainwave.cache import Cache
from terrainwave.codec.cdf53.refiner import LevelHeights
from terrainwave.codec.cdf53.tile_layout import TileLayout, TileSpec
from terrainwave.codec.refiner import Decoded, Raw, as_array
from terrainwave.coding.lifting53 import forward_transform, places_of
from terrainwave.errors import CorruptStreamError, InvalidArgumentError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.names import methods_that
from terrainwave.read.decoder import WHOLE, RowsOf, TreeDecoder, unit_key, unit_name
from terrainwave.read.fetched import Payloads

Tile = list[LevelHeights]
Coefficients = NDArray[np.int64]


class TiledDecoder(TreeDecoder):
    """Decoded units of a file with tiles: each is cut from its tile.

    Half of the memory is for units, half for tiles; as much again for coefficients, which few
    callers use. `decode` decodes the payload of a tile, below its head's block.
    """

    are_apart = False

    def __init__(
        self,
        grid: Grid,
        parameters: CodecParameters,
        payloads: Payloads,
        cache_bytes: int,
        decode: Callable[[TileSpec, LevelHeights | None, bytes], Tile],
    ) -> None:
        super().__init__(grid, parameters, None, payloads, cache_bytes // 2)
        self._layout = TileLayout(grid, parameters.has_voids)
        self._decode_payload = decode
        self._tiles: Cache[Block, Tile] = Cache(cache_bytes // 2, size_of=_n_bytes)
        self._coefficients: Cache[Block, Coefficients] = Cache(
            cache_bytes // 2, size_of=lambda found: found.nbytes
        )

    def prefetch(self, keys: Sequence[Block], rows: RowsOf = WHOLE) -> list[Block]:  # noqa: ARG002
        """Fetch the payloads of the tiles needed to decode `keys`, in one call.

        Returns an empty list: a unit needs tiles but no other units.
        """
        needed: dict[Block, None] = {}
        for key in keys:
            tile: Block | None = self._layout.key_of(key)
            while tile is not None and tile not in needed and self._tiles.get(tile) is None:
                needed[tile] = None
                tile = self._layout.above(tile)
        self._fetched.fetch(list(needed))
        return []

    def _decode(self, key: Block, rows: RowsOf = WHOLE, raw: Raw | None = None) -> Decoded:  # noqa: ARG002
        tile_key = self._layout.key_of(key)
        if key != tile_key and self._fetched.take(key):
            raise CorruptStreamError(
                f"{unit_name(key)} is damaged: it has a payload, which is its tile's to hold"
            )
        tile = self._tile(tile_key)
        level = tile[key.level + 1 - max(tile_key.level + 1, 0)]
        return final_heights(level.part(self.spec(key).region), self._parameters)

    def coefficients(self, level: int, region: Region) -> Coefficients:
        """Return the magnitude of the wavelet coefficient at each sample of a level, in quanta.

        It belongs to the transform that makes the coarsest level with this sample; the samples of
        the coarsest level of all have none: 0. Equal in all tiles that share a sample, and on all
        levels.

        Parameters
        ----------
        region : Region
            Inside the level.
        """
        found = np.empty(region.shape, dtype=np.int64)
        side = self.grid.block
        # One of the blocks that share a line is enough.
        for row in _blocks_along(region.row, region.n_rows, side):
            for col in _blocks_along(region.col, region.n_cols, side):
                block = Block(level, row, col)
                here = self.grid.block_region(block).intersect(region)
                found[here.slices_in(region)] = self._coefficients_in(block, here)
        return found

    def _coefficients_in(self, block: Block, region: Region) -> Coefficients:
        key = self._layout.key_of(unit_key(block))
        spec = self._layout.spec(key)
        stride = 1 << (spec.last - block.level)
        coarse = spec.regions[block.level - spec.last - 1]
        return self._of_tile(key)[::stride, ::stride][region.slices_in(coarse)] * np.int64(
            self._parameters.step
        )

    def _of_tile(self, key: Block) -> Coefficients:
        return self._coefficients.get_or_make(key, lambda: self._transform_tile(key))

    def _transform_tile(self, key: Block) -> Coefficients:
        """Return the magnitudes of a tile's coefficients at the samples of its finest level.

        The transform is reversible, so transforming the decoded heights gives the decoded
        coefficients.
        """
        spec, above = self._layout.spec(key), self._layout.above(key)
        field = self._tile(key)[-1].heights.astype(np.int64)
        forward_transform(field, spec.n_transforms, spec.held)
        np.abs(field, out=field)
        found = places_of(field, spec.n_transforms)
        lowest = found[:: 1 << spec.n_transforms, :: 1 << spec.n_transforms]
        if above is None or spec.outer is None:
            lowest[...] = 0
        else:
            outer = self._layout.spec(above).region
            lowest[...] = self._of_tile(above)[spec.outer.slices_in(outer)]
        return found

    def _tile(self, key: Block) -> Tile:
        # Tiles above never wait for those below.
        return self._tiles.get_or_make(key, lambda: self._decode_tile(key))

    def _decode_tile(self, key: Block) -> Tile:
        spec = self._layout.spec(key)
        above = self._layout.above(key)
        outer = None
        if above is not None and spec.outer is not None:
            outer = self._tile(above)[-1].part(spec.outer)
        try:
            return self._decode_payload(spec, outer, self._fetched.take(key))
        except CorruptStreamError as exc:
            raise type(exc)(f"the tile of {unit_name(key)} is damaged: {exc}") from exc


def with_coefficients(decoder: TreeDecoder) -> TiledDecoder:
    """Return a decoder that has wavelet coefficients; raise `InvalidArgumentError` for another."""
    if not isinstance(decoder, TiledDecoder):
        raise InvalidArgumentError(
            "the file has no coefficients of a 5/3 wavelet; those of method"
            f" {methods_that(lambda method: method.has_coefficients)} have"
        )
    return decoder


def _blocks_along(first: int, n: int, side: int) -> range:
    """Return the blocks of `side` cells that hold `n` samples from `first` on, along a line."""
    start = first // side if n > 1 else max(first - 1, 0) // side
    return range(start, max((first + n - 2) // side, start) + 1)


def _n_bytes(tile: Tile) -> int:
    return sum(level.heights.nbytes + level.validity.nbytes for level in tile)


def final_heights(level: LevelHeights, parameters: CodecParameters) -> Decoded:
    """Return a level's final heights: quanta in the raster's range, off the nodata value.

    A height that equals nodata goes up, or down if there is no room (format-cdf53.md, C.6).
    """
    wide = level.heights.astype(np.int64) * parameters.step
    heights = np.clip(wide, parameters.z_min, parameters.z_max).astype(np.int32)
    low, high = parameters.forbidden
    if low <= high:
        collides = as_array(level.validity.mask, heights.shape)
        collides = collides & (heights >= low) & (heights <= high)
        heights[collides] = low - 1 if high >= parameters.z_max else high + 1
    return Decoded(heights, level.validity.copy())
