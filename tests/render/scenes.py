"""Small terrains and a store that is a list, for the tests of rendering."""

import io

import numpy as np
from twz import twz_bytes

from terrainwave.render.scene.camera import Camera, project
from terrainwave.render.scene.patch_kernels import SKIRT_FLAG
from terrainwave.terrain import Terrain

# The background where gaps are looked for.
LOUD = (255, 0, 255)


def hills(n_rows=150, n_cols=210, seed=1, amplitude=300.0):
    """Return fractal heights, float64: sums of bilinear noise, each octave half as high."""
    rng = np.random.default_rng(seed)
    heights = np.zeros((n_rows, n_cols))
    for cells in (2, 4, 8, 16, 32, 64):
        noise = rng.normal(size=(cells + 2, cells + 2))
        rows = np.linspace(0, cells, n_rows)[:, None]
        cols = np.linspace(0, cells, n_cols)[None, :]
        r, c = rows.astype(int), cols.astype(int)
        u, v = rows - r, cols - c
        heights += (amplitude / cells) * (
            noise[r, c] * (1 - u) * (1 - v)
            + noise[r + 1, c] * u * (1 - v)
            + noise[r, c + 1] * (1 - u) * v
            + noise[r + 1, c + 1] * u * v
        )
    return heights


def terrain_of(heights, *, pixel=30.0, corner=(500000, 5200000), nodata=None, crs="EPSG:32633",
               affine=None, **options):  # fmt: skip
    """Return an open terrain of an array whose pixels are `pixel` wide, or lie as `affine` says."""
    import rasterio
    from rasterio.io import MemoryFile

    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            height=heights.shape[0],
            width=heights.shape[1],
            count=1,
            dtype=heights.dtype,
            crs=crs,
            nodata=nodata,
            transform=affine or rasterio.Affine(pixel, 0, corner[0], 0, -pixel, corner[1]),
        ) as dataset:
            dataset.write(heights, 1)
        with memory.open() as dataset:
            data = twz_bytes(dataset, **options)
    return Terrain(io.BytesIO(data), threads=1)


def terrain_with_hole(shape, hole):
    """Return an open lossless terrain of hills, void in the slices `hole`."""
    heights = np.round(hills(*shape, 2)).astype(np.int16)
    heights[hole] = -32768
    return terrain_of(heights, max_error=0, nodata=-32768)


class ListStore:
    """A `Store` that keeps patches in a dict."""

    def __init__(self, max_blocks=10_000):
        self.max_blocks = max_blocks
        self.patches = {}

    def put(self, node, patch):
        if len(self.patches) >= self.max_blocks:
            return False
        self.patches[node] = patch
        return True

    def drop(self, node):
        del self.patches[node]

    @property
    def n_bytes(self):
        return sum(patch.n_bytes for patch in self.patches.values())


def drawn_heights(scene, frames, shape):
    """Return what each drawn patch shows at full-grid samples: (rows, cols, metres) per patch."""
    grid = scene.terrain.grid
    for node, morph in zip(frames.nodes.tolist(), frames.morphs.tolist(), strict=True):
        patch = scene.store.patches[node]
        stride = grid.stride(patch.piece.level)
        first_row = patch.piece.row * grid.block * stride
        first_col = patch.piece.col * grid.block * stride
        z = patch.vertices["z"].astype(float)
        z = z + morph * (patch.vertices["z_parent"].astype(float) - z) + patch.base
        rows = patch.vertices["row"].astype(int) * stride
        cols = (patch.vertices["col"].astype(int) & ~SKIRT_FLAG) * stride
        found = np.full(
            (min(grid.block * stride, shape[0] - 1 - first_row) + 1,
             min(grid.block * stride, shape[1] - 1 - first_col) + 1), np.nan)  # fmt: skip
        is_skirt = patch.vertices["col"] & SKIRT_FLAG != 0
        triangles = patch.triangles[~is_skirt[patch.triangles].any(axis=1)]
        _fill(found, rows[triangles], cols[triangles], z[triangles])
        inside = np.argwhere(~np.isnan(found))
        yield inside[:, 0] + first_row, inside[:, 1] + first_col, found[tuple(inside.T)]


def _fill(found, rows, cols, z):
    """Set the samples in triangles, whose corners are in half samples; arrays of shape (n, 3)."""
    top, bottom = -(-rows.min(1) // 2), np.minimum(rows.max(1) // 2, found.shape[0] - 1)
    left, right = -(-cols.min(1) // 2), np.minimum(cols.max(1) // 2, found.shape[1] - 1)
    n_rows, n_cols = np.maximum(bottom - top + 1, 0), np.maximum(right - left + 1, 0)
    # All samples in the triangles' boxes, one box after the other.
    n_samples = n_rows * n_cols
    of = np.repeat(np.arange(len(rows)), n_samples)
    number = np.arange(len(of)) - np.repeat(np.cumsum(n_samples) - n_samples, n_samples)
    row, col = top[of] + number // n_cols[of], left[of] + number % n_cols[of]
    r, c, rows, cols, z = 2 * row, 2 * col, rows[of].T, cols[of].T, z[of].T
    area = (cols[1] - cols[0]) * (rows[2] - rows[0]) - (cols[2] - cols[0]) * (rows[1] - rows[0])
    one = (c - cols[0]) * (rows[2] - rows[0]) - (cols[2] - cols[0]) * (r - rows[0])
    two = (cols[1] - cols[0]) * (r - rows[0]) - (c - cols[0]) * (rows[1] - rows[0])
    inside = (one >= 0) & (two >= 0) & (one + two <= area)
    surface = z[0] + (one * (z[1] - z[0]) + two * (z[2] - z[0])) / area
    found[row[inside], col[inside]] = surface[inside]


def random_camera(rng, scene):
    low, high = scene.frame.box
    x, y = rng.uniform(low[:2], high[:2]) * 1.3
    z = high[2] + rng.uniform(20, 1.0 * (high - low).max())
    heading = np.degrees(np.arctan2(-x, -y)) + rng.uniform(-40, 40)
    return Camera((x, y, z), heading % 360, rng.uniform(-70, -10), rng.uniform(30, 80))


def apart_on_screen(view, scene, heights, valid, rows, cols, z):
    """Return how far valid originals in view are from drawn heights of samples, pixels."""
    known = valid[rows, cols]
    rows, cols, z = rows[known], cols[known], z[known]
    xy, scale = scene.frame.samples_to_local(rows, cols), view.exaggeration
    size = [view.viewport.width, view.viewport.height, np.inf]
    drawn, true = (
        project(view.camera, view.viewport, np.column_stack([xy, scale * metres]))
        for metres in (z, heights[rows, cols].astype(float))
    )
    with np.errstate(invalid="ignore"):
        seen = ((true >= 0) & (true <= size) & (drawn >= 0) & (drawn <= size)).all(axis=1)
    return np.hypot(*(drawn - true)[seen, :2].T)


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
