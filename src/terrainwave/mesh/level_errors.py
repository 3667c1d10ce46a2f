"""Largest error of each level: stored in the file, or by equations (2) and (3) of Y10.

E. Yusov, V. Turlapov 2010 (Y10), §2.2 and §2.6. Stored is the measured error: the largest distance
of valid originals under a block from the bilinear surface of its decoded samples. The equations
need no original. They exceed the measured errors, except for originals past the last sample of a
coarse level; and (3) treats a surface of triangles as bilinear.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Block, Region
from terrainwave.mesh.sections import mesher_of
from terrainwave.names import UNBOUNDED_MESHES
from terrainwave.tri.block_mesh import FRACTION_BITS


class LevelErrors(NamedTuple):
    """The largest error of each level in physical units, the coarsest level first."""

    heights: list[float]  # of the bilinear surfaces of blocks
    # of their meshes, by equation (3). None if the file has no meshes with a tolerance.
    meshes: list[float] | None = None


def level_errors(terrain: Any, kind: str) -> LevelErrors:
    """Return the largest error of each level.

    ``"measured"`` reads the index; ``"recursive"`` decodes all levels, windows at a time.
    """
    if kind == "measured":
        return LevelErrors(terrain.level_errors())
    errors = recursive_errors(terrain)
    heights = [float(of_level.max()) for of_level in errors]
    if terrain.mesh_kind in {"none", *UNBOUNDED_MESHES}:
        return LevelErrors(heights)
    return LevelErrors(
        heights, [float(of_level.max()) for of_level in _mesh_errors(terrain, errors)]
    )


def recursive_errors(
    terrain: Any, *, count: Callable[[int], None] = lambda _: None
) -> list[NDArray[np.float64]]:
    """Return Err_Appr of every block by level, the coarsest first, by Y10 equation (2).

    On the full grid Err_Appr(B) = delta, the effective bound. Above it Err_Appr(B) = the largest of
    B's children + Err_Int(B) + delta, where Err_Int(B) is the largest distance of the children's
    decoded samples from B's bilinear surface. In physical units. Decodes all levels, windows at a
    time; `count` is called with numbers of finished samples of the full grid.
    """
    side = terrain.grid.block
    scale = abs(terrain.raster_info.scale)
    bound = terrain.quanta_error
    levels = [np.full(terrain.grid.level_blocks(terrain.n_levels - 1), bound)]
    for level in range(terrain.n_levels - 2, -1, -1):
        finer = levels[-1]
        errors = np.zeros(terrain.grid.level_blocks(level))
        for row, col in np.ndindex(errors.shape):
            children = finer[2 * row : 2 * row + 2, 2 * col : 2 * col + 2]
            apart = _interpolation_error(terrain, level, row * side, col * side) * scale
            errors[row, col] = children.max(initial=0.0) + apart + bound
            if level == terrain.n_levels - 2:
                count(4 * side * side)
        levels.append(errors)
    return levels[::-1]


def _mesh_errors(terrain: Any, errors: list[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Return Err of the mesh of every block: Err_Appr + Err_Tri, Y10 equation (3).

    Err_Tri is the tolerance that the block's mesh keeps, by §2.6 from the block's error as the
    index holds it, rounded up.
    """
    mesher = mesher_of(terrain)
    unit = terrain.quantizer.quantum * abs(terrain.raster_info.scale) / (1 << FRACTION_BITS)
    sums = [of_level.copy() for of_level in errors]
    for level, of_level in enumerate(sums):
        for row, col in np.ndindex(of_level.shape):
            of_level[row, col] += mesher.tolerance(Block(level, row, col)) * unit
    return sums


def _interpolation_error(terrain: Any, level: int, row: int, col: int) -> float:
    """Return the distance of the next level from the surface of the block at (row, col)."""
    side = terrain.grid.block
    n_rows, n_cols = terrain.level_shape(level + 1)
    fine_region = Region(2 * row, 2 * col, 2 * side + 1, 2 * side + 1).intersect(
        Region(0, 0, n_rows, n_cols)
    )
    if 0 in fine_region.shape:
        return 0.0
    fine, fine_valid = terrain.read_with_mask(fine_region, level=level + 1, voids="any")
    coarse_region = Region(row, col, fine_region.n_rows // 2 + 1, fine_region.n_cols // 2 + 1)
    coarse, valid = terrain.read_with_mask(coarse_region, level=level, voids="any")
    surface = _doubled(_doubled(np.where(valid, coarse, 0).astype(np.float64)).T).T
    known = _doubled(_doubled(valid.astype(np.float64)).T).T == 1
    n_rows, n_cols = min(surface.shape[0], fine.shape[0]), min(surface.shape[1], fine.shape[1])
    part = np.s_[:n_rows, :n_cols]
    both = fine_valid[part] & known[part]
    heights = np.where(both, fine[part], 0).astype(np.float64)
    return float(np.abs(np.where(both, surface[part] - heights, 0)).max(initial=0.0))


def _doubled(values: np.ndarray) -> np.ndarray:
    """Return the rows of `values` with the mean of each two between them."""
    doubled = np.repeat(values, 2, axis=0)[:-1]
    doubled[1::2] = (values[:-1] + values[1:]) / 2
    return doubled
