"""Comparison of a file's raster metadata with the original's."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from rasterio.crs import CRS

from terrainwave.place.crs import parse_crs
from terrainwave.place.units import height_unit, meeting
from terrainwave.raster_io.dataset import is_placed
from terrainwave.verification.original import Original, as_stored

# Metadata that the raster of a part need not share with the file.
_OF_WHOLE = ("size", "description", "AREA_OR_POINT")


def metadata_problems(terrain: Any, original: Original, *, part: bool = False) -> Iterator[str]:
    """Yield differences of metadata; for the raster of a `part`, of those that affect heights."""
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
        # Area is GDAL's default, and is not stored in a GeoTIFF without georeference.
        ("AREA_OR_POINT", info.area_or_point or "Area", original.area_or_point()),
    ]
    unit, own_unit = original.unit().name, info.units or None
    problem = unit_problem(terrain, original)
    if problem:
        yield problem
    elif (own_unit is None) != (unit is None) and not part:
        yield f"units is {own_unit!r}, the original's is {unit!r}"
    for name, found, expected in pairs:
        if found != expected and not (part and name in _OF_WHOLE):
            hint = " (with `part` only what it covers is compared)" if name == "size" else ""
            hint = hint if np.less_equal(original.shape, terrain.shape).all() else ""
            yield f"{name} is {found!r}, the original's is {expected!r}{hint}"
    other_kind = original.kind_problem(terrain)
    if other_kind is not None:
        yield f"the original's numbers mean something else: {other_kind}"
    if part:
        yield from _compare_crs_of_part(terrain, dataset.crs)
        return
    if not _same_nodata(terrain.nodata, original.nodata, original.dtype):
        yield f"nodata is {terrain.nodata!r}, the original's is {original.nodata!r}"
    found, expected = tuple(terrain.transform)[:6], original.transform
    if found != expected:
        yield f"the transform is {found}, the original's is {expected}"
    # Without georeference a file keeps no CRS.
    if terrain.crs or is_placed(dataset):
        epoch, expected_epoch = info.coordinate_epoch, original.coordinate_epoch()
        if epoch != expected_epoch:
            yield f"the coordinate epoch is {epoch}, the original's is {expected_epoch}"
        yield from _compare_crs(terrain.crs, dataset.crs)


def place_problem(terrain: Any, original: Original) -> str:
    if original.place is not None:
        return ""
    n_rows, n_cols = original.shape
    return (
        f"the original does not lie on the file's grid, or reaches beyond the file: found {n_rows}"
        f" x {n_cols} samples with the transform {original.transform}, expected a part of"
        f" {terrain.shape[0]} x {terrain.shape[1]} with {tuple(terrain.transform)[:6]}, moved by"
        " whole pixels"
    )


def unit_problem(terrain: Any, original: Original) -> str:
    unit = height_unit(terrain.info().units, terrain.crs)
    return meeting("the original", original.unit(), "the file", unit).problem


def _same_nodata(nodata: Any, expected: Any, dtype: np.dtype[Any]) -> bool:
    if expected is not None and dtype.kind != "f":
        limits = np.iinfo(dtype)
        # No sample can equal such a value, so the file has none.
        if not (math.isfinite(expected) and limits.min <= expected <= limits.max):
            expected = None
        elif expected != int(expected):
            expected = None
    if nodata is None or expected is None:
        return nodata is None and expected is None
    if math.isnan(nodata) or math.isnan(expected):
        return math.isnan(nodata) and math.isnan(expected)
    return bool(as_stored(nodata, dtype) == as_stored(expected, dtype))


def _compare_crs_of_part(terrain: Any, found: CRS | None) -> Iterator[str]:
    expected = terrain.raster_info.rasterio_crs()
    if (found or None) != expected:
        yield f"the CRS is {terrain.crs or 'missing'}, the original's is {found or 'missing'}"


def _compare_crs(crs: Any, expected: CRS | None) -> Iterator[str]:
    if not crs or not expected:
        if bool(crs) != bool(expected):
            yield f"the CRS is {crs or 'missing'}, the original's is {expected or 'missing'}"
        return
    # Compared by WKT: rasterio's == equates systems whose ellipsoids differ in late digits. A
    # string is from the file, hence parse_crs: rasterio would follow a URL in it.
    crs = parse_crs(crs) if isinstance(crs, str) else crs
    if crs is None or crs.to_wkt() != expected.to_wkt():
        crs_text = "not understood" if crs is None else crs.to_wkt()
        yield f"the CRS is {crs_text}, the original's is {expected.to_wkt()}"
