"""Coordinate epochs are kept; attribute tables, which are not, are named."""

import json
import re
import warnings

import pytest
import rasterio
import rasterio.shutil
from commands import run
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import TerrainwaveWarning
from terrainwave.raster_io.source import RasterSource

VRT = """<VRTDataset rasterXSize="9" rasterYSize="9">
<SRS dataAxisToSRSAxisMapping="2,1" coordinateEpoch="{}">EPSG:9000</SRS>
<GeoTransform>{},0.01,0,-30,0,-0.01</GeoTransform>
<VRTRasterBand dataType="Int16" band="1"><NoDataValue>-1</NoDataValue></VRTRasterBand></VRTDataset>
"""
TABLE = """<PAMDataset><PAMRasterBand band="1"><GDALRasterAttributeTable tableType="thematic">
<FieldDefn index="0"><Name>v</Name><Type>0</Type><Usage>0</Usage></FieldDefn>
<Row index="0"><F>1</F></Row></GDALRasterAttributeTable></PAMRasterBand></PAMDataset>"""


def dynamic(folder, name="a.tif", epoch=2020.5, left=140):
    """Write a GeoTIFF of a dynamic CRS at an epoch; return its path."""
    (folder / "a.vrt").write_text(VRT.format(epoch, left))
    rasterio.shutil.copy(folder / "a.vrt", folder / name, driver="GTiff")
    return folder / name


def epochs(path):
    """Return the epochs that GDAL finds, by a VRT copy."""
    with rasterio.open(path) as dataset, rasterio.MemoryFile(ext=".vrt") as memory:
        rasterio.shutil.copy(dataset, memory.name, driver="VRT")
        return re.findall(r'coordinateEpoch="([^"]*)"', bytes(memory.read()).decode())


@pytest.fixture
def twz(tmp_path):
    terrainwave.compress(dynamic(tmp_path), tmp_path / "a.twz", max_error=0, method="store")
    return tmp_path / "a.twz"


@pytest.mark.parametrize("cog", [False, True])
def test_an_epoch_comes_back_in_a_geotiff(tmp_path, twz, cog):
    back = tmp_path / "back.tif"
    with pytest.warns(TerrainwaveWarning, match=r"epoch 2020\.5.*\.aux\.xml beside it: keep both"):
        terrainwave.decompress(twz, back, cog=cog)
    assert epochs(back) == epochs(tmp_path / "a.tif") == ["2020.5"]
    terrainwave.compress(back, tmp_path / "again.twz", max_error=0, method="store")
    with terrainwave.open(tmp_path / "again.twz") as terrain:
        assert terrain.info().coordinate_epoch == 2020.5


def test_info_says_the_epoch(twz):
    assert re.search(r"epoch +2020\.5", run("info", twz).stdout)
    assert json.loads(run("info", twz, "--json").stdout)["coordinate_epoch"] == 2020.5


def test_epochs_are_read_of_vrts_and_kept_from_file_to_file(tmp_path, twz):
    for source in (tmp_path / "a.vrt", twz):
        terrainwave.compress(source, tmp_path / "b.twz", max_error=0, overwrite=True)
        with terrainwave.open(tmp_path / "b.twz") as terrain:
            assert terrain.info().coordinate_epoch == 2020.5


def test_verify_compares_epochs(tmp_path, twz):
    assert terrainwave.verify(twz, tmp_path / "a.tif").ok
    other = dynamic(tmp_path, "other.tif", 2010)
    assert terrainwave.verify(twz, other).problems == (
        "the coordinate epoch is 2020.5, the original's is 2010.0",
    )


def test_a_mosaic_of_different_epochs_has_none(tmp_path):
    paths = [dynamic(tmp_path, "a.tif"), dynamic(tmp_path, "b.tif", 2010, 140.09)]
    with pytest.warns(TerrainwaveWarning, match="dropped.*differ.*the coordinate epoch"):
        source = RasterSource(paths)
    with source:
        assert source.info.coordinate_epoch is None


def test_a_raster_without_an_epoch_has_no_such_key(tmp_path):
    place = {"crs": "EPSG:9000", "transform": Affine(0.01, 0, 140, 0, -0.01, -30)}
    write_geotiff(tmp_path / "a.tif", terrain_like(9, 9), **place)
    terrainwave.compress(tmp_path / "a.tif", tmp_path / "a.twz", max_error=0, method="store")
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        assert "coordinate_epoch" not in terrain.header.metadata
        assert terrain.info().coordinate_epoch is None


def test_category_names_are_named(tmp_path):
    path = write_geotiff(tmp_path / "a.tif", terrain_like(9, 9))
    names = "<CategoryNames><Category>sea</Category></CategoryNames>"
    text = f'<PAMDataset><PAMRasterBand band="1">{names}</PAMRasterBand></PAMDataset>'
    (tmp_path / "a.tif.aux.xml").write_text(text)
    with pytest.warns(TerrainwaveWarning, match="dropped.*its category names"):
        RasterSource(path).close()


@pytest.mark.parametrize("kind", ["aux.xml", "img", "vat.dbf"])
def test_an_attribute_table_is_named(tmp_path, kind):
    path = write_geotiff(tmp_path / "a.tif", terrain_like(9, 9))
    (tmp_path / "a.tif.aux.xml").write_text(TABLE)
    if kind == "img":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rasterio.shutil.copy(path, tmp_path / "a.img", driver="HFA")
        path = tmp_path / "a.img"
    elif kind == "vat.dbf":
        (tmp_path / "a.tif.aux.xml").unlink()
        (tmp_path / "a.tif.vat.dbf").write_bytes(b"")
    with pytest.warns(TerrainwaveWarning, match="dropped.*its raster attribute table"):
        RasterSource(path).close()
