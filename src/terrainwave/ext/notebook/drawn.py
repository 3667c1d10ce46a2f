"""Window drawn on a map: conversion between a box of longitudes and latitudes and samples."""

import math
from typing import Any

import numpy as np

from terrainwave.arguments import checked_numbers
from terrainwave.errors import InvalidArgumentError
from terrainwave.globe.lonlat import Extent, Globe
from terrainwave.grid.quadtree import Region

# Points along the sides of a box used to find its samples, and along those of a window for its
# outline.
_N_ACROSS, _N_ALONG = 129, 33
# Share of a box by which its outermost points lie inside, at the end of a turn.
_INSIDE = 1e-9


def region_of_box(globe: Globe, box: Any) -> Region:
    """Return the samples of the full grid whose pixels touch a box in degrees, clipped.

    In a raster around the whole globe, a box across its first column is reduced to its larger part.
    Raises `InvalidArgumentError` if it is not a box, or does not overlap the raster.
    """
    west, south, east, north = checked_numbers("box", box, "west, south, east, north")
    if not (west <= east <= west + 360 and -90 <= south <= north <= 90):
        raise InvalidArgumentError(
            f"found `box` {box}, expected degrees: west <= east, south <= north"
        )
    cut = _cut(globe.extent, Extent(west, south, east, north))
    region = Region(0, 0, 0, 0) if cut is None else _samples(globe, cut)
    if not all(region.shape):
        raise InvalidArgumentError(
            "the window does not overlap the terrain: draw it over the terrain"
        )
    return region


def _cut(extent: Extent, box: Extent) -> Extent | None:
    parts = []
    for turn in range(-3, 4):  # maps count turns
        west = max(extent.west, box.west + 360 * turn)
        parts.append((min(extent.east, box.east + 360 * turn) - west, west))
    width, west = max(parts)
    south, north = max(extent.south, box.south), min(extent.north, box.north)
    if width < 0 or south > north:
        return None
    return Extent(west, south, west + width, north)


def _samples(globe: Globe, box: Extent) -> Region:
    across = np.clip(np.linspace(0, 1, _N_ACROSS), _INSIDE, 1 - _INSIDE)
    lon, lat = np.meshgrid(
        box.west + across * (box.east - box.west), box.south + across * (box.north - box.south)
    )
    rows, cols = globe.continued_samples(lon.ravel(), lat.ravel())
    known = np.isfinite(rows) & np.isfinite(cols)
    whole = Region(0, 0, *globe.terrain.shape)
    if not known.any():
        return Region(0, 0, 0, 0)
    ends = []
    for places, n_samples in zip((rows[known], cols[known]), globe.terrain.shape, strict=True):
        # Samples are pixel centres; positions beyond the raster are clipped.
        held = np.clip(places, -2, n_samples + 1)
        ends.append((math.floor(held.min() + 0.5), math.ceil(held.max() - 0.5)))
    (first_row, last_row), (first_col, last_col) = ends
    found = Region(first_row, first_col, last_row - first_row + 1, last_col - first_col + 1)
    return found.intersect(whole)


def outline(globe: Globe, region: Region) -> list[list[float]]:
    row, col, n_rows, n_cols = region
    along = np.linspace(0, 1, _N_ALONG)
    still = np.zeros(_N_ALONG)
    down = np.concatenate([still, along, still + 1, along[::-1]])
    right = np.concatenate([along, still + 1, along[::-1], still])
    lon, lat = globe.from_samples(row - 0.5 + n_rows * down, col - 0.5 + n_cols * right)
    known = np.isfinite(lon) & np.isfinite(lat)
    lon = np.unwrap(lon[known], period=360)
    places = np.round(np.stack([lon, lat[known]], axis=1), 7)
    return [[float(x), float(y)] for x, y in places]
