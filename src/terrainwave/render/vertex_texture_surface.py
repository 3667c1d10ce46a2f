"""Full grids whose vertices a shader moves to their roots (Yusov & Turlapov 2008)."""

from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import LimitExceededError
from terrainwave.render.modes.dynamic import PATCH
from terrainwave.render.modes.whole import eye_of
from terrainwave.render.selection import View
from terrainwave.render.shaders import TERRAIN_FRAGMENT
from terrainwave.render.surface import OWN_UNIT, release_all, set_uniforms
from terrainwave.render.whole_surface import WholeStore
from terrainwave.tri.dynamic import DynamicMesh
from terrainwave.tri.haar import FIRST, HIGH, LOW, N_COLS, N_ROWS, HaarTree

if TYPE_CHECKING:
    from terrainwave.render.modes.mode import Frames
    from terrainwave.render.modes.whole import BuiltSamples
    from terrainwave.render.scene import Scene

_SLOPES, _HEIGHTS, _BOUNDS, _MARKS = OWN_UNIT, OWN_UNIT + 1, OWN_UNIT + 2, OWN_UNIT + 3
_VOID = np.float32(-1e38)
_BYTES_PER_SAMPLE = 10  # heights 16/3, bounds 4, marks 1/3

VERTEX_SHADER = """
#version 330 core
in uvec2 in_place;              // column and row in a patch
in vec4 in_patch;               // its first sample relative to the eye (x, y); column, row
uniform sampler2D heights;      // level h: nodes of height h
uniform sampler2D bounds;       // level h - 1: error, low, high
uniform sampler2D marks;        // level h - 1: 0 above roots
uniform int top;
uniform vec2 threshold;         // τ / λ, τ
uniform vec4 level_axes;        // metres per sample of the level: x by col, x by row, y ...
uniform mat4 view_projection;
uniform float z_scale, eye_z, stride, base_error, reach, focal, slant;
uniform bool is_bound;
uniform vec3 forward;
uniform vec4 planes[5];
out vec3 v_seen;
out vec2 v_sample;
flat out ivec2 v_layers;
out vec2 v_grid;
flat out vec4 v_parent;
out float gl_ClipDistance[1];

vec2 across(vec2 place) {
    return in_patch.xy + vec2(dot(level_axes.xy, place), dot(level_axes.zw, place));
}

// As `tri.dynamic.screen_error`; all places are relative to the eye.
float screen_error(int h, ivec2 node, vec2 middle) {
    vec3 b = texelFetch(bounds, node, h - 1).xyz;
    float low = b.y * z_scale - eye_z, high = b.z * z_scale - eye_z;
    vec3 away = vec3(across(middle), (low + high) / 2.0);
    float side = float(1 << h) * reach;
    vec3 extent = vec3(abs(level_axes.xz) + abs(level_axes.yw), 0.0) * side;
    extent.z = (high - low) / 2.0;
    for (int k = 0; k < 5; ++k) {
        float beyond = is_bound ? dot(abs(planes[k].xyz), extent) : length(extent);
        if (dot(planes[k].xyz, away) + planes[k].w + beyond < 0.0) return 0.0;
    }
    vec3 near = max(abs(away) - extent, vec3(0.0));
    float distance = length(near);
    if (distance == 0.0) return 1e30;
    if (!is_bound) {
        float z = texelFetch(heights, node, h).r * z_scale - eye_z;
        float flat_way = length(away.xy);
        return focal * b.x * z_scale * flat_way / max(length(vec2(flat_way, z)), distance)
            / distance;
    }
    vec3 far = abs(away) + extent;
    float depth = max(dot(forward, away) - dot(abs(forward), extent), distance / slant);
    float scale = focal * min(length(far) / depth, slant) / depth;
    float base = base_error * z_scale;
    if (b.x < 0.0) return scale * (length(vec3(extent.xy, 2.0 * extent.z)) + base);
    return scale * (b.x * z_scale + base) * length(far.xy) / length(vec3(far.xy, near.z));
}

void main() {
    ivec2 place = ivec2(in_place), first = ivec2(in_patch.zw), size = textureSize(heights, 0);
    ivec2 at = first + place;
    bool is_void = any(greaterThanEqual(at, size));
    at = min(at, size - 1);
    place = at - first;
    vec3 drawn = vec3(0.0);     // column and row in the patch, height
    float share = 1.0;
    int h = top;
    for (; h >= 0; --h) {
        vec2 middle = (vec2(place >> h) + 0.5) * float(1 << h) - 0.5;
        vec3 own = vec3(middle, texelFetch(heights, at >> h, h).r);
        drawn = mix(drawn, own, share);
        if (h == 0 || texelFetch(marks, at >> h, h - 1).r > 0.0) {
            is_void = is_void || own.z < -1e37;
            break;
        }
        share = 1.0;
        if (threshold.y > threshold.x) {
            float error = screen_error(h, at >> h, middle);
            share = clamp((error - threshold.x) / (threshold.y - threshold.x), 0.0, 1.0);
        }
    }
    if (is_void) drawn.z = 0.0;
    v_seen = vec3(across(drawn.xy), drawn.z * z_scale - eye_z);
    v_sample = drawn.xy + vec2(first);
    v_layers = ivec2(0, -1);
    v_grid = v_sample * stride;
    v_parent = vec4(0.0, 0.0, float(h), base_error);
    // A triangle with a void corner shrinks to nothing beside the others.
    gl_ClipDistance[0] = is_void ? -1e9 : 1.0;
    gl_Position = view_projection * vec4(v_seen, 1.0);
}
"""


def patch_grid(side: int) -> tuple[NDArray[np.uint16], NDArray[np.uint32]]:
    """Return vertices (column, row) and triangles of the quads of a patch, cut as the full grid."""
    rows, cols = np.divmod(np.arange((side + 1) ** 2), side + 1)
    numbers = np.arange((side + 1) ** 2, dtype=np.uint32).reshape(side + 1, side + 1)
    a, b = numbers[:-1, :-1].ravel(), numbers[:-1, 1:].ravel()
    d, c = numbers[1:, :-1].ravel(), numbers[1:, 1:].ravel()
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return np.column_stack([cols, rows]).astype(np.uint16), triangles


class TreeStore(WholeStore):
    """A `Store` of slopes, and of a tree as textures."""

    def __init__(self, context: Any, *, max_bytes: int) -> None:
        super().__init__(context, max_bytes=max_bytes)
        self.textures: list[Any] = []

    @property
    def n_bytes(self) -> int:
        """Return the bytes of all textures."""
        n_samples = 0 if not self.textures else self.textures[0].width * self.textures[0].height
        return super().n_bytes + _BYTES_PER_SAMPLE * n_samples

    def put(self, node: int, built: "BuiltSamples") -> bool:
        """Upload slopes and nodes."""
        super().put(node, built)
        if not isinstance(built.mesh, DynamicMesh):
            raise AssertionError("the mode builds a tree")
        tree = built.mesh.tree
        shapes = tree.layout[:, N_ROWS:]
        n_rows, n_cols = (int(n) for n in shapes[0])
        limit = int(self._context.info["GL_MAX_TEXTURE_SIZE"])
        n_bytes = super().n_bytes + _BYTES_PER_SAMPLE * n_rows * n_cols
        if max(n_rows, n_cols) > limit or n_bytes > self._max_bytes:
            raise LimitExceededError(
                f"textures of {n_rows} x {n_cols} nodes do not fit the memory allowed for pictures;"
                " --mode dynamic needs less"
            )
        z = np.where(np.isnan(tree.z), _VOID, tree.z)
        self.textures = [
            self._levels(tree, z, 0, 1),
            self._levels(tree, tree.bounds, 1, 3),
            self._levels(tree, built.mesh.marks, 1, 1, "f1"),
        ]
        return True

    def send_marks(self, mesh: DynamicMesh) -> None:
        """Bring the auxiliary texture up to date: the rows of patches whose marks have changed."""
        patch_rows = np.flatnonzero(mesh.has_changed.any(axis=1))
        if not len(patch_rows):
            return
        layout = mesh.tree.layout
        for height in range(1, len(layout)):
            first, _, n_cols = (int(n) for n in layout[height])
            side = 1 << (mesh.tree.top - height)
            start, end = int(patch_rows[0]) * side, (int(patch_rows[-1]) + 1) * side
            self.textures[2].write(
                mesh.marks[first + start * n_cols : first + end * n_cols],
                viewport=(0, start, n_cols, end - start), level=height - 1,
            )  # fmt: skip
        mesh.has_changed[...] = False

    def _levels(
        self,
        tree: HaarTree,
        values: NDArray[np.generic],
        lowest: int,
        n_components: int,
        dtype: str = "f4",
    ) -> Any:
        """Return a texture whose levels are the nodes of heights from `lowest`."""
        layout = tree.layout
        n_rows, n_cols = (int(n) for n in layout[lowest, N_ROWS:])
        texture = self._context.texture((n_cols, n_rows), n_components, dtype=dtype, alignment=1)
        texture.build_mipmaps()
        texture.filter = (moderngl.NEAREST_MIPMAP_NEAREST, moderngl.NEAREST)
        for height in range(lowest, tree.top + 1):
            start = int(layout[height, FIRST]) - (len(tree.z) - len(values))
            end = start + int(layout[height, N_ROWS] * layout[height, N_COLS])
            texture.write(np.ascontiguousarray(values[start:end]).tobytes(), level=height - lowest)
        return texture

    def release(self) -> None:
        """Free the GPU's memory."""
        super().release()
        for texture in self.textures:
            texture.release()


class VertexTextureSurface:
    """A `Surface` of full grids.

    Parameters
    ----------
    context : moderngl.Context
        OpenGL 3.3 core or newer.
    """

    n_clip_distances = 1

    def __init__(self, context: Any, *, max_bytes: int) -> None:
        self._context = context
        self.store = TreeStore(context, max_bytes=max_bytes)
        self.program = context.program(
            vertex_shader=VERTEX_SHADER.strip(), fragment_shader=TERRAIN_FRAGMENT.strip()
        )
        places, triangles = patch_grid(PATCH)
        self.places = context.buffer(places.tobytes())
        self._triangles = context.buffer(triangles.tobytes())
        self.patches = context.buffer(reserve=16)
        self._array: Any = None

    def submit(self, scene: "Scene", view: View, frames: "Frames") -> int:
        """Upload what has changed, and draw the grids of all patches in view."""
        n = self.prepare(scene, view, self.program)
        if not n:
            return 0
        if self._array is None:
            self._array = self._context.vertex_array(
                self.program,
                [(self.places, "2u2", "in_place"), (self.patches, "4f4/i", "in_patch")],
                index_buffer=self._triangles, index_element_size=4,
            )  # fmt: skip
        self._array.render(moderngl.TRIANGLES, instances=n)
        return 1

    def prepare(self, scene: "Scene", view: View, program: Any) -> int:
        """Fill buffers, textures and uniforms; return how many patches are in view."""
        mode: Any = scene.mode
        followed = mode.followed
        if followed is None:
            return 0
        mesh, eye, matrix = mode.dynamic_mesh, eye_of(view), mode.sample_matrix
        patches = _patches_in_view(mesh.tree, matrix, view)
        if not len(patches):
            return 0
        self._fill_patches(patches, matrix, view)
        self.store.send_marks(mesh)
        heights, bounds, marks = self.store.textures
        a, b, _, d, e, _ = matrix
        planes = eye.planes.copy()
        planes[:, 3] += planes[:, :3] @ eye.position
        values = {
            "slopes": _SLOPES, "heights": _HEIGHTS, "bounds": _BOUNDS, "marks": _MARKS,
            "side": float(self.store.side), "top": mesh.tree.top, "stride": float(mode.stride),
            "threshold": (followed.threshold, followed.tau), "level_axes": (a, b, d, e),
            "eye_z": float(eye.position[2]), "base_error": mesh.base_error,
            "reach": mesh.tree.reach, "focal": eye.focal, "slant": eye.slant,
            "is_bound": mode.error == "measured", "forward": tuple(eye.forward),
            "planes": [tuple(plane) for plane in planes.tolist()], "z_scale": view.exaggeration,
        }  # fmt: skip
        set_uniforms(program, values)
        for unit, texture in (
            (_SLOPES, self.store.slopes), (_HEIGHTS, heights), (_BOUNDS, bounds), (_MARKS, marks)
        ):  # fmt: skip
            texture.use(unit)
        return len(patches)

    def _fill_patches(
        self, patches: NDArray[np.int64], matrix: tuple[float, ...], view: View
    ) -> None:
        a, b, c, d, e, f = matrix
        rows, cols = (patches * PATCH).T
        places = np.column_stack([a * cols + b * rows + c, d * cols + e * rows + f])
        content = np.column_stack([places - view.camera.eye[:2], cols, rows]).astype("<f4")
        if content.nbytes > self.patches.size:
            self.patches.orphan(content.nbytes)
        self.patches.write(content.tobytes())

    def release(self) -> None:
        """Free the GPU's memory."""
        release_all(
            self._array, self.places, self._triangles, self.patches, self.program, self.store
        )  # fmt: skip


def _patches_in_view(tree: HaarTree, matrix: tuple[float, ...], view: View) -> NDArray[np.int64]:
    """Return rows and columns of patches whose boxes are not behind a plane, shape (n, 2)."""
    n_rows, n_cols = (int(n) for n in tree.layout[-1, N_ROWS:])
    bounds = tree.bounds[-n_rows * n_cols :].astype(np.float64)
    rows, cols = np.divmod(np.arange(n_rows * n_cols), n_cols)
    mid_rows, mid_cols = ((places + 0.5) * PATCH - 0.5 for places in (rows, cols))
    a, b, c, d, e, f = matrix
    middle = np.column_stack(
        [a * mid_cols + b * mid_rows + c, d * mid_cols + e * mid_rows + f,
         (bounds[:, LOW] + bounds[:, HIGH]) / 2 * view.exaggeration]
    )  # fmt: skip
    extent = np.empty_like(middle)
    extent[:, 0], extent[:, 1] = (abs(a) + abs(b)) * PATCH, (abs(d) + abs(e)) * PATCH
    extent[:, 2] = (bounds[:, HIGH] - bounds[:, LOW]) / 2 * view.exaggeration
    planes = view.planes
    most = middle @ planes[:, :3].T + planes[:, 3] + extent @ np.abs(planes[:, :3]).T
    is_seen = (most >= 0).all(axis=1)
    return np.column_stack([rows, cols])[is_seen]
