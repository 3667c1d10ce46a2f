"""Regular blocks in batches: Zhang et al. 2012 (see `neville`), over the file's decoded heights.

Blocks of N x N samples of a pyramid of their own, one draw call for all of them. Its criterion is
theirs with ``error="paper"``: a level's error is taken as μ times its spacing, and the finest level
l with ε_l <= α d is drawn (eqs. 3–6), skirts are (2^Δl_max + 1) ε_l deep (eq. 10) and heights move
from the coarser level's with the distance (eqs. 11, 12). With ``error="measured"`` each block has
the measured error of its surface, and τ is kept as in the adaptive mode.

The loading scheme is theirs in both (§4.2): roots near to far, children in view breadth first until
M blocks, eviction by w, and once all are here what P₂ = 2 P₁ − P₀ sees. One departure: blocks that
the criterion needs come first, because breadth first alone would fill M with distant ones.
"""

import math
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError
from terrainwave.grid.quadtree import Region
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.read.decoder import units_of
from terrainwave.render.camera import Camera, Viewport, focal_length
from terrainwave.render.frame import Frame
from terrainwave.render.kernels import slopes
from terrainwave.render.modes.bounded import BoundedMode
from terrainwave.render.modes.mode import Frames
from terrainwave.render.modes.neville import Heights, NevillePyramid
from terrainwave.render.modes.regular import (
    fill_parent_heights,
    fill_vertices,
    largest_deviation,
)
from terrainwave.render.patches import Cancelled
from terrainwave.render.scales import FLOAT32_ROUNDING, HeightScale, HeightTexels, SlopeScale
from terrainwave.render.selection import NodeInfo, NodeTable, Piece, Selection, View

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile
    from terrainwave.render.modes.block_surface import BlockSurface

# The quadtrees of the list (TQL) per side; theirs are as many as regions.
ROOTS_PER_SIDE = 2
# μ of ε_l = μ g_l where none is asked for; they show 0.5 and 1.
MU = 0.5


class RegularBlock(NamedTuple):
    """A block as drawn.

    Parameters
    ----------
    heights : ndarray of float32, shape (n + 2, n + 2, 2)
        Of its vertices (see `regular`) and of its parent's surface there, metres; NaN in voids.
    slopes : ndarray of float16, shape (n + 2, n + 2, 3)
        Metres per metre to the east and to the north at its samples and one around them.
    """

    heights: Heights
    slopes: NDArray[np.float16]
    n_triangles: int
    base: float
    error: float
    morph: float
    children: list[NodeInfo]


class _Levels:
    """Errors, lowest and highest heights of all blocks, metres; one array per level, 0 coarsest."""

    def __init__(self, shapes: list[tuple[int, int]]) -> None:
        self.errors = [np.zeros(shape) for shape in shapes]
        self.low = [np.full(shape, np.inf) for shape in shapes]
        self.high = [np.full(shape, -np.inf) for shape in shapes]


class Batched(BoundedMode):
    """Zhang et al.'s blocks, chosen by their criterion or by measured errors.

    Parameters
    ----------
    detail : float, optional
        μ > 0, for error "paper" alone.
    order : int
        Of the filter: 2 or 4.

    Notes
    -----
    The pyramid and the errors are made when the mode begins: that decodes the file twice. Memory is
    bounded; a large pyramid lies in temporary files (4/3 bytes per sample).
    """

    name = "batched"
    options = ("detail", "order")

    def __init__(
        self,
        terrain: "TerrainFile",
        frame: Frame,
        *,
        error: str = "measured",
        progress: ProgressCallback | None = None,
        detail: float | None = None,
        order: int = 4,
    ) -> None:
        super().__init__(terrain, frame, error=error)
        self._mu = self._checked_detail(detail)
        self._side = terrain.grid.block
        self._scale = HeightScale.of(terrain, frame)
        self._slope_scale, self._height_texels = SlopeScale(frame), HeightTexels.of(frame)
        low, high = (height * frame.metres[2] for height in frame.heights)
        self._middle, self._largest = (low + high) / 2, abs(high - low) / 2
        self.n_levels = 1
        while self._n_blocks(0) > ROOTS_PER_SIDE:
            self.n_levels += 1
        reporter = Reporter(progress)
        n_samples = terrain.shape[0] * terrain.shape[1]
        self._pyramid = NevillePyramid(
            terrain.shape,
            self._read,
            self.n_levels,
            Path(tempfile.gettempdir()),
            reporter.counter("pyramid", n_samples, 4),
            order=order,
        )
        try:
            self._levels = self._measure(reporter.counter("errors", n_samples, 4))
        except BaseException:
            self.close()
            raise

    @classmethod
    def preparation(cls, error: str) -> str | None:
        """Say that pyramid and errors need every sample."""
        return (
            "building the pyramid of Zhang et al. and measuring its blocks: this decodes the whole"
            " file twice"
        )

    def _checked_detail(self, detail: float | None) -> float:
        if detail is None:
            return MU
        if self.error != "paper":
            raise InvalidArgumentError(
                f"found `detail` {detail:g} and `error` {self.error!r}, expected `error` 'paper':"
                " measured errors need no factor"
            )
        if not 0 < detail < math.inf:
            raise InvalidArgumentError(f"found `detail` {detail:g}, expected a number > 0")
        return detail

    def close(self) -> None:
        """Delete the pyramid."""
        self._pyramid.close()

    # Arithmetic of levels: pieces count from the coarsest, as everywhere here

    def _shift(self, level: int) -> int:
        return self.n_levels - 1 - level

    def _n_blocks(self, level: int) -> int:
        """Return the larger number of blocks per side of a level."""
        return max(self._blocks(level))

    def _blocks(self, level: int) -> tuple[int, int]:
        size = self._side << self._shift(level)
        n_rows, n_cols = self.terrain.shape
        return -(-n_rows // size), -(-n_cols // size)

    def _children(self, piece: Piece) -> list[Piece]:
        level = piece.level + 1
        if level == self.n_levels:
            return []
        n_rows, n_cols = self._blocks(level)
        return [
            Piece(level, row, col)
            for row in (2 * piece.row, 2 * piece.row + 1)
            for col in (2 * piece.col, 2 * piece.col + 1)
            if row < n_rows and col < n_cols
        ]

    def _read(self, region: Region) -> Heights:
        """Return heights of the full grid, metres above the middle of the file's range."""
        terrain = self.terrain
        level = terrain.n_levels - 1
        terrain.decoder.prefetch(units_of(terrain.grid, level, region))
        quanta, mask = terrain.decoder.window(level, region)
        return np.where(mask, self._scale.metres(quanta) - self._middle, np.nan).astype(np.float32)

    def _samples(self, piece: Piece, apron: int, *, replicate: bool) -> Heights:
        region = Region(
            piece.row * self._side - apron,
            piece.col * self._side - apron,
            self._side + 2 * apron,
            self._side + 2 * apron,
        )
        return self._pyramid.window(self._shift(piece.level), region, replicate=replicate)

    def _vertices(self, piece: Piece) -> Heights:
        samples = self._samples(piece, 1, replicate=True)
        vertices = np.empty_like(samples)
        fill_vertices(samples, vertices)
        return vertices

    # Measured errors and boxes

    def _measure(self, count: Callable[[int], None]) -> _Levels:
        levels = _Levels([self._blocks(level) for level in range(self.n_levels)])
        roots = self._root_pieces()
        with ThreadPoolExecutor(min(self.terrain.n_threads, len(roots))) as executor:
            for _ in executor.map(lambda root: self._measure_below(root, [], levels, count), roots):
                pass
        return levels

    def _measure_below(
        self,
        piece: Piece,
        above: list[tuple[Piece, Heights]],
        levels: _Levels,
        count: Callable[[int], None],
    ) -> None:
        """Measure a block, those below it, and those `above` against what lies here."""
        level, row, col = piece.level, piece.row, piece.col
        vertices = self._vertices(piece)
        children = self._children(piece)
        if children:
            for child in children:
                self._measure_below(child, [*above, (piece, vertices)], levels, count)
            low = [levels.low[c.level][c.row, c.col] for c in children]
            high = [levels.high[c.level][c.row, c.col] for c in children]
        else:
            full = Region(row * self._side, col * self._side, self._side, self._side)
            full = full.intersect(Region(0, 0, *self.terrain.shape))
            # The inner vertices of the finest level are its samples.
            heights = np.ascontiguousarray(vertices[1 : 1 + full.n_rows, 1 : 1 + full.n_cols])
            for coarse, surface in above:
                shift = level - coarse.level
                first = full.row - (coarse.row * self._side << shift)
                left = full.col - (coarse.col * self._side << shift)
                error = largest_deviation(heights, surface, first, left, float(1 << shift))
                errors = levels.errors[coarse.level]
                errors[coarse.row, coarse.col] = max(errors[coarse.row, coarse.col], error)
            count(heights.size)
            low, high = [np.inf], [-np.inf]
        known = vertices[~np.isnan(vertices)]
        bound = self.terrain.quanta_error * self.frame.metres[2]
        levels.errors[level][row, col] += bound
        levels.low[level][row, col] = min(*low, known.min(initial=np.inf) - bound, np.inf)
        levels.high[level][row, col] = max(*high, known.max(initial=-np.inf) + bound, -np.inf)

    # The tree

    def _root_pieces(self) -> list[Piece]:
        n_rows, n_cols = self._blocks(0)
        return [Piece(0, row, col) for row in range(n_rows) for col in range(n_cols)]

    def roots(self) -> list[NodeInfo]:
        """Return the roots of the list of quadtrees."""
        return [self._info(piece) for piece in self._root_pieces()]

    def children(self, piece: Piece) -> list[NodeInfo]:
        """Return the blocks one level finer."""
        return [self._info(child) for child in self._children(piece)]

    def _info(self, piece: Piece) -> NodeInfo:
        level, row, col = piece.level, piece.row, piece.col
        size = self._side << self._shift(level)
        n_rows, n_cols = self.terrain.shape
        rows = np.clip([row * size - 0.5, (row + 1) * size - 0.5], 0, n_rows - 1)
        cols = np.clip([col * size - 0.5, (col + 1) * size - 0.5], 0, n_cols - 1)
        xy = self.frame.samples_to_local(np.repeat(rows, 2), np.tile(cols, 2))
        (left, bottom), (right, top) = xy.min(axis=0), xy.max(axis=0)
        low, high = self._levels.low[level][row, col], self._levels.high[level][row, col]
        if low > high:  # void
            low = high = 0.0
        middle = self._middle
        return NodeInfo(
            piece,
            (float(left), float(bottom), float(low) + middle),
            (float(right), float(top), float(high) + middle),
            self._error(piece),
        )

    def _error(self, piece: Piece) -> float:
        if self.error == "paper":
            return self._mu * self.spacing * (1 << self._shift(piece.level))
        error = float(self._levels.errors[piece.level][piece.row, piece.col])
        return error + 4 * self._largest * FLOAT32_ROUNDING

    @property
    def spacing(self) -> float:
        """Return g_0, metres between samples of the finest level."""
        a, b, _, d, e, _ = self.frame.sample_matrix
        return math.sqrt(abs(a * e - b * d))

    # In workers

    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> RegularBlock:
        """Return vertices and slopes of a block."""
        vertices = self._vertices(piece)
        if is_cancelled():
            raise Cancelled
        before = vertices
        if piece.level:
            parent = Piece(piece.level - 1, piece.row >> 1, piece.col >> 1)
            before = np.empty_like(vertices)
            first_row, first_col = (piece.row & 1) * self._side, (piece.col & 1) * self._side
            fill_parent_heights(vertices, self._vertices(parent), first_row, first_col, before)
        if is_cancelled():
            raise Cancelled
        with np.errstate(invalid="ignore"):
            apart = np.abs(vertices - before)
        has_any = not np.isnan(vertices).all()
        return RegularBlock(
            np.stack([vertices, before], axis=-1),
            self._slopes(piece),
            n_grid_triangles(self._side) if has_any else 0,
            self._middle,
            self._error(piece),
            float(np.nanmax(apart)) if has_any else 0.0,
            self.children(piece),
        )

    def _slopes(self, piece: Piece) -> NDArray[np.float16]:
        samples = self._samples(piece, 2, replicate=False)
        mask = ~np.isnan(samples)
        gradients = np.empty((self._side + 2, self._side + 2, 2), dtype=np.float32)
        slopes(np.where(mask, samples, 0), mask, 1, 1, gradients)
        per_sample = gradients / (1 << self._shift(piece.level))
        metres = samples.astype(np.float64) + self._middle
        return self._height_texels.beside(self._slope_scale.texels(per_sample), metres, mask)

    # Each frame

    def gamma(self, camera: Camera, viewport: Viewport) -> float:
        """Return τ / α: h / (2 tan(fov / 2)) (eq. 3), or the γ that holds everywhere."""
        if self.error == "paper":
            return focal_length(camera, viewport)
        return super().gamma(camera, viewport)

    def split_error(self, tau: float) -> float:
        """Return τ: blocks are split where ε_l > α d (eqs. 4–6)."""
        return tau if self.error == "paper" else super().split_error(tau)

    def spare(self, table: NodeTable, view: View, max_blocks: int) -> NDArray[np.int32]:
        """Return T: all blocks in view breadth first, to M (§4.2)."""
        return table.wanted(view, max_blocks, -1.0)

    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        """Return morphs and skirts: as the errors demand, or as the paper has them."""
        if self.error != "paper":
            return super().frames(table, view, selection, tau, n_missing)
        nodes, distances = selection.nodes, selection.distances
        alpha = tau / view.gamma
        errors = table.errors[nodes] * view.exaggeration
        # The block replaces its parent at twice the distance at which it is replaced itself.
        nearest = errors / alpha
        morphs = np.clip((distances - nearest) / nearest, 0.0, 1.0)
        mu = self._mu * view.exaggeration
        steepest = (self._side - 1) * alpha / mu + 2  # 2^Δl_max, eq. (9), M = N samples
        return Frames(
            nodes, distances, morphs, (steepest + 1) * errors,
            selection.n_triangles, tau, n_missing,
        )  # fmt: skip

    @staticmethod
    def surface(context: Any, side: int, *, max_bytes: int) -> "BlockSurface":
        """Return textures of blocks and the program that draws them."""
        from terrainwave.render.modes.block_surface import BlockSurface

        return BlockSurface(context, side, max_bytes=max_bytes)


def n_grid_triangles(side: int) -> int:
    """Return the triangles of a block and its skirts."""
    cells = side + 1
    return 2 * cells * cells + 8 * cells
