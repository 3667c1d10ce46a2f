"""Regular blocks in batches: Zhang et al. 2012 (see `neville`), over the file's decoded heights.

Blocks of N x N cells, the file's own, one draw call for all of them. A block's heights are made on
demand, from the file's next finer level under it. The criterion is theirs with ``error="paper"``: a
level's error is assumed to be μ times its spacing, and the finest level l with ε_l <= α d is drawn
(eqs. 3–6), skirts are (2^Δl_max + 1) ε_l deep (eq. 10) and heights move from the coarser level's
with the distance (eqs. 11, 12). With ``error="measured"`` each block has a bound on the error of
its surface, and τ is kept as in the adaptive mode.

The loading scheme is theirs in both (§4.2): roots near to far, children in view breadth first until
M blocks, eviction by w. Three departures: blocks that the criterion needs come first, because
breadth first alone would fill M with distant ones; the future view of a camera is requested seconds
ahead (`paging.motion`; theirs one frame, eq. 15); and the pyramid: theirs is made from the finest
level up by the filter of eq. (1), so that a coarse block depends on all data beneath it, and is
stored (docs/decisions/0017-neville-levels-on-demand.md).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.cache import Cache
from terrainwave.errors import InvalidArgumentError
from terrainwave.grid.block_stats import with_outside
from terrainwave.grid.quadtree import Block, Region
from terrainwave.read.decoder import unit_key, units_of
from terrainwave.render.modes.bounded import BoundedMode
from terrainwave.render.modes.mode import Frames, ModeNeeds
from terrainwave.render.modes.neville import filtered
from terrainwave.render.modes.regular import fill_parent_heights, largest_deviation
from terrainwave.render.scene.camera import Camera, Viewport, focal_length
from terrainwave.render.scene.horizon import Floors
from terrainwave.render.scene.patches import PatchBuilder, go_on
from terrainwave.render.scene.scales import FLOAT32_ROUNDING, HeightScale
from terrainwave.render.scene.selection import NodeInfo, NodeTable, Piece, Selection, View

# Default μ of ε_l = μ g_l; the paper shows 0.5 and 1.
MU = 0.5
# A parent's heights are needed by each of its children.
_CACHED_GRIDS = 64

Heights = NDArray[np.float32]


class BlockGrid(NamedTuple):
    """A block's heights, metres above the mode's middle, NaN in voids, and their error, metres."""

    heights: Heights
    error: float


class RegularBlock(NamedTuple):
    """A block to draw."""

    # shape (n + 1, n + 1, 2); of its vertices (see `regular`) and of its parent's surface there,
    # metres above `base`; NaN in voids and past the raster's edge
    heights: Heights
    slopes: NDArray[np.float16]  # shape (n + 3, n + 3, 3); as in `PatchBuilder.slopes`
    n_triangles: int
    base: float
    error: float
    morph: float
    children: list[NodeInfo]
    floors: Floors


class Batched(BoundedMode):
    """Zhang et al.'s blocks, selected by their criterion or by guaranteed errors."""

    name = "batched"
    options = ("detail", "order", "orientation")

    def __init__(
        self,
        needs: ModeNeeds,
        *,
        detail: float | None = None,  # μ > 0, only for error "paper"
        order: int = 4,  # of the filter: 2 or 4
        orientation: bool = False,
    ) -> None:
        super().__init__(needs, orientation=orientation)
        terrain, frame = self.terrain, self.frame
        if detail is not None and self.error != "paper":
            raise InvalidArgumentError(
                f"found `detail` {detail:g} and `error` {self.error!r}, expected `error` 'paper':"
                " measured errors need no factor"
            )
        self._mu = MU if detail is None else detail
        self._order = order
        self._side = terrain.grid.block
        self._scale = HeightScale.of(terrain, frame)
        self._patches = PatchBuilder(terrain, frame)
        low, high = frame.height_range
        self._middle, self._largest = (low + high) / 2, (high - low) / 2
        self._grids: Cache[Block, BlockGrid] = Cache(_CACHED_GRIDS)

    def roots(self) -> list[NodeInfo]:
        return [self._info(block) for block in self.terrain.grid.blocks(0)]

    def children(self, piece: Piece) -> list[NodeInfo]:
        return [self._info(child) for child in self.terrain.grid.children(piece.block)]

    def _info(self, block: Block) -> NodeInfo:
        region = self.terrain.grid.full_region(block)
        (left, bottom), (right, top) = self.frame.sides_of(region)
        low, high = self._limits(block)
        error = self._bound(block, self.terrain.block_error(block) * self.frame.error_metres)
        spacing = self.frame.spacing * self.terrain.grid.stride(block.level)
        return NodeInfo(Piece(*block), (left, bottom, low), (right, top, high), error, spacing)

    def _limits(self, block: Block) -> tuple[float, float]:
        """Return limits of originals and decoded samples under a block, metres.

        They also hold for its vertices, by `_grid`, except float32's last digit.
        """
        rounding = self._largest * FLOAT32_ROUNDING
        low, high = sorted(map(self.frame.to_metres, self.terrain.block_box(block)))
        return low - rounding, high + rounding

    def _bound(self, block: Block, error: float) -> float:
        """Return a block's error: of its level by eq. (2), or as measured."""
        if self.error == "paper":
            return self._mu * self.spacing * self.terrain.grid.stride(block.level)
        return error

    @property
    def spacing(self) -> float:
        """Return g_0, metres between samples of the finest level."""
        a, b, _, d, e, _ = self.frame.sample_matrix
        return math.sqrt(abs(a * e - b * d))

    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> RegularBlock:
        block = piece.block
        children = self.children(piece)
        self._prefetch(block)
        go_on(is_cancelled)
        heights, error = self.grid(block)
        go_on(is_cancelled)
        before = heights
        if block.level:
            parent, before = self.grid(block.parent).heights, np.empty_like(heights)
            first_row, first_col = (block.row & 1) * self._side, (block.col & 1) * self._side
            fill_parent_heights(heights, parent, first_row, first_col, before)
        go_on(is_cancelled)
        slopes = self._patches.slopes(block)
        has_any = not np.isnan(heights).all()
        missing = [(0, self._side + 1 - n) for n in heights.shape]
        both = np.stack([heights, before], axis=-1)
        with np.errstate(invalid="ignore"):
            apart = np.abs(heights - before)
        return RegularBlock(
            np.pad(both, (*missing, (0, 0)), constant_values=np.nan),
            slopes,
            2 * self._side**2 + 8 * self._side if has_any else 0,  # and those of skirts
            self._middle,
            self._bound(block, error),
            float(np.nanmax(apart)) if has_any else 0.0,
            children,
            self._patches.floors(block, error),
        )

    def _prefetch(self, block: Block) -> None:
        grid, level = self.terrain.grid, block.level
        near = grid.block_region(block, 2).intersect(Region(0, 0, *grid.level_shape(level)))
        keys = units_of(grid, level, near)
        if level < grid.k_max:
            keys.append(block)
        self.terrain.decoder.prefetch(keys)

    def grid(self, block: Block) -> BlockGrid:
        return self._grids.get_or_make(block, lambda: self._grid(block))

    def _grid(self, block: Block) -> BlockGrid:
        grid, finest = self.terrain.grid, self.terrain.grid.k_max
        coarse, mask = self._samples(unit_key(block), grid.block_region(block))
        if block.level == finest:
            error = self.terrain.quanta_error * self.frame.error_metres
            heights = np.where(mask, self._metres(coarse), np.nan)
            return BlockGrid(heights.astype(np.float32), self._plus(error))
        fine, valid = self._samples(block, grid.group_region(block))
        shape = self._reach(block)
        coarse, mask = _continued(coarse, mask, shape)
        fine, valid = _continued(fine, valid, (2 * shape[0] - 1, 2 * shape[1] - 1))
        surface = self._metres(fine)
        known = np.where(mask, self._metres(coarse), np.nan)
        low, high = (z - self._middle for z in self._limits(block))
        heights = filtered(surface, valid, self._order, known)
        vertices = np.clip(heights, low, high).astype(np.float32)
        error = max(
            self._error_below(child, vertices, surface, valid) for child in grid.children(block)
        )
        return BlockGrid(vertices, self._plus(error))

    def _error_below(
        self,
        child: Block,
        vertices: Heights,
        fine: NDArray[np.float64],
        valid: NDArray[np.bool_],
    ) -> float:
        """Return the largest distance of originals under a child from its parent's surface, metres.

        It is at most their distance from the child's bilinear surface, stated in the index, plus
        that surface's distance from the parent's; `fine` and `valid` are those of all children.
        """
        terrain, is_finest = self.terrain, child.level == self.terrain.grid.k_max
        own = terrain.quanta_error if is_finest else terrain.block_error(child)
        # No original lies beyond these samples of the child's level.
        rows, cols = (
            ((number & 1) * self._side, (number & 1) * self._side + n)
            for number, n in zip((child.row, child.col), self._reach(child), strict=True)
        )
        apart = largest_deviation(vertices, fine, valid, rows, cols, not is_finest)
        return own * self.frame.error_metres + apart

    def _reach(self, block: Block) -> tuple[int, int]:
        side, stride = self._side, self.terrain.grid.stride(block.level)
        rows, cols = (-(-(n - 1) // stride) for n in self.terrain.shape)
        return min(side, rows - block.row * side) + 1, min(side, cols - block.col * side) + 1

    def _plus(self, error: float) -> float:
        """Return an error plus the rounding of float32 and of the GPU's sums."""
        return error + 4 * self._largest * FLOAT32_ROUNDING

    def _samples(self, key: Block, region: Region) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        _, decoded = self.terrain.decoder.part(key, region)
        return decoded.heights, decoded.mask

    def _metres(self, quanta: NDArray[np.int32]) -> NDArray[np.float64]:
        return self._scale.metres(quanta) - self._middle

    def gamma(self, camera: Camera, viewport: Viewport) -> float:
        """Return τ / α: h / (2 tan(fov / 2)) (eq. 3), or the guaranteed γ."""
        if self.error == "paper":
            return focal_length(camera, viewport)
        return super().gamma(camera, viewport)

    def split_error(self, tau: float) -> float:
        """Return τ: blocks are split if ε_l > α d (eqs. 4–6)."""
        return tau if self.error == "paper" else super().split_error(tau)

    def spare(self, table: NodeTable, view: View, max_blocks: int) -> NDArray[np.int32]:
        """Return T: all blocks in view breadth first, up to M (§4.2)."""
        return table.wanted(view, max_blocks, -1.0)

    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        if self.error != "paper":
            return super().frames(table, view, selection, tau, n_missing)
        nodes, distances = selection.nodes, selection.distances
        alpha = tau / view.gamma
        errors = table.errors[nodes] * view.exaggeration
        # The block replaces its parent at twice the distance at which it is replaced itself.
        nearest = errors / alpha
        morphs = np.clip((distances - nearest) / nearest, 0.0, 1.0)
        mu = self._mu * view.exaggeration
        steepest = self._side * alpha / mu + 2  # 2^Δl_max, eq. (9), M = N + 1 samples
        return Frames(
            nodes, distances, morphs, (steepest + 1) * errors,
            selection.n_triangles, tau * view.flatness, n_missing,
        )  # fmt: skip


def _continued(
    quanta: NDArray[np.int32], mask: NDArray[np.bool_], shape: tuple[int, int]
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Return samples continued past the raster's edge as in a block's error (FORMAT.md §4.4)."""
    missing = [(0, n - own) for n, own in zip(shape, quanta.shape, strict=True)]
    return with_outside(np.ascontiguousarray(quanta), *shape), np.pad(mask, missing, mode="edge")
