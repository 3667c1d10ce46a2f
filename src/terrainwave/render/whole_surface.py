"""One mesh on the GPU, uploaded each frame; one texture of slopes for the whole raster."""

from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from terrainwave.errors import LimitExceededError
from terrainwave.render.selection import View
from terrainwave.render.shaders import TERRAIN_FRAGMENT
from terrainwave.render.surface import OWN_UNIT, release_all, set_uniforms

if TYPE_CHECKING:
    from terrainwave.render.modes.mode import Frames
    from terrainwave.render.modes.whole import Samples
    from terrainwave.render.scene import Scene

_SLOPES = OWN_UNIT
_FIRST_BYTES = 1 << 20
_TEXEL_BYTES = 8
# The fragment shader reads slopes beside a sample: a ring of texels, and one more to be even.
_RING = 3

VERTEX = np.dtype([("place", "<f4", 3), ("grid", "<f4", 2), ("size", "<f4")])

_VERTEX_SHADER = """
#version 330 core
in vec3 in_place;           // relative to the eye
in vec2 in_grid;            // column and row of the level in memory
in float in_size;
uniform mat4 view_projection;
uniform float stride;
uniform float error;
out vec3 v_seen;
out vec2 v_sample;
flat out ivec2 v_layers;
out vec2 v_grid;            // column, row of the full grid
flat out vec4 v_parent;     // unused, unused, size, error
void main() {
    v_seen = in_place;
    v_sample = in_grid;
    v_layers = ivec2(0, -1);
    v_grid = in_grid * stride;
    v_parent = vec4(0.0, 0.0, in_size, error);
    gl_Position = view_projection * vec4(in_place, 1.0);
}
"""


class WholeStore:
    """A `Store` of the slopes of one raster, which come at once or in parts.

    Parameters
    ----------
    max_blocks : int
        Parts whose heights the mode may hold at a time; slopes of all of them stay.
    """

    def __init__(self, context: Any, *, max_bytes: int, max_blocks: int = 1) -> None:
        self._context, self._max_bytes = context, max_bytes
        self.max_blocks = max_blocks
        self._nodes: set[int] = set()
        self.slopes: Any = None
        self.side = 0

    @property
    def n_bytes(self) -> int:
        """Return the bytes of the texture."""
        return 0 if self.slopes is None else self.slopes.width * self.slopes.height * _TEXEL_BYTES

    def put(self, node: int, built: Any) -> bool:
        """Upload slopes; the first time, of all the raster."""
        if len(self._nodes) == self.max_blocks:
            return False
        self._nodes.add(node)
        samples: Samples = built.samples
        if self.slopes is None:
            self._allocate(max(samples.slopes.shape[:2]))
        # The ring around the raster repeats its border; parts write over each other's.
        content = np.pad(samples.slopes, ((1, 1), (1, 1), (0, 0)), mode="edge")
        n_rows, n_cols = content.shape[:2]
        place = samples.region.col, samples.region.row, 0, n_cols, n_rows, 1
        self.slopes.write(content.tobytes(), viewport=place)
        return True

    def _allocate(self, side: int) -> None:
        size = side + _RING
        limit = int(self._context.info["GL_MAX_TEXTURE_SIZE"])
        if size > limit or size * size * _TEXEL_BYTES > self._max_bytes:
            raise LimitExceededError(
                f"a raster of {side} samples a side does not fit the memory allowed for pictures;"
                " --mode adaptive needs less"
            )
        self.side = side
        self.slopes = self._context.texture_array((size, size, 1), 3, dtype="f2", alignment=1)
        self.slopes.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self.slopes.repeat_x = self.slopes.repeat_y = False

    def drop(self, node: int) -> None:
        """Make room for another part; slopes stay."""
        self._nodes.remove(node)

    def release(self) -> None:
        """Free the GPU's memory."""
        if self.slopes is not None:
            self.slopes.release()


class WholeSurface:
    """A `Surface` of one mesh.

    Parameters
    ----------
    context : moderngl.Context
        OpenGL 3.3 core or newer.
    max_blocks : int
        See `WholeStore`.
    """

    n_clip_distances = 0

    def __init__(self, context: Any, *, max_bytes: int, max_blocks: int = 1) -> None:
        self._context = context
        self.store = WholeStore(context, max_bytes=max_bytes, max_blocks=max_blocks)
        self.program = context.program(
            vertex_shader=_VERTEX_SHADER.strip(), fragment_shader=TERRAIN_FRAGMENT.strip()
        )
        self._vertices = context.buffer(reserve=_FIRST_BYTES, dynamic=True)
        self._triangles = context.buffer(reserve=_FIRST_BYTES, dynamic=True)
        self._array: Any = None

    def submit(self, scene: "Scene", view: View, frames: "Frames") -> int:
        """Upload and draw the mesh of the frame."""
        n = self.prepare(scene, view, self.program)
        if not n:
            return 0
        self._array.render(moderngl.TRIANGLES, vertices=n)
        return 1

    def prepare(self, scene: "Scene", view: View, program: Any) -> int:
        """Fill buffers, textures and uniforms; return how many corners triangles have."""
        mode: Any = scene.mode
        drawn = mode.drawn
        if drawn is None or not len(drawn.triangles):
            return 0
        vertices = np.empty(len(drawn.vertices), dtype=VERTEX)
        vertices["place"] = drawn.vertices - view.camera.eye
        vertices["grid"] = mode.grid_places(drawn.vertices)
        vertices["size"] = drawn.sizes
        self._upload(vertices.tobytes(), drawn.triangles.astype("<u4").tobytes())
        set_uniforms(
            program,
            {
                "slopes": _SLOPES, "side": float(self.store.side), "stride": float(mode.stride),
                "error": mode.base_error,
            },
        )  # fmt: skip
        self.store.slopes.use(_SLOPES)
        return int(drawn.triangles.size)

    def _upload(self, vertices: bytes, triangles: bytes) -> None:
        """Fill the buffers, with larger ones where they are too small."""
        if self._array is None or max(len(vertices), len(triangles)) > self._vertices.size:
            if self._array is not None:
                self._array.release()
            size = max(self._vertices.size, 2 * len(vertices), 2 * len(triangles))
            self._vertices.orphan(size)
            self._triangles.orphan(size)
            self._array = self._context.vertex_array(
                self.program,
                [(self._vertices, "3f4 2f4 1f4", "in_place", "in_grid", "in_size")],
                index_buffer=self._triangles, index_element_size=4,
            )  # fmt: skip
        self._vertices.write(vertices)
        self._triangles.write(triangles)

    def release(self) -> None:
        """Free the GPU's memory."""
        release_all(self._array, self._vertices, self._triangles, self.program, self.store)
