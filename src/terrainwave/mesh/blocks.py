"""Meshes of blocks from decoded heights, and their measured errors.

A block's mesh depends on its decoded samples, the voids next to it, the error codes of the index
and, for the kinds of `tri.stored_kinds`, the block's bytes in the mesh sections.
"""

import math
import threading
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.cache import Cache
from terrainwave.codec.refiner import Heights, Mask
from terrainwave.container.page import decode_error
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.block_stats import with_outside
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.grid.shares import shares_of
from terrainwave.mesh.codes import full_shape, has_triangles, mesh_codes, sum_code
from terrainwave.mesh.trees import BlockCoefficients, ZeroTrees
from terrainwave.names import UNBOUNDED_MESHES
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh, no_mesh
from terrainwave.tri.halves.borders import beside_void, line_vertices
from terrainwave.tri.halves.halves import Lines, triangulate
from terrainwave.tri.mesh_distance import deviation_from_bilinear, largest_deviation
from terrainwave.tri.stored_kinds import STORED_KINDS, Draft, StoredSamples
from terrainwave.tri.zerotree.agreement import BorderVertices
from terrainwave.tri.zerotree.labels import Trees

# Of a coarse block's error against the originals, the share its mesh may add (Y10 §2.8).
_MESH_SHARE = 4
_MAX_TOLERANCE = 1 << 40
# For meshes of views above the finest level: the factor of their tolerance, and the largest
# distance of vertices between samples from the bilinear surface, in tolerances (decision 29).
_LOOSER = 2
_LEASH = Fraction(3, 2)
_CACHED_MESHES = 64

ErrorCode = Callable[[Block], int]
Originals = Callable[[Region], tuple[Heights, Mask]]


class LevelSamples(Protocol):
    """Source of the samples of a file's levels, such as its decoder."""

    def window(self, level: int, region: Region) -> tuple[Heights, Mask]:
        """Return heights and validity of any region inside a level."""
        ...


class BlockSamples(NamedTuple):
    """Samples of a block with the surroundings that its mesh needs.

    `locked` are the samples that are void or next to a void, on either side of a border.
    """

    heights: Heights
    mask: Mask
    locked: Mask


class SideTolerances(NamedTuple):
    """Tolerances of a block's border lines, in 1/16 quanta."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True)
class BlockMesher:
    """The stored mesh of any block of a file."""

    grid: Grid
    decoder: LevelSamples
    error_code: ErrorCode  # the index's error code of a block
    finest_tolerance: int  # tolerance on the finest level, in 1/16 quanta
    # True if the raster may have voids; neighbours are then decoded for their masks
    has_voids: bool
    kind: str = "halves"  # ``"halves"`` or one of `tri.stored_kinds.STORED_KINDS`
    # returns the stored bytes of a block's mesh; needed for kinds other than halves
    part: Callable[[Block], bytes] | None = None
    # returns the zero trees that meshes follow (`mesh.trees.tree_source`), if any
    trees: ZeroTrees | None = None
    # returns the coefficients that they follow (`mesh.trees.coefficient_source`), if any
    coefficients: BlockCoefficients | None = None

    def tolerance(self, block: Block) -> int:
        """Return the tolerance of a block's mesh against its samples: Err_Tri, in 1/16 quanta.

        The finest level's, doubled from level to level, or a quarter of the block's own error if
        that is more (Yusov & Turlapov 2010, §2.8).
        """
        if block.level == self.grid.k_max:
            return self.finest_tolerance
        own = (decode_error(self.error_code(block)) << FRACTION_BITS) // _MESH_SHARE
        return min(max(self.finest_tolerance * self.grid.stride(block.level), own), _MAX_TOLERANCE)

    def side_tolerances(self, block: Block) -> SideTolerances:
        """Return the tolerance of each border line: the smaller one of the two adjacent blocks."""
        own = self.tolerance(block)
        if block.level == self.grid.k_max:
            return SideTolerances(own, own, own, own)
        tolerances = []
        for row, col in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            beside = Block(block.level, block.row + row, block.col + col)
            tolerances.append(
                min(own, self.tolerance(beside)) if self.grid.contains(beside) else own
            )
        return SideTolerances(*tolerances)

    def samples(self, block: Block) -> BlockSamples:
        """Return the samples of a block, reaching past the raster's edge if the block does.

        Outside samples continue the last two rows or columns linearly, as in the block's error
        (FORMAT.md §4.4), and are valid if the last ones are.
        """
        grid = self.grid
        region = grid.block_region(block)
        n_rows, n_cols = full_shape(self.grid, block)
        if not self.has_voids:
            heights, _ = self.decoder.window(block.level, region)
            mask = np.ones((n_rows, n_cols), dtype=np.bool_)
            return BlockSamples(with_outside(heights, n_rows, n_cols), mask, ~mask)
        wide = grid.block_region(block, 1).intersect(Region(0, 0, *grid.level_shape(block.level)))
        heights, mask = self.decoder.window(block.level, wide)
        padding = (
            (region.row == wide.row, wide.row + wide.n_rows == region.row + region.n_rows),
            (region.col == wide.col, wide.col + wide.n_cols == region.col + region.n_cols),
        )
        beyond = np.pad(mask, np.array(padding, dtype=int), constant_values=True)
        heights = np.ascontiguousarray(heights[region.slices_in(wide)])
        heights = with_outside(heights, n_rows, n_cols)
        beyond = _with_outside_mask(beyond, n_rows - region.n_rows)
        beyond = _with_outside_mask(beyond.T, n_cols - region.n_cols).T
        mask = np.ascontiguousarray(beyond[1:-1, 1:-1])
        return BlockSamples(heights, mask, beside_void(beyond))

    def stored_samples(self, block: Block) -> StoredSamples:
        """Return the samples of a block, with the zero trees that its stored mesh follows."""
        samples = self.samples(block)
        trees = self.zero_trees(block)
        if trees is not None:
            # Samples past the raster's edge belong to the trees of the last ones inside.
            outside = [(0, n - own) for n, own in zip(samples.mask.shape, trees.shape, strict=True)]
            trees = np.pad(trees, outside, mode="edge")
        coefficients = None
        if self.coefficients is not None:
            found = self.coefficients(block)
            # Samples past the raster's edge have none.
            outside = [(0, n - own) for n, own in zip(samples.mask.shape, found.shape, strict=True)]
            coefficients = np.pad(found, outside)
        return StoredSamples(*samples, trees, coefficients)

    def zero_trees(self, block: Block) -> Trees | None:
        """Return the zero trees that the mesh of a block follows, by the samples in the raster.

        None for kinds without, on the finest level, and if the group below has none.
        """
        if block.level == self.grid.k_max or self.trees is None:
            return None
        return self.trees(block, self.tolerance(block))

    def has_mesh(self, block: Block) -> bool:
        """Return whether the block's samples have triangles; decodes only if there may be voids."""
        if self.has_voids:
            return has_triangles(self.samples(block).mask)
        return min(full_shape(self.grid, block)) > 1

    def bounded_error(
        self, block: Block, heights: Heights, mask: Mask, lost: Fraction
    ) -> int | None:
        """Return the bound on a finest block's mesh from its originals, less `lost` quanta.

        It is the block's own error, which includes the loss, plus the tolerance, in 1/16 quanta;
        known without making the mesh. None if measuring may give much less: for originals so alike
        that the block may have one height, and if the mask, that of `heights` or a part of them,
        does not decide whether it has a mesh. Also None for kinds whose tolerance is not a bound.
        """
        if self.kind in UNBOUNDED_MESHES or not has_triangles(mask):
            return None
        own, valid = decode_error(self.error_code(block)), heights[mask]
        if int(valid.max()) - int(valid.min()) <= 2 * own:
            return None
        return (
            (own << FRACTION_BITS) + self.finest_tolerance - math.floor(lost * (1 << FRACTION_BITS))
        )

    def error_codes(
        self, errors: dict[Block, int], lost: Fraction, *, by_recursion: bool
    ) -> dict[Block, int]:
        """Return the codes of errors of meshes, as `mesh_codes`.

        With the recursion none is below Err_Appr + Err_Tri, equation (3) of Yusov & Turlapov 2010.
        Measured errors can be larger, because the equation treats a surface of triangles as
        bilinear.
        """
        codes = mesh_codes(errors, lost)
        if not by_recursion:
            return codes
        return {
            block: max(code, sum_code(self.error_code(block), self.tolerance(block)))
            for block, code in codes.items()
        }

    def derived_error(self, block: Block, mesh: BlockMesh) -> int:
        """Return a bound on an unmeasured mesh of a coarse block, in 1/16 quanta.

        It is the block's own error, from the originals, plus the distance of the mesh from the
        surface of that error. Own error plus tolerance is not a bound: between samples, meshes are
        further from the surface than at samples.
        """
        samples = self.samples(block)
        apart = deviation_from_bilinear(mesh, samples.heights, samples.mask)
        return (decode_error(self.error_code(block)) << FRACTION_BITS) + apart

    def view_tolerance(self, block: Block) -> int:
        """Return the tolerance of `view_mesh`, in 1/16 quanta."""
        own = self.tolerance(block)
        return own if block.level == self.grid.k_max else min(_LOOSER * own, _MAX_TOLERANCE)

    def view_mesh(self, block: Block) -> BlockMesh:
        """Return a mesh of a coarse block with few triangles for its `derived_error`.

        Always of kind `halves`, and not the file's mesh.
        """
        sides = (min(_LOOSER * side, _MAX_TOLERANCE) for side in self.side_tolerances(block))
        tolerance, samples = self.view_tolerance(block), self.samples(block)
        lines = border_lines(samples, SideTolerances(*sides), self.grid.block)
        return triangulate(*samples, lines, tolerance, leash=int(_LEASH * tolerance))

    def mesh(self, block: Block) -> BlockMesh:
        """Return the block's stored mesh; positions count from the block's first sample."""
        if self.kind in STORED_KINDS:
            return self._stored_mesh(block, self.stored_samples(block))
        samples = self.samples(block)
        lines = border_lines(samples, self.side_tolerances(block), self.grid.block)
        return triangulate(*samples, lines, self.tolerance(block))

    def coarser_mesh(self, block: Block, tolerance: int) -> BlockMesh:
        """Return a mesh of the file's kind within a tolerance of a block's samples, 1/16 quanta.

        It follows no zero trees. Borders of two blocks with the same tolerance are the same if the
        kind is halves.
        """
        samples = self.samples(block)
        if self.kind in STORED_KINDS:
            if not has_triangles(samples.mask):
                return no_mesh()
            return STORED_KINDS[self.kind].alone(StoredSamples(*samples, None), tolerance)
        sides = SideTolerances(tolerance, tolerance, tolerance, tolerance)
        return triangulate(*samples, border_lines(samples, sides, self.grid.block), tolerance)

    def draft(self, block: Block, demanded: BorderVertices | None) -> Draft:
        samples = self.stored_samples(block)
        return STORED_KINDS[self.kind].draft(samples, self.tolerance(block), demanded)

    def encode(self, block: Block, draft: Draft) -> bytes:
        samples = self.stored_samples(block)
        return STORED_KINDS[self.kind].encode(samples, self.tolerance(block), draft)

    def _stored_mesh(self, block: Block, samples: StoredSamples) -> BlockMesh:
        if self.part is None:
            raise ValueError(f"meshes of kind {self.kind} have stored bytes")
        data = self.part(block)
        if not has_triangles(samples.mask):
            if data:
                raise CorruptStreamError(f"{block} has no mesh, but bytes of one")
            return no_mesh()
        return STORED_KINDS[self.kind].mesh(samples, self.tolerance(block), data)


def _with_outside_mask(beyond: Mask, n_outside: int) -> Mask:
    """Copy the last inside row's validity to outside rows; `beyond` has an apron, True outside."""
    if not n_outside:
        return beyond
    last = np.repeat(beyond[-2:-1], n_outside, axis=0)
    return np.concatenate([beyond[:-1], last, np.ones_like(beyond[-1:])])


def outer_lines(values: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return views of the top, bottom, left and right line of a rectangle."""
    return values[0], values[-1], values[:, 0], values[:, -1]


def border_lines(
    samples: BlockSamples,
    tolerances: SideTolerances,
    side: int,
    offset: tuple[int, int] = (0, 0),
) -> Lines:
    """Return the vertices of the four border lines of a rectangle of samples.

    `offset` is the position of its first sample in its block of `side` cells.
    """
    row, col = offset
    lines = []
    for heights, locked, first, tolerance in zip(
        outer_lines(samples.heights), outer_lines(samples.locked), (col, col, row, row), tolerances,
        strict=True,
    ):  # fmt: skip
        heights = heights.astype(np.int64) << FRACTION_BITS
        forced = np.ascontiguousarray(locked)
        lines.append(line_vertices(heights, forced, first, side, tolerance))
    return Lines(*lines)


def measure_meshes(
    grid: Grid,
    mesher: BlockMesher,
    originals: Originals,
    executor: Executor,
    on_samples: Callable[[int], None],
    lost: Fraction,
    blocks: list[Block] | None = None,
) -> dict[Block, int]:
    """Return the distance of the valid originals under each block from its mesh, in 1/16 quanta.

    One walk over the full grid in windows; every window measures the meshes of all ancestors of its
    finest block, which can differ from the originals by more than their own error plus tolerance.
    The finest one cannot: it takes this bound, or is measured too (`BlockMesher.bounded_error`).
    Blocks without a mesh are left out. With `blocks`, some of the finest level, only the originals
    under these. The caller adds `lost` quanta to all errors.
    """
    meshes: Cache[Block, BlockMesh] = Cache(_CACHED_MESHES)
    largest: dict[Block, int] = {}
    lock = threading.Lock()

    def measure(block: Block) -> None:
        region = grid.block_region(block)
        heights, mask = originals(region)
        errors = {}
        bound = mesher.bounded_error(block, heights, mask, lost)
        if bound is not None:
            errors[block] = bound
        above = block
        while mask.any():
            is_bounded = above == block and bound is not None
            mesh = (
                no_mesh() if is_bounded else meshes.get_or_make(above, partial(mesher.mesh, above))
            )
            if len(mesh.triangles):
                stride = grid.stride(above.level)
                first = above.row * grid.block * stride, above.col * grid.block * stride
                errors[above] = largest_deviation(
                    mesh, stride, heights, mask, region.row - first[0], region.col - first[1]
                )
            if above.level == 0:
                break
            above = above.parent
        with lock:
            for key, error in errors.items():
                largest[key] = max(largest.get(key, 0), error)
        on_samples(region.n_rows * region.n_cols)

    def measure_all(share: list[Block]) -> None:
        for block in share:
            measure(block)

    finest = grid.blocks(grid.k_max) if blocks is None else blocks
    for _ in executor.map(measure_all, shares_of(finest, lambda block: (block.row, block.col))):
        pass
    return largest
