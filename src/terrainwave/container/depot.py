"""Segments and arrays on storage that several machines share, until a file is put together.

A segment is stored in the file's own form (FORMAT.md §3.2): page, then payloads and meshes. Its
page's `first_child` is 0, as nobody knows offsets in the file yet.
"""

import io
import os
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.cache import Cache
from terrainwave.container.page import describe_head, empty_page, page_layout, unpack_page
from terrainwave.container.reader import check_crc
from terrainwave.container.segment import Segment, segment_of_page
from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.sources.opening import open_source
from terrainwave.container.spool import storage_errors
from terrainwave.extras import need
from terrainwave.grid.quadtree import Block, Grid

_OPEN_SOURCES = 32
_CACHED_PAGES = 64
_CHUNK = 16 << 20


class StoredSegment(NamedTuple):
    """Where a segment lies; all of an absent one (FORMAT.md §3.4) is 0 but its path."""

    path: str
    offset: int
    page_length: int
    length: int

    def chunks(self) -> Iterator[bytes]:
        """Yield the page, then payloads and meshes, at most 16 MiB in memory at a time."""
        source = open_source(self.path)
        try:
            yield source.read(self.offset, self.page_length)
            end = self.offset + self.length
            for start in range(self.offset + self.page_length, end, _CHUNK):
                yield source.read(start, min(_CHUNK, end - start))
        finally:
            source.close()


@dataclass(frozen=True)
class Depot:
    """A directory that all machines of a run see: a path, or a URL that fsspec can write to.

    What is written appears whole or not at all, so that a task can be run again after its machine
    was lost, or twice at a time.
    """

    root: str

    def path(self, name: str) -> str:
        """Return the path or URL of something stored."""
        return f"{self.root}/{name}"

    @contextmanager
    def create(self, name: str) -> Iterator[BinaryIO]:
        """Give a file to write that appears when the block ends without exception.

        Raises
        ------
        StorageError
            If it cannot be written.
        """
        with storage_errors(f"cannot write {self.path(name)}"):
            filesystem, path = _filesystem(self.root)
            target = f"{path}/{name}"
            # Object stores show a file only once it is whole.
            is_local = "file" in filesystem.protocol
            unfinished = f"{target}.{secrets.token_hex(8)}" if is_local else target
            with filesystem.open(unfinished, "wb") as file:
                yield file
            if is_local:
                os.replace(unfinished, target)

    def save(self, name: str, **arrays: Any) -> None:
        """Store arrays under a name."""
        with self.create(name) as file:
            np.savez(file, **arrays)

    def load(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the arrays that `save` stored.

        Raises
        ------
        StorageError
            If it is not there.
        """
        source = open_source(self.path(name))
        try:
            data = source.read(0, source.size)
        finally:
            source.close()
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return dict(arrays)

    def remove(self) -> None:
        """Delete everything in the depot."""
        with storage_errors(f"cannot remove {self.root}"):
            filesystem, path = _filesystem(self.root)
            if filesystem.exists(path):
                filesystem.rm(path, recursive=True)


def _filesystem(root: str) -> tuple[Any, str]:
    """Return fsspec's file system of a path or URL and the path in it."""
    fsspec = need("fsspec.core", extra="distributed", purpose="a cluster")
    filesystem, path = fsspec.url_to_fs(root)
    return filesystem, path


class StoredSegments:
    """Payloads, meshes and codes of stored segments, by key; not thread-safe.

    Parameters
    ----------
    place : callable
        Returns where a segment lies, by its head.
    """

    def __init__(self, grid: Grid, place: Callable[[Block | None], StoredSegment]) -> None:
        self._grid = grid
        self._place = place
        self._sources: Cache[str, ByteSource] = Cache(
            _OPEN_SOURCES, drop=lambda source: source.close()
        )
        self._segments: Cache[Block | None, Segment] = Cache(_CACHED_PAGES)

    def payloads(self, keys: Sequence[Block]) -> list[bytes]:
        """Return the payloads of `keys`; raise `CorruptStreamError` if a checksum is wrong."""
        return [self._section(key, is_mesh=False) for key in keys]

    def mesh(self, key: Block) -> bytes:
        """Return the mesh section of `key`; empty if it has none."""
        return self._section(key, is_mesh=True)

    def codes(self, block: Block) -> tuple[int, int, int, int]:
        """Return the codes of `block`: z_min, z_max, error, mesh error."""
        head = None if block.level == 0 else self._grid.segment_head(block.parent)
        segment = self._segment(head)
        z_min, z_max, error, mesh_error = segment.page.codes[segment.block_rows[block]].tolist()
        return z_min, z_max, error, mesh_error

    def close(self) -> None:
        """Close all sources."""
        self._sources.clear()

    def __enter__(self) -> "StoredSegments":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _section(self, key: Block, *, is_mesh: bool) -> bytes:
        head = None if key.is_root_key else self._grid.segment_head(key)
        segment = self._segment(head)
        row = segment.key_rows[key]
        if is_mesh:
            wanted, crcs, kind = segment.mesh_range(row), segment.page.mesh_crcs, "mesh"
        else:
            wanted, crcs, kind = segment.payload_range(row), segment.page.payload_crcs, "payload"
        if not wanted.length:
            return b""
        data = self._source(self._place(head).path).read(*wanted)
        check_crc(data, crcs[row], kind, key)
        return data

    def _segment(self, head: Block | None) -> Segment:
        return self._segments.get_or_make(head, lambda: self._load(head))

    def _load(self, head: Block | None) -> Segment:
        layout, place = page_layout(self._grid, head), self._place(head)
        page = empty_page(layout)
        if place.length:
            data = self._source(place.path).read(place.offset, place.page_length)
            page = unpack_page(data, layout, f"the page of {describe_head(head)}")
        end = place.offset + place.length
        return segment_of_page(head, layout, page, place.offset, place.page_length, end)

    def _source(self, path: str) -> ByteSource:
        return self._sources.get_or_make(path, lambda: open_source(path))
