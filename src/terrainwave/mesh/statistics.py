"""Statistics of the meshes of each level of a file, and of their zero trees."""

from typing import NamedTuple

import numpy as np

from terrainwave.file import TerrainFile
from terrainwave.mesh.loose import LooseMesher
from terrainwave.mesh.sections import mesher_of, parts_of_blocks


class MeshLevel(NamedTuple):
    """The meshes of the blocks of a level."""

    level: int  # counted from the coarsest, 0
    n_triangles: int  # of the stored meshes
    # stored bits of the meshes per sample of the level (Yusov & Turlapov 2010, tables 1 and 2); 0
    # for kinds computed from heights
    label_bits: float
    # share of the finest nodes of the trees with a significant coefficient. This and the next are
    # None for meshes without zero trees, and on the finest level.
    significant: float | None
    n_loose: int | None  # triangles of the blocks' non-guaranteed meshes, each block by itself


def mesh_levels(terrain: TerrainFile) -> list[MeshLevel]:
    """Return the statistics of each level's meshes, the coarsest first.

    Decodes the whole file, and makes its meshes; one level at a time.
    """
    if terrain.header.mesh == "none":
        return []
    return [_mesh_level(terrain, level) for level in range(terrain.n_levels)]


def _mesh_level(terrain: TerrainFile, level: int) -> MeshLevel:
    mesher, loose = mesher_of(terrain), LooseMesher(terrain)
    part = parts_of_blocks(terrain.grid, terrain.container.mesh)
    nodes = np.zeros(2, dtype=np.int64)
    n_triangles = n_bytes = n_loose = 0
    for block in terrain.grid.blocks(level):
        n_triangles += len(mesher.mesh(block).triangles)
        n_bytes += len(part(block))
        trees = mesher.zero_trees(block)
        if trees is not None:
            nodes += np.array([np.count_nonzero(trees == 0), trees.size])
            n_loose += len(loose.mesh(block).triangles)

    n_rows, n_cols = terrain.level_shape(level)
    has_trees = bool(nodes[1])
    return MeshLevel(
        level,
        n_triangles,
        8 * n_bytes / (n_rows * n_cols),
        float(nodes[0] / nodes[1]) if has_trees else None,
        n_loose if has_trees else None,
    )
