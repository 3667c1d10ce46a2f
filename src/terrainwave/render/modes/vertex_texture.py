"""The quadtree as a vertex texture: E. Yusov, V. Turlapov 2008, on the marks of `dynamic`.

The full grids of patches are on the GPU, and so are heights and errors of all nodes, as levels of
textures. The auxiliary texture has the marks of all nodes in such levels; its changes are uploaded
each frame. The processor does no more: the vertex shader descends to the root above each vertex of
a tree's full grid, moves it there, so that triangles collapse, and morphs it. Vertices of the right
and lower neighbours' first column and row belong to a tree's grid too.

Textures belong to one patch, and so do the shader's lookups: a patch extends half a tree over some
samples of its neighbours, or beyond the outline, on either side, and ends in skirts there.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.render.modes.dynamic import Dynamic
from terrainwave.tri.followed import Eye


class VertexTexture(Dynamic):
    """The mesh of `Dynamic`, made by the vertex shader."""

    name = "vertex-texture"
    # Textures: heights 16/3, bounds 4, marks 1/3.
    sample_bytes = Dynamic.sample_bytes + 10

    def arrange(self) -> None:
        """Set the extent of patches for a size of trees.

        A mesh ends at most half a tree short of its samples. Whole trees fit those of a patch, and
        the last ones extend further beyond its cells than that.
        """
        self.apron, self.beyond = self.tree // 2, self.tree
        self.cells = self.samples - self.apron

    def draw(
        self, eye: Eye, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], int]:
        """Leave the drawing to the GPU; count triangles by their upper limit, two per vertex."""
        errors = [
            self.mesh_error(patch, eye, followed)
            for patch, followed in zip(self.shown, self.followed, strict=True)
        ]
        n_vertices = sum(followed.n_vertices for followed in self.followed)
        return self.depths(eye, errors, low, high), 2 * n_vertices
