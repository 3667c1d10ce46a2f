"""The dynamic triangulation of Yusov & Turlapov 2006 (`terrainwave.tri.dynamic`), frame by frame.

The heights are read, and their tree is built, once, in a worker.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Region
from terrainwave.progress import ProgressCallback
from terrainwave.render.frame import Frame
from terrainwave.render.modes.whole import MAX_SIDE, MORPH, BuiltSamples, Drawn, WholeMode, eye_of
from terrainwave.render.patches import Cancelled
from terrainwave.render.selection import NodeTable, Piece, View
from terrainwave.tri.dynamic import DynamicMesh, Followed

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

PATCH = 256


class Dynamic(WholeMode):
    """A mesh from the marks of a Haar quadtree that follows the camera.

    Parameters
    ----------
    stepwise : bool
        Change marks by one height a frame, as the paper does.
    """

    name = "dynamic"
    options = ("stepwise",)
    morph = MORPH
    followed: Followed | None = None
    _mesh: DynamicMesh | None = None

    def __init__(
        self,
        terrain: "TerrainFile",
        frame: Frame,
        *,
        error: str = "measured",
        progress: ProgressCallback | None = None,
        stepwise: bool = False,
    ) -> None:
        super().__init__(terrain, frame, error=error)
        self._is_stepwise = stepwise

    @classmethod
    def preparation(cls, error: str) -> str | None:
        """Say that all heights of a level are read."""
        measured = " and measuring the errors of all nodes" if error == "measured" else ""
        return (
            f"reading the finest level of at most {MAX_SIDE} samples a side{measured}: this decodes"
            " it once"
        )

    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> BuiltSamples:
        """Return the samples and their tree."""
        samples = self.read(self.level, Region(0, 0, *self.shape))
        if is_cancelled():
            raise Cancelled
        self._mesh = DynamicMesh(
            samples.heights,
            sample_matrix=self.sample_matrix,
            patch=PATCH,
            error=self.error,
            base_error=self.base_error,
        )
        return BuiltSamples(samples, self.base_error, self._mesh)

    @property
    def dynamic_mesh(self) -> DynamicMesh:
        """Return the mesh, which has been built where the piece is resident."""
        if self._mesh is None:
            raise AssertionError("the piece is resident, so it has been built")
        return self._mesh

    def follow(self, view: View, tau: float) -> Followed:
        """Bring the marks up to date with a view."""
        mesh = self.dynamic_mesh
        self.followed = mesh.follow(
            eye_of(view), tau, morph=self.morph,
            max_vertices=self.max_vertices(mesh.least_vertices), is_stepwise=self._is_stepwise,
        )  # fmt: skip
        return self.followed

    def mesh(self, table: NodeTable, view: View, tau: float) -> tuple[Drawn, float]:
        """Return the mesh of a view, and what it keeps: its τ, or more while steps lag behind."""
        followed = self.follow(view, tau)
        frame = self.dynamic_mesh.draw(eye_of(view), followed)
        sizes: NDArray[np.int32] = frame.nodes[:, 0]
        return Drawn(frame.vertices, frame.triangles, sizes), followed.within
