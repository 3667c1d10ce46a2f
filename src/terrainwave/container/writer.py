"""Assemble a file from its segments (FORMAT.md §3.2)."""

import os
import threading
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
    pack_columns,
    pack_page,
    page_layout,
    page_length,
)
from terrainwave.container.spool import (
    TEMPORARY_ADVICE,
    LikeSegment,
    Section,
    SectionFile,
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

    columns: bytes = b""
    page_length: int = 0
    body_length: int = 0
    sections_length: int = 0

    @property
    def length(self) -> int:
        return self.page_length + self.body_length


_ABSENT = _Extent()


def assemble(out_file: BinaryIO, header: Header, segments: Segments) -> Extents:
    """Write a whole file to `out_file`, sequentially from its current position.

    `header` includes metadata and parameters; digests follow later (`append_digests`). `segments`
    has one for each of ``header.grid.segment_heads()``, complete; None for one that is void, and
    nothing for those below it. The same header and payloads give the same bytes, in whatever order
    they arrived. Memory: the index pages, about 2 kB per segment, and one payload.

    Raises `InvalidHeightsError` if the header or its metadata is outside the limits of the format.
    Raises `StorageError` if a temporary file cannot be read or the disk is full.
    """
    grid = header.grid
    levels: list[list[Block | None]] = [[None]]
    while levels[-1]:
        # In Morton order like their parents.
        below = [child for head in levels[-1] for child in _children(grid, head)]
        levels.append([child for child in below if segments[child] is not None])
    parts: dict[Block | None, _Extent] = defaultdict(lambda: _ABSENT)
    # Equal segments with equal children have one page.
    known: dict[tuple[Block | None, tuple[_Extent, ...]], _Extent] = {}
    for heads in reversed(levels):
        for head in heads:
            there, segment = _resolved(head, segments)
            children = tuple(parts[child] for child in _children(grid, head))
            if isinstance(segment, SegmentSpool) and (there, children) not in known:
                known[there, children] = _extent(grid, there, segment, children)
            parts[head] = (
                _Extent(b"", segment.page_length, segment.n_bytes, segment.n_bytes)
                if isinstance(segment, StoredSegment)
                else known[there, children]
            )
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
    first_children: dict[Block | None, int] = defaultdict(int)
    child_start = top_start + parts[None].page_length
    for heads in levels:
        child_start += sum(parts[head].body_length for head in heads)
        cursor = child_start
        for head in heads:
            if children_of := _children(grid, head):
                first_children[head] = cursor
                cursor += sum(parts[child].body_length for child in children_of)
    with storage_errors(f"cannot write {getattr(out_file, 'name', 'the file')}"):
        out_file.write(first + metadata + header.file_tables)
        out_file.write(pack_page(parts[None].columns, first_children[None]))
        for heads in levels:
            for head in heads:
                for child in _children(grid, head):
                    below_it = segments[child] if parts[child].page_length else None
                    if isinstance(below_it, StoredSegment):
                        out_file.write(below_it.page())
                    elif below_it is not None:
                        out_file.write(pack_page(parts[child].columns, first_children[child]))
                if not parts[head].sections_length:
                    continue
                there, segment = _resolved(head, segments)
                if isinstance(segment, StoredSegment):
                    chunks = segment.sections()
                else:
                    chunks = segment.chunks(page_layout(grid, there).keys_in_file)
                for chunk in chunks:
                    out_file.write(chunk)
        out_file.flush()
    return extents


def append_digests(
    out_file: BinaryIO, header: Header, extents: Extents, digests: DigestTree
) -> None:
    """Append the digests of its heights to a file that `assemble` wrote from its first byte on."""
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
    part = _extent(grid, head, spool, ())
    page = pack_page(part.columns, 0) if part.length else b""
    return spool.stored(page, page_layout(grid, head).keys_in_file)


def _resolved(
    head: Block | None, segments: Segments
) -> tuple[Block | None, SegmentSpool | StoredSegment]:
    """Return the segment that holds a segment's payloads: itself, or the one it equals."""
    segment = segments[head]
    if isinstance(segment, LikeSegment):
        head, segment = segment.head, segments[segment.head]
    assert isinstance(segment, SegmentSpool | StoredSegment)
    return head, segment


def _children(grid: Grid, head: Block | None) -> Sequence[Block]:
    is_last = head is not None and head.level + SEGMENT_LEVELS >= grid.k_max
    return [] if is_last else page_layout(grid, head).children


def _extent(
    grid: Grid, head: Block | None, spool: SegmentSpool, children: Sequence[_Extent]
) -> _Extent:
    keys, none = page_layout(grid, head).keys, Section()
    payloads = np.array([spool.payloads[key] for key in keys], dtype=np.uint64)
    meshes = np.array([spool.meshes.get(key, none) for key in keys], dtype=np.uint64)
    codes = b"".join(spool.codes[key] for key in keys)
    page = Page(
        payload_lengths=payloads[:, 1].astype(np.uint32),
        payload_crcs=payloads[:, 2].astype(np.uint32),
        mesh_lengths=meshes[:, 1].astype(np.uint32),
        mesh_crcs=meshes[:, 2].astype(np.uint32),
        flags=np.zeros(len(keys), dtype=np.uint8),
        codes=np.frombuffer(codes, dtype=np.uint8).reshape(-1, N_CODES),
        child_page_lengths=np.array([part.page_length for part in children], dtype=np.uint32),
        child_lengths=np.array([part.length for part in children], dtype=np.uint64),
    )
    if head is not None and page.is_empty:
        return _ABSENT
    columns = pack_columns(page)
    length = page_length(columns)
    if length > MAX_PAGE:
        raise AssertionError(f"page of {length} bytes")
    return _Extent(columns, length, page.body_length, page.sections_length)


class SpoolSink:
    """Distributes payloads to the spools of their segments; thread-safe.

    `spools` has the segments with payloads. None marks a segment that is void with all below it,
    which have no entries. A repeated segment names the one that it equals.
    """

    def __init__(
        self, grid: Grid, directory: str | os.PathLike[str], advice: str = TEMPORARY_ADVICE
    ) -> None:
        self._grid = grid
        self.spools: dict[Block | None, SegmentSpool | LikeSegment | StoredSegment | None] = {}
        self._file = SectionFile(directory, advice=advice)
        self.n_bytes = 0
        self.n_units = 0
        self._lock = threading.Lock()

    def __call__(self, key: Block, payload: bytes) -> None:
        head = None if key.is_root_key else self._grid.segment_head(key)
        with self._lock:
            spool = self.spools.get(head)
            if not isinstance(spool, SegmentSpool):
                spool = self.spools[head] = SegmentSpool(self._file)
            self.n_bytes += len(payload)
            self.n_units += 1
        spool.add(key, payload)

    def leave_out(self, block: Block) -> None:
        """Record that all units below a block are void."""
        grid = self._grid
        layer = [block]
        while layer and layer[0].level < grid.k_max and grid.segment_head(layer[0]) != layer[0]:
            for key in layer:
                self(key, b"")
            layer = grid.all_children(layer)
        if layer and layer[0].level < grid.k_max:
            with self._lock:
                self.spools.update(dict.fromkeys(layer))

    def repeat(self, head: Block, like: Block) -> None:
        with self._lock:
            self.spools[head] = LikeSegment(like)

    def store(self, head: Block) -> None:
        """Move a complete segment, with its codes, out of memory: only its position stays."""
        spool = self.spools.get(head)
        if isinstance(spool, SegmentSpool):
            self.spools[head] = stored_segment(self._grid, head, spool)

    def close(self) -> None:
        self._file.close()

    def present(self) -> Iterator[SegmentSpool]:
        return (spool for spool in self.spools.values() if isinstance(spool, SegmentSpool))

    def set_meshes(self, sections: Mapping[Block, bytes]) -> None:
        for key, section in sections.items():
            head = None if key.is_root_key else self._grid.segment_head(key)
            spool = self.spools.get(head)
            if isinstance(spool, SegmentSpool):
                spool.set_mesh(key, section)
            elif section:
                raise ValueError(f"{key} has a mesh, but no payload of its own")

    def payloads(self, keys: Sequence[Block]) -> list[bytes]:
        return [self._payload(key) for key in keys]

    def _payload(self, key: Block) -> bytes:
        head = None if key.level < 0 else self._grid.segment_head(key)
        spool = self.spools.get(head)
        if isinstance(spool, LikeSegment):
            assert head is not None
            key = spool.key_there(key, head)
            spool = self.spools[spool.head]
        return next(spool.chunks([key])) if isinstance(spool, SegmentSpool) else b""
