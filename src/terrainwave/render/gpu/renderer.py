"""Draws a scene; shared by `render` and `view`."""

import math
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.raster_io.drape import Drape
from terrainwave.render.gpu import shaders
from terrainwave.render.gpu.solid_surface import SolidSurface
from terrainwave.render.gpu.surface import (
    DETAIL_UNIT,
    DRAPE_UNIT,
    RAMP_UNIT,
    WATER_UNIT,
    Surface,
    picture_of,
    program_of,
    release_all,
    set_uniforms,
)
from terrainwave.render.look.colorings import AUTO, NO_SEA
from terrainwave.render.look.ramps import (
    Palette,
    absolute_palette,
    error_palette,
    relative_palette,
    slope_palette,
)
from terrainwave.render.look.style import COLORINGS, Style
from terrainwave.render.look.water import EVERYWHERE, NOWHERE, Water, waves_of
from terrainwave.render.modes.mode import Frames
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import projection_matrix, slant, view_matrix
from terrainwave.render.scene.scales import HeightTexels
from terrainwave.render.scene.selection import View
from terrainwave.render.scene.walls import Solid, distance_to_walls, haze_of

_CLIP_DISTANCE_0 = 0x3000
_NEAREST = 1e-5  # of the farthest distance
_GROUND_REACH = 0.38  # of the terrain's diagonal


class _DrapeTexture:
    """A drape on the GPU; one transparent texel without a drape."""

    def __init__(self, context: Any, drape: Drape | None) -> None:
        self.is_there, self.place = drape is not None, (0.0, 0.0, 1.0, 1.0)
        pixels = np.zeros((1, 1, 4), dtype=np.uint8)
        if drape is not None:
            pixels = drape.pixels
            self.place = (drape.col, drape.row, 1 / drape.n_cols, 1 / drape.n_rows)
        self.texture = picture_of(context, pixels, moderngl.LINEAR)
        self.texture.build_mipmaps()
        self.texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self.release = self.texture.release


class _WaterTexture:
    """Water mask on the GPU."""

    def __init__(self, context: Any, water: Water) -> None:
        n_rows, n_cols = water.cells.shape
        self.lowest = water.lowest
        self.place = (float(water.stride), 1 / n_cols, 1 / n_rows)
        self.texture = picture_of(context, water.cells[..., None], moderngl.NEAREST)
        self.release = self.texture.release


class Renderer:
    """Draws frames of a scene into the framebuffer in use."""

    _HORIZON = (0.80, 0.86, 0.91)
    _ZENITH = (0.30, 0.50, 0.74)

    def __init__(
        self,
        context: Any,  # OpenGL 3.3 core or newer
        scene: Scene,
        surface: Surface,  # draws the scene's pieces; released with the renderer
        drape: Drape | None = None,  # picture to drape over the terrain
        solid: Solid | None = None,  # the block under it
        water: Water | None = None,  # where it shows water; by default everywhere at and below 0
    ) -> None:
        self._context = context
        self._scene = scene
        self.surface = surface
        self._sky = program_of(context, shaders.SKY_VERTEX, shaders.SKY_FRAGMENT)
        self._sky_array = context.vertex_array(self._sky, [])
        self._solid = None if solid is None else SolidSurface(context, solid)
        self._texels = HeightTexels.of(scene.frame)
        self._ramp: Any = None
        self._ramp_key: tuple[object, ...] = ()
        self._drape, self._detail = _DrapeTexture(context, drape), _DrapeTexture(context, None)
        self._found, self._everywhere, self._nowhere = (
            _WaterTexture(context, one) for one in (water or EVERYWHERE, EVERYWHERE, NOWHERE)
        )
        self.n_draw_calls = 0

    def set_drape(self, drape: Drape) -> None:
        self._drape.release()
        self._drape = _DrapeTexture(self._context, drape)

    def set_detail(self, drape: Drape) -> None:
        self._detail.release()
        self._detail = _DrapeTexture(self._context, drape)

    def set_water(self, water: Water) -> None:
        self._found.release()
        self._found = _WaterTexture(self._context, water)

    def _water(self, style: Style) -> _WaterTexture:
        if style.sea_level == AUTO:
            return self._found
        return self._nowhere if style.sea_level == NO_SEA else self._everywhere

    def _ramp_texture(self, key: tuple[object, ...], palette: Palette) -> Any:
        if key != self._ramp_key:
            release_all(self._ramp)
            self._ramp = picture_of(self._context, palette.colors, moderngl.LINEAR)
            self._ramp_key = key
        return self._ramp

    def palette(self, frames: Frames, style: Style) -> Palette:
        if style.coloring == "slope":
            return slope_palette()
        if style.coloring == "error":
            errors = self._scene.table.errors[frames.nodes]
            return error_palette(max(float(errors.max(initial=0.0)), 1e-6))
        frame = self._scene.frame
        low, high = frame.height_range
        if not style.is_absolute(frame.body):
            return relative_palette(style.ramp_on(frame.body), low, high)
        sea = waves_of(self._scene.terrain, frame)
        water_from = self._water(style).lowest(sea)
        if not isinstance(style.sea_level, str):
            sea += style.sea_level * frame.metres[2]
        return absolute_palette(low, high, sea, frame.latitudes, water_from)

    def set_solid(self, solid: Solid) -> None:
        release_all(self._solid)
        self._solid = SolidSurface(self._context, solid)

    def clear(self, view: View, style: Style) -> None:
        """Begin a picture with the sky or the background."""
        background = style.background or (0, 0, 0)
        self._context.clear(*(value / 255 for value in background), 1.0, depth=1.0)
        if style.background is None:
            self._draw_sky(view, style)

    def draw(self, view: View, frames: Frames, style: Style) -> None:
        self.clear(view, style)
        self.draw_terrain(view, frames, style)
        self.draw_solid(view, frames, style)

    def draw_terrain(
        self, view: View, frames: Frames, style: Style, matrix: NDArray[np.float64] | None = None
    ) -> None:
        """Draw the terrain, or a part of it, into a picture that has begun.

        `matrix` projects positions relative to the eye, 4 x 4; by default it is the view's. The
        meshes are those of the view in any case.
        """
        context = self._context
        self.n_draw_calls = 0
        if not len(frames.nodes):
            return
        values = self._shared_uniforms(view, frames, style)
        palette = self.palette(frames, style)
        own = self._terrain_uniforms(view, palette, style)
        own["skirt_reach"] = self._scene.skirt_reach(view, frames)
        if matrix is not None:
            own["view_projection"] = tuple(matrix.T.ravel())
        set_uniforms(self.surface.program, values | own)
        # The range of errors changes from frame to frame, their colours do not.
        key = (style.coloring, style.ramp, style.sea_level)
        self._ramp_texture(key, palette).use(RAMP_UNIT)
        self._drape.texture.use(DRAPE_UNIT)
        self._detail.texture.use(DETAIL_UNIT)
        self._water(style).texture.use(WATER_UNIT)
        context.enable_only(moderngl.DEPTH_TEST)
        clips = range(_CLIP_DISTANCE_0, _CLIP_DISTANCE_0 + self.surface.n_clip_distances)
        for clip in clips:
            context.enable_direct(clip)
        context.wireframe = style.wireframe
        self.n_draw_calls = self.surface.submit(self._scene, view, frames)
        context.wireframe = False
        for clip in clips:
            context.disable_direct(clip)

    def draw_solid(self, view: View, frames: Frames, style: Style) -> None:
        if self._solid is not None and style.draws_solid:
            values = self._shared_uniforms(view, frames, style)
            self._solid.draw(self._scene.frame, view, values)

    def depth_range(self, view: View, frames: Frames) -> tuple[float, float]:
        frame, eye = self._scene.frame, view.camera.eye
        low, high = frame.solid_box
        corners = np.maximum(np.abs(low - eye), np.abs(high - eye))
        far = max(float(np.linalg.norm(corners)) * 1.01, 1.0)
        nearest = float(frames.distances.min(initial=far))
        if self._solid is not None:
            nearest = min(nearest, distance_to_walls(frame, eye))
        # Depth is less than distance, most of all in the corners.
        nearest /= slant(view.camera, view.viewport)
        return max(nearest * 0.9, far * _NEAREST), far

    def _shared_uniforms(self, view: View, frames: Frames, style: Style) -> dict[str, Any]:
        near, far = self.depth_range(view, frames)
        matrix = projection_matrix(view.camera, view.viewport, near, far)
        matrix = matrix @ view_matrix(view.camera)
        a, b, _, d, e, _ = self._scene.frame.sample_matrix
        start, density = haze_of(self._scene.frame, view.camera.eye, style.haze)
        background = style.background
        color = self._HORIZON if background is None else tuple(part / 255 for part in background)
        return {
            "view_projection": tuple(matrix.T.ravel()),
            "sample_axes": (a, b, d, e),
            "z_scale": view.exaggeration,
            "sun": style.sun_vector,
            "haze": (*color, density),
            "haze_start": start,
            "shade": style.shade,
            "base": self._scene.frame.base - float(view.camera.eye[2]),
        }

    def _terrain_uniforms(self, view: View, palette: Palette, style: Style) -> dict[str, Any]:
        scene = self._scene
        low, high = scene.frame.box
        northwards = 1 / max(float(high[1] - low[1]), 1.0)
        return {
            "ramp_range": palette.ranges,
            "height_texels": (self._texels.reference, self._texels.scale),
            "northwards": (float(view.camera.eye[1] - low[1]) * northwards, northwards),
            "coloring": COLORINGS[style.coloring],
            "ramp": RAMP_UNIT,
            "water": WATER_UNIT,
            "water_place": self._water(style).place,
            "drape": DRAPE_UNIT,
            "drape_place": self._drape.place,
            "drape_share": style.drape if self._drape.is_there else 0.0,
            "detail": DETAIL_UNIT,
            "detail_place": self._detail.place,
            "detail_share": 1.0 if self._detail.is_there else 0.0,
            "last": (scene.frame.shape[1] - 1.0, scene.frame.shape[0] - 1.0),
        }

    def _draw_sky(self, view: View, style: Style) -> None:
        frame = self._scene.frame
        low, high = frame.box
        a, b, _, d, e, _ = frame.sample_matrix
        extent = float(np.linalg.norm((high - low)[:2]))
        tangent = math.tan(math.radians(view.camera.fov) / 2)
        values = {
            "axes": tuple(view.camera.axes.ravel()),
            "tangents": (tangent * view.viewport.aspect, tangent),
            "zenith": self._ZENITH,
            "horizon": self._HORIZON,
            "sun": style.sun_vector,
            "eye": view.camera.position,
            "base": frame.base,
            "middle": tuple((low + high)[:2] / 2),
            "first": (frame.sample_matrix[2], frame.sample_matrix[5]),
            "sample_steps": (a, d, b, e),
            "last": (frame.shape[1] - 1.0, frame.shape[0] - 1.0),
            "extent": extent,
            "reach": _GROUND_REACH * extent,
            "has_ground": self._solid is not None and style.draws_solid,
        }
        set_uniforms(self._sky, values)
        self._context.enable_only(moderngl.NOTHING)
        self._sky_array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        release_all(self.surface, self._solid, self._ramp, self._drape, self._detail)
        release_all(self._found, self._everywhere, self._nowhere)
        release_all(self._sky_array, self._sky)
