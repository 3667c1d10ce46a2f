"""Files that are patched hold the new raster; what did not change is copied."""

import re
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from cases import some
from click.testing import CliRunner
from containers import open_container
from strategies import terrain_like, write_geotiff
from twz import stated_bounds_problems, twz_bytes

import terrainwave
from terrainwave.cli import main
from terrainwave.errors import (
    BoundViolationError,
    InvalidArgumentError,
    InvalidHeightsError,
    StorageError,
)
from terrainwave.terrain import Terrain
from terrainwave.write.patch import patch
from terrainwave.write.patching import patcher
from terrainwave.write.patching.patcher import PatchEncoder

NODATA = -32768
HEIGHTS = terrain_like(140, 100, seed=11)
TRANSFORM = (2.0, 0.0, 1000.0, 0.0, -2.0, 5000.0)


def changed(heights, row=60, col=20, side=9):
    """Return heights with a hollow; their range stays as it is."""
    heights = heights.copy()
    part = heights[row : row + side, col : col + side]
    part[:] = (part.astype(np.int64) + int(heights.max())) // 2
    return heights


def with_voids(heights):
    heights = heights.copy()
    heights[30:50, 60:90] = NODATA
    return heights


@pytest.fixture
def file(tmp_path):
    """Return what makes a file of heights."""

    def make(heights, **options):
        path = tmp_path / "dem.twz"
        path.write_bytes(twz_bytes(heights, **options))
        return path

    return make


def copied_units(before, after):
    """Return the keys whose payloads are the same."""
    with open_container(before) as old, open_container(after) as new:
        keys = [*old.grid.root_keys()]
        keys += [key for level in range(old.grid.k_max) for key in old.grid.blocks(level)]
        return {key for key in keys if old.payload(key) == new.payload(key)}, set(keys)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "options",
    [
        {"mesh": "halves", "measure_meshes": True},
        *({"mesh": mesh} for mesh in ("none", "halves", "zerotree-plain", "zerotree-layer", "rqt")),
    ],
)
def test_a_lossless_file_becomes_that_of_the_new_raster(file, options):
    # So small a raster has no tables of its own, which a patch would keep.
    options = options | {"max_error": 0, "method": "predictive"}
    path = file(HEIGHTS, **options)
    result = patch(path, changed(HEIGHTS))
    assert path.read_bytes() == twz_bytes(changed(HEIGHTS), **options)
    assert (result.n_recoded, result.n_copied) == (5, 5)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", ["predictive", "rapid"])
@pytest.mark.parametrize("max_error", [0, 3])
@pytest.mark.parametrize("new", some([changed(with_voids(HEIGHTS)), with_voids(HEIGHTS)], 2))
@pytest.mark.parametrize("old", [with_voids(changed(HEIGHTS)), with_voids(HEIGHTS[::-1])])
def test_the_result_is_within_the_bound_and_true(file, tmp_path, method, max_error, new, old):
    path = file(old, max_error=max_error, nodata=NODATA, method=method)
    write_geotiff(tmp_path / "new.tif", new, nodata=NODATA)
    before = path.read_bytes()
    result = patch(path, tmp_path / "new.tif")
    report = terrainwave.verify(path, tmp_path / "new.tif", mesh=True)
    assert report.ok, report
    copied, units = copied_units(before, path.read_bytes())
    assert (result.n_copied, result.n_recoded) == (len(copied), len(units - copied))
    assert result.measured_error <= max_error


@pytest.mark.parametrize(("method", "rings"), [("predictive", 1), ("predictive", 3), ("rapid", 1)])
def test_the_same_raster_changes_nothing(file, method, rings):
    path = file(with_voids(HEIGHTS), max_error=3, nodata=NODATA, border_rings=rings, method=method)
    before, time = path.read_bytes(), path.stat().st_mtime_ns
    result = patch(path, with_voids(HEIGHTS), nodata=NODATA)
    assert (result.n_recoded, path.stat().st_mtime_ns) == (0, time)
    assert path.read_bytes() == before


def part_of(heights, path, row, col, n_rows, n_cols):
    """Write a window of heights with its place."""
    transform = (2.0, 0.0, 1000.0 + 2 * col, 0.0, -2.0, 5000.0 - 2 * row)
    window = heights[row : row + n_rows, col : col + n_cols]
    write_geotiff(path, window, transform=transform, crs="EPSG:32610")


@pytest.fixture
def placed(tmp_path):
    """Return what makes a file with a place, of the bound given."""
    write_geotiff(tmp_path / "old.tif", HEIGHTS, transform=TRANSFORM, crs="EPSG:32610")

    def make(max_error):
        path = tmp_path / "dem.twz"
        path.write_bytes(twz_bytes(tmp_path / "old.tif", max_error=max_error))
        return path

    return make


SIDECAR = """<PAMDataset>
  <Metadata><MDI key="survey">lidar</MDI></Metadata>
  <Metadata domain="TERRAINWAVE"><MDI key="MAX_ERROR">0</MDI></Metadata>
  <PAMRasterBand band="1">
    <Description>ground</Description><Minimum>1</Minimum>
    <Histograms><HistItem><HistMin>1</HistMin></HistItem></Histograms>
    <Metadata>
      <MDI key="STATISTICS_MEAN">1</MDI><MDI key="sensor">a</MDI>
    </Metadata>
  </PAMRasterBand>
</PAMDataset>"""
STATISTICS_ALONE = """<?xml version="1.0"?><PAMDataset><PAMRasterBand band="1">
<Metadata><MDI key="STATISTICS_MEAN">1</MDI></Metadata>
<Metadata domain="TERRAINWAVE"><MDI key="FINGERPRINT">1</MDI></Metadata>
</PAMRasterBand></PAMDataset>"""


@pytest.fixture
def patched_beside(placed, tmp_path):
    """Return what patches a file next to an .aux.xml: it gives the result and what is left."""
    part_of(changed(HEIGHTS), tmp_path / "new.tif", 30, 5, 80, 70)

    def patched(content):
        path = placed(0)
        sidecar, overviews = tmp_path / "dem.twz.aux.xml", tmp_path / "dem.twz.ovr"
        sidecar.write_text(content)
        overviews.write_bytes(b"overviews of the old heights")
        result = patch(path, tmp_path / "new.tif")
        assert result.n_recoded > 0
        assert not overviews.exists()
        return result, sidecar.read_text() if sidecar.exists() else None

    return patched


def test_statistics_beside_a_patched_file_go_and_what_users_wrote_stays(patched_beside):
    result, left = patched_beside(SIDECAR)
    assert all(text in left for text in ("survey", "lidar", "sensor", "<Description>ground<"))
    assert not any(
        text in left for text in ("STATISTICS", "Histograms", "Minimum", "MAX_ERROR", "TERRAINWAVE")
    )
    assert result.notes == []


def test_statistics_stay_where_a_patch_changes_nothing(placed, tmp_path):
    path = placed(0)
    (tmp_path / "dem.twz.aux.xml").write_text(STATISTICS_ALONE)
    assert patch(path, tmp_path / "old.tif").n_recoded == 0
    assert (tmp_path / "dem.twz.aux.xml").read_text() == STATISTICS_ALONE


def merged(new, row, col, n_rows, n_cols, old=HEIGHTS):
    """Return the old heights with a window of new ones."""
    heights = old.copy()
    heights[row : row + n_rows, col : col + n_cols] = new[row : row + n_rows, col : col + n_cols]
    return heights


def write_whole(heights, path):
    nodata = NODATA if (heights == NODATA).any() else None
    write_geotiff(path, heights, transform=TRANSFORM, crs="EPSG:32610", nodata=nodata)
    return path


MIDDLE = (60, 20, 9, 9)


@pytest.mark.parametrize(("mesh", "old"), [("none", HEIGHTS), ("halves", with_voids(HEIGHTS))])
def test_a_lossy_file_takes_the_change_alone(tmp_path, mesh, old):
    """It asked for a raster that reaches further, however far that reached."""
    path, bound = tmp_path / "dem.twz", 2
    write_whole(old, tmp_path / "old.tif")
    path.write_bytes(twz_bytes(tmp_path / "old.tif", max_error=bound, mesh=mesh))
    with Terrain(path) as terrain:
        before = terrain.read().astype(int)
    part_of(changed(HEIGHTS), tmp_path / "new.tif", *MIDDLE)
    result = patch(path, tmp_path / "new.tif")
    new = merged(changed(HEIGHTS), *MIDDLE, old)
    with Terrain(path) as terrain:
        after, info = terrain.read().astype(int), terrain.info()
    inside = np.zeros(before.shape, bool)
    inside[60:69, 20:29] = True
    assert np.abs(after - new)[inside].max() <= bound
    np.testing.assert_array_equal(after[~inside], before[~inside])
    assert info.effective_error == result.effective_error == bound
    assert info.moved_error == 0
    report = terrainwave.verify(path, write_whole(new, tmp_path / "all.tif"), mesh=True)
    assert report.ok, report
    assert stated_bounds_problems(path, new, NODATA) == []
    error = np.abs(after - new)[new != NODATA].max()
    assert error <= result.measured_error <= result.effective_error


@pytest.fixture
def moved(tmp_path):
    """Return a file whose heights are those of another lossy one: moved by up to 2."""
    write_whole(HEIGHTS, tmp_path / "old.tif")
    terrainwave.compress(tmp_path / "old.tif", tmp_path / "a.twz", max_error=2, block=32)
    terrainwave.decompress(tmp_path / "a.twz", tmp_path / "a.tif")
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        dataset.heights.terrainwave.to_twz(tmp_path / "dem.twz", max_error=2, block=32)
    return tmp_path / "dem.twz"


@pytest.mark.full
def test_what_heights_had_moved_before_stays_until_the_original_is_given(moved, tmp_path):
    path, new = moved, HEIGHTS
    for row, col in ((60, 20), (20, 60), (100, 40)):
        new = merged(changed(new, row, col), row, col, 9, 9, new)
        part_of(new, tmp_path / "new.tif", row, col, 9, 9)
        result = patch(path, tmp_path / "new.tif")
        assert result.effective_error == 4
        with Terrain(path) as terrain:
            error = np.abs(terrain.read().astype(int) - new).max()
        assert error <= result.measured_error <= result.effective_error
        report = terrainwave.verify(path, write_whole(new, tmp_path / "all.tif"), mesh=True)
        # But for the description, which xarray brings along.
        assert replace(report, problems=()).ok, report
    with Terrain(path) as terrain:
        assert terrain.info().moved_error == 2
        with pytest.raises(InvalidHeightsError, match="expected at least 4"):
            terrain.mesh(max_error=3)
    described = CliRunner().invoke(main, ["info", str(path)])
    assert "of it from an earlier file" in described.output
    result = patch(path, tmp_path / "new.tif", original=write_whole(new, tmp_path / "all.tif"))
    assert result.effective_error == 2
    with Terrain(path) as terrain:
        assert np.abs(terrain.read().astype(int) - new).max() <= 2
        assert (terrain.max_error, terrain.info().moved_error) == (2, 0)
    assert "of it from an earlier file" not in CliRunner().invoke(main, ["info", str(path)]).output


def test_errors_of_meshes_contain_what_heights_had_moved_before(moved, tmp_path, monkeypatch):
    """What stored heights stand in for is half a step and all earlier moves away from them."""
    measure, added = patcher.measure_meshes, []

    def noted(*arguments):
        added.append(arguments[5])
        return measure(*arguments)

    monkeypatch.setattr(patcher, "measure_meshes", noted)
    part_of(changed(HEIGHTS, 100, 40), tmp_path / "new.tif", 100, 40, 9, 9)
    measured = terrainwave.store_meshes(moved, tmp_path / "measured.twz")
    patch(measured, tmp_path / "new.tif")
    assert added == [0, 4]


def test_with_the_original_the_bound_stays(placed, tmp_path):
    path = placed(2)
    part_of(changed(HEIGHTS), tmp_path / "new.tif", *MIDDLE)
    result = patch(path, tmp_path / "new.tif", original=tmp_path / "old.tif")
    assert result.effective_error == 2
    new = merged(changed(HEIGHTS), *MIDDLE)
    report = terrainwave.verify(path, write_whole(new, tmp_path / "all.tif"), mesh=True)
    assert report.ok, report


@pytest.mark.parametrize(("dtype", "bound"), [("int16", 2), ("float32", 0.3), ("float64", 1.5)])
@pytest.mark.parametrize("method", ["rapid", "predictive"])
def test_heights_on_fixed_steps_stay_beyond_the_new_raster(tmp_path, dtype, bound, method):
    path, old = tmp_path / "dem.twz", HEIGHTS.astype(dtype)
    write_whole(old, tmp_path / "old.tif")
    terrainwave.compress(
        tmp_path / "old.tif", path, max_error=bound, stable=True, method=method, mesh="none"
    )
    with Terrain(path) as terrain:
        before, stated = terrain.read(), terrain.info().effective_error
    new = merged(changed(HEIGHTS), *MIDDLE).astype(dtype)
    part_of(new, tmp_path / "new.tif", *MIDDLE)
    result = patch(path, tmp_path / "new.tif")
    assert result.effective_error == stated
    with Terrain(path) as terrain:
        after = terrain.read()
        assert not terrain.header.has_corrections
    assert (after != before).any()
    after[60:69, 20:29], apart = before[60:69, 20:29], np.abs(after - new)[60:69, 20:29]
    np.testing.assert_array_equal(after, before)
    assert apart.max() <= bound


@pytest.mark.parametrize("max_error", [0, 2])
def test_an_original_without_an_earlier_patch_is_refused(placed, tmp_path, max_error):
    """It undid that patch without a word."""
    path = placed(max_error)
    part_of(changed(HEIGHTS), tmp_path / "new.tif", *MIDDLE)
    patch(path, tmp_path / "new.tif", original=tmp_path / "old.tif")
    before = path.read_bytes()
    part_of(changed(HEIGHTS, 100, 40), tmp_path / "other.tif", 100, 40, 9, 9)
    with pytest.raises(InvalidHeightsError, match=r"the original is .* at row 6\d, column 2\d, .*"):
        patch(path, tmp_path / "other.tif", original=tmp_path / "old.tif")
    assert path.read_bytes() == before
    # The same place again hides what the first patch changed.
    patch(path, tmp_path / "new.tif", original=tmp_path / "old.tif")


def assert_own_samples_are_those_of(path, new):
    """Check which samples of all levels are valid, and all that `check` does."""
    with Terrain(path) as terrain:
        for level in range(terrain.n_levels):
            stride = terrain.grid.stride(level)
            _, valid = terrain.read_with_mask(level=level)
            np.testing.assert_array_equal(valid, (new != NODATA)[::stride, ::stride])
        assert list(terrain.check()) == []


@pytest.mark.parametrize("method", ["predictive", "rapid"])
def test_a_patch_brings_the_first_voids_to_a_file(file, method):
    path = file(HEIGHTS, max_error=2, mesh="none", nodata=NODATA, method=method)
    for new, has_voids in ((HEIGHTS, False), (with_voids(HEIGHTS), True)):
        patch(path, new, nodata=NODATA)
        with Terrain(path) as terrain:
            assert terrain.header.has_voids == has_voids
    assert_own_samples_are_those_of(path, new)


@pytest.mark.parametrize("with_original", [False, True])
def test_the_range_that_is_refused_is_that_of_the_new_raster(placed, tmp_path, with_original):
    """With the original it was that of both together, in one window."""
    high = HEIGHTS[60:69, 20:29].copy()
    high[0, 0] = HEIGHTS.max() + 100
    write_geotiff(tmp_path / "new.tif", high, crs="EPSG:32610", transform=(2, 0, 1040, 0, -2, 4880))
    original = tmp_path / "old.tif" if with_original else None
    with pytest.raises(InvalidHeightsError, match=f"from {high.min()} to {high.max()}, the file"):
        patch(placed(2), tmp_path / "new.tif", original=original)


def test_the_file_itself_is_no_newer_raster_and_no_original(placed, tmp_path):
    path = placed(2)
    with pytest.raises(StorageError, match="is the file to be patched; expected the newer raster"):
        patch(path, path)
    with pytest.raises(StorageError, match="to be patched; as original expected the raster that"):
        patch(path, tmp_path / "old.tif", original=path)


def test_an_original_with_other_voids_is_refused(tmp_path):
    path, old = tmp_path / "dem.twz", with_voids(HEIGHTS)
    path.write_bytes(twz_bytes(write_whole(old, tmp_path / "old.tif"), max_error=2))
    other = old.copy()
    other[90, 90] = NODATA
    part_of(HEIGHTS, tmp_path / "new.tif", *MIDDLE)
    with pytest.raises(InvalidHeightsError, match="the original is void at row 90, column 90, "):
        patch(path, tmp_path / "new.tif", original=write_whole(other, tmp_path / "other.tif"))


def test_an_original_of_another_size_is_refused(placed, tmp_path):
    path = placed(2)
    part_of(changed(HEIGHTS), tmp_path / "new.tif", *MIDDLE)
    with pytest.raises(InvalidHeightsError, match="the original has 9 x 9 samples, expected"):
        patch(path, tmp_path / "new.tif", original=tmp_path / "new.tif")


def test_a_height_that_moves_is_found_by_the_proof(placed, tmp_path, monkeypatch):
    path = placed(2)
    before = path.read_bytes()
    part_of(changed(HEIGHTS), tmp_path / "new.tif", *MIDDLE)
    monkeypatch.setattr(PatchEncoder, "restored", lambda *arguments: None)
    with pytest.raises(BoundViolationError, match="which the new raster does not cover, has moved"):
        patch(path, tmp_path / "new.tif")
    assert path.read_bytes() == before


def test_readers_keep_the_old_file(file):
    path = file(HEIGHTS, max_error=0)
    with Terrain(path) as terrain:
        patch(path, changed(HEIGHTS))
        np.testing.assert_array_equal(terrain.read(), HEIGHTS)
    with Terrain(path) as terrain:
        np.testing.assert_array_equal(terrain.read(), changed(HEIGHTS))


SMALL = HEIGHTS[:9, :8]


@pytest.mark.parametrize(
    ("new", "message"),
    [
        (SMALL.astype("int32"), "dtype is int32, expected int16"),
        (
            np.full((9, 8), SMALL.max() + 5, "int16"),
            r"file can hold .* Compress the whole raster again, with height_range"
            rf" {SMALL.min()},{SMALL.max() + 5} to leave room",
        ),
        (terrain_like(10, 8), "reaches beyond the file: it begins at row 0"),
        (np.ma.masked_less(SMALL, SMALL.mean()), "has voids, and the file has no way"),
    ],
)
def test_what_the_file_cannot_hold_is_refused(file, new, message):
    path = file(SMALL, max_error=1)
    before = path.read_bytes()
    with pytest.raises(InvalidHeightsError, match=message):
        patch(path, new)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ({"crs": "EPSG:32611"}, "CRS is EPSG:32611, expected that of the file, EPSG:32610"),
        ({"transform": (2, 0, 1001, 0, -2, 5000)}, "does not lie on the file's grid"),
        ({"transform": (1, 0, 1000, 0, -1, 5000)}, "does not lie on the file's grid"),
        ({"transform": (2, 0, 998, 0, -2, 5000)}, r"begins at row 0, column -1 and has 9 x 8"),
    ],
)
def test_another_place_is_refused(tmp_path, place, message):
    own = {"crs": "EPSG:32610", "transform": TRANSFORM}
    write_geotiff(tmp_path / "old.tif", SMALL, **own)
    write_geotiff(tmp_path / "new.tif", SMALL, **own | place)
    (tmp_path / "dem.twz").write_bytes(twz_bytes(tmp_path / "old.tif", max_error=1))
    with pytest.raises(InvalidHeightsError, match=message):
        patch(tmp_path / "dem.twz", tmp_path / "new.tif")


@pytest.mark.parametrize("method", ["cdf53", "store"])
def test_other_methods_are_refused_with_advice(tmp_path, file, method):
    path = file(SMALL, method=method)
    write_geotiff(tmp_path / "new.tif", SMALL)
    result = CliRunner().invoke(main, ["patch", str(path), str(tmp_path / "new.tif")])
    assert result.exit_code == 1
    assert "only files of method rapid or predictive can be patched" in result.stderr


LOWEST, HIGHEST = int(SMALL.min()), int(SMALL.max())


@pytest.mark.parametrize("method", ["predictive", "rapid"])
@pytest.mark.parametrize("dtype", some(["int16", "float32"], 2))
@pytest.mark.parametrize("max_error", some([0, 1, 0.5], 3))
def test_a_file_with_room_takes_a_higher_summit(tmp_path, method, dtype, max_error):
    place = {"crs": "EPSG:32633", "transform": (30, 0, 0, 0, -30, 0)}
    old = HEIGHTS.astype(dtype)
    new = old.copy()
    new[3, 4], new[70, 60] = old.max() + 1, old.min() - 1
    for name, heights in (("old", old), ("new", new)):
        write_geotiff(tmp_path / f"{name}.tif", heights, **place)
    path, options = tmp_path / "dem.twz", ["--max-error", str(max_error), "--method", method]
    words = ["compress", str(tmp_path / "old.tif"), str(path), "-q", "--overwrite", *options]
    patching = ["patch", str(path), str(tmp_path / "new.tif")]
    assert CliRunner().invoke(main, words).exit_code == 0
    refused = CliRunner().invoke(main, patching)
    (given,) = re.findall(r"with --range (\S+) to leave room", refused.stderr)
    assert refused.exit_code == 1
    assert CliRunner().invoke(main, [*words, f"--range={given}"]).exit_code == 0
    assert terrainwave.verify(path, tmp_path / "old.tif").ok
    assert CliRunner().invoke(main, patching).exit_code == 0
    assert terrainwave.verify(path, tmp_path / "new.tif").ok


def test_a_range_without_effect_is_a_note_or_refused(tmp_path):
    voids = np.ma.masked_all((9, 8), "int16")
    made = terrainwave.compress(voids, tmp_path / "a.twz", height_range=(0, 9))
    assert "`height_range` has no effect" in " ".join(made.notes)
    heights = SMALL + np.float32(0.123)
    for top, is_told in ((1_000, False), (1_000_000, True)):
        made = terrainwave.compress(
            heights, tmp_path / f"{top}.twz", max_error=0.005, method="rapid", height_range=(0, top)
        )
        assert ("`height_range` is so wide" in " ".join(made.notes)) == is_told
        assert (made.effective_error == 0) == is_told
    cut = terrainwave.Cdf53(rate=1.0)
    with pytest.raises(InvalidArgumentError, match="found height_range and rate"):
        terrainwave.compress(SMALL, tmp_path / "b.twz", method=cut, height_range=(0, 5000))


def test_a_range_that_the_type_lacks_is_refused(tmp_path):
    with pytest.raises(InvalidHeightsError, match=r"from -5 to 1e\+06 .* int16"):
        terrainwave.compress(SMALL, tmp_path / "a.twz", height_range=(-5, 1e6))


@pytest.mark.parametrize("max_error", [0, 1])
@pytest.mark.parametrize(("height", "fits"), [
    (LOWEST, True), (HIGHEST, True), (LOWEST - 1, False), (HIGHEST + 1, False),
])  # fmt: skip
def test_new_heights_must_lie_in_the_range_of_the_file(file, max_error, height, fits):
    """To the last quantum, whatever the bound: units that are copied are decoded by the range."""
    path, new = file(SMALL, max_error=max_error), SMALL.copy()
    new[4, 4] = height
    if not fits:
        with pytest.raises(InvalidHeightsError, match=f"file can hold {LOWEST} to {HIGHEST} "):
            patch(path, new)
        return
    assert patch(path, new).measured_error <= max_error
    with Terrain(path) as terrain:
        assert np.abs(terrain.read().astype(int) - new).max() <= max_error


@pytest.mark.parametrize("max_error", [0, 1])
def test_a_file_with_voids_takes_new_ones_and_heights_in_their_place(file, max_error):
    old, new = SMALL.copy(), SMALL.copy()
    old[2:4, 2:5] = new[6:8, 1:4] = NODATA
    path = file(old, max_error=max_error, nodata=NODATA)
    patch(path, new, nodata=NODATA)
    with Terrain(path) as terrain:
        found = terrain.read(masked=True)
    np.testing.assert_array_equal(found.mask, new == NODATA)
    assert np.abs(found.astype(int) - new).max() <= max_error


@pytest.mark.parametrize("max_error", [0, 1])
@pytest.mark.parametrize("has_void", [False, True])
def test_a_valid_height_that_is_nodata_in_the_file_is_refused(file, max_error, has_void):
    """It was a fault of ours in a lossless file; others were moved beside it, without a word."""
    old = np.arange(72, dtype="int16").reshape(9, 8) - 20
    old[old == 7] = 8
    if has_void:
        old[0, 0] = 7
    path = file(old, max_error=max_error, nodata=7)
    before = path.read_bytes()
    new = old.copy()
    new[5, 5] = 7
    with pytest.raises(InvalidHeightsError, match="valid heights of 7, the file's nodata value"):
        patch(path, new)
    assert path.read_bytes() == before
    if has_void:
        patch(path, new, nodata=7)
        with Terrain(path) as terrain:
            np.testing.assert_array_equal(terrain.read(masked=True).mask, new == 7)


def test_a_file_of_voids_alone_takes_no_height(file):
    path = file(np.full((9, 8), NODATA, "int16"), max_error=0, nodata=NODATA)
    with pytest.raises(InvalidHeightsError, match="the file has voids alone"):
        patch(path, SMALL, nodata=NODATA)


def test_heights_between_the_files_steps_are_refused(file):
    heights = SMALL.astype("float32")
    path = file(heights, max_error=0)
    heights[3, 3] += 0.25
    with pytest.raises(InvalidHeightsError, match="no multiples of the file's vertical step 1 "):
        patch(path, heights)


@pytest.mark.parametrize("method", ["predictive", "rapid"])
@pytest.mark.parametrize("has_less", [False, True])
def test_own_samples_of_levels_are_those_of_the_new_raster(file, method, has_less):
    options = {"max_error": 0, "mesh": "none", "nodata": NODATA, "method": method}
    old, new = with_voids(HEIGHTS), with_voids(HEIGHTS)
    # Single samples on places of coarse levels: no mask of these changes.
    new[96, 16] = new[64, 72] = NODATA
    if has_less:
        new[40, 72] = HEIGHTS[40, 72]
    path = file(old, **options)
    assert patch(path, new, nodata=NODATA).n_recoded > 0
    assert_own_samples_are_those_of(path, new)
    # So small a raster has no tables of its own; a unit whose fills alone would differ is copied.
    if method == "predictive" and has_less:
        assert path.read_bytes() == twz_bytes(new, **options)


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
@pytest.mark.parametrize(("declared", "asked"), [(None, 0), (-9999, 0), (-9999, "none")])
def test_an_original_has_the_voids_that_its_file_was_told(tmp_path, declared, asked):
    heights = terrain_like(40, 40).astype(np.int16)
    heights[:4], heights[4:8] = 0, -9999
    place = {"crs": "EPSG:32632", "transform": (10.0, 0.0, 5e5, 0.0, -10.0, 5e6)}
    whole = write_geotiff(tmp_path / "whole.tif", heights, nodata=declared, **place)
    terrainwave.compress(whole, tmp_path / "a.twz", max_error=1, nodata=asked, mesh="none")
    part = place | {"transform": (10.0, 0.0, 5e5 + 200, 0.0, -10.0, 5e6 - 200)}
    new = write_geotiff(tmp_path / "new.tif", heights[12:16, 12:16], **part)
    assert patch(tmp_path / "a.twz", new, original=whole).n_recoded > 0
    heights[20:24, 20:24] = heights[12:16, 12:16]
    whole = write_geotiff(tmp_path / "later.tif", heights, nodata=declared, **place)
    terrainwave.store_meshes(tmp_path / "a.twz", tmp_path / "b.twz", original=whole)
