"""Rows and columns as polynomials of longitude and latitude: as near to PROJ as they say."""

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from rasterio.transform import Affine
from strategies import write_geotiff

import terrainwave
from terrainwave.errors import InvalidHeightsError
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.polynomials import fit_places

# Metres around the equator.
WORLD = 2 * np.pi * 6378137
RASTERS = {
    "utm": ("EPSG:32633", Affine(90, 40, 4e5, 40, -90, 5e6)),
    "pole": ("EPSG:3031", Affine(90e3, 0, -3e6, 0, -90e3, 3e6)),
    "mercator": ("EPSG:3857", Affine(WORLD / 72, 0, -WORLD / 2, 0, -WORLD / 60, WORLD / 2)),
    "turn": ("EPSG:4326", Affine(5, 0, 0, 0, -2, 60)),
    "strait": ("EPSG:32660", Affine(5e3, 0, 6e5, 0, -5e3, 8e6)),
    "nearly a turn": ("EPSG:4326", Affine(4.9, 0, 10, 0, -2, 60)),
}


def globe_of(tmp_path, crs, transform, shape=(60, 72)):
    raster = write_geotiff(
        tmp_path / "dem.tif", np.zeros(shape, np.int16), crs=crs, transform=transform
    )
    terrainwave.compress(
        raster, tmp_path / "dem.twz", method="store", mesh="none", max_error=0, verify=False
    )
    return Globe(terrainwave.open(tmp_path / "dem.twz"))


def evaluated(table, domain, lon, lat):
    """Return the polynomial's values at places, degrees reduced to the domain's turn."""
    west, south, east, north = domain
    across = (2 * (west + np.mod(lon - west, 360)) - west - east) / (east - west)
    down = (2 * lat - south - north) / (north - south)
    return chebyshev.chebval2d(down, across, table)


@pytest.mark.parametrize("name", RASTERS)
def test_no_sample_is_further_from_its_place_than_stated(tmp_path, name):
    globe = globe_of(tmp_path, *RASTERS[name])
    with globe.terrain:
        places = fit_places(globe)
        rows, cols = (grid.ravel().astype(float) for grid in np.mgrid[0:60, 0:72])
        lon, lat = globe.from_samples(rows, cols)
        there = np.isfinite(lon) & (np.abs(lat) < 89.9)
        lon, lat, rows, cols = lon[there], lat[there], rows[there], cols[there]
        apart = [
            evaluated(places.rows, places.domain, lon, lat) - rows,
            evaluated(places.cols, places.domain, lon, lat) - cols,
        ]
        if globe.turn is not None:
            apart[1] = np.mod(apart[1] + globe.turn / 2, globe.turn) - globe.turn / 2
        # It is measured at other places.
        assert np.abs(apart).max() <= 2 * places.error + 1e-8
        assert places.error < 1e-4
        assert places.rows.size + places.cols.size < 1000
        assert len(places.as_json(globe)["rows"]) == len(places.rows)


def test_places_that_two_share_are_refused(tmp_path, monkeypatch):
    """Of all that polynomials put into the raster PROJ must say the same."""
    globe = globe_of(tmp_path, *RASTERS["utm"])
    with globe.terrain:
        monkeypatch.setattr(globe, "to_samples", lambda lon, lat: (lon * np.nan, lat * np.nan))
        with pytest.raises(InvalidHeightsError, match="inf samples off"):
            fit_places(globe)


def test_a_projection_that_is_cut_is_refused(tmp_path):
    globe = globe_of(tmp_path, "ESRI:54052", Affine(5e5, 0, -18e6, 0, -25e4, 8e6))
    with globe.terrain, pytest.raises(InvalidHeightsError, match="warp the raster to EPSG:4326"):
        fit_places(globe)
