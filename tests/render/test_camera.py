"""Cameras, frames and γ."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.errors import InvalidHeightsError
from terrainwave.render.scene.camera import (
    Camera,
    Viewport,
    format_camera,
    gamma_guaranteed,
    gamma_paper,
    home,
    parse_camera,
    project,
    projection_matrix,
    top_view,
    view_matrix,
)
from terrainwave.render.scene.frame import Frame

UTM = Frame((500000.0, 5200000.0), (1.0, 1.0, 1.0), (30.0, 0.0, -3000.0, 0.0, -30.0, 2000.0),
            (134, 201), (0.0, 900.0))  # fmt: skip
FEET = replace(UTM, centre=(8.5, 46.5), metres=(76500.0, 111170.0, 0.3048))
VIEWPORT = Viewport(1920, 1280)


def steps(low, high):
    """Return numbers from `low` to `high` in thousandths: no subnormal ones."""
    return st.integers(round(low * 1000), round(high * 1000)).map(lambda number: number / 1000)


cameras = st.builds(
    Camera,
    st.tuples(*[steps(-1e5, 1e5)] * 3),
    steps(0, 359.99),
    steps(-89, 89),
    steps(10, 120),
)


@given(camera=cameras)
@pytest.mark.parametrize("frame", [UTM, FEET])
def test_a_camera_line_gives_the_camera_back(frame, camera):
    found = parse_camera(format_camera(camera, frame), frame)
    np.testing.assert_allclose(found.position, camera.position, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        [found.heading, found.pitch, found.fov], [camera.heading, camera.pitch, camera.fov],
        atol=1e-6,
    )  # fmt: skip


def test_a_camera_line_is_in_the_files_coordinates_and_unit():
    frame = replace(UTM, metres=FEET.metres, centre=(0.0, 0.0))
    line = format_camera(Camera((100.0, -50.0, 304.8), 45, -20, 60), frame)
    x, y, z, *rest = (float(part) for part in line.split(","))
    assert (x, y, z) == pytest.approx((100 / 76500, -50 / 111170, 1000.0))
    assert rest == [45, -20, 60]


@pytest.mark.parametrize("line", ["", "1,2,3", "1,2,3,4,5,6,7", "1,2,nan,0,0", "1,2,3,0,-91,50",
                                  "1,2,3,0,0,0.5", "a,b,c,d,e"])  # fmt: skip
def test_a_line_that_is_no_camera_is_refused(line):
    with pytest.raises(InvalidHeightsError):
        parse_camera(line, UTM)


@pytest.mark.parametrize(
    ("heading", "pitch", "forward"),
    [(0, 0, (0, 1, 0)), (90, 0, (1, 0, 0)), (180, 0, (0, -1, 0)), (0, -90, (0, 0, -1))],
)
def test_headings_count_clockwise_from_north(heading, pitch, forward):
    camera = Camera((0, 0, 0), heading, pitch)
    np.testing.assert_allclose(camera.forward, forward, atol=1e-12)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.axes) == pytest.approx(-1)  # right, up, forward: left-handed


@given(camera=cameras)
def test_matrices_project_as_project_does(camera):
    rng = np.random.default_rng(2)
    points = camera.eye + rng.normal(size=(20, 3)) * 100 + camera.forward * 500
    pixels = project(camera, VIEWPORT, points)
    matrix = projection_matrix(camera, VIEWPORT, 1.0, 1e5) @ view_matrix(camera)
    clip = np.column_stack([points - camera.eye, np.ones(20)]) @ matrix.T
    x, y = clip[:, 0] / clip[:, 3], clip[:, 1] / clip[:, 3]
    np.testing.assert_allclose((x + 1) / 2 * 1920, pixels[:, 0], rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose((1 - y) / 2 * 1280, pixels[:, 1], rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(clip[:, 3], pixels[:, 2], rtol=1e-9)


def test_gamma_of_the_paper_is_its_formula():
    camera = Camera((0, 0, 0), fov=60)
    expected = 0.5 * 1920 / math.tan(math.radians(30))
    assert gamma_paper(camera, VIEWPORT) == pytest.approx(expected)


@pytest.mark.parametrize(("fov", "size"), [(60, (1920, 1280)), (90, (640, 640)), (100, (300, 900))])
def test_gamma_bounds_pixels_everywhere_and_is_nearly_reached(fov, size):
    """Steps of any direction at any place in view: never more than γ · step / distance."""
    camera, viewport = Camera((0, 0, 0), 0, 0, fov), Viewport(*size)
    gamma = gamma_guaranteed(camera, viewport)
    rng = np.random.default_rng(3)
    n = 200_000
    x, y = rng.uniform(0, size[0], n), rng.uniform(0, size[1], n)
    x[: n // 2] = np.where(rng.random(n // 2) < 0.5, 0.5, size[0] - 0.5)
    y[: n // 2] = np.where(rng.random(n // 2) < 0.5, 0.5, size[1] - 0.5)
    tangent = math.tan(math.radians(fov) / 2) / (size[1] / 2)
    rays = np.column_stack([(x - size[0] / 2) * tangent, np.ones(n), (size[1] / 2 - y) * tangent])
    first = rays * rng.uniform(10, 1000, (n, 1))
    step = rng.normal(size=(n, 3))
    step *= 1e-3 / np.linalg.norm(step, axis=1, keepdims=True)
    moved = project(camera, viewport, first + step) - project(camera, viewport, first)
    apart = np.hypot(moved[:, 0], moved[:, 1])
    distance = np.minimum(np.linalg.norm(first, axis=1), np.linalg.norm(first + step, axis=1))
    share = apart / (gamma * 1e-3 / distance)
    assert share.max() <= 1.0 + 1e-6
    if gamma > gamma_paper(camera, viewport):
        assert share.max() > 0.95


@pytest.mark.parametrize("size", [(1920, 1280), (500, 900), (300, 300)])
@pytest.mark.parametrize("heading", [0.0, 37.0])
@pytest.mark.parametrize("pitch", [-20.0, -38.0, -90.0])
def test_home_shows_the_whole_box_and_fills_a_side(size, heading, pitch):
    viewport = Viewport(*size)
    low, high = UTM.box
    camera = home((low, high), viewport, heading=heading, pitch=pitch)
    corners = np.array(
        [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    pixels = project(camera, viewport, corners)
    assert not np.isnan(pixels).any()
    assert pixels[:, :2].min() >= 0
    assert (pixels[:, :2].max(axis=0) <= size).all()
    filled = (pixels[:, :2].max(axis=0) - pixels[:, :2].min(axis=0)) / size
    assert filled.max() > 0.7
    assert top_view((low, high), viewport).pitch == -90


def corners_of(low, high):
    return np.array(
        [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


# Metres: square mountains, a wide coast, a long valley, a planet, a needle.
BOXES = {
    "square": (30e3, 30e3, 2500.0),
    "wide": (90e3, 20e3, 1500.0),
    "long": (5e3, 60e3, 800.0),
    "planet": (40e6, 20e6, 18e3),
    "steep": (400.0, 400.0, 900.0),
}


@pytest.mark.parametrize("size", [(1280, 853), (600, 900), (300, 300)])
@pytest.mark.parametrize("box", BOXES)
def test_the_first_view_holds_the_whole_box_below_some_sky(box, size):
    high = np.array(BOXES[box]) / 2
    camera = home((-high, high), Viewport(*size))
    x, y, depth = project(camera, Viewport(*size), corners_of(-high, high)).T / np.array(
        [size[0], size[1], 1]
    ).reshape(3, 1)
    assert (depth > 0).all()
    assert 0.019 < x.min()
    assert x.max() < 0.981
    assert 0.149 < y.min() < 0.7
    assert y.max() < 0.981
    # It reaches two sides of what is left, and stands in its middle.
    assert max((x.max() - x.min()) / 0.96, (y.max() - y.min()) / 0.83) > 0.999
    assert (x.max() + x.min()) / 2 == pytest.approx(0.5, abs=1e-3)
    assert (y.max() + y.min()) / 2 == pytest.approx((0.15 + 0.98) / 2, abs=1e-3)
