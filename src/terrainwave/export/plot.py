"""A picture of a mesh from above, with matplotlib."""

import math
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.frames import areas, find_place, metres_per_unit
from terrainwave.export.mesh import Mesh
from terrainwave.extras import need

# From the north-west, 45 degrees above the horizon, as maps are lit.
_LIGHT = np.array([-0.5, 0.5, math.sqrt(0.5)])
_AMBIENT = 0.35
_EDGE = {"edgecolors": (0, 0, 0, 0.45), "linewidths": 0.25}


def plot(mesh: Mesh, ax: Any, *, wireframe: bool, cmap: str) -> Any:
    """Draw a mesh; see `Mesh.plot`."""
    pyplot = need("matplotlib.pyplot", extra="demo")
    collections = need("matplotlib.collections", extra="demo")

    if not mesh.n_triangles:
        raise InvalidHeightsError("the mesh is empty: there is nothing to draw")
    if ax is None:
        _, ax = pyplot.subplots()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        place = find_place(mesh)
        unit = metres_per_unit(mesh.units)
    left, bottom, right, top = mesh.bounds
    stretch = 1.0
    per_x = per_y = place.unit
    if place.is_geographic:
        latitude = (bottom + top) / 2 * place.unit
        stretch = math.cos(math.radians(min(abs(latitude), 85.0)))
        per_y = math.radians(place.unit) * place.ellipsoid.axis
        per_x = per_y * stretch
    corners = mesh.points[mesh.triangles[areas(mesh) > 0]]
    brightness = _brightness(corners * (per_x, per_y, unit))
    heights = corners[:, :, 2].mean(axis=1)
    low, high = float(heights.min()), float(heights.max())
    colours = pyplot.get_cmap(cmap)((heights - low) / ((high - low) or 1.0))
    colours[:, :3] *= brightness[:, np.newaxis]
    # Edges of the faces' own colour close the hairlines between neighbours.
    edges: dict[str, Any] = _EDGE if wireframe else {"edgecolors": "face", "linewidths": 0.1}
    ax.add_collection(collections.PolyCollection(corners[:, :, :2], facecolors=colours, **edges))
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    ax.set_aspect(1 / stretch)
    return ax


def _brightness(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Lambert's cosine of each triangle, 1 on level ground at most."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    direct = np.clip((normals * _LIGHT).sum(axis=1) / _LIGHT[2], 0, 1)
    shade: NDArray[np.float64] = _AMBIENT + (1 - _AMBIENT) * direct
    return shade
