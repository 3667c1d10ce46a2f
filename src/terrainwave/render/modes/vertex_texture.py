"""The quadtree as a vertex texture: E. Yusov, V. Turlapov 2008, on the marks of `dynamic`.

The full grid lies on the GPU, and so do heights and errors of all nodes, as levels of textures. The
auxiliary texture has the marks of all nodes in such levels; what has changed of it comes each
frame. That is all the processor does: the vertex shader goes down to the root above each vertex of
a patch's full grid, moves it there, so that triangles collapse, and morphs it. Vertices of the
right and lower neighbours' first column and row belong to a patch's grid too.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from terrainwave.render.modes.dynamic import Dynamic
from terrainwave.render.modes.mode import Frames
from terrainwave.render.selection import NodeTable, Selection, View

if TYPE_CHECKING:
    from terrainwave.render.vertex_texture_surface import VertexTextureSurface


class VertexTexture(Dynamic):
    """The mesh of `Dynamic`, made by the vertex shader."""

    name = "vertex-texture"

    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        """Mark nodes for a view; count as triangles what they are at most, two per vertex."""
        nodes = selection.nodes[:1]
        n_triangles, used = 0, tau
        if len(nodes) and min(self.shape) > 1:
            followed = self.follow(view, tau)
            n_triangles, used = 2 * followed.n_vertices, followed.within
        none = np.zeros(len(nodes))
        return Frames(nodes, selection.distances[:1], none, none, n_triangles, used, n_missing)

    @staticmethod
    def surface(context: Any, side: int, *, max_bytes: int) -> "VertexTextureSurface":
        """Return the textures and the program that draws full grids."""
        from terrainwave.render.vertex_texture_surface import VertexTextureSurface

        return VertexTextureSurface(context, max_bytes=max_bytes)
