"""Check of a GeoTIFF's georeference: GDAL's writer cannot hold every CRS.

Systems with rotated poles, axes to the west, or vertical systems without a code come back changed
or not at all. So the file is opened again, and differences are written to the .aux.xml next to it.
"""

import os
import warnings
from dataclasses import replace

from rasterio.crs import CRS
from rasterio.errors import CRSError

from terrainwave.errors import TerrainwaveWarning
from terrainwave.file import TerrainFile
from terrainwave.place.description import Description, read_projjson
from terrainwave.raster_io.geotiff.sink import (
    SIDECAR,
    crs_of_geotiff,
    read_place,
    write_beside,
)
from terrainwave.raster_io.raster_info import RasterInfo

_SAME_FACTOR = 1e-7


def info_to_write(terrain: TerrainFile) -> RasterInfo:
    """Return the raster's metadata with the unit of its CRS if the band has none.

    Otherwise GDAL derives one from the vertical CRS as stored in the GeoTIFF, which may differ.
    """
    return replace(terrain.raster_info, units=terrain.units)


def keep_place(path: str | os.PathLike[str], info: RasterInfo) -> None:
    """Open a GeoTIFF that has just been finished; write missing metadata to the .aux.xml, and warn.

    `info` has the intended CRS and unit.
    """
    crs = _crs_of(info)
    if crs is None:
        return
    found = _differences(path, crs, info)
    if not found:
        return
    write_beside(path, crs, info.units, info.coordinate_epoch)
    still = _differences(path, crs, info)
    kept = (
        f"and is written into the {SIDECAR} beside it: keep both files together"
        if not still
        else f"and GDAL reads another one from the {SIDECAR} beside it, too ({', '.join(still)})"
    )
    warnings.warn(
        f"a GeoTIFF does not hold all of this coordinate reference system ({', '.join(found)});"
        f" it is kept in the .twz file {kept}",
        TerrainwaveWarning,
        stacklevel=3,
    )


def _differences(path: str | os.PathLike[str], crs: CRS, info: RasterInfo) -> list[str]:
    found, found_unit, epoch = read_place(path)
    differences, unit = crs_differences(crs, found), info.units
    if epoch != info.coordinate_epoch:
        differences.append(f"the coordinate epoch {info.coordinate_epoch:.10g} is lost")
    if unit is not None and found_unit != unit:
        differences.append(f"the unit {unit} becomes {found_unit or 'unknown'}")
    return differences


def _crs_of(info: RasterInfo) -> CRS | None:
    """Return the CRS without a warning, which writing the GeoTIFF has issued."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        found: CRS | None = info.rasterio_crs()
    return found


def crs_differences(wanted: CRS, found: CRS | None) -> list[str]:
    """Return the differences of a CRS from the intended one, in a few words each; not names."""
    if found is None:
        return ["it has none of it"]
    if found.to_wkt() == wanted.to_wkt():
        return []
    one, other = _described(wanted), _described(found)
    differences = []
    if one.kind != other.kind:
        differences.append(f"{one.kind} becomes {other.kind}")
    for name, a, b in (("x", one.x, other.x), ("y", one.y, other.y)):
        if a.direction != b.direction or abs(a.factor / b.factor - 1) > _SAME_FACTOR:
            differences.append(
                f"{name} goes {a.direction} in {a.unit}, becomes {b.direction} in {b.unit}"
            )
    differences += _vertical_differences(one, other)
    if not differences and found != wanted and _as_proj4(found) != _as_proj4(wanted):
        differences.append("the datum or the projection")
    return differences


def _vertical_differences(one: Description, other: Description) -> list[str]:
    a, b = one.vertical, other.vertical
    if a is None or b is None:
        if a is None and b is None:
            return []
        there = next(part.name for part in (a, b) if part is not None)
        return [f"the vertical system {there} is {'lost' if b is None else 'new'}"]
    differences = []
    if abs(a.metres / b.metres - 1) > _SAME_FACTOR:
        differences.append(f"the vertical unit {a.unit} becomes {b.unit}")
    if _plain(a.datum) != _plain(b.datum):
        differences.append(f"the vertical datum {a.datum or a.name} becomes {b.datum or b.name}")
    if (a.is_down, a.is_ellipsoidal) != (b.is_down, b.is_ellipsoidal):
        differences.append("the direction of heights")
    return differences


def _plain(name: str) -> str:
    return name.replace("_", " ").casefold()


def _described(crs: CRS) -> Description:
    try:
        return read_projjson(crs.to_dict(projjson=True))
    except (CRSError, ValueError, TypeError):
        return read_projjson({})


def _as_proj4(crs: CRS) -> str:
    """Return the CRS as a PROJ 4 string, in which equal systems of different names are equal."""
    try:
        text = str(crs.to_proj4())
    except CRSError:
        text = ""
    return text or str(crs.to_wkt())


def warn_of_crs(head: bytes, info: RasterInfo) -> None:
    """Warn of CRS properties that a GeoTIFF of this head without other files cannot hold."""
    crs = _crs_of(info)
    found = [] if crs is None else crs_differences(crs, crs_of_geotiff(head))
    if crs is not None and info.coordinate_epoch is not None:
        found.append(f"the coordinate epoch {info.coordinate_epoch:.10g} is lost")
    if found:
        warnings.warn(
            f"a GeoTIFF does not hold all of this coordinate reference system"
            f" ({', '.join(found)}); `decompress` writes it into a {SIDECAR} beside it",
            TerrainwaveWarning,
            stacklevel=3,
        )
