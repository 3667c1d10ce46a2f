"""Conversion of a block of the file to a patch: vertices, triangles and slopes for the GPU.

The step from a coarse block to the finest ones is large: their meshes keep to the file's own error.
So finest blocks also have variants, with 4, 16 … times the tolerance, in the tree between their
parent and the file's mesh: a chain, each the only child of the one before.

Runs in worker threads.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.cache import Cache
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block, Region
from terrainwave.mesh.loose import LooseMesher
from terrainwave.mesh.mesh_data import walls_below
from terrainwave.mesh.sections import mesher_of
from terrainwave.names import UNBOUNDED_MESHES
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.horizon import OVERLAP, Floors, floors_of
from terrainwave.render.scene.patch_kernels import SKIRT_FLAG, bilinear_at
from terrainwave.render.scene.scales import FLOAT32_ROUNDING, HeightScale, Texels
from terrainwave.render.scene.selection import NodeInfo, Piece
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.mesh_surface import surface_at

# col and row in half samples of the block's level (the column's top bit marks skirts); height and
# height of the parent's surface above the patch's base, metres.
VERTEX = np.dtype([("col", "<u2"), ("row", "<u2"), ("z", "<f4"), ("z_parent", "<f4")])
# Cache of meshes: their children's vertices move to them.
_CACHED_BYTES = 192 << 20
_VARIANT_BITS = 2  # each variant has four times the tolerance of the one before
_MAX_VARIANT = 5
# Limit of a variant's error, as a share of the error of the piece that it replaces.
_VARIANT_SHARE = 0.6


class Cancelled(Exception):
    """A patch that is no longer wanted."""


def go_on(is_cancelled: Callable[[], bool]) -> None:
    """Raise `Cancelled` if work is no longer wanted."""
    if is_cancelled():
        raise Cancelled


class Patch(NamedTuple):
    """A piece to draw."""

    piece: Piece
    vertices: NDArray[np.void]  # of VERTEX
    triangles: NDArray[np.uint32]  # shape (n, 3); the surface's, then those of skirts
    # shape (n_rows + 2, n_cols + 2, 3); metres per metre to the east and to the north at the
    # block's samples and around them
    slopes: NDArray[np.float16]
    base: float  # height of z = 0, metres
    # used for selection: no valid original is further from the surface, metres; with
    # `PatchBuilder.is_loose`, from the guaranteed surface
    error: float
    drawn_error: float  # no valid original is further from the drawn surface, metres
    morph: float  # largest distance between the surface and its parent's at vertices, metres
    children: list[NodeInfo]
    floors: Floors  # lower limits of the surface, within `drawn_error`

    @property
    def n_triangles(self) -> int:
        return len(self.triangles)

    @property
    def n_bytes(self) -> int:
        return self.vertices.nbytes + self.triangles.nbytes + self.slopes.nbytes


class PatchBuilder:
    """Patches of a terrain's blocks. Thread-safe."""

    def __init__(
        self,
        terrain: TerrainFile,
        frame: Frame,  # local metres; its exaggeration is not used: the GPU applies it
        *,
        # Err_Appr of every block (`level_errors.recursive_errors`): errors are then Err_Appr +
        # Err_Tri, Yusov & Turlapov 2010, eq. (3). By default they are those stored for meshes, or
        # else bounds that are known once meshes are built (`mesh.blocks`).
        recursive: list[NDArray[np.float64]] | None = None,
        # blocks above the finest level are drawn with meshes without a guarantee (`mesh.loose`),
        # whose errors are known once they are built
        is_loose: bool = False,
    ) -> None:
        self._terrain = terrain
        self._frame = frame
        self._recursive = recursive
        self._mesher = mesher_of(terrain)
        self._loose = LooseMesher(terrain) if is_loose else None
        self._scale = HeightScale.of(terrain, frame)
        self._unit = abs(self._scale.per_quantum) / (1 << FRACTION_BITS)  # metres, of tolerances
        self._texels = Texels(frame, self._scale)
        self._meshes: Cache[Piece, BlockMesh] = Cache(
            _CACHED_BYTES, size_of=lambda mesh: sum(part.nbytes for part in mesh)
        )

    def roots(self) -> list[NodeInfo]:
        return [self._first(block, math.inf) for block in self._terrain.grid.blocks(0)]

    def children(self, piece: Piece) -> list[NodeInfo]:
        if piece.variant:
            return [self.info(piece._replace(variant=piece.variant - 1))]
        error = self.error(piece)
        return [self._first(child, error) for child in self._terrain.grid.children(piece.block)]

    def parent(self, piece: Piece) -> Piece | None:
        if piece.level == self._terrain.n_levels - 1:
            next_one = piece._replace(variant=piece.variant + 1)
            above = Piece(*piece.block.parent) if piece.level else None
            limit = self.error(above) if above else math.inf
            if next_one.variant <= self._coarsest(limit):
                return next_one
        return Piece(*piece.block.parent) if piece.level else None

    def _first(self, block: Block, error: float) -> NodeInfo:
        """Return the first piece of a block below one with this error: its coarsest useful one."""
        variant = 0
        if block.level == self._terrain.n_levels - 1:
            variant = self._coarsest(error)
        return self.info(Piece(*block, variant))

    def _coarsest(self, error: float) -> int:
        """Return the coarsest variant that is useful below a piece with this error."""
        variant = 0
        while variant < _MAX_VARIANT and math.isfinite(error):
            if self._variant_error(variant + 1) > _VARIANT_SHARE * error:
                break
            variant += 1
        return variant

    def _variant_error(self, variant: int) -> float:
        tolerance = self._variant_tolerance(variant) * self._unit
        return self._terrain.quanta_error * self._frame.error_metres + tolerance

    def _variant_tolerance(self, variant: int) -> int:
        own = max(self._terrain.header.mesh_tolerance, 1 << FRACTION_BITS)
        return own << _VARIANT_BITS * variant

    def info(self, piece: Piece) -> NodeInfo:
        block = piece.block
        region = self._terrain.grid.full_region(block)
        error = self.error(piece)
        low, high = sorted(map(self._frame.to_metres, self._terrain.block_box(block)))
        (left, bottom), (right, top) = self._frame.sides_of(region)
        spacing = self._frame.spacing * self._terrain.grid.stride(block.level)
        ends = (left, bottom, low - error), (right, top, high + error)
        return NodeInfo(piece, *ends, error, spacing)

    def error(self, piece: Piece) -> float:
        if piece.variant:
            return self._variant_error(piece.variant)
        terrain, block = self._terrain, piece.block
        per_unit = self._frame.error_metres
        stored = terrain.stored_mesh_error(block)
        is_unbounded = terrain.mesh_kind in UNBOUNDED_MESHES
        if stored is not None and (is_unbounded or self._recursive is None):
            return stored * per_unit
        # For an unmeasured mesh an estimate, until it is built.
        is_viewed = self._is_made_for_views(block)
        tolerance = (self._mesher.view_tolerance if is_viewed else self._mesher.tolerance)(block)
        return self._heights_error(block) * per_unit + tolerance * self._unit

    def _is_unmeasured(self, block: Block) -> bool:
        """Return whether the bound of a block's mesh is only known once it is built."""
        if block.level == self._terrain.n_levels - 1:
            return False
        if self._loose is not None or self._terrain.mesh_kind == "none":
            return True
        return self._recursive is None and self._terrain.stored_mesh_error(block) is None

    def _is_made_for_views(self, block: Block) -> bool:
        """Return whether a block has another mesh than the file's, with fewer triangles."""
        return self._loose is None and self._is_unmeasured(block)

    def _heights_error(self, block: Block) -> float:
        """Return the error of a block's bilinear surface, in the file's unit."""
        if self._recursive is not None:
            return float(self._recursive[block.level][block.row, block.col])
        if block.level == self._terrain.n_levels - 1:
            return self._terrain.quanta_error
        return self._terrain.block_error(block)

    def mesh(self, piece: Piece) -> BlockMesh:
        return self._meshes.get_or_make(piece, lambda: self._triangulate(piece))

    def _triangulate(self, piece: Piece) -> BlockMesh:
        block = piece.block
        if piece.variant:
            return self._mesher.coarser_mesh(block, self._variant_tolerance(piece.variant))
        if self._loose is not None and block.level < self._terrain.n_levels - 1:
            return self._loose.mesh(block)
        if self._is_made_for_views(block):
            return self._mesher.view_mesh(block)
        return self._mesher.mesh(block)

    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> Patch:
        """Return the patch of a piece."""
        block = piece.block
        children = self.children(piece)
        go_on(is_cancelled)
        mesh = self.mesh(piece)
        go_on(is_cancelled)
        z = self._scale.metres(mesh.heights / (1 << FRACTION_BITS))
        base = float(z.min() + z.max()) / 2 if len(z) else 0.0
        z_parent = self._parent_heights(piece, mesh, z)
        go_on(is_cancelled)
        vertices = np.empty(len(z), dtype=VERTEX)
        vertices["col"], vertices["row"] = mesh.cols, mesh.rows
        vertices["z"], vertices["z_parent"] = z - base, z_parent - base
        vertices, triangles = _with_skirts(mesh, vertices)
        largest = float(
            max(np.abs(z - base).max(initial=0), np.abs(z_parent - base).max(initial=0))
        )
        morph = float(np.abs(z - z_parent).max(initial=0))
        error = drawn_error = self.error(piece)
        if self._is_unmeasured(block):
            drawn_error = self._mesher.derived_error(block, mesh) * self._unit
            if self._loose is None:
                error = drawn_error
        rounding = largest * FLOAT32_ROUNDING
        return Patch(
            piece,
            vertices,
            triangles,
            self.slopes(block),
            base,
            error + rounding,
            drawn_error + rounding,
            morph,
            children,
            self.floors(block, drawn_error + rounding),
        )

    def _parent_heights(
        self, piece: Piece, mesh: BlockMesh, z: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the heights of the parent's surface at the vertices; `z` if it has none.

        For a coarser level it is the surface of the samples: within a mesh's tolerance, a quarter
        of its error, of the drawn one, so that the parent's mesh need not be built.
        """
        above = self.parent(piece)
        if above is None or not len(z):
            return z
        if above.level < piece.level and self._loose is None:
            return self._coarser_heights(piece, mesh, z)
        parent = self.mesh(above)
        numbers = np.full((int(mesh.rows.max()) + 1, int(mesh.cols.max()) + 1), -1, dtype=np.int32)
        numbers[mesh.rows, mesh.cols] = np.arange(len(z), dtype=np.int32)
        factor, first = 1, (0, 0)
        if above.level < piece.level:
            side = 2 * self._terrain.grid.block
            factor, first = 2, ((piece.row & 1) * side, (piece.col & 1) * side)
        heights = np.full(len(z), np.nan)
        surface_at(
            parent.rows, parent.cols, parent.heights, parent.triangles, factor, *first, numbers,
            heights,
        )  # fmt: skip
        heights = self._scale.metres(heights / (1 << FRACTION_BITS))
        return np.where(np.isnan(heights), z, heights)

    def _coarser_heights(
        self, piece: Piece, mesh: BlockMesh, z: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the heights between samples of the level above at the vertices of a mesh."""
        grid = self._terrain.grid
        inner = grid.block_region(piece.block)
        level = Region(0, 0, *grid.level_shape(piece.level - 1))
        row, col = inner.row // 2, inner.col // 2
        n_rows, n_cols = (n // 2 + 2 for n in inner.shape)
        region = Region(row, col, n_rows, n_cols).intersect(level)
        heights, mask = self._terrain.decoder.window(piece.level - 1, region)
        out = np.empty(len(z))
        first = 2 * (inner.row - 2 * row), 2 * (inner.col - 2 * col)
        quanta = (z - self._scale.zero) / self._scale.per_quantum
        bilinear_at(mesh.rows, mesh.cols, heights, mask, *first, quanta, out)
        return self._scale.metres(out)

    def floors(self, block: Block, error: float) -> Floors:
        """Return lower limits of a block's surface that is within `error` metres of originals.

        They are at most the error of its bilinear surface below the block's samples.
        """
        grid, frame = self._terrain.grid, self._frame
        inner, wide = grid.block_region(block), grid.block_region(block, OVERLAP)
        quanta, mask = self._terrain.decoder.window(block.level, wide)
        below = error + self._heights_error(block) * frame.error_metres
        heights = np.where(mask, self._scale.metres(quanta) - below, -np.inf)
        matrix = np.array(frame.matrix_of(wide, grid.stride(block.level)))
        cells = inner.n_rows - 1, inner.n_cols - 1
        return floors_of(heights, matrix, cells, (inner.row - wide.row, inner.col - wide.col))

    def slopes(self, block: Block) -> NDArray[np.float16]:
        """Return slopes and heights at the samples of a block and at one more on each side.

        Neighbours of one level compute the same values where they share samples. Past the raster's
        edge the last ones are repeated, and once more if the block ends before its full size.
        """
        terrain, grid = self._terrain, self._terrain.grid
        level = Region(0, 0, *grid.level_shape(block.level))
        inner = grid.block_region(block)
        near = grid.block_region(block, 1).intersect(level)
        wide = grid.block_region(block, 2).intersect(level)
        samples = terrain.decoder.window(block.level, wide)
        n_rows, n_cols = (n + 2 + min(1, grid.block + 1 - n) for n in (inner.n_rows, inner.n_cols))
        first = inner.row - 1 - wide.row, inner.col - 1 - wide.col
        stride = grid.stride(block.level)
        return self._texels.of(samples, first, near.shape, (n_rows, n_cols), stride)


def _with_skirts(
    mesh: BlockMesh, vertices: NDArray[np.void]
) -> tuple[NDArray[np.void], NDArray[np.uint32]]:
    """Return vertices and triangles with two more triangles below each edge on the border."""
    triangles = mesh.triangles.astype(np.uint32)
    if not len(triangles):
        return vertices, triangles
    starts, ends = mesh.triangles.ravel(), mesh.triangles[:, [1, 2, 0]].ravel()
    is_border = np.zeros(len(starts), dtype=np.bool_)
    for places in (mesh.rows, mesh.cols):
        line = places[starts]
        is_border |= (line == places[ends]) & ((line == 0) | (line == places.max()))
    edges = np.column_stack([starts, ends])[is_border]
    is_top = np.zeros(len(vertices), dtype=np.bool_)
    is_top[edges] = True
    below = vertices[is_top]
    below["col"] |= SKIRT_FLAG
    lower = len(vertices) - 1 + np.cumsum(is_top)[edges]
    skirts = walls_below(*edges.T, *lower.T).astype(np.uint32)
    return np.concatenate([vertices, below]), np.concatenate([triangles, skirts])
