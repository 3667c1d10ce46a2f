"""`Mesh`: a triangulated surface in world coordinates, as users hold it."""

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import AS_IS, count_of, crs_name, in_one_line

if TYPE_CHECKING:
    from terrainwave.export.files import SavedMesh


@dataclass(frozen=True, repr=False)
class Mesh:
    """A triangulated surface in world coordinates.

    Parameters
    ----------
    vertices : ndarray of float64, shape (n_vertices, 3)
        x, y in units of the CRS and height in the file's unit, relative to `origin`. A vertex on a
        sample lies at the centre of its pixel.
    triangles : ndarray of int32, shape (n_triangles, 3)
        Indices of vertices, counter-clockwise seen from above (from +z, x to the right, y up).
    origin : tuple of float
        What to add to vertices: x, y, height.
    error : float
        No valid original sample under the mesh is vertically further from it, in the file's unit.
    crs : str, optional
        Coordinate reference system as ``AUTH:CODE`` or WKT2.
    units : str, optional
        Unit of heights and of `error`.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    origin: tuple[float, float, float]
    error: float
    crs: str | None = None
    units: str | None = None
    attributes: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return in_one_line(
            f"<Mesh: {count_of(self.n_triangles, 'triangle')}, {self.n_vertices:,} vertices,"
            f" within {self.error:.6g} {self.units or '(unit unknown)'}, {crs_name(self.crs)}>"
        )

    @property
    def n_vertices(self) -> int:
        """Return the number of vertices."""
        return len(self.vertices)

    @property
    def n_triangles(self) -> int:
        """Return the number of triangles."""
        return len(self.triangles)

    @property
    def points(self) -> NDArray[np.float64]:
        """Return the vertices in the CRS, `origin` added."""
        return self.vertices + np.asarray(self.origin)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return (left, bottom, right, top) of the vertices in the CRS.

        Raises
        ------
        ValueError
            If the mesh has no vertex.
        """
        if not self.n_vertices:
            raise ValueError("the mesh is empty: it has no bounds")
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        frame: str | None = None,
        z_scale: float = 1.0,
        solid: float | None = None,
        radius: float | None = None,
        vertical: str = AS_IS,
        overwrite: bool = False,
    ) -> "SavedMesh":
        """Write the mesh to a file; see `terrainwave.export.files.save_mesh`.

        Parameters
        ----------
        path : path
            Its extension tells the format: .ply, .obj, .stl, .glb, .gltf, .vtu, .vtk or .terrain.
        frame : {"local", "native", "ecef"}, optional
            Local metres (the default for degrees), the CRS (the default else), or geocentric.
        z_scale : float
            Heights are multiplied by it; > 0.
        solid : float, optional
            Close the mesh with walls and a flat base at this height, in the file's unit.
        radius : float, optional
            Radius in metres of the body that degrees lie on, instead of the CRS's ellipsoid.
        vertical : {"as-is", "ellipsoid"}
            Of geocentric coordinates and .terrain: take heights as above the ellipsoid, or convert
            them from the CRS's vertical datum by PROJ's grid.
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        TerrainwaveError
            If the extension is unknown, an option does not fit, a package is missing, or the file
            cannot be written; nothing is left behind.
        """
        from terrainwave.export.files import save_mesh

        return save_mesh(
            self,
            path,
            frame=frame,
            z_scale=z_scale,
            solid=solid,
            radius=radius,
            vertical=vertical,
            overwrite=overwrite,
        )

    def to_trimesh(self) -> Any:
        """Return a `trimesh.Trimesh` with these vertices, without `origin`; needs trimesh."""
        from terrainwave.export.files import to_trimesh

        return to_trimesh(self)

    def to_pyvista(self) -> Any:
        """Return a `pyvista.PolyData` with these vertices, without `origin`; needs pyvista."""
        from terrainwave.export.files import to_pyvista

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
            matplotlib's name of the colours of heights; by default those of land, and on the Earth
            those of the sea below 0 where there are heights below -450 m.

        Returns
        -------
        ax : matplotlib Axes
        """
        from terrainwave.export.plot import plot

        return plot(self, ax, wireframe=wireframe, cmap=cmap)
