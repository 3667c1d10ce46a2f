"""`Terrain.plot` and `Terrain.view` where there is no window."""

import io
import sys

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.errors import InvalidHeightsError


@pytest.fixture
def terrain():
    heights = np.round(hills(45, 61, 3)).astype(np.int16)
    heights[5:9, 7:12] = -32768
    with terrain_of(heights, max_error=0, nodata=-32768) as terrain:
        yield terrain


@pytest.fixture
def ax():
    from matplotlib.figure import Figure

    return Figure().subplots()


def test_a_map_lies_in_the_coordinates_of_the_crs_and_voids_are_clear(terrain, ax):
    assert terrain.plot(ax) is ax
    left, bottom, right, top = terrain.bounds
    assert ax.images[0].get_extent() == pytest.approx([left, right, bottom, top])
    rgba = np.asarray(ax.images[0].get_array())
    assert rgba.shape == (45, 61, 4)
    np.testing.assert_array_equal(rgba[..., 3] == 0, terrain.read() == -32768)


@pytest.mark.gl
@pytest.mark.large
def test_a_notebook_gets_a_picture(terrain, monkeypatch, tmp_path):
    class ZMQInteractiveShell:
        pass

    class IPython:
        get_ipython = staticmethod(ZMQInteractiveShell)

    monkeypatch.setitem(sys.modules, "IPython", IPython)
    picture = terrain.view(size=(120, 90))
    assert picture.pixels.shape == (90, 120, 3)
    assert len(np.unique(picture.pixels.reshape(-1, 3), axis=0)) > 100
    from matplotlib.image import imread

    shown = np.round(imread(io.BytesIO(picture._repr_png_()))[..., :3] * 255)
    np.testing.assert_array_equal(shown, picture.pixels)
    picture.save(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() == picture._repr_png_()
    again = terrain.view(size=(120, 90), camera=picture.camera)
    np.testing.assert_array_equal(again.pixels, picture.pixels)


@pytest.mark.gl
@pytest.mark.large
@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")  # of moderngl-window's PyGLM
def test_without_a_display_a_picture_stands_in_for_the_window(terrain, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    whole = terrain.view(size=(60, 40), mode="full")
    assert whole.pixels.shape == (40, 60, 3)
    left, bottom, right, top = terrain.bounds
    west = (left, bottom, (left + right) / 2, (bottom + top) / 2)
    part = terrain.view(size=(60, 40), bounds=west)
    x, wide = (float(picture.camera.split(",")[0]) for picture in (part, whole))
    assert x < wide


def test_a_view_of_voids_is_refused():
    voids = np.full((9, 9), -9, dtype=np.int16)
    with (
        terrain_of(voids, max_error=0, nodata=-9) as terrain,
        pytest.raises(InvalidHeightsError, match="voids only"),
    ):
        terrain.view()
