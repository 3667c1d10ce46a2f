"""Overlays drawn with Pillow: text, a scale bar, a legend of the colours."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError
from terrainwave.extras import need
from terrainwave.place.units import unit_text
from terrainwave.render.look.ramps import N_LATITUDES, Palette
from terrainwave.render.look.style import Style
from terrainwave.render.scene.frame import Frame, round_length

WHITE, SHADE = (255, 255, 255, 255), (0, 0, 0, 130)
FONT_SIZE = 14
_LONGEST_BAR = 170  # pixels
_LEAST_SIZE = (240, 180)
# Legend: the bar's pixels, and the largest number of intervals between its labels.
_BAR_WIDTH, _BAR_HEIGHT, _MOST_INTERVALS = 16, 130, 6
_HATCH = ((204, 204, 201, 255), (153, 153, 153, 255))


def length_text(metres: float) -> str:
    """Return a length as people write it."""
    return f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"


class Legend(NamedTuple):
    """Meaning of a picture's colours."""

    title: str  # their quantity, and its unit
    # shape (n, 3); from the bar's lower end to its upper one: from the lowest value to the highest;
    # for depths the other way round
    colors: NDArray[np.uint8]
    labels: list[tuple[float, str]]  # positions from 0 (lower end) to 1, and the values there
    has_voids: bool  # explain the hatch


def check_marks(size: tuple[int, int], style: Style, *, legend: bool, scale_bar: bool) -> None:
    """Raise `InvalidArgumentError` for a legend without values, or too small a picture."""
    if legend and not style.has_legend:
        raise InvalidArgumentError(
            f"found `legend` with `coloring` {style.coloring}, expected one whose colours are"
            " heights, slopes or errors"
        )
    if (legend or scale_bar) and not all(
        side >= least for side, least in zip(size, _LEAST_SIZE, strict=True)
    ):
        raise InvalidArgumentError(
            f"found `size` {size[0]}x{size[1]}, expected at least {_LEAST_SIZE[0]}x"
            f"{_LEAST_SIZE[1]} for a legend or scale bar"
        )


def legend_of(
    style: Style, palette: Palette, frame: Frame, units: str | None, *, has_voids: bool
) -> Legend:
    """Return the legend of a picture's colours, those of the raster's middle latitude.

    The palette is in metres or, of slopes, degrees; `units` is the file's unit of heights.
    """
    per_unit = frame.metres[2]
    title = f"{'depth' if per_unit < 0 else 'height'}, {unit_text(units)}"
    low, high = (height - frame.zero for height in sorted(frame.heights))
    if style.coloring == "slope":
        per_unit, title = 1.0, "slope, degrees"
        _, _, low, high = palette.ranges
    elif style.coloring == "error":
        per_unit, title = frame.error_metres, f"error, {unit_text(units)}"
        low, high = (value / per_unit for value in palette.ranges[2:])
    shown = np.linspace(low, high, 2 * _BAR_HEIGHT) * per_unit
    colors = palette.color_of(shown, min(N_LATITUDES // 2, len(palette.colors) - 1))
    if not high > low:
        return Legend(title, colors, [(0.5, f"{low:g}")], has_voids)
    interval = round_length((high - low) / 2)
    while (high - low) / (interval / 2) <= _MOST_INTERVALS:
        interval = round_length(interval / 2)
    first, last = math.ceil(low / interval - 1e-9), math.floor(high / interval + 1e-9)
    ticks = [number * interval for number in range(first, last + 1)]
    labels = [((tick - low) / (high - low), f"{tick:.10g}") for tick in ticks]
    if per_unit < 0:  # the deepest is at the bottom
        colors, labels = colors[::-1], [(1 - share, text) for share, text in labels]
    return Legend(title, colors, labels, has_voids)


def pillow(module: str) -> Any:
    return need(f"PIL.{module}", extra="view", purpose="text in a picture")


class Ink:
    """Draws into an RGBA image of Pillow."""

    def __init__(self, image: Any) -> None:
        self.image, self.draw = image, pillow("ImageDraw").Draw(image)
        self.font = pillow("ImageFont").load_default(FONT_SIZE)

    def text(self, x: float, y: float, words: str) -> None:
        left, top, right, bottom = self.draw.multiline_textbbox((x, y), words, font=self.font)
        self.draw.rectangle((left - 6, top - 4, right + 6, bottom + 4), fill=SHADE)
        self.draw.multiline_text((x, y), words, font=self.font, fill=WHITE)

    def scale_bar(self, metres_per_pixel: float) -> None:
        metres = round_length(metres_per_pixel * _LONGEST_BAR)
        length = metres / metres_per_pixel
        x, y = self.image.width - 24 - length, self.image.height - 22
        self.text(x, y - 26, length_text(metres))
        self.draw.line((x, y, x + length, y), fill=(0, 0, 0, 200), width=6)
        self.draw.line((x + 1, y, x + length - 1, y), fill=WHITE, width=3)

    def legend(self, legend: Legend) -> None:
        """Draw a bar of colours with labels at the upper left, where initial views have sky."""
        pitch, bar = FONT_SIZE + 6, min(_BAR_HEIGHT, self.image.height - 90)
        words = [legend.title, *(text for _, text in legend.labels)]
        words += ["no data"] if legend.has_voids else []
        widths = [self.draw.textlength(word, font=self.font) for word in words]
        widest = max(widths[0], _BAR_WIDTH + 14 + max(widths[1:]))
        height = pitch + bar + (pitch + 8 if legend.has_voids else 0)
        x, y = 18.0, 20.0
        panel = (x - 8, y - 8, x + widest + 10, y + height + 10)
        self.draw.rectangle(panel, fill=SHADE)
        self.draw.text((x, y - 3), legend.title, font=self.font, fill=WHITE)
        top = int(y + pitch + 2)
        for line in range(bar):
            share = 1 - (line + 0.5) / bar
            color = legend.colors[int(share * len(legend.colors))]
            ends = (x, top + line, x + _BAR_WIDTH, top + line)
            self.draw.line(ends, fill=(*color.tolist(), 255))
        for share, text in legend.labels:
            at = top + (1 - share) * (bar - 1)
            self.draw.line((x + _BAR_WIDTH, at, x + _BAR_WIDTH + 5, at), fill=WHITE)
            place = (x + _BAR_WIDTH + 10, at)
            self.draw.text(place, text, font=self.font, fill=WHITE, anchor="lm")
        if legend.has_voids:
            self._hatch(int(x), top + bar + 10)

    def _hatch(self, x: int, y: int) -> None:
        side = _BAR_WIDTH - 2
        for row in range(side):
            for col in range(_BAR_WIDTH + 1):
                is_stripe = (col - row) % 8 < 3
                self.draw.point((x + col, y + row), fill=_HATCH[is_stripe])
        place = (x + _BAR_WIDTH + 10, y + side / 2)
        self.draw.text(place, "no data", font=self.font, fill=WHITE, anchor="lm")


def draw_marks(
    pixels: NDArray[np.uint8], *, legend: Legend | None, metres_per_pixel: float | None
) -> NDArray[np.uint8]:
    """Return a picture, uint8 (height, width, 3), with a legend and a scale bar; a copy."""
    images = pillow("Image")
    height, width, _ = pixels.shape
    over = images.new("RGBA", (width, height), (0, 0, 0, 0))
    ink = Ink(over)
    if legend is not None:
        ink.legend(legend)
    if metres_per_pixel is not None:
        ink.scale_bar(metres_per_pixel)
    picture = images.fromarray(pixels).convert("RGBA")
    return np.asarray(images.alpha_composite(picture, over).convert("RGB"))
