"""Height of a camera above the ground, without waiting for a read."""

import math
import time
from collections.abc import Callable

from terrainwave.file import TerrainFile
from terrainwave.render.paging.background import Background, Outcome
from terrainwave.render.scene.camera import Camera
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.selection import NodeTable

_SECONDS = 0.2  # between two reads of the ground


def level_here(table: NodeTable, x: float, y: float) -> int | None:
    """Return the finest level whose pieces are loaded at local x, y; None if none is."""
    found, waiting = None, table.roots.tolist()
    while waiting:
        node = waiting.pop()
        is_over = (table.low[node, :2] <= (x, y)).all() and (table.high[node, :2] >= (x, y)).all()
        if not (is_over and table.is_resident[node]):
            continue
        found = max(found or 0, table.pieces[node].level)
        waiting += [child for child in table.children[node].tolist() if child >= 0]
    return found


class Ground:
    """The ground under a moving camera.

    It is read in the background. Used by one thread.
    """

    def __init__(
        self,
        terrain: TerrainFile,
        # of blocks: the ground is that of the drawn level, which needs almost no decoding or
        # fetching. By default it is that of the finest level.
        table: NodeTable | None,
        background: Background,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._terrain, self._table = terrain, table
        self._background, self._clock = background, clock
        self._height: float | None = None  # in the file's unit
        self._look_at = -math.inf

    def height_over(self, camera: Camera, frame: Frame) -> float | None:
        """Return the camera's height above the ground, local metres; None while unknown.

        Over voids and next to the raster, that above the last ground.
        """
        if self._clock() >= self._look_at:
            self._look(camera, frame)
        if self._height is None:
            return None
        return camera.position[2] - frame.to_metres(self._height) * frame.exaggeration

    def _look(self, camera: Camera, frame: Frame) -> None:
        x, y, _ = camera.position
        level: int | None = -1
        if self._table is not None:
            level = level_here(self._table, x, y)
        if level is None:
            return
        self._look_at = math.inf  # one read at a time
        place = frame.to_world(camera.eye[None])[:, :2]

        def take(outcome: Outcome) -> None:
            self._look_at = self._clock() + _SECONDS
            if outcome.problem is None and math.isfinite(outcome.value):
                self._height = outcome.value

        terrain = self._terrain
        self._background.start(lambda: float(terrain.sample(place, level=level)[0]), take)
