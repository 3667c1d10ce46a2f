"""The driver gives what Terrain gives: heights, voids, place, overviews. `built` builds it."""

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import rasterio
from gdal_driver.built import ROOT, build, by_python, error_lines, good, run
from gdal_driver.files import KINDS, write_described, write_kind
from rasterio.windows import Window

import terrainwave
from benchmarks.slow_server import SlowServer

pytestmark = [pytest.mark.full, pytest.mark.gdal]
GOLDEN = ROOT / "tests" / "golden" / "v2"


@pytest.fixture(scope="module", autouse=True)
def _plugin():
    build()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("driver")


@pytest.fixture(scope="module")
def kinds(folder):
    """A .twz file of each of `KINDS`."""
    return {kind: write_kind(folder, kind) for kind in KINDS}


@pytest.fixture(scope="module")
def described(folder):
    return write_described(folder)


LEVELS = """
for path, target in asked:
    n = int(gdal.Open(path).GetMetadataItem("LEVELS", "TERRAINWAVE"))
    for level in range(-n, n):
        named = gdal.Open(f"TWZ:{path}:{level}")
        opened = gdal.OpenEx(path, open_options=[f"LEVEL={level}"])
        band = named.GetRasterBand(1)
        found = {
            "heights": band.ReadAsArray(), "mask": band.GetMaskBand().ReadAsArray(),
            "same": opened.ReadAsArray(), "transform": named.GetGeoTransform(),
        }
        assert opened.GetGeoTransform() == named.GetGeoTransform()
        assert not named.GetSubDatasets() and not opened.GetSubDatasets()
        np.savez(f"{target}{level}.npz", **found)
print(0)
"""


def assert_all_levels_are_those_of_terrain(paths, folder):
    targets = [folder / f"{path.stem}-level" for path in paths]
    by_python(
        LEVELS, [[str(path), str(target)] for path, target in zip(paths, targets, strict=True)]
    )
    for path, target in zip(paths, targets, strict=True):
        with terrainwave.open(path) as terrain:
            for level in range(-terrain.n_levels, terrain.n_levels):
                found = np.load(f"{target}{level}.npz")
                heights, valid = terrain.read_with_mask(level=level)
                assert found["heights"].dtype == heights.dtype
                assert found["heights"].tobytes() == heights.tobytes(), (path.name, level)
                np.testing.assert_array_equal(found["same"], heights)
                np.testing.assert_array_equal(found["mask"], np.where(valid, 255, 0), path.name)
                a, b, c, d, e, f = terrain.transform_of(level)[:6]
                np.testing.assert_allclose(found["transform"], (c, a, b, f, d, e), rtol=1e-15)


def test_golden_files_open_and_all_their_levels_are_terrains(folder):
    """Each fourth file: `ctest` reads all by the library that the driver calls."""
    assert_all_levels_are_those_of_terrain(sorted(GOLDEN.glob("*.twz"))[::4], folder)


def test_levels_of_every_type_and_kind_of_voids_are_terrains(kinds, folder):
    assert_all_levels_are_those_of_terrain(list(kinds.values()), folder)


def test_levels_of_a_raster_without_a_place_have_rows_and_columns_of_the_full_grid(folder):
    path = folder / "nowhere.twz"
    heights = np.add.outer(np.arange(150), np.arange(170)).astype(np.int16)
    path.write_bytes(terrainwave.compress_to_bytes(heights, max_error=0, block=32, threads=1))
    assert_all_levels_are_those_of_terrain([path], folder)
    assert "Origin" not in good("gdalinfo", path)


OVERVIEWS = """
counts = []
for path, target in asked:
    dataset = gdal.Open(path)
    band = dataset.GetRasterBand(1)
    counts.append(band.GetOverviewCount())
    mask = band.GetMaskBand()
    for i in range(band.GetOverviewCount()):
        overview = band.GetOverview(i)
        values = overview.ReadAsArray(), overview.GetMaskBand().ReadAsArray()
        if mask.GetOverviewCount():
            assert (mask.GetOverview(i).ReadAsArray() == values[1]).all()
        np.savez(f"{target}{i}.npz", heights=values[0], mask=values[1])
print(json.dumps(counts))
"""


def test_overviews_are_those_of_terrain_geotiff_to_the_last_bit(kinds, folder):
    asked = [[str(path), str(folder / f"{kind}-overview")] for kind, path in kinds.items()]
    counts = by_python(OVERVIEWS, asked)
    for (path, target), n in zip(asked, counts, strict=True):
        with terrainwave.open(path) as terrain:
            with rasterio.open(terrain.geotiff()) as dataset:
                assert n == len(dataset.overviews(1)) > 0
            for i in range(n):
                found = np.load(f"{target}{i}.npz")
                with rasterio.open(terrain.geotiff(), overview_level=i) as dataset:
                    assert found["heights"].tobytes() == dataset.read(1).tobytes(), (path, i)
                    if terrain.raster_info.mask_kind != "nan":
                        np.testing.assert_array_equal(found["mask"], dataset.read_masks(1))


DESCRIPTION = """
dataset = gdal.Open(asked)
band = dataset.GetRasterBand(1)
found = {
    "transform": dataset.GetGeoTransform(), "wkt": dataset.GetProjection(),
    "tags": dataset.GetMetadata(), "band tags": band.GetMetadata(), "nodata": band.GetNoDataValue(),
    "unit": band.GetUnitType(), "scale": band.GetScale(), "offset": band.GetOffset(),
    "description": band.GetDescription(), "least": band.GetMinimum(), "greatest": band.GetMaximum(),
    "color": gdal.GetColorInterpretationName(band.GetColorInterpretation()),
    "own": dataset.GetMetadata("TERRAINWAVE"), "subdatasets": dataset.GetSubDatasets(),
    "json": dataset.GetMetadata_List("json:TERRAINWAVE"), "flags": band.GetMaskFlags(),
    "structure": dataset.GetMetadata("IMAGE_STRUCTURE"), "block": band.GetBlockSize(),
}
print(json.dumps(found))
"""


def test_a_file_says_what_the_geotiff_of_it_says(described):
    found = by_python(DESCRIPTION, str(described))
    with terrainwave.open(described) as terrain, rasterio.open(terrain.geotiff()) as dataset:
        assert found["transform"] == list(dataset.transform.to_gdal())
        assert rasterio.CRS.from_wkt(found["wkt"]) == dataset.crs
        tags = {key: value for key, value in dataset.tags().items() if "TERRAINWAVE" not in key}
        assert found["tags"] == tags
        assert tags["AREA_OR_POINT"] == "Point"
        assert found["band tags"] == dataset.tags(1) == {"SENSOR": "none of them"}
        assert (found["unit"],) == dataset.units
        assert ((found["scale"],), (found["offset"],)) == (dataset.scales, dataset.offsets)
        assert (found["description"],) == dataset.descriptions
        assert found["nodata"] == dataset.nodata
        assert found["color"] == "Green"
        heights = terrain.read()
    # The header has the range of heights that may be there, within the bound of 1.
    assert 0 <= heights.min() - found["least"] <= 1
    assert 0 <= found["greatest"] - heights.max() <= 1


@pytest.mark.parametrize(("kind", "word"), [("depth", "down"), ("height", "up"), ("radius", None)])
def test_the_band_says_which_way_its_numbers_go(folder, kind, word):
    path = folder / f"{kind}.twz"
    heights = np.arange(400, dtype=np.float32).reshape(20, 20)
    terrainwave.compress(heights, path, max_error=0, heights_are=kind)
    found = by_python(DESCRIPTION, str(path))
    assert found["band tags"].get("positive") == word
    assert found["own"]["HEIGHTS_ARE"] == kind


def test_the_domain_of_the_format_tells_bound_method_and_levels(kinds, described):
    own = by_python(DESCRIPTION, str(described))["own"]
    with terrainwave.open(described) as terrain:
        assert float(own["MAX_ERROR"]) == terrain.effective_error
        assert float(own["MAX_ERROR_ASKED"]) == 0.75
        assert (own["METHOD"], own["LEVELS"]) == (terrain.header.method, str(terrain.n_levels))
        assert own["SOFTWARE"].startswith("terrainwave")
    found = by_python(DESCRIPTION, str(kinds["int16-nodata"]))
    assert "averages" in found["own"]["OVERVIEWS"]
    assert found["structure"]["COMPRESSION_REVERSIBILITY"] == "LOSSY"
    assert not found["subdatasets"]
    (text,) = found["json"]
    assert json.loads(text)["crs"] == "EPSG:32632"


def test_the_domain_of_the_format_tells_root_side_and_a_missing_proof(folder):
    heights = np.arange(2000, dtype=np.int16).reshape(40, 50)
    terrainwave.compress(heights, folder / "side.twz", max_error=6, bound="below")
    own = by_python(DESCRIPTION, str(folder / "side.twz"))["own"]
    with terrainwave.open(folder / "side.twz") as terrain:
        assert own["ROOT"] == terrain.digest()
    assert own["BOUND"] == "below"
    assert "PROOF" not in own
    terrainwave.compress(heights, folder / "unproved.twz", max_error=6, verify=False)
    own = by_python(DESCRIPTION, str(folder / "unproved.twz"))["own"]
    assert own["PROOF"] == "none"
    assert not {"ROOT", "BOUND"} & set(own)


@pytest.fixture(scope="module", params=["cdf97", "rapid"])
def rough(request, folder):
    """Lossless and lossy files of a method, of rough heights with voids, and those heights."""
    y, x = np.mgrid[0:300, 0:280]
    heights = 300 * np.sin(x / 97) * np.cos(y / 71) + 60 * np.sin((x + y) / 23)
    heights += np.random.default_rng(3).normal(0, 4, x.shape)
    heights = np.round(heights).astype(np.int16)
    heights[100:150, 100:190] = -32768
    paths = {}
    for max_error in (0, 3):
        paths[max_error] = folder / f"rough-{request.param}-{max_error}.twz"
        paths[max_error].write_bytes(
            terrainwave.compress_to_bytes(
                heights, nodata=-32768, method=request.param, max_error=max_error, block=32,
                threads=1,
            )
        )  # fmt: skip
    return request.param, heights, paths


BOUNDS = """
found = []
for path in asked:
    n = int(gdal.Open(path).GetMetadataItem("LEVELS", "TERRAINWAVE"))
    for level in range(n):
        named = gdal.Open(f"TWZ:{path}:{level}")
        opened = gdal.OpenEx(path, open_options=[f"LEVEL={level - n}"])
        told = [[dataset.GetMetadata(domain) for domain in ("TERRAINWAVE", "IMAGE_STRUCTURE")]
                for dataset in (named, opened)]
        told[1][0].pop("FINGERPRINT", None)
        assert told[0] == told[1]
        np.save(f"{path}.{level}.npy", named.ReadAsArray())
        found.append([path, level, *told[0]])
print(json.dumps(found))
"""


def test_each_level_states_a_bound_that_holds_for_its_samples(rough):
    method, heights, paths = rough
    is_nested, excesses = method == "rapid", []
    for path, level, own, structure in by_python(BOUNDS, list(map(str, paths.values()))):
        bound = float(own["MAX_ERROR"])
        with terrainwave.open(path) as terrain:
            is_full = level == terrain.n_levels - 1
            whole, stated = terrain.effective_error, terrain.level_errors()[level]
            originals = heights[:: terrain.grid.stride(level), :: terrain.grid.stride(level)]
        assert bound == (whole if is_full or is_nested else stated)
        samples = np.load(f"{path}.{level}.npy").astype(float)
        both = (samples != -32768) & (originals != -32768)
        error = np.abs(samples - originals)[both].max()
        assert error <= bound, (path, level)
        assert structure["COMPRESSION_REVERSIBILITY"] == ("LOSSY" if bound else "LOSSLESS")
        assert ("MAX_ERROR_ASKED" in own) == is_full
        excesses.append(error - whole)
    # Levels that are filtered are further away than the full grid is.
    assert is_nested == (max(excesses) <= 0)


@pytest.mark.parametrize("method", ["cdf97", "rapid"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_levels_of_exact_floats_on_no_grid_state_what_rounding_leaves(folder, method, dtype):
    y, x = np.mgrid[0:140, 0:130]
    heights = (300 * np.sin(x / 31) * np.cos(y / 27) * np.pi).astype(dtype)
    path = folder / f"floats-{method}-{dtype}.twz"
    path.write_bytes(
        terrainwave.compress_to_bytes(heights, max_error=0, method=method, block=32, threads=1)
    )
    worst = []
    for _, level, own, structure in by_python(BOUNDS, [str(path)]):
        with terrainwave.open(path) as terrain:
            originals = heights[:: terrain.grid.stride(level), :: terrain.grid.stride(level)]
        samples = np.load(f"{path}.{level}.npy")
        worst.append(np.abs(samples.astype(float) - originals).max())
        bound = float(own["MAX_ERROR"])
        assert worst[-1] <= bound
        assert (structure["COMPRESSION_REVERSIBILITY"] == "LOSSLESS") == (bound == 0)
    assert worst[-1] == 0 < max(worst)


def test_a_filtered_level_of_a_file_on_a_server_states_no_bound(rough):
    method, _, paths = rough
    code = """
dataset = gdal.Open(f"TWZ:/vsicurl/{asked}:-2")
print(json.dumps([dataset.GetMetadataItem("MAX_ERROR", "TERRAINWAVE"),
                  dataset.GetMetadataItem("COMPRESSION_REVERSIBILITY", "IMAGE_STRUCTURE")]))
"""
    path = paths[3]
    with SlowServer(path.parent, latency=0.001, bits_per_second=0) as server:
        told = by_python(code, server.url(path.name), GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR")
    assert told == ([None, None] if method == "cdf97" else ["3", "LOSSY"])


OVERVIEW_LEVEL = """
path, number = asked
whole = gdal.Open(path)
opened = gdal.OpenEx(path, open_options=[f"OVERVIEW_LEVEL={number}"])
band, expected = opened.GetRasterBand(1), whole.GetRasterBand(1).GetOverview(int(number[0]))
for found, right in ((band, expected), (band.GetMaskBand(), expected.GetMaskBand())):
    np.testing.assert_array_equal(found.ReadAsArray(), right.ReadAsArray())
across, down = whole.RasterXSize / opened.RasterXSize, whole.RasterYSize / opened.RasterYSize
c, a, b, f, d, e = whole.GetGeoTransform()
np.testing.assert_allclose(
    opened.GetGeoTransform(), (c, a * across, b * down, f, d * across, e * down), rtol=1e-15)
assert opened.GetProjection() == whole.GetProjection()
assert opened.GetMetadata() == whole.GetMetadata()
sizes = [band.GetOverview(i).XSize for i in range(band.GetOverviewCount())]
print(json.dumps([opened.GetMetadata("TERRAINWAVE"), opened.GetMetadata("IMAGE_STRUCTURE"), sizes,
                  whole.GetRasterBand(1).GetOverviewCount()]))
"""


@pytest.mark.parametrize("kind", ["int16-none", "uint8-mask"])
@pytest.mark.parametrize("number", ["0", "0only", "1"])
def test_an_overview_that_an_option_names_is_that_of_the_band_and_states_no_bound(
    kinds, kind, number
):
    path = kinds[kind]
    own, structure, sizes, n_all = by_python(OVERVIEW_LEVEL, [str(path), number])
    assert not {"MAX_ERROR", "MAX_ERROR_ASKED", "LEVEL"} & set(own)
    assert "without a bound" in own["OVERVIEWS"]
    assert "COMPRESSION_REVERSIBILITY" not in structure
    assert len(sizes) == (0 if number == "0only" else n_all - 1 - int(number))
    assert own["LEVELS"].isdigit()


COPIES = """
path, folder = asked
half = gdal.OpenEx(path, open_options=["OVERVIEW_LEVEL=0"])
ways = [(path, {}), (path, {"width": 300, "height": 200}), (path, {"format": "VRT"}), (half, {}),
        (path, {"outputType": gdal.GDT_Float32}), (path, {"scaleParams": [[0, 1, 0, 2]]})]
made = [gdal.Translate(f"{folder}/{i}.tif", source, options=gdal.TranslateOptions(**options))
        for i, (source, options) in enumerate(ways)]
made.append(gdal.Warp(f"{folder}/warped.tif", path, dstSRS="EPSG:4326"))
made.append(gdal.Warp(f"{folder}/coarse.vrt", path, xRes=60, yRes=60, format="VRT"))
made.append(gdal.BuildVRT(f"{folder}/built.vrt", [path]))
found = [line for dataset in made for one in (dataset, dataset.GetRasterBand(1))
         for domain in one.GetMetadataDomainList() or []
         for line in one.GetMetadata_List(domain) or []]
print(json.dumps([len(made), found]))
"""


def test_no_copy_that_gdal_makes_states_the_bound(kinds, folder):
    n_copies, told = by_python(COPIES, [str(kinds["int16-nodata"]), str(folder)])
    assert n_copies == 9
    assert "AREA_OR_POINT=Area" in told
    words = ("MAX_ERROR", "REVERSIBILITY", "TERRAINWAVE", "FINGERPRINT")
    assert [line for line in told if any(word in line for word in words)] == []


@pytest.mark.parametrize(
    ("kind", "flags", "nodata"),
    [("int16-nodata", 8, -32768), ("uint8-mask", 2, None), ("int16-none", 1, None)],
)
def test_voids_are_a_nodata_value_or_a_mask_of_the_dataset(kinds, kind, flags, nodata):
    found = by_python(DESCRIPTION, str(kinds[kind]))
    assert (found["flags"], found["nodata"]) == (flags, nodata)


WINDOWS = """
rng = np.random.default_rng(5)
kinds = {kind: gdal.Open(path) for kind, path in asked.items()}
for kind, dataset in kinds.items():
    band = dataset.GetRasterBand(1)
    whole, mask = band.ReadAsArray(), band.GetMaskBand().ReadAsArray()
    height, width = whole.shape
    for _ in range(12):
        row, col = int(rng.integers(height)), int(rng.integers(width))
        size = rng.integers(1, (width - col + 1, height - row + 1))
        box = col, row, int(size[0]), int(size[1])
        part = np.s_[row : row + box[3], col : col + box[2]]
        assert (band.ReadAsArray(*box).tobytes() == whole[part].tobytes()), (kind, box)
        assert (band.GetMaskBand().ReadAsArray(*box) == mask[part]).all(), (kind, box)
        as_float = band.ReadAsArray(*box, buf_type=gdal.GDT_Float64)
        np.testing.assert_array_equal(as_float, whole[part].astype(np.float64))
        dataset.FlushCache()
    as_float = band.ReadAsArray(buf_type=gdal.GDT_Float64)
    np.testing.assert_array_equal(as_float, whole.astype(np.float64))
    # A line of a buffer is longer than the window, and lines begin at its end.
    buffer = np.zeros((height, width + 3), dtype=whole.dtype)
    raw = dataset.ReadRaster(0, 0, width, height, buf_line_space=buffer.strides[0])
    raw += bytes(buffer.nbytes - len(raw))
    strided = np.frombuffer(raw, whole.dtype).reshape(buffer.shape)
    assert strided[:, :width].tobytes() == whole.tobytes()
print(0)
"""


def test_windows_are_parts_of_the_whole_in_any_type_and_stride(kinds):
    by_python(WINDOWS, {kind: str(path) for kind, path in kinds.items()})


def test_threads_and_many_readers_of_one_file_get_the_same(kinds):
    code = """
from concurrent.futures import ThreadPoolExecutor
def read(i):
    dataset = gdal.Open(asked)
    band = dataset.GetRasterBand(1)
    row = 37 * i % 900
    return (band.ReadAsArray(0, row, 1091, 400) == whole[row : row + 400]).all() and (
        band.GetOverview(0).ReadAsArray() == half).all()
dataset = gdal.Open(asked)
band = dataset.GetRasterBand(1)
whole, half = band.ReadAsArray(), band.GetOverview(0).ReadAsArray()
with ThreadPoolExecutor(8) as pool:
    assert all(pool.map(read, range(60)))
np.save(asked + ".npy", whole)
print(0)
"""
    path = kinds["int16-nodata"]
    with terrainwave.open(path) as terrain:
        expected = terrain.read()
    for threads in ("1", "3", "ALL_CPUS"):
        by_python(code, str(path), GDAL_NUM_THREADS=threads)
        np.testing.assert_array_equal(np.load(f"{path}.npy"), expected)


def test_a_process_that_forks_after_threads_were_used_still_reads(kinds):
    code = """
import os
gdal.Open(asked[0]).ReadAsArray()
child = os.fork()
if not child:
    total = float(np.nansum(gdal.Open(asked[1]).ReadAsArray(), dtype=np.float64))
    os._exit(0 if total == asked[2] else 1)
print(os.waitpid(child, 0)[1])
"""
    with terrainwave.open(kinds["float32-nan"]) as terrain:
        total = float(np.nansum(terrain.read(), dtype=np.float64))
    asked = [str(kinds["int16-nodata"]), str(kinds["float32-nan"]), total]
    assert by_python(code, asked, GDAL_NUM_THREADS="3") == 0


def test_a_file_written_anew_is_read_anew(kinds, folder):
    code = """
import shutil, os
name, one, other = asked
shutil.copy(one, name)
kept = gdal.Open(name)
before = kept.ReadAsArray().shape, kept.GetRasterBand(1).DataType
shutil.copy(other, name + ".part")
os.replace(name + ".part", name)
after = gdal.Open(name)
print(json.dumps([before, [after.ReadAsArray().shape, after.GetRasterBand(1).DataType]]))
"""
    one, other = kinds["int16-nodata"], kinds["uint8-mask"]
    before, after = by_python(code, [str(folder / "again.twz"), str(one), str(other)])
    assert before[0] == list(KINDS["int16-nodata"][2])
    assert after[0] == list(KINDS["uint8-mask"][2])


@pytest.fixture(scope="module")
def twins(folder):
    """Two files of one size and the same first 16 KiB, and their heights, one of which differs."""
    heights = np.random.default_rng(1).integers(0, 30_000, (3600, 2700), dtype=np.int16)
    other = heights.copy()
    other[3501, 2681] ^= 1
    paths = [folder / "twin-a.twz", folder / "twin-b.twz"]
    for path, values in zip(paths, (heights, other), strict=True):
        path.write_bytes(
            terrainwave.compress_to_bytes(
                values, max_error=0, method="store", block=32, threads=1, mesh="none"
            )
        )
    one, two = (path.read_bytes() for path in paths)
    assert len(one) == len(two)
    assert one[: 16 << 10] == two[: 16 << 10]
    return paths, (int(heights[3501, 2681]), int(other[3501, 2681]))


TWINS = """
import os
one, other, name, way = asked
def put(source):
    data = open(source, "rb").read()
    if way == "replaced":
        open(name + ".part", "wb").write(data)
        os.replace(name + ".part", name)
    elif way == "rewritten":
        open(name, "wb").write(data)
    else:
        gdal.FileFromMemBuffer(name, data)
    if way != "memory":
        os.utime(name, ns=(10**18, 10**18))
kept, found = [], []
for source in (one, other, one):
    put(source)
    kept.append(gdal.Open(name))
    found.append(int(kept[-1].ReadAsArray()[3501, 2681]))
print(json.dumps(found))
"""


@pytest.mark.parametrize("way", ["replaced", "rewritten", "memory"])
def test_files_of_equal_size_time_and_beginning_are_told_apart(twins, folder, way):
    (one, other), expected = twins
    name = "/vsimem/twin.twz" if way == "memory" else str(folder / f"{way}.twz")
    found = by_python(TWINS, [str(one), str(other), name, way])
    assert found == [expected[0], expected[1], expected[0]]


PROFILES = """
import rasterio
from rasterio.merge import merge
one, other, target = asked
found = []
for path in (one, other):
    with rasterio.open(path) as dataset:
        found.append([dataset.compression, dataset.profile["driver"]])
        with rasterio.open(target, "w", **dataset.profile | {"driver": "GTiff"}) as copy:
            copy.write(dataset.read())
        with rasterio.open(target) as copy:
            assert (copy.read() == dataset.read()).all()
            assert copy.profile["transform"] == dataset.transform
merged, _ = merge([one, one])
with rasterio.open(one) as dataset:
    assert (merged == dataset.read()).all()
print(json.dumps(found))
"""


@pytest.mark.parametrize("method", ["cdf53", "rapid"])
def test_profiles_and_merges_of_the_systems_rasterio_work(described, folder, method):
    """Rasterio 1.3 raises for a compression that is not one of GeoTIFF's."""
    path = write_kind(folder, "uint8-mask", method=method)
    found = by_python(PROFILES, [str(path), str(described), str(folder / "profile.tif")])
    assert found == [[None, "TWZ"]] * 2


def test_a_sidecar_appears_only_where_somebody_asks_for_exact_statistics(kinds, folder):
    path = folder / "alone" / "alone.twz"
    path.parent.mkdir()
    shutil.copy(kinds["int16-nodata"], path)
    good("gdalinfo", path)
    good("gdalinfo", "-approx_stats", path)
    good("gdal_translate", "-q", path, folder / "copy.tif")
    by_python(
        "dataset = gdal.Open(asked); dataset.GetRasterBand(1).GetHistogram(approx_ok=1); print(0)",
        str(path),
    )
    assert [entry.name for entry in path.parent.iterdir()] == ["alone.twz"]
    told = good("gdalinfo", "-stats", path)
    assert [entry.name for entry in sorted(path.parent.iterdir())] == [
        "alone.twz", "alone.twz.aux.xml",
    ]  # fmt: skip
    kept = next(line for line in told.splitlines() if "STATISTICS_MEAN" in line)
    assert kept in good("gdalinfo", path)


def write_flat(path, height, **options):
    """Write a .twz file of one height but for three samples; return its path."""
    heights = np.full((80, 90), height, dtype=np.int16)
    heights[0, :3] = 0, 1, 100
    path.write_bytes(terrainwave.compress_to_bytes(heights, max_error=0, threads=1, **options))
    return path


MEASURED = """
dataset = gdal.Open(asked)
band = dataset.GetRasterBand(1)
mean = band.GetStatistics(0, 1)[2]
counts = band.GetHistogram(-0.5, 100.5, 101, include_out_of_range=0, approx_ok=0)
plain = {key: value for key, value in band.GetMetadata().items() if "STATISTICS" not in key}
print(json.dumps([mean, [i for i, count in enumerate(counts) if count > 2], plain,
                  dataset.GetMetadata(), dataset.GetMetadataItem("MAX_ERROR", "TERRAINWAVE")]))
"""


def kept_statistics(path):
    return "STATISTICS_MEAN" in good("gdalinfo", path)


@pytest.fixture
def measured(tmp_path):
    """A file with an .aux.xml of statistics and a histogram, to which a user added metadata."""
    path = write_flat(tmp_path / "dem.twz", 20)
    assert by_python(MEASURED, str(path))[1] == [20]
    code = """
dataset = gdal.Open(asked)
dataset.SetMetadataItem("survey", "lidar")
dataset.GetRasterBand(1).SetMetadataItem("sensor", "a")
del dataset
print(0)
"""
    by_python(code, str(path))
    assert kept_statistics(path)
    return path


def test_statistics_of_a_file_that_was_replaced_are_measured_anew(measured, tmp_path):
    shutil.copy(write_flat(tmp_path / "other.twz", 70), measured)
    assert not kept_statistics(measured)
    mean, counts, band_tags, tags, bound = by_python(MEASURED, str(measured))
    assert mean == pytest.approx(70, abs=0.1)
    assert counts == [70]
    assert (band_tags, tags) == ({"sensor": "a"}, {"survey": "lidar"})
    assert bound == "0"
    assert kept_statistics(measured)


def test_a_sidecar_states_no_bound_of_a_file_that_was_replaced(measured):
    heights = np.arange(7200, dtype=np.int16).reshape(80, 90)
    measured.write_bytes(terrainwave.compress_to_bytes(heights, max_error=5, threads=1))
    told = good("gdalinfo", "-mdd", "TERRAINWAVE", measured)
    with terrainwave.open(measured) as terrain:
        assert f"MAX_ERROR={terrain.effective_error:g}\n" in told
    assert "COMPRESSION_REVERSIBILITY=LOSSY" in told
    assert "survey=lidar" in told


@pytest.mark.parametrize("way", ["patch", "compress"])
def test_statistics_after_patch_and_overwrite_are_those_of_the_new_heights(measured, way):
    heights = np.full((80, 90), 70, dtype=np.int16)
    heights[0, :3] = 0, 1, 100
    if way == "patch":
        terrainwave.patch(measured, heights)
    else:
        terrainwave.compress(heights, measured, max_error=0, overwrite=True)
    sidecar = Path(f"{measured}.aux.xml")
    assert sidecar.exists() == (way == "patch")
    assert "STATISTICS" not in (sidecar.read_text() if way == "patch" else "")
    mean, counts, band_tags, tags, _ = by_python(MEASURED, str(measured))
    assert (round(mean), counts) == (70, [70])
    users = ({"sensor": "a"}, {"survey": "lidar"}) if way == "patch" else ({}, {})
    assert (band_tags, tags) == users


@pytest.mark.parametrize("name", ["TWZ:{}:9", "TWZ:{}:-9"])
def test_a_level_that_does_not_exist_is_one_line_with_those_that_do(kinds, name):
    ended = run("gdalinfo", name.format(kinds["int16-none"]))
    (line,) = error_lines(ended)
    assert "found level" in line
    assert "expected 0 (the coarsest) to 4, or -1 (the full grid) to -5" in line


@pytest.mark.parametrize("text", ["one", "", "1.5", "99999999999999999999"])
def test_a_level_that_is_no_number_is_refused(kinds, text):
    ended = run("gdalinfo", "-oo", f"LEVEL={text}", kinds["int16-none"])
    assert ended.returncode == 1
    assert f"found level {text}" in ended.stderr


BY_LEVEL = """\
<VRTDataset rasterXSize="{}" rasterYSize="{}"><VRTRasterBand dataType="UInt16" band="1">
<SimpleSource><SourceFilename relativeToVRT="1">{}</SourceFilename><SourceBand>1</SourceBand>
</SimpleSource></VRTRasterBand></VRTDataset>"""
READ_ALL = "print(json.dumps([gdal.Open(name).ReadAsArray().tolist() for name in asked]))"


@pytest.fixture
def moved(tmp_path):
    """A folder with VRT files of a file's level -2, made in another folder; and its heights."""
    made, moved = tmp_path / "made", tmp_path / "moved"
    (made / "data").mkdir(parents=True)
    path = write_kind(made / "data", "uint16-nodata").rename(made / "data" / "dem.twz")
    with terrainwave.open(path) as terrain:
        heights = terrain.read(level=-2)
    names = {"named": ["TWZ:data/dem.twz:-2"], "quoted": ['TWZ:"data/dem.twz":-2']}
    names["option"] = ["-oo", "LEVEL=-2", "data/dem.twz"]
    for name, arguments in names.items():
        good("gdalbuildvrt", "-q", f"{name}.vrt", *arguments, folder=made)
    (made / "relative.vrt").write_text(BY_LEVEL.format(600, 257, "TWZ:data/dem.twz:-2"))
    made.rename(moved)
    return moved, heights.tolist()


@pytest.mark.parametrize("name", ["named", "quoted", "option", "relative"])
def test_a_vrt_of_a_level_works_from_any_folder_and_moves_with_its_file(moved, name):
    folder, heights = moved
    if name in ("named", "quoted") and by_python("print(gdal.VersionInfo())") < 3080000:
        # GDAL before 3.8 keeps such names relative to the folder of the program.
        (line, *_) = error_lines(run("gdalinfo", "-checksum", folder / f"{name}.vrt"))
        assert "give the level by the open option LEVEL" in line
        return
    assert by_python(READ_ALL, [str(folder / f"{name}.vrt")]) == [heights]


@pytest.mark.parametrize(
    "command",
    [
        ["gdaladdo", "{path}", "2", "4"],
        ["gdaladdo", "-ro", "{path}", "2"],
        ["gdaladdo", "-clean", "{path}"],
        ["gdalwarp", "-q", "{source}", "{path}"],
        ["gdalwarp", "-q", "-of", "TWZ", "{source}", "{path}"],
        ["gdalwarp", "-q", "-overwrite", "{source}", "{path}"],
        ["gdalwarp", "-q", "{source}", "{missing}"],
        ["gdal_edit.py", "-a_nodata", "5", "{path}"],
        ["gdaldem", "hillshade", "-q", "{source}", "{missing}"],
    ],
    ids=" ".join,
)
def test_commands_that_would_write_name_the_one_that_does(kinds, folder, command):
    path, missing = folder / "target.twz", folder / "missing.twz"
    shutil.copy(kinds["int16-none"], path)
    source = kinds["int16-none"].with_suffix(".tif")
    names = {"path": path, "source": source, "missing": missing}
    ended = run(*(part.format(**names) for part in command))
    assert ended.returncode != 0
    assert "terrainwave compress dem.tif dem.twz" in ended.stderr
    assert path.read_bytes() == kinds["int16-none"].read_bytes()
    assert not missing.exists()
    assert not list(folder.glob("target.twz.*"))


def test_an_invalid_file_is_one_error_line_at_most(folder):
    """Of those that only readers of meshes find wrong nothing may be said. `ctest` reads all."""
    for path in sorted((GOLDEN / "invalid").glob("*.twz"))[::6]:
        ended = run("gdal_translate", "-q", "-of", "ENVI", path, folder / "invalid.raw")
        assert ended.returncode in (0, 1), ended.stderr
        lines = error_lines(ended)
        assert len(lines) == ended.returncode, ended.stderr
        assert all(path.name in line for line in lines)


DAMAGE = """
bytes_of = open(asked, "rb").read()
rng = np.random.default_rng(11)
gdal.PushErrorHandler("CPLQuietErrorHandler")
gdal.DontUseExceptions()
n_opened = 0
for i in range(600):
    data = bytearray(bytes_of)
    if i % 3 == 0:
        del data[int(rng.integers(len(data))) :]
    else:
        for _ in range(1 + i % 4):
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
    gdal.FileFromMemBuffer("/vsimem/damaged.twz", bytes(data))
    dataset = gdal.Open("/vsimem/damaged.twz")
    if dataset is None:
        continue
    n_opened += 1
    dataset.ReadAsArray()
    dataset.GetRasterBand(1).GetMaskBand().ReadAsArray()
    for k in range(dataset.GetRasterBand(1).GetOverviewCount()):
        dataset.GetRasterBand(1).GetOverview(k).ReadAsArray()
print(n_opened)
"""


def test_damaged_files_never_end_the_process(folder):
    small = terrainwave.compress_to_bytes(
        np.add.outer(np.arange(130), np.arange(600)).astype(np.int16), max_error=0.5, block=32
    )
    (folder / "small.twz").write_bytes(small)
    assert 0 < by_python(DAMAGE, str(folder / "small.twz")) < 600


def test_a_file_in_a_zip_is_read(kinds, folder):
    path = kinds["float32-nodata"]
    with zipfile.ZipFile(folder / "packed.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(path, "inner/dem.twz")
    code = "np.save(asked[1], gdal.Open(asked[0]).ReadAsArray(700, 5, 300, 400)); print(0)"
    target = str(folder / "zip.npy")
    by_python(code, [f"/vsizip/{folder / 'packed.zip'}/inner/dem.twz", target])
    with terrainwave.open(path) as terrain:
        expected = terrain.read(Window(700, 5, 300, 400))
    np.testing.assert_array_equal(np.load(target), expected)


def test_the_plugin_is_small_and_exports_nothing_else():
    plugin = Path(build()) / "gdal_TWZ.so"
    assert plugin.stat().st_size < 2_000_000
    ended = run("nm", "-D", "--defined-only", "--extern-only", plugin)
    names = {line.split()[-1].split("@")[0] for line in ended.stdout.splitlines()}
    assert "GDALRegister_TWZ" in names
    assert not {name for name in names if name.startswith("twz_")}
