"""Index arithmetic of levels, blocks, groups and segments (FORMAT.md §2).

Level 0 is the coarsest, `k_max` the full grid; level k's samples sit on every 2^(k_max - k)-th
sample of the full grid. A block is N x N cells of a level and shares its border samples with its
neighbours; a group is the four children of one block. Yusov & Turlapov 2010, §2.1.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

ROOT_LEVEL = -1
SEGMENT_LEVELS = 4


class Region(NamedTuple):
    """A rectangle of samples of one level, in that level's indices."""

    row: int
    col: int
    n_rows: int
    n_cols: int

    @property
    def shape(self) -> tuple[int, int]:
        """Return ``(n_rows, n_cols)``."""
        return self.n_rows, self.n_cols

    def slices_in(self, outer: "Region") -> tuple[slice, slice]:
        """Return the index of this region inside an array that covers `outer`."""
        row, col = self.row - outer.row, self.col - outer.col
        return slice(row, row + self.n_rows), slice(col, col + self.n_cols)

    def intersect(self, other: "Region") -> "Region":
        """Return the common part; empty (zero rows or columns) if disjoint."""
        row, col = max(self.row, other.row), max(self.col, other.col)
        n_rows = min(self.row + self.n_rows, other.row + other.n_rows) - row
        n_cols = min(self.col + self.n_cols, other.col + other.n_cols) - col
        return Region(row, col, max(n_rows, 0), max(n_cols, 0))

    def tiles(self, n_rows: int, n_cols: int, *, is_aligned: bool = False) -> Iterator["Region"]:
        """Yield the parts of this region, row by row, of at most `n_rows` x `n_cols` samples.

        They begin at its corner or, aligned, at the multiples of their size: then the first ones
        may be smaller, too.
        """
        if not (self.n_rows and self.n_cols):
            return
        top = self.row // n_rows * n_rows if is_aligned else self.row
        left = self.col // n_cols * n_cols if is_aligned else self.col
        for row in range(top, self.row + self.n_rows, n_rows):
            for col in range(left, self.col + self.n_cols, n_cols):
                yield Region(row, col, n_rows, n_cols).intersect(self)


class Block(NamedTuple):
    """Block (level, row, col) of the quadtree, counted in blocks of its level."""

    level: int
    row: int
    col: int

    @property
    def parent(self) -> "Block":
        """Return the block one level coarser that contains this one."""
        return Block(self.level - 1, self.row >> 1, self.col >> 1)

    @property
    def is_root_key(self) -> bool:
        """Return whether this is the key of a root block: its position on `ROOT_LEVEL`."""
        return self.level == ROOT_LEVEL


def morton(row: int, col: int) -> int:
    """Return the Morton number of (row, col): bits interleaved, the row's above the column's."""
    return _spread(row) << 1 | _spread(col)


def _spread(value: int) -> int:
    result, bit = 0, 0
    while value >> bit:
        result |= (value >> bit & 1) << 2 * bit
        bit += 1
    return result


@dataclass(frozen=True)
class Grid:
    """The quadtree over an ``n_rows x n_cols`` raster cut into blocks of `block` cells.

    `k_max` is the smallest number of refinements for which the longer side of level 0 has at most
    one block, which makes one root block.
    """

    n_rows: int
    n_cols: int
    block: int
    k_max: int = field(init=False)

    def __post_init__(self) -> None:
        cells = max(self.n_rows, self.n_cols) - 1
        k_max = 0
        while _ceil_shift(cells, k_max) > self.block:
            k_max += 1
        object.__setattr__(self, "k_max", k_max)

    def stride(self, level: int) -> int:
        """Return the distance of the level's samples in samples of the full grid."""
        return 1 << (self.k_max - level)

    def level_shape(self, level: int) -> tuple[int, int]:
        """Return the numbers of rows and columns of the level that lie inside the raster."""
        shift = self.k_max - level
        return (self.n_rows - 1 >> shift) + 1, (self.n_cols - 1 >> shift) + 1

    def level_blocks(self, level: int) -> tuple[int, int]:
        """Return the numbers of block rows and block columns of the level."""
        shift = self.k_max - level
        return self._n_blocks(self.n_rows - 1, shift), self._n_blocks(self.n_cols - 1, shift)

    def _n_blocks(self, cells: int, shift: int) -> int:
        return max(1, -(-_ceil_shift(cells, shift) // self.block))

    def contains(self, block: Block) -> bool:
        """Return whether the quadtree has this block."""
        if not 0 <= block.level <= self.k_max:
            return False
        rows, cols = self.level_blocks(block.level)
        return 0 <= block.row < rows and 0 <= block.col < cols

    def is_inside(self, block: Block) -> bool:
        """Return whether a block has neighbours on all sides."""
        around = (Block(block.level, block.row + by, block.col + by) for by in (-1, 1))
        return all(map(self.contains, around))

    def blocks(self, level: int) -> list[Block]:
        """Return all blocks of the level in Morton order."""
        rows, cols = self.level_blocks(level)
        blocks = [Block(level, row, col) for row in range(rows) for col in range(cols)]
        return sorted(blocks, key=lambda b: morton(b.row, b.col))

    def n_units(self) -> int:
        """Return the number of coded units: root blocks, and a group below each inner block."""
        sizes = [self.level_blocks(level) for level in range(self.k_max)]
        roots = self.level_blocks(0)
        return roots[0] * roots[1] + sum(rows * cols for rows, cols in sizes)

    def children(self, block: Block) -> list[Block]:
        """Return the blocks one level finer inside `block`, in Morton order; none at `k_max`."""
        return self.all_children([block])

    def all_children(self, blocks: Sequence[Block]) -> list[Block]:
        """Return the `children` of blocks of one level, one block's after the other's."""
        if not blocks or blocks[0].level == self.k_max:
            return []
        level = blocks[0].level + 1
        rows, cols = self.level_blocks(level)
        return [
            Block(level, row, col)
            for block in blocks
            for row in (2 * block.row, 2 * block.row + 1)
            for col in (2 * block.col, 2 * block.col + 1)
            if row < rows and col < cols
        ]

    # Keys of coded units (FORMAT.md §2.4): a group's is its parent, a root's itself on ROOT_LEVEL.

    def root_keys(self) -> list[Block]:
        """Return the keys of the root blocks in Morton order."""
        return [Block(ROOT_LEVEL, root.row, root.col) for root in self.blocks(0)]

    def key_blocks(self, key: Block) -> list[Block]:
        """Return the blocks whose heights the unit of `key` holds, in Morton order."""
        if key.is_root_key:
            return [Block(0, key.row, key.col)]
        return self.children(key)

    def block_region(self, block: Block, apron: int = 0) -> Region:
        """Return the samples of `block` inside the raster, with `apron` more on each side."""
        return self._region(block.level, block.row, block.col, self.block, apron)

    def group_region(self, parent: Block, apron: int = 0) -> Region:
        """Return the samples of the level below `parent` that its children cover."""
        return self._region(parent.level + 1, parent.row, parent.col, 2 * self.block, apron)

    def full_region(self, block: Block) -> Region:
        """Return the samples of the full grid under `block`, both borders included."""
        stride = self.stride(block.level)
        return self._region(self.k_max, block.row, block.col, self.block * stride, 0)

    def descendant_region(self, block: Block, level: int) -> Region:
        """Return the samples of `level` under `block`, both borders included."""
        return self._region(level, block.row, block.col, self.block << (level - block.level), 0)

    def _region(self, level: int, row: int, col: int, side: int, apron: int) -> Region:
        n_rows, n_cols = self.level_shape(level)
        first_row, first_col = max(row * side - apron, 0), max(col * side - apron, 0)
        last_row = min((row + 1) * side + apron, n_rows - 1)
        last_col = min((col + 1) * side + apron, n_cols - 1)
        return Region(first_row, first_col, last_row - first_row + 1, last_col - first_col + 1)

    # Segments (FORMAT.md §3): four levels of groups each, counted from the finest.

    @property
    def top_levels(self) -> int:
        """Return the number of levels of groups in the top segment."""
        return self.k_max if self.k_max < SEGMENT_LEVELS else self.k_max % SEGMENT_LEVELS

    def segment_levels(self) -> list[int]:
        """Return the levels of the blocks that head a segment below the top one."""
        return list(range(self.top_levels, self.k_max, SEGMENT_LEVELS))

    def segment_head(self, group: Block) -> Block | None:
        """Return the block whose segment holds the group below `group`; None for the top one."""
        if group.level < self.top_levels:
            return None
        depth = (group.level - self.top_levels) % SEGMENT_LEVELS
        return Block(group.level - depth, group.row >> depth, group.col >> depth)

    def segment_groups(self, head: Block | None) -> list[Block]:
        """Return the parents of the segment's groups in the page's order: level, then Morton."""
        if head is None:
            return [block for level in range(self.top_levels) for block in self.blocks(level)]
        parents, layer = [], [head]
        for _ in range(SEGMENT_LEVELS):
            parents += layer
            layer = [child for block in layer for child in self.children(block)]
        return parents

    def segment_children(self, head: Block | None) -> list[Block]:
        """Return the heads of the segments that hang below this one, in Morton order."""
        level = self.top_levels if head is None else head.level + SEGMENT_LEVELS
        if level >= self.k_max:
            return []
        if head is None:
            return self.blocks(level)
        layer = [head]
        for _ in range(SEGMENT_LEVELS):
            layer = [child for block in layer for child in self.children(block)]
        return layer

    def descendants(self, block: Block, level: int) -> list[Block]:
        """Return the blocks of a level inside `block`, in Morton order."""
        layer = [block]
        for _ in range(level - block.level):
            layer = [child for parent in layer for child in self.children(parent)]
        return layer

    def segment_heads(self) -> Iterator[Block | None]:
        """Yield the heads of all segments in file order: the top one, then (level, Morton)."""
        yield None
        for level in self.segment_levels():
            yield from self.blocks(level)


def _ceil_shift(value: int, shift: int) -> int:
    return -(-value >> shift)
