"""Meshes of a whole view, made anew each frame: what `dynamic`, `rqt` and `vertex-texture` share.

One level of the file lies in memory: the finest whose sides are not above `MAX_SIDE` samples. Its
measured error is added to errors.
"""

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Region
from terrainwave.progress import ProgressCallback
from terrainwave.read.decoder import units_of
from terrainwave.render.camera import focal_length, slant
from terrainwave.render.frame import Frame
from terrainwave.render.kernels import slopes
from terrainwave.render.modes.mode import Frames, Mode
from terrainwave.render.scales import FLOAT32_ROUNDING, HeightScale, SlopeScale
from terrainwave.render.selection import NodeInfo, NodeTable, Piece, Selection, View
from terrainwave.tri.dynamic import DynamicMesh, Eye
from terrainwave.tri.rqt_tiles import Tile
from terrainwave.tri.rqt_view import RestrictedMesh

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

# A texture of slopes of this side takes 81 MiB.
MAX_SIDE = 4608
MAX_VERTICES = 4_000_000
# λ: vertices move while errors go from τ / λ to τ.
MORPH = 1.25


class Drawn(NamedTuple):
    """A mesh for one frame.

    Parameters
    ----------
    vertices : ndarray of float64, shape (n, 3)
        Local metres, heights with exaggeration.
    triangles : ndarray of int32, shape (m, 3)
    sizes : ndarray of int32, shape (n,)
        What `--coloring level` shows: log2 of the vertex's share of the grid.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    sizes: NDArray[np.int32]


class Samples(NamedTuple):
    """A rectangle of a level.

    Parameters
    ----------
    heights : ndarray of float64, shape (n_rows, n_cols)
        Metres; NaN in voids.
    slopes : ndarray of float16, shape (n_rows, n_cols, 2)
        Metres per metre to the east and to the north.
    """

    region: Region
    heights: NDArray[np.float64]
    slopes: NDArray[np.float16]


class BuiltSamples(NamedTuple):
    """What `build` returns: samples and a bound for them, metres.

    Parameters
    ----------
    mesh : DynamicMesh or RestrictedMesh, optional
        Over the samples, or the overview of all.
    tile : Tile, optional
        Of a mesh over an overview.
    """

    samples: Samples
    error: float
    mesh: DynamicMesh | RestrictedMesh | None = None
    tile: Tile | None = None
    n_triangles: int = 0
    base: float = 0.0
    morph: float = 0.0

    @property
    def children(self) -> list[NodeInfo]:
        """Return nothing: these pieces are not replaced."""
        return []


def eye_of(view: View) -> Eye:
    """Return the numbers that errors on screen depend on."""
    return Eye(
        view.camera.eye,
        view.camera.forward,
        view.planes,
        focal_length(view.camera, view.viewport),
        slant(view.camera, view.viewport),
        view.exaggeration,
    )


class WholeMode(Mode):
    """A mode that draws one mesh.

    Attributes
    ----------
    level : int
        Of the file, that lies in memory.
    shape : tuple of int
        Its rows and columns.
    drawn : Drawn, optional
        The mesh of the last frame.
    """

    def __init__(
        self,
        terrain: "TerrainFile",
        frame: Frame,
        *,
        error: str = "measured",
        progress: ProgressCallback | None = None,
    ) -> None:
        super().__init__(terrain, frame, error=error)
        grid, self.level = terrain.grid, terrain.n_levels - 1
        while max(grid.level_shape(self.level)) > MAX_SIDE and self.level > 0:
            self.level -= 1
        self.shape = grid.level_shape(self.level)
        self.stride = grid.stride(self.level)
        self.drawn: Drawn | None = None
        self._scale, self._slope_scale = HeightScale.of(terrain, frame), SlopeScale(frame)

    @cached_property
    def base_error(self) -> float:
        """Return the largest distance of originals from the level's samples, metres."""
        terrain = self.terrain
        error = terrain.quanta_error
        if self.level < terrain.n_levels - 1:
            error = self._largest_error(self.level)
        largest = max(abs(height) for height in self.frame.heights)
        return (error + largest * FLOAT32_ROUNDING) * self.frame.metres[2]

    def _largest_error(self, level: int) -> float:
        """Return the largest error of a level's blocks, in the file's unit."""
        blocks = self.terrain.grid.blocks(level)
        return max(self.terrain.block_error(block) for block in blocks)

    @property
    def sample_matrix(self) -> tuple[float, ...]:
        """Return how samples of the level lie in local metres."""
        a, b, c, d, e, f = self.frame.sample_matrix
        stride = self.stride
        return a * stride, b * stride, c, d * stride, e * stride, f

    def grid_places(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return columns and rows of the level under local x, y; shape (n, 2)."""
        a, b, c, d, e, f = self.sample_matrix
        inverse = np.linalg.inv(np.array([[a, b], [d, e]]))
        return (vertices[:, :2] - (c, f)) @ inverse.T

    # The tree: one piece

    def roots(self) -> list[NodeInfo]:
        """Return the one piece."""
        low, high = self.frame.exaggerated(1.0).box
        bottom, top = low.tolist(), high.tolist()
        error = self.base_error
        return [
            NodeInfo(
                Piece(0, 0, 0),
                (bottom[0], bottom[1], bottom[2] - error),
                (top[0], top[1], top[2] + error),
                error,
            )
        ]

    def children(self, piece: Piece) -> list[NodeInfo]:
        """Return nothing: the mesh of a frame is not a matter of pieces."""
        return []

    def read(self, level: int, region: Region) -> Samples:
        """Return samples of a level. Thread-safe."""
        terrain = self.terrain
        whole = Region(0, 0, *terrain.grid.level_shape(level))
        wide = Region(region.row - 1, region.col - 1, region.n_rows + 2, region.n_cols + 2)
        wide = wide.intersect(whole)
        terrain.decoder.prefetch(units_of(terrain.grid, level, wide))
        quanta, mask = terrain.decoder.window(level, wide)
        in_quanta = np.empty((region.n_rows, region.n_cols, 2), dtype=np.float32)
        slopes(quanta, mask, region.row - wide.row, region.col - wide.col, in_quanta)
        per_sample = in_quanta * (self._scale.per_quantum / terrain.grid.stride(level))
        here = region.slices_in(wide)
        heights = np.where(mask[here], self._scale.metres(quanta[here]), np.nan)
        return Samples(region, heights, self._slope_scale.texels(per_sample))

    # Each frame

    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        """Make the mesh of a view, and return it as one piece's."""
        nodes = selection.nodes[:1]
        self.drawn, used = None, tau
        if len(nodes) and min(self.shape) > 1:
            self.drawn, used = self.mesh(table, view, tau)
        n_triangles = 0 if self.drawn is None else len(self.drawn.triangles)
        none = np.zeros(len(nodes))
        return Frames(nodes, selection.distances[:1], none, none, n_triangles, used, n_missing)

    def max_vertices(self, least: int) -> int:
        """Return the budget of a frame's mesh, which has less than two triangles per vertex."""
        return max(min(self.max_triangles // 2, MAX_VERTICES), least)

    def mesh(self, table: NodeTable, view: View, tau: float) -> tuple[Drawn, float]:
        """Return the mesh of a view, and its τ."""
        raise NotImplementedError

    @staticmethod
    def surface(context: Any, side: int, *, max_bytes: int) -> Any:
        """Return a buffer for the mesh of a frame, and the program that draws it."""
        from terrainwave.render.whole_surface import WholeSurface

        return WholeSurface(context, max_bytes=max_bytes)
