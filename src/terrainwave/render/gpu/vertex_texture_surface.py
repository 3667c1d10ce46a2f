"""Full grids whose vertices a shader moves to their roots (Yusov & Turlapov 2008)."""

from collections.abc import Callable
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render.gpu.block_surface import cells_of
from terrainwave.render.gpu.front_surface import CUT_OFF, FrontStore
from terrainwave.render.gpu.shaders import OUTPUTS
from terrainwave.render.gpu.surface import OWN_UNIT, Surface, release_all, set_uniforms
from terrainwave.render.modes.front import FrontPatch, eye_of
from terrainwave.render.modes.mode import Frames
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.selection import View
from terrainwave.tri.dynamic.dynamic import DynamicMesh
from terrainwave.tri.dynamic.haar import FIRST, HIGH, LOW, N_COLS, N_ROWS, HaarTree
from terrainwave.tri.followed import Eye, Followed

_SLOPES, _HEIGHTS, _BOUNDS, _MARKS = OWN_UNIT, OWN_UNIT + 1, OWN_UNIT + 2, OWN_UNIT + 3
_VOID = np.float32(-1e38)
_SKIRT = 1 << 15
Grid = tuple[NDArray[np.uint16], NDArray[np.uint32]]

VERTEX_SHADER = """
#version 330 core
in uvec2 in_place;              // column and row in a tree; the column's top bit marks skirts
in vec4 in_tree;                // its first sample relative to the eye (x, y); column, row
uniform vec2 lead;              // columns and rows of samples before those of the patch
uniform sampler2D heights;      // level h: nodes of height h
uniform sampler2D bounds;       // level h - 1: error, low, high
uniform sampler2D marks;        // level h - 1: 0 above roots
uniform int top;
uniform vec2 threshold;         // τ / λ, τ
uniform vec4 level_axes;        // metres per sample of the level: x by col, x by row, y ...
uniform float z_scale, eye_z, stride, base_error, reach, focal, slant;
uniform float layer, skirt;     // of slopes; metres
uniform vec2 first_grid;        // column and row of the full grid
uniform float first_size;       // log2 of the share of a sample
uniform bool is_bound;
uniform vec3 forward;
uniform vec4 planes[5];
out float gl_ClipDistance[5];
CUT_OFF
OUTPUTS

vec2 across(vec2 place) {
    return in_tree.xy + vec2(dot(level_axes.xy, place), dot(level_axes.zw, place));
}

// As `tri.dynamic.dynamic.screen_error`; all places are relative to the eye.
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
    float size = length(vec3(extent.xy, 2.0 * extent.z));
    if (!is_bound) {
        if (b.x < 0.0) return focal * size / distance;
        float z = texelFetch(heights, node, h).r * z_scale - eye_z;
        float flat_way = length(away.xy);
        return focal * b.x * z_scale * flat_way / max(length(vec2(flat_way, z)), distance)
            / distance;
    }
    vec3 far = abs(away) + extent;
    float depth = max(dot(forward, away) - dot(abs(forward), extent), distance / slant);
    float scale = focal * min(length(far) / depth, slant) / depth;
    float base = base_error * z_scale;
    if (b.x < 0.0) return scale * (size + base);
    return scale * (b.x * z_scale + base) * length(far.xy) / length(vec3(far.xy, near.z));
}

void main() {
    bool is_skirt = in_place.x >= 32768u;
    ivec2 place = ivec2(in_place) - ivec2(is_skirt ? 32768 : 0, 0);
    ivec2 first = ivec2(in_tree.zw), size = textureSize(heights, 0);
    ivec2 at = first + place;
    bool is_void = any(greaterThanEqual(at, size));
    at = min(at, size - 1);
    place = at - first;
    vec3 drawn = vec3(0.0);     // column and row in the tree, height
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
    v_below = is_skirt ? 1.0 : 0.0;
    v_seen.z -= is_skirt ? skirt_depth(v_seen, skirt) : 0.0;
    v_sample = drawn.xy + vec2(first) - lead;
    v_layer = layer;
    v_grid = v_sample * stride + first_grid;
    v_about = vec2(float(h) + first_size, base_error);
    // A triangle with a void corner shrinks to a point.
    gl_ClipDistance[0] = is_void ? -1e9 : 1.0;
    cut_off(1, v_grid);
    gl_Position = view_projection * vec4(v_seen, 1.0);
}
""".replace("CUT_OFF", CUT_OFF).replace("OUTPUTS", OUTPUTS)


def tree_grid(side: int) -> Grid:
    """Return vertices (column, row) and triangles of a tree's quads, cut like the full grid."""
    rows, cols = np.divmod(np.arange((side + 1) ** 2), side + 1)
    # The last corner of a triangle gives its colour.
    return np.column_stack([cols, rows]).astype(np.uint16), cells_of(side + 1)[:, [0, 2, 1]]


def skirt_grid(shape: tuple[int, int]) -> Grid:
    """Return vertices (column, row) and triangles of skirts below the sides of a raster."""
    (n_rows, n_cols), places, triangles = shape, [], []
    rows, cols = np.arange(n_rows), np.arange(n_cols)
    none, last = (0 * cols, 0 * rows), (0 * cols + n_rows - 1, 0 * rows + n_cols - 1)
    lines = (cols, none[0]), (none[1], rows), (cols, last[0]), (last[1], rows)
    n_before = 0
    for places_along in lines:
        line = np.column_stack(places_along)
        n = len(line)
        places += [line, np.add(line, (_SKIRT, 0))]
        a, c = np.arange(n - 1) + n_before, np.arange(n - 1) + n_before + n
        triangles += [np.column_stack([a, a + 1, c]), np.column_stack([a + 1, c + 1, c])]
        n_before += 2 * n
    return np.concatenate(places).astype(np.uint16), np.concatenate(triangles).astype(np.uint32)


class TreeTextures:
    """The tree of a patch as textures whose levels are its heights."""

    def __init__(self, context: Any, mesh: DynamicMesh) -> None:
        tree = mesh.tree
        z = np.where(np.isnan(tree.z), _VOID, tree.z)
        self._mesh = mesh
        self.heights = _levels(context, tree, z, 0, 1)
        self.bounds = _levels(context, tree, tree.bounds, 1, 3)
        self.marks = _levels(context, tree, mesh.marks, 1, 1, "f1")

    def send_marks(self) -> None:
        mesh = self._mesh
        tree_rows = np.flatnonzero(mesh.has_changed.any(axis=1))
        if not len(tree_rows):
            return
        layout = mesh.tree.layout
        for height in range(1, len(layout)):
            first, _, n_cols = (int(n) for n in layout[height])
            side = 1 << (mesh.tree.top - height)
            start, end = int(tree_rows[0]) * side, (int(tree_rows[-1]) + 1) * side
            self.marks.write(
                mesh.marks[first + start * n_cols : first + end * n_cols],
                viewport=(0, start, n_cols, end - start), level=height - 1,
            )  # fmt: skip
        mesh.has_changed[...] = False

    def release(self) -> None:
        release_all(self.heights, self.bounds, self.marks)


def _levels(
    context: Any,
    tree: HaarTree,
    values: NDArray[np.generic],
    lowest: int,
    n_components: int,
    dtype: str = "f4",
) -> Any:
    """Return a texture whose levels are the nodes of heights from `lowest`."""
    layout = tree.layout
    n_rows, n_cols = (int(n) for n in layout[lowest, N_ROWS:])
    texture = context.texture((n_cols, n_rows), n_components, dtype=dtype, alignment=1)
    texture.build_mipmaps()
    texture.filter = (moderngl.NEAREST_MIPMAP_NEAREST, moderngl.NEAREST)
    for height in range(lowest, tree.top + 1):
        start = int(layout[height, FIRST]) - (len(tree.z) - len(values))
        end = start + int(layout[height, N_ROWS] * layout[height, N_COLS])
        texture.write(np.ascontiguousarray(values[start:end]).tobytes(), level=height - lowest)
    return texture


class TreeStore(FrontStore):
    """`PieceStore` of slopes, and of trees as textures."""

    def __init__(self, context: Any, *, max_bytes: int) -> None:
        super().__init__(context, max_bytes=max_bytes)
        self.trees: dict[int, TreeTextures] = {}

    def put(self, node: int, built: FrontPatch) -> bool:
        if not super().put(node, built):
            return False
        if built.mesh is not None:
            self.trees[node] = TreeTextures(self._context, built.mesh)
        return True

    def drop(self, node: int) -> None:
        super().drop(node)
        release_all(self.trees.pop(node, None))

    def release(self) -> None:
        super().release()
        release_all(*self.trees.values())


class VertexTextureSurface(Surface):
    """`Surface` of full grids."""

    n_clip_distances = 5

    def __init__(self, context: Any, *, max_bytes: int) -> None:
        super().__init__(context, TreeStore(context, max_bytes=max_bytes), VERTEX_SHADER)
        self.trees = context.buffer(reserve=16)
        # Vertices, triangles and both together, of trees by their side and of skirts.
        self.grids: dict[Any, tuple[Any, ...]] = {}

    def submit(self, scene: Scene, view: View, frames: Frames) -> int:
        """Upload changes, and draw the grids of all trees in view, patch by patch."""
        mode: Any = scene.mode
        eye, n_calls = eye_of(view), 0
        for node, patch, followed, depth in zip(
            frames.nodes.tolist(), mode.shown, mode.followed, frames.skirts.tolist(), strict=True
        ):
            n = self.prepare(scene, node, patch, followed, eye, self.program)
            if not n:
                continue
            set_uniforms(self.program, {"skirt": depth})
            self._draw_grid(tree_grid, 1 << patch.mesh.tree.top, n=n)
            self._fill_trees(np.zeros((1, 2), dtype=np.int64), patch, eye)
            self._draw_grid(skirt_grid, patch.mesh.shape, n=1)
            n_calls += 2
        return n_calls

    def _draw_grid(self, make: Callable[..., Grid], *arguments: Any, n: int) -> None:
        if arguments not in self.grids:
            places, triangles = (self._context.buffer(part.tobytes()) for part in make(*arguments))
            array = self._context.vertex_array(
                self.program,
                [(places, "2u2", "in_place"), (self.trees, "4f4/i", "in_tree")],
                index_buffer=triangles, index_element_size=4,
            )  # fmt: skip
            self.grids[arguments] = places, triangles, array
        self.grids[arguments][-1].render(moderngl.TRIANGLES, instances=n)

    def prepare(
        self,
        scene: Scene,
        node: int,
        patch: FrontPatch,
        followed: Followed,
        eye: Eye,
        program: Any,
    ) -> int:
        """Fill buffers, textures and uniforms for a patch; return the number of trees in view."""
        mesh: DynamicMesh = patch.mesh
        trees = _trees_in_view(mesh.tree, mesh.matrix, eye)
        if not len(trees):
            return 0
        self._fill_trees(trees, patch, eye)
        textures = self.store.trees[node]
        textures.send_marks()
        a, b, _, d, e, _ = patch.matrix
        stride = scene.terrain.grid.stride(patch.piece.level)
        planes = eye.planes.copy()
        planes[:, 3] += planes[:, :3] @ eye.position
        values = {
            "slopes": _SLOPES, "heights": _HEIGHTS, "bounds": _BOUNDS, "marks": _MARKS,
            "side": float(self.store.side), "top": mesh.tree.top, "stride": float(stride),
            "layer": float(self.store.layer_of[node]),
            "first_grid": (float(patch.region.col * stride), float(patch.region.row * stride)),
            "first_size": float(stride.bit_length() - 1),
            "threshold": (followed.threshold, followed.tau), "level_axes": (a, b, d, e),
            "eye_z": float(eye.position[2]), "base_error": mesh.base_error,
            "reach": mesh.tree.reach, "focal": eye.focal, "slant": eye.slant,
            "is_bound": scene.mode.error == "measured", "forward": tuple(eye.forward),
            "planes": [tuple(plane) for plane in planes.tolist()], "z_scale": eye.z_scale,
            "lead": patch.lead[::-1],
        }  # fmt: skip
        set_uniforms(program, values)
        for unit, texture in (
            (_SLOPES, self.store.layers.textures[0]), (_HEIGHTS, textures.heights),
            (_BOUNDS, textures.bounds), (_MARKS, textures.marks),
        ):  # fmt: skip
            texture.use(unit)
        return len(trees)

    def _fill_trees(self, trees: NDArray[np.int64], patch: FrontPatch, eye: Eye) -> None:
        a, b, c, d, e, f = patch.mesh.matrix
        rows, cols = (trees << patch.mesh.tree.top).T
        places = np.column_stack([a * cols + b * rows + c, d * cols + e * rows + f])
        content = np.column_stack([places - eye.position[:2], cols, rows]).astype("<f4")
        if content.nbytes > self.trees.size:
            self.trees.orphan(content.nbytes)
        self.trees.write(content.tobytes())

    def release(self) -> None:
        super().release()
        release_all(*(part for parts in self.grids.values() for part in reversed(parts)))


def _trees_in_view(tree: HaarTree, matrix: tuple[float, ...], eye: Eye) -> NDArray[np.int64]:
    """Return rows and columns of trees whose boxes are not behind a plane, shape (n, 2)."""
    n_rows, n_cols = (int(n) for n in tree.layout[-1, N_ROWS:])
    bounds, side = tree.bounds[-n_rows * n_cols :].astype(np.float64), 1 << tree.top
    rows, cols = np.divmod(np.arange(n_rows * n_cols), n_cols)
    mid_rows, mid_cols = ((places + 0.5) * side - 0.5 for places in (rows, cols))
    a, b, c, d, e, f = matrix
    middle = np.column_stack(
        [a * mid_cols + b * mid_rows + c, d * mid_cols + e * mid_rows + f,
         (bounds[:, LOW] + bounds[:, HIGH]) / 2 * eye.z_scale]
    )  # fmt: skip
    extent = np.empty_like(middle)
    extent[:, 0], extent[:, 1] = (abs(a) + abs(b)) * side, (abs(d) + abs(e)) * side
    extent[:, 2] = (bounds[:, HIGH] - bounds[:, LOW]) / 2 * eye.z_scale
    planes = eye.planes
    most = middle @ planes[:, :3].T + planes[:, 3] + extent @ np.abs(planes[:, :3]).T
    is_seen = (most >= 0).all(axis=1)
    return np.column_stack([rows, cols])[is_seen]
