"""Text, scale bar and north arrow over the picture, drawn with Pillow into one texture."""

import math
from functools import partial
from typing import Any, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.place.meaning import RADIUS
from terrainwave.render.gpu.surface import program_of, release_all
from terrainwave.render.look.marks import FONT_SIZE, WHITE, Ink, pillow
from terrainwave.render.scene.camera import Camera, Viewport, project
from terrainwave.render.scene.measure import Profile, distance_text

LINE_COLOR = (255, 214, 64, 255)
_GRAPH, _MARGIN = (420, 130), 18
_LETTER = 7  # pixels, approximately
_LEAST_FONT = 8
_LINE_WIDTH, _DOT = 3.0, 7.0  # pixels

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

_LINE_VERTEX = """
#version 330 core
in vec2 in_place;
void main() { gl_Position = vec4(in_place, 0.0, 1.0); }
"""
_LINE_FRAGMENT = """
#version 330 core
uniform vec4 color;
out vec4 fragment;
void main() { fragment = color; }
"""


def line_triangles(pixels: NDArray[np.float64], viewport: Viewport) -> NDArray[np.float32]:
    """Return triangles of a line through pixels (y down), and of a dot at each end.

    NaN, behind the eye, is a gap in the line. The
    corners, float32 (m, 2) in OpenGL's coordinates, are three per triangle.
    """
    known = pixels[~np.isnan(pixels).any(axis=1)]
    if not len(known):
        return np.empty((0, 2), dtype=np.float32)
    starts, ends = pixels[:-1], pixels[1:]
    is_here = ~np.isnan(starts).any(axis=1) & ~np.isnan(ends).any(axis=1)
    starts, ends = starts[is_here], ends[is_here]
    along = ends - starts
    along /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]]) * (_LINE_WIDTH / 2)
    quads = [(starts - across, starts + across, ends - across, ends + across)]
    tips = known[[0, -1]]
    sides = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)]) * (_DOT / 2)
    quads.append((tips + sides[0], tips + sides[1], tips + sides[2], tips + sides[3]))
    corners = np.concatenate(
        [np.stack([a, b, c, c, b, d], axis=1).reshape(-1, 2) for a, b, c, d in quads]
    )
    shown = corners / (viewport.width / 2, -viewport.height / 2) + (-1.0, 1.0)
    return shown.astype(np.float32)


def shortened(line: str, most: int) -> str:
    return line if len(line) <= most else line[: most - 1] + "…"


def draw_overlay(
    viewport: Viewport,
    camera: Camera,
    lines: list[str],
    metres_per_pixel: float | None,
    help_lines: list[tuple[str, str]] | None = None,
    profile: Profile | None = None,
) -> NDArray[np.uint8]:
    """Return the overlay, uint8 (height, width, 4).

    `metres_per_pixel` is that of the middle of the picture; None omits the scale bar.
    """
    image = pillow("Image").new("RGBA", (viewport.width, viewport.height), (0, 0, 0, 0))
    ink = Ink(image)
    draw, font = ink.draw, ink.font
    if lines:
        most = max((viewport.width - 100) // _LETTER, 20)
        ink.text(12, 10, "\n".join(map(partial(shortened, most=most), lines)))
    if metres_per_pixel is not None and metres_per_pixel > 0:
        ink.scale_bar(metres_per_pixel)
    _draw_arrow(draw, viewport, camera, font)
    if profile is not None:
        _draw_profile(ink, profile)
    if help_lines is not None:
        _draw_help(draw, viewport, help_lines)
    return np.asarray(image)


class Change(NamedTuple):
    """An image and the rows in which it differs from the previous one."""

    image: NDArray[np.uint8]  # shape (height, width, 4)
    first_row: int
    n_rows: int
    data: bytes  # of these rows


def change_of(before: NDArray[np.uint8] | None, image: NDArray[np.uint8]) -> Change:
    """Return the data to send to the GPU if it has the image `before`; None sends everything."""
    first, end = 0, image.shape[0]
    if before is not None and before.shape == image.shape:
        differs = np.flatnonzero((before.view(np.uint32) != image.view(np.uint32)).any(axis=(1, 2)))
        first, end = (int(differs[0]), int(differs[-1]) + 1) if len(differs) else (0, 0)
    return Change(image, first, end - first, image[first:end].tobytes())


def _draw_profile(ink: Ink, profile: Profile) -> None:
    """Draw heights over distances at the lower left, with the ends of both axes."""
    width = min(_GRAPH[0], ink.image.width - 2 * _MARGIN)
    height = min(_GRAPH[1], ink.image.height // 3)
    left, top = _MARGIN + 58, ink.image.height - _MARGIN - height
    ink.draw.rectangle(
        (_MARGIN - 8, top - 14, left + width + 10, ink.image.height - 4), fill=(0, 0, 0, 170)
    )
    upwards = profile.upwards
    known = upwards[~np.isnan(upwards)]
    if not len(known):
        ink.text(left, top, "no data")
        return
    low, high = float(known.min()), float(known.max())
    span, length = max(high - low, 1e-9), max(profile.horizontal, 1e-9)
    x = left + profile.distances / length * (width - 1)
    y = top + (1 - (upwards - low) / span) * (height - 24)
    is_gap = np.isnan(y)
    for first in np.flatnonzero(~is_gap & np.concatenate([[True], is_gap[:-1]])).tolist():
        gaps = np.flatnonzero(is_gap[first:])
        end = first + int(gaps[0]) if len(gaps) else len(y)
        places = list(zip(x[first:end].tolist(), y[first:end].tolist(), strict=True))
        ink.draw.line(places if len(places) > 1 else places * 2, fill=LINE_COLOR, width=2)
    sign = math.copysign(1, profile.metres_per_height)
    digits = 9 if profile.word == RADIUS else 6
    for value, at in ((high, top), (low, top + height - 24)):
        text = f"{sign * value:.{digits}g}"
        ink.draw.text((left - 8, at), text, font=ink.font, fill=WHITE, anchor="rm")
    for text, at, anchor in (("0", left, "lt"), (distance_text(length), left + width, "rt")):
        place = (at, top + height - 16)
        ink.draw.text(place, text, font=ink.font, fill=WHITE, anchor=anchor)


def _draw_help(draw: Any, viewport: Viewport, lines: list[tuple[str, str]]) -> None:
    """Draw two columns in the middle, in smaller letters if they would not fit."""
    gap = 24
    for size in range(FONT_SIZE, _LEAST_FONT - 1, -1):
        font = pillow("ImageFont").load_default(size)
        widths = [max(draw.textlength(line[k], font=font) for line in lines) for k in (0, 1)]
        width, pitch = widths[0] + gap + widths[1], 1.45 * size
        height = pitch * len(lines)
        if width + 32 <= viewport.width and height + 24 <= viewport.height:
            break
    x, y = (viewport.width - width) / 2, (viewport.height - height) / 2
    draw.rectangle((x - 16, y - 12, x + width + 16, y + height + 10), fill=(0, 0, 0, 170))
    for number, (key, meaning) in enumerate(lines):
        draw.text((x, y + pitch * number), key, font=font, fill=(255, 222, 140, 255))
        draw.text((x + widths[0] + gap, y + pitch * number), meaning, font=font, fill=WHITE)


def _draw_arrow(draw: Any, viewport: Viewport, camera: Camera, font: Any) -> None:
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
        self._program = program_of(context, _VERTEX, _FRAGMENT)
        self._array = context.vertex_array(self._program, [])
        self._texture: Any = None
        self._line_program = program_of(context, _LINE_VERTEX, _LINE_FRAGMENT)

    def draw_line(self, points: NDArray[np.float64], camera: Camera, viewport: Viewport) -> None:
        corners = line_triangles(project(camera, viewport, points)[:, :2], viewport)
        if not len(corners):
            return
        buffer = self._context.buffer(corners.tobytes())
        array = self._context.vertex_array(self._line_program, [(buffer, "2f", "in_place")])
        self._line_program["color"] = tuple(value / 255 for value in LINE_COLOR)
        self._context.enable_only(moderngl.NOTHING)
        array.render(moderngl.TRIANGLES)
        release_all(array, buffer)

    def set(self, change: Change) -> None:
        """Set another image; only the changed rows are uploaded."""
        height, width, _ = change.image.shape
        size = width, height
        if self._texture is None or self._texture.size != size:
            release_all(self._texture)
            self._texture = self._context.texture(size, 4, alignment=4)
            self._texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        if change.n_rows:
            self._texture.write(change.data, (0, change.first_row, width, change.n_rows))

    def draw(self) -> None:
        if self._texture is None:
            return
        self._context.enable_only(moderngl.BLEND)
        self._context.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        self._texture.use(0)
        self._array.render(moderngl.TRIANGLE_STRIP, vertices=4)

    def release(self) -> None:
        release_all(self._texture, self._array, self._program, self._line_program)
