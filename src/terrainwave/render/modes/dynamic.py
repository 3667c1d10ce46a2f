"""The dynamic triangulation of Yusov & Turlapov 2006 (`tri.dynamic.dynamic`), frame by frame.

Each patch has a Haar quadtree of its own, over some samples of its neighbours as well, or some
beyond the outline: a mesh ends short of its last samples, over a neighbour's, with skirts.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.render.modes.front import ALL_OPEN, MORPH, Drawn, FrontMode, FrontPatch, PatchFrame
from terrainwave.render.modes.mode import ModeNeeds
from terrainwave.render.scene.selection import Piece
from terrainwave.tri.dynamic.dynamic import DynamicMesh
from terrainwave.tri.followed import Eye, Followed


class Dynamic(FrontMode):
    """A mesh from the marks of a Haar quadtree that follows the camera.

    Parameters
    ----------
    stepwise : bool
        Change marks by one height a frame, as the paper does.
    """

    name = "dynamic"
    options = ("stepwise",)
    morph = MORPH
    # Samples per side of the trees of a patch: no node is larger. One at the end of a patch has its
    # vertex up to half a tree inside. Whole trees fit the samples of a patch, and those beyond its
    # cells reach further than that.
    tree = 16
    apron = tree // 2
    cells = 31 * apron
    sample_bytes = 11

    def __init__(self, needs: ModeNeeds, *, stepwise: bool = False) -> None:
        super().__init__(needs)
        self._is_stepwise = stepwise

    def make_mesh(
        self,
        piece: Piece,
        heights: NDArray[np.float64],
        matrix: tuple[float, ...],
        base_error: float,
    ) -> DynamicMesh:
        """Return the tree of a patch. Thread-safe."""
        return DynamicMesh(
            heights,
            sample_matrix=matrix,
            patch=self.tree,
            error=self.error,
            base_error=base_error,
            open_sides=ALL_OPEN,
            is_surface=piece.level < self.n_levels - 1,
            scratch=self.scratch,
        )

    def between(self, level: int, heights: NDArray[np.float64]) -> float:
        """Return as much as heights change to the next sample, down and across.

        A place is no more than half a sample each way from one in the same window of
        `tri.dynamic.haar`: by no more than that the window's plane and the surface rise to there,
        one up, the other down.
        """
        if level < self.n_levels - 1:
            return 0.0  # trees have measured it
        rises = (np.abs(np.diff(heights, axis=axis)) for axis in (0, 1))
        return sum(float(np.max(rise, initial=0.0, where=~np.isnan(rise))) for rise in rises)

    def follow(self, patch: FrontPatch, eye: Eye, tau: float, max_vertices: int) -> Followed:
        """Bring the marks of a patch up to date with a view."""
        followed: Followed = patch.mesh.follow(
            eye, tau, morph=self.morph, max_vertices=max_vertices, is_stepwise=self._is_stepwise
        )
        return followed

    def frame_of(self, patch: FrontPatch, eye: Eye, followed: Followed) -> PatchFrame:
        """Return the mesh of a patch."""
        frame = patch.mesh.draw(eye, followed)
        sizes = frame.nodes[:, 0] + (self.n_levels - 1 - patch.piece.level)
        error = self.mesh_error(patch, eye, followed)
        return PatchFrame(Drawn(frame.vertices, frame.triangles, sizes), frame.edges, error)

    def mesh_error(self, patch: FrontPatch, eye: Eye, followed: Followed) -> float:
        """Return how far the mesh in view is from the samples of a patch, metres."""
        mesh: DynamicMesh = patch.mesh
        return mesh.largest_error(eye, followed) + mesh.tree.rounding
