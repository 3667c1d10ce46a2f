"""Pixels drawn without a screen: no gaps, equal shades on borders, the surface where it should be.

These need EGL and an OpenGL 3.3 driver, such as Mesa's (see tools/install_gl.sh); without one they
fail.
"""

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.render.camera import Camera, home, project, top_view
from terrainwave.render.offscreen import Offscreen, create_context
from terrainwave.render.renderer import Renderer, Style

pytestmark = [pytest.mark.gl, pytest.mark.large]

LOUD = (255, 0, 255)
SIZE = (320, 240)


@pytest.fixture(scope="module")
def context():
    context = create_context()
    yield context
    context.release()


@pytest.fixture(autouse=True)
def no_gl_errors(context):
    assert context.error == "GL_NO_ERROR"
    yield
    assert context.error == "GL_NO_ERROR"


@pytest.fixture(scope="module")
def rough():
    with terrain_of(np.round(hills(150, 210, 1)).astype(np.int16), max_error=0) as terrain:
        yield terrain


@pytest.fixture(scope="module")
def with_voids():
    heights = np.round(hills(133, 170, 2)).astype(np.int16)
    heights[40:60, 30:55] = -32768
    with terrain_of(heights, max_error=0, nodata=-32768) as terrain:
        yield terrain


def loud(image):
    return (image == LOUD).all(axis=2)


def eroded(mask, n=1):
    """Return the pixels whose neighbours up to n away are all in the mask."""
    for _ in range(n):
        padded = np.pad(mask, 1)
        near = [padded[1 + r : padded.shape[0] - 1 + r, 1 + c : padded.shape[1] - 1 + c]
                for r in (-1, 0, 1) for c in (-1, 0, 1)]  # fmt: skip
        mask = np.logical_and.reduce(near)
    return mask


def random_camera(rng, frame):
    low, high = frame.box
    x, y = rng.uniform(low[:2], high[:2])
    z = high[2] + rng.uniform(30, 0.4 * (high - low).max())
    heading = np.degrees(np.arctan2(-x, -y)) + rng.uniform(-60, 60)
    return Camera((x, y, z), heading % 360, rng.uniform(-80, -15), rng.uniform(30, 80))


@pytest.mark.parametrize("tau", [1.0, 6.0])
def test_no_gap_shows_where_the_full_terrain_has_none(context, rough, tau):
    rng = np.random.default_rng(1)
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    n_levels = set()
    with (
        Offscreen(rough, SIZE, mode="full", **options) as full,
        Offscreen(rough, SIZE, **options) as adaptive,
    ):
        for _ in range(15):
            camera = random_camera(rng, full.scene.frame)
            reference, _ = full.picture(camera, style)
            image, frames = adaptive.picture(camera, style, max_pixel_error=tau)
            pieces = [adaptive.scene.table.pieces[node] for node in frames.nodes.tolist()]
            n_levels |= {(piece.level, piece.variant) for piece in pieces}
            # Outlines against the background may move by τ and a pixel.
            inside = eroded(~loud(reference), int(np.ceil(tau)) + 1)
            assert inside.sum() > 1000
            assert (loud(image) & inside).sum() == 0
    assert len(n_levels) > 2


def test_no_gap_shows_while_paging(context, rough):
    """Blocks of all levels side by side, parents standing in: still no gap."""
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    with (
        Offscreen(rough, SIZE, mode="full", **options) as full,
        Offscreen(rough, SIZE, n_workers=1, **options) as adaptive,
    ):
        camera = Camera((0.0, -1500.0, full.scene.frame.box[1][2] + 200), 0, -25, 60)
        reference, _ = full.picture(camera, style)
        adaptive.picture(camera, style, max_pixel_error=1e5)  # the root alone
        n_frames, is_done = 0, False
        while not is_done:
            image, frames = adaptive.picture(camera, style, max_pixel_error=0.5, settle=False)
            inside = eroded(~loud(reference), 12)  # the root is coarse
            assert inside.sum() > 1000
            assert (loud(image) & inside).sum() == 0
            is_done = not frames.n_missing
            n_frames += 1
            adaptive.scene._pager.wait(5)
        assert n_frames > 3


def test_voids_are_as_in_the_full_terrain(context, with_voids):
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    with (
        Offscreen(with_voids, SIZE, mode="full", **options) as full,
        Offscreen(with_voids, SIZE, **options) as adaptive,
    ):
        camera = top_view(full.scene.frame.box, full.viewport)
        reference, _ = full.picture(camera, style)
        image, _ = adaptive.picture(camera, style, max_pixel_error=0.2)
        assert eroded(loud(reference)).sum() > 100
        assert (loud(image) & eroded(~loud(reference))).sum() == 0
        assert (~loud(image) & eroded(loud(reference))).sum() == 0


def test_shades_agree_across_borders_of_one_level(context):
    """On a smooth surface, whose shade hardly changes from pixel to pixel."""
    rows, cols = np.mgrid[0:129, 0:129]
    smooth = (400 * np.sin(rows / 40) * np.cos(cols / 45)).astype(np.float32)
    with terrain_of(smooth, max_error=0.01, mesh_error=4.0) as terrain:
        with Offscreen(terrain, (516, 516), samples=0, context=context) as offscreen:
            camera = top_view(offscreen.scene.frame.box, offscreen.viewport)
            style = Style(coloring="plain", haze=0, background=LOUD)
            view = offscreen.scene.view(camera, offscreen.viewport, 0.5)
            image, frames = offscreen.picture(camera, style, max_pixel_error=0.5)
            pieces = [offscreen.scene.table.pieces[node] for node in frames.nodes.tolist()]
            assert len({piece.level for piece in pieces}) == 1
            assert len(pieces) == 16
            grey = image.astype(int)
            # Second differences: a step at a border would stand out from the slow change.
            for k in (1, 2, 3):
                xy = offscreen.scene.frame.samples_to_local(np.array([64]), np.array([32 * k]))
                column = round(float(project(camera, view.viewport, np.array([[*xy[0], 0.0]]))[0, 0]))
                band = grey[40:-40, column - 4 : column + 4]
                steps = np.diff(band, axis=1)
                assert np.abs(np.diff(steps, axis=1)).max() <= 2
                assert np.abs(steps).max() <= 3


def test_the_surface_is_where_the_heights_are(context, rough):
    """Depths seen from above against decoded heights."""
    heights = rough.read().astype(float)
    with Offscreen(rough, (420, 300), samples=0, context=context) as offscreen:
        camera = top_view(offscreen.scene.frame.box, offscreen.viewport)
        style = Style(background=LOUD)
        view = offscreen.scene.view(camera, offscreen.viewport, 0.05)
        _, frames = offscreen.picture(camera, style, max_pixel_error=0.05)
        near, far = offscreen.renderer.depth_range(view, frames)
        data = offscreen._target.read(components=1, attachment=-1, dtype="f4")
        depth = np.frombuffer(data, dtype=np.float32).reshape(300, 420)[::-1].astype(float)
        depth = 2 * near * far / (far + near - (2 * depth - 1) * (far - near))
        rows, cols = np.mgrid[10:140:5, 10:200:5]
        rows, cols = rows.ravel(), cols.ravel()
        xy = offscreen.scene.frame.samples_to_local(rows, cols)
        pixels = project(camera, view.viewport, np.column_stack([xy, heights[rows, cols]]))
        x, y = pixels[:, 0].astype(int), pixels[:, 1].astype(int)
        z = camera.position[2] - depth[y, x]
        # Half a pixel beside the sample the surface is elsewhere by slope · half a pixel.
        slope = np.hypot(*np.gradient(heights))[rows, cols] / 30
        pixel = pixels[:, 2] / view.viewport.height * 2 * np.tan(np.radians(25))
        assert (np.abs(z - heights[rows, cols]) <= 2 + 3 * slope * pixel + 0.3 * pixel).all()
        assert np.median(np.abs(z - heights[rows, cols])) < 6


def test_drawing_block_by_block_gives_the_same_picture(context, rough):
    """What a driver without indirect draws (OpenGL 3.3, macOS) does."""
    style = Style()
    with Offscreen(rough, SIZE, samples=0, context=context) as offscreen:
        camera = home(offscreen.scene.frame.box, offscreen.viewport)
        image, frames = offscreen.picture(camera, style)
        assert offscreen.renderer.is_indirect
        assert offscreen.renderer.n_draw_calls == 1
        offscreen.renderer.release()
        offscreen.renderer = Renderer(context, offscreen.scene, offscreen.store, indirect=False)
        again, _ = offscreen.picture(camera, style)
        assert offscreen.renderer.n_draw_calls == len(frames.nodes)
        np.testing.assert_array_equal(image, again)


def test_a_picture_is_the_same_each_time(context, rough):
    images = []
    for n_workers in (1, 3):
        with Offscreen(rough, SIZE, context=context, n_workers=n_workers) as offscreen:
            camera = home(offscreen.scene.frame.box, offscreen.viewport)
            images.append(offscreen.picture(camera, Style())[0])
    np.testing.assert_array_equal(*images)


def test_buffers_grow_and_memory_keeps_to_its_limit(context, rough):
    with Offscreen(rough, SIZE, context=context, max_bytes=64 << 20) as offscreen:
        rng = np.random.default_rng(2)
        sizes = []
        for _ in range(12):
            offscreen.picture(
                random_camera(rng, offscreen.scene.frame), Style(), max_pixel_error=0.3
            )
            sizes.append(offscreen.store.n_bytes)
        assert max(sizes) <= 64 << 20


@pytest.mark.parametrize("coloring", ["ground", "ramp", "level", "error", "plain"])
def test_every_colouring_draws_the_terrain_in_many_colours(context, rough, coloring):
    with Offscreen(rough, SIZE, samples=0, context=context) as offscreen:
        camera = home(offscreen.scene.frame.box, offscreen.viewport)
        style = Style(coloring=coloring, background=LOUD)
        image, _ = offscreen.picture(camera, style)
        terrain = image[~loud(image)]
        assert len(terrain) > 3000
        assert len(np.unique(terrain, axis=0)) > 50
