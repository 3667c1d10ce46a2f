"""Camera: position, view, motion. Positions are local metres, float64.

x is east, y north, z up; the heading counts clockwise from north, the pitch up from the horizon.
The GPU gets positions relative to the eye, so that large map coordinates don't jitter.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError
from terrainwave.render.scene.frame import Frame

Vector = NDArray[np.float64]

DEFAULT_FOV = 50.0
_MAX_PITCH = 89.9
# Initial view: a longer lens than in flight, so that the far side is not much smaller.
_FOV = 40.0
# Share of the picture's sides that the whole terrain fills; share of its height that is sky.
_HOME_SHARE = 0.96
_SKY = 0.15
_HOME_PITCHES = (-22.0, -52.0)
_PITCH_STEPS = 30
_CENTRING_STEPS = 60
# The raster is viewed from the east if that fills the picture by this factor more.
_TURN_GAIN = 2.0
_LEAST_SIZE = 1.0


@dataclass(frozen=True)
class Camera:
    """Eye, direction and field of view."""

    position: tuple[float, float, float]  # x, y, z in local metres
    heading: float = 0.0  # degrees
    pitch: float = 0.0  # degrees; -90 looks straight down
    fov: float = DEFAULT_FOV  # vertical field of view in degrees, 1 to 150

    @cached_property
    def eye(self) -> Vector:
        return np.array(self.position, dtype=np.float64)

    @cached_property
    def axes(self) -> Vector:
        heading, pitch = math.radians(self.heading), math.radians(self.pitch)
        sin_h, cos_h = math.sin(heading), math.cos(heading)
        sin_p, cos_p = math.sin(pitch), math.cos(pitch)
        return np.array(
            [
                [cos_h, -sin_h, 0.0],
                [-sin_h * sin_p, -cos_h * sin_p, cos_p],
                [sin_h * cos_p, cos_h * cos_p, sin_p],
            ]
        )

    @property
    def forward(self) -> Vector:
        forward: Vector = self.axes[2]
        return forward

    def at(self, place: Vector) -> Self:
        x, y, z = place.tolist()
        return replace(self, position=(x, y, z))


@dataclass(frozen=True)
class Viewport:
    """Size of the picture in pixels."""

    width: int
    height: int

    @property
    def aspect(self) -> float:
        return self.width / self.height


def focal_length(camera: Camera, viewport: Viewport) -> float:
    """Return pixels per unit of tangent: ½ V_y / tan(φ/2), φ the vertical field of view."""
    return viewport.height / 2 / math.tan(math.radians(camera.fov) / 2)


def slant(camera: Camera, viewport: Viewport) -> float:
    """Return the largest distance / depth in view, that of the picture's corners.

    √(1 + |t|²), t the tangents there: |t|² = tan²(φ/2) (1 + (V_x / V_y)²).
    """
    return math.sqrt(_slant_squared(camera, viewport))


def _slant_squared(camera: Camera, viewport: Viewport) -> float:
    tangent = math.tan(math.radians(camera.fov) / 2)
    return 1 + tangent**2 * (1 + viewport.aspect**2)


def gamma_paper(camera: Camera, viewport: Viewport) -> float:
    """Return γ of Yusov & Turlapov 2010, §2.8: ½ max(V_x, V_y) / tan(φ/2), φ as in `focal_length`.

    Exact only near the axis: it uses the distance to the eye, not the depth.
    """
    largest = max(viewport.width, viewport.height)
    return largest / 2 / math.tan(math.radians(camera.fov) / 2)


def gamma_guaranteed(camera: Camera, viewport: Viewport) -> float:
    """Return the γ for which γ · error / distance bounds pixels everywhere in the picture.

    A step e at distance d under the tangents t = (t_x, t_y) moves by at most f (1 + |t|²) e / d
    pixels, f the focal length: the largest singular value of the projection's derivative is
    f √(1 + |t|²) / depth, and the depth is d / √(1 + |t|²), at the corners d over the slant.
    """
    corner = focal_length(camera, viewport) * _slant_squared(camera, viewport)
    return max(gamma_paper(camera, viewport), corner)


def view_matrix(camera: Camera) -> Vector:
    """Return the rotation from positions relative to the eye to right, up, backward; 4 x 4."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.axes
    matrix[2, :3] *= -1
    return matrix


def projection_matrix(camera: Camera, viewport: Viewport, near: float, far: float) -> Vector:
    """Return OpenGL's perspective matrix, 4 x 4, for column vectors."""
    focal = 1 / math.tan(math.radians(camera.fov) / 2)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = focal / viewport.aspect, focal
    matrix[2, 2], matrix[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
    matrix[3, 2] = -1
    return matrix


def project(camera: Camera, viewport: Viewport, points: Vector) -> Vector:
    """Return pixels (x right, y down) and depths of points, shape (n, 3); NaN behind the eye."""
    seen = (points - camera.eye) @ camera.axes.T
    focal = focal_length(camera, viewport)
    depth = np.where(seen[:, 2] > 0, seen[:, 2], np.nan)
    return np.column_stack(
        [
            viewport.width / 2 + focal * seen[:, 0] / depth,
            viewport.height / 2 - focal * seen[:, 1] / depth,
            depth,
        ]
    )


def format_camera(camera: Camera, frame: Frame) -> str:
    """Return x,y,z,heading,pitch,fov: position and height in the file's CRS and unit."""
    x, y, z = frame.to_world(camera.eye[None])[0]
    numbers = [repr(float(x)), repr(float(y)), repr(float(z))]
    numbers += [f"{value:.10g}" for value in (camera.heading, camera.pitch, camera.fov)]
    return ",".join(numbers)


def parse_camera(line: str, frame: Frame) -> Camera:
    try:
        numbers = [float(part) for part in line.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (5, 6) or not all(math.isfinite(number) for number in numbers):
        raise InvalidArgumentError(
            f"found `camera` {line!r}, expected x,y,z,heading,pitch,fov (fov may be left out)"
        )
    pitch, fov = numbers[4], numbers[5] if len(numbers) == 6 else DEFAULT_FOV
    if not -90 <= pitch <= 90 or not 1 <= fov <= 150:
        raise InvalidArgumentError(
            f"found `camera` with pitch {pitch:g} and fov {fov:g}, expected -90 … 90"
            " and 1 … 150 degrees"
        )
    position = frame.to_local(np.array([numbers[:3]]))[0]
    return Camera((position[0], position[1], position[2]), numbers[3], pitch, fov)


def home(
    box: tuple[Vector, Vector],
    viewport: Viewport,
    *,
    heading: float | None = None,
    pitch: float | None = None,
) -> Camera:
    """Return an oblique view of a box, a `Frame`'s for all of it, that fills the picture.

    The box's corners are projected: all are in the picture, with `_SKY` of its height above them.
    By default the pitch is the one between -52 and -22 degrees at which the box reaches both the
    sides and the top and bottom of the rest, and the view is to the north; to the west, along a
    raster much wider than long, if that fills twice as much of the picture.
    """
    low, high = box
    # A raster of one sample has no size; use a metre around it.
    room = np.where(high - low < _LEAST_SIZE, _LEAST_SIZE, 0.0)
    low, high = low - room, high + room
    corners = np.array(
        [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    if heading is not None:
        return _framed(corners, viewport, heading, pitch)
    north, west = (_framed(corners, viewport, angle, pitch) for angle in (0.0, 270.0))
    filled, turned = (_filled(camera, viewport, corners) for camera in (north, west))
    return west if turned > _TURN_GAIN * filled else north


def _framed(corners: Vector, viewport: Viewport, heading: float, pitch: float | None) -> Camera:
    """Return the nearest camera of a heading that has all corners in its window."""
    if pitch is None:
        shallow, steep = _HOME_PITCHES
        for _ in range(_PITCH_STEPS):
            pitch = (shallow + steep) / 2
            across, upwards = _reaches(corners, viewport, Camera((0, 0, 0), heading, pitch, _FOV))
            # Limited by the sides: a steeper view fills the remaining height.
            shallow, steep = (pitch, steep) if across < upwards else (shallow, pitch)
        pitch = (shallow + steep) / 2
    camera = Camera((0.0, 0.0, 0.0), heading, pitch, _FOV)
    seen = corners @ camera.axes.T
    # The looser pair of sides leaves room: the same on both sides, in pixels.
    centre = np.array([0.0, 0.0, min(_reaches(corners, viewport, camera))])
    depths = seen[:, 2] - centre[2]
    for axis, (least, most) in enumerate(_window(camera, viewport)):
        centre[axis] = seen[:, axis].mean()
        for _ in range(_CENTRING_STEPS):
            shares = (seen[:, axis] - centre[axis]) / depths
            off = (shares.max() + shares.min() - least - most) / 2
            centre[axis] += off * float(depths.min())
    return camera.at(centre @ camera.axes)


def _window(camera: Camera, viewport: Viewport) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the tangents, left and right, bottom and top, between which the box must lie."""
    tangent = math.tan(math.radians(camera.fov) / 2)
    side = tangent * viewport.aspect * _HOME_SHARE
    sky = _SKY if camera.pitch > -_MAX_PITCH else 1 - _HOME_SHARE  # none when looking down
    return (-side, side), (-tangent * _HOME_SHARE, tangent * (1 - 2 * sky))


def _reaches(corners: Vector, viewport: Viewport, camera: Camera) -> list[float]:
    """Return how far forward the eye may move, for the picture's sides, and its top and bottom.

    The eye (r, u, f) in the camera's axes sees a corner if least · (corner's f − f) <= corner's r −
    r <= most · (corner's f − f), and alike upwards.
    """
    seen = corners @ camera.axes.T
    return [
        float(
            ((seen[:, axis] - least * seen[:, 2]).min() - (seen[:, axis] - most * seen[:, 2]).max())
            / (most - least)
        )
        for axis, (least, most) in enumerate(_window(camera, viewport))
    ]


def _filled(camera: Camera, viewport: Viewport, corners: Vector) -> float:
    """Return the pixels of the box's upper side."""
    x, y, _ = project(camera, viewport, corners[[1, 3, 7, 5]]).T
    return float(abs((x * np.roll(y, 1) - y * np.roll(x, 1)).sum()) / 2)


def top_view(box: tuple[Vector, Vector], viewport: Viewport) -> Camera:
    return home(box, viewport, heading=0.0, pitch=-90.0)


def fly(camera: Camera, right: float, up: float, forward: float) -> Camera:
    return camera.at(camera.eye + np.array([right, up, forward]) @ camera.axes)


def look(camera: Camera, d_heading: float, d_pitch: float) -> Camera:
    pitch = min(max(camera.pitch + d_pitch, -_MAX_PITCH), _MAX_PITCH)
    return replace(camera, heading=(camera.heading + d_heading) % 360, pitch=pitch)


def orbit(camera: Camera, pivot: Vector, d_heading: float, d_pitch: float) -> Camera:
    """Return the camera rotated around a point, which keeps its position in the picture."""
    seen = camera.axes @ (camera.eye - pivot)
    turned = look(camera, d_heading, d_pitch)
    return turned.at(pivot + seen @ turned.axes)


def zoom(camera: Camera, towards: Vector, factor: float) -> Camera:
    return camera.at(towards + (camera.eye - towards) * factor)


def along(cameras: list[Camera], share: float) -> Camera:
    """Return the camera at a share (0 … 1) of a flight through `cameras`, evenly by key.

    Positions by Catmull and Rom's splines, angles along the shorter way.
    """
    if len(cameras) == 1:
        return cameras[0]
    passed = min(max(share, 0.0), 1.0) * (len(cameras) - 1)
    key = min(int(passed), len(cameras) - 2)
    t = passed - key
    before, start, end, after = (
        cameras[min(max(key + k, 0), len(cameras) - 1)] for k in (-1, 0, 1, 2)
    )
    p_0, p_1, p_2, p_3 = before.eye, start.eye, end.eye, after.eye
    place = 0.5 * (
        2 * p_1
        + (p_2 - p_0) * t
        + (2 * p_0 - 5 * p_1 + 4 * p_2 - p_3) * t**2
        + (3 * p_1 - p_0 - 3 * p_2 + p_3) * t**3
    )
    smooth = t * t * (3 - 2 * t)
    turn = (end.heading - start.heading + 180) % 360 - 180
    return Camera(
        (0.0, 0.0, 0.0),
        (start.heading + turn * smooth) % 360,
        start.pitch + (end.pitch - start.pitch) * smooth,
        start.fov + (end.fov - start.fov) * smooth,
    ).at(place)
