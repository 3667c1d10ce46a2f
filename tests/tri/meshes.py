"""Meshes made by hand: what Terrain.mesh would give, without it."""

import numpy as np

from terrainwave.export.mesh import Mesh


def grid_mesh(heights, transform, *, valid=None, error=0.5, crs=None, units=None, **attributes):
    """Return two triangles for each cell of samples whose four corners are valid.

    `transform` is (a, b, c, d, e, f) of an area raster: vertices lie at pixel centres.
    """
    heights = np.asarray(heights, dtype=np.float64)
    valid = np.ones(heights.shape, dtype=bool) if valid is None else valid
    a, b, c, d, e, f = transform
    rows, cols = np.indices(heights.shape) + 0.5
    points = np.stack([a * cols + b * rows + c, d * cols + e * rows + f, heights], axis=-1)
    points = points.reshape(-1, 3)
    number = np.arange(heights.size).reshape(heights.shape)
    north_west, north_east = number[:-1, :-1], number[:-1, 1:]
    south_west, south_east = number[1:, :-1], number[1:, 1:]
    whole = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    triangles = np.concatenate(
        [
            np.stack([north_west, south_west, south_east], axis=-1)[whole],
            np.stack([north_west, south_east, north_east], axis=-1)[whole],
        ]
    )
    if a * e - b * d > 0:  # south-up: the order is mirrored
        triangles = triangles[:, ::-1]
    origin = tuple(float(value) for value in points[heights.size // 2])
    return Mesh(
        vertices=points - origin,
        triangles=triangles.astype(np.int32),
        origin=origin,
        error=error,
        crs=crs,
        units=units,
        attributes=attributes,
    )


def hills(n_rows, n_cols):
    """Return heights of 100 to 300, smooth."""
    row, col = np.mgrid[:n_rows, :n_cols]
    return 200 + 60 * np.sin(row / 3.0) + 40 * np.cos(col / 4.0)
