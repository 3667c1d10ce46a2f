"""Heights that a CRS counts downwards are drawn as what they are: a depth of 10 lies at -10."""

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.errors import TerrainwaveWarning
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.modes import MODES
from terrainwave.render.window.pictures import choose_camera

SIZE = (160, 120)
HEIGHT, DEPTH = "EPSG:32633+3855", "EPSG:32633+5715"


@pytest.fixture(scope="module")
def both():
    """Yield a sea floor with an island twice: by heights, and by the depths of the same places."""
    heights = (hills(70, 90, 5, amplitude=900) - 300).astype(np.int16)
    heights[20:30, 30:50] = -9999
    with (
        terrain_of(heights, max_error=0, nodata=-9999, crs=HEIGHT) as up,
        terrain_of(
            np.where(heights == -9999, -9999, -heights).astype(np.int16),
            max_error=0, nodata=-9999, crs=DEPTH,
        ) as down,
    ):  # fmt: skip
        yield up, down


def picture(terrain, style, context, **options):
    tau = 2.0
    with Canvas(terrain, SIZE, samples=0, context=context, **options) as canvas:
        frame = canvas.scene.frame
        camera = choose_camera(frame, canvas.viewport)
        return canvas.picture(camera, style, max_pixel_error=tau)[0], frame.box, camera


@pytest.mark.few(2)
@pytest.mark.gl
@pytest.mark.large
@pytest.mark.parametrize(
    ("mode", "coloring"),
    [*((mode, "absolute") for mode in MODES), ("adaptive", "error"), ("batched", "plain")],
)
def test_depths_are_drawn_as_the_heights_of_the_same_places(both, context, mode, coloring):
    up, down = both
    style = Style(coloring=coloring, sea_level="none")
    expected, box, camera = picture(up, style, context, mode=mode)
    with pytest.warns(TerrainwaveWarning, match="a depth of 10 becomes a height of -10"):
        found, own_box, own_camera = picture(down, style, context, mode=mode)
    np.testing.assert_array_equal(own_box, box)
    np.testing.assert_array_equal(own_camera.position, camera.position)
    # Quanta are rounded up in one and down in the other; edges of triangles may differ.
    differs = np.abs(found.astype(int) - expected.astype(int)).max(axis=2) > 8
    assert differs.mean() < 0.01
    upside_down = picture(up, style, context, mode=mode)[0][::-1]
    assert (np.abs(upside_down.astype(int) - expected.astype(int)).max(axis=2) > 8).mean() > 0.1
