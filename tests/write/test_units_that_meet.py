"""Heights of one unit beside those of another, at each place where a file takes new ones."""

import numpy as np
import pytest
import rasterio
import xarray as xr
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import InvalidHeightsError

HEIGHTS = terrain_like(20, 20)
TRANSFORM = rasterio.Affine(10, 0, 500_000, 0, -10, 5_000_000)
FEET_CRS = "EPSG:2263+6360"


def raster(path, unit, crs="EPSG:32632", heights=HEIGHTS):
    units = None if unit is None else [unit]
    return write_geotiff(path, heights, units=units, crs=crs, transform=TRANSFORM)


@pytest.fixture
def file(tmp_path):
    """Return what makes a file of heights in a unit."""

    def make(unit, crs="EPSG:32632"):
        path = tmp_path / "dem.twz"
        terrainwave.compress(raster(tmp_path / "old.tif", unit, crs), path, max_error=1)
        return path

    return make


def as_given(kind, path, tmp_path):
    """Return a raster as a path, a dataset, labelled heights, or a mosaic."""
    if kind == "path":
        return path
    if kind == "mosaic":
        return [path, path]
    dataset = rasterio.open(path)
    if kind == "dataset":
        return dataset
    with dataset:
        rows, cols = np.arange(20), np.arange(20)
        return xr.DataArray(
            dataset.read(1),
            dims=("y", "x"),
            coords={"y": 5_000_000 - 10 * (rows + 0.5), "x": 500_000 + 10 * (cols + 0.5)},
            attrs={"units": dataset.units[0], "crs": "EPSG:32632"},
        )


@pytest.mark.parametrize("kind", ["path", "dataset", "labelled", "mosaic"])
def test_a_patch_in_another_unit_is_refused_however_it_is_given(file, tmp_path, kind):
    path = file("metre")
    before = path.read_bytes()
    new = as_given(kind, raster(tmp_path / "new.tif", "ft"), tmp_path)
    with pytest.raises(InvalidHeightsError, match=r'in ft, the file has metre; .*"A\*0\.3048"'):
        terrainwave.patch(path, new)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("unit", "crs", "new_unit", "refused"),
    [
        ("metre", "EPSG:32632", "US survey foot", "A*0.304800609601"),
        ("metre", "EPSG:32632", "cm", "A*0.01"),
        ("km", "EPSG:32632", "m", "A*0.001"),
        ("foot", "EPSG:32632", "US survey foot", "A*1.000002"),
        (None, FEET_CRS, "metre", "A*3.28083333333"),
        ("metre", FEET_CRS, None, "A*0.304800609601"),
        ("metre", "EPSG:32632", "percent", "if both mean the same"),
        ("m/yr", "EPSG:32632", "mm/yr", "if both mean the same"),
    ],
)
def test_other_units_are_refused_with_what_to_do(file, tmp_path, unit, crs, new_unit, refused):
    path = file(unit, crs)
    new = raster(tmp_path / "new.tif", new_unit, crs)
    with pytest.raises(InvalidHeightsError) as problem:
        terrainwave.patch(path, new)
    assert refused in str(problem.value)
    assert "\n" not in str(problem.value)


@pytest.mark.parametrize("command", ["patch", "store_meshes"])
def test_an_original_in_another_unit_is_refused(file, tmp_path, command):
    path = file("metre")
    original = raster(tmp_path / "original.tif", "ft")
    same = raster(tmp_path / "new.tif", "m")
    calls = {
        "patch": lambda: terrainwave.patch(path, same, original=original),
        "store_meshes": lambda: terrainwave.store_meshes(
            path, tmp_path / "meshes.twz", original=original
        ),
    }
    with pytest.raises(InvalidHeightsError, match=r"original\.tif: found heights in ft"):
        calls[command]()


def test_verify_compares_no_heights_of_another_unit(file, tmp_path):
    path, original = file(None, FEET_CRS), raster(tmp_path / "original.tif", "metre", FEET_CRS)
    report = terrainwave.verify(path, original)
    assert report.errors is None
    assert "the file has US survey foot" in report.problems[0]
