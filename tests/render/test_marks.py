"""Legends and scale bars, drawn over pictures."""

import numpy as np
import pytest

from terrainwave.render.look.marks import draw_marks, legend_of
from terrainwave.render.look.ramps import absolute_palette, relative_palette
from terrainwave.render.look.style import Style
from terrainwave.render.scene.frame import Frame

FRAME = Frame((0, 0), (1.0, 1.0, 1.0), (1, 0, 0, 0, -1, 0), (9, 9), (-1000.0, 3000.0))


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
