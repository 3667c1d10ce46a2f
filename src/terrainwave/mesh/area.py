"""One watertight mesh over any area of a file, from the meshes of its blocks.

The area is cut into blocks of several levels: coarse ones where the index says that their heights
take no more than a quarter of the error asked for, blocks of the full grid elsewhere. Each is
meshed with what its heights leave of the error; what a coarse mesh does between its samples is
measured. Where levels meet, the finer block takes the coarser one's border line as it is: on nested
grids its vertices are samples of the finer block too, and the coarse mesh's error covers the
samples between them. So no gap is stitched and no error added.

With a budget of triangles the outlines of voids are those of a level that the budget has room for
(`mesh.outlines`): all originals are covered, and small voids may be.
"""

import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import check_flags, checked_error, checked_whole
from terrainwave.cache import Cache
from terrainwave.container.codes import decode_error
from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
    TerrainwaveWarning,
)
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import (
    IDENTITY,
    determinant,
    pixels_to_places,
    samples_to_places,
    without_shift,
)
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.grid.quantum import as_fraction
from terrainwave.mesh.blocks import BlockSamples, SideTolerances, border_lines
from terrainwave.mesh.loose import LooseMesher
from terrainwave.mesh.outlines import CoveredSamples, finest_outline
from terrainwave.mesh.sections import mesher_of
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.tri.halves.halves import Lines, triangulate
from terrainwave.tri.halves.simplify import simplify
from terrainwave.tri.mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.surface import deviation_from_bilinear, largest_deviation

# Coarse blocks whose heights take at most this share of the error asked for are not refined.
_COARSE_SHARE = 4
# Tries to mesh a block of a coarse level that was asked for within the error. Other coarse blocks
# have one before they are refined: finer ones take fewer triangles than a mesh that is tried again.
_TRIES = 3
# A budget of triangles is met within this ratio of the smallest error, and goes on to the next one
# while more than a twentieth of it is left.
_BUDGET_RATIO, _LAST_RATIO = Fraction(102, 100), Fraction(1001, 1000)
_LEAST_USED = Fraction(95, 100)
# Of a budget: one edge of a void's outline on so many triangles. Sweeps that blocks with voids get.
_OUTLINE_SHARE = 4
_OUTLINE_SWEEPS = 8
_CACHE_BYTES = 64 << 20
# Half samples; edges are shorter than its inverse.
_NEAR = 2.0**-20
_ROUNDING = 2.0**-48


class _UnreachableError(InvalidHeightsError):
    """A coarse level's meshes can't keep to the error, as its samples are too far apart."""


class _TooManyTrianglesError(InvalidHeightsError):
    """A mesh has more triangles than its budget."""


class _Piece(NamedTuple):
    """A block of the cut: tolerances in 1/16 quanta, errors in quanta.

    `heights_error` is that of the block's heights (on coarse levels: of their bilinear surface),
    `error` what the mesh has to keep to.
    """

    tolerance: int
    sides: SideTolerances
    heights_error: Fraction
    error: Fraction


class _MeshedBlock(NamedTuple):
    """A block's mesh and its error against the originals in quanta; None: it can't keep to it."""

    mesh: BlockMesh
    error: Fraction | None


@dataclass(frozen=True)
class _Area:
    """What part of a terrain to mesh, and how.

    `region` is in samples of `level`; `sweeps` counts sweeps of collapses.
    """

    region: Region
    level: int
    sweeps: int = 0


class PlacedMesh(NamedTuple):
    """A mesh in world coordinates; fields as of `export.mesh.Mesh`."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    origin: tuple[float, float, float]
    error: float
    crs: str | None
    units: str | None
    attributes: dict[str, Any]

    @property
    def n_triangles(self) -> int:
        """Return the number of triangles."""
        return len(self.triangles)


def mesh_area(
    terrain: TerrainFile,
    window: Any = None,
    *,
    bounds: Sequence[float] | None = None,
    level: int = -1,
    max_error: float | None = None,
    max_triangles: int | None = None,
    optimise: int = 0,
    guarantee: bool = True,
    progress: ProgressCallback | None = None,
) -> PlacedMesh:
    """Return the mesh of `Terrain.mesh`, where arguments and errors are told."""
    check_flags(guarantee=guarantee)
    max_error = checked_error("max_error", max_error)
    if max_triangles is not None:
        max_triangles = checked_whole("max_triangles", max_triangles, least=1)
    optimise = checked_whole("optimise", optimise, least=0)
    if not guarantee:
        if max_error is not None or max_triangles is not None or optimise:
            raise InvalidArgumentError(
                "found an error, a budget or sweeps with no guarantee, expected none of them: the"
                " zero trees alone say what the mesh is"
            )
        level = _level_with_trees(terrain, level)
    index = terrain.level_index(level)
    region = terrain.region(window, bounds=bounds, level=level)
    if note := terrain.note_on_cut(window, bounds=bounds, level=level):
        warnings.warn(note, TerrainwaveWarning, stacklevel=3)
    if min(region.shape) < 2:
        raise InvalidArgumentError(
            f"found an area of {region.n_rows} x {region.n_cols} samples, expected at least"
            " 2 x 2: a mesh lies between samples"
        )
    area = _Area(region, index, optimise)
    with ThreadPoolExecutor(terrain.n_threads, thread_name_prefix="terrainwave") as executor:
        extractor = _Extractor(terrain, area, executor, Reporter(progress))
        if not guarantee:
            return extractor.loose_mesh()
        if max_triangles is not None:
            return extractor.within_budget(max_triangles, max_error)
        return extractor.mesh(max_error)


def _level_with_trees(terrain: TerrainFile, level: int) -> int:
    """Return the level to mesh by zero trees: the finest that has some, where -1 is asked for."""
    index = terrain.level_index(level)
    if terrain.n_levels == 1 or (level >= 0 and index == terrain.n_levels - 1):
        raise InvalidArgumentError(
            f"found level {index} of {terrain.n_levels}, expected a coarser one: the finest has no"
            " zero trees, which a mesh without a guarantee is made of"
        )
    return min(index, terrain.n_levels - 2)


class _Extractor:
    def __init__(
        self, terrain: TerrainFile, area: _Area, executor: ThreadPoolExecutor, reporter: Reporter
    ) -> None:
        header = terrain.header
        self._terrain, self._header, self._area = terrain, header, area
        self._grid = terrain.grid
        self._mesher = mesher_of(terrain)
        self._executor = executor
        self._reporter = reporter
        self._n_tries = 0
        self._scale = abs(as_fraction(terrain.raster_info.scale))
        self._quantum = header.quantum * self._scale  # physical height of one quantum
        rho = Fraction(header.rho) / header.quantum
        # What the codec and patches take of an error, in quanta.
        self._coded = Fraction(header.coded_error) + rho
        self._has_meshes = header.mesh != "none"
        self._samples: Cache[Block, BlockSamples] = Cache(_CACHE_BYTES, size_of=_n_bytes)
        # Whether outlines of voids may have fewer vertices, which takes sweeps.
        self._are_outlines_simple = False

    # Errors, in quanta

    def _heights_error(self, block: Block) -> Fraction:
        if block.level == self._grid.k_max:
            return self._coded
        return Fraction(decode_error(self._terrain.container.codes(block)[2]))

    def _smallest_error(self) -> Fraction:
        """Return the smallest error that may be asked for."""
        if self._area.level == self._grid.k_max:
            return self._coded
        return max(self._heights_error(block) for block in self._blocks(self._area.level))

    def _left_over(self, block: Block, error: Fraction) -> int:
        """Return the tolerance that a block's heights leave of an error, in 1/16 quanta."""
        left = max(error - self._heights_error(block), Fraction(0))
        return int(left * (1 << FRACTION_BITS))

    # Pieces

    def _stored_piece(self, block: Block) -> _Piece:
        mesher = self._mesher
        tolerance = mesher.tolerance(block)
        error = Fraction(decode_error(self._terrain.container.codes(block)[3]))
        if block.level == self._grid.k_max and (self._area.sweeps or not self._has_meshes):
            error = self._coded + Fraction(tolerance, 1 << FRACTION_BITS)
        return _Piece(tolerance, mesher.side_tolerances(block), self._heights_error(block), error)

    def _piece(self, block: Block, error: Fraction) -> _Piece:
        own, sides = self._left_over(block, error), []
        for row, col in _TOWARDS.values():
            beside = Block(block.level, block.row + row, block.col + col)
            if self._grid.contains(beside):
                sides.append(min(own, self._left_over(beside, error)))
            else:
                sides.append(own)
        return _Piece(own, SideTolerances(*sides), self._heights_error(block), error)

    # Which blocks

    def _meets(self, block: Block) -> bool:
        """Say whether cells of the block lie in the area."""
        region, scale = self._area.region, self._grid.stride(self._area.level)
        stride = self._grid.stride(block.level) * self._grid.block
        return (
            block.row * stride < (region.row + region.n_rows - 1) * scale
            and (block.row + 1) * stride > region.row * scale
            and block.col * stride < (region.col + region.n_cols - 1) * scale
            and (block.col + 1) * stride > region.col * scale
        )

    def _blocks(self, level: int) -> list[Block]:
        return [block for block in self._descend(level) if block.level == level]

    def _descend(self, level: int) -> Iterator[Block]:
        waiting = [block for block in self._grid.blocks(0) if self._meets(block)]
        while waiting:
            block = waiting.pop()
            yield block
            if block.level < level:
                waiting += [child for child in self._grid.children(block) if self._meets(child)]

    def _cut(self, error: Fraction) -> dict[Block, _Piece]:
        """Return the blocks to mesh for an error in quanta."""
        level = self._area.level
        cut: dict[Block, _Piece] = {}
        waiting = [block for block in self._grid.blocks(0) if self._meets(block)]
        while waiting:
            block = waiting.pop()
            if block.level == level or self._is_usable(block, error):
                cut[block] = self._piece(block, error)
            else:
                waiting += [child for child in self._grid.children(block) if self._meets(child)]
        self._close(cut, error)
        return cut

    def _is_usable(self, block: Block, error: Fraction) -> bool:
        """Say whether a coarse block's stored mesh may stand beside finer ones."""
        if self._terrain.pyramid != "nested":
            return False
        return self._heights_error(block) * _COARSE_SHARE <= error

    def _ends_between_samples(self, block: Block, side: str) -> bool:
        """Say whether a border line goes on to a sample past the raster's edge.

        A finer level has no such sample at the same place.
        """
        side_cells = self._grid.block * self._grid.stride(block.level)
        is_upright = side in ("left", "right")
        number = block.row if is_upright else block.col
        last = (self._grid.n_rows if is_upright else self._grid.n_cols) - 1
        return (number + 1) * side_cells > last and last % self._grid.stride(block.level) != 0

    def _close(self, cut: dict[Block, _Piece], error: Fraction) -> None:
        """Split coarse blocks until no void lies where levels meet.

        Splitting never makes another block usable again, so the result does not depend on the
        order.
        """
        waiting = sorted(block for block in cut if block.level < self._area.level)
        while waiting:
            again = []
            for block in waiting:
                if block in cut and not self._fits_beside(cut, block):
                    again += self._split(cut, block, error)
            waiting = sorted({block for block in again if block.level < self._area.level})

    def _split(self, cut: dict[Block, _Piece], block: Block, error: Fraction) -> list[Block]:
        """Replace a block by finer ones; return these and its neighbours."""
        del cut[block]
        again = self._neighbours(cut, block)
        for child in self._grid.children(block):
            if self._meets(child):
                again += self._add(cut, child, error)
        return again

    def _add(self, cut: dict[Block, _Piece], block: Block, error: Fraction) -> list[Block]:
        if block.level == self._area.level or self._is_usable(block, error):
            cut[block] = self._piece(block, error)
            return [block]
        return [
            added
            for child in self._grid.children(block)
            if self._meets(child)
            for added in self._add(cut, child, error)
        ]

    def _neighbours(self, cut: dict[Block, _Piece], block: Block) -> list[Block]:
        """Return the coarser or equal blocks of the cut beside a block."""
        neighbours = []
        for row, col in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            beside = self._covering(cut, Block(block.level, block.row + row, block.col + col))
            if beside is not None:
                neighbours.append(beside)
        return neighbours

    def _covering(self, cut: dict[Block, _Piece], block: Block) -> Block | None:
        """Return the block of the cut that contains a block."""
        while block.level >= 0:
            if block in cut:
                return block
            block = block.parent
        return None

    def _fits_beside(self, cut: dict[Block, _Piece], block: Block) -> bool:
        """Say whether no void lies where a coarse block meets finer ones, on lines that both have.

        The finer ones' corners must be samples of the coarse one, to be vertices of its border.
        """
        for side, finer in self._finer(cut, block):
            if self._grid.block >> (finer.level - block.level) == 0:
                return False
            if self._ends_between_samples(block, side):
                return False
            if _sides(self._samples_of(block).locked)[side].any():
                return False
            if _sides(self._samples_of(finer).locked)[_OPPOSITE[side]].any():
                return False
        return True

    def _own_lines(self, cut: dict[Block, _Piece], block: Block, samples: BlockSamples) -> Lines:
        """Return the block's border lines, with vertices at the corners of finer blocks."""
        if block.level < self._area.level:
            forced = samples.locked.copy()
            for side, finer in self._finer(cut, block):
                step = self._grid.block >> (finer.level - block.level)
                place = finer.row if side in ("left", "right") else finer.col
                first = place * step
                first -= (block.row if side in ("left", "right") else block.col) * self._grid.block
                line = _sides(forced)[side]
                line[[first, min(first + step, len(line) - 1)]] = True
            samples = samples._replace(locked=forced)
        return border_lines(samples, cut[block].sides, self._grid.block)

    def _finer(self, cut: dict[Block, _Piece], block: Block) -> Iterator[tuple[str, Block]]:
        """Yield (side of the block, a finer block of the cut beside it)."""
        for side, (row, col) in _TOWARDS.items():
            beside = Block(block.level, block.row + row, block.col + col)
            if not self._grid.contains(beside) or self._covering(cut, beside) is not None:
                continue
            waiting = [beside]
            while waiting:
                finer = waiting.pop()
                for child in self._grid.children(finer):
                    # Of the neighbour's children, those on the shared line.
                    if (row and child.row & 1 != (row < 0)) or (col and child.col & 1 != (col < 0)):
                        continue
                    if child in cut:
                        yield side, child
                    elif self._meets(child):
                        waiting.append(child)

    # Meshes

    def _samples_of(self, block: Block) -> BlockSamples:
        return self._samples.get_or_make(block, lambda: self._mesher.samples(block))

    def _lines(self, cut: dict[Block, _Piece], block: Block, samples: BlockSamples) -> Lines:
        """Return the block's border lines, those of coarser neighbours where there are any."""
        lines = self._own_lines(cut, block, samples)
        for side, (row, col) in _TOWARDS.items():
            place = Block(block.level, block.row + row, block.col + col)
            if not self._grid.contains(place):
                continue
            beside = self._covering(cut, place)
            if beside is None or beside.level == block.level:
                continue
            coarse = self._own_lines(cut, beside, self._samples_of(beside))
            line = getattr(coarse, _OPPOSITE[side])
            ratio = 1 << (block.level - beside.level)
            own = np.zeros(len(getattr(lines, side)), dtype=np.bool_)
            first = (block.row if col else block.col) * self._grid.block // ratio
            first -= (beside.row if col else beside.col) * self._grid.block
            n_coarse = (len(own) - 1) // ratio + 1
            own[::ratio] = line[first : first + n_coarse]
            lines = lines._replace(**{side: own})
        return lines

    def _build(self, cut: dict[Block, _Piece], block: Block) -> _MeshedBlock:
        samples = self._samples.get(block) or self._mesher.samples(block)
        piece, lines = cut[block], self._lines(cut, block, samples)
        if block.level == self._grid.k_max:
            mesh = self._triangulated(block, samples, lines, piece.tolerance)
            measured = largest_deviation(mesh, 1, samples.heights, samples.mask, 0, 0)
            # Samples on a coarser neighbour's border keep to the error, not to the tolerance.
            error = piece.heights_error + Fraction(measured, 1 << FRACTION_BITS)
            return _MeshedBlock(mesh, min(error, piece.error))
        stride, tolerance = self._grid.stride(block.level), piece.tolerance
        for _ in range(_TRIES if block.level == self._area.level else 1):
            mesh = self._triangulated(block, samples, lines, tolerance)
            measured = deviation_from_bilinear(mesh, stride, samples.heights, samples.mask)
            if measured <= piece.tolerance:
                error = piece.heights_error + Fraction(measured, 1 << FRACTION_BITS)
                return _MeshedBlock(mesh, error)
            tolerance = tolerance * piece.tolerance // (measured + measured // 16)
        return _MeshedBlock(mesh, None)

    def _triangulated(
        self, block: Block, samples: BlockSamples, lines: Lines, tolerance: int
    ) -> BlockMesh:
        """Return the mesh of a block's samples, with fewer triangles where sweeps are asked for."""
        mesh = triangulate(*samples, lines, tolerance)
        sweeps = self._area.sweeps if block.level == self._grid.k_max else 0
        if self._are_outlines_simple and not samples.mask.all():
            sweeps = max(sweeps, _OUTLINE_SWEEPS)
        if not sweeps:
            return mesh
        return simplify(mesh, samples.heights, samples.mask, tolerance, sweeps)

    def mesh(self, max_error: float | None) -> PlacedMesh:
        """Return the mesh for an error in physical units, or that of the stored meshes."""
        if max_error is None:
            return self._stored_mesh()
        return self._mesh_within(self._asked(max_error))

    def _asked(self, max_error: float) -> Fraction:
        """Return an error in quanta, unless the heights are further from the originals."""
        smallest = self._smallest_error()
        # What the file states of itself, as float64, is enough.
        if max_error < float(smallest * self._quantum) * (1 - _ROUNDING):
            raise InvalidArgumentError(
                f"found `max_error` {max_error:g}, expected at least"
                f" {float(smallest * self._quantum):g}: the heights of this level are no nearer to"
                " the originals"
            )
        return max(as_fraction(max_error) / self._quantum, smallest)

    def _stored_mesh(self) -> PlacedMesh:
        level = self._area.level
        if not self._has_meshes:
            if level < self._grid.k_max:
                raise InvalidArgumentError(
                    "the file stores no meshes of coarse levels: add them with terrainwave mesh"
                    " --store, or give a `max_error`"
                )
            return self._mesh_within(self._coded + max(self._coded, Fraction(1)))
        cut = {block: self._stored_piece(block) for block in self._blocks(level)}
        if level == self._grid.k_max and self._area.sweeps:
            return self._assemble(self._build_all(cut))

        def build(block: Block) -> _MeshedBlock:
            return _MeshedBlock(self._mesher.mesh(block), cut[block].error)

        return self._assemble(dict(self._each(build, sorted(cut))))

    def loose_mesh(self) -> PlacedMesh:
        """Return the mesh of the zero trees alone, with the error that it turns out to have."""
        level = self._area.level
        stride = self._grid.stride(level)
        meshes = LooseMesher(self._terrain).meshes(self._blocks(level), self._executor.map)

        def measured(block: Block) -> _MeshedBlock:
            samples, mesh = self._samples_of(block), meshes[block]
            apart = deviation_from_bilinear(mesh, stride, samples.heights, samples.mask)
            error = self._heights_error(block) + Fraction(apart, 1 << FRACTION_BITS)
            return _MeshedBlock(mesh, error)

        return self._assemble(dict(self._each(measured, list(meshes))))

    def _each(
        self, build: Callable[[Block], _MeshedBlock], blocks: list[Block]
    ) -> Generator[tuple[Block, _MeshedBlock]]:
        """Yield blocks with what is built of them, in threads, and tell how far it is."""
        self._n_tries += 1
        stage = "meshing" if self._n_tries == 1 else f"meshing, try {self._n_tries}"
        n_samples = self._grid.block**2
        meshes = self._executor.map(build, blocks)
        for n_done, (block, meshed) in enumerate(zip(blocks, meshes, strict=True), 1):
            self._reporter.report(stage, n_done * n_samples, len(blocks) * n_samples)
            yield block, meshed

    def _mesh_within(self, error: Fraction, n_most: int | None = None) -> PlacedMesh:
        """Return the mesh for an error in quanta.

        Raises
        ------
        _UnreachableError
            If a coarse level can't keep to it.
        _TooManyTrianglesError
            If it has more than `n_most` triangles; the rest of it is not made.
        """
        cut, level = self._cut(error), self._area.level
        built = self._build_all(cut, n_most)
        while True:
            failed = sorted(block for block, mesh in built.items() if mesh.error is None)
            if not failed:
                return self._assemble(built)
            if level < self._grid.k_max and any(block.level == level for block in failed):
                raise _UnreachableError(
                    f"found max_error {float(error * self._quantum):g}, which level {level} cannot"
                    " reach: use a finer level or a larger max_error"
                )
            for block in failed:
                if block in cut:
                    self._split(cut, block, error)
            self._close(cut, error)
            built = self._build_all(cut, n_most)

    def _mesh_if_reached(self, error: Fraction, n_most: int) -> PlacedMesh | None:
        """Return the mesh for an error in quanta.

        None if it has more than `n_most` triangles or a coarse level can't keep to the error.
        """
        try:
            return self._mesh_within(error, n_most)
        except (_UnreachableError, _TooManyTrianglesError):
            return None

    def _build_all(
        self, cut: dict[Block, _Piece], n_most: int | None = None
    ) -> dict[Block, _MeshedBlock]:
        built, n_triangles = {}, 0
        # Closed before its end, it begins no more.
        with closing(self._each(lambda block: self._build(cut, block), sorted(cut))) as meshes:
            for block, meshed in meshes:
                built[block] = meshed
                if n_most is not None and meshed.error is not None:
                    n_triangles += self._n_inside(block, meshed.mesh)
                    if n_triangles > n_most:
                        raise _TooManyTrianglesError(f"more than {n_most} triangles")
        return built

    def _n_inside(self, block: Block, mesh: BlockMesh) -> int:
        """Return how many triangles of a block's mesh the area's mesh will have."""
        return len(_clipped(*_joined(self._grid, [block], [mesh]), self._limits())[1])

    def within_budget(self, max_triangles: int, max_error: float | None) -> PlacedMesh:
        """Return the mesh of the smallest error, up to 2 %, that has at most `max_triangles`."""
        self._simplify_outlines(max_triangles)
        high = self._largest_error()
        if max_error is not None:
            high = min(high, self._asked(max_error))
        best = self._mesh_within(high)
        if best.n_triangles > max_triangles:
            raise InvalidArgumentError(
                f"found `max_triangles` {max_triangles}, expected at least {best.n_triangles}: the"
                f" mesh with an error of {float(high * self._quantum):g} has as many"
            )
        low = self._smallest_error()
        finest = self._mesh_if_reached(low, max_triangles)
        if finest is not None:
            return finest
        low = max(low, Fraction(1, 16))
        while high > low * _BUDGET_RATIO or (
            best.n_triangles < max_triangles * _LEAST_USED and high > low * _LAST_RATIO
        ):
            # The geometric mean, as errors span decades.
            middle = Fraction(float(low * high) ** 0.5).limit_denominator(1 << 20)
            if not low < middle < high:
                break
            mesh = self._mesh_if_reached(middle, max_triangles)
            if mesh is not None:
                best, high = mesh, middle
            else:
                low = middle
        return best

    def _simplify_outlines(self, max_triangles: int) -> None:
        """Keep so much of the outlines of voids as a budget of triangles has room for."""
        if self._terrain.raster_info.mask_kind == "none":
            return
        area, decoder = self._area, self._terrain.decoder
        n_edges = max_triangles // _OUTLINE_SHARE
        outline = finest_outline(self._grid, decoder, area.level, area.region, n_edges)
        self._mesher = mesher_of(self._terrain, CoveredSamples(self._grid, decoder, outline))
        self._are_outlines_simple = True

    def _largest_error(self) -> Fraction:
        """Return an error beyond which meshes have no fewer triangles, in quanta."""
        header = self._header
        return Fraction(2 * (header.z_max - header.z_min) + 2) + self._smallest_error()

    def _assemble(self, built: dict[Block, _MeshedBlock]) -> PlacedMesh:
        blocks = sorted(built)
        meshes = [built[block].mesh for block in blocks]
        vertices, triangles = _joined(self._grid, blocks, meshes)
        vertices, triangles = _clipped(vertices, triangles, self._limits())
        errors = [built[b].error or 0 for b, m in zip(blocks, meshes, strict=True) if len(m.rows)]
        return self._placed(
            vertices, triangles, float(max(errors, default=Fraction(0)) * self._quantum)
        )

    def _limits(self) -> tuple[int, int, int, int]:
        """Return the area's first and last rows and columns, in half samples of the full grid."""
        region, stride = self._area.region, self._grid.stride(self._area.level)
        return (
            2 * region.row * stride,
            2 * min((region.row + region.n_rows - 1) * stride, self._grid.n_rows - 1),
            2 * region.col * stride,
            2 * min((region.col + region.n_cols - 1) * stride, self._grid.n_cols - 1),
        )

    def _placed(
        self, vertices: NDArray[np.float64], triangles: NDArray[np.int32], error: float
    ) -> PlacedMesh:
        """Return the mesh in world coordinates, counter-clockwise seen from above."""
        crs, raster = self._terrain.crs, self._terrain.raster_info
        first_row, last_row, first_col, last_col = self._limits()
        row_0, col_0 = (first_row + last_row) // 4, (first_col + last_col) // 4
        rows, cols = vertices[:, 0] / 2 - row_0, vertices[:, 1] / 2 - col_0
        quanta = vertices[:, 2] / (1 << FRACTION_BITS)
        numerator, denominator = self._header.quantum.numerator, self._header.quantum.denominator
        heights = (quanta + self._header.base) * numerator / denominator
        x, y = pixels_to_places(without_shift(raster.transform), rows, cols)
        points = np.stack([x, y, heights * raster.scale + raster.offset], 1)
        if determinant(raster.transform) > 0:
            triangles = np.ascontiguousarray(triangles)
        else:
            triangles = np.ascontiguousarray(triangles[:, ::-1])
        origin = (*samples_to_places(raster.transform, float(row_0), float(col_0)), 0.0)
        # An array without a place: its columns and rows are no degrees.
        attributes = {"is_placed": raster.transform != IDENTITY}
        return PlacedMesh(points, triangles, origin, error, crs, self._terrain.units, attributes)


def _n_bytes(samples: BlockSamples) -> int:
    return samples.heights.nbytes + samples.mask.nbytes + samples.locked.nbytes


_TOWARDS = {"top": (-1, 0), "bottom": (1, 0), "left": (0, -1), "right": (0, 1)}
_OPPOSITE = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}


def _sides(values: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    return {"top": values[0], "bottom": values[-1], "left": values[:, 0], "right": values[:, -1]}


def _joined(
    grid: Grid, blocks: list[Block], meshes: list[BlockMesh]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the vertices and triangles of all blocks; vertices that blocks share are one.

    A vertex is (row, column, height), in half samples of the full grid and 1/16 quanta.
    """
    places, heights, is_border = [], [], []
    for block, mesh in zip(blocks, meshes, strict=True):
        stride, side = grid.stride(block.level), 2 * grid.block
        rows = (block.row * side + mesh.rows.astype(np.int64)) * stride
        cols = (block.col * side + mesh.cols.astype(np.int64)) * stride
        last_row, last_col = mesh.rows.max(initial=0), mesh.cols.max(initial=0)
        is_border.append(
            (mesh.rows == 0) | (mesh.rows == last_row) | (mesh.cols == 0) | (mesh.cols == last_col)
        )
        places.append(rows << 32 | cols)
        heights.append(mesh.heights)
    if not blocks:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.int32)
    place, height = np.concatenate(places), np.concatenate(heights)
    number = np.arange(len(place))
    on_border = np.flatnonzero(np.concatenate(is_border))
    _, first, same = np.unique(place[on_border], return_index=True, return_inverse=True)
    number[on_border] = on_border[first][same.reshape(-1)]
    is_kept = number == np.arange(len(place))
    renumbered = (np.cumsum(is_kept, dtype=np.int32) - 1)[number]
    triangles = np.empty((sum(len(mesh.triangles) for mesh in meshes), 3), dtype=np.int32)
    n_vertices = n_triangles = 0
    for mesh in meshes:
        beyond = n_triangles + len(mesh.triangles)
        own = renumbered[n_vertices : n_vertices + len(mesh.rows)]
        triangles[n_triangles:beyond] = own[mesh.triangles]
        n_vertices, n_triangles = n_vertices + len(mesh.rows), beyond
    place, height = place[is_kept], height[is_kept]
    vertices = np.stack([place >> 32, place & 0xFFFFFFFF, height], 1).astype(np.float64)
    return vertices, triangles


def _clipped(
    vertices: NDArray[np.float64],
    triangles: NDArray[np.int32],
    limits: tuple[int, int, int, int],
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the part of a mesh inside (first row, last row, first column, last column)."""
    whole = triangles
    for axis, limit, sign in (
        (0, limits[0], 1.0), (0, limits[1], -1.0), (1, limits[2], 1.0), (1, limits[3], -1.0),
    ):  # fmt: skip
        vertices, triangles = _cut_off(vertices, triangles, sign * (vertices[:, axis] - limit))
    if triangles is whole:
        return vertices, triangles
    used, number = np.unique(triangles, return_inverse=True)
    return vertices[used], number.reshape(triangles.shape).astype(np.int32)


def _cut_off(
    vertices: NDArray[np.float64], triangles: NDArray[np.int32], inside: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Keep what lies where `inside`, linear over the plane, is >= 0.

    An edge that crosses the line gets one new vertex, the same in both its triangles.
    """
    if (inside >= 0).all():
        return vertices, triangles
    is_in = inside[triangles] >= 0
    n_in = is_in.sum(axis=1)
    kept = [triangles[n_in == 3]]
    edges: list[NDArray[np.int64]] = []
    # Turned so that the odd one out comes first: one inside, or one outside.
    for n, odd in ((1, True), (2, False)):
        rows = np.flatnonzero(n_in == n)
        first = np.argmax(is_in[rows] == odd, axis=1)
        turned = triangles[rows[:, None], (first[:, None] + np.arange(3)) % 3].astype(np.int64)
        edges.append(np.stack([turned[:, [0, 1]], turned[:, [0, 2]]], 1))
    both = np.sort(np.concatenate(edges).reshape(-1, 2), axis=1)
    unique, number = np.unique(both, axis=0, return_inverse=True)
    a, b = unique[:, 0], unique[:, 1]
    share = inside[a] / (inside[a] - inside[b])
    crossing = vertices[a] + share[:, None] * (vertices[b] - vertices[a])
    # Rounding must not put a crossing beside a half sample it lies on, such as the area's corner:
    # no other one is so near, as denominators are lengths of edges.
    whole = np.rint(crossing[:, :2])
    is_near = np.abs(crossing[:, :2] - whole) < _NEAR
    crossing[:, :2] = np.where(is_near, whole, crossing[:, :2])
    # A vertex on the line is its own crossing.
    ends = len(vertices) + np.arange(len(unique))
    ends = np.where(inside[a] == 0, a, np.where(inside[b] == 0, b, ends))
    new = ends[number.reshape(-1, 2)]
    n_one = len(edges[0])
    one, two = edges[0][:, 0, 0], edges[1][:, :, 1]
    ends_one, ends_two = new[:n_one], new[n_one:]
    kept.append(np.stack([one, ends_one[:, 0], ends_one[:, 1]], 1).astype(np.int32))
    # The quad beyond the corner outside: new 1, corner 1, corner 2, new 2.
    kept.append(np.stack([ends_two[:, 0], two[:, 0], two[:, 1]], 1).astype(np.int32))
    kept.append(np.stack([ends_two[:, 0], two[:, 1], ends_two[:, 1]], 1).astype(np.int32))
    vertices = np.concatenate([vertices, crossing])
    triangles = np.concatenate(kept)
    return vertices, triangles[_has_area(vertices, triangles)]


def _has_area(vertices: NDArray[np.float64], triangles: NDArray[np.int32]) -> NDArray[np.bool_]:
    a, b, c = (vertices[triangles[:, k], :2] for k in range(3))
    area = (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) - (c[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    is_positive: NDArray[np.bool_] = area > 0
    return is_positive
