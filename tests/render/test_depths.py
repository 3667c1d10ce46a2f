"""Heights that a CRS counts downwards are drawn as what they are: a depth of 10 lies at -10."""

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.errors import TerrainwaveWarning
from terrainwave.export.plot import colours_of_heights
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.marks import legend_of
from terrainwave.render.look.style import Style
from terrainwave.render.look.water import read_water
from terrainwave.render.modes import MODES
from terrainwave.render.scene.frame import frame_of
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


@pytest.mark.filterwarnings("ignore:the coordinate reference system counts depths")
def test_water_and_places_of_depths_are_those_of_heights(both):
    up, down = both
    water, own_water = (read_water(terrain, frame_of(terrain)) for terrain in both)
    np.testing.assert_array_equal(own_water.cells, water.cells)
    assert frame_of(up).error_metres == frame_of(down).error_metres == 1
    place = np.array([[500100.0, 5199000.0, -40.0]])
    local = frame_of(up).to_local(place)
    np.testing.assert_array_equal(frame_of(down).to_local(place * (1, 1, -1)), local)
    np.testing.assert_array_almost_equal(frame_of(down).to_world(local), place * (1, 1, -1))


class Colours:
    """A palette that is brighter the higher a place is."""

    colors = np.zeros((1, 256, 3), dtype=np.uint8)
    ranges = (-900.0, 900.0, 0.0, 3.0)

    def color_of(self, metres, _):
        return np.repeat(np.clip(metres / 8 + 128, 0, 255).astype(np.uint8)[:, None], 3, axis=1)


@pytest.mark.filterwarnings("ignore:the coordinate reference system counts depths")
def test_a_legend_of_depths_has_the_deepest_below(both):
    up, down = (
        legend_of(Style(coloring="relative"), Colours(), frame_of(terrain), "m", has_voids=False)
        for terrain in both
    )
    assert (up.title, down.title) == ("height, m", "depth, m")
    np.testing.assert_array_equal(down.colors, up.colors)
    assert np.all(np.diff(up.colors[:, 0].astype(int)) >= 0)
    at = {float(text): share for share, text in up.labels}
    assert {-float(text): pytest.approx(share) for share, text in down.labels} == at
    errors = legend_of(Style(coloring="error"), Colours(), frame_of(both[1]), "m", has_voids=False)
    assert next(float(text) for _, text in errors.labels) >= 0


@pytest.mark.parametrize("is_earth", [True, False])
def test_a_map_colours_depths_as_heights(is_earth):
    heights = colours_of_heights(None, -5000, 300, 1.0, is_earth=is_earth)
    depths = colours_of_heights(None, -300, 5000, -1.0, is_earth=is_earth)
    shares = np.linspace(0, 1, 50)
    np.testing.assert_allclose(depths(shares), heights(1 - shares), atol=0.02)
