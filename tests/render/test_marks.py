"""Legends and scale bars, drawn over pictures."""

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.errors import InvalidArgumentError
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.marks import check_marks, draw_marks, legend_of, length_text
from terrainwave.render.look.ramps import absolute_palette, relative_palette, slope_palette
from terrainwave.render.look.style import Style
from terrainwave.render.scene.camera import Camera, home, top_view
from terrainwave.render.scene.frame import Frame
from terrainwave.render.window.pictures import with_marks

FRAME = Frame((0, 0), (1.0, 1.0, 1.0), (1, 0, 0, 0, -1, 0), (9, 9), (-1000.0, 3000.0))
FEET = Frame((0, 0), (1.0, 1.0, 0.3048), (1, 0, 0, 0, -1, 0), (9, 9), (0.0, 1000.0))


def test_a_legend_has_round_heights_in_their_places_and_the_unit():
    palette = absolute_palette(-1000.0, 3000.0, 0.0, None)
    legend = legend_of(Style(), palette, FRAME, "m", has_voids=False)
    assert legend.title == "height, m"
    assert [text for _, text in legend.labels] == ["-1000", "0", "1000", "2000", "3000"]
    assert [share for share, _ in legend.labels] == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    # Below the quarter it is water, above it land.
    below, above = (legend.colors[int(share * 260)].astype(int) for share in (0.23, 0.27))
    assert below[2] > below[0] + 20
    assert above[1] > above[2] + 20


def test_heights_of_a_legend_are_in_the_files_unit():
    legend = legend_of(Style(), relative_palette("grey", 0.0, 304.8), FEET, "ft", has_voids=False)
    assert legend.title == "height, ft"
    assert legend.labels[-1] == (1.0, "1000")
    for place, color in ((0, [96, 94, 92]), (130, [150, 147, 143]), (-1, [206, 203, 198])):
        assert np.abs(legend.colors[place].astype(int) - color).max() <= 1
    unknown = legend_of(Style(), relative_palette("grey", 0.0, 1.0), FEET, None, has_voids=False)
    assert unknown.title == "height, unit unknown"


def test_slopes_are_in_degrees_and_a_flat_raster_has_one_label():
    legend = legend_of(Style(coloring="slope"), slope_palette(), FRAME, "m", has_voids=True)
    assert (legend.title, legend.labels[0], legend.labels[-1]) == (
        "slope, degrees", (0.0, "0"), (1.0, "60")
    )  # fmt: skip
    flat = Frame((0, 0), (1.0, 1.0, 1.0), (1, 0, 0, 0, -1, 0), (9, 9), (7.0, 7.0))
    legend = legend_of(Style(), relative_palette("grey", 7.0, 7.0), flat, "m", has_voids=False)
    assert legend.labels == [(0.5, "7")]


def test_a_drawn_legend_has_its_colours_from_the_lowest_below_to_the_highest_above():
    legend = legend_of(
        Style(), relative_palette("cividis", -1000, 3000), FRAME, "m", has_voids=True
    )
    image = draw_marks(np.full((300, 400, 3), 90, np.uint8), legend=legend, metres_per_pixel=None)
    bar = image[44:166, 24].astype(int)
    assert np.abs(bar[0] - legend.colors[-4]).max() < 12
    assert np.abs(bar[-1] - legend.colors[8]).max() < 25
    assert (np.diff(bar.sum(axis=1)) <= 0).all()  # darker downwards, all the way
    assert (image[:, 250:] == 90).all()


def test_marks_that_make_no_sense_are_refused():
    for coloring in ("plain", "level", "flat"):
        with pytest.raises(InvalidArgumentError, match=f"with coloring {coloring}, expected"):
            check_marks((640, 480), Style(coloring=coloring), legend=True, scale_bar=False)
    with pytest.raises(InvalidArgumentError, match="found size 60x480, expected at least 240x180"):
        check_marks((60, 480), Style(), legend=False, scale_bar=True)
    check_marks((60, 40), Style(coloring="flat"), legend=False, scale_bar=False)


@pytest.mark.gl
@pytest.mark.large
def test_the_scale_bar_is_as_long_as_it_says_in_the_middle(context):
    heights = np.round(hills(60, 70, 1, 20.0)).astype(np.int16)
    heights[25:36, 30:41] = -99
    style = Style()
    with (
        terrain_of(heights, max_error=0, nodata=-99) as terrain,
        Canvas(terrain, (320, 240), samples=0, context=context) as canvas,
    ):
        camera = top_view(canvas.scene.frame.box, canvas.viewport)
        bare, frames = canvas.picture(camera, style)
        # Heights there vary by some ten metres, seen from 2.5 km: the bar by a percent.
        first, second = (canvas.pick(x, 60.5) for x in (60.5, 260.5))
        scale = (second[0] - first[0]) / 200
        assert canvas.metres_per_pixel() == pytest.approx(scale, rel=0.02)
        marked = with_marks(canvas, bare, frames, style, legend=True, scale_bar=True)
        line = marked[240 - 22]
        white = np.flatnonzero((line == 255).all(axis=1))
        assert length_text(1000) == "1 km"
        assert len(white) * scale == pytest.approx(1000, rel=0.04)
        assert not np.array_equal(marked[:, :200], bare[:, :200])
        np.testing.assert_array_equal(marked[40:180, 180:], bare[40:180, 180:])
        canvas.picture(Camera((0.0, 0.0, 500.0), 0, 80), style)
        assert canvas.metres_per_pixel() is None
        canvas.picture(home(canvas.scene.frame.box, canvas.viewport), style)
        assert canvas.metres_per_pixel() > 0
