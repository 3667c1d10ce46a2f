"""Compare what a file says of its raster with what the original says."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from rasterio.crs import CRS

from terrainwave.place.crs import parse_crs
from terrainwave.place.units import height_unit, meeting
from terrainwave.raster_io.dataset import is_placed
from terrainwave.verification.original import Original, as_stored


def metadata_problems(terrain: Any, original: Original) -> Iterator[str]:
    """Yield what a file says of its raster that the original does not."""
    dataset, index = original.dataset, original.band - 1
    info = terrain.info()
    if terrain.effective_error > terrain.max_error * (1 + 1e-12):
        yield (
            f"the file states an effective error of {terrain.effective_error}, above the"
            f" {terrain.max_error} it was asked for"
        )
    pairs = [
        ("size", tuple(terrain.shape), (dataset.height, dataset.width)),
        ("type", np.dtype(terrain.dtype).name, original.dtype.name),
        ("scale", float(info.scale), original.scale),
        ("offset", float(info.offset), float(dataset.offsets[index])),
        ("description", info.description or None, dataset.descriptions[index] or None),
        # Area is GDAL's default, and not kept by a GeoTIFF that lies nowhere.
        ("AREA_OR_POINT", info.area_or_point or "Area", original.area_or_point()),
    ]
    unit, own_unit = original.unit().name, info.units or None
    problem = unit_problem(terrain, original)
    if problem:
        yield problem
    elif (own_unit is None) != (unit is None):
        yield f"units is {own_unit!r}, the original's is {unit!r}"
    for name, found, expected in pairs:
        if found != expected:
            yield f"{name} is {found!r}, the original's is {expected!r}"
    other_kind = original.kind_problem(terrain.raster_info)
    if other_kind is not None:
        yield f"the original's numbers mean something else: {other_kind}"
    if not _same_nodata(terrain.nodata, original.nodata, original.dtype):
        yield f"nodata is {terrain.nodata!r}, the original's is {original.nodata!r}"
    found, expected = tuple(terrain.transform)[:6], tuple(dataset.transform)[:6]
    if found != expected:
        yield f"the transform is {found}, the original's is {expected}"
    # Of samples that lie nowhere a file keeps no CRS.
    if terrain.crs or is_placed(dataset):
        yield from _compare_crs(terrain.crs, dataset.crs)


def unit_problem(terrain: Any, original: Original) -> str:
    """Return why heights cannot be compared: they are in different units; empty if they can."""
    unit = height_unit(terrain.info().units, terrain.crs)
    return meeting("the original", original.unit(), "the file", unit).problem


def _same_nodata(nodata: Any, expected: Any, dtype: np.dtype[Any]) -> bool:
    if expected is not None and dtype.kind != "f":
        limits = np.iinfo(dtype)
        # No sample can equal such a value; the file rightly has none.
        if not (math.isfinite(expected) and limits.min <= expected <= limits.max):
            expected = None
        elif expected != int(expected):
            expected = None
    if nodata is None or expected is None:
        return nodata is None and expected is None
    if math.isnan(nodata) or math.isnan(expected):
        return math.isnan(nodata) and math.isnan(expected)
    return bool(as_stored(nodata, dtype) == as_stored(expected, dtype))


def _compare_crs(crs: Any, expected: CRS | None) -> Iterator[str]:
    if not crs or not expected:
        if bool(crs) != bool(expected):
            yield f"the CRS is {crs or 'missing'}, the original's is {expected or 'missing'}"
        return
    # Equal by WKT: rasterio's == calls systems the same whose ellipsoids differ in late digits.
    # A string is from the file, hence parse_crs: rasterio would follow a URL in it.
    crs = parse_crs(crs) if isinstance(crs, str) else crs
    if crs is None or crs.to_wkt() != expected.to_wkt():
        crs_text = "not understood" if crs is None else crs.to_wkt()
        yield f"the CRS is {crs_text}, the original's is {expected.to_wkt()}"
