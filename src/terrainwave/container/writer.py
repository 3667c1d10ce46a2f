"""Assemble a file from its segments (FORMAT.md §3.2)."""

import os
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import BinaryIO, NamedTuple

import numpy as np

from terrainwave.container.digests import DigestTree
from terrainwave.container.header import (
    HAS_DIGESTS,
    HEADER_SIZE,
    MAX_PAGE,
    Extents,
    Header,
    pack_header,
)
from terrainwave.container.metadata import pack_metadata
from terrainwave.container.page import (
    N_CODES,
    Page,
    PageLayout,
    describe_head,
    describe_key,
    pack_columns,
    pack_page,
    page_layout,
    page_length,
)
from terrainwave.container.spool import (
    LikeSegment,
    SegmentSpool,
    StoredSegment,
    storage_errors,
)
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid

# A segment is spooled, or stored if it has no children. None marks one that is void with all below
# it, which have no entries.
Segments = Mapping[Block | None, SegmentSpool | LikeSegment | StoredSegment | None]


class _Extent(NamedTuple):
    """Sizes of a segment, needed before any byte is written; all zero if it is absent.

    `body_length` includes the pages of its children, `sections_length` only payloads and meshes.
    """

    columns: bytes
    page_length: int
    body_length: int
    sections_length: int

    @property
    def length(self) -> int:
        return self.page_length + self.body_length


_ABSENT = _Extent(b"", 0, 0, 0)
_Extents = defaultdict[Block | None, _Extent]


def assemble(out_file: BinaryIO, header: Header, segments: Segments) -> Extents:
    """Write a whole file to `out_file`, from its current position.

    Raises `ValueError` if a segment, payload or code is missing or too much. Raises
    `InvalidHeightsError` if the header or its metadata is outside the limits of the format. Raises
    `StorageError` if a temporary file cannot be read or the disk is full.

    Parameters
    ----------
    out_file : binary file object
        Written sequentially.
    header : Header
        Includes metadata and parameters. Digests follow later (`append_digests`).
    segments : mapping of Block or None to SegmentSpool, LikeSegment, StoredSegment or None
        One for each of ``header.grid.segment_heads()``, complete; None for one that is void, and
        nothing for those below it.

    Notes
    -----
    The same header and payloads give the same bytes, in whatever order they arrived. Memory: the
    index pages, about 2 kB per segment, and one payload.
    """
    grid = header.grid
    levels: list[list[Block | None]] = [[None]]
    while levels[-1]:
        # In Morton order like their parents.
        levels.append(
            [
                child
                for head in levels[-1]
                for child in _children(grid, head)
                if not _is_void(child, segments)
            ]
        )
    parts: _Extents = defaultdict(lambda: _ABSENT)
    prepare = _Preparation(grid, segments, parts)
    for heads in reversed(levels):
        for head in heads:
            parts[head] = prepare(head)
    metadata = pack_metadata(header.metadata)
    top_start = HEADER_SIZE + len(metadata) + len(header.file_tables)
    extents = Extents(
        file_size=top_start + parts[None].page_length + sum(p.body_length for p in parts.values()),
        metadata_length=len(metadata),
        metadata_crc=zlib.crc32(metadata),
        parameters_length=len(header.file_tables),
        parameters_crc=zlib.crc32(header.file_tables),
        top_page_length=parts[None].page_length,
    )
    header = replace(header, features=header.features & ~HAS_DIGESTS)
    first = pack_header(header, extents)
    # The bodies of this level's segments, then those of their children.
    first_children: dict[Block | None, int] = {}
    child_start = top_start + parts[None].page_length
    for heads in levels:
        child_start += sum(parts[head].body_length for head in heads)
        cursor = child_start
        for head in heads:
            if children := _children(grid, head):
                first_children[head] = cursor
                cursor += sum(parts[child].body_length for child in children)
    with storage_errors(f"cannot write {getattr(out_file, 'name', 'the file')}"):
        out_file.write(first + metadata + header.file_tables)
        out_file.write(_page_bytes(None, segments, parts[None], first_children.get(None, 0)))
        for heads in levels:
            for head in heads:
                for child in _children(grid, head):
                    if parts[child].page_length:
                        first_child = first_children.get(child, 0)
                        out_file.write(_page_bytes(child, segments, parts[child], first_child))
                if parts[head].sections_length:
                    for chunk in _sections(grid, head, segments):
                        out_file.write(chunk)
        out_file.flush()
    return extents


def append_digests(
    out_file: BinaryIO, header: Header, extents: Extents, digests: DigestTree
) -> None:
    """Append the digests of its heights to a file written by `assemble`.

    Raises `StorageError` if the disk is full.

    Parameters
    ----------
    out_file : binary file object
        The file from its first byte on; seekable.
    header, extents : Header, Extents
        Those of the file; `extents` as `assemble` returned them.
    """
    section = digests.pack()
    header = replace(header, features=header.features | HAS_DIGESTS)
    extents = replace(extents, file_size=extents.file_size + len(section))
    with storage_errors(f"cannot write {getattr(out_file, 'name', 'the file')}"):
        out_file.seek(0, os.SEEK_END)
        out_file.write(section)
        out_file.seek(0)
        out_file.write(pack_header(header, extents))
        out_file.seek(0, os.SEEK_END)
        out_file.flush()


def stored_segment(grid: Grid, head: Block, spool: SegmentSpool) -> StoredSegment:
    """Return a complete segment without child segments in a form that takes little memory."""
    part = _Preparation(grid, {head: spool}, defaultdict(lambda: _ABSENT))(head)
    page = pack_page(part.columns, 0) if part.length else b""
    return spool.stored(page, page_layout(grid, head).keys_in_file)


def _is_void(head: Block, segments: Segments) -> bool:
    return head in segments and segments[head] is None


def _page_bytes(head: Block | None, segments: Segments, part: _Extent, first_child: int) -> bytes:
    segment = segments[head]
    if isinstance(segment, StoredSegment):
        return segment.page()
    return pack_page(part.columns, first_child)


def _sections(grid: Grid, head: Block | None, segments: Segments) -> Iterator[bytes]:
    there, segment = _resolved(head, segments)
    if isinstance(segment, StoredSegment):
        yield from segment.sections()
    elif segment is not None:
        yield from segment.chunks(page_layout(grid, there).keys_in_file)


def _resolved(
    head: Block | None, segments: Segments
) -> tuple[Block | None, SegmentSpool | StoredSegment | None]:
    """Return the segment that holds a segment's payloads: itself, or the one it equals."""
    segment = segments[head]
    if not isinstance(segment, LikeSegment):
        return head, segment
    found = segments[segment.head]
    if not isinstance(found, SegmentSpool):
        raise ValueError(f"{describe_head(segment.head)} has no payloads of its own")
    return segment.head, found


def _children(grid: Grid, head: Block | None) -> Sequence[Block]:
    is_last = head is not None and head.level + SEGMENT_LEVELS >= grid.k_max
    return [] if is_last else page_layout(grid, head).children


class _Preparation:
    """Makes the pages of segments; equal segments with equal children only once."""

    def __init__(self, grid: Grid, segments: Segments, parts: _Extents) -> None:
        self._grid = grid
        self._segments = segments
        self._parts = parts
        self._like: dict[tuple[Block | None, tuple[_Extent, ...]], _Extent] = {}

    def __call__(self, head: Block | None) -> _Extent:
        if head not in self._segments:
            raise ValueError(f"{describe_head(head)} is missing")
        there, segment = _resolved(head, self._segments)
        if segment is None:
            return _ABSENT
        if isinstance(segment, StoredSegment):
            return _Extent(b"", segment.page_length, segment.n_bytes, segment.n_bytes)
        children = tuple(self._parts[child] for child in _children(self._grid, head))
        if there == head:
            return self._made(there, segment, children)
        if (there, children) not in self._like:
            self._like[there, children] = self._made(there, segment, children)
        return self._like[there, children]

    def _made(
        self, head: Block | None, segment: SegmentSpool, children: Sequence[_Extent]
    ) -> _Extent:
        page = _page(self._grid, page_layout(self._grid, head), segment, children)
        if head is not None and page.is_empty:
            return _ABSENT
        columns = pack_columns(page)
        length = page_length(columns)
        if length > MAX_PAGE:
            raise AssertionError(f"page of {length} bytes")
        return _Extent(columns, length, page.body_length, page.sections_length)


def _page(grid: Grid, layout: PageLayout, spool: SegmentSpool, children: Sequence[_Extent]) -> Page:
    extra = set(spool.keys()) - set(layout.keys)
    if extra:
        raise ValueError(f"{describe_key(min(extra))} does not belong to this segment")
    rows, codes = [], []
    for key in layout.keys:
        try:
            rows.append(spool.entry(key))
            codes.append(spool.codes(key))
        except KeyError:
            raise ValueError(f"{describe_key(key)} has no payload or no codes") from None
        if len(codes[-1]) != N_CODES * len(grid.key_blocks(key)):
            raise ValueError(f"{describe_key(key)} has {len(codes[-1])} bytes of codes")
    return Page(
        payload_lengths=np.array([row.payload_length for row in rows], dtype=np.uint32),
        payload_crcs=np.array([row.payload_crc for row in rows], dtype=np.uint32),
        mesh_lengths=np.array([row.mesh_length for row in rows], dtype=np.uint32),
        mesh_crcs=np.array([row.mesh_crc for row in rows], dtype=np.uint32),
        flags=np.array([row.flags for row in rows], dtype=np.uint8),
        codes=np.frombuffer(b"".join(codes), dtype=np.uint8).reshape(-1, N_CODES),
        child_page_lengths=np.array([part.page_length for part in children], dtype=np.uint32),
        child_lengths=np.array([part.length for part in children], dtype=np.uint64),
    )
