"""Segments: an index page with the place of what it lists (FORMAT.md §3)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from terrainwave.container.page import Page, PageLayout, payload_starts
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.grid.quadtree import Block


@dataclass(frozen=True)
class Segment:
    """An index page with the places of what it lists.

    Parameters
    ----------
    sections_start : int
        Where its payloads and meshes begin, which follow each other without gaps.
    page_starts, child_starts : sequence of int
        Where the pages of its children lie, and their bodies.
    end : int
        Where its payloads and meshes end.
    """

    head: Block | None
    layout: PageLayout
    page: Page
    sections_start: int
    end: int
    payload_starts: Sequence[int]
    page_starts: Sequence[int]
    child_starts: Sequence[int]

    def payload_range(self, row: int) -> ByteRange:
        """Return where the payload in `row` of the page lies."""
        return ByteRange(self.payload_starts[row], int(self.page.payload_lengths[row]))

    def mesh_range(self, row: int) -> ByteRange:
        """Return where the mesh in `row` of the page lies."""
        return ByteRange(self.payload_range(row).end, int(self.page.mesh_lengths[row]))

    def page_range(self, child: Block) -> ByteRange:
        """Return where the page of `child` lies; of length 0 if the segment is absent."""
        row = self.layout.child_rows[child]
        return ByteRange(self.page_starts[row], int(self.page.child_page_lengths[row]))

    def child_range(self, child: Block) -> ByteRange:
        """Return where the body of `child` lies; of length 0 if it has none or is absent."""
        row = self.layout.child_rows[child]
        return ByteRange(self.child_starts[row], self.page.child_body_lengths[row])


def segment_of_page(
    head: Block | None, layout: PageLayout, page: Page, body_start: int, *, has_pages: bool = True
) -> Segment:
    """Return a page with the places of what it lists, from where its body begins.

    `has_pages`: the pages of its children lie there, before payloads and meshes.
    """
    pages = page.child_page_lengths.tolist() if has_pages else [0] * len(layout.children)
    sections_start = body_start + sum(pages)
    return Segment(
        head=head,
        layout=layout,
        page=page,
        sections_start=sections_start,
        end=sections_start + page.sections_length,
        payload_starts=payload_starts(page, layout, sections_start),
        page_starts=list(accumulate(pages, initial=body_start))[:-1],
        child_starts=list(accumulate(page.child_body_lengths, initial=page.first_child))[:-1],
    )
