"""Segments: an index page with absolute positions (FORMAT.md §3)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from terrainwave.container.page import Page, PageLayout, payload_starts
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.grid.quadtree import Block


@dataclass(frozen=True)
class Segment:
    """Index page of a segment with the positions of its payloads, meshes and children.

    Its payloads and meshes lie from `sections_start` to `end`; `page_starts` and `child_starts` are
    those of its children's pages and bodies.
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
        return ByteRange(self.payload_starts[row], int(self.page.payload_lengths[row]))

    def mesh_range(self, row: int) -> ByteRange:
        return ByteRange(self.payload_range(row).end, int(self.page.mesh_lengths[row]))

    def codes(self, block: Block) -> tuple[int, int, int, int]:
        z_min, z_max, error, mesh_error = self.page.codes[self.layout.block_rows[block]].tolist()
        return z_min, z_max, error, mesh_error

    def page_range(self, child: Block) -> ByteRange:
        row = self.layout.child_rows[child]
        return ByteRange(self.page_starts[row], int(self.page.child_page_lengths[row]))

    def child_range(self, child: Block) -> ByteRange:
        row = self.layout.child_rows[child]
        return ByteRange(self.child_starts[row], self.page.child_body_lengths[row])


def segment_of_page(head: Block | None, layout: PageLayout, page: Page, body_start: int) -> Segment:
    pages = page.child_page_lengths.tolist()
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
