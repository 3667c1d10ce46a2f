"""Regular blocks on the GPU: heights in an array texture, one instanced call for all of them."""

from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render.gpu.shaders import SKIRT_DEPTH, TERRAIN_FRAGMENT
from terrainwave.render.gpu.surface import OWN_UNIT, release_all, set_uniforms
from terrainwave.render.gpu.texture_layers import HEIGHTS, SLOPES, LayeredTextures
from terrainwave.render.scene.selection import View

if TYPE_CHECKING:
    from terrainwave.render.modes.batched import RegularBlock
    from terrainwave.render.modes.mode import Frames
    from terrainwave.render.paging.scene import Scene

_SLOPES, _INSTANCES, _HEIGHTS = OWN_UNIT, OWN_UNIT + 1, OWN_UNIT + 2
_SKIRT = 1 << 15
_VOID = np.float32(-1e38)
_SMALLEST = 256  # initial instances

# Row k of `instances` holds block k in four texels:
# (x, y, z of its corner at z = 0, relative to the eye; share of the parent's surface)
# (depth of skirts, layer, level, samples of the full grid per cell)
# (columns, rows of the full grid right of and below its corner; columns, rows left of and above)
# (error in metres, unused, unused, unused)
_VERTEX = """
#version 330 core
in uvec2 in_place;          // column and row of the vertex; the column's top bit marks skirts
uniform sampler2D instances;
uniform sampler2DArray heights;
uniform mat4 view_projection;
uniform vec4 sample_axes;   // metres per sample of the full grid: x by col, x by row, y ...
uniform float z_scale;
out vec3 v_seen;            // relative to the eye
out vec2 v_sample;          // in samples of the block's level
flat out ivec2 v_layers;
out vec2 v_grid;            // column, row of the full grid
flat out vec4 v_parent;     // unused, unused, level, error
out float gl_ClipDistance[3];
SKIRT_DEPTH
void main() {
    vec4 a = texelFetch(instances, ivec2(0, gl_InstanceID), 0);
    vec4 b = texelFetch(instances, ivec2(1, gl_InstanceID), 0);
    vec4 c = texelFetch(instances, ivec2(2, gl_InstanceID), 0);
    vec4 d = texelFetch(instances, ivec2(3, gl_InstanceID), 0);
    bool is_skirt = in_place.x >= 32768u;
    ivec2 vertex = ivec2(is_skirt ? in_place.x - 32768u : in_place.x, in_place.y);
    vec2 full = vec2(vertex) * b.w;
    vec2 z_both = texelFetch(heights, ivec3(vertex, int(b.y)), 0).rg;
    bool is_void = z_both.x < -1e37;
    float z = is_void ? 0.0 : mix(z_both.x, z_both.y, a.w);
    vec3 seen = a.xyz;
    seen.x += full.x * sample_axes.x + full.y * sample_axes.y;
    seen.y += full.x * sample_axes.z + full.y * sample_axes.w;
    seen.z += z * z_scale;
    v_below = is_skirt ? 1.0 : 0.0;
    seen.z -= is_skirt ? skirt_depth(seen, b.x) : 0.0;
    v_seen = seen;
    v_sample = vec2(vertex);
    v_layers = ivec2(int(b.y), -1);
    v_parent = vec4(0.0, 0.0, b.z, d.x);
    v_grid = c.zw + full;
    gl_ClipDistance[0] = c.x - full.x;
    gl_ClipDistance[1] = c.y - full.y;
    // A triangle with a void corner shrinks to a point.
    gl_ClipDistance[2] = is_void ? -1e9 : 1.0;
    gl_Position = view_projection * vec4(seen, 1.0);
}
""".replace("SKIRT_DEPTH", SKIRT_DEPTH)


def grid_mesh(n: int) -> tuple[NDArray[np.uint16], NDArray[np.uint32]]:
    """Return the vertices (column, row) and triangles of n x n vertices, and of their skirts.

    Cells are cut from their first corner to their last, as in `regular.half_place`.
    """
    numbers = np.arange(n * n, dtype=np.uint32).reshape(n, n)
    a, b = numbers[:-1, :-1].ravel(), numbers[:-1, 1:].ravel()
    c, d = numbers[1:, :-1].ravel(), numbers[1:, 1:].ravel()
    cells = np.concatenate([np.column_stack([a, d, b]), np.column_stack([a, c, d])])
    rim = np.concatenate([numbers[0, :-1], numbers[:-1, -1], numbers[-1, :0:-1], numbers[:0:-1, 0]])
    upper, lower = rim, n * n + np.arange(len(rim), dtype=np.uint32)
    after, lower_after = np.roll(upper, -1), np.roll(lower, -1)
    skirts = np.concatenate(
        [np.column_stack([upper, after, lower]), np.column_stack([after, lower_after, lower])]
    )
    rows, cols = np.divmod(np.concatenate([numbers.ravel(), rim]), n)
    cols[n * n :] |= _SKIRT
    places = np.column_stack([cols, rows]).astype(np.uint16)
    return places, np.concatenate([cells, skirts]).astype(np.uint32)


class BlockStore:
    """`PieceStore` of regular blocks: a layer each."""

    def __init__(self, context: Any, side: int, *, max_bytes: int) -> None:
        self.layers = LayeredTextures(context, side + 3, [SLOPES, HEIGHTS], max_bytes=max_bytes)
        self._layer_of: dict[int, int] = {}

    @property
    def max_blocks(self) -> int:
        """Return how many blocks fit."""
        return self.layers.max_layers

    @property
    def n_bytes(self) -> int:
        """Return the bytes of all textures, used or not."""
        return self.layers.n_bytes

    def put(self, node: int, built: "RegularBlock") -> bool:
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

    def release(self) -> None:
        self.layers.release()


class BlockSurface:
    """`Surface` of regular blocks.

    Parameters
    ----------
    context : moderngl.Context
        OpenGL 3.3 core or newer.
    side : int
        Cells of a block per side.
    """

    n_clip_distances = 3

    def __init__(self, context: Any, side: int, *, max_bytes: int) -> None:
        self._context = context
        self._side = side
        self.store = BlockStore(context, side, max_bytes=max_bytes)
        self.program = context.program(
            vertex_shader=_VERTEX.strip(), fragment_shader=TERRAIN_FRAGMENT.strip()
        )
        places, triangles = grid_mesh(side + 1)
        self._places = context.buffer(places.tobytes())
        self._triangles = context.buffer(triangles.tobytes())
        self._array = context.vertex_array(
            self.program, [(self._places, "2u2", "in_place")],
            index_buffer=self._triangles, index_element_size=4,
        )  # fmt: skip
        self._instances: Any = None

    def instances(self, scene: "Scene", view: View, frames: "Frames") -> NDArray[np.float32]:
        """Return the texels of the blocks, float32 (n, 16): see the shader."""
        table, nodes = scene.table, frames.nodes
        keys = table.keys[nodes]
        strides = np.left_shift(1, scene.mode.n_levels - 1 - keys[:, 0])
        rows = keys[:, 1] * self._side * strides
        cols = keys[:, 2] * self._side * strides
        bases = table.bases[nodes]
        origins = np.column_stack(
            [scene.frame.samples_to_local(rows, cols), bases * view.exaggeration]
        )
        n_rows, n_cols = scene.frame.shape
        texels = np.zeros((len(nodes), 16), dtype=np.float32)
        texels[:, 0:3] = origins - view.camera.eye
        texels[:, 3] = frames.morphs
        texels[:, 4] = frames.skirts
        texels[:, 5] = self.store.layers_of(nodes)
        texels[:, 6] = keys[:, 0]
        texels[:, 7] = strides
        texels[:, 8], texels[:, 9] = n_cols - 1 - cols, n_rows - 1 - rows
        texels[:, 10], texels[:, 11] = cols, rows
        texels[:, 12], texels[:, 13:] = table.errors[nodes], 0
        return texels[texels[:, 5] >= 0]

    def submit(self, scene: "Scene", view: View, frames: "Frames") -> int:
        """Draw all blocks by one call."""
        texels = self.instances(scene, view, frames)
        n = len(texels)
        if not n:
            return 0
        self._reach(n)
        self._instances.write(texels.tobytes(), viewport=(0, 0, 4, n))
        slopes, heights = self.store.layers.textures
        set_uniforms(
            self.program,
            {
                "side": float(self._side), "slopes": _SLOPES, "heights": _HEIGHTS,
                "instances": _INSTANCES,
            },
        )  # fmt: skip
        slopes.use(_SLOPES)
        heights.use(_HEIGHTS)
        self._instances.use(_INSTANCES)
        self._array.render(moderngl.TRIANGLES, instances=n)
        return 1

    def _reach(self, n_blocks: int) -> None:
        """Allocate the instances of `n_blocks`."""
        if self._instances is not None and self._instances.size[1] >= n_blocks:
            return
        if self._instances is not None:
            self._instances.release()
        n = max(_SMALLEST, 1 << (n_blocks - 1).bit_length())
        self._instances = self._context.texture((4, n), 4, dtype="f4")
        self._instances.filter = (moderngl.NEAREST, moderngl.NEAREST)

    def release(self) -> None:
        release_all(
            self._instances, self._array, self._places, self._triangles, self.program, self.store
        )  # fmt: skip
