"""Cut through the quadtree: blocks of several levels that make up an area, for an error.

It has coarse blocks if the index gives their heights at most a quarter of the error, blocks of the
area's level elsewhere. Levels meet only where there is no void.

Along edges of a tile that are not edges of the raster, all blocks and their neighbours are of the
area's level: then the meshes there, and the vertices on these edges, depend only on the heights and
the error. The mesh of the adjacent tile has the same.
"""

from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.container.page import UNMEASURED, decode_error
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.mesh.blocks import BlockMesher, BlockSamples, SideTolerances, outer_lines
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh

# Coarse blocks whose heights take at most this share of the requested error are not refined.
_COARSE_SHARE = 4
TOWARDS = {"top": (-1, 0), "bottom": (1, 0), "left": (0, -1), "right": (0, 1)}
OPPOSITE = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}


class Area(NamedTuple):
    """Part of a terrain to mesh, and options.

    `region` is in samples of `level`; `sweeps` counts sweeps of collapses. With `is_tile` the mesh
    has the vertices of the adjacent areas on its edges.
    """

    grid: Grid
    region: Region
    level: int
    sweeps: int = 0
    is_tile: bool = False

    @property
    def is_finest(self) -> bool:
        return self.level == self.grid.k_max

    def limits(self) -> tuple[int, int, int, int]:
        """Return the first and last rows and columns, in half samples of the full grid."""
        region, stride = self.region, self.grid.stride(self.level)
        return (
            2 * region.row * stride,
            2 * min((region.row + region.n_rows - 1) * stride, self.grid.n_rows - 1),
            2 * region.col * stride,
            2 * min((region.col + region.n_cols - 1) * stride, self.grid.n_cols - 1),
        )

    def roots(self) -> list[Block]:
        return [block for block in self.grid.blocks(0) if self.meets(block)]

    def children(self, block: Block) -> list[Block]:
        return [child for child in self.grid.children(block) if self.meets(child)]

    def blocks(self, level: int) -> list[Block]:
        """Return the blocks of a level that have cells in the area."""
        found, waiting = [], self.roots()
        while waiting:
            block = waiting.pop()
            if block.level == level:
                found.append(block)
            else:
                waiting += self.children(block)
        return found

    def touches_cut_edge(self, block: Block) -> bool:
        """Return whether a block has one of the area's level at an edge within the raster.

        Also counted are neighbours of blocks that such an edge crosses, as these share border
        lines.
        """
        region, (n_rows, n_cols) = self.region, self.grid.level_shape(self.level)
        span = 1 << (self.level - block.level)
        for first, count, n_samples, number in (
            (region.row, region.n_rows, n_rows, block.row),
            (region.col, region.n_cols, n_cols, block.col),
        ):
            for edge in (first, first + count - 1):
                at, inside = divmod(edge, self.grid.block)
                near = range(at - 1, at + 2 if inside else at + 1)
                if 0 < edge < n_samples - 1 and near.start < (number + 1) * span:
                    if number * span < near.stop:
                        return True
        return False

    def meets(self, block: Block) -> bool:
        region, scale = self.region, self.grid.stride(self.level)
        stride = self.grid.stride(block.level) * self.grid.block
        return (
            block.row * stride < (region.row + region.n_rows - 1) * scale
            and (block.row + 1) * stride > region.row * scale
            and block.col * stride < (region.col + region.n_cols - 1) * scale
            and (block.col + 1) * stride > region.col * scale
        )


class CutBlock(NamedTuple):
    """A block of the cut: tolerances in 1/16 quanta, errors in quanta.

    `heights_error` is that of the block's heights (on coarse levels: of their bilinear surface),
    `error` the limit for the mesh.
    """

    tolerance: int
    sides: SideTolerances
    heights_error: Fraction
    error: Fraction


class Errors:
    """Shares of an error that blocks' heights take and leave to meshes; in quanta."""

    def __init__(self, terrain: TerrainFile, area: Area) -> None:
        header = terrain.header
        self._container, self._grid, self._area = terrain.container, terrain.grid, area
        # The codec's and patches' share.
        self.coded = Fraction(header.coded_error) + Fraction(header.rho) / header.quantum

    def heights(self, block: Block) -> Fraction:
        if block.level == self._grid.k_max:
            return self.coded
        return Fraction(decode_error(self._container.codes(block)[2]))

    def smallest(self) -> Fraction:
        if self._area.is_finest:
            return self.coded
        return max(map(self.heights, self._area.blocks(self._area.level)))

    def piece(self, block: Block, error: Fraction) -> CutBlock:
        own, sides = self._left_over(block, error), []
        for row, col in TOWARDS.values():
            beside = Block(block.level, block.row + row, block.col + col)
            is_there = self._grid.contains(beside)
            sides.append(min(own, self._left_over(beside, error)) if is_there else own)
        return CutBlock(own, SideTolerances(*sides), self.heights(block), error)

    def stored_piece(self, block: Block, mesher: BlockMesher) -> CutBlock:
        """Return a finest block with the tolerances of the file's meshes."""
        tolerance = mesher.tolerance(block)
        error = self.coded + Fraction(tolerance, 1 << FRACTION_BITS)
        return CutBlock(tolerance, mesher.side_tolerances(block), self.heights(block), error)

    def of_mesh(self, block: Block, mesh: BlockMesh, mesher: BlockMesher) -> Fraction:
        """Return a bound on the error of a block's own mesh: the file's, if stated."""
        code = self._container.codes(block)[3]
        if code != UNMEASURED:
            return Fraction(decode_error(code))
        return Fraction(mesher.derived_error(block, mesh), 1 << FRACTION_BITS)

    def _left_over(self, block: Block, error: Fraction) -> int:
        """Return the tolerance that a block's heights leave of an error, in 1/16 quanta."""
        left = max(error - self.heights(block), Fraction(0))
        return int(left * (1 << FRACTION_BITS))


class Cut:
    """Blocks to mesh together; they cover an area and do not overlap."""

    def __init__(self, area: Area, pieces: dict[Block, CutBlock]) -> None:
        self._area, self._grid = area, area.grid
        self.pieces = pieces

    def covering(self, block: Block) -> Block | None:
        while block.level >= 0:
            if block in self.pieces:
                return block
            block = block.parent
        return None

    def finer(self, block: Block) -> Iterator[tuple[str, Block]]:
        """Yield (side of the block, an adjacent finer block of the cut)."""
        for side, (row, col) in TOWARDS.items():
            beside = Block(block.level, block.row + row, block.col + col)
            if not self._grid.contains(beside) or self.covering(beside) is not None:
                continue
            waiting = [beside]
            while waiting:
                for child in self._grid.children(waiting.pop()):
                    # The neighbour's children on the shared line.
                    if (row and child.row & 1 != (row < 0)) or (col and child.col & 1 != (col < 0)):
                        continue
                    if child in self.pieces:
                        yield side, child
                    elif self._area.meets(child):
                        waiting.append(child)


class ErrorCut(Cut):
    """The blocks to mesh for an error in quanta."""

    def __init__(
        self,
        area: Area,
        errors: Errors,
        error: Fraction,
        # returns the samples of a block: levels do not meet where they are void
        samples_of: Callable[[Block], BlockSamples],
        *,
        # coarse samples are samples of finer levels, too, as adjacent meshes of both need
        are_nested: bool,
    ) -> None:
        super().__init__(area, {})
        self._errors, self._error = errors, error
        self._samples_of = samples_of
        self._are_nested = are_nested
        for block in area.roots():
            self._add(block)
        self._close()

    def refine(self, failed: list[Block]) -> None:
        for block in failed:
            if block in self.pieces:
                self._split(block)
        self._close()

    def _add(self, block: Block) -> list[Block]:
        if block.level == self._area.level or self._is_usable(block):
            self.pieces[block] = self._errors.piece(block, self._error)
            return [block]
        return [added for child in self._area.children(block) for added in self._add(child)]

    def _is_usable(self, block: Block) -> bool:
        """Return whether a coarse block's stored mesh may be adjacent to finer ones."""
        if not self._are_nested or (self._area.is_tile and self._area.touches_cut_edge(block)):
            return False
        return self._errors.heights(block) * _COARSE_SHARE <= self._error

    def _close(self) -> None:
        """Split coarse blocks until no void lies where levels meet.

        Splitting never makes another block usable again, so the result does not depend on the
        order.
        """
        waiting = sorted(block for block in self.pieces if block.level < self._area.level)
        while waiting:
            again = []
            for block in waiting:
                if block in self.pieces and not self._fits_beside(block):
                    again += self._split(block)
            waiting = sorted({block for block in again if block.level < self._area.level})

    def _split(self, block: Block) -> list[Block]:
        """Replace a block by finer ones; return these and its neighbours."""
        del self.pieces[block]
        again = [
            beside
            for row, col in TOWARDS.values()
            if (beside := self.covering(Block(block.level, block.row + row, block.col + col)))
        ]
        for child in self._area.children(block):
            again += self._add(child)
        return again

    def _fits_beside(self, block: Block) -> bool:
        """Return whether a coarse block meets finer ones without voids, on lines that both have.

        The finer ones' corners must be samples of the coarse one, to be vertices of its border.
        """
        for side, finer in self.finer(block):
            if self._grid.block >> (finer.level - block.level) == 0:
                return False
            if self._ends_between_samples(block, side):
                return False
            if sides_of(self._samples_of(block).locked)[side].any():
                return False
            if sides_of(self._samples_of(finer).locked)[OPPOSITE[side]].any():
                return False
        return True

    def _ends_between_samples(self, block: Block, side: str) -> bool:
        """Return whether a border line extends to a sample past the raster's edge.

        A finer level has no such sample at the same position.
        """
        side_cells = self._grid.block * self._grid.stride(block.level)
        is_upright = side in ("left", "right")
        number = block.row if is_upright else block.col
        last = (self._grid.n_rows if is_upright else self._grid.n_cols) - 1
        return (number + 1) * side_cells > last and last % self._grid.stride(block.level) != 0


def sides_of(values: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """Return views of the outermost rows and columns."""
    return dict(zip(TOWARDS, outer_lines(values), strict=True))
