"""`Mesh`: a triangulated surface in world coordinates, for users."""

import os
from dataclasses import dataclass
from typing import Any

from terrainwave.arguments import AS_IS
from terrainwave.export.mesh_formats import SavedMesh
from terrainwave.mesh.mesh_data import MeshData


@dataclass(frozen=True, repr=False)
class Mesh(MeshData):
    """A triangulated surface in world coordinates.

    Parameters
    ----------
    vertices : ndarray of float64, shape (n_vertices, 3)
        x, y in units of the CRS and height in the file's unit, relative to `origin`. A vertex on a
        sample lies at the centre of its pixel.
    triangles : ndarray of int32, shape (n_triangles, 3)
        Indices of vertices, counter-clockwise seen from above (from +z, x to the right, y up).
    origin : tuple of float
        Offset to add to vertices: x, y, height.
    error : float
        No valid original sample under the mesh is vertically further from it, in the file's unit.
    crs : str, optional
        Coordinate reference system as ``AUTH:CODE`` or WKT2.
    units : str, optional
        Unit of heights and of `error`.
    heights_are : {"height", "depth", "radius"}, optional
        Meaning of heights, as in `compress`. None: heights, or depths if the CRS's vertical axis
        points down. Depths and radii are converted to heights if the mesh is saved in another
        frame.
    """

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        frame: str | None = None,
        z_scale: float = 1.0,
        solid: float | None = None,
        skirts: float | None = None,
        radius: float | None = None,
        vertical: str = AS_IS,
        up: str | None = None,
        drape: str | os.PathLike[str] | None = None,
        overwrite: bool = False,
    ) -> SavedMesh:
        """Write the mesh to a file; see `terrainwave.export.mesh_files.save_mesh`.

        Parameters
        ----------
        path : path
            The extension selects the format (``export.shapes.MESH_FORMATS``, or ``.terrain``).
        frame : {"local", "native", "ecef"}, optional
            Metres from the middle (default for degrees), the CRS (otherwise), or geocentric. For
            geocentric files edges are divided where the globe curves too much, and the error
            includes the rest.
        z_scale : float
            Heights are multiplied by it; > 0.
        solid : float, optional
            Close the mesh with walls and a flat base at this height, in the file's unit.
        skirts : float, optional
            Hang walls of this height, in the file's unit, from all borders; > 0. They hide gaps
            next to meshes of another error.
        radius : float, optional
            Radius in metres of the body that degrees lie on, instead of the CRS's ellipsoid.
        vertical : {"as-is", "ellipsoid"}
            For geocentric coordinates and .terrain: assume that heights are above the ellipsoid, or
            convert them from the CRS's vertical datum with PROJ's grid.
        up : {"y", "z"}, optional
            The axis that points upwards in the file; y means coordinates (x, z, -y). By default y
            in glTF, which has no other, and z in other formats.
        drape : path, optional
            Path or URL of a picture to put into a .glb or .gltf, as for `Terrain.view`: warped to
            the mesh's CRS, at most 8192 pixels a side. A picture without coordinates covers the
            whole raster, or the mesh if that has no raster.
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        TerrainwaveError
            If the extension is unknown, an option does not fit, a package is missing, or the file
            cannot be written. No file remains.
        """
        given = {name: value for name, value in locals().items() if name != "self"}
        from terrainwave.export.mesh_files import save_mesh

        return save_mesh(self, **given)

    def to_trimesh(self) -> Any:
        """Return a `trimesh.Trimesh` with these vertices, without `origin`; needs trimesh."""
        from terrainwave.export.mesh_formats import to_trimesh

        return to_trimesh(self)

    def to_pyvista(self) -> Any:
        """Return a `pyvista.PolyData` with these vertices, without `origin`; needs pyvista."""
        from terrainwave.export.mesh_formats import to_pyvista

        return to_pyvista(self)

    def plot(self, ax: Any = None, *, wireframe: bool = False, cmap: str | None = None) -> Any:
        """Draw the mesh from above, coloured by height and shaded; needs matplotlib.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to draw; a new figure by default.
        wireframe : bool
            Draw the edges too.
        cmap : str, optional
            matplotlib's name of a colour map. By default colours of land; on the Earth, heights
            below 0 get colours of the sea if there are heights below -450 m.

        Returns
        -------
        ax : matplotlib Axes
        """
        from terrainwave.export.plot import plot

        return plot(self, ax, wireframe=wireframe, cmap=cmap)
