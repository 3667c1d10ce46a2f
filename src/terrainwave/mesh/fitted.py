"""Meshes of the blocks of a cut, whose borders are the same lines on both sides.

Where levels meet, the finer block uses the coarser one's border line unchanged.
"""

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from terrainwave.cache import Cache
from terrainwave.grid.quadtree import Block
from terrainwave.mesh.blocks import BlockMesher, BlockSamples, border_lines
from terrainwave.mesh.cut import OPPOSITE, TOWARDS, Area, Cut, sides_of
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.halves.halves import Lines, triangulate
from terrainwave.tri.halves.simplify import simplify
from terrainwave.tri.mesh_distance import deviation_from_bilinear, largest_deviation

# Tries to mesh a coarse block within the requested error. Other coarse blocks have one try before
# they are refined: finer ones take fewer triangles than further tries.
_TRIES = 3
_CACHE_BYTES = 64 << 20


class MeshedBlock(NamedTuple):
    """A block's mesh and its error against the originals in quanta; None if too large."""

    mesh: BlockMesh
    error: Fraction | None


class BlockFitter:
    """Meshes blocks of a cut; samples of blocks come from a mesher, through a cache.

    `sweeps_at_voids` is the least number of sweeps of collapses for blocks with voids.
    """

    def __init__(self, area: Area, mesher: BlockMesher, sweeps_at_voids: int = 0) -> None:
        self._area, self._grid = area, area.grid
        self._mesher = mesher
        self._sweeps_at_voids = sweeps_at_voids
        self._samples: Cache[Block, BlockSamples] = Cache(_CACHE_BYTES, size_of=_n_bytes)

    def samples_of(self, block: Block) -> BlockSamples:
        return self._samples.get_or_make(block, lambda: self._mesher.samples(block))

    def build(self, cut: Cut, block: Block) -> MeshedBlock:
        """Return the mesh of a block of a cut, within the error of its piece."""
        samples = self._samples.get(block) or self._mesher.samples(block)
        piece, lines = cut.pieces[block], self._lines(cut, block, samples)
        if block.level == self._grid.k_max:
            mesh = self._triangulated(block, samples, lines, piece.tolerance)
            measured = largest_deviation(mesh, 1, samples.heights, samples.mask, 0, 0)
            # Samples on a coarser neighbour's border keep to the error, not to the tolerance.
            error = piece.heights_error + Fraction(measured, 1 << FRACTION_BITS)
            return MeshedBlock(mesh, min(error, piece.error))
        tolerance = piece.tolerance
        for _ in range(_TRIES if block.level == self._area.level else 1):
            mesh = self._triangulated(block, samples, lines, tolerance)
            measured = deviation_from_bilinear(mesh, samples.heights, samples.mask)
            if measured <= piece.tolerance:
                error = piece.heights_error + Fraction(measured, 1 << FRACTION_BITS)
                return MeshedBlock(mesh, error)
            tolerance = tolerance * piece.tolerance // (measured + measured // 16)
        return MeshedBlock(mesh, None)

    def _lines(self, cut: Cut, block: Block, samples: BlockSamples) -> Lines:
        """Return the block's border lines, those of coarser neighbours if there are any."""
        lines = self._own_lines(cut, block, samples)
        for side, (row, col) in TOWARDS.items():
            place = Block(block.level, block.row + row, block.col + col)
            if not self._grid.contains(place):
                continue
            beside = cut.covering(place)
            if beside is None or beside.level == block.level:
                continue
            coarse = self._own_lines(cut, beside, self.samples_of(beside))
            line = getattr(coarse, OPPOSITE[side])
            ratio = 1 << (block.level - beside.level)
            own = np.zeros(len(getattr(lines, side)), dtype=np.bool_)
            first = (block.row if col else block.col) * self._grid.block // ratio
            first -= (beside.row if col else beside.col) * self._grid.block
            n_coarse = (len(own) - 1) // ratio + 1
            own[::ratio] = line[first : first + n_coarse]
            lines = lines._replace(**{side: own})
        return lines

    def _own_lines(self, cut: Cut, block: Block, samples: BlockSamples) -> Lines:
        """Return the block's border lines, with vertices at the corners of finer blocks."""
        if block.level < self._area.level:
            forced = samples.locked.copy()
            for side, finer in cut.finer(block):
                spacing = self._grid.block >> (finer.level - block.level)
                place = finer.row if side in ("left", "right") else finer.col
                first = place * spacing
                first -= (block.row if side in ("left", "right") else block.col) * self._grid.block
                line = sides_of(forced)[side]
                line[[first, min(first + spacing, len(line) - 1)]] = True
            samples = samples._replace(locked=forced)
        return border_lines(samples, cut.pieces[block].sides, self._grid.block)

    def _triangulated(
        self, block: Block, samples: BlockSamples, lines: Lines, tolerance: int
    ) -> BlockMesh:
        mesh = triangulate(*samples, lines, tolerance)
        sweeps = self._area.sweeps if block.level == self._grid.k_max else 0
        if not samples.mask.all():
            sweeps = max(sweeps, self._sweeps_at_voids)
        if not sweeps:
            return mesh
        return simplify(mesh, samples.heights, samples.mask, tolerance, sweeps)


def _n_bytes(samples: BlockSamples) -> int:
    return samples.heights.nbytes + samples.mask.nbytes + samples.locked.nbytes
