"""Rasters of every driver of GDAL that can write floats: what the driver keeps comes back.

The drivers are listed when the test runs. What one loses by itself shows in the file it wrote: that
is what results are compared with.
"""

import math
import warnings

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from rasterio._err import CPLE_BaseError
from rasterio.drivers import raster_driver_extensions
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from strategies import write_geotiff

import terrainwave
from terrainwave.raster_io.raster_info import SUPPORTED_DTYPES

# Where drivers ask for an ending that rasterio does not list.
ENDINGS = {
    "AAIGrid": ".asc", "BAG": ".bag", "ERS": ".ers", "GTX": ".gtx", "ILWIS": ".mpr", "KRO": ".kro",
    "LCP": ".lcp", "Leveller": ".ter", "MRF": ".mrf", "NWT_GRD": ".grd", "RMF": ".rsw",
    "ROI_PAC": ".dem", "RRASTER": ".grd", "RST": ".rst", "SAGA": ".sdat", "Terragen": ".ter",
}  # fmt: skip
SIDE = 60
ROWS, COLS = np.mgrid[:SIDE, :SIDE]
HEIGHTS = np.round(4 * (500 + 100 * np.sin(COLS / 9) + 50 * np.cos(ROWS / 7))) / 4
IS_VOID = np.abs(COLS - 30) + np.abs(ROWS - 20) < 8
UTM = {"crs": "EPSG:32633", "transform": Affine(30, 0, 500_000, 0, -30, 5_000_000)}
DEGREES = {"crs": "EPSG:4326", "transform": Affine(0.25, 0, 10, 0, -0.25, 50)}
CASES = {
    "utm-voids": ("float32", np.where(IS_VOID, -9999, HEIGHTS), {**UTM, "nodata": -9999}, "m"),
    "degrees": ("float64", HEIGHTS, DEGREES, "ft"),
    "utm-nan": ("float32", np.where(IS_VOID, np.nan, HEIGHTS), {**UTM, "nodata": math.nan}, None),
}
# What GDAL and rasterio raise where a driver cannot write floats, or read what it wrote.
FAILURES = (CPLE_BaseError, RasterioError, OSError, SystemError, ValueError, TypeError)


def copies(folder, base):
    """Yield each driver's name and the path of a raster that it made of `base` and GDAL reads."""
    known = {driver: f".{ending}" for ending, driver in raster_driver_extensions().items()}
    with rasterio.Env() as env:
        names = sorted(set(env.drivers()) - {"MEM", "Memory"})
    for name in names:
        for ending in dict.fromkeys((ENDINGS.get(name), known.get(name), ".bin")):
            path = folder / f"{name.replace(' ', '_')}{ending}"
            if ending is None:
                continue
            try:
                rasterio.shutil.copy(base, path, driver=name)
                with rasterio.open(path) as dataset:
                    is_raster = dataset.count == 1 and dataset.dtypes[0] in SUPPORTED_DTYPES
                    dataset.read(1)
            except FAILURES:
                continue
            if is_raster:
                yield name, path
                break


def described(path):
    """Return what a raster says, by rasterio alone: heights, valid, and all else."""
    with rasterio.open(path) as dataset:
        heights = dataset.read(1)
        valid = (dataset.read_masks(1) > 0) & ~np.isnan(heights.astype(float))
        return heights, valid, {
            "dtype": dataset.dtypes[0],
            "transform": tuple(dataset.transform),
            # What the driver of RST writes where there is none.
            "units": tuple(None if unit == "unspecified" else unit for unit in dataset.units),
            "scale": (dataset.scales, dataset.offsets),
        }  # fmt: skip


def crs_of(path):
    with rasterio.open(path) as dataset:
        return dataset.crs


def differences(path, twz, back):
    """Return what differs in a raster that came back."""
    (heights, valid, said), (found, is_valid, told) = described(path), described(back)
    wrong = {name: (said[name], told[name]) for name in said if said[name] != told[name]}
    if (valid != is_valid).any():
        wrong["voids"] = int((valid != is_valid).sum())
    elif (heights[valid] != found[valid]).any():
        wrong["heights"] = int((heights[valid] != found[valid]).sum())
    with terrainwave.open(twz) as terrain:
        kept = terrain.raster_info.rasterio_crs()
    if kept != crs_of(path):
        wrong["crs"] = (crs_of(path), kept)
    # The writer of GeoTIFFs takes the codes of some datums for what these are; what it does not
    # hold lies beside it.
    copy = back.with_name("copy.tif")
    rasterio.shutil.copy(path, copy, driver="GTiff")
    if crs_of(back) not in (crs_of(path), crs_of(copy)):
        wrong["written crs"] = (crs_of(copy), crs_of(back))
    return wrong


@pytest.mark.full
@pytest.mark.parametrize("case", CASES)
def test_rasters_of_every_driver_come_back(tmp_path, case):
    dtype, heights, place, unit = CASES[case]
    base = write_geotiff(tmp_path / "base.tif", heights.astype(dtype), **place)
    if unit is not None:
        with rasterio.open(base, "r+") as dataset:
            dataset.units = (unit,)
    wrong, names = {}, []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what GDAL and terrainwave say of each
        for name, path in copies(tmp_path, base):
            names.append(name)
            terrainwave.compress(path, tmp_path / "a.twz", max_error=0, overwrite=True)
            terrainwave.decompress(tmp_path / "a.twz", tmp_path / "back.tif", overwrite=True)
            if found := differences(path, tmp_path / "a.twz", tmp_path / "back.tif"):
                wrong[name] = found
    assert wrong == {}
    assert {"GTiff", "COG", "AAIGrid", "ENVI", "HFA", "netCDF", "VRT"} <= set(names)
    assert len(names) >= 20
