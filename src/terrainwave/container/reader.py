"""Random access to the payloads of a file; bytes are read only on demand.

Untrusted bytes are checked in this order: magic, version, header and its checksum, limits, file
size, metadata, index pages and positions of their segments, checksums of payloads (FORMAT.md §3.5).
"""

import logging
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from terrainwave.cache import Cache
from terrainwave.container.digests import TAIL_LENGTH, DigestTree, section_length, unpack_digests
from terrainwave.container.header import (
    HEADER_SIZE,
    SMALLEST_DIGESTS,
    Extents,
    Header,
    check_optional_sections,
    unpack_header,
)
from terrainwave.container.metadata import unpack_metadata
from terrainwave.container.page import (
    Segment,
    describe_head,
    describe_key,
    empty_page,
    page_layout,
    segment_of_page,
    unpack_page,
)
from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.sources.ranges import ByteRange, RoundReader
from terrainwave.errors import CorruptStreamError, TerrainwaveError, TruncatedStreamError
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid

_log = logging.getLogger(__name__)

FIRST_READ = 16 * 1024
_CHECK_BATCH = 4 * 1024 * 1024


class Container:
    """Open .twz file: bytes by key, no heights. Thread-safe; a context manager.

    A key is the parent block of a group, or one of `Grid.root_keys`: a root's position on level -1.
    Keys and blocks outside of the grid raise `KeyError`. With `may_be_cut` a file that ends too
    early is opened, too: its `n_missing` bytes count as damaged. Opening reads the first 16 KiB
    and, if the top page ends later, a second range: 64 KiB at most for metadata up to 30 kB. Memory
    does not depend on the size of the raster, but on `cached_segments`: index pages of about 50 kB.
    """

    def __init__(
        self, source: ByteSource, cached_segments: int = 256, *, may_be_cut: bool = False
    ) -> None:
        self._arguments = source, cached_segments
        self._segments: Cache[Block, Segment] = Cache(cached_segments)
        start = source.read(0, min(FIRST_READ, source.size))
        header, extents = unpack_header(start)
        self.n_missing = max(extents.file_size - source.size, 0)
        if self.n_missing and not may_be_cut:
            raise TruncatedStreamError(
                f"the file has {source.size} of its {extents.file_size} bytes; on_error='mask'"
                " (decompress --on-error mask) reads what is there"
            )
        if self.n_missing:
            from terrainwave.container.sources.zip_member import CutFile  # sound files need none

            source = CutFile(source, extents.file_size)
        self.source = source
        if source.size > extents.file_size:
            left_over = source.size - extents.file_size
            raise CorruptStreamError(f"{left_over} bytes left over after the last section")
        end = extents.top_start + extents.top_page_length
        if end > len(start):
            start += source.read(len(start), end - len(start))
        check_optional_sections(start[HEADER_SIZE : extents.header_size])
        self._start = start
        self.extents: Extents = extents
        self.header: Header = _with_sections(header, extents, start)
        self.grid: Grid = self.header.grid
        self._segments_end = extents.file_size - SMALLEST_DIGESTS * header.has_digests
        self._top = self._unpack_top(start[extents.top_start : end])

    def _unpack_top(self, data: bytes) -> Segment:
        start = self.extents.top_start
        layout = page_layout(self.grid, None)
        page = unpack_page(data, layout, f"the page of {describe_head(None)}")
        segment = segment_of_page(None, layout, page, start + len(data))
        end = segment.end
        if end > self._segments_end:
            raise CorruptStreamError("the top segment reaches beyond the end of the file")
        last = page.children_end if layout.children else end
        if layout.children and page.first_child != end:
            raise CorruptStreamError("the first segment does not follow the top segment")
        n_levels_below = self.grid.k_max - self.grid.top_levels
        is_exact = not self.header.has_digests  # otherwise `check` finds their start
        if is_exact and last != self._segments_end and n_levels_below <= SEGMENT_LEVELS:
            raise CorruptStreamError("the segments do not fill the file")
        if last > self._segments_end:
            raise CorruptStreamError("a segment reaches beyond the end of the file")
        return segment

    def segment(self, head: Block | None) -> Segment:
        return self.segments([head])[head]

    def segments(self, heads: Sequence[Block | None]) -> dict[Block | None, Segment]:
        """Return the indices of several segments; missing pages of a level take one request."""
        with self._blaming_change():
            known = self._located(heads, self.rounds(), lambda _: ())
        return {head: known[head] for head in heads}

    def _located(
        self,
        heads: Iterable[Block | None],
        reader: RoundReader,
        wanted: Callable[[Mapping[Block | None, Segment]], Iterable[ByteRange]],
    ) -> dict[Block | None, Segment]:
        """Return the indices of segments and of those above them.

        Each missing level takes one round, which also fetches what is `wanted` by the known
        indices.
        """
        known = self._known_segments(heads)
        while missing := self._next_segments(heads, known):
            places = {head: parent.page_range(head) for head, parent in missing.items()}
            here = {head: place for head, place in places.items() if reader.has(place)}
            if not here:  # otherwise they may locate more to fetch
                reader.fetch([*places.values(), *wanted(known)])
            for head, place in (here or places).items():
                segment = self._unpack_segment(head, missing[head], reader.take(place))
                self._segments.put(head, segment)
                known[head] = segment
        return known

    @contextmanager
    def _blaming_change(self) -> Iterator[None]:
        """Turn contradictions in the bytes into an error that the file has changed, if it has."""
        try:
            yield
        except CorruptStreamError:
            self.source.check_unchanged()
            raise

    def _parent_head(self, head: Block) -> Block | None:
        if not self.grid.contains(head) or head.level not in self.grid.segment_levels():
            raise KeyError(f"no segment begins at {head}")
        # A root block's own segment is also a child of the top one.
        return None if head.level == 0 else self.grid.segment_head(head.parent)

    def _unpack_segment(self, head: Block, parent: Segment, data: bytes) -> Segment:
        """Check a page against its parent's and return its segment (FORMAT.md §3.5)."""
        layout = page_layout(self.grid, head)
        start, length = parent.child_range(head)
        if not data:
            return segment_of_page(head, layout, empty_page(layout), start)
        name = describe_head(head)
        page = unpack_page(data, layout, f"the page of {name}")
        if page.body_length != length:
            raise CorruptStreamError(
                f"the body of {name} has {page.body_length} bytes, its parent says {length}"
            )
        # Strictly forward, so that no chain of pages returns to a byte.
        if layout.children and page.first_child < parent.page.children_end:
            raise CorruptStreamError(f"the child segments of {name} overlap others")
        if layout.children and page.children_end > self._segments_end:
            raise CorruptStreamError(f"a child of {name} reaches beyond the end of the file")
        return segment_of_page(head, layout, page, start)

    def _head_of(self, key: Block) -> Block | None:
        if key.is_root_key:
            if self.grid.contains(Block(0, key.row, key.col)):
                return None
        elif key.level < self.grid.k_max and self.grid.contains(key):
            return self.grid.segment_head(key)
        raise KeyError(f"the grid has no {describe_key(key)}")

    def present_segments(self) -> Iterator[Segment]:
        """Yield the index of every segment that takes bytes, parents first."""
        waiting: list[Block | None] = [None]
        while waiting:
            segment = self.segment(waiting.pop())
            yield segment
            children = segment.layout.children
            waiting += [child for child in children if segment.page_range(child).length]

    def payload(self, key: Block) -> bytes:
        """Return the payload of `key`; raise `CorruptStreamError` for a wrong checksum."""
        return self.payloads([key])[0]

    def payloads(self, keys: Sequence[Block]) -> list[bytes]:
        """Return the payloads of `keys` in this order; near ones are read in one request.

        Each missing level of index pages takes one round of requests, which also fetches the
        payloads whose position is known by then; one more round fetches the rest.
        """
        heads = {key: self._head_of(key) for key in keys}
        reader = self.rounds()
        with self._blaming_change():
            known = self._located(
                heads.values(), reader, lambda known: _payload_places(heads, known).values()
            )
            of_payloads = _payload_places(heads, known)
            reader.fetch(of_payloads.values())
            payloads = {key: reader.take(place) for key, place in of_payloads.items()}
            n_bytes = sum(map(len, payloads.values()))
            _log.debug("read %d payloads, %d bytes", len(keys), n_bytes)
            for key, head in heads.items():
                crcs = known[head].page.payload_crcs
                check_crc(payloads[key], crcs[known[head].layout.key_rows[key]], "payload", key)
        return [payloads[key] for key in keys]

    def rounds(self) -> RoundReader:
        return RoundReader(self.source, self._start)

    def _known_segments(self, heads: Iterable[Block | None]) -> dict[Block | None, Segment]:
        """Return those of the segments and their ancestors that are cached or implied."""
        known: dict[Block | None, Segment] = {None: self._top}
        for head in set(heads):
            above = head
            while above is not None and above not in known:
                segment = self._segments.get(above)
                if segment is not None:
                    known[above] = segment
                above = self._parent_head(above)
        return known

    def _next_segments(
        self, heads: Iterable[Block | None], known: Mapping[Block | None, Segment]
    ) -> dict[Block, Segment]:
        """Return, with its parent, the highest unknown segment on the way to each of `heads`."""
        missing: dict[Block, Segment] = {}
        for head in heads:
            while head is not None and head not in known:
                parent_head = self._parent_head(head)
                if parent_head in known:
                    missing[head] = known[parent_head]
                head = parent_head
        return missing

    def payload_lengths(self, keys: Sequence[Block]) -> list[int]:
        return [segment.payload_range(row).length for segment, row in self._rows(keys)]

    def payload_parts(self, parts: Sequence[tuple[Block, int, int]]) -> list[bytes]:
        """Return bytes of payloads, unchecked; each of `parts` is (key, start, end)."""
        ranges = []
        for (segment, row), (_, start, end) in zip(
            self._rows([key for key, _, _ in parts]), parts, strict=True
        ):
            whole = segment.payload_range(row)
            if not 0 <= start <= end <= whole.length:
                raise ValueError(f"bytes {start} … {end} of a payload of {whole.length}")
            ranges.append(ByteRange(whole.offset + start, end - start))
        return self.source.read_many(ranges)

    def mesh(self, key: Block) -> bytes:
        ((segment, row),) = self._rows([key])
        data = self.source.read(*segment.mesh_range(row))
        with self._blaming_change():
            check_crc(data, segment.page.mesh_crcs[row], "mesh", key)
        return data

    def codes(self, block: Block) -> tuple[int, int, int, int]:
        if not self.grid.contains(block):
            raise KeyError(f"the grid has no {block}")
        head = None if block.level == 0 else self.grid.segment_head(block.parent)
        return self.segment(head).codes(block)

    def _rows(self, keys: Sequence[Block]) -> list[tuple[Segment, int]]:
        heads = {key: self._head_of(key) for key in keys}
        segments = self.segments([*heads.values()])
        found = ((segments[heads[key]], key) for key in keys)
        return [(segment, segment.layout.key_rows[key]) for segment, key in found]

    def digests_place(self) -> ByteRange:
        """Return the position of the digests at the file's end; of length 0 if it has none."""
        size = self.extents.file_size
        if not self.header.has_digests:
            return ByteRange(size, 0)
        length = section_length(self.source.read(size - TAIL_LENGTH, TAIL_LENGTH))
        if not SMALLEST_DIGESTS <= length <= size - self._top.end:
            raise CorruptStreamError(f"digests of {length} bytes do not fit behind the segments")
        return ByteRange(size - length, length)

    def digests(self) -> DigestTree | None:
        """Return the digests of heights, if any; raise `CorruptStreamError` if damaged."""
        if not self.header.has_digests:
            return None
        with self._blaming_change():
            data = self.source.read(*self.digests_place())
            return unpack_digests(data, (self.header.n_rows, self.header.n_cols))

    def check(self) -> Iterator[str]:
        """Read every byte once and yield problems, one line each; nothing if the file is sound.

        Nothing is checked below an unreadable page. Memory: the index pages of one level; of the
        finest, where most are, only one.
        """
        yield from self._check_payloads(self._top)
        byte_pos, end, layer = self._top.end, self._top.end, [self._top]
        while layer:
            byte_pos, parents, layer = max(byte_pos, end), layer, []
            for parent, child in ((one, child) for one in parents for child in one.layout.children):
                if not parent.page_range(child).length:
                    continue
                start, length = parent.child_range(child)
                # This also keeps the walk finite: each byte is visited at most once.
                if start != byte_pos:
                    name = f"the body of {describe_head(child)}"
                    yield f"{name} begins at byte {start}, not {byte_pos}"
                    if start < byte_pos:
                        continue
                byte_pos = start + length
                try:
                    with self._blaming_change():  # what is known of it may be older
                        data = self.source.read(*parent.page_range(child))
                        segment = self._unpack_segment(child, parent, data)
                except TerrainwaveError as error:
                    yield str(error)
                    continue
                yield from self._check_payloads(segment)
                end = max(end, segment.end)
                if segment.layout.children:
                    layer.append(segment)
        byte_pos = max(byte_pos, end)
        try:
            place = self.digests_place()
        except CorruptStreamError as error:
            yield str(error)
            return
        if byte_pos != place.offset:
            yield f"the segments end at byte {byte_pos} of {place.offset}"

    def _check_payloads(self, segment: Segment) -> Iterator[str]:
        batch: list[int] = []
        size = 0
        for row in segment.layout.order:
            batch.append(row)
            size += segment.payload_range(row).length + segment.mesh_range(row).length
            if size > _CHECK_BATCH:
                yield from self._check_rows(segment, batch)
                batch, size = [], 0
        yield from self._check_rows(segment, batch)

    def _check_rows(self, segment: Segment, rows: Sequence[int]) -> Iterator[str]:
        payload_ranges = [segment.payload_range(row) for row in rows]
        mesh_ranges = [segment.mesh_range(row) for row in rows]
        data = self.source.read_many([*payload_ranges, *mesh_ranges])
        for kind, parts, crcs in (
            ("payload", data[: len(rows)], segment.page.payload_crcs),
            ("mesh", data[len(rows) :], segment.page.mesh_crcs),
        ):
            for row, part in zip(rows, parts, strict=True):
                try:
                    with self._blaming_change():
                        check_crc(part, crcs[row], kind, segment.layout.keys[row])
                except CorruptStreamError as error:
                    yield str(error)

    def close(self) -> None:
        self._start = b""
        self.source.close()

    def __enter__(self) -> "Container":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Container, may_be_cut=self.n_missing > 0), self._arguments


def _payload_places(
    heads: Mapping[Block, Block | None], known: Mapping[Block | None, Segment]
) -> dict[Block, ByteRange]:
    return {
        key: known[head].payload_range(known[head].layout.key_rows[key])
        for key, head in heads.items()
        if head in known
    }


def _with_sections(header: Header, extents: Extents, start: bytes) -> Header:
    metadata = start[extents.parameters_start - extents.metadata_length : extents.parameters_start]
    if zlib.crc32(metadata) != extents.metadata_crc:
        raise CorruptStreamError("checksum of the metadata does not match")
    file_tables = start[extents.parameters_start : extents.top_start]
    if zlib.crc32(file_tables) != extents.parameters_crc:
        raise CorruptStreamError("checksum of the method's parameters does not match")
    return replace(header, metadata=unpack_metadata(metadata), file_tables=file_tables)


def check_crc(data: bytes, crc: int, kind: str, key: Block) -> None:
    if zlib.crc32(data) != crc:
        raise CorruptStreamError(f"checksum of the {kind} of {describe_key(key)} does not match")


@dataclass(frozen=True)
class Parts:
    """Bytes of each part of a file; their sum is the file.

    `heights`: payloads of each level, the coarsest first; one number if a payload spans several.
    """

    metadata: int
    tables: int
    index: int
    heights: tuple[int, ...]
    meshes: int
    digests: int


def parts_of(container: Container) -> Parts:
    extents = container.extents
    index, meshes = extents.top_page_length, 0
    heights = [0] * (container.grid.k_max + 1)
    for segment in container.present_segments():
        page = segment.page
        index += int(page.child_page_lengths.sum(dtype="int64"))
        meshes += int(page.mesh_lengths.sum(dtype="int64"))
        for key, length in zip(segment.layout.keys, page.payload_lengths.tolist(), strict=True):
            # The key of a group is the block above it; that of a root lies on level -1.
            heights[key.level + 1] += length
    return Parts(
        extents.parameters_start,
        extents.parameters_length,
        index,
        tuple(heights),
        meshes,
        container.digests_place().length,
    )
