"""Rasters that are hardly terrains, and transforms that are hardly north-up."""

import io

import numpy as np
import pytest
from render.scenes import ListStore, hills, terrain_of
from twz import twz_bytes

from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Viewport, home, top_view
from terrainwave.render.scene.frame import frame_of
from terrainwave.terrain import Terrain

pytestmark = pytest.mark.large

VIEWPORT = Viewport(120, 80)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 2), (33, 33), (34, 100)])
@pytest.mark.parametrize("kind", ["flat", "void", "rough"])
def test_every_small_raster_has_a_first_view(shape, kind):
    heights = np.full(shape, 7, dtype=np.int16)
    if kind == "void":
        heights[:] = -32768
    if kind == "rough":
        heights = np.round(hills(*shape, 1)).astype(np.int16)
    with terrain_of(heights, max_error=0, nodata=-32768) as terrain:
        with Scene(terrain, ListStore()) as scene:
            for camera in (home(scene.frame.box, VIEWPORT), top_view(scene.frame.box, VIEWPORT)):
                assert np.isfinite(camera.position).all()
                frames = scene.settle(scene.view(camera, VIEWPORT, 1.0))
                assert frames.n_missing == 0
                if kind == "void" or min(shape) == 1:
                    assert frames.n_triangles == 0
                else:
                    assert frames.n_triangles > 0


def test_degrees_become_metres_of_the_ellipsoid():
    """A degree at 60 degrees north: 111 412.9 m of latitude, 55 800.2 m of longitude (WGS 84)."""
    import rasterio
    from rasterio.io import MemoryFile

    heights = np.zeros((61, 61), dtype=np.int16)
    heights[5, 5] = 100
    with MemoryFile() as memory:
        profile = {
            "driver": "GTiff", "height": 61, "width": 61, "count": 1, "dtype": "int16",
            "crs": "EPSG:4326", "transform": rasterio.Affine(1 / 60, 0, 10, 0, -1 / 60, 60.5),
        }  # fmt: skip
        with memory.open(**profile) as dataset:
            dataset.write(heights, 1)
            dataset.units = ("ft",)
        with memory.open() as dataset:
            data = twz_bytes(dataset, max_error=0)
    with Terrain(io.BytesIO(data), threads=1) as terrain:
        frame = frame_of(terrain)
        low, high = frame.box
        latitude = 60.5 - 30.5 / 60
        assert latitude == pytest.approx(60, abs=0.01)
        assert (high - low)[1] == pytest.approx(111_412.9, rel=1e-4)
        assert (high - low)[0] == pytest.approx(55_800.2, rel=1e-3)
        assert high[2] == pytest.approx(30.48)
        sphere = frame_of(terrain, radius=1_737_400.0)
        assert (sphere.box[1] - sphere.box[0])[1] == pytest.approx(np.radians(1) * 1_737_400)
        points = np.array([[10.2, 60.1, 55.0]])
        np.testing.assert_allclose(frame.to_world(frame.to_local(points)), points, rtol=1e-12)


@pytest.mark.parametrize("shape", [(150, 210), (40, 1100)])  # the latter has two segments
def test_boxes_hold_every_original_and_nest(shape):
    heights = np.round(hills(*shape, 3)).astype(np.int16)
    with terrain_of(heights, max_error=3, block=32) as terrain:
        grid = terrain.grid
        for level in range(terrain.n_levels):
            for block in grid.blocks(level):
                low, high = terrain.block_box(block)
                region = grid.full_region(block)
                under = heights[region.slices_in(grid.full_region(grid.blocks(0)[0]))]
                assert low <= under.min()
                assert under.max() <= high
                if grid.segment_head(block) == block:
                    continue  # the boxes below begin with the raster's
                for child in grid.children(block):
                    inner = terrain.block_box(child)
                    assert low <= inner[0] <= inner[1] <= high
