"""Payloads on their way into the spools of their segments."""

import os
import threading
from collections.abc import Iterable, Mapping, Sequence

from terrainwave.container.page import page_layout
from terrainwave.container.spool import SegmentSpool
from terrainwave.grid.quadtree import Block, Grid


class SpoolSink:
    """Sorts payloads into the spools of their segments, those of `heads`; thread-safe."""

    def __init__(
        self, grid: Grid, heads: Iterable[Block | None], directory: str | os.PathLike[str]
    ) -> None:
        self._grid = grid
        self.spools = {head: SegmentSpool(directory) for head in heads}
        self.n_bytes = 0
        self.n_units = 0
        self._n_missing: dict[Block | None, int] = {}
        self._lock = threading.Lock()

    def __call__(self, key: Block, payload: bytes) -> None:
        """Take the payload of a unit."""
        head = None if key.is_root_key else self._grid.segment_head(key)
        self.spools[head].add(key, payload)
        with self._lock:
            self.n_bytes += len(payload)
            self.n_units += 1
            if head not in self._n_missing:
                self._n_missing[head] = len(page_layout(self._grid, head).keys)
            self._n_missing[head] -= 1
            is_complete = self._n_missing[head] == 0
        if is_complete:
            self.spools[head].finish()

    def set_meshes(self, sections: Mapping[Block, bytes]) -> None:
        """Take the mesh sections of keys whose payloads have been taken."""
        for key, section in sections.items():
            head = None if key.is_root_key else self._grid.segment_head(key)
            self.spools[head].set_mesh(key, section)
        for spool in self.spools.values():
            spool.finish()

    def payloads(self, keys: Sequence[Block]) -> list[bytes]:
        """Return payloads that have been taken."""
        heads = [None if key.level < 0 else self._grid.segment_head(key) for key in keys]
        return [
            next(self.spools[head].chunks([key])) for head, key in zip(heads, keys, strict=True)
        ]
