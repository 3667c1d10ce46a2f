"""Is the place that `decompress` writes the raster's, whatever a GeoTIFF can hold?"""

import warnings

import numpy as np
import pytest
import rasterio
from cases import some
from place.crs_cases import CASES, CF_POLE
from rasterio.crs import CRS
from rasterio.io import MemoryFile
from strategies import write_geotiff

import terrainwave
from terrainwave.errors import TerrainwaveWarning
from terrainwave.place.crs import format_crs
from terrainwave.raster_io.geotiff.sink import read_place, write_beside

# As ENVI's headers have it, without codes: the vertical system becomes another one in a GeoTIFF.
NO_CODES = CRS.from_user_input("EPSG:2263+6360").to_wkt(version="WKT1_ESRI")
# Systems that a GeoTIFF of GDAL 3.10 gives back as others, found by writing and reading each.
NOT_HELD = {
    "rotated_pole_sphere", "rotated_pole_wgs84", "rotated_pole_cf", "rotated_pole_south_up",
    "mars_map_west", "mars_north_west",
}  # fmt: skip


def compressed(tmp_path, crs, units=None):
    path = tmp_path / "dem.twz"
    in_degrees = CRS.from_user_input(crs).is_geographic
    metres, degrees = (30, 0, 980000, 0, -30, 200000), (0.01, 0, 8, 0, -0.01, 50)
    with rasterio.open(
        "", "w+", driver="MEM", height=9, width=8, count=1, dtype="float32", crs=crs,
        transform=rasterio.Affine(*(degrees if in_degrees else metres)),
    ) as dataset:  # fmt: skip
        dataset.write(np.full((1, 9, 8), 1000, np.float32))
        if units:
            dataset.units = (units,)
        terrainwave.compress(dataset, path, max_error=0, mesh="none")
    return path


@pytest.mark.parametrize("case", some(CASES, 8), ids=[case.name for case in CASES])
def test_the_crs_comes_back_whatever_a_geotiff_holds(case, tmp_path):
    twz, tif = compressed(tmp_path, case.crs), tmp_path / "back.tif"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        terrainwave.decompress(twz, tif)
    notes = [str(one.message) for one in told if issubclass(one.category, TerrainwaveWarning)]
    assert (len(notes) == 1) == (case.name in NOT_HELD)
    assert (tmp_path / "back.tif.aux.xml").exists() == (case.name in NOT_HELD)
    # compressed again, it has the same axes and the same way to the globe
    again = tmp_path / "again.twz"
    terrainwave.compress(tif, again, max_error=0, mesh="none")
    from terrainwave.globe.lonlat import Globe

    with warnings.catch_warnings(), terrainwave.open(twz) as one, terrainwave.open(again) as other:
        warnings.simplefilter("ignore")
        at = np.array([0.0, 5.0]), np.array([3.0, 7.0])
        np.testing.assert_array_equal(Globe(one).from_samples(*at), Globe(other).from_samples(*at))
        assert Globe(one).height_range == Globe(other).height_range


def test_feet_of_a_crs_without_codes_stay_feet(tmp_path):
    twz, tif = compressed(tmp_path, NO_CODES), tmp_path / "back.tif"
    with pytest.warns(TerrainwaveWarning, match="vertical unit .* becomes metre"):
        terrainwave.decompress(twz, tif)
    with rasterio.open(tif) as dataset, terrainwave.open(twz) as terrain:
        assert dataset.units == (terrain.units,)
        assert "oot" in terrain.units
        assert format_crs(dataset.crs) == terrain.crs
    assert terrainwave.verify(twz, tif).ok


def test_the_unit_of_the_crs_is_the_geotiff_s_band_s(tmp_path):
    tif = tmp_path / "back.tif"
    terrainwave.decompress(compressed(tmp_path, "EPSG:2263+6360"), tif)
    with rasterio.open(tif) as dataset:
        assert dataset.units == ("US survey foot",)


def test_a_stale_file_beside_does_not_give_its_crs(tmp_path):
    tif = tmp_path / "back.tif"
    with pytest.warns(TerrainwaveWarning, match="keep both files"):
        terrainwave.decompress(compressed(tmp_path, CF_POLE), tif)
    (tmp_path / "dem.twz").unlink()
    terrainwave.decompress(compressed(tmp_path, "EPSG:32633"), tif, overwrite=True)
    assert not (tmp_path / "back.tif.aux.xml").exists()
    with rasterio.open(tif) as dataset:
        assert dataset.crs == CRS.from_epsg(32633)


def test_a_virtual_geotiff_tells_what_it_lacks(tmp_path):
    with terrainwave.open(compressed(tmp_path, CF_POLE)) as terrain:
        with pytest.warns(TerrainwaveWarning, match="it has none of it"):
            stream = terrain.geotiff()
        data = stream.read()
        with MemoryFile(data) as memory, memory.open() as dataset:
            assert dataset.crs is None


def test_what_told_of_a_raster_that_was_there_goes_with_it(tmp_path):
    target = tmp_path / "a.tif"
    target.write_bytes(b"another raster")
    crs = CRS.from_epsg(32633)
    write_beside(target, crs, "ft")
    write_geotiff(tmp_path / "b.tif", np.arange(12, dtype="int16").reshape(3, 4))
    terrainwave.compress(tmp_path / "b.tif", tmp_path / "b.twz", max_error=0)
    terrainwave.decompress(tmp_path / "b.twz", target, overwrite=True)
    assert not (tmp_path / "a.tif.aux.xml").exists()
    assert read_place(target)[:2] == (None, None)


@pytest.mark.parametrize("cog", [False, True])
def test_statistics_and_overviews_of_a_raster_that_was_there_are_not_read(tmp_path, cog):
    target, overviews = tmp_path / "a.tif", tmp_path / "a.tif.ovr"
    write_geotiff(target, np.full((900, 900), 7, dtype="int16"))
    write_geotiff(overviews, np.full((450, 450), 7, dtype="int16"))
    (tmp_path / "a.tif.aux.xml").write_text(
        '<PAMDataset><PAMRasterBand band="1"><Metadata><MDI key="STATISTICS_MEAN">7</MDI>'
        "</Metadata></PAMRasterBand></PAMDataset>"
    )
    with rasterio.open(target) as dataset:
        assert (dataset.tags(1)["STATISTICS_MEAN"], dataset.overviews(1)) == ("7", [2])
    write_geotiff(tmp_path / "b.tif", np.full((900, 900), 9, dtype="int16"))
    terrainwave.compress(tmp_path / "b.tif", tmp_path / "b.twz", max_error=0, method="store")
    terrainwave.decompress(tmp_path / "b.twz", target, overwrite=True, cog=cog)
    with rasterio.open(target) as dataset:
        assert "STATISTICS_MEAN" not in dataset.tags(1)
        assert dataset.overviews(1) == ([2] if cog else [])
        assert (dataset.read(1, out_shape=(450, 450)) == 9).all()
