"""Which part of an orthophoto is read finer as the camera moves."""

from types import SimpleNamespace

import numpy as np
import pytest

from terrainwave.render.look.drape_detail import DrapeDetail, place_of_square, square_near
from terrainwave.render.scene.camera import Camera
from terrainwave.render.scene.frame import Frame

# 1000 x 1000 samples of 30 m.
FRAME = Frame((0.0, 0.0), (1.0, 1.0, 1.0), (30.0, 0.0, -14985.0, 0.0, -30.0, 14985.0),
              (1000, 1000), (0.0, 500.0))  # fmt: skip
WHOLE = (0.0, 0.0, 1000.0, 1000.0)


def test_its_place_is_in_pixels_of_the_grid_and_within_the_photo():
    down = square_near(Camera((15.0, -15.0, 0.0), 0, -90), 100.0)
    # The local origin is the corner of four pixels in the middle; sample (500, 500) is 15 m off.
    assert place_of_square(down, FRAME, WHOLE) == pytest.approx((490.5, 490.5, 20, 20))
    assert place_of_square(down, FRAME, (0.0, 0.0, 495.0, 1000.0)) == pytest.approx(
        (490.5, 490.5, 4.5, 20)
    )
    assert place_of_square(down, FRAME, (0.0, 0.0, 100.0, 100.0)) is None


def test_parts_are_read_one_at_a_time_where_they_are_finer_and_the_camera_has_moved():
    asked, shown, waiting = [], [], []
    photo = SimpleNamespace(
        place=WHOLE, finer=100.0, part=lambda place, size: asked.append((place, size)) or "part"
    )
    background = SimpleNamespace(start=lambda work, then: waiting.append((work, then)))
    detail = DrapeDetail(photo, 4.0, background, shown.append)

    def tick(x, height):
        detail.tick(Camera((x, 0.0, 0.0), 0, -90), height, FRAME)

    def finish():
        work, then = waiting.pop()
        then(SimpleNamespace(value=work(), problem=None))

    tick(0.0, None)
    assert not waiting
    tick(0.0, 500.0)
    tick(5000.0, 500.0)  # the first one is on its way
    finish()
    assert shown == ["part"]
    # 3,000 m are 100 pixels in 2048 texels.
    assert asked[0][1] == (2048, 2048)
    np.testing.assert_allclose(asked[0][0], (450, 450, 100, 100))
    tick(100.0, 500.0)
    assert not waiting
    tick(5000.0, 500.0)
    finish()
    tick(0.0, 5000.0)  # 1000 pixels in 2048 texels are no finer than the whole
    assert not waiting
