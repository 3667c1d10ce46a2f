"""Where is water? Only where heights say so: level at 0, or below all dry land."""

import numpy as np
import pytest
from render.scenes import terrain_of

from terrainwave.errors import InvalidArgumentError
from terrainwave.ext.publish import publish_site
from terrainwave.ext.serve.app import make_app
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.look.water import (
    DEEP,
    LAND,
    LEVEL,
    find_water,
)
from terrainwave.render.scene.camera import top_view

SIDE = 120
COLS = np.broadcast_to(np.arange(SIDE, dtype=float), (SIDE, SIDE))
ROUGH = np.random.default_rng(5).normal(0, 0.6, (SIDE, SIDE))
PLACE = {"crs": "EPSG:32611", "pixel": 30.0, "corner": (5e5, 4e6)}

# What lies where, by columns: heights, a column of each kind of ground, and what is expected there.
VALLEY = np.abs(COLS - 60) * 5 - 86 + ROUGH  # down to -86 m, dry, as Death Valley
SEA_FLOOR = np.where(COLS < 60, -40 * (60 - COLS), 20 * (COLS - 60) + 5)
COAST = np.where(COLS < 60, 0.0, 3 * (COLS - 59))
POLDERS = np.where(COLS < 60, 0.0, -4 + ROUGH)
DEPRESSION = np.where(COLS < 60, -28.0, -28 + (COLS - 60))  # a lake at -28 m, as the Caspian Sea
PLAIN = np.round((COLS - 60) * 0.2)  # slopes through 0 so gently that it is level there
BOTH = np.where(COLS < 40, -15 * (41 - COLS), np.abs(COLS - 85) * 6 - 86)
BOTH[:, 38:60] = 300.0
HARBOUR = COAST.copy()
HARBOUR[50:70, 80:100] = 0.0
CASES = {
    "valley": (VALLEY, {60: LAND, 40: LAND, 5: LAND}),
    "sea floor": (SEA_FLOOR, {2: DEEP, 30: DEEP, 57: DEEP, 100: LAND}),
    "coast": (COAST, {2: LEVEL, 57: LEVEL, 100: LAND}),
    "polders": (POLDERS, {2: LEVEL, 57: LEVEL, 70: LAND, 110: LAND}),
    "depression": (DEPRESSION, {20: LAND, 70: LAND, 88: LAND, 110: LAND}),
    "plain": (PLAIN, {20: LAND, 60: LAND, 100: LAND}),
    "sea and valley": (BOTH, {2: DEEP, 30: DEEP, 60: LAND, 85: LAND, 110: LAND}),
    "harbour": (HARBOUR, {2: LEVEL, 90: LEVEL, 110: LAND}),
    "mountains": (COLS * 20.0 + 1, {2: LAND, 100: LAND}),
    "sea alone": (COLS * 0.0, {2: LEVEL, 100: LEVEL}),
    "floor alone": (COLS * -10.0 - 20, {2: DEEP, 100: DEEP}),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("is_turned", [False, True])
def test_water_is_where_heights_say_so(name, is_turned):
    heights, expected = CASES[name]
    valid = np.ones(heights.shape, dtype=bool)
    cells = find_water(heights.T, valid, 0.02).T if is_turned else find_water(heights, valid, 0.02)
    assert {col: cells[60, col] for col in expected} == expected


def test_voids_are_no_depths():
    valid = np.abs(COLS - 60) > 2
    assert not find_water(np.where(valid, VALLEY, -9999.0), valid, 0.02).any()


@pytest.mark.parametrize("sea", ["high", np.nan, np.inf])
def test_what_is_no_sea_level_is_refused(tmp_path, sea):
    with pytest.raises(InvalidArgumentError, match=r"found sea_level .*, expected auto, none or"):
        Style(sea_level=sea)
    with pytest.raises(InvalidArgumentError, match="found sea_level"):
        make_app([], sea_level=sea)
    with pytest.raises(InvalidArgumentError, match="found sea_level"):
        publish_site([], tmp_path / "site", sea_level=sea)


@pytest.mark.full
@pytest.mark.gl
def test_pictures_show_water_where_it_is(context):
    def blue_columns(heights, sea_level="auto"):
        heights = np.round(heights).astype(np.int16)
        style = Style(shade=0.0, haze=0.0, solid=False, background=(9, 9, 9), sea_level=sea_level)
        with (
            terrain_of(heights, max_error=0, **PLACE) as terrain,
            Canvas(terrain, (360, 360), samples=0, context=context) as canvas,
        ):
            frame = canvas.scene.frame
            camera = top_view(frame.box, canvas.viewport)
            image, _ = canvas.picture(camera, style, max_pixel_error=1.0)
            row, found = image[180].astype(int), {}
            for x in np.flatnonzero((row != 9).any(axis=1)):
                place = canvas.pick(x + 0.5, 180.5)
                if place is not None:
                    col = round((place[0] - frame.sample_matrix[2]) / 30)
                    found[col] = bool(row[x, 2] > row[x, 0] + 20)
        return found

    for name, (heights, expected) in CASES.items():
        found = blue_columns(heights)
        assert {col: found[col] for col in expected} == {
            col: code != LAND for col, code in expected.items()
        }, name
    assert blue_columns(VALLEY, 0.0)[60]
    assert not blue_columns(VALLEY, -90.0)[60]
    assert not any(blue_columns(SEA_FLOOR, "none").values())
