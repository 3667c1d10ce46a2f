"""Writers of mesh files: each returns the bytes of a file (`export.shapes.MESH_FORMATS`).

trimesh and meshio write them, except OBJ and glTF: their writers cannot put normals and texture
coordinates into one file without complaints of the format's validator.
"""

import io
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import scratch
from terrainwave.export.frames import vertex_normals
from terrainwave.extras import need
from terrainwave.mesh.mesh_data import MeshData

# Extra that installs the packages of the writers.
EXTRA = "mesh"
_STL_HEADER = 80
_VTK_TITLE = 255
# Decimals in an OBJ file: of metres or feet, and of possible degrees.
_DIGITS = 5
_DIGITS_OF_DEGREES = 10
# Decimals of unit vectors and texture coordinates, as float32 holds them.
_DIGITS_OF_PARTS = 7


@dataclass(frozen=True)
class SavedMesh:
    """A written mesh file.

    Parameters
    ----------
    path : str
    n_bytes, n_vertices, n_triangles : int
        Those of a body include its walls and base.
    error : float
        No valid original sample under the mesh is vertically further from the surface in the file,
        in `units`: the mesh's error plus the rounding of coordinates in the file. On a globe it
        also holds between samples, along the normal of the ellipsoid.
    rounding : float
        The part of `error` that rounding can add.
    units : str, optional
        Unit of the .twz file's heights and of `error`; not of the written file, whose heights may
        be scaled.
    frame : str
        ``"local"``, ``"native"`` or ``"ecef"``.
    origin : tuple of float
        Offset to add to the coordinates in the file to get those of the frame.
    curvature : float
        Largest distance, in metres, of flat triangles from the curved body: a part of `error`, only
        in geocentric coordinates.
    vertical : dict, optional
        For geocentric coordinates: the kind of heights (``heights``: ``"as-is"`` or
        ``"ellipsoid"``), the CRS's ``datum``, or PROJ's ``operation`` and its ``grids``.
    share : float, optional
        For meshes without a guarantee: the share of samples within the tolerance of guaranteed
        meshes.
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


def to_trimesh(mesh: MeshData) -> Any:
    """Return a `trimesh.Trimesh` with the mesh's vertices, relative to its origin."""
    trimesh = need("trimesh", extra=EXTRA)
    return trimesh.Trimesh(vertices=mesh.vertices, faces=mesh.triangles, process=False)


def to_pyvista(mesh: MeshData) -> Any:
    """Return a `pyvista.PolyData` with the mesh's vertices, relative to its origin."""
    pyvista = need("pyvista", extra="pyvista")
    faces = np.empty((mesh.n_triangles, 4), dtype=np.int64)
    faces[:, 0] = 3
    faces[:, 1:] = mesh.triangles
    return pyvista.PolyData(mesh.vertices, faces.ravel())


def _one_line(about: dict[str, Any]) -> str:
    return json.dumps(about, allow_nan=False)


def write_ply(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    """Return a binary PLY file, by meshio."""
    out = io.BytesIO()
    _meshio_mesh(mesh).write(out, file_format="ply")
    # meshio's comment holds the time, which would make equal files differ.
    header, end, body = out.getvalue().partition(b"end_header\n")
    comment = f"comment terrainwave {_one_line(about)}\n".encode()
    header = re.sub(rb"comment [^\n]*\n", lambda _: comment, header, count=1)
    return header + end + body


def write_obj(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    """Return an OBJ file, with normals and texture coordinates if the mesh has any."""
    uv = mesh.attributes.get("uv")
    parts = [f"# terrainwave {_one_line(about)}\n", _lines("v", mesh.vertices, obj_digits(mesh))]
    corner = "%d"
    if uv is not None:
        parts += [
            _lines("vt", uv, _DIGITS_OF_PARTS),
            _lines("vn", vertex_normals(mesh), _DIGITS_OF_PARTS),
        ]
        corner = "%d/%d/%d"
    # Vertices count from 1; each has its own normal and texture coordinates.
    numbers = np.repeat(mesh.triangles.astype(np.int64) + 1, corner.count("%"), axis=1)
    line = f"f {corner} {corner} {corner}\n"
    parts.append(line * mesh.n_triangles % tuple(numbers.ravel().tolist()))
    return "".join(parts).encode()


def _lines(word: str, values: NDArray[np.float64], digits: int) -> str:
    """Return a line for each row of numbers, after a word."""
    line = word + f" %.{digits}f" * values.shape[1] + "\n"
    rounded = np.round(values, digits) + 0.0  # no -0
    return line * len(values) % tuple(rounded.ravel().tolist())


def obj_digits(mesh: MeshData) -> int:
    """Return the number of decimals of an OBJ file's coordinates."""
    width = float(np.ptp(mesh.vertices[:, 0]))
    may_be_degrees = mesh.attributes["frame"]["name"] == "native" and width <= 360
    return _DIGITS_OF_DEGREES if may_be_degrees else _DIGITS


def write_stl(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    """Return a binary STL file, by trimesh."""
    from trimesh.exchange.stl import export_stl

    data = bytes(export_stl(to_trimesh(mesh)))
    # It must not begin with `solid`, which marks a text file. 80 bytes have room only for the
    # origin.
    origin = " ".join(f"{value:.15g}" for value in about["frame"].get("centre", mesh.origin))
    header = f"terrainwave origin {origin}".encode()[:_STL_HEADER]
    return header.ljust(_STL_HEADER) + data[_STL_HEADER:]


def turned_y_up(mesh: MeshData) -> MeshData:
    """Return a mesh whose y points upwards, and z to the south.

    (x, y, z) to (x, z, −y) is a rotation: triangles keep their sense.
    """
    vertices = mesh.vertices[:, [0, 2, 1]] * (1.0, 1.0, -1.0) + 0.0  # no -0
    return replace(mesh, vertices=vertices, attributes=mesh.attributes | {"up": "y"})


def _meshio_mesh(mesh: MeshData) -> Any:
    meshio = need("meshio", extra=EXTRA)
    return meshio.Mesh(np.ascontiguousarray(mesh.vertices), [("triangle", mesh.triangles)])


def write_vtu(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    """Return a VTU file, by meshio."""
    data = _written_by_path(mesh, path, "vtu")
    # XML forbids two dashes inside a comment.
    comment = _one_line(about).replace("--", "-\\u002d")
    start = data.index(b"<VTKFile")
    return data[:start] + f"<!-- terrainwave {comment} -->\n".encode() + data[start:]


def write_vtk(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    """Return a VTK file, by meshio."""
    version, _, rest = _written_by_path(mesh, path, "vtk").split(b"\n", 2)
    title = f"terrainwave {_one_line(about)}"
    if len(title) > _VTK_TITLE:
        title = f"terrainwave {_one_line(about | {'crs': None})}"[:_VTK_TITLE]
    return b"\n".join([version, title.encode(), rest])


def _written_by_path(mesh: MeshData, path: Path, name: str) -> bytes:
    """Use meshio with a temporary file where it requires a path."""
    with scratch(path) as part, storage_errors(f"cannot write {path}"):
        _meshio_mesh(mesh).write(part.path, file_format=name)
        return part.path.read_bytes()
