"""One mesh of many patches on the GPU, uploaded each frame; slopes of each patch in a texture."""

from typing import Any

import moderngl
import numpy as np

from terrainwave.render.gpu.shaders import OUTPUTS
from terrainwave.render.gpu.surface import OWN_UNIT, Surface, release_all, set_uniforms
from terrainwave.render.gpu.texture_layers import SLOPES, LayeredTextures
from terrainwave.render.modes.front import FrontPatch
from terrainwave.render.modes.mode import Frames
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.selection import View

_SLOPES = OWN_UNIT
_FIRST_BYTES = 1 << 20
# The fragment shader reads slopes next to a sample: a ring of texels, and one more for an even
# size.
RING = 3

VERTEX = np.dtype(
    [("place", "<f4", 3), ("sample", "<f4", 2), ("grid", "<f4", 2), ("about", "<f4", 4)]
)

# Meshes may reach beyond the raster's outline.
CUT_OFF = """
uniform vec2 last;          // column and row of the full grid

void cut_off(int k, vec2 grid) {
    vec2 inside = last - grid;
    gl_ClipDistance[k] = grid.x + 1e-3;
    gl_ClipDistance[k + 1] = grid.y + 1e-3;
    gl_ClipDistance[k + 2] = inside.x + 1e-3;
    gl_ClipDistance[k + 3] = inside.y + 1e-3;
}
"""

_VERTEX_SHADER = """
#version 330 core
in vec3 in_place;           // relative to the eye
in vec2 in_sample;          // column and row of the patch
in vec2 in_grid;            // column and row of the full grid
in vec4 in_about;           // layer, size, error; depth of a skirt's lower end, -1 of a surface
out float gl_ClipDistance[4];
CUT_OFF
OUTPUTS
void main() {
    bool is_skirt = in_about.w >= 0.0;
    v_seen = in_place;
    v_below = is_skirt ? 1.0 : 0.0;
    v_seen.z -= is_skirt ? skirt_depth(in_place, in_about.w) : 0.0;
    v_sample = in_sample;
    v_layer = in_about.x;
    v_grid = in_grid;
    v_about = in_about.yz;
    gl_Position = view_projection * vec4(v_seen, 1.0);
    cut_off(0, in_grid);
}
""".replace("CUT_OFF", CUT_OFF).replace("OUTPUTS", OUTPUTS)


class FrontStore:
    """`PieceStore` of the slopes of patches, a layer each; `max_bytes` is for their meshes, too."""

    def __init__(self, context: Any, *, max_bytes: int) -> None:
        self._context, self._max_bytes = context, max_bytes
        self.layers: Any = None  # the first patch gives their size
        self.layer_of: dict[int, int] = {}
        self.max_blocks, self._room = 1, 0
        self.side = 0

    @property
    def n_bytes(self) -> int:
        layers = 0 if self.layers is None else self.layers.n_bytes
        return layers + self._room * len(self.layer_of)

    def put(self, node: int, built: FrontPatch) -> bool:
        """Upload slopes; return False if there is no room."""
        if self.layers is None:
            self._allocate(built)
        layer = None if len(self.layer_of) == self.max_blocks else self.layers.take()
        if layer is None:
            return False
        # The ring around a patch repeats its border.
        content = np.pad(built.slopes, ((1, 2), (1, 2), (0, 0)), mode="edge")
        self.layers.write(layer, [content])
        self.layer_of[node] = layer
        return True

    def _allocate(self, built: FrontPatch) -> None:
        """Divide the memory between layers and the rest."""
        self.side, self._room = built.side, built.room
        layer = (built.side + RING) ** 2 * SLOPES.n_bytes
        n_patches = self._max_bytes // (layer + built.room)
        self.layers = LayeredTextures(
            self._context, built.side + RING, [SLOPES], max_bytes=n_patches * layer
        )
        self.max_blocks = self.layers.max_layers

    def drop(self, node: int) -> None:
        self.layers.give_back(self.layer_of.pop(node))

    def release(self) -> None:
        release_all(self.layers)


class FrontSurface(Surface):
    """`Surface` of one mesh."""

    n_clip_distances = 4

    def __init__(self, context: Any, *, max_bytes: int) -> None:
        super().__init__(context, FrontStore(context, max_bytes=max_bytes), _VERTEX_SHADER)
        self._vertices = context.buffer(reserve=_FIRST_BYTES, dynamic=True)
        self._triangles = context.buffer(reserve=_FIRST_BYTES, dynamic=True)
        self._array: Any = None

    def submit(self, scene: Scene, view: View, frames: Frames) -> int:
        mode: Any = scene.mode
        drawn = mode.drawn
        if drawn is None or not len(drawn.triangles):
            return 0
        vertices = np.empty(len(drawn.vertices), dtype=VERTEX)
        vertices["place"] = drawn.vertices - view.camera.eye
        vertices["about"][:, 1], vertices["about"][:, 3] = drawn.sizes, drawn.depths
        starts = mode.first_vertices
        for k, (node, patch) in enumerate(zip(frames.nodes.tolist(), mode.shown, strict=True)):
            part = vertices[starts[k] : starts[k + 1]]
            places = patch.places(drawn.vertices[starts[k] : starts[k + 1]])
            stride = scene.terrain.grid.stride(patch.piece.level)
            part["sample"] = places
            part["grid"] = np.add(places, (patch.region.col, patch.region.row)) * stride
            part["about"][:, 0] = self.store.layer_of[node]
            part["about"][:, 2] = patch.error
        self._upload(vertices.tobytes(), drawn.triangles.astype("<u4").tobytes())
        set_uniforms(self.program, {"slopes": _SLOPES, "side": float(self.store.side)})
        self.store.layers.textures[0].use(_SLOPES)
        self._array.render(moderngl.TRIANGLES, vertices=int(drawn.triangles.size))
        return 1

    def _upload(self, vertices: bytes, triangles: bytes) -> None:
        if self._array is None or max(len(vertices), len(triangles)) > self._vertices.size:
            release_all(self._array)
            size = max(self._vertices.size, 2 * len(vertices), 2 * len(triangles))
            self._vertices.orphan(size)
            self._triangles.orphan(size)
            self._array = self._context.vertex_array(
                self.program,
                [(
                    self._vertices, "3f4 2f4 2f4 4f4", "in_place", "in_sample", "in_grid",
                    "in_about",
                )],
                index_buffer=self._triangles, index_element_size=4,
            )  # fmt: skip
        self._vertices.write(vertices)
        self._triangles.write(triangles)
