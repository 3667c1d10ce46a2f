"""Segments that decode alike, told by their bytes: sea, of which a planet has thousands."""

from typing import NamedTuple

from terrainwave.container.reader import Container
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block
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
    around = (Block(head.level, head.row + step, head.col + step) for step in (-1, 1))
    if not is_finest or not all(map(grid.contains, around)):
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
