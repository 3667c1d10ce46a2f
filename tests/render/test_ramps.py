"""Are the few colours that a page gets those of the pictures?"""

import numpy as np
import pytest

from terrainwave.render.look.ramps import N_COLORS, RAMPS, ramp_colors, ramp_stops


@pytest.mark.parametrize("name", RAMPS)
@pytest.mark.parametrize(("low", "high"), [(-8000.0, 4000.0), (187.0, 4173.0), (12.0, 12.0)])
def test_stops_are_the_ramp_where_they_are_joined_by_lines(name, low, high):
    stops = ramp_stops(name, low, high)
    at = [height for height, _ in stops]
    assert (np.diff(at) > 0).all()
    colors = np.array([list(bytes.fromhex(color[1:])) for _, color in stops], dtype=float)
    heights = np.linspace(low, high, N_COLORS)
    joined = np.column_stack([np.interp(heights, at, colors[:, k]) for k in range(3)])
    assert np.abs(joined - ramp_colors(name, low, high)).max() < 1.5
