"""Segments: an index page with the place of what it lists (FORMAT.md §3)."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from terrainwave.container.page import Page, PageLayout, payload_starts
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.grid.quadtree import Block

# Payloads next to a page are read with it up to a size, and so much more of what they are
# estimated to take: a payload that is longer than that costs a request of its own for the rest.
_MAX_AHEAD = 1024 * 1024
_MARGIN = 0.25


@dataclass(frozen=True)
class Segment:
    """An index page with the place of its segment in the file."""

    head: Block | None
    layout: PageLayout
    page: Page
    start: int
    end: int
    payload_starts: Sequence[int]
    child_starts: Sequence[int]

    def payload_range(self, row: int) -> ByteRange:
        """Return where the payload in `row` of the page lies."""
        return ByteRange(self.payload_starts[row], int(self.page.payload_lengths[row]))

    def mesh_range(self, row: int) -> ByteRange:
        """Return where the mesh in `row` of the page lies."""
        return ByteRange(self.payload_range(row).end, int(self.page.mesh_lengths[row]))

    @property
    def body_start(self) -> int:
        """Return where its payloads and meshes begin, which follow each other without gaps."""
        return min(self.payload_starts)

    def page_range(self, child: Block) -> ByteRange:
        """Return where the page of `child` lies; of length 0 if the segment is absent."""
        row = self.layout.child_rows[child]
        return ByteRange(self.child_starts[row], int(self.page.child_page_lengths[row]))

    def child_range(self, child: Block) -> ByteRange:
        """Return where the segment of `child` lies; of length 0 if it is absent."""
        row = self.layout.child_rows[child]
        return ByteRange(self.child_starts[row], int(self.page.child_lengths[row]))


def segment_of_page(
    head: Block | None, layout: PageLayout, page: Page, start: int, page_length: int, end: int
) -> Segment:
    """Return a page with the places of what it lists, from the segment's own place."""
    child_starts, child_start = [], page.first_child
    for length in page.child_lengths.tolist():
        child_starts.append(child_start)
        child_start += length
    return Segment(
        head=head,
        layout=layout,
        page=page,
        start=start,
        end=end,
        payload_starts=payload_starts(page, layout, start + page_length),
        child_starts=child_starts,
    )


def page_and_payloads(
    parent: Segment, head: Block, layout: PageLayout, wanted: Collection[Block]
) -> ByteRange:
    """Return where the page of a segment lies, and probably the `wanted` payloads next to it.

    How long payloads are stands in the page itself. Here they are taken to change by as much from
    each level to the next, beginning with the one above the segment, which is first scaled by
    how long the segment is beside its siblings; together they fill the segment.
    """
    page = parent.page_range(head)
    body_length = parent.child_range(head).length - page.length
    keys = layout.keys_in_file
    n_ahead = next((rank for rank, key in enumerate(keys) if key not in wanted), len(keys))
    if not n_ahead or not body_length:
        return page
    depths = np.array([key.level - head.level + 1 for key in keys])
    above = _length_above(parent, head)
    change = (above * len(keys) - body_length) / depths.sum()
    lengths = np.maximum(above - change * depths, 1.0)
    ahead = lengths[:n_ahead].sum() / lengths.sum() * body_length
    n_bytes = min(int(ahead * (1 + _MARGIN)), body_length, _MAX_AHEAD)
    return ByteRange(page.offset, page.length + n_bytes)


def _length_above(parent: Segment, head: Block) -> float:
    """Return the bytes of the key above a segment, scaled by the segment's part of those below."""
    row = parent.layout.key_rows[head.parent]
    length = parent.mesh_range(row).end - parent.payload_range(row).offset
    siblings = [child for child in parent.layout.children if child.parent == head.parent]
    total = sum(parent.child_range(sibling).length for sibling in siblings)
    return length * len(siblings) * parent.child_range(head).length / total
