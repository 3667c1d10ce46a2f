"""What a file tells without decoding: which parts are void, and which segments decode alike.

The latter are sea: a planet has thousands.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from terrainwave.container.reader import Container
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Region
from terrainwave.read.decoder import TreeDecoder

# Bytes of a segment of one height: longer ones are not.
_MOST_BYTES = 1 << 16


class Content(NamedTuple):
    """All that the units of a finest segment decode to follows from.

    The one height of the block above them, the lengths of their payloads, and these.
    """

    height: int
    lengths: bytes
    payloads: bytes


def content_of(container: Container, decoder: TreeDecoder, head: Block) -> Content | None:
    """Return what the units of the segment of `head` decode to follows from.

    None where that is more: unless it is one of the finest, has neighbours on all sides, and lies
    below a block that is of one height.
    """
    grid = container.grid
    is_finest = head.level + SEGMENT_LEVELS == grid.k_max and grid.segment_head(head) == head
    if not is_finest or not grid.is_inside(head):
        return None
    segment = container.segment(head)
    n_bytes = segment.page.body_length
    if not 0 < n_bytes <= _MOST_BYTES:
        return None
    above = decoder.block(head)
    height = int(above.heights[0, 0])
    if above.validity.own_mask is not None or not (above.heights == height).all():
        return None
    payloads = container.source.read(segment.body_start, n_bytes)
    return Content(height, segment.page.payload_lengths.tobytes(), payloads)


def coded_parts(container: Container, level: int, region: Region) -> Iterator[Region]:
    """Yield the parts of a region of a level in which units have a payload, for methods of units.

    A unit without one is void, as is all below it: so few are looked at where much is.
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
