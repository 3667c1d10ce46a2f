"""What captions of pictures promise, what --measure finds, and what is seen of skirts and walls."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.modes import MODES
from terrainwave.render.scene.camera import home
from terrainwave.render.window.pictures import caption, fly_through

SIZE = (200, 150)
_FAST = ["adaptive", "batched", "full", "loose"]
# What these modes compile takes a minute.
ALL = [mode if mode in _FAST else pytest.param(mode, marks=pytest.mark.full) for mode in MODES]


def scene_of(name="adaptive", *, is_bound=True, has_limit=True, error="measured"):
    mode = SimpleNamespace(name=name, error=error, is_bound=is_bound, has_limit=has_limit)
    return SimpleNamespace(mode=mode)


@pytest.mark.parametrize(
    ("scene", "tau", "kept", "text"),
    [
        (scene_of(), 1.0, 1.0, "within 1 pixels"),
        (scene_of(), 1.0, 1.7, "within 1.7 pixels"),
        (scene_of(), 1.1, 1.1, "within 1.1 pixels"),
        (scene_of(), 1.0, 0.96201, "within 0.963 pixels"),
        (scene_of(), 1.0, 2.1, "within 1 pixels where the file's finest meshes are"),
        (scene_of(), 1.0, math.inf, "within 1 pixels where the file's finest meshes are"),
        (scene_of(), 1e6, math.inf, "no limit: not all that the view needs fits"),
        (scene_of("loose", has_limit=False), 6.0, 6.34, "no limit in mode loose, here within 6.34"
         " pixels"),
        (scene_of("loose", has_limit=False), math.inf, math.inf, "no limit in mode loose"),
        (scene_of(is_bound=False, has_limit=False, error="paper"), 1.0, math.inf,
         "no limit with error paper"),
    ],
)  # fmt: skip
def test_a_caption_says_what_holds_and_where_there_is_no_limit(scene, tau, kept, text):
    assert caption(scene, tau, kept) == text


@pytest.fixture(scope="module")
def jagged():
    """Steep ground of several blocks with holes, one of them across the outline."""
    heights = np.round(hills(90, 110, 3, 700.0)).astype(np.int16)
    heights[20:34, 50:75] = heights[70:, 30:44] = heights[60, 90] = -32768
    with terrain_of(heights, max_error=0, nodata=-32768, block=32) as terrain:
        yield terrain


def seen_from_the_side(canvas):
    return home(canvas.scene.frame.solid_box, canvas.viewport)


@pytest.mark.few(4)
@pytest.mark.gl
@pytest.mark.parametrize("mode", ALL)
@pytest.mark.parametrize("tau", [1.0, 4.0])
def test_a_picture_is_within_its_caption(context, jagged, mode, tau):
    with Canvas(jagged, SIZE, mode=mode, context=context) as canvas:
        camera = seen_from_the_side(canvas)
        ((_, drawn),) = fly_through(canvas, [camera], 1, Style(), tau, measure=True)
        assert drawn["measured_pixel_error"] <= drawn["max_pixel_error"]
        if canvas.scene.mode.has_limit:
            assert drawn["max_pixel_error"] <= tau
            assert drawn["caption"].startswith("within")
        else:
            assert drawn["caption"].startswith("no limit")


@pytest.mark.gl
def test_no_caption_says_less_than_a_gpu_draws(context):
    """Cells of 15 km that meshes keep exactly: only float32 is between drawn and decoded."""
    heights = np.random.default_rng(0).integers(-20_000, 20_000, (33, 33)).astype(np.int16)
    with (
        terrain_of(heights, max_error=0, mesh_error=0, pixel=15_000) as terrain,
        Canvas(terrain, SIZE, mode="full", context=context) as canvas,
    ):
        camera = home(canvas.scene.frame.solid_box, canvas.viewport)
        ((_, drawn),) = fly_through(canvas, [camera], 1, Style(), 1.0, measure=True)
    assert drawn["caption"] == "within 0.00391 pixels"
    assert drawn["measured_pixel_error"] <= drawn["max_pixel_error"] == 1 / 256


@pytest.mark.gl
def test_measuring_finds_a_surface_that_is_off(context, jagged, monkeypatch):
    """By about as many pixels as the vertices were moved."""
    from terrainwave.render.gpu import patch_surface

    with Canvas(jagged, SIZE, context=context) as canvas:
        camera = seen_from_the_side(canvas)
        ((_, right),) = fly_through(canvas, [camera], 1, Style(), 0.5, measure=True)
        instances = patch_surface.PatchSurface.instances

        def moved(self, *arguments):
            found = instances(self, *arguments)
            found[:, 2] += 300.0
            return found

        monkeypatch.setattr(patch_surface.PatchSurface, "instances", moved)
        ((_, wrong),) = fly_through(canvas, [camera], 1, Style(), 0.5, measure=True)
        assert right["measured_pixel_error"] <= 0.5
        assert wrong["measured_pixel_error"] > 5
