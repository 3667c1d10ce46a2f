"""Each block from its own guaranteed mesh (Yusov & Turlapov 2010, §2.8): the default."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from terrainwave.mesh.level_errors import recursive_errors
from terrainwave.progress import Reporter
from terrainwave.render.modes.bounded import BoundedMode
from terrainwave.render.modes.mode import ModeNeeds
from terrainwave.render.scene.patches import Patch, PatchBuilder
from terrainwave.render.scene.selection import NodeInfo, Piece


class Adaptive(BoundedMode):
    """Blocks by their error on screen, each from its own mesh.

    `builder` does all the work: another kind of mesh per block only needs another builder.
    """

    name = "adaptive"
    options: tuple[str, ...] = ("orientation",)
    is_loose = False

    def __init__(self, needs: ModeNeeds, *, orientation: bool = False) -> None:
        super().__init__(needs, orientation=orientation)
        self.builder = PatchBuilder(
            self.terrain, self.frame, recursive=self._recursive_errors(), is_loose=self.is_loose
        )

    @classmethod
    def preparation(cls, error: str) -> str | None:
        if error != "paper":
            return None
        return "following the error recursion of Yusov & Turlapov: this decodes the whole file once"

    def _recursive_errors(self) -> list[NDArray[np.float64]] | None:
        if self.error != "paper":
            return None
        n_rows, n_cols = self.terrain.shape
        count = Reporter(self.progress).counter("errors", n_rows * n_cols, 4)
        return recursive_errors(self.terrain, count=count)

    def roots(self) -> list[NodeInfo]:
        return self.builder.roots()

    def children(self, piece: Piece) -> list[NodeInfo]:
        """Return the children of a piece: its next variant, or the blocks one level finer."""
        return self.builder.children(piece)

    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> Patch:
        return self.builder.build(piece, is_cancelled)
