"""Distribution of payloads to the spools of their segments."""

import os
import threading
from collections.abc import Iterator, Mapping, Sequence

from terrainwave.container.spool import (
    TEMPORARY_ADVICE,
    LikeSegment,
    SectionFile,
    SegmentSpool,
    StoredSegment,
)
from terrainwave.container.writer import stored_segment
from terrainwave.grid.quadtree import Block, Grid


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
