"""Rasters that are hardly terrains, and transforms that are hardly north-up."""

import numpy as np
import pytest
from render.scenes import ListStore, hills, terrain_of

from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Viewport, home, top_view

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
