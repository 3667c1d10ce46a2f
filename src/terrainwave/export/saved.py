"""What is known of a mesh as a file."""

from dataclasses import dataclass
from typing import Any


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
        in `units`: the mesh's error and what the rounding of coordinates in the file can add. On a
        globe it holds between samples, too, along the normal of the ellipsoid.
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
        Metres that flat triangles can be off the curved body between their vertices: a part of
        `error`, in geocentric coordinates only.
    vertical : dict, optional
        Of geocentric coordinates: what heights are (``heights``: ``"as-is"`` or ``"ellipsoid"``),
        the CRS's ``datum``, or PROJ's ``operation`` and its ``grids``.
    share : float, optional
        Of meshes without a guarantee: the share of samples within the tolerance that guaranteed
        meshes have.
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
    share: float | None = None
