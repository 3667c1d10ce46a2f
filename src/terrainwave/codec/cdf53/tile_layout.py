"""Tiles: coded units that span several levels (format-cdf53.md, C.2).

A tile is a block of one level, its *head*, with all samples of the next few levels below it. One
stream holds them; its payload has the key of the head. The heights of the head's block are the LL
band of the tile and come from the tile above. The root tile has no head: it holds level 0 and the
levels that remain when full tiles are counted from the finest level, so the coarse levels come
first in the file, as an overview.
"""

from dataclasses import dataclass
from functools import cached_property

from terrainwave.coding.lifting53 import HELD_BOTTOM, HELD_LEFT, HELD_RIGHT, HELD_TOP
from terrainwave.grid.quadtree import Block, Grid, Region

# Tiles of this many cells per side, at least two blocks (Zheng, Wang, Wang: 1025 x 1025 samples).
_TILE_LOG2 = 10


@dataclass(frozen=True)
class TileSpec:
    """Parameters of a tile's coder besides the heights of its head's block.

    The tile holds the levels `first` … `last` with the samples `regions`; `outer` is its head's
    block; `held` is the set of sides that border on other tiles (sum of `lifting53.HELD_TOP` …),
    `n_below` the number of levels finer than `last`; `has_voids` is true if samples may be void.
    """

    key: Block
    first: int
    last: int
    outer: Region | None
    regions: tuple[Region, ...]
    held: int
    n_transforms: int
    n_below: int
    has_voids: bool = True

    @property
    def region(self) -> Region:
        """Return the samples of the finest level."""
        return self.regions[-1]

    def is_finest(self, index: int) -> bool:
        """Return whether a level, counted from the coarsest, is the full grid."""
        return self.n_below + len(self.regions) - 1 == index

    @property
    def is_root(self) -> bool:
        """Return whether this is the tile without a head."""
        return self.key.is_root_key


@dataclass(frozen=True)
class TileLayout:
    """Partition of a grid's units into tiles."""

    grid: Grid
    has_voids: bool = True

    @cached_property
    def depth(self) -> int:
        """Return the number of levels of a tile other than the root one."""
        return max(1, _TILE_LOG2 + 1 - self.grid.block.bit_length())

    @cached_property
    def root_last(self) -> int:
        """Return the finest level of the root tile."""
        return self.grid.k_max % self.depth

    def key_of(self, unit: Block) -> Block:
        """Return the key of the tile that holds the unit with this key."""
        if unit.level < self.root_last:
            return Block(-1, 0, 0)
        depth = (unit.level - self.root_last) % self.depth
        return Block(unit.level - depth, unit.row >> depth, unit.col >> depth)

    def above(self, key: Block) -> Block | None:
        """Return the key of the tile that holds the head of tile `key`; None for the root tile."""
        if key.is_root_key:
            return None
        return self.key_of(Block(-1, 0, 0) if key.level == 0 else key.parent)

    def below(self, key: Block) -> list[Block]:
        """Return the keys of the tiles whose heads lie in tile `key`."""
        last = self.root_last if key.is_root_key else key.level + self.depth
        if last == self.grid.k_max:
            return []
        heads = [Block(0, 0, 0) if key.is_root_key else key]
        while heads[0].level < last:
            heads = [child for head in heads for child in self.grid.children(head)]
        return heads

    def keys(self) -> list[Block]:
        """Return the keys of all tiles, those above first."""
        keys, layer = [], [Block(-1, 0, 0)]
        while layer:
            keys += layer
            layer = [below for key in layer for below in self.below(key)]
        return keys

    def n_units(self, key: Block) -> int:
        head = Block(0, 0, 0) if key.is_root_key else key
        last = self.root_last if key.is_root_key else key.level + self.depth
        layer, count = [head], 1 if key.is_root_key else 0
        for _ in range(head.level, last):
            count += len(layer)
            layer = [child for block in layer for child in self.grid.children(block)]
        return count

    def spec(self, key: Block) -> TileSpec:
        grid = self.grid
        head = Block(0, 0, 0) if key.is_root_key else key
        first = key.level + 1
        last = self.root_last if key.is_root_key else key.level + self.depth
        regions = tuple(
            grid.descendant_region(head, level) for level in range(max(first, 0), last + 1)
        )
        n_rows, n_cols = grid.level_blocks(head.level)
        held = 0
        for side, is_held in (
            (HELD_TOP, head.row > 0),
            (HELD_LEFT, head.col > 0),
            (HELD_BOTTOM, head.row + 1 < n_rows),
            (HELD_RIGHT, head.col + 1 < n_cols),
        ):
            held += side if is_held else 0
        return TileSpec(
            key=key,
            first=first,
            last=last,
            outer=None if key.is_root_key else grid.block_region(head),
            regions=regions,
            held=held,
            n_transforms=self._root_transforms() if key.is_root_key else self.depth,
            n_below=grid.k_max - last,
            has_voids=self.has_voids,
        )

    def _root_transforms(self) -> int:
        """Return the number of transforms that reduce the root tile to one sample; at least one."""
        cells = max(self.grid.level_shape(self.root_last)) - 1
        return max(cells.bit_length(), self.root_last + 1)

    def lowpass_tiles(self, level: int) -> tuple[int, tuple[int, int]]:
        """Return cells per side and rows and columns of the tiles that hold `level`."""
        if level <= self.root_last:
            return self.grid.block << level, (1, 1)
        key = self.key_of(Block(level - 1, 0, 0))
        return self.grid.block << (level - key.level), self.grid.level_blocks(key.level)
