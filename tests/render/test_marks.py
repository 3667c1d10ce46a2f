"""Legends and scale bars, drawn over pictures."""

import pytest

from terrainwave.render.look.marks import legend_of
from terrainwave.render.look.ramps import absolute_palette
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
