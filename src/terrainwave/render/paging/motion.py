"""Prediction of a camera's motion, so that data are requested in advance."""

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from terrainwave.render.scene.camera import Camera, look

# Seconds of the prediction, the nearest first: blocks take tenths of a second from a disk, a second
# or two from the web.
AHEAD = (0.25, 0.75, 1.5, 3.0)
_WINDOW_S = 0.3
_LEAST_MOTIONS = 3
# Between two frames, a deviation from the steady motion by more than this factor is a jump.
_JUMP = 8.0


class Motion:
    """The last positions of a camera and its steady speed. Used by one thread.

    Zhang et al. 2012, eq. 15, predict one frame, P₂ = 2 P₁ − P₀; here the same line, by seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: deque[tuple[float, Camera]] = deque()

    def see(self, camera: Camera) -> None:
        """Record the camera's position; after a jump, earlier ones are forgotten."""
        now = self._clock()
        if self._seen and self._is_jump(camera, now):
            self._seen.clear()
        self._seen.append((now, camera))
        while len(self._seen) > _LEAST_MOTIONS and self._seen[0][0] < now - _WINDOW_S:
            self._seen.popleft()

    def _is_jump(self, camera: Camera, now: float) -> bool:
        first, last = self._seen[0], self._seen[-1]
        seconds = last[0] - first[0]
        way = float(np.linalg.norm(camera.eye - last[1].eye))
        if len(self._seen) < _LEAST_MOTIONS or seconds <= 0:
            return False
        speed = float(np.linalg.norm(last[1].eye - first[1].eye)) / seconds
        steady = speed * max(now - last[0], 1e-3)
        return way > _JUMP * steady and speed > 0

    def ahead(self) -> list[Camera]:
        """Return the cameras after `AHEAD` seconds of further motion; none if it rests."""
        if len(self._seen) < _LEAST_MOTIONS:
            return []
        (start, before), (end, now) = self._seen[0], self._seen[-1]
        seconds = end - start
        turn = (now.heading - before.heading + 180) % 360 - 180
        tilt = now.pitch - before.pitch
        if seconds <= 0 or (before.position == now.position and not turn and not tilt):
            return []
        speed = (now.eye - before.eye) / seconds
        cameras = []
        for later in AHEAD:
            # Turns last less long than flights.
            share = min(later, 1.0) / seconds
            cameras.append(look(now.at(now.eye + speed * later), turn * share, tilt * share))
        return cameras
