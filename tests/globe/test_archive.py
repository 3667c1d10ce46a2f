"""PMTiles archives of `terrainwave tiles a.twz a.pmtiles`, read by the format's package."""

import json
import os
from unittest.mock import Mock

import numpy as np
import pytest
from commands import run
from pmtiles.reader import MmapSource, Reader, all_tiles
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.globe import archive
from terrainwave.globe.archive import write_pmtiles
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.terrain_rgb import rgb_tile

UTM = Affine(90.0, 0.0, 4e5, 0.0, -90.0, 4e6)
# Across 180°.
PACIFIC = Affine(0.02, 0.0, 179.6, 0.0, -0.02, 10.0)


def make_twz(tmp_path, transform=UTM, crs="EPSG:32633", mask=None, side=40):
    heights = terrain_like(side, side)
    raster = write_geotiff(
        tmp_path / "dem.tif", heights, transform=transform, crs=crs, units=("m",), mask=mask
    )
    terrainwave.compress(raster, tmp_path / "dem.twz", max_error=1, method="store", block=32)
    raster.unlink()
    return tmp_path / "dem.twz"


def read_archive(path):
    """Return {(z, x, y): bytes}, header and metadata."""
    with path.open("rb") as file:
        source = MmapSource(file)
        reader = Reader(source)
        return dict(all_tiles(source)), reader.header(), reader.metadata()


@pytest.mark.parametrize(("transform", "crs"), [(UTM, "EPSG:32633"), (PACIFIC, "EPSG:4326")])
def test_an_archive_holds_every_tile_that_has_terrain(tmp_path, transform, crs):
    twz, target = make_twz(tmp_path, transform, crs), tmp_path / "dem.pmtiles"
    options = {"min_zoom": 6, "rim": 2, "attribution": "© somebody"}
    with terrainwave.open(twz) as terrain:
        zooms = write_pmtiles(terrain, target, image="png", **options)
        globe = Globe(terrain)
        found, header, metadata = read_archive(target)
        (z, *_), *_ = sorted(found, reverse=True)
        assert zooms[-1].zoom == header["max_zoom"] == z
        assert (zooms[0].zoom, header["min_zoom"]) == (6, 6)
        assert sum(zoom.n_tiles for zoom in zooms) == len(found)
        for place, png in found.items():
            assert png == rgb_tile(globe, *place, 2).image
        for z, x, y in list(found):
            beside = [(z, (x + 1) % 2**z, y), (z, x, y + 1)]
            assert all(at in found or rgb_tile(globe, *at, 2) is None for at in beside)
    assert (metadata["encoding"], metadata["attribution"]) == ("mapbox", "© somebody")
    # a bound of the file does not hold for tiles: each zoom states its own errors
    assert "max_error" not in metadata
    assert all(zoom["terrain_error"] > 0 for zoom in metadata["zooms"])
    assert -180e7 <= header["min_lon_e7"] < header["max_lon_e7"] <= 180e7


@pytest.mark.full
def test_tiles_lie_in_the_order_of_the_formats_curve(tmp_path):
    with terrainwave.open(make_twz(tmp_path, side=500)) as terrain:
        *_, last = write_pmtiles(terrain, tmp_path / "dem.pmtiles", min_zoom=9)
    assert last.n_tiles >= 6
    assert read_archive(tmp_path / "dem.pmtiles")[1]["clustered"]


def test_the_command_replaces_an_archive_only_if_told(tmp_path):
    twz, target = make_twz(tmp_path), tmp_path / "dem.pmtiles"
    result = run("tiles", twz, target, "--min-zoom", 5, "--max-zoom", 7, "--json")
    assert result.exit_code == 0, result.output
    assert [zoom["zoom"] for zoom in json.loads(result.stdout)["zooms"]] == [5, 6, 7]
    again = run("tiles", twz, target, "--max-zoom", 5)
    assert (again.exit_code, again.stdout) == (1, "")
    assert "--overwrite" in again.stderr
    assert run("tiles", twz, target, "--max-zoom", 6, "--overwrite", "-q").exit_code == 0
    assert read_archive(target)[1]["max_zoom"] == 6
    assert sorted(os.listdir(tmp_path)) == ["dem.pmtiles", "dem.twz"]


def test_a_failure_leaves_no_file(tmp_path, monkeypatch):
    twz = make_twz(tmp_path)

    monkeypatch.setattr(
        archive.tiling, "rgb_tile", Mock(side_effect=OSError(28, "No space left on device"))
    )
    result = run("tiles", twz, tmp_path / "dem.pmtiles", "--threads", 1)
    assert result.exit_code == 1
    assert "the disk is full" in result.stderr
    assert os.listdir(tmp_path) == ["dem.twz"]


@pytest.mark.parametrize(
    ("target", "options", "line"),
    [
        ("t", "--min-zoom 9 --max-zoom 4", "found --min-zoom 9, expected 0 … 4, the finest zoom"),
        ("t", "--max-zoom 99", "found --max-zoom 99, expected 0 … "),
        ("t.pmtiles", "--max-zoom 99", "found --max-zoom 99, expected 0 … "),
        ("t", "--min-zoom -1", "-1 is not in the range x>=0"),
        ("t", "--rim 3", "found --rim for a directory"),
        ("t.pmtiles", "--max-zoom 22", "found --max-zoom 22, expected 0 … "),
        ("t.pmtiles", "--min-zoom 3 --max-zoom 2", "found --min-zoom 3, expected 0 … 2"),
        ("t.pmtiles", "--rim 9", "found --rim 9, expected a whole number, 0 … 8"),
        ("t.mbtiles", "", "expected a directory or a name that ends in .pmtiles"),
        ("t", "--tile-size 512", "found --tile-size for a directory"),
        ("t", "--image webp", "found --image for a directory"),
        ("t", "--round-by-zoom", "found --round-by-zoom for a directory"),
        ("t.pmtiles", "--tile-size 300", "found --tile-size 300, expected 256 or 512"),
    ],
)
def test_what_cannot_be_is_wrong_usage(tmp_path, target, options, line):
    twz = make_twz(tmp_path)
    result = run("tiles", twz, tmp_path / target, *options.split())
    assert result.exit_code == 2, result.output
    assert line in result.stderr
    assert os.listdir(tmp_path) == ["dem.twz"]


def test_pillow_without_webp_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("PIL.features.check", lambda feature: feature != "webp")
    twz = make_twz(tmp_path)
    result = run("tiles", twz, tmp_path / "t.pmtiles")
    assert result.exit_code == 1
    assert "built without WebP: install one with it, or take --image png" in result.stderr
    assert run("tiles", twz, tmp_path / "t.pmtiles", "--image", "png").exit_code == 0


def test_a_raster_without_heights_has_no_archive(tmp_path):
    twz = make_twz(tmp_path, mask=np.zeros((40, 40), bool))
    result = run("tiles", twz, tmp_path / "t.pmtiles")
    assert result.exit_code == 1
    assert "no valid height" in result.stderr
    assert os.listdir(tmp_path) == ["dem.twz"]
