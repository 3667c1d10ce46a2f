"""Text, scale bar and north arrow over the picture, drawn with Pillow into one texture."""

import math
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render.camera import Camera, Viewport
from terrainwave.render.marks import FONT_SIZE, WHITE, Ink
from terrainwave.render.surface import release_all

_VERTEX = """
#version 330 core
out vec2 v_place;
void main() {
    v_place = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1);
    gl_Position = vec4(v_place * 2.0 - 1.0, 0.0, 1.0);
}
"""
_FRAGMENT = """
#version 330 core
in vec2 v_place;
uniform sampler2D image;
out vec4 color;
void main() { color = texture(image, vec2(v_place.x, 1.0 - v_place.y)); }
"""


def draw_overlay(
    viewport: Viewport,
    camera: Camera,
    lines: list[str],
    metres_per_pixel: float | None,
    help_lines: list[tuple[str, str]] | None = None,
) -> NDArray[np.uint8]:
    """Return the overlay, uint8 (height, width, 4).

    `metres_per_pixel` is that of the middle of the picture; None leaves the scale bar out.
    """
    from PIL import Image

    image = Image.new("RGBA", (viewport.width, viewport.height), (0, 0, 0, 0))
    ink = Ink(image)
    draw, font = ink.draw, ink.font
    if lines:
        ink.text(12, 10, "\n".join(lines))
    if metres_per_pixel is not None and metres_per_pixel > 0:
        ink.scale_bar(metres_per_pixel)
    _draw_arrow(draw, viewport, camera, font)
    if help_lines is not None:
        _draw_help(draw, viewport, help_lines, font)
    return np.asarray(image)


def _draw_help(draw: Any, viewport: Viewport, lines: list[tuple[str, str]], font: Any) -> None:
    """Draw two columns in the middle."""
    widths = [max(draw.textlength(line[k], font=font) for line in lines) for k in (0, 1)]
    gap, pitch = 24, 1.45 * FONT_SIZE
    width, height = widths[0] + gap + widths[1], pitch * len(lines)
    x, y = (viewport.width - width) / 2, (viewport.height - height) / 2
    draw.rectangle((x - 16, y - 12, x + width + 16, y + height + 10), fill=(0, 0, 0, 170))
    for number, (key, meaning) in enumerate(lines):
        draw.text((x, y + pitch * number), key, font=font, fill=(255, 222, 140, 255))
        draw.text((x + widths[0] + gap, y + pitch * number), meaning, font=font, fill=WHITE)


def _draw_arrow(draw: Any, viewport: Viewport, camera: Camera, font: Any) -> None:
    """Draw where north is: up where the camera looks north."""
    angle = math.radians(-camera.heading)
    x, y, size = viewport.width - 44, 44, 26
    along = np.array([math.sin(angle), -math.cos(angle)])
    across = np.array([along[1], -along[0]])
    middle = np.array([x, y])
    tip, tail = middle + along * size, middle - along * size * 0.6
    for side, fill in ((1, (235, 70, 60, 255)), (-1, (250, 250, 250, 255))):
        corner = middle - along * size * 0.9 + across * side * size * 0.45
        draw.polygon([tuple(tip), tuple(tail), tuple(corner)], fill=fill, outline=(0, 0, 0, 160))
    at = middle + along * (size + 10)
    draw.text(tuple(at), "N", font=font, fill=WHITE, anchor="mm",
              stroke_width=2, stroke_fill=(0, 0, 0, 200))  # fmt: skip


class Overlay:
    """The overlay's texture on the GPU."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._program = context.program(
            vertex_shader=_VERTEX.strip(), fragment_shader=_FRAGMENT.strip()
        )
        self._array = context.vertex_array(self._program, [])
        self._texture: Any = None

    def set(self, image: NDArray[np.uint8]) -> None:
        """Take another image."""
        size = image.shape[1], image.shape[0]
        if self._texture is None or self._texture.size != size:
            if self._texture is not None:
                self._texture.release()
            self._texture = self._context.texture(size, 4, alignment=4)
            self._texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._texture.write(np.ascontiguousarray(image).tobytes())

    def draw(self) -> None:
        """Draw it into the framebuffer in use."""
        if self._texture is None:
            return
        self._context.enable_only(moderngl.BLEND)
        self._context.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        self._texture.use(0)
        self._array.render(moderngl.TRIANGLE_STRIP, vertices=4)

    def release(self) -> None:
        """Free the GPU's memory."""
        release_all(self._texture, self._array, self._program)
