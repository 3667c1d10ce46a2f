"""Pixels of the modes whose mesh is made anew each frame; needs OpenGL as `test_pixels` does."""

import numpy as np
import pytest
from render.scenes import LOUD, eroded, hills, loud, terrain_of
from render.test_fronts import cameras, low_flight
from tri.slow_dynamic import drawn_samples

from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.gpu.vertex_texture_surface import VERTEX_SHADER
from terrainwave.render.look.style import Style
from terrainwave.render.modes.dynamic import Dynamic
from terrainwave.render.modes.front import eye_of
from terrainwave.render.scene.camera import top_view

# What these modes compile takes a minute.
pytestmark = [
    pytest.mark.full, pytest.mark.gl, pytest.mark.large, pytest.mark.usefixtures("no_gl_errors")
]  # fmt: skip

SIZE = (160, 120)
MODES = ["dynamic", "rqt", "vertex-texture"]


@pytest.fixture(scope="module")
def rough():
    with terrain_of(np.round(hills(90, 110, 1)).astype(np.int16), max_error=0) as terrain:
        yield terrain


@pytest.mark.parametrize("mode", MODES)
def test_no_gap_shows_where_the_full_terrain_has_none(context, rough, mode):
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    with (
        Canvas(rough, SIZE, mode="full", **options) as full,
        Canvas(rough, SIZE, mode=mode, **options) as coarse,
    ):
        counts = set()
        for tau in (1.0, 5.0):
            for camera in cameras(full.scene.frame, 4, seed=2):
                reference, _ = full.picture(camera, style)
                image, frames = coarse.picture(camera, style, max_pixel_error=tau)
                # Outlines against the background may move by τ and a pixel.
                inside = eroded(~loud(reference), int(np.ceil(tau)) + 1)
                outside = eroded(loud(reference), int(np.ceil(tau)) + 1)
                assert inside.sum() > 300
                assert (loud(image) & inside).sum() == 0
                assert (~loud(image) & outside).sum() == 0
                counts.add(frames.n_triangles)
        assert len(counts) > 4


@pytest.mark.parametrize(  # where coarse levels end short of it
    ("n_cols", "error"), [(209, "measured"), (213, "paper"), (216, "measured"), (216, "paper")]
)
@pytest.mark.parametrize("mode", MODES)
def test_the_terrain_reaches_its_outline_and_no_further(
    context, small_patches, mode, error, n_cols
):
    """Seen from above, at errors that are bounds and at those that are none."""
    heights = np.round(hills(150, n_cols, 3, amplitude=20)).astype(np.int16)
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    with (
        terrain_of(heights, max_error=0) as terrain,
        Canvas(terrain, SIZE, mode="full", **options) as full,
        Canvas(terrain, SIZE, mode=mode, error=error, **options) as coarse,
    ):
        camera = top_view(full.scene.frame.box, full.viewport)
        reference, _ = full.picture(camera, style)
        levels = set()
        for tau in (0.3, 1.0, 4.0, 30.0):
            image, _ = coarse.picture(camera, style, max_pixel_error=tau)
            assert (loud(image) & eroded(~loud(reference), 1)).sum() == 0
            assert (~loud(image) & eroded(loud(reference), 1)).sum() == 0
            levels |= {patch.piece.level for patch in coarse.scene.mode.shown}
        assert len(levels) > 1


@pytest.mark.parametrize("tree", [2, 32])
@pytest.mark.parametrize("mode", ["dynamic", "vertex-texture"])
def test_no_gap_shows_with_trees_of_any_size(context, gentle, monkeypatch, mode, tree):
    """Patches of one tree, or of many small ones; the outline seen from above is the raster's."""
    monkeypatch.setattr(Dynamic, "samples", 32)
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    with (
        Canvas(gentle, SIZE, mode="full", **options) as full,
        Canvas(gentle, SIZE, mode=mode, tree=tree, **options) as coarse,
    ):
        above = top_view(full.scene.frame.box, full.viewport)
        for camera in (above, *low_flight(full.scene, 2)):
            reference, _ = full.picture(camera, style)
            image, _ = coarse.picture(camera, style, max_pixel_error=2.0)
            assert eroded(~loud(reference), 3).sum() > 300
            assert (loud(image) & eroded(~loud(reference), 3)).sum() == 0
            assert camera is not above or (~loud(image) & eroded(loud(reference), 1)).sum() == 0


@pytest.mark.parametrize("error", ["measured", "paper"])
@pytest.mark.parametrize("mode", MODES)
def test_voids_are_as_in_the_full_terrain(context, mode, error):
    heights = np.round(hills(70, 80, 2)).astype(np.int16)
    heights[20:40, 30:55] = -32768
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    with (
        terrain_of(heights, max_error=0, nodata=-32768) as terrain,
        Canvas(terrain, SIZE, mode="full", **options) as full,
        Canvas(terrain, SIZE, mode=mode, error=error, **options) as coarse,
    ):
        camera = top_view(full.scene.frame.box, full.viewport)
        reference, _ = full.picture(camera, style)
        image, _ = coarse.picture(camera, style, max_pixel_error=0.2)
        assert eroded(loud(reference), 2).sum() > 50
        assert (loud(image) & eroded(~loud(reference), 2)).sum() == 0
        assert (~loud(image) & eroded(loud(reference), 2)).sum() == 0


@pytest.mark.parametrize("mode", MODES)
def test_the_picture_is_that_of_the_full_terrain_but_for_tau(context, rough, mode):
    """Shades come from slopes of all samples, so that a fine mesh looks like the full one."""
    style = Style(background=LOUD)
    options = {"samples": 0, "context": context}
    with (
        Canvas(rough, SIZE, mode="full", **options) as full,
        Canvas(rough, SIZE, mode=mode, **options) as coarse,
    ):
        camera = top_view(full.scene.frame.box, full.viewport)
        reference, _ = full.picture(camera, style)
        image, _ = coarse.picture(camera, style, max_pixel_error=0.1)
        inside = eroded(~loud(reference), 2)
        apart = np.abs(image.astype(int) - reference).max(axis=2)[inside]
        assert np.quantile(apart, 0.99) <= 6


@pytest.mark.parametrize("morph", [1.0, 1.6])
@pytest.mark.parametrize("error", ["measured", "paper"])
def test_the_vertex_shader_puts_each_sample_where_the_dynamic_mesh_has_its_root(
    context, rough, error, morph
):
    """By transform feedback: roots and morphs that the GPU finds, against the processor's.

    The camera goes on, so that the marks come in parts, over those of the views before.
    """
    n_checked = n_morphed = 0
    with Canvas(
        rough, SIZE, mode="vertex-texture", error=error, samples=0, context=context
    ) as canvas:
        mode, surface = canvas.scene.mode, canvas.surface
        mode.morph = morph
        program = context.program(
            vertex_shader=VERTEX_SHADER.strip(), varyings=["v_seen", "gl_ClipDistance"]
        )
        for camera in cameras(canvas.scene.frame, 3, seed=4):
            canvas.draw(camera, Style(), max_pixel_error=3.0)
            view = canvas.scene.view(camera, canvas.viewport, 3.0)
            (patch,), (followed,), eye = mode.shown, mode.followed, eye_of(view)
            n = surface.prepare(canvas.scene, 0, patch, followed, eye, program)
            side = mode.tree + 1
            array = context.vertex_array(
                program,
                [(surface.grids[(mode.tree,)][0], "2u2", "in_place"),
                 (surface.trees, "4f4/i", "in_tree")],
            )  # fmt: skip
            program["z_scale"] = 1.0
            buffer = context.buffer(reserve=n * side * side * 32)
            array.transform(buffer, instances=n)
            parts = np.frombuffer(buffer.read(), dtype=np.float32).reshape(n, side, side, 8)
            places = np.frombuffer(surface.trees.read(n * 16), dtype=np.float32).reshape(n, 4)
            buffer.release()
            array.release()
            placed = patch.mesh.draw(eye, followed)
            shape = tuple(patch.mesh.tree.layout[0, 1:].tolist())
            expected = drawn_samples(placed, shape) - camera.eye
            found = np.full((*shape, 4), np.nan)
            for part, (col, row) in zip(parts, places[:, 2:].astype(int), strict=True):
                found[row : row + side - 1, col : col + side - 1] = part[:-1, :-1, :4]
            expected[np.isnan(found[..., 0])] = np.nan  # trees out of view
            found, is_drawn = found[..., :3], found[..., 3] > 0
            np.testing.assert_array_equal(is_drawn, ~np.isnan(expected[..., 0]))
            # Metres; the GPU's are float32 relative to the eye.
            apart = np.abs(found - expected)[is_drawn]
            assert apart.max() < (0.01 if morph == 1.0 else 0.05)
            n_checked += is_drawn.sum()
            still = patch.mesh.draw(eye, followed._replace(threshold=followed.tau))
            n_morphed += (np.abs(placed.vertices - still.vertices).max(axis=1) > 0.5).sum()
        program.release()
    assert n_checked > 90 * 110
    assert (n_morphed > 10) == (morph > 1), n_morphed
