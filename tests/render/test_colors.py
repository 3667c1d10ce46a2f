"""Colours: by metres on the Earth, by the range elsewhere; of samples, whatever the mesh."""

import numpy as np
import pytest
from rasterio.transform import Affine
from render.scenes import hills, terrain_of

from terrainwave.errors import InvalidArgumentError
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.colorings import MEANINGS, RAMP_NAMES
from terrainwave.render.look.ramps import (
    N_LATITUDES,
    RAMPS,
    absolute_palette,
    error_palette,
    relative_palette,
    slope_palette,
    snow_line,
)
from terrainwave.render.look.style import COLORINGS, Style
from terrainwave.render.scene.camera import top_view
from terrainwave.render.scene.frame import Frame, frame_of
from terrainwave.render.scene.scales import HeightScale, HeightTexels, Texels

MOON_RADIUS = 1_737_400.0


def colors_at(palette, *values, row=0):
    return palette.color_of(np.array(values, dtype=float), row).astype(int)


def is_blue(color):
    return color[2] > color[0] + 20


def is_green(color):
    return color[1] > max(color[0], color[2])


def is_white(color):
    return min(color) > 240


@pytest.mark.parametrize("heights", [(-4000.0, 4000.0), (-3.0, 900.0), (0.0, 9.0)])
def test_water_is_blue_up_to_nought_and_land_green_above(heights):
    palette = absolute_palette(*heights, 0.0, (40.0, 40.0))
    assert is_blue(colors_at(palette, 0.0)[0])
    assert is_green(colors_at(palette, 1.0)[0])
    assert is_blue(colors_at(palette, heights[0])[0])


def test_a_height_has_its_colour_whatever_the_rasters_range():
    wide = absolute_palette(-5000.0, 8000.0, 0.0, None)
    narrow = absolute_palette(200.0, 700.0, 0.0, None)
    found, expected = (colors_at(palette, 250.0, 500.0, 690.0) for palette in (wide, narrow))
    assert np.abs(found - expected).max() <= 2


@pytest.mark.parametrize(
    ("latitude", "bare", "white"),
    [(46.0, 2500.0, 3500.0), (-33.0, 3000.0, 6000.0), (0.0, 4000.0, 5600.0), (-75.0, None, 2.0)],
)
def test_snow_lies_above_the_line_of_the_latitude_only(latitude, bare, white):
    palette = absolute_palette(0.0, 8000.0, 0.0, (latitude, latitude))
    assert is_white(colors_at(palette, white)[0])
    none = absolute_palette(0.0, 8000.0, 0.0, None)
    if bare is not None:
        assert snow_line(latitude) > bare
        np.testing.assert_array_equal(colors_at(palette, bare), colors_at(none, bare))
    assert not is_white(colors_at(none, white)[0])


def test_rows_of_the_palette_go_from_the_south_to_the_north():
    palette = absolute_palette(0.0, 3000.0, 0.0, (0.0, 80.0))
    assert palette.colors.shape[0] == N_LATITUDES
    assert not is_white(colors_at(palette, 2000.0)[0])
    assert is_white(colors_at(palette, 2000.0, row=N_LATITUDES - 1)[0])


@pytest.mark.parametrize("name", RAMPS)
def test_relative_colours_go_from_the_lowest_to_the_highest(name):
    palette = relative_palette(name, -30.0, 70.0)
    ends = np.array([RAMPS[name][0][1:], RAMPS[name][-1][1:]])
    np.testing.assert_array_equal(colors_at(palette, -30.0, 70.0), ends)
    np.testing.assert_array_equal(colors_at(relative_palette(name, 5.0, 5.0), 5.0)[0], ends[0])


def test_slopes_and_errors_have_colours_of_their_own():
    assert sum(colors_at(slope_palette(), 0.0)[0]) > sum(colors_at(slope_palette(), 60.0)[0]) + 300
    low, high = colors_at(error_palette(12.0), 0.0, 12.0)
    assert is_blue(low)
    assert high[0] > high[2]


@pytest.mark.parametrize(
    ("crs", "radius", "body"),
    [
        ("EPSG:4326", None, "earth"), ("EPSG:32632", None, "earth"), (None, None, "unknown"),
        ("EPSG:4326", MOON_RADIUS, "moon"), (None, 3_396_190.0, "mars"), (None, 2.6e5, "other"),
    ],
)  # fmt: skip
def test_the_body_is_told_by_its_radius(crs, radius, body):
    heights = np.ones((4, 5), dtype=np.int16)
    import warnings

    place = {"pixel": 30.0} if crs == "EPSG:32632" else {"pixel": 0.01, "corner": (10.0, 60.0)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # degrees are guessed without a CRS
        with terrain_of(heights, max_error=0, crs=crs, **place) as terrain:
            frame = frame_of(terrain, radius=radius)
    assert frame.body == body
    if crs == "EPSG:32632":  # 5 200 000 m of northing
        assert frame.latitudes == pytest.approx((46.95, 46.95), abs=0.01)
    else:
        assert frame.latitudes == pytest.approx((59.965, 59.995))


def test_auto_is_absolute_on_the_earth_and_relative_elsewhere():
    assert Style().is_absolute("earth")
    assert not any(Style().is_absolute(body) for body in ("moon", "mars", "other", "unknown"))
    assert not Style(ramp="cividis").is_absolute("earth")
    assert not Style(coloring="relative").is_absolute("earth")
    assert Style(coloring="absolute").is_absolute("unknown")
    ramps = {body: Style().ramp_on(body) for body in ("unknown", "moon", "mars", "other")}
    assert ramps == {"unknown": "tints", "moon": "grey", "mars": "mars", "other": "grey"}
    assert Style(ramp="cividis").ramp_on("mars") == "cividis"
    Style(coloring="absolute").check_body("earth")
    with pytest.raises(InvalidArgumentError, match="and a raster on the Moon"):
        Style(coloring="absolute").check_body("moon")
    assert set(MEANINGS) == set(COLORINGS)
    assert tuple(RAMPS) == RAMP_NAMES


def stored_heights(frame, quanta, mask):
    """Return what textures hold of heights in quarters of a metre, float64."""
    texels = Texels(frame, HeightScale(0.25, 0.0))
    return texels.of((quanta, mask), (0, 0), quanta.shape, quanta.shape, 1)[:, :, 2].astype(float)


@pytest.mark.parametrize("heights", [(-9000.0, 9000.0), (4000.0, 4010.0), (-5e6, 5e6)])
def test_heights_in_textures_are_near_enough_to_colour_by(heights):
    frame = Frame((0, 0), (1, 1, 1), (1, 0, 0, 0, -1, 0), (9, 9), heights)
    texels = HeightTexels.of(frame)
    quanta = np.round(4 * np.linspace(*heights, 64)).astype(np.int32).reshape(8, 8)
    quanta[4, 4] = round(4 * texels.reference) + 1
    stored = stored_heights(frame, quanta, np.ones((8, 8), dtype=bool))
    apart = np.abs(stored * texels.scale + texels.reference - quanta / 4)
    assert apart.max() <= (heights[1] - heights[0]) / 2000
    assert apart[4, 4] <= 0.001 * texels.scale


def test_voids_take_the_colour_of_what_is_around():
    frame = Frame((0, 0), (1, 1, 1), (1, 0, 0, 0, -1, 0), (5, 5), (100.0, 200.0))
    quanta, valid = np.full((5, 5), 600, dtype=np.int32), np.ones((5, 5), dtype=bool)
    for place in ((2, 2), (0, 0)):
        quanta[place], valid[place] = -32768, False
    np.testing.assert_array_equal(stored_heights(frame, quanta, valid), 50.0)


@pytest.mark.gl
@pytest.mark.large
@pytest.mark.parametrize(
    ("mode", "tau"),
    [
        ("adaptive", 9.0),
        ("batched", 0.01),
        *(
            pytest.param(mode, tau, marks=pytest.mark.full)
            for mode, tau in (("dynamic", 9.0), ("rqt", 0.2), ("vertex-texture", 9.0))
        ),
    ],
)
def test_a_coast_is_where_the_samples_have_it_however_coarse_the_mesh(context, mode, tau):
    heights = np.maximum(np.round(hills(97, 97, 4, 60.0)), 0).astype(np.int16)
    assert 0.2 < (heights == 0).mean() < 0.8
    style = Style(shade=0.0, haze=0.0, solid=False, background=(9, 9, 9))
    with (
        terrain_of(heights, max_error=0, block=128) as terrain,
        Canvas(terrain, (291, 291), samples=0, context=context, mode=mode) as canvas,
    ):
        frame = canvas.scene.frame
        camera = top_view(frame.box, canvas.viewport)
        image, _ = canvas.picture(camera, style, max_pixel_error=tau)
        n_right = n_seen = 0
        for y, x in np.random.default_rng(1).integers(10, 280, (300, 2)):
            place = canvas.pick(x + 0.5, y + 0.5)
            col, row = (place[0] - frame.sample_matrix[2]) / 30, place[1] / -30 + 48
            near = heights[int(row) - 1 : int(row) + 3, int(col) - 1 : int(col) + 3]
            if (near == 0).all() or (near > 0).all():
                n_seen += 1
                n_right += is_blue(image[y, x].astype(int)) == (near == 0).all()
    assert n_seen > 100
    assert n_right > 0.97 * n_seen


# How rasters of 97 x 97 samples hold the same ground: rows and columns turned, and their affine.
_TURNED = {
    "south_up": (lambda z: z[::-1], (30, 0, 0, 0, 30, -2910)),
    "east_left": (lambda z: z[:, ::-1], (-30, 0, 2910, 0, -30, 0)),
    "turned_180": (lambda z: z[::-1, ::-1], (-30, 0, 2910, 0, 30, -2910)),
    "transposed": (lambda z: z.T, (0, 30, 0, -30, 0, 0)),
    "turned_90": (lambda z: z.T[:, ::-1], (0, 30, 0, 30, 0, -2910)),
    "turned_270": (lambda z: z.T[::-1], (0, -30, 2910, -30, 0, 0)),
}


def seen_from_above(context, heights, affine):
    style = Style(haze=0.0, solid=False, background=(9, 9, 9))
    with (
        terrain_of(heights, max_error=0, affine=Affine(*affine)) as terrain,
        Canvas(terrain, (200, 200), samples=0, context=context) as canvas,
    ):
        camera = top_view(canvas.scene.frame.box, canvas.viewport)
        image, _ = canvas.picture(camera, style, max_pixel_error=0.2)
    return image.astype(float)[10:-10, 10:-10]


@pytest.mark.few(2)
@pytest.mark.gl
@pytest.mark.large
@pytest.mark.parametrize("turn", _TURNED)
def test_ridges_are_shaded_alike_however_the_raster_lies(context, turn):
    heights = np.round(hills(97, 97, 4, 900.0)).astype(np.int16)
    turned, affine = _TURNED[turn]
    plain = seen_from_above(context, heights, (30, 0, 0, 0, -30, 0))
    other = seen_from_above(context, np.ascontiguousarray(turned(heights)), affine)
    # without ridges transposed rasters differ by several grey levels
    assert np.abs(other - plain).mean() < 1.0
    assert plain.std() > 20
