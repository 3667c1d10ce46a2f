"""`Terrain.plot` and `Terrain.view` where there is no window."""

import inspect
import io
import sys

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.terrain import Terrain


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


@pytest.mark.parametrize(
    ("crs", "labels"),
    [
        ("EPSG:32633", ("easting, m", "northing, m")),
        ("EPSG:2264", ("easting, US survey foot", "northing, US survey foot")),
        ("EPSG:4326", ("longitude, degrees", "latitude, degrees")),
        (None, ("x, unit unknown", "y, unit unknown")),
    ],
)
def test_axes_and_colours_of_a_map_are_labelled_with_units(crs, labels, ax):
    place = {"pixel": 0.01, "corner": (10.0, 50.0)} if crs == "EPSG:4326" else {}
    heights = np.arange(30, dtype=np.int16).reshape(5, 6)
    with terrain_of(heights, max_error=0, crs=crs, **place) as terrain:
        terrain.plot(ax)
    assert (ax.get_xlabel(), ax.get_ylabel()) == labels
    bar = next(other for other in ax.figure.axes if other is not ax)
    assert bar.get_ylabel() == "height, unit unknown"
    assert not any("e" in text.get_text() for text in ax.get_xticklabels())


def test_an_array_without_a_place_is_in_samples_and_heights_have_their_unit(ax):
    from terrainwave.place.position import axis_labels
    from terrainwave.place.units import unit_text

    assert axis_labels(None, is_placed=False) == ("x, samples", "y, samples")
    assert (unit_text(" ft "), unit_text(""), unit_text(None)) == ("ft", *["unit unknown"] * 2)


def test_a_map_is_lit_from_the_north_west_and_only_shaded_as_asked(terrain, ax):
    terrain.plot(ax, shade=0.0, cmap="gray")
    plain = np.asarray(ax.images[0].get_array())[..., 0]
    heights = terrain.read(masked=True).astype(float)
    share = ((heights - heights.min()) / (heights.max() - heights.min())).filled(np.nan)
    known = ~np.isnan(share)
    assert np.abs(plain - share)[known].max() < 1 / 200
    terrain.plot(ax, shade=1.0, cmap="gray")
    shaded = np.asarray(ax.images[-1].get_array())[..., 0]
    lit = np.divide(shaded, plain, out=np.zeros_like(plain), where=plain > 0.05)
    away = np.gradient(np.where(known, heights.filled(0), 0))
    faces_light = away[1] + away[0]  # rises to the east and to the south: towards the light
    clear = known & (plain > 0.05)
    clear[3:11, 5:14] = False
    assert lit[clear & (faces_light > 20)].mean() > lit[clear & (faces_light < -20)].mean() + 0.1


def test_a_map_of_a_part_shows_that_part(terrain, ax):
    left, bottom, _, _ = terrain.bounds
    terrain.plot(ax, bounds=(left, bottom, left + 600, bottom + 300))
    assert ax.images[0].get_extent() == pytest.approx([left, left + 600, bottom, bottom + 300])


def test_a_shade_out_of_range_is_refused(terrain, ax):
    with pytest.raises(InvalidHeightsError, match="found shade 2, expected a finite number, 0 … 1"):
        terrain.plot(ax, shade=2)


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


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1)])
def test_a_map_of_a_single_line_is_drawn_without_light(shape, ax):
    heights = np.arange(shape[0] * shape[1], dtype=np.int16).reshape(shape)
    with terrain_of(heights, max_error=0) as terrain:
        terrain.plot(ax, cmap="gray")
    assert np.asarray(ax.images[0].get_array()).shape == (*shape, 4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1)])
def test_a_view_of_no_surface_is_refused(shape):
    with (
        terrain_of(np.ones(shape, dtype=np.int16), max_error=0) as terrain,
        pytest.raises(InvalidHeightsError, match=f"has {shape[0]} x {shape[1]}"),
    ):
        terrain.view()


def test_a_view_of_voids_is_refused():
    voids = np.full((9, 9), -9, dtype=np.int16)
    with (
        terrain_of(voids, max_error=0, nodata=-9) as terrain,
        pytest.raises(InvalidHeightsError, match="voids only"),
    ):
        terrain.view()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wireframe": True}, "unexpected keyword argument 'wireframe'"),
        ({"mode": "fast"}, "found mode 'fast', expected one of adaptive, batched"),
        ({"mode": ["rqt"]}, "found mode .*, expected one of adaptive, batched"),
        ({"error": "coefficient"}, "found error 'coefficient', expected measured or paper"),
        ({"detail": -1}, "found detail -1, expected a finite number > 0"),
        ({"detail": 0.5, "error": "paper"}, "found detail in mode adaptive, expected mode batched"),
        ({"order": "4"}, "found order the text '4', expected 2 or 4"),
        ({"order": 3, "mode": "batched"}, "found order 3, expected 2 or 4"),
        ({"stepwise": "no"}, "found stepwise 'no', expected True or False"),
        ({"stepwise": True}, "found stepwise in mode adaptive, expected mode dynamic or vertex-"),
        ({"tree": 20, "mode": "dynamic"}, "found tree 20, expected a power of two, 2 … 256"),
        ({"tree": 32}, "found tree in mode adaptive, expected mode dynamic or vertex-texture"),
        ({"orientation": 1}, "found orientation 1, expected True or False"),
        ({"drape": 3}, "found drape 3, expected a path as text"),
        ({"exaggeration": 0}, "found exaggeration 0, expected a finite number > 0"),
        ({"radius": float("nan")}, "found radius nan, expected a finite number > 0"),
        ({"bounds": (1, 2, 3)}, "found bounds .*, expected four finite numbers: left, bottom"),
        ({"camera": "a", "bounds": (1, 2, 3, 4)}, "found both camera and bounds, expected one"),
        ({"style": "plain"}, "found style 'plain', expected a Style"),
        ({"camera": 3}, "found camera 3, expected x,y,z,heading,pitch,fov as a text"),
    ],
)
def test_wrong_arguments_of_a_view_are_told_before_a_window_opens(
    terrain, monkeypatch, options, message
):
    def opened(*_, **__):
        raise AssertionError("opened")

    monkeypatch.setattr("terrainwave.render.window.viewer.run", opened)
    monkeypatch.setattr("terrainwave.render.gpu.canvas.create_context", opened)
    with pytest.raises((InvalidArgumentError, TypeError), match=message):
        terrain.view(**options)


def test_a_view_has_the_options_of_the_command_but_those_of_its_style_and_memory():
    from terrainwave.cli.commands.view import view as command

    own = {option.name for option in command.params} - {"file"}
    of_style = {"coloring", "ramp", "sea_level", "sun", "haze", "wireframe", "background"}
    of_machine = {"memory", "n_workers", "target_ms", "fullscreen", "quiet"}
    named = inspect.signature(Terrain.view).parameters.keys() - {"self", "style"}
    assert named == own - of_style - of_machine
