"""The numbers of a mesh in world coordinates, and what is known of them as a file."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import count_of, crs_name, in_one_line


@dataclass(frozen=True, repr=False)
class MeshData:
    """A triangulated surface in world coordinates; `Mesh` has what users do with it.

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


@dataclass(frozen=True)
class SavedMesh:
    """What was written.

    Parameters
    ----------
    path : str
    n_bytes, n_vertices, n_triangles : int
        Those of a body include its walls and base.
    error : float
        No valid original sample under the mesh is vertically further from the surface in the file,
        in `units`: the mesh's error and what the rounding of coordinates in the file can add.
    rounding : float
        The part of `error` that rounding can add.
    units : str, optional
        Unit of the .twz file's heights and of `error`; not of the file written, whose heights may
        be scaled.
    frame : str
        ``"local"``, ``"native"`` or ``"ecef"``.
    origin : tuple of float
        What to add to the coordinates in the file to have those of the frame.
    curvature : float
        Metres that flat triangles can lie below the curved body between their vertices; in
        geocentric coordinates only, and not part of `error`.
    vertical : dict, optional
        Of geocentric coordinates: what heights are (``heights``: ``"as-is"`` or ``"ellipsoid"``),
        the CRS's ``datum``, or PROJ's ``operation`` and its ``grids``.
    """

    path: str
    n_bytes: int
    n_vertices: int
    n_triangles: int
    error: float
    rounding: float
    units: str | None
    frame: str
    origin: tuple[float, float, float]
    curvature: float = 0.0
    vertical: dict[str, Any] | None = None
