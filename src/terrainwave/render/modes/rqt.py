"""Zheng, Wang and Wang's view-dependent restricted quadtree (`terrainwave.tri.rqt_view`).

From high up the overview alone is drawn: a coarse level of the file. Tiles are read and decoded by
workers as they come into view with an overview that is not good enough; until then the overview
stands in for them. Those out of view go where they are too many.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Region
from terrainwave.progress import ProgressCallback
from terrainwave.read.tiles import TileDecoder, with_coefficients
from terrainwave.render.camera import Camera
from terrainwave.render.frame import Frame
from terrainwave.render.modes.mode import ERRORS
from terrainwave.render.modes.whole import (
    MORPH,
    BuiltSamples,
    Drawn,
    WholeMode,
    eye_of,
)
from terrainwave.render.patches import Cancelled
from terrainwave.render.selection import NodeInfo, NodeTable, Piece, View
from terrainwave.tri.rqt_tiles import tile_bytes
from terrainwave.tri.rqt_view import RestrictedFrame, RestrictedMesh

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

TILE = 256
# The overview has every 16th sample at least: the file's own levels go on above it.
_OVERVIEW_LEVELS = 4
OVERVIEW = Piece(0, 0, 0)
# Heights and errors of tiles; those that are needed least go first where there are more.
MAX_TILE_BYTES = 128 << 20


def spread_slopes(
    slopes: NDArray[np.float16], stride: int, shape: tuple[int, int]
) -> NDArray[np.float16]:
    """Return slopes at all samples, linear between those at every `stride`-th."""
    spread = np.empty((*shape, slopes.shape[2]), dtype=np.float16)
    below, right = (np.arange(n) // stride for n in shape)
    down, across = (
        (np.arange(n) % stride / np.float32(stride)).astype(np.float32)[:, None] for n in shape
    )
    last_row, last_col = slopes.shape[0] - 1, slopes.shape[1] - 1
    for start in range(0, shape[0], TILE):
        rows = slice(start, start + TILE)
        first, share = below[rows], down[rows, None]
        part = slopes[first].astype(np.float32) * (1 - share)
        part += slopes[np.minimum(first + 1, last_row)] * share
        spread[rows] = part[:, right] * (1 - across) + part[
            :, np.minimum(right + 1, last_col)
        ] * across  # fmt: skip
    return spread


class Rqt(WholeMode):
    """A restricted quadtree over an overview and those tiles that the view needs."""

    name = "rqt"
    errors = (*ERRORS, "coefficient")
    frame_mesh: RestrictedFrame | None = None

    def __init__(
        self,
        terrain: "TerrainFile",
        frame: Frame,
        *,
        error: str = "measured",
        progress: ProgressCallback | None = None,
    ) -> None:
        super().__init__(terrain, frame, error=error)
        if error == "coefficient":
            self._tile_decoder: TileDecoder | None = with_coefficients(terrain.decoder)
        else:
            self._tile_decoder = None
        self._overview_level = max(self.level - _OVERVIEW_LEVELS, 0)
        self._overview_stride = 1 << (self.level - self._overview_level)
        largest = self._largest_error(self._overview_level)
        self._overview_error = max(largest * frame.metres[2], self.base_error)
        self._n_tiles = tuple(max(-(-(n - 1) // TILE), 1) for n in self.shape)
        self._mesh: RestrictedMesh | None = None

    # Pieces: the overview, and tiles beside it

    def roots(self) -> list[NodeInfo]:
        """Return the overview and all tiles."""
        whole = super().roots()[0]
        nodes = [whole._replace(error=self._overview_error)]
        if self._overview_stride == 1:
            return nodes
        for row in range(self._n_tiles[0]):
            for col in range(self._n_tiles[1]):
                region = self._region(row, col)
                rows = np.array([region.row, region.row + region.n_rows - 1]) * self.stride
                cols = np.array([region.col, region.col + region.n_cols - 1]) * self.stride
                xy = self.frame.samples_to_local(np.repeat(rows, 2), np.tile(cols, 2))
                (left, bottom), (right, top) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
                low, high = (left, bottom, whole.low[2]), (right, top, whole.high[2])
                nodes.append(NodeInfo(Piece(1, row, col), low, high, self._overview_error))
        return nodes

    def _region(self, row: int, col: int) -> Region:
        return Region(row * TILE, col * TILE, TILE + 1, TILE + 1).intersect(
            Region(0, 0, *self.shape)
        )

    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> BuiltSamples:
        """Return the samples of the overview or of a tile, and what the mesh takes of them."""
        if piece.level:
            region = self._region(piece.row, piece.col)
            samples = self.read(self.level, region)
            if is_cancelled():
                raise Cancelled
            tile = self._overview_mesh.measure(
                piece.row, piece.col, samples.heights, self.base_error,
                self._coefficients(self.level, region),
            )  # fmt: skip
            return BuiltSamples(samples, self.base_error, tile=tile)
        shape = self.terrain.grid.level_shape(self._overview_level)
        samples = self.read(self._overview_level, Region(0, 0, *shape))
        low, high = (height * self.frame.metres[2] for height in self.frame.heights)
        mesh = RestrictedMesh(
            self.shape,
            (min(low, high) - self._overview_error, max(low, high) + self._overview_error),
            samples.heights,
            stride=self._overview_stride,
            tile=TILE,
            sample_matrix=self.sample_matrix,
            error=self.error,
            base_error=self._overview_error,
            coefficients=self._coefficients(self._overview_level, samples.region),
        )
        wide = samples._replace(
            region=Region(0, 0, *self.shape),
            slopes=spread_slopes(samples.slopes, self._overview_stride, self.shape),
        )
        return BuiltSamples(wide, self._overview_error, mesh)

    def _coefficients(self, level: int, region: Region) -> NDArray[np.float64] | None:
        """Return the magnitudes of the file's coefficients in metres; None without `error`."""
        if self._tile_decoder is None:
            return None
        quanta = self._tile_decoder.coefficients(level, region)
        return np.multiply(quanta, abs(self._scale.per_quantum), dtype=np.float64)

    @property
    def _overview_mesh(self) -> RestrictedMesh:
        if self._mesh is None:
            raise AssertionError("tiles are wanted once the overview is here")
        return self._mesh

    # As pieces come and go

    def keep(self, piece: Piece, built: Any) -> None:
        """Take the mesh of the overview, or a tile into it."""
        if piece.level:
            self._overview_mesh.load(piece.row, piece.col, built.tile)
        else:
            self._mesh = built.mesh

    def drop(self, piece: Piece) -> None:
        """Forget a tile."""
        if piece.level:
            self._overview_mesh.unload(piece.row, piece.col)

    # Each frame

    def wanted(
        self, table: NodeTable, view: View, tau: float, max_blocks: int, camera: Camera
    ) -> NDArray[np.int32]:
        """Return the overview, and tiles in which it is not within τ; the worst ones first."""
        overview = table.find(OVERVIEW)
        first = [] if overview is None else [overview]
        if self._mesh is not None:
            eye = eye_of(replace(view, camera=camera))
            pieces = [Piece(1, *tile) for tile in self._mesh.wanted_tiles(eye, tau).tolist()]
            first += [node for node in map(table.find, pieces) if node is not None]
        return np.array(first, dtype=np.int32)

    def mesh(self, table: NodeTable, view: View, tau: float) -> tuple[Drawn, float]:
        """Return the mesh of a view, and its τ."""
        mesh = self._overview_mesh
        frame = mesh.update(
            eye_of(view), tau, morph=MORPH, max_vertices=self.max_vertices(mesh.least_vertices)
        )
        self.frame_mesh = frame
        both = frame.places[:, 0] | frame.places[:, 1] | TILE
        sizes = np.log2(both & -both).astype(np.int32)
        return Drawn(frame.vertices, frame.triangles, sizes), frame.tau

    @staticmethod
    def surface(context: Any, side: int, *, max_bytes: int) -> Any:
        """Return a buffer for the mesh of a frame, and the program that draws it."""
        from terrainwave.render.whole_surface import WholeSurface

        return WholeSurface(
            context, max_bytes=max_bytes, max_blocks=1 + MAX_TILE_BYTES // tile_bytes(TILE)
        )
