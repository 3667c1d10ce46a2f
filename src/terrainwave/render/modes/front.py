"""Meshes rebuilt each frame, patch by patch: common parts of `dynamic`, `rqt` and `vertex-texture`.

The raster is a quadtree of patches with equal numbers of cells, each of one level of the file: the
coarsest holds all of it, the finest ones its full grid. They are loaded and dropped like blocks. A
patch is used if the error of its level is at most `_LEVEL_SHARE` of τ on screen; its mesh follows
the camera within it, so that both errors together are within τ.

A mesh may end short of its samples, and the samples of a coarse level short of the raster. At the
outline a patch's heights continue beyond it, and shaders clip the mesh there.

Neighbours may be of any level. Where they are not joined, both end in skirts: at every point of a
border each is within its own error of the originals, so skirts as deep as both errors together
leave no gap. A patch coarser than τ requires represents others that are not loaded yet: it is drawn
with a τ that suits its level, not with all of its samples.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.block_stats import with_outside
from terrainwave.grid.quadtree import Block, Region
from terrainwave.mesh.mesh_data import walls_below
from terrainwave.read.decoder import units_of
from terrainwave.render.modes.mode import NO_PROMISE, Frames, Mode, ModeNeeds
from terrainwave.render.scene.camera import Camera, focal_length, slant
from terrainwave.render.scene.patches import go_on
from terrainwave.render.scene.scales import FLOAT32_ROUNDING, HeightScale, Texels
from terrainwave.render.scene.selection import NodeInfo, NodeTable, Piece, Selection, View
from terrainwave.tri.followed import Eye, Followed, Pressure
from terrainwave.tri.rqt.vertex_errors import twist_of
from terrainwave.tri.scratch import Scratch

MAX_VERTICES = 4_000_000
# λ: vertices move while errors go from τ / λ to τ.
MORPH = 1.25
# Share of τ for the error of a level. A power of two, so that dividing by it restores τ exactly.
_LEVEL_SHARE = 0.5
# A patch that represents others is drawn with at most this multiple of τ.
_MOST_RELAXED = 8.0
# If patches do not fit, τ is raised by steps, up to this factor: around the eye no level is good
# enough. It is lowered if no more than this share of the room is taken.
_STEP, _MOST_SHORT, _WELL_FILLED = 1.1, 16.0, 0.95

# Neighbours, or samples beyond the outline, continue beyond all sides of a mesh.
_ALL_OPEN = (True, True, True, True)


class Drawn(NamedTuple):
    """A mesh for one frame."""

    vertices: NDArray[np.float64]  # shape (n, 3); local metres, heights with exaggeration
    triangles: NDArray[np.int32]  # shape (m, 3); those of skirts come last, patch by patch
    # shape (n,); for `--coloring level`: log2 of the vertex's share of the full grid
    sizes: NDArray[np.int32]
    # shape (n,); largest depth of a vertex at a skirt's lower end; -1 for all others
    depths: NDArray[np.float64]

    @classmethod
    def surface(
        cls,
        vertices: NDArray[np.float64],
        triangles: NDArray[np.int32],
        sizes: NDArray[np.int32],
    ) -> Self:
        return cls(vertices, triangles, sizes, np.full(len(vertices), -1.0))


class PatchFrame(NamedTuple):
    """The mesh of a patch for one frame."""

    drawn: Drawn
    # shape (k, 2); vertices of edges to neighbours that are not joined to it
    edges: NDArray[np.int32]
    # vertical distance of the mesh from the samples of its level where such edges and those of
    # neighbours are in view; metres, without exaggeration
    error: float


@dataclass(frozen=True)
class FrontPatch:
    """Result of `build`: a mesh that follows the camera over samples of one level."""

    piece: Piece
    region: Region  # of the level
    matrix: tuple[float, ...]  # positions of its samples in local metres, counted from its first
    slopes: NDArray[np.float16]  # of `Texels.of`
    # over its continued heights: a DynamicMesh or a RestrictedMesh; None if all is void
    mesh: Any
    lead: tuple[int, int]  # rows and columns of continued heights before those of the patch
    error: float  # largest distance of originals from triangles between all samples, metres
    children: list[NodeInfo]
    side: int  # samples per side of the mode's largest patches
    room: int  # limit of a patch's memory besides its slopes, in bytes
    # largest additional distance of triangles from the bilinear surface between samples, over
    # `PatchFrame.error`, metres
    between: float = 0.0
    n_triangles: int = 0
    base: float = 0.0
    morph: float = 0.0
    floors: None = None

    def places(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, c, d, e, f = self.matrix
        inverse = np.linalg.inv(np.array([[a, b], [d, e]]))
        return (vertices[:, :2] - (c, f)) @ inverse.T


def eye_of(view: View) -> Eye:
    return Eye(
        view.camera.eye,
        view.camera.forward,
        view.planes,
        focal_length(view.camera, view.viewport),
        slant(view.camera, view.viewport),
        view.exaggeration,
    )


class FrontMode(Mode):
    """Mode of patches whose meshes follow the camera."""

    cells: int  # of a patch, per side
    # `apron, beyond`: samples by which patches extend beyond their first row and column, and beyond
    # those of their cells
    apron: int = 0
    beyond: int = 1
    # meshes have this number of samples per side, or a multiple of it, and may end half as many
    # short of their last ones
    tree: int = 1
    sample_bytes: int  # of a mesh, at most

    def __init__(self, needs: ModeNeeds) -> None:
        super().__init__(needs)
        terrain, frame = self.terrain, self.frame
        self._scale = HeightScale.of(terrain, frame)
        self._texels = Texels(frame, self._scale)
        self._patches: dict[Piece, FrontPatch] = {}
        self.scratch = Scratch()  # of the thread that draws
        self._pressure, self._shortage = Pressure(), 1.0
        self._last_camera: Camera | None = None
        self._is_short = False
        self.drawn: Drawn | None = None  # the mesh of the last frame
        # patches of the last frame, in the order of `Frames.nodes`
        self.shown: list[FrontPatch] = []
        self.followed: list[Followed] = []  # statistics of their meshes
        self.first_vertices: list[int] = []  # first vertex of each in `drawn`

    @property
    def side(self) -> int:
        return min(self._reach, max(self.terrain.shape))

    @property
    def _reach(self) -> int:
        """Return the samples per side of a patch with its aprons, also at the raster's edge."""
        return self.apron + self.cells + self.beyond

    @property
    def _mesh_side(self) -> int:
        return min(self._reach, self.side + 1 + self.apron + self.beyond)

    def _n_pieces(self, level: int) -> tuple[int, int]:
        grid = self.terrain.grid
        stride, n_rows, n_cols = grid.stride(level), grid.n_rows, grid.n_cols
        rows, cols = (-(-(n - 1) // (stride * self.cells)) for n in (n_rows, n_cols))
        return max(rows, 1), max(cols, 1)

    def roots(self) -> list[NodeInfo]:
        """Return the piece that holds all of the finest level that fits one."""
        level = max(k for k in range(self.n_levels) if k == 0 or self._n_pieces(k) == (1, 1))
        rows, cols = self._n_pieces(level)
        return [self._info(Piece(level, r, c)) for r in range(rows) for c in range(cols)]

    def children(self, piece: Piece) -> list[NodeInfo]:
        """Return the four pieces of the next level, as far as the raster extends. Thread-safe."""
        level = piece.level + 1
        if level == self.n_levels:
            return []
        n_rows, n_cols = self._n_pieces(level)
        return [
            self._info(Piece(level, row, col))
            for row in (2 * piece.row, 2 * piece.row + 1)
            for col in (2 * piece.col, 2 * piece.col + 1)
            if row < n_rows and col < n_cols
        ]

    def region(self, piece: Piece) -> Region:
        level = Region(0, 0, *self.terrain.grid.level_shape(piece.level))
        row, col = (k * self.cells - self.apron for k in (piece.row, piece.col))
        return Region(row, col, self._reach, self._reach).intersect(level)

    def _continue(
        self, piece: Piece, region: Region, heights: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], tuple[int, int]]:
        """Continue the heights of a patch beyond the outline, if it has a part of that.

        A mesh may end short of its last samples, and a coarse level ends short of the raster. The
        continuation makes it cover the whole raster; shaders clip the rest. The second result are
        rows and columns before those of the patch.
        """
        grid, outside, beyond = self.terrain.grid, [], []
        shape, stride = grid.level_shape(piece.level), grid.stride(piece.level)
        for place, first, n, n_level, n_full in zip(
            (piece.row, piece.col), region[:2], region.shape, shape, self.terrain.shape, strict=True
        ):
            n_before = first - (place * self.cells - self.apron)
            n_outside = n_after = 0
            if first + n == n_level and n_before + n < self._reach:
                n_outside = int((n_level - 1) * stride < n_full - 1)
                n_after = self.tree // 2
                n_after += -(n_before + n + n_outside + n_after) % self.tree
            outside.append((0, n_outside))
            beyond.append((n_before, n_after))
        wide = np.pad(heights, outside, mode="edge")
        linear = with_outside(heights, *wide.shape)
        # If one of the last two is void, repeat the last.
        wide = np.where(np.isnan(linear), wide, linear)
        return np.pad(wide, beyond, mode="edge"), (beyond[0][0], beyond[1][0])

    def _blocks(self, level: int, region: Region) -> list[Block]:
        grid = self.terrain.grid
        rows, cols = (
            range(
                min(first // grid.block, n_blocks - 1),
                min((first + max(n - 2, 0)) // grid.block, n_blocks - 1) + 1,
            )
            for first, n, n_blocks in zip(
                region[:2], region[2:], grid.level_blocks(level), strict=True
            )
        )
        return [Block(level, row, col) for row in rows for col in cols]

    def _info(self, piece: Piece) -> NodeInfo:
        terrain = self.terrain
        region = self.region(piece)
        stride = terrain.grid.stride(piece.level)
        blocks = self._blocks(piece.level, region)
        error = self._level_error(piece.level, blocks)
        boxes = [height for block in blocks for height in terrain.block_box(block)]
        z = [self.frame.to_metres(height) for height in boxes]
        (left, bottom), (right, top) = self.frame.sides_of(region, stride)
        low, high = (left, bottom, min(z) - error), (right, top, max(z) + error)
        return NodeInfo(piece, low, high, error, self.frame.spacing * stride)

    def _level_error(self, level: int, blocks: list[Block]) -> float:
        """Return the largest distance of originals from decoded samples of blocks, metres."""
        terrain = self.terrain
        error = terrain.quanta_error
        if level < self.n_levels - 1:
            error = max(terrain.block_error(block) for block in blocks)
        largest = max(map(abs, self.frame.height_range))
        return error * self.frame.error_metres + largest * FLOAT32_ROUNDING

    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> FrontPatch:
        region = self.region(piece)
        info = self._info(piece)
        children = self.children(piece)
        heights, slopes = self.read(piece.level, region)
        go_on(is_cancelled)
        matrix = self.frame.matrix_of(region, self.terrain.grid.stride(piece.level))
        error, mesh = info.error, None
        is_void = np.isnan(heights).all()
        heights, lead = self._continue(piece, region, heights)
        if min(self.terrain.shape) > 1 and not is_void:
            if piece.level < self.n_levels - 1:  # originals also lie between samples
                error += twist_of(heights)
            mesh = self.make_mesh(
                piece, heights, sample_matrix=_moved(matrix, lead), error=self.error,
                base_error=error, open_sides=_ALL_OPEN, scratch=self.scratch,
            )  # fmt: skip
        return FrontPatch(
            piece, region, matrix, slopes, mesh, lead, error, children, self.side,
            self.sample_bytes * self._mesh_side ** 2, self.between(piece.level, heights),
        )  # fmt: skip

    def between(self, level: int, heights: NDArray[np.float64]) -> float:  # noqa: ARG002
        """Return how much further originals may be from triangles between samples than at them.

        Only for skirts: where levels have all originals, these are at samples.
        """
        return 0.0

    @abstractmethod
    def make_mesh(self, piece: Piece, heights: NDArray[np.float64], **given: Any) -> Any:
        """Return the mesh of a patch, `given` most of its arguments. Thread-safe."""

    def read(self, level: int, region: Region) -> tuple[NDArray[np.float64], NDArray[np.float16]]:
        """Return heights of a level, metres, NaN in voids, and `Texels` of it. Thread-safe."""
        terrain = self.terrain
        whole = Region(0, 0, *terrain.grid.level_shape(level))
        wide = Region(region.row - 1, region.col - 1, region.n_rows + 2, region.n_cols + 2)
        wide = wide.intersect(whole)
        terrain.decoder.prefetch(units_of(terrain.grid, level, wide))
        quanta, mask = terrain.decoder.window(level, wide)
        here = region.slices_in(wide)
        heights = np.where(mask[here], self._scale.metres(quanta[here]), np.nan)
        first = region.row - wide.row, region.col - wide.col
        slopes = self._texels.of(
            (quanta, mask), first, region.shape, region.shape, terrain.grid.stride(level)
        )
        return heights, slopes

    def keep(self, piece: Piece, built: Any) -> None:
        self._patches[piece] = built

    def drop(self, piece: Piece) -> None:
        del self._patches[piece]

    def wanted(
        self, table: NodeTable, view: View, tau: float, max_blocks: int, camera: Camera
    ) -> NDArray[np.int32]:
        """Return the wanted pieces for a camera; τ is raised until they fit.

        It is lowered again as the camera moves and there is room.
        """

        def pieces(factor: float) -> NDArray[np.int32]:
            return table.wanted(view, max_blocks, tau * factor, camera)

        def are_too_many(nodes: NDArray[np.int32]) -> bool:
            # Before the first patch is loaded, the number that fits is unknown.
            return len(nodes) == max_blocks > len(table.roots)

        nodes = pieces(self._shortage)
        if camera is not view.camera:
            return nodes
        if camera != self._last_camera:
            self._last_camera = camera
            while self._shortage > 1:
                less = max(self._shortage / _STEP, 1.0)
                more = pieces(less)
                if len(more) > _WELL_FILLED * max_blocks:
                    break
                self._shortage, nodes = less, more
        while are_too_many(nodes) and self._shortage < _MOST_SHORT:
            self._shortage *= _STEP
            nodes = pieces(self._shortage)
        self._is_short |= are_too_many(nodes)
        return nodes

    def split_error(self, tau: float) -> float:
        return tau * _LEVEL_SHARE

    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        """Make the meshes of a selection that was split at `tau`, from `split_error`."""
        order = np.argsort(selection.distances, kind="stable").tolist()
        order = [k for k in order if self._patch(table, selection.nodes[k]).mesh is not None]
        nodes, distances = selection.nodes[order], selection.distances[order]
        self.shown = [self._patch(table, node) for node in nodes.tolist()]
        tau *= self._shortage
        eye, wanted = eye_of(view), tau / _LEVEL_SHARE
        on_screen = table.on_screen(view, nodes)
        is_finest = np.array([patch.piece.level == self.n_levels - 1 for patch in self.shown])
        relaxed = np.where(is_finest, 1.0, np.maximum(on_screen / tau, 1.0))
        within = self._follow_all(eye, wanted, np.minimum(relaxed, _MOST_RELAXED))
        # Levels above τ remain if there is no room for finer ones, or no need (`View.flatness`).
        most = NO_PROMISE if self._is_short and not n_missing else view.flatness
        within = min(within * min(float(relaxed.max(initial=1.0)), most), NO_PROMISE)
        self._is_short = False
        depths, n_triangles = self.draw(eye, *table.boxes(nodes, view.exaggeration))
        none = np.zeros(len(nodes))
        return Frames(nodes, distances, none, depths, n_triangles, within, n_missing)

    def _patch(self, table: NodeTable, node: int) -> FrontPatch:
        return self._patches[table.pieces[node]]

    def _follow_all(self, eye: Eye, tau: float, relaxed: NDArray[np.float64]) -> float:
        """Update all meshes, within the budget; return the error they keep, in pixels."""
        # A mesh has less than three triangles per vertex: two and, with skirts, two per edge on
        # borders.
        least = sum(patch.mesh.least_vertices for patch in self.shown)
        budget = max(min(self.max_triangles // 3, MAX_VERTICES), least)
        self._pressure.relieve()
        while True:
            used = tau * self._pressure.factor
            self.followed = [
                self.follow(patch, eye, used * factor, max(budget, patch.mesh.least_vertices))
                for patch, factor in zip(self.shown, relaxed.tolist(), strict=True)
            ]
            n_vertices = sum(followed.n_vertices for followed in self.followed)
            if n_vertices <= budget or not self._pressure.rise():
                break
        kept = [
            followed.within / factor
            for followed, factor in zip(self.followed, relaxed.tolist(), strict=True)
        ]
        return max(kept, default=tau)

    def follow(self, patch: FrontPatch, eye: Eye, tau: float, max_vertices: int) -> Followed:
        followed: Followed = patch.mesh.follow(eye, tau, morph=MORPH, max_vertices=max_vertices)
        return followed

    def draw(
        self, eye: Eye, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], int]:
        """Make the frame's mesh; return the depths of skirts, and the number of triangles.

        `low` and `high` are corners of the boxes of `shown`.
        """
        frames = self.frames_of(eye)
        depths = self.depths(eye, [frame.error for frame in frames], low, high)
        self._join(frames, depths)
        return depths, 0 if self.drawn is None else len(self.drawn.triangles)

    @abstractmethod
    def frames_of(self, eye: Eye) -> list[PatchFrame]:
        """Return the meshes of `shown`, which have followed the eye."""

    def depths(
        self, eye: Eye, errors: list[float], low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the depth of each patch's skirts, local metres.

        It is its own error, which is `PatchFrame.error` plus that of its level and the error
        between samples, plus the largest of its neighbours.
        """
        own = np.array([patch.error + patch.between for patch in self.shown]) + errors
        own *= eye.z_scale
        if not own.any():
            return own
        slack = 1e-6 * (high - low).max()
        apart = np.maximum(
            low[:, None, :2] - high[None, :, :2], low[None, :, :2] - high[:, None, :2]
        )
        touches = (apart <= slack).all(axis=2) & ~np.eye(len(own), dtype=np.bool_)
        beside: NDArray[np.float64] = np.where(touches, own[None, :], 0.0).max(axis=1)
        return own + beside

    def _join(self, frames: list[PatchFrame], depths: NDArray[np.float64]) -> None:
        parts, starts = [], [0]
        for frame, depth in zip(frames, depths.tolist(), strict=True):
            part = _with_skirts(frame, depth)
            parts.append(part._replace(triangles=part.triangles + np.int32(starts[-1])))
            starts.append(starts[-1] + len(part.vertices))
        self.first_vertices = starts
        self.drawn = Drawn(*map(np.concatenate, zip(*parts, strict=True))) if parts else None


def _moved(matrix: tuple[float, ...], lead: tuple[int, int]) -> tuple[float, ...]:
    """Return the matrix of samples counted from one `lead` rows and columns before the first."""
    (a, b, c, d, e, f), (rows, cols) = matrix, lead
    return a, b, c - a * cols - b * rows, d, e, f - d * cols - e * rows


def _with_skirts(frame: PatchFrame, depth: float) -> Drawn:
    """Return a patch with two more triangles below each of its edges."""
    drawn, edges, _ = frame
    if not len(edges):
        return drawn
    n = len(drawn.vertices)
    top, numbers = np.unique(edges, return_inverse=True)
    a, b = edges.T
    lower_a, lower_b = (n + numbers.reshape(edges.shape)).T
    skirts = walls_below(a, b, lower_a, lower_b)
    return Drawn(
        np.concatenate([drawn.vertices, drawn.vertices[top]]),
        np.concatenate([drawn.triangles, skirts.astype(np.int32)]),
        np.concatenate([drawn.sizes, drawn.sizes[top]]),
        np.concatenate([drawn.depths, np.full(len(top), depth)]),
    )
