"""Items for STAC catalogues: what a file is, where it lies, and its checksum."""

import hashlib
import json
import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import rasterio
from commands import run
from referencing import Registry, Resource
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import InvalidHeightsError
from terrainwave.globe.stac import stac_item


def made(tmp_path, crs, transform, shape=(40, 60), **tags):
    source = write_geotiff(
        tmp_path / "dem.tif", terrain_like(*shape), crs=crs, transform=transform, nodata=-9999,
        units=("metre",), tags=tags or None,
    )  # fmt: skip
    terrainwave.compress(source, tmp_path / "dem.twz", max_error=2, mesh="none", block=32)
    return tmp_path / "dem.twz"


def item_of(path):
    with terrainwave.open(path) as terrain:
        return stac_item(terrain)


def area(ring):
    lon, lat = np.array(ring).T
    return float(np.sum(lon[:-1] * lat[1:] - lon[1:] * lat[:-1]) / 2)


def test_an_item_says_what_the_file_is(tmp_path):
    path = made(
        tmp_path, "EPSG:32633", (30.0, 0.0, 500000.0, 0.0, -30.0, 5200000.0),
        TIFFTAG_DATETIME="2021:05:03 10:00:00",
    )  # fmt: skip
    item = json.loads(run("info", path, "--stac").stdout)
    asset = item["assets"]["data"]
    assert asset["file:checksum"] == "1220" + hashlib.sha256(path.read_bytes()).hexdigest()
    assert asset["file:size"] == path.stat().st_size
    assert asset["type"] == "application/vnd.terrainwave"
    (band,) = asset["bands"]
    assert (band["data_type"], band["nodata"], band["unit"]) == ("int16", -9999, "metre")
    properties = item["properties"]
    assert properties["datetime"] == "2021-05-03T10:00:00Z"
    assert properties["proj:code"] == "EPSG:32633"
    assert properties["proj:shape"] == [40, 60]
    assert properties["gsd"] == pytest.approx(30, rel=0.01)
    assert properties["terrainwave:max_error"] == 2
    (ring,) = item["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    assert area(ring) > 0  # counterclockwise
    lon, lat = np.array(ring).T
    assert item["bbox"] == pytest.approx([lon.min(), lat.min(), lon.max(), lat.max()], abs=1e-5)
    assert item["bbox"][0] == pytest.approx(15, abs=1e-6)


@pytest.mark.parametrize(
    ("transform", "bbox", "kind"),
    [
        ((0.5, 0.0, 5.0, 0.0, -0.5, 50.0), [5, 30, 35, 50], "Polygon"),
        ((0.5, 0.0, 170.0, 0.0, -0.5, 50.0), [170, 30, -160, 50], "MultiPolygon"),
        ((0.5, 0.0, -200.0, 0.0, -0.5, 50.0), [160, 30, -170, 50], "MultiPolygon"),
        ((6.0, 0.0, -180.0, 0.0, -4.5, 90.0), [-180, -90, 180, 90], "Polygon"),
        ((6.0, 0.0, 0.0, 0.0, -4.5, 90.0), [-180, -90, 180, 90], "Polygon"),
    ],
)
def test_boxes_follow_geojson(tmp_path, transform, bbox, kind):
    item = item_of(made(tmp_path, "EPSG:4326", transform))
    assert item["bbox"] == pytest.approx(bbox, abs=1e-6)
    assert item["geometry"]["type"] == kind
    rings = item["geometry"]["coordinates"]
    if kind == "MultiPolygon":
        rings = [ring for polygon in rings for ring in polygon]
    for ring in rings:
        assert area(ring) > 0
        lon, lat = np.array(ring).T
        assert abs(lon).max() <= 180
        assert abs(lat).max() <= 90


@pytest.mark.filterwarnings("ignore:.*")
def test_a_raster_without_a_place_has_no_item(tmp_path):
    path = made(tmp_path, None, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0))
    with pytest.raises(InvalidHeightsError, match="no coordinate reference system"):
        item_of(path)


def test_statistics_are_of_pixels_before_scale_and_offset(tmp_path):
    heights = terrain_like(40, 60)
    place = {"crs": "EPSG:32633", "transform": (30.0, 0.0, 5e5, 0.0, -30.0, 5.2e6)}
    path = write_geotiff(tmp_path / "a.tif", heights, **place)
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.5,), (-100,)
    terrainwave.compress(path, tmp_path / "a.twz", max_error=0, method="store")
    band = item_of(tmp_path / "a.twz")["assets"]["data"]["bands"][0]
    assert band["statistics"] == {"minimum": heights.min(), "maximum": heights.max()}
    assert (band["raster:scale"], band["raster:offset"]) == (0.5, -100)


def test_voids_alone_have_no_statistics(tmp_path):
    place = {"crs": "EPSG:32633", "transform": (30.0, 0.0, 5e5, 0.0, -30.0, 5.2e6)}
    path = write_geotiff(tmp_path / "a.tif", np.full((9, 9), -1, "int16"), nodata=-1, **place)
    terrainwave.compress(path, tmp_path / "a.twz", max_error=0, method="store")
    assert "statistics" not in item_of(tmp_path / "a.twz")["assets"]["data"]["bands"][0]


def test_a_crs_without_a_code_is_wkt2(tmp_path):
    crs = "+proj=laea +lat_0=52 +lon_0=10 +datum=WGS84"
    item = item_of(made(tmp_path, crs, (1000.0, 0.0, 0.0, 0.0, -1000.0, 0.0)))
    assert item["properties"]["proj:wkt2"].startswith("PROJCRS[")
    assert "datetime" in item["properties"]


STAC = Path(__file__).parents[2] / "stac"
EXTENSION = json.loads((STAC / "json-schema" / "schema.json").read_text())


def schema_of_the_extension():
    from jsonschema import Draft7Validator

    return Draft7Validator(EXTENSION)


def schema_of_items():
    """Return a validator by STAC's own schema of items, which comes with pystac."""
    from jsonschema import Draft7Validator, FormatChecker  # here: it takes seconds, of each worker

    folder = Path(str(files("pystac.validation") / "jsonschemas"))
    found = {path.name: json.loads(path.read_text()) for path in folder.rglob("*.json")}
    near = found["item.json"]["$id"].rpartition("/")[0]  # where its references look
    registry = Registry()
    for name, schema in found.items():
        for id_ in (schema["$id"].rstrip("#"), f"{near}/{name}"):
            registry = registry.with_resource(id_, Resource.from_contents(schema))
    return Draft7Validator(found["item.json"], registry=registry, format_checker=FormatChecker())


@pytest.mark.parametrize("name", ["raster", "example"])
def test_items_are_valid_by_the_schemas_of_stac_and_of_the_extension(name, tmp_path):
    item = json.loads((STAC / "examples" / "item.json").read_text())
    if name != "example":
        source = write_geotiff(
            tmp_path / "dem.tif", terrain_like(40, 60), crs="EPSG:32633", nodata=-9999,
            transform=(30.0, 0.0, 500000.0, 0.0, -30.0, 5200000.0), units=("metre",),
        )  # fmt: skip
        terrainwave.compress(source, tmp_path / "dem.twz", max_error=2)
        item = item_of(tmp_path / "dem.twz")
    schema_of_items().validate(item)
    schema_of_the_extension().validate(item)
    assert EXTENSION["$id"] in item["stac_extensions"]


def test_the_schema_refuses_what_the_extension_does_not_say():
    item = json.loads((STAC / "examples" / "item.json").read_text())
    for key, value in (
        ("terrainwave:max_error", -1),
        ("terrainwave:root", "abc"),
        ("terrainwave:bound", "left"),
        ("terrainwave:other", 1),
    ):
        wrong = item | {"properties": item["properties"] | {key: value}}
        assert not schema_of_the_extension().is_valid(wrong), key


def test_the_extension_describes_the_fields_of_items():
    text = (STAC / "README.md").read_text()
    known = EXTENSION["properties"]["properties"]["properties"]
    assert re.findall(r"^\| `(terrainwave:\w+)`", text, re.M) == list(known)
