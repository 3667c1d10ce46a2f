"""Colours: by metres on the Earth, by the range elsewhere; of samples, whatever the mesh."""

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.scene.camera import top_view
from terrainwave.render.scene.frame import Frame, frame_of
from terrainwave.render.scene.scales import HeightScale, HeightTexels, Texels

MOON_RADIUS = 1_737_400.0


def is_blue(color):
    return color[2] > color[0] + 20


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
