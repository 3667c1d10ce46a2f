"""Conversion of longitudes and latitudes to samples by polynomials, without a projection library.

Rows and columns of a full grid are smooth functions of longitude and latitude wherever the
projection is smooth. They are interpolated at Chebyshev nodes of the raster's extent, negligible
coefficients are dropped, and the result is compared with PROJ at other points: the error is
measured, not proved. A reader evaluates sums of products (docs/decisions/0014).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError
from terrainwave.globe.lonlat import Extent, Globe

Numbers = NDArray[np.float64]

# Nodes along each axis: the polynomials' degree is at most one less.
_N_NODES = 65
# Points along each axis used for the comparison.
_N_CHECKED = 150
# Samples. Coefficients with a smaller sum are dropped; a larger error is refused.
_DROPPED, MAX_ERROR = 1e-5, 0.05
# Share of the extent by which the polynomials reach beyond it, as its sides may bulge.
_BEYOND = (1e-3, 0.0)


@dataclass(frozen=True)
class FittedPlaces:
    """Rows and columns of a full grid as polynomials of longitude and latitude."""

    domain: Extent  # degrees that map to the arguments -1 … 1 of the polynomials
    # shape (n_lat, n_lon); coefficients of products of Chebyshev polynomials. If the raster's rows
    # are parallels, columns of another turn differ by `Globe.turn`.
    rows: Numbers
    cols: Numbers
    # samples. Largest difference from PROJ's rows and columns within the raster, found at 22,500
    # points.
    error: float

    def as_json(self, globe: Globe) -> dict[str, Any]:
        """Return the globe's fields for the reader in JavaScript (js/map/globe.js)."""
        return {
            "domain": list(self.domain),
            "rows": self.rows.tolist(),
            "cols": self.cols.tolist(),
            "turn": globe.turn,
            "goes_round": globe.is_whole_turn,
            "error_samples": self.error,
            "metres": globe.metres,
            "radii": globe.has_radii,
            "pixel": globe.pixel,
            "axis": globe.ellipsoid.axis,
            "polar_axis": globe.ellipsoid.axis * math.sqrt(1 - globe.ellipsoid.e2),
        }


def fit_places(globe: Globe) -> FittedPlaces:
    """Return the rows and columns of a globe's raster as polynomials of longitude and latitude.

    Raises `InvalidHeightsError` where they differ by more than `MAX_ERROR` samples: for a
    projection that is interrupted, or undefined somewhere in the raster's extent.
    """
    found = [_fitted(globe, domain) for domain in _domains(globe.extent)]
    best = min(found, key=lambda places: places.error)
    if not best.error <= MAX_ERROR:
        raise InvalidHeightsError(
            "the raster's coordinate reference system is not smooth enough to be told by"
            f" polynomials: they are {best.error:.3g} samples off, expected at most {MAX_ERROR};"
            " warp the raster to EPSG:4326 first"
        )
    return best


def _domains(extent: Extent) -> list[Extent]:
    west, south, east, north = extent
    found = []
    for beyond in _BEYOND:
        # Whole turns end where they begin: nothing is beyond.
        across = beyond * (east - west) if east - west < 359 else 0.0
        down = beyond * (north - south)
        found.append(
            Extent(west - across, max(south - down, -90), east + across, min(north + down, 90))
        )
    return found


def _fitted(globe: Globe, domain: Extent) -> FittedPlaces:
    nodes = np.cos(np.pi * (np.arange(_N_NODES) + 0.5) / _N_NODES)
    basis = chebyshev.chebvander(nodes, _N_NODES - 1)
    # Discrete orthogonality of Chebyshev polynomials at their nodes.
    weights = np.full(_N_NODES, 2 / _N_NODES)
    weights[0] /= 2
    inverse = weights[:, None] * basis.T
    values = _samples_at(globe, domain, nodes)
    rows, cols = (_without_small(inverse @ value @ inverse.T) for value in values)
    return FittedPlaces(domain, rows, cols, _measured_error(globe, domain, rows, cols))


def _grid(domain: Extent, at: Numbers) -> tuple[Numbers, Numbers]:
    """Return longitudes and latitudes of all pairs of arguments, of shape (n_lat, n_lon)."""
    west, south, east, north = domain
    lon, lat = np.meshgrid(
        (west + east + at * (east - west)) / 2, (south + north + at * (north - south)) / 2
    )
    return lon, lat


def _samples_at(globe: Globe, domain: Extent, at: Numbers) -> tuple[Numbers, Numbers]:
    """Return rows and columns at all pairs of arguments; columns continue beyond a turn."""
    lon, lat = _grid(domain, at)
    rows, cols = globe.continued_samples(lon.ravel(), lat.ravel())
    if globe.turn is not None:
        sign = math.copysign(1, globe.terrain.raster_info.transform[0])
        turns = (cols - cols[0]) / globe.turn
        expected = sign * (lon - lon[0, 0]).ravel() / 360
        cols = cols + np.rint(expected - turns) * globe.turn
    return rows.reshape(lon.shape), cols.reshape(lon.shape)


def _without_small(coefficients: Numbers) -> Numbers:
    """Return coefficients without the last rows and columns whose sum is negligible."""
    sizes = np.abs(coefficients)
    if not np.isfinite(sizes).all():
        return np.full((1, 1), np.nan)
    n_rows, n_cols = (
        max(int(np.sum(np.cumsum(sizes.sum(axis=axis)[::-1]) > _DROPPED)), 1) for axis in (1, 0)
    )
    return np.ascontiguousarray(coefficients[:n_rows, :n_cols])


def _measured_error(globe: Globe, domain: Extent, rows: Numbers, cols: Numbers) -> float:
    """Return the largest difference from PROJ within the raster.

    Infinite if PROJ has no position, or another point has the same samples.
    """
    at = (2 * np.arange(_N_CHECKED) + 1) / _N_CHECKED - 1
    there = _samples_at(globe, domain, at)
    if not (np.isfinite(there).all() and np.isfinite(rows).all() and np.isfinite(cols).all()):
        return math.inf
    found = [
        chebyshev.chebvander(at, table.shape[0] - 1)
        @ table
        @ chebyshev.chebvander(at, table.shape[1] - 1).T
        for table in (rows, cols)
    ]
    distances = [np.abs(one - other) for one, other in zip(there, found, strict=True)]
    if globe.turn is not None:
        away = np.mod(distances[1], globe.turn)
        distances[1] = np.minimum(away, globe.turn - away)
    lon, lat = _grid(domain, at)
    is_in_raster = np.isfinite(globe.to_samples(lon.ravel(), lat.ravel())[0]).reshape(lon.shape)
    if (_lie_in(globe, there, -0.25) & ~is_in_raster).any():
        return math.inf
    is_near = _lie_in(globe, there, 1.0) | _lie_in(globe, (found[0], found[1]), 1.0)
    return float(np.max(distances, where=is_near, initial=0.0))


def _lie_in(globe: Globe, places: tuple[Numbers, Numbers], beyond: float) -> NDArray[np.bool_]:
    """Return which samples lie within the raster's pixels and `beyond` around them."""
    n_rows, n_cols = globe.terrain.shape
    rows, cols = places
    if globe.turn is not None:
        start = (n_cols - 1 - globe.turn) / 2
        cols = start + np.mod(cols - start, globe.turn)
    is_in: NDArray[np.bool_] = (
        (rows >= -0.5 - beyond)
        & (rows <= n_rows - 0.5 + beyond)
        & (cols >= -0.5 - beyond)
        & (cols <= n_cols - 0.5 + beyond)
    )
    return is_in
