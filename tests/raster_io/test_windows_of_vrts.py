"""Rasters whose heights depend on the windows that are read: a note says so, and what to do."""

import warnings

import pytest
import rasterio
import rasterio.shutil
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from strategies import terrain_like, write_geotiff

from terrainwave.raster_io.source import RasterSource

DEPEND = "its heights depend on the windows that are read"
NESTED = """<VRTDataset rasterXSize="20" rasterYSize="20"><SRS>EPSG:3857</SRS>
<GeoTransform>1001875,14,0,5645715,0,-14</GeoTransform>
<VRTRasterBand dataType="Float32" band="1"><NoDataValue>-9999</NoDataValue>
<SimpleSource{}><SourceFilename relativeToVRT="1">{}</SourceFilename><SourceBand>1</SourceBand>
<SrcRect xOff="0" yOff="0" xSize="{}" ySize="20"/><DstRect xOff="0" yOff="0" xSize="20" ySize="20"/>
</SimpleSource></VRTRasterBand></VRTDataset>"""


@pytest.fixture
def dem(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = {"crs": "EPSG:32632", "transform": Affine(10, 0, 5e5, 0, -10, 5e6)}
    write_geotiff("dem.tif", terrain_like(40, 40, "float32"), nodata=-9999, **place)
    return "dem.tif"


def warped(dem, **options):
    return WarpedVRT(rasterio.open(dem), crs="EPSG:3857", **options)


def written(name, dem, **options):
    """Write a warped VRT to a file; return its name."""
    with warped(dem, **options) as vrt:
        rasterio.shutil.copy(vrt, name, driver="VRT")
    return name


def nested(name, source, resampling="", size=20):
    with open(name, "w") as file:
        file.write(NESTED.format(resampling, source, size))
    return name


def notes_of(source):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with RasterSource(source) as opened:
            return [note for note in opened.notes if DEPEND in note]


def test_warped_vrts_are_noted_also_below_others(dem):
    inner = written("warped.vrt", dem)
    outer = nested("nested.vrt", inner)
    for name in (inner, outer, nested("twice.vrt", outer), f"vrt://{outer}", "renamed.tif"):
        if name == "renamed.tif":
            rasterio.shutil.copy(inner, "again.vrt", driver="VRT")
            with open("again.vrt") as file, open(name, "w") as other:
                other.write(file.read())
        (note,) = notes_of(name)
        assert "gdalwarp -et 0" in note


def test_exact_warps_and_plain_mosaics_are_not_noted(dem):
    exact = written("exact.vrt", dem, tolerance=0)
    plain = nested("plain.vrt", dem, ' resampling="bilinear"')
    for name in (dem, exact, nested("nested.vrt", exact), plain):
        assert notes_of(name) == []
    with warped(dem, tolerance=0) as vrt:
        assert notes_of(vrt) == []


def test_sources_that_are_resampled_with_weights_are_noted(dem):
    assert "resamples" in notes_of(nested("a.vrt", dem, ' resampling="bilinear"', 13))[0]
    assert notes_of(nested("b.vrt", dem, ' resampling="nearest"', 13)) == []
    # as gdal_translate -srcwin 0.4 … -r bilinear writes it
    with open(nested("c.vrt", dem, ' resampling="bilinear"')) as file:
        moved = file.read().replace('SrcRect xOff="0"', 'SrcRect xOff="0.4"')
    with open("c.vrt", "w") as file:
        file.write(moved)
    assert "resamples" in notes_of("c.vrt")[0]
