"""The quadtree as a vertex texture: E. Yusov, V. Turlapov 2008, on the marks of `dynamic`.

The full grid lies on the GPU, and so do heights and errors of all nodes, as levels of textures.
What comes each frame is the auxiliary texture: the height of each sample's root. The vertex shader
moves every vertex of a patch's full grid to its root, so that triangles collapse there, and morphs
it. Vertices of the right and lower neighbours' first column and row belong to a patch's grid too.
"""

from typing import TYPE_CHECKING, Any

from terrainwave.render.modes.dynamic import Dynamic

if TYPE_CHECKING:
    from terrainwave.render.vertex_texture_surface import VertexTextureSurface


class VertexTexture(Dynamic):
    """The mesh of `Dynamic`, made by the vertex shader."""

    name = "vertex-texture"

    @staticmethod
    def surface(context: Any, side: int, *, max_bytes: int) -> "VertexTextureSurface":
        """Return the textures and the program that draws full grids."""
        from terrainwave.render.vertex_texture_surface import VertexTextureSurface

        return VertexTextureSurface(context, max_bytes=max_bytes)
