"""Distribution of payloads to the spools of their segments."""

import os
import secrets
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Protocol

from terrainwave.container.page import N_CODES, page_layout
from terrainwave.container.spool import (
    TEMPORARY_ADVICE,
    LikeSegment,
    SegmentSpool,
    StoredSegment,
    storage_errors,
)
from terrainwave.container.writer import write_segment
from terrainwave.grid.quadtree import Block, Grid


class SpoolSink:
    """Distributes payloads to the spools of their segments; thread-safe.

    `spools` has the segments with payloads. None marks a segment that is void with all below it,
    which have no entries. A repeated segment names the one that it equals.
    """

    def __init__(self, grid: Grid, directory: str | os.PathLike[str]) -> None:
        self._grid = grid
        self._directory = directory
        self.spools: dict[Block | None, SegmentSpool | LikeSegment | StoredSegment | None] = {}
        # Finished segments without child segments. A run may code a raster twice.
        name = f"finished-{secrets.token_hex(8)}.twz-spool"
        self._finished, self._end = os.path.join(directory, name), 0
        self.n_bytes = 0
        self.n_units = 0
        self._n_missing: dict[Block | None, int] = {}
        self._lock, self._storing = threading.Lock(), threading.Lock()

    def __call__(self, key: Block, payload: bytes) -> None:
        """Store the payload of a unit."""
        head = None if key.is_root_key else self._grid.segment_head(key)
        with self._lock:
            spool = self.spools.get(head)
            if not isinstance(spool, SegmentSpool):
                spool = self.spools[head] = SegmentSpool(self._directory)
        spool.add(key, payload)
        with self._lock:
            self.n_bytes += len(payload)
            self.n_units += 1
            if head not in self._n_missing:
                self._n_missing[head] = len(page_layout(self._grid, head).keys)
            self._n_missing[head] -= 1
            is_complete = self._n_missing[head] == 0
            if is_complete:
                del self._n_missing[head]
        if is_complete:
            spool.finish()

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
        """Record that the segment of `head` has the bytes of that of `like`."""
        with self._lock:
            self.spools[head] = LikeSegment(like)

    def store(self, head: Block) -> None:
        """Move a complete segment, with its codes, out of memory: only its position stays."""
        spool = self.spools.get(head)
        if not isinstance(spool, SegmentSpool):
            return
        action = f"cannot write temporary files in {self._directory}"
        with self._storing, storage_errors(action, advice=TEMPORARY_ADVICE):
            # Not "ab": after a failed write, the next one begins after the good bytes.
            with open(self._finished, "r+b" if self._end else "wb") as file:
                file.seek(self._end)
                stored = write_segment(file, self._finished, self._grid, head, spool)
            self._end += stored.length
        self.spools[head] = stored
        spool.close()

    def present(self) -> Iterator[SegmentSpool]:
        """Yield the spools that have payloads of their own."""
        return (spool for spool in self.spools.values() if isinstance(spool, SegmentSpool))

    def set_meshes(self, sections: Mapping[Block, bytes]) -> None:
        """Store the mesh sections of keys whose payloads are stored."""
        for key, section in sections.items():
            head = None if key.is_root_key else self._grid.segment_head(key)
            spool = self.spools.get(head)
            if isinstance(spool, SegmentSpool):
                spool.set_mesh(key, section)
            elif section:
                raise ValueError(f"{key} has a mesh, but no payload of its own")
        for spool in self.present():
            spool.finish()

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


class Stored(Protocol):
    """Payloads, meshes and codes of segments that exist."""

    def payloads(self, keys: Sequence[Block]) -> list[bytes]: ...

    def mesh(self, key: Block) -> bytes: ...

    def codes(self, block: Block) -> tuple[int, int, int, int]: ...


def copied_segments(
    grid: Grid,
    heads: Iterable[Block | None],
    stored: Stored,
    mesh_codes: Mapping[Block, int],
    directory: str | os.PathLike[str],
    sections: Mapping[Block, bytes] | None = None,
    advice: str = TEMPORARY_ADVICE,
) -> dict[Block | None, SegmentSpool]:
    """Return segments with other codes of mesh errors, and other mesh sections if any are given."""
    spools: dict[Block | None, SegmentSpool] = {}
    for head in heads:
        spool = spools[head] = SegmentSpool(directory, advice=advice)
        for key in page_layout(grid, head).keys:
            codes = bytearray()
            for block in grid.key_blocks(key):
                codes += bytes([*stored.codes(block)[: N_CODES - 1], mesh_codes.get(block, 0)])
            mesh = stored.mesh(key) if sections is None else sections.get(key, b"")
            spool.add(key, stored.payloads([key])[0], codes=bytes(codes), mesh=mesh)
        spool.finish()
    return spools
