"""Keys, mouse, overlay and PNG without a window."""

import io

import numpy as np
import pytest

from terrainwave.render.gpu.overlay import draw_overlay
from terrainwave.render.look.png import encode_png
from terrainwave.render.look.style import COLORINGS, Style
from terrainwave.render.scene.camera import Camera, Viewport
from terrainwave.render.scene.frame import Frame
from terrainwave.render.window.controls import Controls

VIEWPORT = Viewport(300, 200)


class FakeScene:
    def __init__(self):
        self.frame = Frame((0.0, 0.0), (1.0, 1.0, 1.0), (30.0, 0.0, -1500.0, 0.0, -30.0, 1500.0),
                           (101, 101), (0.0, 500.0))  # fmt: skip

    def exaggerate(self, factor):
        self.frame = self.frame.exaggerated(factor)


@pytest.fixture
def controls():
    return Controls(FakeScene(), Camera((0.0, -2000.0, 800.0), 0, -20), Style(), 1.0)


def press(controls, *keys):
    for key in keys:
        controls.press(key, VIEWPORT)
        controls.release(key)


def test_held_keys_fly_as_long_as_they_are_held(controls):
    controls.height_over_ground = 100.0
    controls.press("w", VIEWPORT)
    controls.tick(0.1)
    np.testing.assert_allclose(
        np.linalg.norm(np.subtract(controls.camera.position, (0, -2000, 800))), 10
    )
    controls.press("shift", VIEWPORT)
    before = controls.camera
    controls.tick(0.1)
    np.testing.assert_allclose(np.linalg.norm(controls.camera.eye - before.eye), 40)
    controls.release("w")
    before = controls.camera
    controls.tick(0.1)
    assert controls.camera == before


def test_up_is_up_wherever_the_camera_looks(controls):
    controls.press("e", VIEWPORT)
    controls.tick(0.1)
    x, y, z = controls.camera.position
    assert (x, y) == (0, -2000)
    assert z > 800


def test_keys_change_the_picture(controls):
    press(controls, "c", "r", "l", "b", "h")
    assert controls.style.coloring != "auto"
    assert controls.style.ramp != "auto"
    assert controls.style.wireframe
    assert controls.style.shade == 0
    assert controls.shows_help
    for _ in range(len(COLORINGS) - 1):
        press(controls, "c")
    assert controls.style.coloring == "auto"
    press(controls, "period", "+", "]")
    assert controls.style.sun[0] == 330
    assert controls.max_pixel_error == pytest.approx(2**0.5)
    assert controls._scene.frame.exaggeration == 1.25
    assert controls.camera.position[2] == 1000


def test_the_scale_bar_is_as_long_as_it_says():
    image = draw_overlay(VIEWPORT, Camera((0, 0, 0)), [], 10.0)
    row = image[VIEWPORT.height - 22]
    white = np.flatnonzero((row[:, :3] == 255).all(axis=1) & (row[:, 3] == 255))
    assert abs(len(white) * 10 - 1000) <= 30


def test_a_png_is_read_back_as_it_was():
    from PIL import Image

    image = np.random.default_rng(1).integers(0, 256, (37, 53, 3), dtype=np.uint8)
    with Image.open(io.BytesIO(encode_png(image))) as found:
        np.testing.assert_array_equal(np.asarray(found), image)
