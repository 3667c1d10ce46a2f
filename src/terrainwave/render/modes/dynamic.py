"""The dynamic triangulation of Yusov & Turlapov 2006 (`tri.dynamic.dynamic`), frame by frame.

Each patch has a forest of Haar quadtrees: those of its own samples, and two rings of trees around
them, with its neighbours' samples or some beyond the outline. Patches of one level are one mesh:
fans join their own trees, and rings are not drawn there (`draw_together`). If a neighbour has
another level, the inner ring is drawn over it, and ends in skirts: levels of a file are not heights
of one quadtree, and the error of a triangle between two would be the sum of theirs. The outer ring
makes the measured errors of the inner one those of the whole raster.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.render.modes.front import MORPH, Drawn, FrontMode, FrontPatch, PatchFrame
from terrainwave.render.modes.mode import ModeNeeds
from terrainwave.render.scene.selection import Piece
from terrainwave.tri.dynamic.dynamic import DynamicMesh, ForestPart, draw_together
from terrainwave.tri.followed import Eye, Followed


class Dynamic(FrontMode):
    """A mesh from the marks of Haar quadtrees of `tree` x `tree` samples that follow the camera.

    With `stepwise` marks change by one height per frame, as in the paper.
    """

    name = "dynamic"
    options = ("stepwise", "tree")
    morph = MORPH
    tree = 16
    samples = 256  # samples per side of a patch; without its apron in modes whose patches overlap
    sample_bytes = 11

    def __init__(self, needs: ModeNeeds, *, stepwise: bool = False, tree: int | None = None):
        super().__init__(needs)
        self._is_stepwise = stepwise
        if tree is not None:
            self.tree = tree
        self.arrange()

    def arrange(self) -> None:
        self.cells, self.apron, self.beyond = self.samples, 2 * self.tree, 2 * self.tree

    def make_mesh(self, piece: Piece, heights: NDArray[np.float64], **given: Any) -> DynamicMesh:
        is_surface = piece.level < self.n_levels - 1
        return DynamicMesh(heights, patch=self.tree, is_surface=is_surface, **given)

    def between(self, level: int, heights: NDArray[np.float64]) -> float:
        """Return the largest change of heights to the next sample, down and across.

        A point is at most half a sample each way from one in the same window of `tri.dynamic.haar`:
        the window's plane and the surface rise by no more than that to there, one up, the other
        down.
        """
        if level < self.n_levels - 1:
            return 0.0  # included in the trees' errors
        rises = (np.abs(np.diff(heights, axis=axis)) for axis in (0, 1))
        return sum(float(np.max(rise, initial=0.0, where=~np.isnan(rise))) for rise in rises)

    def follow(self, patch: FrontPatch, eye: Eye, tau: float, max_vertices: int) -> Followed:
        followed: Followed = patch.mesh.follow(
            eye, tau, morph=self.morph, max_vertices=max_vertices, is_stepwise=self._is_stepwise
        )
        return followed

    def frames_of(self, eye: Eye) -> list[PatchFrame]:
        """Return the meshes of `shown`, which have followed the eye; levels are joined."""
        frames: dict[int, PatchFrame] = {}
        # The order decides who draws which ring, so it must not depend on the eye.
        order = sorted(range(len(self.shown)), key=lambda k: self.shown[k].piece)
        for here in self._that_meet(order):
            level = self.shown[here[0]].piece.level
            parts = [self._part(self.shown[k], self.followed[k]) for k in here]
            for k, drawn in zip(here, draw_together(parts, eye), strict=True):
                sizes = drawn.nodes[:, 0] + (self.n_levels - 1 - level)
                error = self.mesh_error(self.shown[k], eye, self.followed[k])
                frames[k] = PatchFrame(
                    Drawn.surface(drawn.vertices, drawn.triangles, sizes), drawn.edges, error
                )
        return [frame for _, frame in sorted(frames.items())]

    def _that_meet(self, order: list[int]) -> Iterator[list[int]]:
        """Yield numbers of shown patches whose trees meet; others need no joining.

        In the given order.
        """
        reach = 1 + -(-2 * self.apron // self.cells)
        left = {self.shown[k].piece: k for k in order}
        rank = {k: number for number, k in enumerate(order)}
        while left:
            found, new = [], [left.pop(next(iter(left)))]
            while new:
                found += new
                near = {
                    piece._replace(row=piece.row + down, col=piece.col + across)
                    for piece in (self.shown[k].piece for k in new)
                    for down in range(-reach, reach + 1)
                    for across in range(-reach, reach + 1)
                }
                new = [left.pop(piece) for piece in near & left.keys()]
            yield sorted(found, key=rank.__getitem__)

    def _part(self, patch: FrontPatch, followed: Followed) -> ForestPart:
        """Return a patch among those of its level: it owns the trees of its cells."""
        piece, ring, n = patch.piece, self.apron // self.tree, self.cells // self.tree
        own = slice(ring, ring + n)
        return ForestPart(
            patch.mesh, followed, (piece.row * n - ring, piece.col * n - ring), (own, own)
        )

    def mesh_error(self, patch: FrontPatch, eye: Eye, followed: Followed) -> float:
        """Return the distance of the mesh in view from the samples of a patch, metres."""
        mesh: DynamicMesh = patch.mesh
        return mesh.largest_error(eye, followed) + mesh.tree.rounding
