"""Coordinate frames of exported meshes: the CRS itself, local metres, geocentric metres."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import AS_IS, check_choice, check_vertical, checked_number
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.curvature import GlobeWay, curvature, mesh_unit, way_onto_globe
from terrainwave.export.shapes import FRAMES
from terrainwave.mesh.mesh_data import MeshData
from terrainwave.place.position import LocalAxes, Place, place_of
from terrainwave.place.vertical import note_as_is


def find_place(mesh: MeshData, *, radius: float | None = None, has_frames: bool = False) -> Place:
    is_placed = mesh.attributes.get("is_placed") is not False
    return place_of(
        mesh.crs, mesh.bounds, is_placed=is_placed, radius=radius, has_frames=has_frames
    )


def quiet_place(mesh: MeshData, radius: float | None) -> Place:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        return find_place(mesh, radius=radius)


def globe_way(
    mesh: MeshData, radius: float | None = None, vertical: str = AS_IS, z_scale: float = 1.0
) -> GlobeWay:
    """Return the conversion of a mesh's points to the globe, without the warnings of `to_frame`."""
    return way_onto_globe(mesh, quiet_place(mesh, radius), vertical, z_scale)


def to_frame(
    mesh: MeshData,
    frame: str | None = None,
    *,
    z_scale: float = 1.0,
    radius: float | None = None,
    vertical: str = AS_IS,
) -> MeshData:
    """Return the mesh in a frame; `error` stays in the file's unit.

    ``local``: metres from the middle of the area, x to the east, y to the north, z the height.
    Degrees are scaled by the ellipsoid's radii of curvature there; feet become metres; axes to the
    west or south are turned. ``native``: coordinates of the CRS, heights in the file's unit.
    ``ecef``: geocentric metres, on WGS 84 for the Earth, else on the ellipsoid of the CRS; heights
    are assumed to be above that ellipsoid, with a note if the CRS names another datum, or converted
    by PROJ's grid (`vertical`), and `error` includes the curvature of the globe and of the geoid
    between vertices. By default ``local`` for degrees, else ``native``. `radius` is that of a
    sphere instead of the CRS's ellipsoid.

    ``attributes["frame"]`` describes the frame: ``name``, ``z_scale``, ``unit``. For ``local`` also
    ``centre`` in the CRS, ``metres`` per unit of x, y and height, ``axes`` (the directions of the
    CRS's x and y, unless they are east and north) and, if heights are radii, ``zero``, the radius
    at z 0. For ``ecef`` also ``vertical``, the meaning of its heights.
    """
    if frame is not None:
        check_choice("frame", frame, FRAMES)
    z_scale = checked_number("z_scale", z_scale, above=0)
    if not mesh.n_triangles:
        raise InvalidHeightsError("the mesh is empty: there are no valid heights under it")
    if check_vertical(vertical) and frame != "ecef":
        raise InvalidArgumentError(
            f"found `vertical` ellipsoid with `frame` {frame or 'local or native'}, expected ecef:"
            " other frames keep the file's datum"
        )
    if frame == "native" and radius is None:
        return _native(mesh, z_scale)
    place = find_place(mesh, radius=radius, has_frames=True)
    frame = frame or ("local" if place.in_degrees else "native")
    if frame == "native":
        return _native(mesh, z_scale)
    if frame == "local":
        return _local(mesh, place, z_scale)
    return _ecef(mesh, place, z_scale, vertical)


def _native(mesh: MeshData, z_scale: float) -> MeshData:
    x, y, height = mesh.origin
    return replace(
        mesh,
        vertices=mesh.vertices * (1.0, 1.0, z_scale),
        origin=(x, y, height * z_scale),
        attributes=_attributes(mesh, "native", z_scale, mesh.units),
    )


def _local(mesh: MeshData, place: Place, z_scale: float) -> MeshData:
    left, bottom, right, top = mesh.area
    centre = ((left + right) / 2, (bottom + top) / 2)
    axes = place.local_axes(*centre)
    unit = mesh_unit(mesh)
    unit.note_kind()
    per_z = unit.metres
    zero = place.surface_radius(*centre) / per_z if unit.is_radius else 0.0
    # The origin is subtracted last but one: vertices are small numbers, the origin is not.
    shift = np.array([mesh.origin[0] - centre[0], mesh.origin[1] - centre[1], mesh.origin[2]])
    shift[2] -= zero
    vertices = mesh.vertices + shift
    vertices[:, :2] = vertices[:, :2] @ axes.matrix.T
    vertices[:, 2] *= per_z * z_scale
    attributes = _attributes(mesh, "local", z_scale, "m")
    attributes["frame"] |= {"centre": list(centre), "metres": [*axes.lengths, per_z]}
    if zero:
        attributes["frame"]["zero"] = zero
    if axes.names != ("east", "north"):
        attributes["frame"]["axes"] = list(axes.names)
    return replace(
        mesh,
        vertices=vertices,
        triangles=_facing_up(mesh, axes),
        origin=(0.0, 0.0, 0.0),
        attributes=attributes,
    )


def _facing_up(mesh: MeshData, axes: LocalAxes) -> NDArray[np.int32]:
    return mesh.triangles[:, ::-1] if axes.is_mirrored else mesh.triangles


def _ecef(mesh: MeshData, place: Place, z_scale: float, vertical: str) -> MeshData:
    place.note_sphere()
    note_heights(mesh, vertical)
    way = way_onto_globe(mesh, place, vertical, z_scale)
    vertices = way.geocentric(mesh.points)
    centre = mesh.attributes.get("geocentric_centre")
    if centre is None:
        centre = np.round((vertices.min(axis=0) + vertices.max(axis=0)) / 2)
    attributes = _attributes(mesh, "ecef", z_scale, "m")
    attributes["frame"]["vertical"] = way.describe(mesh.crs)
    sag = curvature(mesh, way)
    return replace(
        mesh,
        error=mesh.error + sag / way.per_unit,
        vertices=vertices - centre,
        triangles=globe_triangles(mesh, place),
        origin=(float(centre[0]), float(centre[1]), float(centre[2])),
        attributes=attributes | {"sag": sag},
    )


def note_heights(mesh: MeshData, vertical: str) -> None:
    unit = mesh_unit(mesh)
    unit.note_kind()
    if not check_vertical(vertical) and not unit.is_radius:
        note_as_is(mesh.crs)


def globe_triangles(mesh: MeshData, place: Place) -> NDArray[np.int32]:
    return _facing_up(mesh, LocalAxes(*place.directions))


def _attributes(mesh: MeshData, name: str, z_scale: float, unit: str | None) -> dict[str, Any]:
    return mesh.attributes | {"frame": {"name": name, "z_scale": z_scale, "unit": unit}}


def areas(mesh: MeshData) -> NDArray[np.float64]:
    """Return twice the areas of the triangles seen from above; positive is counter-clockwise."""
    xy = mesh.vertices[:, :2]
    a, b, c = (xy[mesh.triangles[:, corner]] for corner in range(3))
    along, across = b - a, c - a
    twice: NDArray[np.float64] = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    return twice


def steepest(mesh: MeshData) -> tuple[float, float]:
    """Return the largest |∂z/∂x| and |∂z/∂y| of the triangles that face upwards."""
    corners = mesh.vertices[mesh.triangles[areas(mesh) > 0]]
    if not len(corners):
        return 0.0, 0.0
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(along, across)
    slopes = np.abs(normals[:, :2] / normals[:, 2:])
    return float(slopes[:, 0].max()), float(slopes[:, 1].max())


def vertex_normals(mesh: MeshData) -> NDArray[np.float64]:
    """Return a unit vector for each vertex: those of its triangles, weighted by their areas.

    The lower vertices of skirts have those above them, so that skirts are lit as the ground is.
    """
    skirts = mesh.attributes.get("skirts")
    triangles = mesh.triangles if skirts is None else mesh.triangles[: skirts.n_triangles]
    corners = mesh.vertices[triangles]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.column_stack(
        [
            np.bincount(triangles.ravel(), np.repeat(crosses[:, axis], 3), mesh.n_vertices)
            for axis in range(3)
        ]
    )
    if skirts is not None:
        normals[mesh.n_vertices - len(skirts.above) :] = normals[skirts.above]
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0] if mesh.attributes.get("up") == "y" else [0.0, 0.0, 1.0])
    # Vertices without triangles point upwards.
    return np.where(lengths > 0, normals / np.maximum(lengths, np.finfo(np.float64).tiny), up)
