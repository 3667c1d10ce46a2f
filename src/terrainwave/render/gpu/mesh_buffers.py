"""Patches on the GPU: one vertex buffer, one index buffer, one array texture of slopes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.render.gpu.arena import Arena
from terrainwave.render.gpu.texture_layers import SLOPES, LayeredTextures
from terrainwave.render.scene.patches import VERTEX, Patch

_FIRST_VERTICES = 1 << 18
_FIRST_INDICES = 1 << 20
# Textures take at most this fraction (1 / n) of the memory.
_TEXTURE_SHARE = 2
_INDEX_BYTES = 4
# struct DrawElementsIndirectCommand
COMMAND = np.dtype(
    [
        ("count", "<u4"),
        ("n_instances", "<u4"),
        ("first_index", "<u4"),
        ("base_vertex", "<i4"),
        ("base_instance", "<u4"),
    ]
)


class _Buffer(Arena):
    """Buffer of the GPU for `capacity` items."""

    def __init__(self, context: Any, capacity: int, itemsize: int) -> None:
        super().__init__(capacity)
        self._context, self.itemsize = context, itemsize
        self.buffer = context.buffer(reserve=capacity * itemsize)

    @property
    def n_bytes(self) -> int:
        return self.capacity * self.itemsize

    def grow(self, capacity: int) -> None:
        old, self.buffer = self.buffer, self._context.buffer(reserve=capacity * self.itemsize)
        self._context.copy_buffer(self.buffer, old)
        old.release()
        super().grow(capacity)


class GpuStore:
    """`PieceStore` on the GPU, within `max_bytes`.

    Buffers and textures grow by doubling. Indices count from the buffer's first vertex, so that
    drivers without base vertices can draw them too.
    """

    def __init__(self, context: Any, side: int, *, max_bytes: int) -> None:
        # Samples of a block and one more on each side.
        self.layers = LayeredTextures(
            context, side + 3, [SLOPES], max_bytes=max_bytes // _TEXTURE_SHARE
        )
        self.max_blocks = self.layers.max_layers
        self._mesh_bytes = max_bytes - self.layers.max_bytes
        self._vertices = _Buffer(context, _FIRST_VERTICES, VERTEX.itemsize)
        self._indices = _Buffer(context, _FIRST_INDICES, _INDEX_BYTES)
        # First vertex, vertices, first index, indices and layer by node, for whole frames at once.
        self._places = np.zeros((256, 5), dtype=np.int64)
        self.generation = 0  # counts replaced buffers: vertex arrays on old ones are stale

    @property
    def n_bytes(self) -> int:
        return self._vertices.n_bytes + self._indices.n_bytes + self.layers.n_bytes

    @property
    def vertex_buffer(self) -> Any:
        return self._vertices.buffer

    @property
    def index_buffer(self) -> Any:
        return self._indices.buffer

    def put(self, node: int, patch: Patch) -> bool:
        n_indices = patch.triangles.size
        if n_indices == 0:
            self._place(node, (0, 0, 0, 0, -1))
            return True
        layer = self.layers.take()
        if layer is None:
            return False
        first_vertex = self._take(self._vertices, self._indices, len(patch.vertices))
        first_index = (
            None if first_vertex is None else self._take(self._indices, self._vertices, n_indices)
        )
        if first_vertex is None or first_index is None:
            self.layers.give_back(layer)
            if first_vertex is not None:
                self._vertices.give_back(first_vertex, len(patch.vertices))
            return False
        self.vertex_buffer.write(patch.vertices, offset=first_vertex * VERTEX.itemsize)
        indices = patch.triangles + np.uint32(first_vertex)
        self.index_buffer.write(indices, offset=first_index * _INDEX_BYTES)
        self.layers.write(layer, [patch.slopes])
        self._place(node, (first_vertex, len(patch.vertices), first_index, n_indices, layer))
        return True

    def _place(self, node: int, place: tuple[int, int, int, int, int]) -> None:
        if node >= len(self._places):
            self._places = np.resize(self._places, (2 * node + 2, 5))
        self._places[node] = place

    def drop(self, node: int) -> None:
        first_vertex, n_vertices, first_index, n_indices, layer = self._places[node].tolist()
        if layer < 0:
            return
        self._vertices.give_back(first_vertex, n_vertices)
        self._indices.give_back(first_index, n_indices)
        self.layers.give_back(layer)

    def _take(self, part: _Buffer, other: _Buffer, size: int) -> int | None:
        while (start := part.take(size)) is None:
            # Twice as much; the last time only the remaining memory.
            capacity = min(2 * part.capacity, (self._mesh_bytes - other.n_bytes) // part.itemsize)
            if capacity < part.capacity + size:
                return None
            part.grow(capacity)
            self.generation += 1
        return start

    def commands(self, nodes: NDArray[np.int32]) -> NDArray[np.void]:
        """Return the draw commands of nodes; command k draws instance k."""
        commands = np.zeros(len(nodes), dtype=COMMAND)
        commands["first_index"], commands["count"] = self._places[nodes, 2], self._places[nodes, 3]
        commands["n_instances"] = 1
        commands["base_instance"] = np.arange(len(nodes))
        return commands

    def layers_of(self, nodes: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the slope layer of each node; -1 if it has no triangles."""
        layers: NDArray[np.int64] = self._places[nodes, 4]
        return layers

    def release(self) -> None:
        for part in (self.vertex_buffer, self.index_buffer, self.layers):
            part.release()
