"""Colours: by metres on the Earth, by the range elsewhere; of samples, whatever the mesh."""

import numpy as np
import pytest

from terrainwave.errors import InvalidArgumentError
from terrainwave.render.look.colorings import MEANINGS, RAMP_NAMES
from terrainwave.render.look.ramps import RAMPS
from terrainwave.render.look.style import COLORINGS, Style
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.scales import HeightScale, HeightTexels, Texels


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
