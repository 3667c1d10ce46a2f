"""Meshes to files of other programs; trimesh, meshio and quantized-mesh-encoder write them."""

import io
import json
import os
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave._version import __version__
from terrainwave.arguments import AS_IS, check_ending, check_flags
from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import check_target, publish, scratch
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.frames import areas, find_place, longest_edge, steepest, to_frame
from terrainwave.export.saved import SavedMesh
from terrainwave.export.solid import solidify
from terrainwave.extras import need
from terrainwave.mesh.mesh_data import MeshData
from terrainwave.place.position import Place
from terrainwave.place.units import height_unit

# Installs what writes the files.
_EXTRA = "mesh"
_STL_HEADER = 80
_VTK_TITLE = 255
# Digits after the point of an OBJ file: of metres or feet, and of what may be degrees.
_DIGITS = 5
_DIGITS_OF_DEGREES = 10


def save_mesh(
    mesh: MeshData,
    path: str | os.PathLike[str],
    *,
    frame: str | None = None,
    z_scale: float = 1.0,
    solid: float | None = None,
    radius: float | None = None,
    vertical: str = AS_IS,
    overwrite: bool = False,
) -> SavedMesh:
    """Write a mesh; the extension of `path` tells the format.

    Parameters
    ----------
    mesh : MeshData
    path : path
        ``.ply``, ``.obj``, ``.vtu``, ``.vtk`` hold float64 or decimal coordinates; ``.stl``,
        ``.glb``, ``.gltf`` hold float32, relative to an origin that is written beside them;
        ``.terrain`` is one Cesium quantized-mesh tile over the mesh's bounds. The file appears
        complete or not at all.
    frame, z_scale, radius, vertical
        As in `to_frame`; a ``.terrain`` tile takes `vertical` too.
    solid : float, optional
        Close the mesh with walls and a flat base at this height, in the file's unit.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InvalidHeightsError
        If the extension is none of the known ones or an option does not fit.
    TerrainwaveError
        If the package that writes the format is missing.
    StorageError
        If the file cannot be written.
    """
    extension = check_extension(path)
    check_flags(overwrite=overwrite)
    if extension == ".terrain":
        _refuse_frame(frame, z_scale, solid)
        need("quantized_mesh_encoder", extra=_EXTRA)
        from terrainwave.export.quantized_mesh import save_tile

        return save_tile(mesh, path, radius=radius, vertical=vertical, overwrite=overwrite)
    writer = _WRITERS[extension]
    need(writer.package, extra=_EXTRA)
    framed, written, rounding = _to_write(mesh, extension, frame, z_scale, solid, radius, vertical)
    about = describe(framed, framed.error + rounding)
    if writer.has_texture and solid is None:
        # A body's walls have no place in a picture from above, and its edges are sharp.
        framed = replace(framed, attributes=framed.attributes | {"uv": _texture_places(mesh)})
        about["texture_bounds"] = list(mesh.bounds)
    # Libraries count on numpy's own settings, which callers may have changed.
    with np.errstate(all="ignore"):
        data = writer.write(replace(framed, vertices=written), about, Path(path))
    with publish(path, overwrite) as part, storage_errors(f"cannot write {path}"):
        part.file.write(data)
    return SavedMesh(
        path=os.fspath(path),
        n_bytes=len(data),
        n_vertices=framed.n_vertices,
        n_triangles=framed.n_triangles,
        error=framed.error + rounding,
        rounding=rounding,
        units=mesh.units,
        vertical=framed.attributes["frame"].get("vertical"),
        frame=str(framed.attributes["frame"]["name"]),
        origin=framed.origin,
        curvature=_curvature(mesh, framed, radius),
    )


def file_rounding(
    mesh: MeshData,
    path: str | os.PathLike[str],
    *,
    frame: str | None = None,
    z_scale: float = 1.0,
    solid: float | None = None,
    radius: float | None = None,
    vertical: str = AS_IS,
) -> float:
    """Return the error that rounding in the file adds to the mesh's, without writing it.

    The arguments are those of `save_mesh`; whoever has a bound to keep asks for a mesh that leaves
    room for this.
    """
    extension = check_extension(path)
    if extension == ".terrain":
        _refuse_frame(frame, z_scale, solid)
        from terrainwave.export.quantized_mesh import tile_rounding

        return tile_rounding(mesh, radius=radius, vertical=vertical)
    framed, _, rounding = _to_write(mesh, extension, frame, z_scale, solid, radius, vertical)
    return framed.error - mesh.error + rounding


def _refuse_frame(frame: str | None, z_scale: float, solid: float | None) -> None:
    if frame is not None or z_scale != 1 or solid is not None:
        raise InvalidArgumentError(
            "a .terrain tile has a frame of its own: expected no `frame`, `z_scale` or `solid`"
        )


def _to_write(
    mesh: MeshData,
    extension: str,
    frame: str | None,
    z_scale: float,
    solid: float | None,
    radius: float | None,
    vertical: str,
) -> tuple[MeshData, NDArray[np.float64], float]:
    """Return the mesh in its frame, its vertices as the file holds them, and their rounding."""
    if solid is not None and frame != "native" and height_unit(mesh.units, mesh.crs).metres < 0:
        raise InvalidHeightsError(
            "found `solid` and a coordinate reference system that counts depths downwards: the base"
            " would lie above the ground; expected `frame` native"
        )
    whole = mesh if solid is None else solidify(mesh, solid)
    framed = to_frame(whole, frame, z_scale=z_scale, radius=radius, vertical=vertical)
    if _WRITERS[extension].is_float32:
        framed = _recentred(framed)
        written = framed.vertices.astype(np.float32).astype(np.float64)
    else:
        framed = replace(framed, vertices=framed.points, origin=(0.0, 0.0, 0.0))
        written = framed.vertices
        if extension == ".obj":
            written = np.round(written, _obj_digits(framed))
    return framed, written, _rounding(mesh, framed, written, radius)


def check_extension(path: str | os.PathLike[str]) -> str:
    """Return the extension of a path in small letters.

    Raises
    ------
    InvalidArgumentError
        If no format has it.
    """
    check_ending(path, EXTENSIONS)
    return Path(path).suffix.lower()


def prepare(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Raise now what `save_mesh` would raise for this path: the mesh may take long to make.

    Raises
    ------
    InvalidArgumentError, TerrainwaveError, StorageError
        If the extension is unknown, its package missing, or the file exists and is to be kept.
    """
    extension = check_extension(path)
    is_tile = extension == ".terrain"
    package = "quantized_mesh_encoder" if is_tile else _WRITERS[extension].package
    need(package, extra=_EXTRA)
    check_target(path, overwrite)


def describe(mesh: MeshData, error: float) -> dict[str, Any]:
    """Describe a mesh in a frame, as plain values for the file's JSON."""
    frame = {name: value for name, value in mesh.attributes["frame"].items() if value is not None}
    about: dict[str, Any] = {"generator": f"terrainwave {__version__}", "origin": list(mesh.origin)}
    about |= {"frame": frame, "error": error}
    if mesh.units:
        about["error_unit"] = mesh.units
    if mesh.crs:
        about["crs"] = mesh.crs
    return about


def _texture_places(mesh: MeshData) -> NDArray[np.float64]:
    """Return where vertices lie in a picture of the mesh's bounds: (0, 0) is its lower left."""
    left, bottom, right, top = mesh.bounds
    size = np.maximum((right - left, top - bottom), np.finfo(np.float64).tiny)
    places: NDArray[np.float64] = (mesh.points[:, :2] - (left, bottom)) / size
    return places


def vertex_normals(mesh: MeshData) -> NDArray[np.float64]:
    """Return a unit vector for each vertex: those of its triangles, weighted by their areas."""
    corners = mesh.vertices[mesh.triangles]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.column_stack(
        [
            np.bincount(
                mesh.triangles.ravel(), np.repeat(crosses[:, axis], 3), minlength=mesh.n_vertices
            )
            for axis in range(3)
        ]
    )
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.array([0.0, 0.0, 1.0])  # of a vertex that is in no triangle
    return np.where(lengths > 0, normals / np.maximum(lengths, np.finfo(np.float64).tiny), up)


def _recentred(mesh: MeshData) -> MeshData:
    """Return the mesh with its origin in its middle, so that float32 holds small numbers.

    Heights stay as they are, except geocentric ones.
    """
    if mesh.attributes["frame"]["name"] != "native":
        return mesh
    left, bottom, right, top = mesh.bounds
    x, y = (round((low + high) / 2, 3) for low, high in ((left, right), (bottom, top)))
    shift = np.array([mesh.origin[0] - x, mesh.origin[1] - y, mesh.origin[2]])
    return replace(mesh, vertices=mesh.vertices + shift, origin=(x, y, 0.0))


def _rounding(
    mesh: MeshData, framed: MeshData, written: NDArray[np.float64], radius: float | None
) -> float:
    """Return by how much the surface in the file can differ from the mesh's, in the file's unit.

    A point of a triangle moves with its corners: horizontally by at most (dx, dy), vertically by
    dz. Where it came to lie the surface is higher or lower by at most the steepest slopes on the
    way: dz + max |∂z/∂x| dx + max |∂z/∂y| dy.
    """
    frame = framed.attributes["frame"]
    moved = np.abs(written - framed.vertices).max(axis=0)
    unit = 1.0 if frame["name"] == "native" else abs(height_unit(mesh.units, mesh.crs).metres)
    at_joints = framed.attributes.get("solid", {}).get("moved", 0.0) * sum(steepest(mesh))
    if frame["name"] == "ecef":
        slope = _steepest_on(framed, _quiet_place(mesh, radius).globe_ellipsoid)
        rounding = float(np.linalg.norm(moved)) * (1 + slope)
    else:
        # A body's walls and base have none or a negative one.
        if (areas(replace(framed, vertices=written)) > 0).sum() < (areas(framed) > 0).sum():
            raise InvalidHeightsError(
                "the format's float32 cannot hold the small triangles of a mesh this wide;"
                " expected .ply, .obj or .vtu, or smaller `bounds`"
            )
        slope_x, slope_y = steepest(framed)
        rounding = float(moved[2] + slope_x * moved[0] + slope_y * moved[1])
    return rounding / (unit * frame["z_scale"]) + at_joints


def _steepest_on(mesh: MeshData, ellipsoid: Any) -> float:
    """Return the largest slope of the triangles of a geocentric mesh that face outwards."""
    corners = mesh.points[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up = corners.mean(axis=1) / (1.0, 1.0, 1 - ellipsoid.e2)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    rise = (normals * up).sum(axis=1)
    lengths = np.linalg.norm(normals, axis=1)
    # Walls stand upright, up to their rounding.
    faces_up = rise > 1e-6 * lengths
    if not faces_up.any():
        return 0.0
    steepness = np.maximum((lengths[faces_up] / rise[faces_up]) ** 2 - 1, 0)
    return float(np.sqrt(steepness.max()))


def _curvature(mesh: MeshData, framed: MeshData, radius: float | None) -> float:
    """Return how far flat triangles can lie below the curved body, in metres.

    A circle of radius r around a triangle with edges up to L, r ≤ L/√3, sags by r²/2R at most.
    """
    if framed.attributes["frame"]["name"] != "ecef":
        return 0.0
    ellipsoid = _quiet_place(mesh, radius).globe_ellipsoid
    return longest_edge(framed) ** 2 / (6 * ellipsoid.axis * (1 - ellipsoid.e2))


def _quiet_place(mesh: MeshData, radius: float | None) -> Place:
    """Return `find_place` again, without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        return find_place(mesh, radius=radius)


# The formats. Each function returns the bytes of a file.


def to_trimesh(mesh: MeshData) -> Any:
    """Return a `trimesh.Trimesh` with the mesh's vertices, relative to its origin."""
    trimesh = need("trimesh", extra=_EXTRA)
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


def _write_ply(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    out = io.BytesIO()
    _meshio_mesh(mesh).write(out, file_format="ply")
    # meshio's comment holds the time, which would make equal files differ.
    header, end, body = out.getvalue().partition(b"end_header\n")
    comment = f"comment terrainwave {_one_line(about)}\n".encode()
    header = re.sub(rb"comment [^\n]*\n", lambda _: comment, header, count=1)
    return header + end + body


def _write_obj(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    from trimesh.exchange.obj import export_obj

    header = f"terrainwave {_one_line(about)}"
    text = export_obj(
        to_trimesh(mesh), include_normals=False, digits=_obj_digits(mesh), header=header
    )
    return str(text).encode()


def _obj_digits(mesh: MeshData) -> int:
    width = float(np.ptp(mesh.vertices[:, 0]))
    may_be_degrees = mesh.attributes["frame"]["name"] == "native" and width <= 360
    return _DIGITS_OF_DEGREES if may_be_degrees else _DIGITS


def _write_stl(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    from trimesh.exchange.stl import export_stl

    data = bytes(export_stl(to_trimesh(mesh)))
    # Not `solid`: that begins a text file. 80 bytes have room for the origin, not for more.
    origin = " ".join(f"{value:.15g}" for value in about["frame"].get("centre", mesh.origin))
    header = f"terrainwave origin {origin}".encode()[:_STL_HEADER]
    return header.ljust(_STL_HEADER) + data[_STL_HEADER:]


def _scene(mesh: MeshData, about: dict[str, Any]) -> Any:
    trimesh = need("trimesh", extra=_EXTRA)
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    # glTF has y upwards: (x, y, z) to (x, z, −y) is a rotation, triangles keep their sense.
    uv = mesh.attributes.get("uv")
    surface = trimesh.Trimesh(
        vertices=_y_up(mesh.vertices),
        faces=mesh.triangles,
        vertex_normals=None if uv is None else _y_up(vertex_normals(mesh)),
        process=False,
    )
    # Without a material viewers take polished metal.
    material = PBRMaterial(
        name="ground",
        baseColorFactor=[0.75, 0.72, 0.66, 1.0],
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=False,
    )
    surface.visual = TextureVisuals(uv=uv, material=material)
    surface.metadata["terrainwave"] = about
    return trimesh.Scene({"terrain": surface})


def _y_up(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors[:, [0, 2, 1]] * (1.0, 1.0, -1.0)


def _write_glb(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    from trimesh.exchange.gltf import export_glb

    return bytes(export_glb(_scene(mesh, about), include_normals="uv" in mesh.attributes))


def _write_gltf(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    from trimesh.exchange.gltf import export_gltf

    scene, has_normals = _scene(mesh, about), "uv" in mesh.attributes
    files = export_gltf(scene, include_normals=has_normals, embed_buffers=True)
    return bytes(files["model.gltf"])


def _meshio_mesh(mesh: MeshData) -> Any:
    meshio = need("meshio", extra=_EXTRA)
    return meshio.Mesh(np.ascontiguousarray(mesh.vertices), [("triangle", mesh.triangles)])


def _write_vtu(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    data = _written_by_path(mesh, path, "vtu")
    # XML forbids two dashes inside a comment.
    comment = _one_line(about).replace("--", "-\\u002d")
    start = data.index(b"<VTKFile")
    return data[:start] + f"<!-- terrainwave {comment} -->\n".encode() + data[start:]


def _write_vtk(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    version, _, rest = _written_by_path(mesh, path, "vtk").split(b"\n", 2)
    title = f"terrainwave {_one_line(about)}"
    if len(title) > _VTK_TITLE:
        title = f"terrainwave {_one_line(about | {'crs': None})}"[:_VTK_TITLE]
    return b"\n".join([version, title.encode(), rest])


def _written_by_path(mesh: MeshData, path: Path, name: str) -> bytes:
    """Let meshio write where it insists on a path."""
    with scratch(path) as part, storage_errors(f"cannot write {path}"):
        _meshio_mesh(mesh).write(part.path, file_format=name)
        return part.path.read_bytes()


@dataclass(frozen=True)
class _Writer:
    package: str
    is_float32: bool
    write: Callable[[MeshData, dict[str, Any], Path], bytes]
    has_texture: bool = False


_WRITERS = {
    ".ply": _Writer("meshio", False, _write_ply),
    ".obj": _Writer("trimesh", False, _write_obj),
    ".stl": _Writer("trimesh", True, _write_stl),
    ".glb": _Writer("trimesh", True, _write_glb, has_texture=True),
    ".gltf": _Writer("trimesh", True, _write_gltf, has_texture=True),
    ".vtu": _Writer("meshio", False, _write_vtu),
    ".vtk": _Writer("meshio", False, _write_vtk),
}
EXTENSIONS = (*_WRITERS, ".terrain")
