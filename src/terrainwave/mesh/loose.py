"""Triangulations of only the zero trees, without a guarantee (Yusov & Turlapov 2010, §2.4).

Every sample of a block moves to the root of the zero tree that holds it. The trees are those that
the file's meshes follow, or else those of decoded layers. The error has no bound beforehand: it is
measured.
"""

from collections.abc import Callable, Iterable

import numpy as np

from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block
from terrainwave.mesh.codes import has_triangles
from terrainwave.mesh.sections import mesher_of
from terrainwave.mesh.trees import coded_source, layer_source
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh, no_mesh
from terrainwave.tri.mesh_surface import surface_at
from terrainwave.tri.zerotree.agreement import BorderVertices, Position, agree, border_of_cut
from terrainwave.tri.zerotree.connect import LooseMesh, loose_mesh
from terrainwave.tri.zerotree.labels import Trees


class LooseMesher:
    """Meshes without a guarantee of blocks above the finest level of a file.

    The threshold of significant details of decoded layers is multiplied by three quarters `n_steps`
    times.
    """

    def __init__(self, file: TerrainFile, n_steps: int = 0) -> None:
        # trees follow a threshold; else the file has coded them
        self.has_threshold = file.header.mesh != "zerotree-coded"
        of_layers, coded = layer_source(file.decoder), coded_source(file.decoder)

        def by_threshold(block: Block, tolerance: int) -> Trees | None:
            return of_layers(block, max(tolerance * 3**n_steps >> 2 * n_steps, 1))

        self._mesher = mesher_of(file, trees=by_threshold if self.has_threshold else coded)

    def samples_within(self, block: Block, mesh: BlockMesh) -> tuple[int, int]:
        samples = self._mesher.samples(block)
        surface = np.full(samples.mask.size, np.nan)
        n_rows, n_cols = samples.mask.shape
        numbers = np.full((2 * n_rows - 1, 2 * n_cols - 1), -1, dtype=np.int32)  # half samples
        numbers[::2, ::2] = np.arange(n_rows * n_cols).reshape(n_rows, n_cols)
        surface_at(mesh.rows, mesh.cols, mesh.heights, mesh.triangles, 1, 0, 0, numbers, surface)
        heights = samples.heights.ravel() * float(1 << FRACTION_BITS)
        is_covered = samples.mask.ravel() & ~np.isnan(surface)
        apart = np.abs(surface - heights)[is_covered]
        return len(apart), int((apart <= self._mesher.tolerance(block)).sum())

    def mesh(self, block: Block) -> BlockMesh:
        """Return the mesh of a single block; its borders may differ from its neighbours'."""
        loose = self._triangulate(block, None)
        return no_mesh() if loose is None else loose.mesh

    def meshes(
        self, blocks: Iterable[Block], run: Callable[..., Iterable[LooseMesh]] = map
    ) -> dict[Block, BlockMesh]:
        """Return the meshes of blocks of one level, with the same vertices on shared borders.

        `run` as in `tri.zerotree.agreement.agree`. Blocks without triangles are left out.
        """
        meshed = [block for block in blocks if self._mesher.has_mesh(block)]
        if not meshed:
            return {}
        level = meshed[0].level

        def triangulate(position: Position, demanded: BorderVertices | None) -> LooseMesh:
            loose = self._triangulate(Block(level, *position), demanded)
            assert loose is not None  # `has_mesh` is true
            return loose

        agreed, _ = agree(
            [(block.row, block.col) for block in meshed],
            triangulate,
            lambda loose: border_of_cut(loose.cut),
            run,
        )
        return {Block(level, *position): loose.mesh for position, loose in agreed.items()}

    def _triangulate(self, block: Block, demanded: BorderVertices | None) -> LooseMesh | None:
        samples = self._mesher.stored_samples(block)
        if not has_triangles(samples.mask):
            return None
        keep = samples.locked
        if demanded is not None:
            keep = keep | demanded.keep(keep.shape)
        trees = samples.trees
        if trees is None:  # the group below is coded without trees: all detail may be there
            trees = np.zeros(keep.shape, dtype=np.uint8)
        return loose_mesh(samples.heights, samples.mask, trees, keep)
