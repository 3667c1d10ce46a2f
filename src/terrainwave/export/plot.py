"""A picture of a mesh from above, with matplotlib."""

import contextlib
import math
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.curvature import mesh_unit
from terrainwave.export.frames import areas, find_place
from terrainwave.extras import need
from terrainwave.mesh.mesh_data import MeshData
from terrainwave.place.position import axis_labels
from terrainwave.place.units import unit_text

# From the north-west, 45 degrees above the horizon, as is usual on maps.
_LIGHT = np.array([-0.5, 0.5, math.sqrt(0.5)])
_AMBIENT = 0.35
_EDGE = {"edgecolors": (0, 0, 0, 0.45), "linewidths": 0.25}


# Metres: no dry land of the Earth lies lower.
_DEEPEST_LAND = -450.0
# Shares of matplotlib's gist_earth at which its sea and its land begin and end.
_SEA_SHARES, _LAND_SHARES = (0.05, 0.28), (0.45, 1.0)
_N_COLOURS = 256
_EARTH_RADII = (6.35e6, 6.39e6)


def colours_of_heights(
    cmap: str | None, low: float, high: float, unit: float, *, is_earth: bool
) -> Any:
    """Return the colour map of heights from `low` to `high`, of `unit` metres each.

    `unit` is negative for depths: the largest is then the lowest place. None as `cmap` is
    gist_earth: only its land, or on the Earth also its sea below 0 if heights are lower than all
    dry land.
    """
    pyplot = need("matplotlib.pyplot", extra="demo")
    if cmap is not None:
        return pyplot.get_cmap(cmap)
    if unit < 0:
        turned = colours_of_heights(None, -high, -low, -unit, is_earth=is_earth)
        return turned.reversed("heights")
    heights, whole = np.linspace(low, high, _N_COLOURS), pyplot.get_cmap("gist_earth")
    shares = np.interp(heights, (low, high), _LAND_SHARES)
    if is_earth and low * unit < _DEEPEST_LAND:
        land = np.interp(heights, (0, max(high, 1.0)), _LAND_SHARES)
        shares = np.where(heights < 0, np.interp(heights, (low, 0), _SEA_SHARES), land)
    colors = need("matplotlib.colors", extra="demo")
    return colors.ListedColormap(whole(shares), name="heights")


def plot(mesh: MeshData, ax: Any, *, wireframe: bool, cmap: str | None) -> Any:
    pyplot = need("matplotlib.pyplot", extra="demo")
    collections = need("matplotlib.collections", extra="demo")

    if not mesh.n_triangles:
        raise InvalidHeightsError("the mesh is empty: there is nothing to draw")
    if ax is None:
        _, ax = pyplot.subplots()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        place = find_place(mesh)
        unit, word = mesh_unit(mesh).metres, mesh_unit(mesh).word
    left, bottom, right, top = mesh.bounds
    stretch = 1.0
    per_x = per_y = place.unit
    if place.in_degrees:
        latitude = place.latitude((left + right) / 2, (bottom + top) / 2)
        stretch = math.cos(math.radians(min(abs(latitude), 85.0)))
        per_y = math.radians(place.unit) * place.ellipsoid.axis
        per_x = per_y * stretch
    corners = mesh.points[mesh.triangles[areas(mesh) > 0]]
    brightness = _brightness(corners * (per_x, per_y, unit))
    heights = corners[:, :, 2].mean(axis=1)
    low, high = float(heights.min()), float(heights.max())
    axis = place.ellipsoid.axis
    is_earth = mesh.crs is not None and _EARTH_RADII[0] <= axis <= _EARTH_RADII[1]
    scale = colours_of_heights(cmap, low, high, unit, is_earth=is_earth)
    colours = scale((heights - low) / ((high - low) or 1.0))
    colours[:, :3] *= brightness[:, np.newaxis]
    # Edges in the faces' own colour close the hairlines between neighbours.
    edges: dict[str, Any] = _EDGE if wireframe else {"edgecolors": "face", "linewidths": 0.1}
    ax.add_collection(collections.PolyCollection(corners[:, :, :2], facecolors=colours, **edges))
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    ax.set_aspect(1 / stretch)
    label_axes(ax, *_labels(mesh))
    norm = need("matplotlib.colors", extra="demo").Normalize(low, high if high > low else low + 1)
    add_colour_bar(ax, norm, scale, mesh.units, word)
    return ax


def _labels(mesh: MeshData) -> tuple[str, str]:
    frame = mesh.attributes.get("frame", {}).get("name", "native")
    if frame == "native":
        return axis_labels(mesh.crs, is_placed=mesh.attributes.get("is_placed") is not False)
    return ("x, m", "y, m") if frame == "ecef" else ("east, m", "north, m")


def label_axes(ax: Any, x: str, y: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    with contextlib.suppress(AttributeError, TypeError):  # axes with ticks of their own
        ax.ticklabel_format(style="plain", useOffset=False)
        ax.locator_params(axis="x", nbins=5)  # eastings have many digits


def add_colour_bar(ax: Any, norm: Any, cmap: Any, units: str | None, word: str) -> None:
    pyplot = need("matplotlib.pyplot", extra="demo")
    scale = pyplot.cm.ScalarMappable(norm=norm, cmap=cmap)
    ax.figure.colorbar(scale, ax=ax, shrink=0.8, label=f"{word}, {unit_text(units)}")


def _brightness(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Lambert's cosine of each triangle, 1 on level ground at most."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    direct = np.clip((normals * _LIGHT).sum(axis=1) / _LIGHT[2], 0, 1)
    shade: NDArray[np.float64] = _AMBIENT + (1 - _AMBIENT) * direct
    return shade
