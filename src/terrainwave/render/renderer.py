"""Draws a scene; shared by `render` and `view`."""

import math
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render import shaders
from terrainwave.render.camera import projection_matrix, view_matrix
from terrainwave.render.mesh_buffers import COMMAND, GpuStore
from terrainwave.render.ramps import N_COLORS, ramp_colors
from terrainwave.render.scene import Frames, Scene
from terrainwave.render.selection import View
from terrainwave.render.style import COLORINGS, Style

_CLIP_DISTANCE_0 = 0x3000
_NEAREST = 1e-5  # of the farthest


class Renderer:
    """Draws frames of a scene into the framebuffer in use.

    Parameters
    ----------
    context : moderngl.Context
        OpenGL 3.3 core or newer.
    indirect : bool
        Draw all patches by one call where the driver can.
    """

    _HORIZON = (0.80, 0.86, 0.91)
    _ZENITH = (0.30, 0.50, 0.74)

    def __init__(
        self, context: Any, scene: Scene, store: GpuStore, *, indirect: bool = True
    ) -> None:
        self._context = context
        self._scene = scene
        self._store = store
        self.is_indirect = indirect and context.version_code >= 430
        defines = "#define INDIRECT" if self.is_indirect else ""
        self._program = context.program(
            vertex_shader=shaders.TERRAIN_VERTEX.strip().replace("//DEFINES", defines),
            fragment_shader=shaders.TERRAIN_FRAGMENT.strip(),
        )
        self._sky = context.program(
            vertex_shader=shaders.SKY_VERTEX.strip(), fragment_shader=shaders.SKY_FRAGMENT.strip()
        )
        self._sky_array = context.vertex_array(self._sky, [])
        self._instances: Any = None
        self._numbers: Any = None
        self._commands: Any = None
        self._array: Any = None
        self._generation = -1
        self._ramp: Any = None
        self._ramp_key: tuple[object, ...] = ()
        self.n_draw_calls = 0

    # Parts that last

    def _reach(self, n_patches: int) -> None:
        """Make room for the instances of `n_patches` and bind the buffers in use."""
        if self._instances is None or self._instances.size[1] < n_patches:
            for part in (self._instances, self._numbers, self._commands):
                if part is not None:
                    part.release()
            n = max(256, 1 << (n_patches - 1).bit_length())
            self._instances = self._context.texture((4, n), 4, dtype="f4")
            self._instances.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self._numbers = self._context.buffer(np.arange(n, dtype=np.int32).tobytes())
            self._commands = self._context.buffer(reserve=n * COMMAND.itemsize)
            self._generation = -1
        if self._generation != self._store.generation:
            content: list[Any] = [(self._store.vertex_buffer, "2u2 2f4", "in_place", "in_heights")]
            if self.is_indirect:
                content.append((self._numbers, "1i4/i", "in_instance"))
            if self._array is not None:
                self._array.release()
            self._array = self._context.vertex_array(
                self._program, content, index_buffer=self._store.index_buffer, index_element_size=4
            )
            self._generation = self._store.generation

    def _ramp_texture(self, style: Style) -> Any:
        low, high = self._heights()
        key = (style.ramp, low, high)
        if key != self._ramp_key:
            if self._ramp is not None:
                self._ramp.release()
            colors = ramp_colors(style.ramp, low, high)
            self._ramp = self._context.texture((N_COLORS, 1), 3, colors.tobytes(), alignment=1)
            self._ramp.repeat_x = self._ramp.repeat_y = False
            self._ramp_key = key
        return self._ramp

    def _heights(self) -> tuple[float, float]:
        low, high = (height * self._scene.frame.metres[2] for height in self._scene.frame.heights)
        return (low, high) if high > low else (low, low + 1.0)

    # One frame

    def instances(self, view: View, frames: Frames) -> NDArray[np.float32]:
        """Return the texels of the patches, float32 (n, 16): see `shaders`."""
        scene, table, nodes = self._scene, self._scene.table, frames.nodes
        grid, frame = scene.terrain.grid, scene.frame
        blocks = table.keys[nodes]
        strides = np.left_shift(1, grid.k_max - blocks[:, 0])
        rows, cols = blocks[:, 1] * grid.block * strides, blocks[:, 2] * grid.block * strides
        bases = scene.bases(nodes)
        origins = np.column_stack([frame.samples_to_local(rows, cols), bases * view.exaggeration])
        texels = np.empty((len(nodes), 16), dtype=np.float32)
        texels[:, 0:3] = origins - view.camera.eye
        texels[:, 3] = frames.morphs
        texels[:, 4] = frames.skirts
        texels[:, 5] = self._store.layers(nodes)
        texels[:, 6] = -1
        texels[:, 7] = strides
        texels[:, 8] = grid.n_cols - 1 - cols
        texels[:, 9] = grid.n_rows - 1 - rows
        texels[:, 10] = (blocks[:, 2] & 1) * grid.block
        texels[:, 11] = (blocks[:, 1] & 1) * grid.block
        texels[:, 12] = blocks[:, 0]
        texels[:, 13] = table.errors[nodes]
        texels[:, 14] = bases
        texels[:, 15] = 0
        return texels

    def clear(self, view: View, style: Style) -> None:
        """Begin a picture: the sky, or the background."""
        background = style.background or (0, 0, 0)
        self._context.clear(*(value / 255 for value in background), 1.0, depth=1.0)
        if style.background is None:
            self._draw_sky(view, style)

    def draw(self, view: View, frames: Frames, style: Style, *, clear: bool = True) -> None:
        """Draw one frame; `clear` begins with the sky or the background."""
        context = self._context
        if clear:
            self.clear(view, style)
        drawn = self._store.layers(frames.nodes) >= 0
        frames = frames._replace(
            nodes=frames.nodes[drawn],
            distances=frames.distances[drawn],
            morphs=frames.morphs[drawn],
            skirts=frames.skirts[drawn],
        )
        n = len(frames.nodes)
        self.n_draw_calls = 0
        if not n:
            return
        self._reach(n)
        self._instances.write(self.instances(view, frames).tobytes(), viewport=(0, 0, 4, n))
        self._set_uniforms(view, frames, style)
        context.enable_only(moderngl.DEPTH_TEST)
        context.enable_direct(_CLIP_DISTANCE_0)
        context.enable_direct(_CLIP_DISTANCE_0 + 1)
        context.wireframe = style.wireframe
        commands = self._store.commands(frames.nodes)
        if self.is_indirect:
            self._commands.write(commands.tobytes())
            self._array.render_indirect(self._commands, moderngl.TRIANGLES, count=n)
            self.n_draw_calls = 1
        else:
            for k, (count, _, first, _, _) in enumerate(commands.tolist()):
                self._program["in_instance"] = k
                self._array.render(moderngl.TRIANGLES, vertices=count, first=first)
            self.n_draw_calls = n
        context.wireframe = False
        context.disable_direct(_CLIP_DISTANCE_0)
        context.disable_direct(_CLIP_DISTANCE_0 + 1)

    def depth_range(self, view: View, frames: Frames) -> tuple[float, float]:
        """Return near and far planes that hold all that is drawn."""
        low, high = self._scene.frame.box
        corners = np.maximum(np.abs(low - view.camera.eye), np.abs(high - view.camera.eye))
        far = max(float(np.linalg.norm(corners)) * 1.01, 1.0)
        tangent = math.tan(math.radians(view.camera.fov) / 2)
        # Depth is less than distance, at most by this much, in the corners.
        slant = math.sqrt(1 + tangent**2 * (1 + view.viewport.aspect**2))
        nearest = float(frames.distances.min(initial=far))
        return max(nearest / slant * 0.9, far * _NEAREST), far

    def _set_uniforms(self, view: View, frames: Frames, style: Style) -> None:
        scene, program = self._scene, self._program
        near, far = self.depth_range(view, frames)
        matrix = projection_matrix(view.camera, view.viewport, near, far)
        matrix = matrix @ view_matrix(view.camera)
        a, b, _, d, e, _ = scene.frame.sample_matrix
        values = {
            "view_projection": tuple(matrix.T.ravel()),
            "sample_axes": (a, b, d, e),
            "z_scale": view.exaggeration,
            "side": float(scene.terrain.grid.block),
            "ramp_range": self._heights(),
            "sun": style.sun_vector,
            "haze": (*self._HORIZON, self._haze(view, style)),
            "coloring": COLORINGS[style.coloring],
            "shade": style.shade,
            "error_range": max(float(scene.table.errors[frames.nodes].max()), 1e-6),
            "slopes": 0,
            "ramp": 1,
            "instances": 2,
        }
        for name, value in values.items():
            if name in program:
                program[name] = value
        self._store.slopes.use(0)
        self._ramp_texture(style).use(1)
        self._instances.use(2)

    def _haze(self, view: View, style: Style) -> float:
        """Return the density of haze per metre: thick on the ground, thin from far above."""
        low, high = self._scene.frame.box
        extent = float(np.linalg.norm(high - low))
        above = max(float(view.camera.eye[2] - high[2]), 0.0)
        return 3.5 * style.haze / extent / (1 + 10 * above / extent)

    def _draw_sky(self, view: View, style: Style) -> None:
        tangent = math.tan(math.radians(view.camera.fov) / 2)
        values = {
            "axes": tuple(view.camera.axes.ravel()),
            "tangents": (tangent * view.viewport.aspect, tangent),
            "zenith": self._ZENITH,
            "horizon": self._HORIZON,
            "sun": style.sun_vector,
        }
        for name, value in values.items():
            if name in self._sky:
                self._sky[name] = value
        self._context.enable_only(moderngl.NOTHING)
        self._sky_array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        """Free the GPU's memory."""
        for part in (
            self._instances, self._numbers, self._commands, self._array, self._ramp,
            self._sky_array, self._sky, self._program,
        ):  # fmt: skip
            if part is not None:
                part.release()
