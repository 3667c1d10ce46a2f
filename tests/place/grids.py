"""Grids of geoids that tests write, by the names that PROJ asks for."""

import struct

import numpy as np
import rasterio

# Degrees: of all grids here.
WEST, SOUTH, STEP, N_LON, N_LAT = 5.0, 40.0, 0.5, 31, 25


def undulation(lon, lat):
    """Return metres from the ellipsoid to the geoid: a plane, which PROJ's bilinear way keeps."""
    return 40.0 + 2.0 * (np.asarray(lon) - 10.0) + 3.0 * (np.asarray(lat) - 46.0)


def write_gtx(path):
    """Write the grid as NOAA's format has it: rows from the south, big-endian."""
    lon, lat = np.meshgrid(WEST + STEP * np.arange(N_LON), SOUTH + STEP * np.arange(N_LAT))
    head = struct.pack(">4d2i", SOUTH, WEST, STEP, STEP, N_LAT, N_LON)
    path.write_bytes(head + undulation(lon, lat).astype(">f4").tobytes())


def write_geotiff(path):
    """Write the grid as PROJ's own format has it (Geodetic TIFF grids)."""
    north = SOUTH + STEP * (N_LAT - 1)
    lon, lat = np.meshgrid(WEST + STEP * np.arange(N_LON), north - STEP * np.arange(N_LAT))
    transform = rasterio.Affine(STEP, 0, WEST - STEP / 2, 0, -STEP, north + STEP / 2)
    with rasterio.open(
        path, "w", driver="GTiff", width=N_LON, height=N_LAT, count=1, dtype="float32",
        crs="EPSG:4326", transform=transform,
    ) as dataset:  # fmt: skip
        dataset.write(undulation(lon, lat).astype(np.float32), 1)
        dataset.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
        dataset.set_band_description(1, "geoid_undulation")
        dataset.units = ("metre",)
