"""The page of `terrainwave site` finds of a file and its original what `verify` finds."""

import json

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from affine import Affine
from ext.rasters import BOUNDS, hills, write_raster
from ext.test_javascript import JS, node

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


@pytest.mark.parametrize(
    ("profile", "line"),
    [
        ({"ENDIANNESS": "BIG", "compress": "deflate", "predictor": 2},
         "big-endian numbers with predictor 2, expected"),
        ({"ENDIANNESS": "BIG", "compress": "lzw", "predictor": 3, "dtype": "float32"},
         "big-endian numbers with predictor 3, expected"),
        ({"NBITS": 12, "dtype": "uint16"}, "12 bits per sample, expected 16"),
        ({"NBITS": 16, "dtype": "float32"}, "16 bits per sample, expected 32"),
        ({"compress": "lzma"}, "of compression 34925, expected one of none, LZW"),
        ({"compress": "jpeg", "dtype": "uint8"}, "of compression 7, expected one of none, LZW"),
    ],
    ids=["predictor 2", "predictor 3", "12 bits", "half floats", "lzma", "jpeg"],
)  # fmt: skip
def test_what_would_be_read_wrong_is_refused_with_a_command_that_helps(tmp_path, profile, line):
    dtype = profile.pop("dtype", "int16")
    heights = (hills(90, 120) % 200).astype(dtype)
    twz = compressed(tmp_path, write_raster(tmp_path / "a.tif", heights, BOUNDS), 0)
    source = write_raster(tmp_path / "b.tif", heights, BOUNDS, **profile)
    (found,) = compared(twz, source)
    assert line in found["error"]
    *options, _, _, _ = found["error"].split("gdal_translate ")[1].split()
    name, value = options[1].rstrip(",").split("=")
    rasterio.shutil.copy(source, tmp_path / "c.tif", driver="GTiff", **{name: value})
    (found,) = compared(twz, tmp_path / "c.tif")
    assert "error" not in found
    if "jpeg" not in str(profile):
        assert found["problems"] == []


@pytest.mark.filterwarnings("ignore:.*found 2 bands")
@pytest.mark.parametrize("interleave", ["pixel", "band"])
def test_an_uncompressed_strip_of_all_rows_is_read_by_parts(tmp_path, interleave):
    heights = hills(1100, 90)
    heights[1090, 7] = 3
    profile = {
        "driver": "GTiff", "height": 1100, "width": 90, "count": 2, "dtype": "int16",
        "blockysize": 1100, "interleave": interleave, "transform": TRANSFORM,
    }  # fmt: skip
    source, changed = tmp_path / "a.tif", tmp_path / "b.tif"
    for path in (source, changed):
        with rasterio.open(path, "w", **profile) as raster:
            raster.write(heights, 1)
            raster.write(heights[::-1], 2)
        heights = heights.copy()
        heights[1090, 7] += 9
    for band in (1, 2):
        twz = tmp_path / f"{band}.twz"
        terrainwave.compress(source, twz, max_error=2, band=band)
        same, other = compared(twz, source, changed, band=band)
        assert same["problems"] == []
        assert same["nValid"] == heights.size
        row = 1090 if band == 1 else 9
        assert f"the worst, at row {row}, column 7" in other["problems"][0]


@pytest.mark.filterwarnings("ignore:.*found 2 bands")
def test_a_strip_that_was_not_written_stays_empty_when_it_is_read_by_parts(tmp_path):
    profile = {
        "driver": "GTiff", "height": 1100, "width": 90, "count": 2, "dtype": "int16",
        "blockysize": 1100, "interleave": "band", "sparse_ok": True, "transform": TRANSFORM,
    }  # fmt: skip
    with rasterio.open(tmp_path / "a.tif", "w", **profile) as raster:
        raster.write(hills(1100, 90), 1)
    for band in (1, 2):
        twz = tmp_path / f"{band}.twz"
        terrainwave.compress(tmp_path / "a.tif", twz, max_error=0, band=band)
        (found,) = compared(twz, tmp_path / "a.tif", band=band)
        assert found["problems"] == []


def test_a_wide_uncompressed_strip_is_read_by_fewer_rows(tmp_path):
    profile = {
        "driver": "GTiff", "height": 600, "width": 220_000, "count": 1, "dtype": "uint8",
        "blockysize": 600,
    }  # fmt: skip
    with rasterio.open(tmp_path / "wide.tif", "w", **profile) as raster:
        raster.write(np.zeros((600, 220_000), np.uint8), 1)
    twz = compressed(tmp_path, write_raster(tmp_path / "small.tif", hills(90, 120), BOUNDS), 3)
    (found,) = compared(twz, tmp_path / "wide.tif")
    assert found["error"].startswith("found a GeoTIFF of 600 rows x 220000 columns, expected 90")


def test_a_compressed_strip_too_large_to_be_decoded_as_a_whole_is_refused(tmp_path):
    profile = {
        "driver": "GTiff", "height": 12000, "width": 12000, "count": 1, "dtype": "uint8",
        "blockysize": 12000,
    }  # fmt: skip
    sources = {"DEFLATE": tmp_path / "packed.tif", "NONE": tmp_path / "plain.tif"}
    for compress, path in sources.items():
        with rasterio.open(path, "w", compress=compress, **profile) as raster:
            raster.write(np.zeros((12000, 12000), np.uint8), 1)
    twz = compressed(tmp_path, write_raster(tmp_path / "small.tif", hills(90, 120), BOUNDS), 3)
    packed, plain = (found["error"] for found in compared(twz, *sources.values()))
    assert packed == (
        "found a GeoTIFF of strips of 12000 x 12000 samples, expected at most 100 MiB in each:"
        " convert it with gdal_translate -co TILED=YES, and choose the new file"
    )
    assert plain.startswith("found a GeoTIFF of 12000 rows x 12000 columns, expected 90 rows")


@pytest.mark.parametrize(
    ("dtype", "nodata"),
    [("uint16", "-9999"), ("uint16", "nan"), ("uint16", "1e20"), ("int16", "-0"),
     ("float32", "-3.4028234663852886e+38"), ("float64", "nan"), ("float32", "-0")],
)  # fmt: skip
def test_nodata_that_no_sample_can_have_is_none_as_for_verify(tmp_path, dtype, nodata):
    heights = (hills(90, 120) % 200 + 1).astype(dtype)
    source = write_raster(tmp_path / "a.tif", heights, BOUNDS)
    patch_nodata(source, nodata)
    twz = compressed(tmp_path, source, 0)
    assert terrainwave.verify(twz, source).problems == ()
    (found,) = compared(twz, source)
    assert found["problems"] == []


def patch_nodata(path, text):
    """Write the tag GDAL_NODATA as it is, whatever the dtype can hold."""
    with rasterio.open(path, "r+") as raster:
        raster.nodata = 77
    data = path.read_bytes()
    at = data.index(b"77\0")
    # The text is in the tag's own four bytes: it moves to the end.
    entry = at - 8
    tag = int.from_bytes(data[entry : entry + 2], "little")
    assert tag == 42113
    size = (len(text) + 1).to_bytes(4, "little")
    place = len(data).to_bytes(4, "little")
    entry_bytes = data[entry : entry + 4] + size + place
    if len(text) < 4:
        entry_bytes = data[entry : entry + 4] + size + text.encode().ljust(4, b"\0")
    path.write_bytes(data[:entry] + entry_bytes + data[entry + 12 :] + text.encode() + b"\0")


@pytest.mark.parametrize(
    ("crs", "scale", "heights_are", "is_known", "bound"),
    [
        ("EPSG:4326", 1, None, True, "above"),
        ("EPSG:4326", 1, None, True, "below"),
        ("EPSG:4326", -1, None, True, "above"),
        ("EPSG:4326+5715", 1, None, None, "above"),
        ("EPSG:4326", 1, "depth", True, "below"),
        ("EPSG:9883", 1, None, False, "above"),
        ("EPSG:9883", 1, "depth", True, "below"),
    ],
)
def test_the_side_of_a_bound_is_that_of_verify_or_it_says_that_it_is_not_known(
    tmp_path, crs, scale, heights_are, is_known, bound
):
    source = write_raster(tmp_path / "a.tif", hills(90, 120), BOUNDS, crs)
    with rasterio.open(source, "r+") as raster:
        raster.scales = (scale,)
    twz = compressed(tmp_path, source, 3, bound=bound, heights_are=heights_are)
    other = tmp_path / "b.twz"
    terrainwave.compress(source, other, max_error=3, heights_are=heights_are)
    kinds = {"heights_are": heights_are}
    assert terrainwave.verify(twz, source, **kinds).ok
    (found,) = compared(twz, source)
    assert found["problems"] == []
    assert is_known is None or found["isSideUnknown"] is not is_known
    with terrainwave.open(twz) as terrain:
        decoded = terrain.read()
        inner = np.abs(decoded.astype(int) - hills(90, 120))
        assert inner.max() > 0
    moved = 2 * decoded.astype(int) - hills(90, 120)
    changed = write_raster(tmp_path / "c.tif", moved.astype(np.int16), BOUNDS, crs)
    with rasterio.open(changed, "r+") as raster:
        raster.scales = (scale,)
    assert not terrainwave.verify(twz, changed, **kinds).ok
    (found,) = compared(twz, changed)
    assert found["isSideUnknown"] != any("wrong side" in line for line in found["problems"])


def test_units_are_compared_as_verify_does(tmp_path):
    names = {"m": "m", "metre": "m", "ft": "ft", None: None}
    rasters = {
        name: write_raster(tmp_path / f"{name}.tif", hills(90, 120), BOUNDS, units=name)
        for name in names
    }
    for own in names:
        twz = compressed(tmp_path, rasters[own], 1)
        for (other, path), found in zip(
            rasters.items(), compared(twz, *rasters.values()), strict=True
        ):
            assert found["problems"] == [
                f"units is {own or 'none'}, the original's is {other or 'none'}"
            ] * (names[own] != names[other])
            assert terrainwave.verify(twz, path).ok is (found["problems"] == [])


def test_transforms_that_differ_in_the_last_digit_differ(tmp_path):
    source = write_raster(tmp_path / "a.tif", hills(90, 120), BOUNDS)
    twz = compressed(tmp_path, source, 1)
    moved = (np.nextafter(BOUNDS[0], 99), *BOUNDS[1:])
    other = write_raster(tmp_path / "b.tif", hills(90, 120), moved)
    assert not terrainwave.verify(twz, other).ok
    (same, found) = compared(twz, source, other)
    assert same["problems"] == []
    assert found["problems"][0].startswith("the transform is")


def test_bands_that_are_no_whole_numbers_are_refused(tmp_path):
    source = write_raster(tmp_path / "a.tif", hills(90, 120), BOUNDS)
    twz = compressed(tmp_path, source, 1)
    assert compared(twz, source, band=1.5) == [
        {"error": "found band 1.5, expected 1, the only one"}
    ]


@pytest.mark.parametrize(
    ("make", "max_error", "scale"),
    [
        (lambda: hills(90, 120), 5, -1),
        (lambda: hills(90, 120) * 20 + np.arange(120, dtype=np.int16) % 3, 40, 1),
        (lambda: hills(90, 120) * 20 + np.arange(120, dtype=np.int16) % 3, 17, 1),
        (floats, 0, 1),
        (floats, 0.5, 1),
    ],
    ids=["negative scale", "40 steps", "17 steps", "lossless floats", "floats"],
)
def test_bars_are_of_one_width_and_count_whole_steps(tmp_path, make, max_error, scale):
    source = write_raster(tmp_path / "a.tif", make(), BOUNDS)
    with rasterio.open(source, "r+") as raster:
        raster.scales = (scale,)
    twz = compressed(tmp_path, source, max_error)
    (found,) = compared(twz, source)
    with terrainwave.open(twz) as terrain:
        decoded = np.asarray(terrain.read(), np.float64)
        bound = terrain.effective_error
    differences = (decoded - make().astype(np.float64)) * scale
    bars, is_whole = found["bars"], make().dtype.kind == "i"
    assert len(bars) <= 33
    assert (len(bars) == 1) == (max_error == 0)
    assert (bars[0]["from"], bars[-1]["to"]) == pytest.approx((-bars[-1]["to"], bars[-1]["to"]))
    assert bars[-1]["to"] >= bound * 0.999999
    for i, bar in enumerate(bars):
        assert bar["to"] - bar["from"] == pytest.approx(bars[0]["to"] - bars[0]["from"])
        if not is_whole:
            continue
        assert bar["from"] == bar["to"] or (bar["to"] - bar["from"]) % 2 == 0
        n = ((differences >= bar["from"]) & (differences <= bar["to"])).sum()
        assert bar["n"] == n, i
    assert sum(bar["n"] for bar in bars) == differences.size


SAVE = """
import { openAsBlob } from "node:fs"; import { writeFile } from "node:fs/promises";
const [twz, tif] = process.argv.slice(1);
const { open } = await import("./src/index.js");
const { geoTiff } = await import("./site/files.js");
const terrain = await open(await openAsBlob(twz));
const { parts } = geoTiff(terrain, await terrain.read(), true);
await writeFile(tif, Buffer.from(await new Blob(parts).arrayBuffer()));
"""


@pytest.mark.parametrize(
    ("dtype", "nodata", "expected"),
    [
        ("int16", None, -32768),
        ("uint8", None, 2),
        ("float32", None, np.nan),
        ("int16", -32768, -32768),
        ("float32", -np.inf, -np.inf),
        ("float64", np.inf, np.inf),
    ],
)
def test_voids_stay_void_in_a_saved_geotiff(tmp_path, dtype, nodata, expected):
    heights = (hills(90, 120) % 200 + 3).astype(dtype)
    if dtype == "uint8":
        heights[0, :2] = 0, 1
    valid = np.ones((90, 120), bool)
    valid[20:40, 30:80] = False
    path = tmp_path / "a.tif"
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            path, "w", driver="GTiff", height=90, width=120, count=1, dtype=dtype,
            crs="EPSG:4326", transform=TRANSFORM, nodata=nodata,
        ) as raster,
    ):  # fmt: skip
        raster.write(heights if nodata is None else np.where(valid, heights, nodata), 1)
        if nodata is None:
            raster.write_mask(valid)
    node("--input-type=module", "-e", SAVE, compressed(tmp_path, path, 0), tmp_path / "b.tif")
    with rasterio.open(tmp_path / "b.tif") as raster:
        assert raster.nodata == pytest.approx(expected, nan_ok=True)
        saved = raster.read(1, masked=True)
    assert (np.ma.getmaskarray(saved) == ~valid).all()
    assert (saved == heights)[valid].all()


MESH = """
const { SIDE, mesher } = await import("./site/mesh.js");
const rough = Float64Array.from({ length: SIDE * SIDE }, (_, i) => 50 * Math.sin(i * 12.9898));
const meshes = [(i) => i % 2 ? NaN : rough[i], (i) => i % SIDE < 200 ? NaN : rough[i],
  (i) => rough[i], () => NaN, () => 5];
console.log(JSON.stringify(meshes.map((height) => {
  const { lines, ...told } = mesher(rough.map((_, i) => height(i)))(0.5);
  return told;
})));
"""


def test_a_mesh_counts_samples_that_no_triangle_covers():
    alternate, left, whole, void, flat = json.loads(node("--input-type=module", "-e", MESH))
    assert (alternate["nTriangles"], alternate["nOutside"]) == (0, (513 * 513 + 1) // 2)
    assert left["nTriangles"] > 0
    assert left["nOutside"] < 513 * 300
    assert whole["nOutside"] == flat["nOutside"] == 0
    assert (void["nTriangles"], void["nOutside"]) == (0, 0)


def test_bounds_are_rounded_up():
    colours = JS.parent / "src/terrainwave/ext/serve/static/colours.js"
    numbers = [0.0999755, 9.99951, 8, 0, 0.30000000000000004, 1000.01, 123456, 0.00012341]
    code = (
        f"const {{ roundedUp }} = await import({str(colours)!r});"
        f"console.log(JSON.stringify({numbers}.map((n) => roundedUp(n, 4))))"
    )
    expected = [0.09998, 10, 8, 0, 0.3, 1001, 123500, 0.0001235]
    assert json.loads(node("--input-type=module", "-e", code)) == expected
