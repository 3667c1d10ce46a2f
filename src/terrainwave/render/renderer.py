"""Draws a scene; shared by `render` and `view`."""

import math
from typing import Any

import moderngl
import numpy as np

from terrainwave.raster_io.drape import Drape
from terrainwave.render import shaders
from terrainwave.render.camera import projection_matrix, slant, view_matrix
from terrainwave.render.modes.mode import Frames
from terrainwave.render.ramps import N_COLORS, ramp_colors
from terrainwave.render.scene import Scene
from terrainwave.render.selection import View
from terrainwave.render.style import COLORINGS, Style
from terrainwave.render.surface import (
    DRAPE_UNIT,
    RAMP_UNIT,
    Surface,
    release_all,
    set_uniforms,
)

_CLIP_DISTANCE_0 = 0x3000
_NEAREST = 1e-5  # of the farthest


class Renderer:
    """Draws frames of a scene into the framebuffer in use.

    Parameters
    ----------
    context : moderngl.Context
        OpenGL 3.3 core or newer.
    surface : Surface
        What draws the scene's pieces; released with the renderer.
    drape : Drape, optional
        A picture to lie on the terrain.
    """

    _HORIZON = (0.80, 0.86, 0.91)
    _ZENITH = (0.30, 0.50, 0.74)

    def __init__(
        self, context: Any, scene: Scene, surface: Surface, drape: Drape | None = None
    ) -> None:
        self._context = context
        self._scene = scene
        self.surface = surface
        self._sky = context.program(
            vertex_shader=shaders.SKY_VERTEX.strip(), fragment_shader=shaders.SKY_FRAGMENT.strip()
        )
        self._sky_array = context.vertex_array(self._sky, [])
        self._ramp: Any = None
        self._ramp_key: tuple[object, ...] = ()
        self._drape = self._drape_texture(drape)
        self._has_drape = drape is not None
        self._drape_place = (0.0, 0.0, 1.0, 1.0)
        if drape is not None:
            self._drape_place = (drape.col, drape.row, 1 / drape.n_cols, 1 / drape.n_rows)
        self.n_draw_calls = 0

    # Parts that last

    def _drape_texture(self, drape: Drape | None) -> Any:
        """Return the texture of the drape; one clear texel without one."""
        pixels = np.zeros((1, 1, 4), dtype=np.uint8) if drape is None else drape.pixels
        height, width = pixels.shape[:2]
        texture = self._context.texture((width, height), 4, pixels.tobytes(), alignment=4)
        texture.repeat_x = texture.repeat_y = False
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        return texture

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
        self.n_draw_calls = 0
        if not len(frames.nodes):
            return
        self._set_uniforms(view, frames, style)
        context.enable_only(moderngl.DEPTH_TEST)
        clips = range(_CLIP_DISTANCE_0, _CLIP_DISTANCE_0 + self.surface.n_clip_distances)
        for clip in clips:
            context.enable_direct(clip)
        context.wireframe = style.wireframe
        self.n_draw_calls = self.surface.submit(self._scene, view, frames)
        context.wireframe = False
        for clip in clips:
            context.disable_direct(clip)

    def depth_range(self, view: View, frames: Frames) -> tuple[float, float]:
        """Return near and far planes that hold all that is drawn."""
        low, high = self._scene.frame.box
        corners = np.maximum(np.abs(low - view.camera.eye), np.abs(high - view.camera.eye))
        far = max(float(np.linalg.norm(corners)) * 1.01, 1.0)
        # Depth is less than distance, most of all in the corners.
        nearest = float(frames.distances.min(initial=far)) / slant(view.camera, view.viewport)
        return max(nearest * 0.9, far * _NEAREST), far

    def _set_uniforms(self, view: View, frames: Frames, style: Style) -> None:
        scene = self._scene
        near, far = self.depth_range(view, frames)
        matrix = projection_matrix(view.camera, view.viewport, near, far)
        matrix = matrix @ view_matrix(view.camera)
        a, b, _, d, e, _ = scene.frame.sample_matrix
        values = {
            "view_projection": tuple(matrix.T.ravel()),
            "sample_axes": (a, b, d, e),
            "z_scale": view.exaggeration,
            "ramp_range": self._heights(),
            "sun": style.sun_vector,
            "haze": (*self._HORIZON, self._haze(view, style)),
            "coloring": COLORINGS[style.coloring],
            "shade": style.shade,
            "error_range": max(float(scene.table.errors[frames.nodes].max()), 1e-6),
            "ramp": RAMP_UNIT,
            "drape": DRAPE_UNIT,
            "drape_place": self._drape_place,
            "drape_share": style.drape if self._has_drape else 0.0,
            "last": (scene.frame.shape[1] - 1.0, scene.frame.shape[0] - 1.0),
        }
        set_uniforms(self.surface.program, values)
        self._ramp_texture(style).use(RAMP_UNIT)
        self._drape.use(DRAPE_UNIT)

    def _haze(self, view: View, style: Style) -> float:
        """Return the density of haze per metre: thick on the ground, thin from far above."""
        low, high = self._scene.frame.box
        # A flat raster of one sample has no size.
        extent = max(float(np.linalg.norm(high - low)), 1.0)
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
        set_uniforms(self._sky, values)
        self._context.enable_only(moderngl.NOTHING)
        self._sky_array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        """Free the GPU's memory."""
        release_all(self.surface, self._ramp, self._drape, self._sky_array, self._sky)
