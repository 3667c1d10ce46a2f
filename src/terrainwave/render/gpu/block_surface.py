"""Regular blocks on the GPU: heights in an array texture, one instanced call for all of them."""

from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render.gpu.shaders import INSTANCE
from terrainwave.render.gpu.surface import InstancedSurface
from terrainwave.render.gpu.texture_layers import HEIGHTS, SLOPES, LayeredTextures
from terrainwave.render.modes.batched import RegularBlock

_SKIRT = 1 << 15
_VOID = np.float32(-1e38)

_VERTEX = (
    """
#version 330 core
in uvec2 in_place;          // column and row of the vertex; the column's top bit marks skirts
uniform sampler2DArray heights;
out float gl_ClipDistance[3];
"""
    + INSTANCE.replace("INSTANCE_NUMBER", "gl_InstanceID")
    + """
void main() {
    bool is_skirt = in_place.x >= 32768u;
    ivec2 vertex = ivec2(is_skirt ? in_place.x - 32768u : in_place.x, in_place.y);
    vec2 z_both = texelFetch(heights, ivec3(vertex, int(of_instance(1).y)), 0).rg;
    bool is_void = z_both.x < -1e37;
    place_vertex(vec2(vertex), is_void ? vec2(0.0) : z_both, is_skirt);
    // A triangle with a void corner shrinks to a point.
    gl_ClipDistance[2] = is_void ? -1e9 : 1.0;
}
"""
)


def cells_of(n: int) -> NDArray[np.uint32]:
    """Return the triangles of n x n vertices: cells cut from their first corner to their last."""
    numbers = np.arange(n * n, dtype=np.uint32).reshape(n, n)
    a, b = numbers[:-1, :-1].ravel(), numbers[:-1, 1:].ravel()
    c, d = numbers[1:, :-1].ravel(), numbers[1:, 1:].ravel()
    return np.concatenate([np.column_stack([a, d, b]), np.column_stack([a, c, d])])


def grid_mesh(n: int) -> tuple[NDArray[np.uint16], NDArray[np.uint32]]:
    """Return the vertices (column, row) and triangles of n x n vertices, and of their skirts."""
    numbers = np.arange(n * n, dtype=np.uint32).reshape(n, n)
    rim = np.concatenate([numbers[0, :-1], numbers[:-1, -1], numbers[-1, :0:-1], numbers[:0:-1, 0]])
    upper, lower = rim, n * n + np.arange(len(rim), dtype=np.uint32)
    after, lower_after = np.roll(upper, -1), np.roll(lower, -1)
    skirts = np.concatenate(
        [np.column_stack([upper, after, lower]), np.column_stack([after, lower_after, lower])]
    )
    rows, cols = np.divmod(np.concatenate([numbers.ravel(), rim]), n)
    cols[n * n :] |= _SKIRT
    places = np.column_stack([cols, rows]).astype(np.uint16)
    return places, np.concatenate([cells_of(n), skirts]).astype(np.uint32)


class BlockStore:
    """`PieceStore` of regular blocks: a layer each."""

    def __init__(self, context: Any, side: int, *, max_bytes: int) -> None:
        self.layers = LayeredTextures(context, side + 3, [SLOPES, HEIGHTS], max_bytes=max_bytes)
        self.max_blocks = self.layers.max_layers
        self.release = self.layers.release
        self._layer_of: dict[int, int] = {}

    @property
    def n_bytes(self) -> int:
        return self.layers.n_bytes

    def put(self, node: int, built: RegularBlock) -> bool:
        layer = self.layers.take() if built.n_triangles else -1
        if layer is None:
            return False
        if layer >= 0:
            heights = np.where(np.isnan(built.heights), _VOID, built.heights)
            self.layers.write(layer, [built.slopes, heights])
        self._layer_of[node] = layer
        return True

    def drop(self, node: int) -> None:
        layer = self._layer_of.pop(node)
        if layer >= 0:
            self.layers.give_back(layer)

    def layers_of(self, nodes: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the layer of each node; -1 if it is void."""
        return np.array([self._layer_of[node] for node in nodes.tolist()], dtype=np.int64)


class BlockSurface(InstancedSurface):
    """`Surface` of regular blocks of `side` cells."""

    n_clip_distances = 3

    def __init__(self, context: Any, side: int, *, max_bytes: int) -> None:
        super().__init__(context, BlockStore(context, side, max_bytes=max_bytes), _VERTEX, side)
        places, triangles = (context.buffer(part.tobytes()) for part in grid_mesh(side + 1))
        self._places, self._triangles = places, triangles
        self._array = context.vertex_array(
            self.program, [(places, "2u2", "in_place")],
            index_buffer=triangles, index_element_size=4,
        )  # fmt: skip

    def draw(self, nodes: NDArray[np.int32], n: int) -> int:  # noqa: ARG002
        self._array.render(moderngl.TRIANGLES, instances=n)
        return 1
