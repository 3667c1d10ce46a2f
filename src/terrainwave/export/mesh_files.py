"""Files of meshes: coordinate frames, errors of rounding, atomic writing."""

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave._version import __version__
from terrainwave.arguments import (
    AS_IS,
    check_ending,
    check_flags,
)
from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import check_target, publish
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.export.curvature import (
    GlobeWay,
    divided,
    least_share,
    mesh_unit,
    rises,
    share_of_edge,
)
from terrainwave.export.frames import areas, globe_way, quiet_place, steepest, to_frame
from terrainwave.export.gltf import GROUND_COLOR
from terrainwave.export.mesh_formats import EXTRA, SavedMesh, obj_digits, turned_y_up
from terrainwave.export.shapes import MESH_ENDINGS, MESH_FORMATS, TILE, Shape
from terrainwave.export.solid import add_skirts, solidify
from terrainwave.extras import need
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import Footprint
from terrainwave.mesh.mesh_data import CURVATURE_SHARE, CurvatureShare, MeshData

_log = logging.getLogger(__name__)

# Tries to make a mesh that keeps its bound in the file, and the factor of the last try's rounding
# that each of them reserves.
_TRIES = 3
_ROUNDING_SLACK = 1.25
# Further tries on a globe, each with half of the share of the curvature: steep triangles can add
# many times that share. They end when halving saves less than this factor: the rest is rounding,
# and each half doubles the triangles.
_HALVINGS, _LESS = 5, 0.8

Made = TypeVar("Made", bound=MeshData)


def check_shape(shape: Shape, extension: str) -> None:
    """Raise `InvalidArgumentError` for options that do not fit a format."""
    if shape.drape is not None and (extension == TILE or not MESH_FORMATS[extension].has_picture):
        raise InvalidArgumentError(
            f"found `drape` for {extension}, expected a name that ends in .glb or .gltf: other"
            " formats hold no picture"
        )
    if extension == TILE:
        if replace(shape, radius=None, vertical=AS_IS) != Shape():
            raise InvalidArgumentError(
                "a .terrain tile has a frame of its own: expected no `frame`, `z_scale`, `solid`,"
                " `skirts` or `up`"
            )
        return
    if shape.up is not None and shape.frame == "ecef":
        raise InvalidArgumentError(
            f"found `up` {shape.up} with `frame` ecef, expected none: no axis of geocentric"
            " coordinates points upwards"
        )
    if shape.up == "z" and MESH_FORMATS[extension].up == "y":
        raise InvalidArgumentError(
            f"found `up` z for {extension}, expected y or none: in glTF y points upwards, and"
            " programs turn the mesh if theirs is another axis"
        )


def save_mesh(
    mesh: MeshData,
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    **options: Any,
) -> SavedMesh:
    """Write a mesh in the format of the extension of `path`; `options` are those of `Mesh.save`.

    ``.ply``, ``.obj``, ``.vtu``, ``.vtk`` hold float64 or decimal coordinates; ``.stl``, ``.glb``,
    ``.gltf`` hold float32, relative to an origin that the file states; ``.terrain`` is one Cesium
    quantized-mesh tile over the mesh's bounds. The file appears complete or not at all.
    """
    extension = check_extension(path)
    check_flags(overwrite=overwrite)
    shape = Shape(**options)
    check_shape(shape, extension)
    if extension == TILE:
        need("quantized_mesh_encoder", extra=EXTRA)
        from terrainwave.export.quantized_mesh import save_tile

        return save_tile(
            mesh, path, radius=shape.radius, vertical=shape.vertical, overwrite=overwrite
        )
    writer = MESH_FORMATS[extension]
    if writer.package is not None:
        need(writer.package, extra=EXTRA)
    framed, written, rounding = _to_write(mesh, extension, shape)
    about = describe(framed, framed.error + rounding)
    framed_file = replace(framed, vertices=written)
    if (shape.up or writer.up) == "y":
        framed_file = turned_y_up(framed_file)
        about["up"] = "y"
    if "uv" in framed.attributes:
        about["texture_bounds"] = list(mesh.area)
    if shape.drape is not None:
        texture = with_texture(mesh, shape.drape).attributes["texture"]
        attributes = framed_file.attributes | {"texture": texture}
        framed_file = replace(framed_file, attributes=attributes)
    # Libraries rely on numpy's default settings, which callers may have changed.
    with np.errstate(all="ignore"):
        data = writer.write(framed_file, about, Path(path))
    with publish(path, overwrite) as part, storage_errors(f"cannot write {path}"):
        part.file.write(data)
    _log.info("%s: %d triangles, %d bytes", path, framed.n_triangles, len(data))
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
        curvature=framed.attributes.get("sag", 0.0),
        share=mesh.share,
    )


def with_texture(mesh: MeshData, drape: str | os.PathLike[str]) -> MeshData:
    """Return the mesh, in its CRS, with a picture for its file, unless it has one."""
    if "texture" in mesh.attributes:
        return mesh
    from terrainwave.raster_io.drape import texture_of

    texture = texture_of(
        os.fspath(drape), crs=mesh.crs, area=mesh.area, color=GROUND_COLOR,
        plain_on=mesh.attributes.get("footprint"),
    )  # fmt: skip
    return replace(mesh, attributes=mesh.attributes | {"texture": texture})


def check_drape(terrain: TerrainFile, drape: str | os.PathLike[str] | None) -> None:
    """Raise most errors of a later `save_mesh` about pictures now, as the mesh may take long."""
    if drape is None:
        return
    from terrainwave.raster_io.drape import check_photo

    footprint = Footprint(terrain.raster_info.transform, terrain.shape)
    check_photo(os.fspath(drape), crs=terrain.crs, footprint=footprint)


def file_rounding(mesh: MeshData, path: str | os.PathLike[str], **options: Any) -> float:
    """Return the error that rounding in the file adds to the mesh's, without writing the file.

    The options are those of `save_mesh`.
    """
    extension, shape = check_extension(path), Shape(**options)
    check_shape(shape, extension)
    if extension == TILE:
        from terrainwave.export.quantized_mesh import tile_rounding

        return tile_rounding(mesh, radius=shape.radius, vertical=shape.vertical)
    framed, _, rounding = _to_write(mesh, extension, shape)
    return framed.error - mesh.error + rounding


def mesh_for_file(
    make: Callable[[float], Made],  # returns the mesh for an error
    # `path, options`: of `save_mesh`
    path: str | os.PathLike[str],
    max_error: float,
    of_heights: float,  # the part of `max_error` that the file's heights take
    **options: Any,
) -> tuple[Made, bool]:
    """Return a mesh for a file, and whether it keeps to the error in the file, too.

    Rounding in the file adds to a mesh's error, so the mesh is made again with a smaller one. On a
    globe the curvature gets a share of the error that the heights leave. If the curvature exceeds
    the error, `InvalidArgumentError` names one that a mesh keeps to, as has been tried; half of it
    is too small, or no more than was asked for.
    """
    shape = Shape(**options)
    is_on_globe = check_extension(path) == TILE or shape.frame == "ecef"

    def try_error(error: float) -> tuple[Made, bool]:
        rounding_of = partial(file_rounding, path=path, **options)
        return _fitted(make, rounding_of, error, of_heights, shape if is_on_globe else None)

    try:
        return try_error(max_error)
    except _TooSmall as found:
        smallest = found.expected
    # What is named is tried. Closer meshes may be steeper, and take more than others.
    is_taken = False
    while smallest < np.inf:
        tried = smallest / 2 if is_taken else smallest
        if tried <= max_error:
            break
        try:
            try_error(tried)
        except _TooSmall as found:
            if is_taken:
                break
            smallest = max(found.expected, _ROUNDING_SLACK * smallest)
        else:
            smallest, is_taken = tried, True
    raise InvalidArgumentError(
        f"found `max_error` {max_error:g}, expected at least {smallest:.9g} on a globe: flat"
        " triangles lie below its curved surface, and a smaller error would take too many of them"
    )


class _TooSmall(Exception):
    """The globe takes more of an error than the heights leave; `expected` is enough, probably."""

    def __init__(self, expected: float) -> None:
        # The message names it with as many digits.
        self.expected = float(f"{expected:.9g}")


def _fitted(
    make: Callable[[float], Made],
    rounding_of: Callable[[Made], float],  # returns what the file adds to a mesh's error
    max_error: float,
    of_heights: float,
    globe: Shape | None,  # None for a mesh that is not on a globe
) -> tuple[Made, bool]:
    """Return the mesh of `mesh_for_file`; raise `_TooSmall` instead of a refusal."""
    left = 0.0 if globe is None else max(max_error - of_heights, 0.0)
    share = CURVATURE_SHARE * left
    try:
        first = make(max_error - share)
        if globe is not None and (wanted := _share_of_cells(first, globe)) > share < left / 2:
            # Dividing all cells takes more triangles than a mesh closer to the heights.
            share = min(wanted, left / 2)
            first = make(max_error - share)
    except InvalidHeightsError:
        # A coarse level's heights take more; if too much, this raises again.
        first = make(max_error)
        left = share = max(max_error - first.error, 0.0)
    if globe is not None and not share:
        share = least_share(first, _way(first, globe))
    surface, is_bent, before, n_tries = first, globe is not None, np.inf, 0
    for _ in range(_TRIES + _HALVINGS):
        if globe is not None:
            surface = _with_share(surface, share)
        rounding = rounding_of(surface)
        if surface.error + rounding <= max_error:
            return surface, True
        is_bent &= rounding < _LESS * before
        if globe is not None and share <= least_share(surface, _way(surface, globe)):
            # Edges are halved as often as they may be.
            if rounding > left:
                raise _TooSmall(max_error - left + _ROUNDING_SLACK * rounding)
            is_bent = False
        n_tries += not is_bent
        if n_tries == _TRIES:
            break
        before = rounding
        if is_bent:
            share, rounding = share / 2, rounding / 2
        try:
            # The next mesh differs, so its rounding may be somewhat larger.
            surface = make(max_error - _ROUNDING_SLACK * rounding)
        except InvalidHeightsError:
            if not is_bent:
                break
    if globe is not None:
        if share <= least_share(surface, _way(surface, globe)):
            raise _TooSmall(max_error + before / 4)
        first = _with_share(first, share)
    return first, False


def _share_of_cells(mesh: MeshData, shape: Shape) -> float:
    known: CurvatureShare | None = mesh.attributes.get("curvature")
    if known is None or known.cell is None:
        return 0.0
    return share_of_edge(known.cell, _way(mesh, shape))


def _with_share(mesh: Made, share: float) -> Made:
    """Return a mesh whose edges are to be divided until the curvature keeps to an error."""
    known: CurvatureShare = mesh.attributes.get("curvature", CurvatureShare(share))
    curvature = known._replace(error=share)
    return replace(mesh, attributes=mesh.attributes | {"curvature": curvature})


def note_on_rounding(max_error: float) -> str:
    """Return a note that a file cannot keep to an error, with one that it can keep."""
    return (
        f"rounding of coordinates in the file makes the error larger than {max_error:g};"
        " .ply, .obj and .vtu keep the bound"
    )


def _to_write(
    mesh: MeshData, extension: str, shape: Shape
) -> tuple[MeshData, NDArray[np.float64], float]:
    """Return the mesh in its frame, its vertices as the file holds them, and their rounding.

    Its attribute ``uv`` holds coordinates in a picture of its area, if the format has them.
    """
    if shape.frame == "ecef":
        mesh = divided(mesh, _way(mesh, shape))
    whole = mesh
    if shape.solid is not None:
        if _is_downward(mesh, shape):
            raise InvalidHeightsError(
                "found `solid` and numbers that count downwards, as depths do: the"
                " base would lie above the ground; expected `frame` native"
            )
        whole = solidify(mesh, shape.solid)
    elif shape.skirts is not None:
        whole = add_skirts(mesh, shape.skirts, is_downward=_is_downward(mesh, shape))
    writer = MESH_FORMATS[extension]
    if writer.has_normals and (shape.solid is None or shape.drape is not None):
        # A body's walls are not visible in a picture from above.
        whole = replace(whole, attributes=whole.attributes | {"uv": _texture_places(whole)})
    framed = to_frame(
        whole, shape.frame, z_scale=shape.z_scale, radius=shape.radius, vertical=shape.vertical
    )
    if writer.is_float32:
        framed = _recentred(framed)
        written = framed.vertices.astype(np.float32).astype(np.float64)
    else:
        framed = replace(framed, vertices=framed.points, origin=(0.0, 0.0, 0.0))
        written = framed.vertices
        if extension == ".obj":
            written = np.round(written, obj_digits(framed))
    return framed, written, _rounding(mesh, framed, written, shape.radius)


def _is_downward(mesh: MeshData, shape: Shape) -> bool:
    """Return whether heights are depths that the frame turns over."""
    return shape.frame != "native" and mesh_unit(mesh).metres < 0


def check_extension(path: str | os.PathLike[str]) -> str:
    check_ending(path, MESH_ENDINGS)
    return Path(path).suffix.lower()


def prepare(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Raise the errors of a later `save_mesh` about this path now, as the mesh may take long."""
    extension = check_extension(path)
    package = "quantized_mesh_encoder" if extension == TILE else MESH_FORMATS[extension].package
    if package is not None:
        need(package, extra=EXTRA)
    check_target(path, overwrite)


def describe(mesh: MeshData, error: float) -> dict[str, Any]:
    frame = {name: value for name, value in mesh.attributes["frame"].items() if value is not None}
    about: dict[str, Any] = {"generator": f"terrainwave {__version__}", "origin": list(mesh.origin)}
    about |= {"frame": frame, "error": error}
    if mesh.units:
        about["error_unit"] = mesh.units
    if mesh.crs:
        about["crs"] = mesh.crs
    about |= mesh.attributes.get("about", {})
    return about


def _texture_places(mesh: MeshData) -> NDArray[np.float64]:
    """Return positions of vertices in a picture of the mesh's area: (0, 0) is the lower left."""
    left, bottom, right, top = mesh.area
    size = np.maximum((right - left, top - bottom), np.finfo(np.float64).tiny)
    places: NDArray[np.float64] = (mesh.points[:, :2] - (left, bottom)) / size
    return places


def _recentred(mesh: MeshData) -> MeshData:
    """Return the mesh with its origin in its middle, so that float32 holds small numbers.

    Heights are not shifted, except geocentric ones.
    """
    if mesh.attributes["frame"]["name"] != "native":
        return mesh
    left, bottom, right, top = mesh.area
    x, y = (round((low + high) / 2, 3) for low, high in ((left, right), (bottom, top)))
    shift = np.array([mesh.origin[0] - x, mesh.origin[1] - y, mesh.origin[2]])
    return replace(mesh, vertices=mesh.vertices + shift, origin=(x, y, 0.0))


def _rounding(
    mesh: MeshData, framed: MeshData, written: NDArray[np.float64], radius: float | None
) -> float:
    """Return the largest difference of the surface in the file from the mesh's, in the file's unit.

    A point of a triangle moves with its corners: horizontally by at most (dx, dy), vertically by
    dz. At its new position the surface is higher or lower by at most the steepest slopes on its
    path: dz + max
    |∂z/∂x| dx + max |∂z/∂y| dy.
    """
    frame = framed.attributes["frame"]
    moved = np.abs(written - framed.vertices).max(axis=0)
    unit = 1.0 if frame["name"] == "native" else abs(mesh_unit(mesh).metres)
    at_joints = framed.attributes.get("solid", {}).get("moved", 0.0) * sum(steepest(mesh))
    if frame["name"] == "ecef":
        slope = _steepest_on(framed, quiet_place(mesh, radius).globe_ellipsoid)
        rounding = float(np.linalg.norm(moved)) * (1 + slope)
    else:
        # A body's walls and base have zero or negative areas.
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
    rise, lengths = rises(mesh.points[mesh.triangles], ellipsoid)
    # Walls are vertical up to rounding.
    faces_up = rise > 1e-6 * lengths
    if not faces_up.any():
        return 0.0
    steepness = np.maximum((lengths[faces_up] / rise[faces_up]) ** 2 - 1, 0)
    return float(np.sqrt(steepness.max()))


def _way(mesh: MeshData, shape: Shape) -> GlobeWay:
    return globe_way(mesh, shape.radius, shape.vertical, shape.z_scale)
