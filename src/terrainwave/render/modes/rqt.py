"""Zheng, Wang and Wang's view-dependent restricted quadtree (`terrainwave.tri.rqt_view`).

Their tiles are patches here: they are read and decoded by workers as they come into view with a
parent that is not good enough, which stands in for them until they are here.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Region
from terrainwave.progress import ProgressCallback
from terrainwave.read.tiles import TileDecoder, with_coefficients
from terrainwave.render.frame import Frame
from terrainwave.render.modes.front import Drawn, FrontMode, FrontPatch, PatchFrame, Sides
from terrainwave.render.modes.mode import ERRORS
from terrainwave.render.selection import Piece
from terrainwave.tri.dynamic import Eye, Followed
from terrainwave.tri.rqt_errors import twist_of
from terrainwave.tri.rqt_view import RestrictedFrame, RestrictedMesh
from terrainwave.tri.scratch import Scratch

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile


class Tile(RestrictedMesh):
    """A mesh over all samples of a patch, which knows those on its borders.

    Parameters
    ----------
    heights : ndarray of float64, shape (n_rows, n_cols)
        Metres; NaN is void.
    """

    def __init__(
        self,
        heights: NDArray[np.float64],
        matrix: tuple[float, ...],
        error: str,
        base_error: float,
        coefficients: NDArray[np.float64] | None,
        scratch: Scratch,
    ) -> None:
        cells = max(heights.shape) - 1
        super().__init__(
            heights,
            tile=max(1 << (cells - 1).bit_length(), 2),
            sample_matrix=matrix,
            error=error,
            base_error=base_error,
            coefficients=coefficients,
            scratch=scratch,
        )
        # In the order of `FrontPatch.open_sides`.
        self._lines = [
            line.copy() for line in (heights[0], heights[:, 0], heights[-1], heights[:, -1])
        ]

    def border(
        self, frame: RestrictedFrame, side: int, eye: Eye
    ) -> tuple[NDArray[np.int32], float]:
        """Return the edges along a side of the patch, and how far those in view are from samples.

        Vertically, without exaggeration.
        """
        line, axis = self._lines[side], side % 2
        place = 0 if side < 2 else self.shape[axis] - 1
        numbers = np.flatnonzero(frame.places[:, axis] == place)
        numbers = numbers[np.argsort(frame.places[numbers, 1 - axis])]
        if len(numbers) < 2:
            return np.empty((0, 2), dtype=np.int32), 0.0
        along, vertices = frame.places[numbers, 1 - axis], frame.vertices[numbers]
        n_void = np.concatenate([[0], np.cumsum(np.isnan(line))])
        is_whole = n_void[along[1:]] == n_void[along[:-1]]
        edges = np.column_stack([numbers[:-1], numbers[1:]])[is_whole].astype(np.int32)
        at = np.arange(along[0], along[-1] + 1)
        drawn = np.column_stack([np.interp(at, along, vertices[:, k]) for k in range(3)])
        original = drawn.copy()
        original[:, 2] = line[at] * eye.z_scale
        behind = [
            points @ eye.planes[:, :3].T + eye.planes[:, 3] < 0 for points in (drawn, original)
        ]
        both = behind[0] & behind[1]
        is_hidden = (both[1:] & both[:-1]).any(axis=1)  # of the parts between two samples
        apart = np.abs(drawn[:, 2] - original[:, 2])
        apart = np.maximum(apart[1:], apart[:-1])
        is_seen = ~is_hidden & ~np.isnan(apart)
        return edges, float(apart.max(initial=0.0, where=is_seen)) / eye.z_scale


class Rqt(FrontMode):
    """A restricted quadtree of one tile for each patch."""

    name = "rqt"
    errors = (*ERRORS, "coefficient")
    cells = 512
    sample_bytes = 12

    def __init__(
        self,
        terrain: "TerrainFile",
        frame: Frame,
        *,
        error: str = "measured",
        progress: ProgressCallback | None = None,
    ) -> None:
        super().__init__(terrain, frame, error=error)
        self._tile_decoder: TileDecoder | None = None
        if error == "coefficient":
            self._tile_decoder = with_coefficients(terrain.decoder)

    def cut_error(self, level: int, heights: NDArray[np.float64]) -> float:
        """Return how far the two halves of a cell may be from its bilinear surface, metres."""
        return 0.0 if level == self.n_levels - 1 else twist_of(heights)

    def make_mesh(
        self,
        piece: Piece,
        region: Region,
        heights: NDArray[np.float64],
        matrix: tuple[float, ...],
        base_error: float,
        open_sides: Sides,
    ) -> Tile:
        """Return the quadtree of a patch. Thread-safe."""
        return Tile(
            heights,
            matrix,
            self.error,
            base_error,
            self._coefficients(piece.level, region),
            self.scratch,
        )

    def _coefficients(self, level: int, region: Region) -> NDArray[np.float64] | None:
        """Return the magnitudes of the file's coefficients in metres; None without `error`."""
        if self._tile_decoder is None:
            return None
        quanta = self._tile_decoder.coefficients(level, region)
        return np.multiply(quanta, abs(self._scale.per_quantum), dtype=np.float64)

    def frame_of(self, patch: FrontPatch, eye: Eye, followed: Followed) -> PatchFrame:
        """Return the mesh of a patch."""
        tile: Tile = patch.mesh
        frame = tile.draw(eye, followed)
        both = frame.places[:, 0] | frame.places[:, 1] | tile.tile
        sizes = np.log2(both & -both).astype(np.int32) + (self.n_levels - 1 - patch.piece.level)
        borders = [tile.border(frame, side, eye) for side in range(4) if patch.open_sides[side]]
        drawn = Drawn(frame.vertices, frame.triangles, sizes)
        none = np.empty((0, 2), dtype=np.int32)
        return PatchFrame(
            drawn,
            np.concatenate([none, *(edges for edges, _ in borders)]),
            max((error for _, error in borders), default=0.0),
        )
