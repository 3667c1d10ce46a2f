"""Finer part of an orthophoto near the camera.

The whole photo is one texture, within the GPU's limit of texels. A second texture of a square near
the camera follows it; it is read in the background.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from terrainwave.render.paging.background import Background, Outcome
from terrainwave.render.scene.camera import Camera
from terrainwave.render.scene.frame import Frame

if TYPE_CHECKING:
    from terrainwave.raster_io.drape import Drape, Photo

DETAIL_SIDE = 2048  # texels
# In heights above the ground: the square's side, and the largest distance of its middle ahead.
_SIDE, _AHEAD = 6.0, 2.0
_LEAST_HEIGHT = 20.0  # metres
# Largest move of the middle, as a share of the side; largest factor by which the square's size may
# change.
_MOVED, _SCALED = 0.15, 1.5
_WORTH = 1.3


class Square(NamedTuple):
    """A square of the ground: its middle in local metres, half its side."""

    x: float
    y: float
    half: float


def square_near(camera: Camera, height: float, least: float = 0.0) -> Square:
    """Return the square near a camera at this height above the ground.

    `least` is its smallest side, in metres.
    """
    height = max(abs(height), _LEAST_HEIGHT)
    down = max(-math.sin(math.radians(camera.pitch)), 0.0)
    level = math.cos(math.radians(camera.pitch))
    ahead = height * min(level / down if down else math.inf, _AHEAD)
    heading = math.radians(camera.heading)
    x, y, _ = camera.position
    half = max(_SIDE * height, least) / 2
    return Square(x + ahead * math.sin(heading), y + ahead * math.cos(heading), half)


def is_near(one: Square, other: Square) -> bool:
    moved = max(abs(one.x - other.x), abs(one.y - other.y))
    scale = one.half / other.half
    return moved < 2 * _MOVED * one.half and 1 / _SCALED < scale < _SCALED


def place_of_square(
    square: Square, frame: Frame, within: tuple[float, float, float, float]
) -> tuple[float, float, float, float] | None:
    """Return column, row, columns and rows of the full grid that a square covers within others.

    None if it covers nothing.
    """
    a, b, c, d, e, f = frame.sample_matrix
    corners = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)]) * square.half
    xy = corners + np.array([square.x - c, square.y - f])
    cols, rows = np.linalg.solve(np.array([[a, b], [d, e]]), xy.T) + 0.5  # corners of pixels
    first_col, first_row = max(cols.min(), within[0]), max(rows.min(), within[1])
    end_col = min(cols.max(), within[0] + within[2])
    end_row = min(rows.max(), within[1] + within[3])
    if end_col - first_col <= 1 or end_row - first_row <= 1:
        return None
    return (
        float(first_col), float(first_row), float(end_col - first_col), float(end_row - first_row)
    )  # fmt: skip


class DrapeDetail:
    """Reads the finer part as the camera moves. Used by one thread, which never waits."""

    def __init__(
        self,
        photo: "Photo",
        texels_per_pixel: float,  # of the whole photo, in its texture
        background: Background,
        # called with each part that was read, in the thread that draws
        show: Callable[["Drape"], None],
    ) -> None:
        self._photo, self._coarse = photo, texels_per_pixel
        self._background, self._show = background, show
        self._square: Square | None = None
        self._is_reading = False
        self.problem: str | None = None

    def _least(self, frame: Frame) -> float:
        """Return the side, in metres, that the texture covers at the photo's own resolution."""
        a, b, _, d, e, _ = frame.sample_matrix
        return DETAIL_SIDE / self._photo.finer * min(math.hypot(a, d), math.hypot(b, e))

    def tick(self, camera: Camera, height: float | None, frame: Frame) -> None:
        """Start reading another part if the camera has left the last one."""
        if height is None or self._is_reading:
            return
        square = square_near(camera, height, self._least(frame))
        if self._square is not None and is_near(self._square, square):
            return
        self._square = square
        place = place_of_square(square, frame, self._photo.place)
        if place is None:
            return
        finer = min(self._photo.finer, DETAIL_SIDE / max(place[2:]))
        if finer < _WORTH * self._coarse:
            return
        size = max(round(place[2] * finer), 1), max(round(place[3] * finer), 1)
        self._is_reading = True

        def take(outcome: Outcome) -> None:
            self._is_reading, self.problem = False, outcome.problem
            if outcome.problem is None:
                self._show(outcome.value)

        photo = self._photo
        self._background.start(lambda: photo.part(place, size), take)
