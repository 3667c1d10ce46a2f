"""Walls, floor and lids on the GPU."""

from typing import Any

import moderngl

from terrainwave.render.gpu import shaders
from terrainwave.render.gpu.surface import program_of, release_all, set_uniforms
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.selection import View
from terrainwave.render.scene.walls import LID, Solid

# Pixels from stripe to stripe in a picture of 853 lines.
_HATCH, _HATCH_LINES = 11.0, 853.0
_LEAST_HATCH = 5.0
_BEHIND = (1.0, 4.0)


class SolidSurface:
    """Draws a `Solid` after the terrain, which it never hides from above."""

    def __init__(self, context: Any, solid: Solid) -> None:
        self._context = context
        self._program = program_of(context, shaders.SOLID_VERTEX, shaders.SOLID_FRAGMENT)
        self._vertices = context.buffer(solid.vertices.tobytes())
        self._indices = context.buffer(solid.triangles.tobytes())
        # Lids come last.
        self._n_lid = 3 * int((solid.vertices["kind"][solid.triangles[:, 0]] == LID).sum())
        self._n_block = solid.triangles.size - self._n_lid
        self._array = context.vertex_array(
            self._program,
            [(self._vertices, "2f 1f 1f 2f", "in_place", "in_height", "in_kind", "in_normal")],
            index_buffer=self._indices,
            index_element_size=4,
        )

    def draw(self, frame: Frame, view: View, uniforms: dict[str, Any]) -> None:
        """Draw into the framebuffer in use; `uniforms` are those that the terrain has too."""
        eye = view.camera.eye
        x, y = frame.sample_matrix[2], frame.sample_matrix[5]
        own = {
            "origin": (x - eye[0], y - eye[1], -eye[2]),
            "depth": float(frame.box[0][2]) - frame.base,
            "hatch": max(_HATCH * view.viewport.height / _HATCH_LINES, _LEAST_HATCH),
        }
        set_uniforms(self._program, uniforms | own)
        self._context.enable_only(moderngl.DEPTH_TEST)
        self._array.render(moderngl.TRIANGLES, vertices=self._n_block)
        if self._n_lid:
            self._context.polygon_offset = _BEHIND  # the terrain wins where both are
            self._array.render(moderngl.TRIANGLES, first=self._n_block, vertices=self._n_lid)
            self._context.polygon_offset = 0.0, 0.0

    def release(self) -> None:
        release_all(self._array, self._vertices, self._indices, self._program)
