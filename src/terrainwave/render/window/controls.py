"""Effects of keys and mouse on the camera and the style."""

import math
from dataclasses import replace

import numpy as np

from terrainwave.render.look.colorings import AUTO, RAMP_NAMES
from terrainwave.render.look.style import COLORINGS, Style
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import (
    Camera,
    Vector,
    Viewport,
    fly,
    home,
    look,
    orbit,
    top_view,
    zoom,
)

HELP = [
    ("W A S D", "fly forward, left, back, right"),
    ("Q E", "down, up; Shift: four times as fast"),
    ("drag", "orbit around the point under the cursor"),
    ("right drag", "look around"),
    ("wheel", "zoom to the cursor (orbit), speed (fly)"),
    ("click", "coordinates, height and the file's bound"),
    ("Tab", "orbit or fly: in fly, drag looks around"),
    ("Home  T  N", "the whole terrain, from above, north up"),
    ("C  R", "colour by height, slope, level, error; ramp"),
    ("L  B  O", "wireframe; light, orthophoto on and off"),
    (",  .", "turn the sun; Shift: raise it, lower it"),
    ("[  ]", "vertical exaggeration"),
    ("-  +", "pixel error"),
    ("M  X", "measure: click places, Backspace takes back; save the profile"),
    ("I  F", "save the picture; record a flight, for --flight"),
    ("P", "print the camera, for --camera"),
    ("H  Esc", "this help; close"),
]

_LOOK_SPEED = 0.15  # degrees per pixel
_ORBIT_SPEED = 0.3
_ZOOM_STEP = 0.85
_SPEED_STEP = 1.25
_FASTER = 4.0
# Speed per second as a share of the height above the ground; least height in metres.
_FIRST_PACE, _LEAST_HEIGHT = 1.0, 5.0
_SLOWEST, _FASTEST = 1e-3, 1e3
# Largest move of a click in pixels: more is a drag.
_STILL = 4.0
_WISHES = {"p": "camera", "i": "picture", "f": "flight", "x": "profile", "backspace": "undo"}
_LOWEST_SUN, _HIGHEST_SUN = 3.0, 88.0  # degrees


class Controls:
    """Camera and style of a viewer, changed by keys and mouse.

    Keys are names: letters, ``tab``, ``home``, ``shift`` and so on.
    """

    def __init__(self, scene: Scene, camera: Camera, style: Style, max_pixel_error: float) -> None:
        self._scene = scene
        self.camera = camera
        self.style = style
        self.max_pixel_error = max_pixel_error
        self.is_flying = False
        self.shows_help = False
        self.is_closing = False
        self.is_measuring = False
        # requests of keys to others, in order; removed by the one who fulfils them
        self.wishes: list[str] = []
        self.pace = _FIRST_PACE  # of flying: shares of the height above the ground, per second
        self.height_over_ground: float | None = None  # local metres; None while unknown
        low, high = scene.frame.box
        self._extent = float(np.linalg.norm(high - low))
        self._dragged = 0.0  # pixels since a button went down
        self._held: set[str] = set()
        self._pivot: Vector | None = None

    @property
    def speed(self) -> float:
        """Return the speed of flying, metres per second: faster high above the ground."""
        height = self.height_over_ground
        height = self._extent / 20 if height is None else abs(height)
        return self.pace * min(max(height, _LEAST_HEIGHT), self._extent)

    def press(self, key: str, viewport: Viewport) -> None:
        self._held.add(key)
        scene, box = self._scene, self._scene.frame.box
        if key == "escape":
            self.is_closing = True
        elif key == "h":
            self.shows_help = not self.shows_help
        elif key == "tab":
            self.is_flying = not self.is_flying
        elif key == "home":
            self.camera = home(scene.frame.solid_box, viewport)
        elif key == "t":
            self.camera = top_view(box, viewport)
        elif key == "n":
            self.camera = replace(self.camera, heading=0.0)
        elif key == "c":
            self.style = replace(self.style, coloring=_next(list(COLORINGS), self.style.coloring))
        elif key == "r":
            self.style = replace(self.style, ramp=_next([AUTO, *RAMP_NAMES], self.style.ramp))
        elif key == "l":
            self.style = replace(self.style, wireframe=not self.style.wireframe)
        elif key == "o":
            self.style = replace(self.style, drape=0.0 if self.style.drape else 1.0)
        elif key == "b":
            self.style = replace(self.style, shade=0.0 if self.style.shade else 1.0)
        elif key in ("comma", "period"):
            self._move_sun(1 if key == "period" else -1)
        elif key in ("[", "]"):
            before = scene.frame.exaggeration
            scene.exaggerate(min(max(before * (1.25 if key == "]" else 0.8), 0.1), 20.0))
            x, y, z = self.camera.position
            self.camera = replace(
                self.camera, position=(x, y, z * scene.frame.exaggeration / before)
            )
        elif key in ("-", "+"):
            factor = 2**0.5 if key == "+" else 2**-0.5
            self.max_pixel_error = min(max(self.max_pixel_error * factor, 0.1), 64.0)
        elif key == "m":
            self.is_measuring = not self.is_measuring
            self.wishes.append("measure")
        elif key in _WISHES:
            self.wishes.append(_WISHES[key])

    def _move_sun(self, sign: int) -> None:
        azimuth, altitude = self.style.sun
        if "shift" in self._held:
            altitude = min(max(altitude + 5 * sign, _LOWEST_SUN), _HIGHEST_SUN)
        else:
            azimuth = (azimuth + 15 * sign) % 360
        self.style = replace(self.style, sun=(azimuth, altitude))

    def release(self, key: str) -> None:
        self._held.discard(key)

    def tick(self, seconds: float) -> None:
        """Fly on for the time since the last frame."""
        axes = [
            ("d" in self._held) - ("a" in self._held),
            ("e" in self._held) - ("q" in self._held),
            ("w" in self._held) - ("s" in self._held),
        ]
        if not any(axes):
            return
        metres = self.speed * min(seconds, 0.25) * (_FASTER if "shift" in self._held else 1.0)
        right, up, forward = (axis * metres for axis in axes)
        self.camera = fly(self.camera, right, 0.0, forward)
        x, y, z = self.camera.position
        self.camera = replace(self.camera, position=(x, y, z + up))

    def grab(self, point: Vector | None) -> None:
        """Start dragging at a point of the surface; None: at the sky."""
        self._pivot = point
        self._dragged = 0.0

    @property
    def was_click(self) -> bool:
        """Return whether the released button has not dragged anything."""
        return self._dragged < _STILL

    def drag(self, dx: float, dy: float, *, is_right: bool = False) -> None:
        """Turn by a movement of the mouse in pixels, y down."""
        self._dragged += abs(dx) + abs(dy)
        if self.is_flying or is_right or self._pivot is None:
            speed = _LOOK_SPEED * math.tan(math.radians(self.camera.fov) / 2) / 0.47
            sign = 1 if self.is_flying else -1
            self.camera = look(self.camera, sign * dx * speed, -sign * dy * speed)
        else:
            self.camera = orbit(self.camera, self._pivot, dx * _ORBIT_SPEED, -dy * _ORBIT_SPEED)

    def scroll(self, notches: float, point: Vector | None) -> None:
        """Zoom to a point, or change the speed; positive is away from the user."""
        if self.is_flying:
            self.pace = min(max(self.pace * _SPEED_STEP**notches, _SLOWEST), _FASTEST)
        elif point is not None:
            self.camera = zoom(self.camera, point, _ZOOM_STEP**notches)
        else:
            self.camera = fly(self.camera, 0.0, 0.0, self.speed * 0.5 * notches)


def _next(names: list[str], name: str) -> str:
    return names[(names.index(name) + 1) % len(names)]
