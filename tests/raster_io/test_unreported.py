"""Coordinate epochs are kept; attribute tables, which are not, are named."""

import re

import pytest
import rasterio
import rasterio.shutil

import terrainwave
from terrainwave.errors import TerrainwaveWarning

VRT = """<VRTDataset rasterXSize="9" rasterYSize="9">
<SRS dataAxisToSRSAxisMapping="2,1" coordinateEpoch="{}">EPSG:9000</SRS>
<GeoTransform>{},0.01,0,-30,0,-0.01</GeoTransform>
<VRTRasterBand dataType="Int16" band="1"><NoDataValue>-1</NoDataValue></VRTRasterBand></VRTDataset>
"""


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
