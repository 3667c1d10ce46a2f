"""Does `verify` find what is wrong, and nothing where nothing is?"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import (
    CorruptStreamError,
    InvalidArgumentError,
    InvalidHeightsError,
    StorageError,
)
from terrainwave.place.meaning import Told
from terrainwave.verification.heights import ErrorSum, verify


class FakeTerrain:
    """Stands in for an open .twz file; decodes to whatever it is given."""

    def __init__(self, heights, valid=None, *, max_error=0.0, effective_error=None, **changes):
        self.heights = heights
        self.valid = np.ones(heights.shape, bool) if valid is None else np.asarray(valid)
        self.shape, self.dtype = heights.shape, heights.dtype
        self.max_error = max_error
        self.effective_error = max_error if effective_error is None else effective_error
        self.nodata = changes.pop("nodata", None)
        self.crs = changes.pop("crs", None)
        self._transform = Affine(*changes.pop("transform", (1, 0, 0, 0, 1, 0)))
        self.bad_row = changes.pop("bad_row", None)
        self.n_levels = 1
        self.header = SimpleNamespace(bound_side="both")
        self.container = SimpleNamespace(n_missing=0, extents=SimpleNamespace(file_size=0))
        self.problems = changes.pop("problems", ())
        fields = {
            "units": None,
            "scale": 1.0,
            "offset": 0.0,
            "description": None,
            "area_or_point": "Area",
            "rounding_error": 0.05,
            "method": "rapid",
            "earlier": (),
            "coordinate_epoch": None,
            "minimum": None,
            "maximum": None,
        }
        self._info = SimpleNamespace(**(fields | changes))

    def info(self):
        return self._info

    @property
    def raster_info(self):
        own_kind = None, Told(), self.crs
        return SimpleNamespace(
            crs=self.crs, own_kind=lambda *_, is_asked: own_kind, stored_side=lambda _: 0
        )

    @property
    def transform(self):
        return self._transform

    def digest(self):
        return None

    def even_blocks(self):
        return None

    def check(self, root=None, window=None):
        yield from self.problems

    def read(self, window=None, *, masked=False, level=-1):
        row, col, n_rows, n_cols = window
        if self.bad_row is not None and row <= self.bad_row < row + n_rows:
            raise CorruptStreamError("block (3, 0, 0) is damaged")
        part = np.s_[row : row + n_rows, col : col + n_cols]
        return np.ma.MaskedArray(self.heights[part], ~self.valid[part])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


@pytest.fixture
def compare(tmp_path, monkeypatch):
    """Return a function that verifies a fake decoded file against a real original."""

    def run(original, terrain, *, mask=None, options=None, **profile):
        monkeypatch.setattr("terrainwave.terrain.Terrain", lambda _, **__: terrain)
        profile = {"tags": {"AREA_OR_POINT": "Area"}, **profile}
        path = write_geotiff(tmp_path / "a.tif", original, mask=mask, **profile)
        return verify("a.twz", path, **(options or {}))

    return run


def test_equal_heights_are_fine(compare):
    heights = terrain_like(300, 400)
    report = compare(heights, FakeTerrain(heights))
    assert report.ok, report.problems
    assert report.errors.n_valid == heights.size
    assert (report.errors.max_error, report.errors.rmse) == (0, 0)
    assert report.errors.worst_row is None


def test_difference_at_the_bound_is_fine_and_one_above_is_named(compare):
    heights = terrain_like(300, 400)
    decoded = heights.copy()
    decoded[123, 45] += 3
    assert compare(heights, FakeTerrain(decoded, max_error=3.0)).ok
    report = compare(heights, FakeTerrain(decoded, max_error=2.0))
    assert report.problems == (
        "1 sample is further from the original than 2; the worst, at row 123, column 45, by 3",
    )
    assert report.errors.max_error == 3
    assert report.errors.rmse == pytest.approx(3 / math.sqrt(heights.size))


def test_effective_error_that_lost_a_digit_still_allows_its_whole_steps(compare):
    heights = terrain_like(9, 9)
    stated = 0.29999999999999993  # three steps of 0.1, rounded down somewhere
    terrain = FakeTerrain(heights + np.int16(3), max_error=0.3, effective_error=stated, scale=0.1)
    assert compare(heights, terrain, bands={"scales": 0.1}).ok


def test_effective_error_above_the_asked_one_is_a_problem(compare):
    heights = terrain_like(9, 9)
    report = compare(heights, FakeTerrain(heights, max_error=1.0, effective_error=2.0))
    assert "effective error of 2.0, above the 1.0" in report.problems[0]


def test_other_bound_can_be_asked_for(compare):
    heights = terrain_like(9, 9)
    terrain = FakeTerrain(heights + np.int16(1), max_error=5.0)
    assert not compare(heights, terrain, options={"max_error": 0.5}).ok


@pytest.mark.parametrize(("bound", "ok"), [(0.3, True), (0.29, False), (0.8, True)])
def test_bound_is_physical_and_exact_after_scale(compare, bound, ok):
    # 3 * 0.1 is above 0.3 in floating point: integers are compared in whole steps.
    heights = terrain_like(9, 9)
    terrain = FakeTerrain(heights + np.int16(3), max_error=bound, scale=0.1)
    report = compare(heights, terrain, bands={"scales": 0.1})
    assert report.ok is ok, report.problems
    assert report.errors.max_error == pytest.approx(0.3)


def test_decimal_floats_are_allowed_one_ulp_of_their_type(compare):
    # float32(1000.4) - float32(1000.3) is 0.10004, though both stand for whole decimetres.
    original = np.array([[1000.3]], "float32")
    decoded = np.array([[1000.4]], "float32")
    assert float(decoded[0, 0]) - float(original[0, 0]) > 0.1
    assert compare(original, FakeTerrain(decoded, max_error=0.1, rounding_error=0.0)).ok
    assert not compare(original, FakeTerrain(decoded, max_error=0.1)).ok
    further = np.nextafter(np.nextafter(decoded, np.float32(2000)), np.float32(2000))
    assert not compare(original, FakeTerrain(further, max_error=0.1, rounding_error=0.0)).ok


def test_lossless_floats_are_allowed_nothing(compare):
    original = np.array([[1000.2]], "float32")
    decoded = np.nextafter(original, np.float32(0))
    assert not compare(original, FakeTerrain(decoded, max_error=0.0, rounding_error=0.0)).ok


def test_mask_differences_are_counted(compare):
    heights = terrain_like(10, 10)
    heights[2, 3] = -1
    valid = heights != -1
    fine = FakeTerrain(heights, valid, nodata=-1)
    assert compare(heights, fine, nodata=-1).ok
    valid = valid.copy()
    valid[5, 5] = False
    report = compare(heights, FakeTerrain(heights, valid, nodata=-1), nodata=-1)
    assert report.problems == ("1 samples are void in one of the two and valid in the other",)
    assert report.errors.n_mask_differences == 1


def test_nan_and_internal_mask_count_as_void(compare):
    heights = terrain_like(4, 4, "float32")
    heights[0, 0] = np.nan
    mask = np.ones((4, 4), bool)
    mask[1, 1] = False
    valid = mask.copy()
    valid[0, 0] = False
    assert compare(heights, FakeTerrain(heights, valid), mask=mask).ok
    assert not compare(heights, FakeTerrain(heights, mask), mask=mask).ok


def test_valid_sample_that_decodes_to_nodata_is_a_problem(compare):
    heights = terrain_like(4, 4)
    decoded = heights.copy()
    decoded[0, 0] = -5
    terrain = FakeTerrain(decoded, max_error=1000.0, nodata=-5)
    report = compare(heights, terrain, nodata=-5)
    assert report.problems == ("1 valid samples decode to the nodata value -5.0",)


def test_decoded_nan_among_valid_samples_is_beyond_any_bound(compare):
    heights = terrain_like(4, 4, "float32")
    decoded = heights.copy()
    decoded[3, 2] = np.nan
    report = compare(heights, FakeTerrain(decoded, max_error=1000.0))
    assert "row 3, column 2" in report.problems[0]


@pytest.mark.parametrize("extreme", [np.inf, -np.inf, *np.finfo("float32").max * np.array([1, -1])])
@pytest.mark.parametrize("has_other", [False, True])
def test_an_extreme_original_is_beyond_any_bound_though_it_has_no_ulp(compare, extreme, has_other):
    decoded = terrain_like(4, 4, "float32")
    heights = decoded.copy()
    heights[3, 2] = extreme
    heights[0, 0] += 5 * has_other
    report = compare(heights, FakeTerrain(decoded, max_error=0.1, rounding_error=0.0))
    assert not report.ok
    assert "row 3, column 2" in report.problems[0]


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"units": "ft"}, "units is 'ft', the original's is None"),
        ({"scale": 2.0}, "scale is 2.0"),
        ({"offset": 2.0}, "offset is 2.0"),
        ({"description": "z"}, "description is 'z'"),
        ({"area_or_point": "Point"}, "AREA_OR_POINT is 'Point'"),
        ({"nodata": 7}, "nodata is 7, the original's is None"),
        ({"transform": (2, 0, 0, 0, 2, 0)}, "the transform is (2.0,"),
        ({"crs": "EPSG:4326"}, "the CRS is EPSG:4326, the original's is missing"),
    ],
)
def test_changed_metadata_are_a_problem(compare, changes, problem):
    heights = terrain_like(4, 4)
    report = compare(heights, FakeTerrain(heights, **changes))
    assert len(report.problems) == 1
    assert problem in report.problems[0]


@pytest.mark.parametrize(
    ("units", "of_original", "problem"),
    [
        ("metre", "ft", "A*0.3048"),
        ("ft", "US survey foot", "A*1.000002"),
        ("m/yr", "m", "if both mean the same"),
    ],
)
def test_heights_of_another_unit_are_not_compared(compare, units, of_original, problem):
    heights = terrain_like(4, 4)
    report = compare(heights, FakeTerrain(heights, units=units), units=[of_original])
    assert report.errors is None
    assert len(report.problems) == 1
    assert f"found heights in {of_original}, the file has {units}" in report.problems[0]
    assert problem in report.problems[0]


def test_crs_is_compared_by_its_definition(compare):
    heights = terrain_like(4, 4)
    nearly = rasterio.CRS.from_epsg(32611).to_wkt().replace("298.257223563", "298.257223564")
    assert compare(heights, FakeTerrain(heights, crs="EPSG:32611"), crs="EPSG:32611").ok
    report = compare(heights, FakeTerrain(heights, crs=nearly), crs="EPSG:32611")
    assert "298.257223564" in report.problems[0]


def test_other_shape_or_type_is_reported_without_comparing_heights(compare):
    heights = terrain_like(4, 5)
    report = compare(heights, FakeTerrain(heights[:, :4]))
    assert report.problems == ("size is (4, 4), the original's is (4, 5)",)
    assert report.errors is None
    report = compare(heights, FakeTerrain(heights.astype("int32")))
    assert "type is 'int32'" in report.problems[0]


@pytest.mark.parametrize("layout", [{}, {"tiled": True, "blockxsize": 64, "blockysize": 64}])
def test_undecodable_window_is_named_and_the_rest_is_compared(compare, layout, monkeypatch):
    monkeypatch.setattr("terrainwave.verification.original._WINDOW_SAMPLES", 256 * 500)
    monkeypatch.setattr("terrainwave.verification.original._WINDOW_SIDE", 256)
    heights = terrain_like(700, 500)
    decoded = heights.copy()
    decoded[699, 499] += 9
    terrain = FakeTerrain(decoded, max_error=1.0, bad_row=300)
    report = compare(heights, terrain, **layout)
    assert report.problems[0].startswith("rows 256 to 511, columns 0 to ")
    assert "block (3, 0, 0) is damaged" in report.problems[0]
    assert "row 699, column 499, by 9" in report.problems[-1]
    assert report.errors.n_valid == heights.size - 256 * 500


def test_nodata_given_at_compression_and_band_are_taken_over(compare):
    layers = np.stack([terrain_like(4, 4), terrain_like(4, 4, seed=1)])
    heights = layers[1].copy()
    heights[0, 0] = 0
    layers[1] = heights
    terrain = FakeTerrain(heights, heights != 0, nodata=0)
    assert compare(layers, terrain, options={"band": 2, "nodata": 0}).ok
    with pytest.raises(InvalidHeightsError, match="found band 3, expected 1"):
        compare(layers, terrain, options={"band": 3})


def test_without_an_original_the_file_checks_itself(monkeypatch):
    terrain = FakeTerrain(terrain_like(4, 4), problems=["block (1, 0, 0) is damaged"])
    monkeypatch.setattr("terrainwave.terrain.Terrain", lambda _, **__: terrain)
    report = verify("a.twz")
    assert not report.ok
    assert report.problems == ("block (1, 0, 0) is damaged",)
    assert report.errors is None


def test_errors_are_summed_over_windows_in_any_order():
    original = np.zeros((4, 6), "uint8")
    decoded = np.array([[0, 0, 2, 0, 0, 0]] * 4, "uint8")
    decoded[3, 5] = 200
    valid = np.ones((4, 6), bool)
    valid[0, 2] = False
    total = ErrorSum(scale=-0.5)
    for row in (2, 0):
        part = np.s_[row : row + 2]
        total.add(row, 0, original[part], decoded[part], valid[part], np.ones((2, 6), bool))
    report = total.report()
    # 23 samples valid in both; three of them 2 off, one 200 off; everything halved.
    assert report.n_valid == 23
    assert report.max_error == 100
    assert (report.worst_row, report.worst_col) == (3, 5)
    assert report.rmse == pytest.approx(math.sqrt((3 * 4 + 200**2) / 23) / 2)
    assert report.n_mask_differences == 1


@pytest.mark.parametrize(("method", "max_error"), [("cdf53", 0.0), ("rapid", 0.5)])
def test_the_sign_of_zero_counts_only_where_every_bit_was_promised(compare, method, max_error):
    heights = np.array([[1.0, -0.0], [0.0, 3.0]], np.float32)
    unsigned = np.abs(heights)
    report = compare(heights, FakeTerrain(unsigned, max_error=max_error, method=method))
    assert report.problems == ()
    (problem,) = compare(heights, FakeTerrain(unsigned)).problems
    assert "1 sample is 0.0 in one of the two and -0.0 in the other" in problem
    assert "row 0, column 1" in problem


@pytest.mark.few(4)
@pytest.mark.parametrize("layout", [{}, {"tiled": True, "blockxsize": 16, "blockysize": 16}])
@pytest.mark.parametrize("flips", [(True, False), (False, True), (True, True)])
def test_a_copy_in_another_order_of_rows_and_columns_is_turned(tmp_path, flips, layout):
    heights = terrain_like(40, 50)
    heights[3:9, 20:] = -1
    place = {"crs": "EPSG:32633", "nodata": -1}
    north = write_geotiff(
        tmp_path / "north.tif", heights, transform=Affine(30, 0, 5e5, 0, -30, 5e6), **place
    )
    terrainwave.compress(north, tmp_path / "a.twz", max_error=2)
    turned = Affine(30, 0, 5e5, 0, -30, 5e6)
    if flips[0]:
        turned, heights = turned @ Affine(1, 0, 0, 0, -1, 40), heights[::-1]
    if flips[1]:
        turned, heights = turned @ Affine(-1, 0, 50, 0, 1, 0), heights[:, ::-1]
    south = write_geotiff(tmp_path / "south.tif", heights, transform=turned, **place, **layout)
    with pytest.warns(terrainwave.TerrainwaveWarning, match="turned to its order"):
        assert verify(tmp_path / "a.twz", south).ok
    other = write_geotiff(tmp_path / "other.tif", heights + 9, transform=turned, **place)
    with pytest.warns(terrainwave.TerrainwaveWarning, match="turned to its order"):
        assert not verify(tmp_path / "a.twz", other).ok


PLACE = Affine(30, 0, 5e5, 0, -30, 5e6)
PART = PLACE @ Affine.translation(40, 30)


@pytest.fixture
def patched(tmp_path):
    """Return a lossy file of 90 x 120 samples, and the heights of a part that it was patched with.

    The part begins at row 30, column 40, has another nodata value, and a void.
    """
    heights = terrain_like(90, 120)
    old = write_geotiff(
        tmp_path / "old.tif", heights, transform=PLACE, crs="EPSG:32633", nodata=-32768
    )
    terrainwave.compress(old, tmp_path / "a.twz", max_error=2, block=32)
    new = np.clip(heights[30:70, 40:90] + 9, heights.min(), heights.max()).astype(heights.dtype)
    new[3, 4] = -9999
    terrainwave.patch(tmp_path / "a.twz", part_raster(tmp_path, new))
    return new


def part_raster(folder, heights, transform=PART, **profile):
    profile = {"crs": "EPSG:32633", "nodata": -9999, **profile}
    return write_geotiff(folder / "new.tif", heights, transform=transform, **profile)


def verified_part(folder, *args, **profile):
    return verify(folder / "a.twz", part_raster(folder, *args, **profile), part=True)


@pytest.mark.large
@pytest.mark.few(1)
def test_a_part_is_compared_where_it_was_patched(patched, tmp_path):
    report = verified_part(tmp_path, patched)
    assert report.ok, report.problems
    assert report.window == report.to_dict()["window"] == (30, 40, 40, 50)
    assert report.errors.n_valid == patched.size - 1
    assert verify(tmp_path / "a.twz", tmp_path / "old.tif").window is None


@pytest.mark.large
def test_a_sample_beyond_the_bound_is_named_by_its_place_in_the_file(patched, tmp_path):
    patched[7, 5] += 30
    (problem,) = verified_part(tmp_path, patched).problems
    assert "the worst, at row 37, column 45, by" in problem


@pytest.mark.large
def test_a_void_of_a_part_that_the_file_has_not_is_a_problem(patched, tmp_path):
    patched[9, 9] = -9999
    assert "void in one of the two" in verified_part(tmp_path, patched).problems[0]


@pytest.mark.large
@pytest.mark.parametrize("layout", [{}, {"tiled": True, "blockxsize": 16, "blockysize": 16}])
@pytest.mark.filterwarnings("ignore:.*turned to its order")
def test_a_part_in_another_order_of_rows_is_turned(patched, tmp_path, layout):
    turned = PART @ Affine(1, 0, 0, 0, -1, 40)
    report = verified_part(tmp_path, patched[::-1], turned, **layout)
    assert report.ok, report.problems
    assert report.window == (30, 40, 40, 50)
    assert not verified_part(tmp_path, patched, turned, **layout).ok


@pytest.mark.large
@pytest.mark.few(4)
@pytest.mark.parametrize(
    "transform",
    [
        PLACE @ Affine.translation(40.5, 30),
        PLACE @ Affine.translation(80, 30),
        PLACE @ Affine.translation(-1, 30),
        PART @ Affine.scale(1.1),
        Affine(0, 0, 5e5, 0, 0, 5e6),
        Affine(30, 0, np.nan, 0, -30, 5e6),
    ],
)
def test_a_part_off_the_grid_or_beyond_the_file_is_not_compared(patched, tmp_path, transform):
    report = verified_part(tmp_path, patched, transform)
    (problem,) = report.problems
    assert "does not lie on the file's grid, or reaches beyond the file" in problem
    assert report.errors is None
    assert report.window is None


@pytest.mark.large
@pytest.mark.parametrize(
    ("profile", "problem"),
    [({"crs": "EPSG:32632"}, "the CRS is"), ({"bands": {"scales": 0.1}}, "scale is 1.0")],
)
def test_a_part_of_another_kind_is_a_problem(patched, tmp_path, profile, problem):
    assert problem in " ".join(verified_part(tmp_path, patched, **profile).problems)


def test_a_smaller_original_is_a_problem_that_names_the_way_out(patched, tmp_path):
    report = verify(tmp_path / "a.twz", part_raster(tmp_path, patched))
    assert "`part`" in report.problems[0]
    assert report.errors is None


def test_a_part_needs_an_original_and_no_meshes(patched, tmp_path):
    with pytest.raises(InvalidArgumentError, match="found part without original"):
        verify(tmp_path / "a.twz", part=True)
    with pytest.raises(InvalidArgumentError, match="found part with mesh"):
        verify(tmp_path / "a.twz", tmp_path / "new.tif", part=True, mesh=True)


def test_missing_original_is_named(tmp_path, monkeypatch):
    terrain = FakeTerrain(terrain_like(4, 4))
    monkeypatch.setattr("terrainwave.terrain.Terrain", lambda _, **__: terrain)
    with pytest.raises(StorageError, match="no such file"):
        verify("a.twz", tmp_path / "a.tif")
