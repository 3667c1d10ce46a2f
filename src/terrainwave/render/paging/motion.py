"""Where a camera is going, by the clock: what it will need is asked for before it is there."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from terrainwave.render.scene.camera import Camera, look

# Seconds ahead that are looked at, the nearest first: blocks are here in tenths of a second from a
# disk, in a second or two from the web.
AHEAD = (0.25, 0.75, 1.5, 3.0)
_WINDOW_S = 0.3
_LEAST_MOTIONS = 3
# Between two frames, what is further from the steady motion than so many times is no motion.
_JUMP = 8.0


class Motion:
    """The last places of a camera and its steady speed. Used by one thread.

    Zhang et al. 2012, eq. 15, looks one frame ahead, P₂ = 2 P₁ − P₀; the same line, by seconds.

    Parameters
    ----------
    clock : callable
        Seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: deque[tuple[float, Camera]] = deque()

    def see(self, camera: Camera) -> None:
        """Take down where the camera is now; after a jump, what was before is forgotten."""
        now = self._clock()
        if self._seen and self._is_jump(camera, now):
            self._seen.clear()
        self._seen.append((now, camera))
        while len(self._seen) > _LEAST_MOTIONS and self._seen[0][0] < now - _WINDOW_S:
            self._seen.popleft()

    def _is_jump(self, camera: Camera, now: float) -> bool:
        """Say whether the camera is somewhere else than its motion, or its rest, explains."""
        first, last = self._seen[0], self._seen[-1]
        seconds = last[0] - first[0]
        way = float(np.linalg.norm(camera.eye - last[1].eye))
        if len(self._seen) < _LEAST_MOTIONS or seconds <= 0:
            return False
        speed = float(np.linalg.norm(last[1].eye - first[1].eye)) / seconds
        steady = speed * max(now - last[0], 1e-3)
        return way > _JUMP * steady and speed > 0

    def ahead(self) -> list[Camera]:
        """Return where the camera will be after `AHEAD` seconds if it goes on; none if it rests."""
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
            x, y, z = now.eye + speed * later
            # A turn goes on for less long than a flight does.
            share = min(later, 1.0) / seconds
            there = replace(now, position=(float(x), float(y), float(z)))
            cameras.append(look(there, turn * share, tilt * share))
        return cameras
