"""A .twz file as an item of a SpatioTemporal Asset Catalog (STAC 1.1.0)."""

import hashlib
import os
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from terrainwave.container.header import MEDIA_TYPE
from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.file import TerrainFile
from terrainwave.globe.lonlat import Globe
from terrainwave.place.meaning import HEIGHT

VERSION = "1.1.0"
# Bound, method, levels and root: stac/ of the repository describes it.
EXTENSION = "urn:terrainwave:stac-extension:v1.0.0"
Ring = list[list[float]]
_EXTENSIONS = (
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "https://stac-extensions.github.io/raster/v2.0.0/schema.json",
    "https://stac-extensions.github.io/file/v2.1.0/schema.json",
    EXTENSION,
)
# Tags with a raster's date of measurement, the best first.
_DATES = ("ACQUISITION_DATE", "TIFFTAG_DATETIME")
# Points of an outline along each side of the raster.
_N_ALONG = 8
# Degrees of longitude: a wider raster has its box as outline.
_WIDE = 180
_POLE = 90
_SLACK = 1e-6
_CHUNK = 1 << 20
_DIGITS = 7  # of degrees: about a centimetre
_SHA256 = "1220"  # of a multihash: its code and its length


def stac_item(terrain: TerrainFile, href: str | None = None) -> dict[str, Any]:
    """Return a STAC item of a file: outline, CRS, resolution, bound, root, checksum; plain values.

    Reads all bytes of the file, for the checksum. `href` is the address of the file in the item; by
    default as it was opened. Raises `InvalidHeightsError` if the raster has no position on a globe.
    """
    info, name = terrain.info(), str(terrain.name)
    globe = Globe(terrain)
    geometry, bbox = _outline(globe)
    source = terrain.container.source
    metres = float(f"{globe.pixel:.6g}")
    band = {
        "data_type": info.dtype,
        "nodata": str(info.nodata) if info.nodata != info.nodata else info.nodata,
        "unit": info.units,
        "statistics": _statistics(terrain),
        "raster:scale": info.scale if info.scale != 1 else None,
        "raster:offset": info.offset or None,
        "raster:spatial_resolution": metres,
        "raster:sampling": (info.area_or_point or "Area").lower(),
    }
    properties = {
        "datetime": _datetime(info.tags, name),
        "gsd": metres,
        **_crs(terrain),
        "proj:shape": [info.n_rows, info.n_cols],
        "proj:transform": list(info.transform),
        # In metres on the globe; in the unit of the heights if that is unknown.
        "terrainwave:max_error": globe.effective_error,
        "terrainwave:bound": info.bound,
        # Meaning of the statistics; heights are the default.
        "terrainwave:heights_are": None if info.heights_are == HEIGHT else info.heights_are,
        "terrainwave:method": info.method,
        "terrainwave:levels": info.n_levels,
        "terrainwave:root": terrain.digest(),
    }
    asset = {
        "href": href or name,
        "type": MEDIA_TYPE,
        "roles": ["data"],
        "file:size": source.size,
        "file:checksum": _checksum(source),
        "bands": [_without_nothing(band)],
    }
    known = _without_nothing(properties) | {"datetime": properties["datetime"]}
    return {
        "type": "Feature",
        "stac_version": VERSION,
        "stac_extensions": list(_EXTENSIONS),
        "id": Path(name).stem,
        "geometry": geometry,
        "bbox": bbox,
        "properties": known,
        "links": [],
        "assets": {"data": asset},
    }


def _statistics(terrain: TerrainFile) -> dict[str, float] | None:
    """Return the range of pixels, before scale and offset (like nodata); None if all are void."""
    header = terrain.header
    if header.z_min > header.z_max:
        return None
    height_of = terrain.quantizer.height_of
    return {"minimum": height_of(header.z_min), "maximum": height_of(header.z_max)}


def _crs(terrain: TerrainFile) -> dict[str, str]:
    """Return the CRS by its code, else as WKT2."""
    text, crs = terrain.crs or "", terrain.raster_info.rasterio_crs()
    if re.fullmatch(r"[A-Za-z0-9_]+:[A-Za-z0-9.]+", text):
        return {"proj:code": text}
    return {} if crs is None else {"proj:wkt2": crs.to_wkt(version="WKT2_2019")}


def _without_nothing(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if value is not None}


def _datetime(tags: Mapping[str, str], name: str) -> str:
    """Return the raster's date from a tag; else the time of the file, or of reading."""
    for key in _DATES:
        for form in ("%Y:%m:%d %H:%M:%S", "%Y-%m-%d %H:%M:%S", "%Y-%m-%d"):
            try:
                found = datetime.strptime(tags.get(key, ""), form)
            except ValueError:
                continue
            return found.replace(tzinfo=UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    try:
        seconds = os.stat(name).st_mtime
    except OSError:  # a URL, or bytes
        return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _checksum(source: ByteSource) -> str:
    digest = hashlib.sha256()
    for start in range(0, source.size, _CHUNK):
        digest.update(source.read(start, min(_CHUNK, source.size - start)))
    return _SHA256 + digest.hexdigest()


def _outline(globe: Globe) -> tuple[dict[str, Any], list[float]]:
    """Return the raster's outline in longitude and latitude, and its box.

    The outline is the box if a raster crosses 180 degrees, which cuts it in two, or holds a pole or
    a whole parallel.
    """
    west, south, east, north = globe.extent
    if east > 180:
        boxes = [(west, south, 180.0, north), (-180.0, south, east - 360, north)]
        rings = [[_ring_of_box(*box)] for box in boxes]
        bbox = [west, south, east - 360, north]
        return {"type": "MultiPolygon", "coordinates": rings}, [_rounded(edge) for edge in bbox]
    ring = _ring_of_box(west, south, east, north)
    if east - west < _WIDE and max(abs(south), abs(north)) < _POLE:
        ring = _ring_of_raster(globe) or ring
    bbox = [west, south, east, north]
    return {"type": "Polygon", "coordinates": [ring]}, [_rounded(edge) for edge in bbox]


def _ring_of_box(west: float, south: float, east: float, north: float) -> Ring:
    corners = [(west, south), (east, south), (east, north), (west, north), (west, south)]
    return [[_rounded(lon), _rounded(lat)] for lon, lat in corners]


def _ring_of_raster(globe: Globe) -> Ring | None:
    """Return points along the outer edges of a raster's pixels; None if one has no position."""
    n_rows, n_cols = globe.terrain.shape
    along = np.linspace(0, 1, _N_ALONG, endpoint=False)
    zero, one = np.zeros(_N_ALONG), np.ones(_N_ALONG)
    rows = np.concatenate([one, 1 - along, zero, along]) * n_rows - 0.5
    cols = np.concatenate([along, one, 1 - along, zero]) * n_cols - 0.5
    lon, lat = globe.from_samples(rows, cols)
    if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
        return None
    lon = globe.extent.west + np.mod(lon - globe.extent.west + _SLACK, 360) - _SLACK
    ring = [[_rounded(x), _rounded(y)] for x, y in zip(lon.tolist(), lat.tolist(), strict=True)]
    turns = sum(
        (b[0] - a[0]) * (b[1] + a[1]) for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)
    )
    if turns > 0:  # GeoJSON requires counterclockwise outlines
        ring.reverse()
    return [*ring, ring[0]]


def _rounded(degrees: float) -> float:
    return round(float(degrees), _DIGITS)
