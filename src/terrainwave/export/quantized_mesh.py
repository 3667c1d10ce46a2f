"""Cesium quantized-mesh tiles, encoded by quantized-mesh-encoder.

A tile holds longitude, latitude and height in 1/32767 of its own extent. The mesh's error holds for
the heights passed to the encoder; the error of rounding is computed from the rounded vertices.
"""

import io
import json
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave._version import __version__
from terrainwave.arguments import AS_IS
from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import publish
from terrainwave.errors import InvalidHeightsError
from terrainwave.export.curvature import curvature, divided, mesh_unit, way_onto_globe
from terrainwave.export.frames import (
    areas,
    find_place,
    globe_triangles,
    note_heights,
    steepest,
)
from terrainwave.export.mesh_formats import SavedMesh
from terrainwave.extras import need
from terrainwave.mesh.mesh_data import MeshData
from terrainwave.place.ellipsoid import Ellipsoid

STEPS = 32767
# Distance, in radii from the middle of the globe, of a point beyond all horizons.
_FAR = 1e6


class Tile(NamedTuple):
    """Bytes of a tile and the largest vertical effect of rounding, in metres."""

    data: bytes
    rounding: float
    n_vertices: int
    n_triangles: int


@dataclass(frozen=True)
class GeographicMesh:
    """A mesh in degrees and metres, and their ellipsoid.

    `curvature` in metres is the part of the mesh's error from flat triangles on the globe.
    """

    mesh: MeshData
    ellipsoid: Ellipsoid
    curvature: float


def on_globe(
    mesh: MeshData, *, radius: float | None = None, vertical: str = AS_IS
) -> GeographicMesh:
    """Return the mesh in longitude, latitude (degrees) and metres.

    Meshes of the Earth go to WGS 84, which Cesium uses; others stay on their own body. Heights are
    assumed to be above the ellipsoid, or converted: `vertical` as in `to_frame`. Edges are divided
    for the globe's curvature (`export.curvature`).
    """
    if not mesh.n_triangles:
        raise InvalidHeightsError("the mesh is empty: there are no valid heights under it")
    place = find_place(mesh, radius=radius)
    place.note_sphere()
    note_heights(mesh, vertical)
    way = way_onto_globe(mesh, place, vertical)
    mesh = divided(mesh, way)
    sag = curvature(mesh, way)
    moved = replace(
        mesh,
        vertices=way.geographic(mesh.points),
        triangles=globe_triangles(mesh, place),
        origin=(0.0, 0.0, 0.0),
        error=mesh.error * way.per_unit + sag,
        units="m",
        attributes=mesh.attributes | {"vertical": way.describe(mesh.crs)},
    )
    if not (areas(moved) > 0).all():
        raise InvalidHeightsError(
            "in longitude and latitude some triangles turn over; a mesh across the date line or a"
            " pole cannot be one tile: expected smaller `bounds`"
        )
    return GeographicMesh(moved, place.globe_ellipsoid, sag)


def _metres(mesh: MeshData) -> float:
    return abs(mesh_unit(mesh).metres)


def encode_tile(globe: GeographicMesh, bounds: Sequence[float]) -> Tile:
    """Encode a mesh as one tile of some bounds around it: west, south, east, north, in degrees."""
    used, triangles = in_order_of_use(globe.mesh.triangles)
    points = globe.mesh.points[used]
    quantized, rounding, low, high = _quantize(points, triangles, bounds)
    about = {"bounds": list(bounds), "geometricerror": globe.mesh.error + rounding}
    about |= {name: globe.mesh.attributes[name] for name in ("vertical",)}
    data = tile_bytes(points, quantized, triangles, (low, high), globe.ellipsoid, about)
    return Tile(data, rounding, len(points), len(triangles))


def tile_bytes(
    # shape (n_vertices, 3); longitude, latitude in degrees and height in metres, in the order of
    # their first use
    points: NDArray[np.float64],
    # shape (n_vertices, 3); the same as in the tile: (u, v, h) in 0 … 32767
    quantized: NDArray[np.int16],
    triangles: NDArray[np.int32],  # shape (n_triangles, 3); counter-clockwise seen from above
    heights: tuple[float, float],  # heights of h = 0 and h = 32767; exact in float32
    ellipsoid: Ellipsoid,
    about: dict[str, Any],  # for the metadata extension
) -> bytes:
    encoder = need("quantized_mesh_encoder.encode", extra="mesh")
    from quantized_mesh_encoder.ellipsoid import Ellipsoid as EncoderEllipsoid
    from quantized_mesh_encoder.extensions import MetadataExtension

    axis, e2 = ellipsoid
    # `encode` takes positions as float32, which are off by nearly a metre at 180 degrees, and
    # rounds down.
    with np.errstate(all="ignore"):
        header = encoder.compute_header(
            points, "naive", ellipsoid=EncoderEllipsoid(a=axis, b=axis * float(np.sqrt(1 - e2)))
        )
        header |= dict(zip(("minimumHeight", "maximumHeight"), heights, strict=True))
        header |= _occlusion_point(ellipsoid.geocentric(points), ellipsoid)
        out = io.BytesIO()
        encoder.encode_header(out, header)
        encoder.write_vertices(out, quantized, len(quantized))
        encoder.write_indices(out, triangles.astype(np.uint32), len(quantized))
        encoder.write_edge_indices(out, quantized, len(quantized))
        # The format requires the length before the text; the encoder omits it for a dict.
        text = json.dumps({"generator": f"terrainwave {__version__}"} | about).encode()
        out.write(MetadataExtension(data=struct.pack("<I", len(text)) + text).encode())
    return out.getvalue()


def _occlusion_point(points: NDArray[np.float64], ellipsoid: Ellipsoid) -> dict[str, float]:
    """Return the point that is behind the horizon if all of the tile is.

    It lies in the direction of the vertices' middle, on the ellipsoid scaled to a unit sphere, at
    the largest 1 / (cos α cos β − sin α sin β), α the angle to a vertex and cos β = 1 / its
    distance (Ring 2013, Computing the horizon occlusion point). It does not exist if α + β reaches
    a right angle, as in tiles of half a globe: then the result is a very distant point, hidden with
    their middle.
    """
    axes = np.array([1.0, 1.0, np.sqrt(1 - ellipsoid.e2)]) * ellipsoid.axis
    scaled = points / axes
    middle = (scaled.min(axis=0) + scaled.max(axis=0)) / 2
    direction = middle / np.linalg.norm(middle)
    distances = np.maximum(np.linalg.norm(scaled, axis=1), 1.0)
    cos_alpha = np.clip(scaled @ direction / np.linalg.norm(scaled, axis=1), -1.0, 1.0)
    angle = np.arccos(cos_alpha) + np.arccos(1 / distances)
    far = 1 / max(float(np.cos(angle.max())), 1 / _FAR) if angle.max() < np.pi / 2 else _FAR
    names = (f"horizonOcclusionPoint{axis}" for axis in "XYZ")
    return dict(zip(names, (direction * far).tolist(), strict=True))


def in_order_of_use(triangles: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return vertices in the order in which triangles first use them, and triangles of these.

    The format requires this order.
    """
    used, first, places = np.unique(triangles.ravel(), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    renumbered: NDArray[np.int32] = rank[places.ravel()].reshape(-1, 3)
    return used[order].astype(np.int64), renumbered


def _quantize(
    points: NDArray[np.float64], triangles: NDArray[np.int32], bounds: Sequence[float]
) -> tuple[NDArray[np.int16], float, float, float]:
    """Return (u, v, h) in 0 … 32767, the rounding in metres, lowest and highest height."""
    low = float(np.nextafter(np.float32(points[:, 2].min()), np.float32(-np.inf)))
    high = float(np.nextafter(np.float32(points[:, 2].max()), np.float32(np.inf)))
    start = np.array([bounds[0], bounds[1], low])
    size = np.array([bounds[2], bounds[3], high]) - start
    steps = np.clip(np.rint((points - start) / size * STEPS), 0, STEPS)
    written = start + steps / STEPS * size
    moved = np.abs(written - points).max(axis=0)
    flat = MeshData(points, triangles, (0.0, 0.0, 0.0), 0.0)
    slope_x, slope_y = steepest(flat)
    rounding = float(moved[2] + slope_x * moved[0] + slope_y * moved[1])
    return steps.astype(np.int16), rounding, low, high


def save_tile(
    mesh: MeshData,
    path: str | os.PathLike[str],
    *,
    radius: float | None = None,
    vertical: str = AS_IS,
    overwrite: bool = False,
) -> SavedMesh:
    """Write a mesh as one quantized-mesh tile over its own bounds.

    The bounds are in its metadata extension; otherwise only the position in a tile set gives them.
    """
    globe = on_globe(mesh, radius=radius, vertical=vertical)
    tile = encode_tile(globe, globe.mesh.bounds)
    with publish(path, overwrite) as part, storage_errors(f"cannot write {path}"):
        part.file.write(tile.data)
    rounding = tile.rounding / _metres(mesh)
    return SavedMesh(
        path=os.fspath(path),
        n_bytes=len(tile.data),
        n_vertices=tile.n_vertices,
        n_triangles=tile.n_triangles,
        error=globe.mesh.error / _metres(mesh) + rounding,
        rounding=rounding,
        units=mesh.units,
        frame="ecef",
        origin=(0.0, 0.0, 0.0),
        curvature=globe.curvature,
        vertical=globe.mesh.attributes["vertical"],
        share=mesh.share,
    )


def tile_rounding(mesh: MeshData, *, radius: float | None = None, vertical: str = AS_IS) -> float:
    """Return the error that `save_tile` would add to the mesh's, in the file's unit."""
    globe = on_globe(mesh, radius=radius, vertical=vertical)
    used, triangles = in_order_of_use(globe.mesh.triangles)
    rounding = _quantize(globe.mesh.points[used], triangles, globe.mesh.bounds)[1]
    return (globe.mesh.error + rounding) / _metres(mesh) - mesh.error
