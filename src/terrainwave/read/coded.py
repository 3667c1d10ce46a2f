"""Properties of a file found without decoding: void parts, and segments that decode alike.

The latter are sea: a planet has thousands of them.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from terrainwave.cache import Cache
from terrainwave.codec.refiner import Decoded
from terrainwave.container.reader import Container
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Region
from terrainwave.read.decoder import TreeDecoder, unit_key

# Upper limits for segments and payloads of one height, in bytes.
_MOST_BYTES, _MOST_IN_PAYLOAD = 1 << 16, 1 << 10
# Cached heights of blocks and payloads, and of segments.
_MOST_KNOWN = 1 << 14
_MOST_CONTENTS = 1 << 8


class Content(NamedTuple):
    """All data that determine the decoded units of a finest segment.

    These are the height of the block above them, lengths and checksums of their payloads, and the
    payloads. Equal checksums need be verified only once.
    """

    height: int
    lengths: bytes
    checksums: bytes
    payloads: bytes


class EvenBlocks:
    """Blocks of one height, found without decoding each, by payloads known to give it.

    Units of a level with neighbours on all sides, below a block of one height, decode alike if
    their payloads are equal. One unit is decoded for each payload. Thread-safe.
    """

    def __init__(self, container: Container, decoder: TreeDecoder) -> None:
        self._container = container
        self._decoder = decoder
        self._are_apart = decoder.are_apart
        # By a unit's level, the height above it and its payload; False if it has several heights.
        self._known: Cache[tuple[int, tuple[int, int], int, bytes], int | bool] = Cache(_MOST_KNOWN)
        self._heights: Cache[Block, int | bool] = Cache(_MOST_KNOWN)
        # For finest segments: the one height below; False if there are several.
        self._below: Cache[Content, int | bool] = Cache(_MOST_CONTENTS)

    def of_block(self, block: Block) -> int | None:
        """Return the one height of a block and its apron; None if samples differ or are void."""
        found = self._heights.get_or_make(block, lambda: self._of_block(block))
        return None if found is False else found

    def _of_block(self, block: Block) -> int | bool:
        height = self.of_unit(unit_key(block))
        return _one_height(self._decoder.block(block)) if height is None else height

    def of_unit(self, key: Block) -> int | None:
        """Return the one height of a unit without decoding it.

        None if it has several, or its payload does not suffice.
        """
        if key.is_root_key or not self._are_apart or not self._container.grid.is_inside(key):
            return None
        above = self.of_block(key)
        if above is None:
            return None
        payload = self._container.payload(key)
        if not 0 < len(payload) <= _MOST_IN_PAYLOAD:
            return None
        shape = self._decoder.spec(key).region.shape  # cut at an edge that only an apron reaches
        found = self._known.get_or_make(
            (key.level, shape, above, payload), lambda: _one_height(self._decoder.unit(key))
        )
        return None if found is False else found

    def below(self, block: Block) -> set[int] | None:
        """Return heights of the full grid under a block, including the lowest and the highest.

        None if not all samples are valid, or remainders change them.
        """
        grid, found, blocks = self._container.grid, set[int](), [block]
        while blocks:
            key = blocks.pop()
            height = self.of_unit(key)
            if key.level < grid.k_max - 1:
                blocks += grid.children(key)
            elif height is not None:
                found.add(height)
            else:
                _, unit = self._decoder.part_once(key, self._decoder.spec(key).core)
                if unit.validity.own_mask is not None or unit.remainders is not None:
                    return None
                found |= {int(unit.heights.min()), int(unit.heights.max())}
        return found

    def own(self, region: Region) -> int | None:
        """Return the one height of a region of the full grid, if a block owns exactly that.

        None otherwise, or if the region is no larger than a unit, or larger than a segment.
        """
        grid = self._container.grid
        depth = (region.n_rows // grid.block).bit_length() - 1
        side = grid.block << max(depth, 0)
        block = Block(grid.k_max - depth, region.row // side, region.col // side)
        if not 0 < depth <= SEGMENT_LEVELS or block.level < 0 or not grid.is_inside(block):
            return None
        if region != Region(block.row * side, block.col * side, side, side):
            return None
        content = self.content(block)
        if content is None:
            found = self._one_below(block)
        else:
            found = self._below.get_or_make(content, lambda: self._one_below(block))
        return None if found is False else found

    def _one_below(self, block: Block) -> int | bool:
        found = self.below(block)
        return found.pop() if found is not None and len(found) == 1 else False

    def content(self, head: Block) -> Content | None:
        """Return the content that determines the units of the segment of `head`.

        None unless it is one of the finest segments, has neighbours on all sides, and lies below a
        block of one height.
        """
        grid = self._container.grid
        is_finest = head.level + SEGMENT_LEVELS == grid.k_max and grid.segment_head(head) == head
        if not is_finest or not self._are_apart or not grid.is_inside(head):
            return None
        segment = self._container.segment(head)
        n_bytes = segment.page.sections_length
        if not 0 < n_bytes <= _MOST_BYTES:
            return None
        height = self.of_block(head)
        if height is None:
            return None
        payloads = self._container.source.read(segment.sections_start, n_bytes)
        page = segment.page
        return Content(
            height, page.payload_lengths.tobytes(), page.payload_crcs.tobytes(), payloads
        )


def _one_height(unit: Decoded) -> int | bool:
    """Return the one height of all samples; False if there are several, or some are void."""
    height = int(unit.heights[0, 0])
    if unit.validity.own_mask is not None or unit.remainders is not None:
        return False
    return height if bool((unit.heights == height).all()) else False


def coded_parts(container: Container, level: int, region: Region) -> Iterator[Region]:
    """Yield the parts of a region of a level whose units have a payload, for methods of units.

    A unit without payload is void with all below it, so mostly void files need few lookups.
    """
    yield from _coded(container, level, region, container.grid.root_keys())


def _coded(
    container: Container, level: int, region: Region, keys: Iterable[Block]
) -> Iterator[Region]:
    grid = container.grid
    near = []
    for key in keys:
        block = Block(0, key.row, key.col) if key.is_root_key else key
        part = grid.descendant_region(block, level).intersect(region)
        if part.n_rows and part.n_cols:
            near.append((key, part))
    lengths = container.payload_lengths([key for key, _ in near])
    for (key, part), length in zip(near, lengths, strict=True):
        if not length:
            continue
        if key.level + 1 == level:
            yield part
        else:
            yield from _coded(container, level, region, grid.key_blocks(key))
