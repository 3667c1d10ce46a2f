"""Pixels drawn without a screen: no gaps, equal shades on borders, the surface where it should be.

These need EGL and an OpenGL 3.3 driver, such as Mesa's (see tools/install_system.sh); without one
they fail.
"""

import numpy as np
import pytest
from cases import some
from render.scenes import LOUD, eroded, hills, loud, terrain_of, terrain_with_hole

from terrainwave.raster_io.drape import Drape
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.scene.camera import Camera, home, project, top_view

pytestmark = [pytest.mark.gl, pytest.mark.large, pytest.mark.usefixtures("no_gl_errors")]

SIZE = (320, 240)


@pytest.fixture(scope="module")
def rough():
    with terrain_of(np.round(hills(150, 210, 1)).astype(np.int16), max_error=0) as terrain:
        yield terrain


@pytest.fixture(scope="module")
def with_voids():
    with terrain_with_hole((133, 170), np.s_[40:60, 30:55]) as terrain:
        yield terrain


def random_camera(rng, frame):
    low, high = frame.box
    x, y = rng.uniform(low[:2], high[:2])
    z = high[2] + rng.uniform(30, 0.4 * (high - low).max())
    heading = np.degrees(np.arctan2(-x, -y)) + rng.uniform(-60, 60)
    return Camera((x, y, z), heading % 360, rng.uniform(-80, -15), rng.uniform(30, 80))


@pytest.mark.full
@pytest.mark.parametrize("mode", ["adaptive", "batched"])
@pytest.mark.parametrize("tau", some([6.0, 1.0], 2))
def test_no_gap_shows_where_the_full_terrain_has_none(context, rough, mode, tau):
    rng = np.random.default_rng(1)
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    n_levels = set()
    with (
        Canvas(rough, SIZE, mode="full", **options) as full,
        Canvas(rough, SIZE, mode=mode, **options) as coarse,
    ):
        for _ in range(15):
            camera = random_camera(rng, full.scene.frame)
            reference, _ = full.picture(camera, style)
            image, frames = coarse.picture(camera, style, max_pixel_error=tau)
            pieces = [coarse.scene.table.pieces[node] for node in frames.nodes.tolist()]
            n_levels |= {(piece.level, piece.variant) for piece in pieces}
            # Outlines against the background may move by τ and a pixel.
            inside = eroded(~loud(reference), int(np.ceil(tau)) + 1)
            assert inside.sum() > 1000
            assert (loud(image) & inside).sum() == 0
    assert len(n_levels) > (2 if mode == "adaptive" else 1)


@pytest.mark.full
@pytest.mark.parametrize("mode", ["adaptive", "batched"])
def test_no_gap_shows_while_paging(context, rough, mode):
    """Blocks of all levels side by side, parents standing in: still no gap."""
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    with (
        Canvas(rough, SIZE, mode="full", **options) as full,
        Canvas(rough, SIZE, mode=mode, n_workers=1, **options) as adaptive,
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


@pytest.mark.parametrize("mode", ["adaptive", "batched"])
def test_voids_are_as_in_the_full_terrain(context, with_voids, mode):
    style = Style(background=LOUD, coloring="flat")
    options = {"samples": 0, "context": context}
    with (
        Canvas(with_voids, SIZE, mode="full", **options) as full,
        Canvas(with_voids, SIZE, mode=mode, **options) as adaptive,
    ):
        camera = top_view(full.scene.frame.box, full.viewport)
        reference, _ = full.picture(camera, style)
        image, _ = adaptive.picture(camera, style, max_pixel_error=0.2)
        assert eroded(loud(reference)).sum() > 100
        assert (loud(image) & eroded(~loud(reference))).sum() == 0
        assert (~loud(image) & eroded(loud(reference))).sum() == 0


def waves(rows, cols):
    """Return heights and their slopes to the east and north, of 30 m samples."""
    heights = 200 * np.sin(rows / 11) * np.cos(cols / 9)
    east = -200 / 9 * np.sin(rows / 11) * np.sin(cols / 9) / 30
    north = -200 / 11 * np.cos(rows / 11) * np.cos(cols / 9) / 30
    return heights, east, north


@pytest.mark.few(1)
@pytest.mark.parametrize("mode", ["adaptive", "batched"])
@pytest.mark.parametrize("exaggeration", [1.0, 2.5])
def test_the_surface_and_its_shade_are_where_the_heights_say(context, mode, exaggeration):
    """Places read back from the depth buffer, and greys, against a known function."""
    rows, cols = np.mgrid[0:150, 0:210]
    heights = waves(rows, cols)[0].astype(np.float32)
    style = Style(coloring="plain", haze=0, background=LOUD)
    rng = np.random.default_rng(3)
    with terrain_of(heights, max_error=0.1, mesh_error=0.2) as terrain:
        options = {
            "samples": 0, "context": context, "exaggeration": exaggeration, "mode": mode
        }  # fmt: skip
        with Canvas(terrain, SIZE, **options) as canvas:
            frame, n_seen = canvas.scene.frame, 0
            for number in range(4):
                camera = random_camera(rng, frame)
                if not number:
                    camera = top_view(frame.box, canvas.viewport)
                image, frames = canvas.picture(camera, style, max_pixel_error=0.02)
                assert canvas.scene.table.errors[frames.nodes].max() < 0.6
                for _ in range(60):
                    x, y = rng.integers(0, SIZE[0]), rng.integers(0, SIZE[1])
                    place = canvas.pick(x, y)
                    if place is None:
                        continue
                    col = (place[0] - frame.sample_matrix[2]) / 30
                    row = (place[1] - frame.sample_matrix[5]) / -30
                    if not (2 < row < 147 and 2 < col < 207):
                        continue
                    z, east, north = waves(row, col)
                    # Triangles lie below a curve by curvature / 8; depths have 24 bits.
                    assert abs(place[2] / exaggeration - z) < 1.5
                    normal = np.array([-east * exaggeration, -north * exaggeration, 1.0])
                    normal /= np.linalg.norm(normal)
                    lit = max(normal @ style.sun_vector, 0) / style.sun_vector[2]
                    sun_x, sun_y, up = style.sun_vector
                    fill = max(normal @ [-sun_x, -sun_y, up], 0)
                    light = 0.30 * (0.5 + 0.5 * normal[2]) + 0.22 * fill + 0.60 * min(lit, 1.45)
                    warm = 0.92 + (1.0 - 0.92) * min(lit, 1.0)
                    expected = min(0.80 * light * warm, 1.0) * 255  # green
                    assert abs(int(image[y, x, 1]) - expected) < 4
                    n_seen += 1
            assert n_seen > 80


def test_a_picture_is_the_same_each_time(context, rough):
    images = []
    for n_workers in (1, 3):
        with Canvas(rough, SIZE, context=context, n_workers=n_workers) as canvas:
            camera = home(canvas.scene.frame.box, canvas.viewport)
            images.append(canvas.picture(camera, Style())[0])
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("mode", ["adaptive", "batched"])
def test_a_drape_lies_where_its_coordinates_say(context, rough, tmp_path, mode):
    """Red and green are the column and row of the photo, which covers a part of the terrain."""
    import rasterio

    n = 128
    ramp = np.arange(n, dtype=np.uint8) * 2
    bands = np.stack([np.tile(ramp, (n, 1)), np.tile(ramp[:, None], (1, n)), np.full((n, n), 9)])
    left, top = 500000 + 30 * 40, 5200000 - 30 * 30
    place = rasterio.Affine(30.0 * 100 / n, 0, left, 0, -30.0 * 90 / n, top)
    with rasterio.open(
        tmp_path / "photo.tif", "w", driver="GTiff", count=3, width=n, height=n, dtype="uint8",
        crs="EPSG:32633", transform=place,
    ) as photo:  # fmt: skip
        photo.write(bands.astype(np.uint8))
    style = Style(coloring="plain", shade=0, haze=0, background=LOUD)
    options = {"samples": 0, "context": context, "mode": mode}
    with Canvas(rough, SIZE, drape=str(tmp_path / "photo.tif"), **options) as canvas:
        rng = np.random.default_rng(5)
        n_inside = n_outside = 0
        for camera in (
            top_view(canvas.scene.frame.box, canvas.viewport),
            home(canvas.scene.frame.box, canvas.viewport),
        ):
            image, _ = canvas.picture(camera, style)
            for x, y in rng.integers(0, SIZE, (150, 2)):
                at = canvas.pick(x, y)
                if at is None:
                    continue
                world = canvas.scene.frame.to_world(at[None])[0]
                u = (world[0] - left) * n / 3000
                v = (top - world[1]) * n / 2700
                if 3 < u < n - 3 and 3 < v < n - 3:
                    assert abs(image[y, x, 0] - 2 * (u - 0.5)) < 6
                    assert abs(image[y, x, 1] - 2 * (v - 0.5)) < 6
                    n_inside += 1
                elif not (-3 < u < n + 3 and -3 < v < n + 3):
                    assert (np.abs(image[y, x] - [209, 204, 194]) < 2).all()  # plain
                    n_outside += 1
        assert n_inside > 30
        assert n_outside > 30
        # A finer part: blue over columns 70 to 100 and rows 50 to 80 of the grid.
        blue = np.full((64, 64, 4), (0, 0, 255, 255), dtype=np.uint8)
        canvas.renderer.set_detail(Drape(blue, 70.0, 50.0, 30.0, 30.0))
        frame = canvas.scene.frame
        camera = top_view(frame.box, canvas.viewport)
        image, _ = canvas.picture(camera, style)
        for row, col, is_fine in ((65, 85, True), (65, 125, False), (100, 85, False)):
            at = np.array([*frame.samples_to_local(np.array([row]), np.array([col]))[0], 0.0])
            x, y, _ = project(camera, canvas.viewport, at[None])[0]
            assert (image[int(y), int(x)].tolist() == [0, 0, 255]) == is_fine
