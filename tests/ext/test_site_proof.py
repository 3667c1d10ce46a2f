"""Does the page of `terrainwave site` find of a file and its original what `verify` finds?"""

import json

import numpy as np
import pytest
import rasterio
from affine import Affine
from ext.rasters import BOUNDS, hills, write_raster
from ext.test_javascript import node

import terrainwave

pytestmark = pytest.mark.full

N_PLACES = 50
TRANSFORM = Affine(0.5 / 120, 0, 8.0, 0, -0.4 / 90, 46.4)


def compared(twz, *originals, band=1):
    """Return what the page's comparison finds of each original."""
    return json.loads(node("testing/compare.js", twz, band, *originals))


def compressed(folder, source, max_error, **options):
    target = folder / f"{source.stem}.twz"
    terrainwave.compress(source, target, max_error=max_error, block=32, threads=1, **options)
    return target


def lake(heights):
    """Return heights with a void, and one beside the edge."""
    heights = heights.copy()
    heights[20:40, 30:80] = heights[:3, :5] = -9999
    return heights


def floats(step=0.01):
    rng = np.random.default_rng(3)
    return (hills(90, 120) + step * rng.integers(-50, 50, (90, 120))).astype(np.float32)


def infinite():
    heights = floats()
    heights[7, 5:60] = -np.inf
    return heights


RASTERS = {
    "whole metres": (lambda: hills(90, 120), 3, {}),
    "lossless": (lambda: hills(90, 120), 0, {}),
    "voids": (lambda: lake(hills(90, 120)), 2, {"nodata": -9999}),
    "uint8": (lambda: (hills(90, 120) % 256).astype(np.uint8), 2, {}),
    "int32": (lambda: hills(90, 120).astype(np.int32) * 1000, 700, {"nodata": 7}),
    "hundredths": (floats, 0.05, {}),
    "hundredths, lossless": (floats, 0, {}),
    "off any grid": (lambda: floats(0.0101010101), 0.03, {"nodata": -9999}),
    "doubles": (lambda: floats().astype(np.float64), 0.5, {"nodata": float("nan")}),
    "infinite nodata": (infinite, 0.1, {"nodata": float("-inf")}),
    "strips of 7 rows": (lambda: hills(90, 120), 1, {"blockysize": 7, "tiled": False}),
    "LZW, big-endian": (lambda: hills(90, 120), 1, {"compress": "lzw", "ENDIANNESS": "BIG"}),
    "tiles, predictor 3": (
        floats, 0.1,
        {"compress": "deflate", "predictor": 3, "tiled": True, "blockxsize": 16, "blockysize": 16},
    ),
    "ZSTD, BigTIFF": (lambda: hills(90, 120), 1, {"compress": "zstd", "BIGTIFF": "YES"}),
}  # fmt: skip


@pytest.mark.parametrize("name", RASTERS)
def test_it_finds_the_errors_that_verify_finds(tmp_path, name):
    make, max_error, profile = RASTERS[name]
    source = write_raster(tmp_path / "a.tif", make(), BOUNDS, **profile)
    (found,) = compared(compressed(tmp_path, source, max_error), source)
    expected = terrainwave.verify(tmp_path / "a.twz", source)
    assert expected.ok
    assert found["problems"] == []
    assert found["nValid"] == expected.errors.n_valid
    assert found["maxError"] == expected.errors.max_error
    assert found["rmse"] == pytest.approx(expected.errors.rmse)
    worst = found["worst"] and (found["worst"]["row"], found["worst"]["col"])
    errors = expected.errors
    assert worst == (None if errors.worst_row is None else (errors.worst_row, errors.worst_col))
    assert sum(bar["n"] for bar in found["bars"]) == found["nValid"]
    assert (found["root"], found["stated"]) == (expected.root, expected.root)


@pytest.mark.parametrize(
    ("make", "step", "bound"),
    [
        (lambda: hills(90, 120), 1, "both"),
        (floats, 0.01, "both"),
        (lambda: lake(hills(90, 120)), 1, "both"),
        (lambda: hills(90, 120), 1, "above"),
    ],
    ids=["metres", "hundredths", "voids", "above"],
)
def test_it_finds_one_sample_that_is_one_step_off_wherever_it_lies(tmp_path, make, step, bound):
    heights = make()
    has_voids = (heights == -9999).any()
    profile = {"nodata": -9999} if has_voids else {}
    source = write_raster(tmp_path / "a.tif", heights, BOUNDS, **profile)
    twz = compressed(tmp_path, source, 0 if bound == "both" else 2, bound=bound)
    with terrainwave.open(twz) as terrain:
        decoded = terrain.read()
    rng = np.random.default_rng(5)
    valid = np.flatnonzero(np.ma.getmaskarray(decoded).ravel() == 0)
    places = {0, heights.size - 1} if not has_voids else set()
    places |= set(rng.choice(valid, N_PLACES - len(places), replace=False).tolist())
    originals = []
    for at in places:
        changed = heights.copy()
        # The side or, of a lossless file, any step.
        one = np.ma.getdata(decoded).ravel()[at] if bound == "above" else changed.ravel()[at]
        changed.flat[at] = one + heights.dtype.type(step)
        originals.append(write_raster(tmp_path / f"{at}.tif", changed, BOUNDS, **profile))
    for at, found in zip(places, compared(twz, *originals), strict=True):
        place = f"row {at // 120}, column {at % 120}"
        assert len(found["problems"]) == 1, (at, found["problems"])
        assert found["problems"][0].startswith("1 sample is")
        assert place in found["problems"][0]
    assert not terrainwave.verify(twz, originals[0]).ok


def test_it_joins_bands_of_many_tiles_and_their_digests(tmp_path):
    """Two bands of two rows of tiles, read in parts; a void part; a file without root."""
    heights = hills(1040, 2100)
    heights[500:1030, 600:1900] = -9999
    heights[40, 2070] = heights[1029, 3] = -9999
    profile = {"nodata": -9999, "tiled": True, "blockxsize": 1024, "blockysize": 1024}
    source = write_raster(tmp_path / "a.tif", heights, BOUNDS, **profile)
    twz = tmp_path / "a.twz"
    terrainwave.compress(source, twz, max_error=2, digest=False)
    (found,) = compared(twz, source)
    expected = terrainwave.verify(twz, source)
    assert found["problems"] == []
    assert found["stated"] is None
    terrainwave.compress(source, tmp_path / "stated.twz", max_error=2)
    with terrainwave.open(tmp_path / "stated.twz") as terrain:
        assert found["root"] == terrain.digest()
    assert found["nValid"] == expected.errors.n_valid
    worst = found["worst"]["row"], found["worst"]["col"]
    assert worst == (expected.errors.worst_row, expected.errors.worst_col)
    heights[1029, 2] += 3
    (found,) = compared(twz, write_raster(tmp_path / "b.tif", heights, BOUNDS, **profile))
    assert "row 1029, column 2," in found["problems"][0]


@pytest.mark.parametrize("kind", ["alpha", "mask"])
def test_it_applies_scale_offset_bands_and_masks(tmp_path, kind):
    heights, opacity = hills(90, 120), np.ones((90, 120), np.int16)
    opacity[10:20] = 0
    band, path = 1 if kind == "alpha" else 2, tmp_path / "a.tif"
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            path, "w", driver="GTiff", height=90, width=120, count=2, dtype="int16",
            crs="EPSG:4326", transform=TRANSFORM, ALPHA="YES" if kind == "alpha" else "NO",
        ) as raster,
    ):  # fmt: skip
        raster.write(np.stack([heights, opacity] if kind == "alpha" else [opacity, heights]))
        raster.scales, raster.offsets = (0.1, 0.1), (100, 100)
        if kind == "mask":
            raster.write_mask(opacity > 0)
    twz = compressed(tmp_path, path, 0.4, band=band)
    expected = terrainwave.verify(twz, path, band=band)
    assert expected.ok
    assert expected.errors.n_valid == 80 * 120
    (found,) = compared(twz, path, band=band)
    assert found["problems"] == []
    assert (found["nValid"], found["maxError"]) == (80 * 120, expected.errors.max_error)
    assert compared(twz, path, band=3) == [{"error": "found band 3, expected 1 to 2"}]


def test_what_differs_is_one_clear_line(tmp_path):
    source = write_raster(tmp_path / "a.tif", lake(hills(90, 120)), BOUNDS, nodata=-9999)
    twz = compressed(tmp_path, source, 1)
    (tmp_path / "text.tif").write_text("heights", encoding="ascii")
    (tmp_path / "cut.tif").write_bytes(source.read_bytes()[:9000])
    damaged = write_raster(tmp_path / "damaged.tif", hills(90, 120), BOUNDS, compress="deflate")
    data = bytearray(damaged.read_bytes())
    data[2000:2100] = bytes(100)
    damaged.write_bytes(data)
    others = {
        source: [],
        write_raster(tmp_path / "b.tif", hills(90, 121), BOUNDS): "of 90 rows x 121 columns",
        write_raster(tmp_path / "c.tif", floats(), BOUNDS): "found a GeoTIFF of float32",
        write_raster(tmp_path / "d.tif", lake(hills(90, 120)), BOUNDS): "void in one of the two",
        write_raster(tmp_path / "e.tif", lake(hills(90, 120)), (7.9, 46, 8.4, 46.4), nodata=-9999):
            "the transform is",
        write_raster(tmp_path / "f.tif", lake(hills(90, 120)), BOUNDS, nodata=-1): "nodata is",
        tmp_path / "text.tif": "found a file that is no TIFF",
        tmp_path / "cut.tif": "the GeoTIFF's header is damaged",
        damaged: "of the GeoTIFF cannot be read",
    }  # fmt: skip
    for (path, line), found in zip(others.items(), compared(twz, *others), strict=True):
        lines = found.get("problems", [found.get("error")])
        assert lines == [] if not line else any(line in one for one in lines), (path, found)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_an_original_that_is_infinite_or_the_largest_float_is_beyond_every_bound(tmp_path, dtype):
    heights = floats().astype(dtype)
    twz = compressed(tmp_path, write_raster(tmp_path / "a.tif", heights, BOUNDS), 0.1)
    values = [np.inf, -np.inf, np.finfo(dtype).max, np.finfo(dtype).min]
    originals = []
    for i, value in enumerate(values):
        changed = heights.copy()
        changed[7, 5] = value
        originals.append(write_raster(tmp_path / f"{i}.tif", changed, BOUNDS))
    for found in compared(twz, *originals):
        assert found["problems"][0].startswith("1 sample is further from the original than 0.")
        assert "at row 7, column 5" in found["problems"][0]
