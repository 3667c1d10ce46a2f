"""View-dependent restricted quadtree of Zheng, Wang and Wang (`terrainwave.tri.rqt.view`).

Their tiles are patches here: workers read and decode them when they come into view with a parent
that is not good enough; the parent is drawn until they are loaded.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.read.tile_decoder import TiledDecoder, with_coefficients
from terrainwave.render.modes.front import Drawn, FrontMode, FrontPatch, PatchFrame
from terrainwave.render.modes.mode import ERRORS, ModeNeeds
from terrainwave.render.scene.selection import Piece
from terrainwave.tri.followed import Eye, Followed
from terrainwave.tri.rqt.view import RestrictedMesh


class RqtMode(FrontMode):
    """A restricted quadtree of one tile for each patch."""

    name = "rqt"
    errors = (*ERRORS, "coefficient")
    cells = 256
    sample_bytes = 12

    def __init__(self, needs: ModeNeeds) -> None:
        super().__init__(needs)
        self._tiles: TiledDecoder | None = None
        if self.error == "coefficient":
            self._tiles = with_coefficients(self.terrain.decoder)

    def make_mesh(self, piece: Piece, heights: NDArray[np.float64], **given: Any) -> RestrictedMesh:
        tile = max(1 << (max(heights.shape) - 2).bit_length(), 2)
        magnitudes = None
        if self._tiles is not None:  # metres, 0 beyond the outline
            region, magnitudes = self.region(piece), np.zeros(heights.shape)
            quanta = self._tiles.coefficients(piece.level, region)
            magnitudes[: region.n_rows, : region.n_cols] = quanta
            magnitudes *= abs(self._scale.per_quantum)
        return RestrictedMesh(heights, tile=tile, coefficients=magnitudes, **given)

    def frames_of(self, eye: Eye) -> list[PatchFrame]:
        return [
            self._frame_of(patch, eye, followed)
            for patch, followed in zip(self.shown, self.followed, strict=True)
        ]

    def _frame_of(self, patch: FrontPatch, eye: Eye, followed: Followed) -> PatchFrame:
        mesh: RestrictedMesh = patch.mesh
        frame = mesh.draw(eye, followed)
        both = frame.places[:, 0] | frame.places[:, 1] | mesh.tile
        sizes = np.log2(both & -both).astype(np.int32) + (self.n_levels - 1 - patch.piece.level)
        drawn = Drawn.surface(frame.vertices, frame.triangles, sizes)
        return PatchFrame(drawn, frame.edges, frame.border_error)
