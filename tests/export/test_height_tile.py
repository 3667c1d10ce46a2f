"""16-bit height tiles: raw and PNG, what the JSON says of them, sizes, voids."""

import json
import warnings

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

from terrainwave.errors import InvalidHeightsError, StorageError, TerrainwaveWarning
from terrainwave.export.geotiff import decompress
from terrainwave.read.resample import fill_voids
from terrainwave.write.compress import compress

TRANSFORM = Affine(10.0, 0.0, 1000.0, 0.0, -10.0, 5000.0)


def make(tmp_path, heights, **profile):
    """Return a lossless .twz of a GeoTIFF with these heights."""
    options = {"crs": "EPSG:32633", "transform": TRANSFORM, "nodata": -32768} | profile
    write_geotiff(tmp_path / "dem.tif", heights, **options)
    compress(tmp_path / "dem.tif", tmp_path / "dem.twz", max_error=0, method="store", block=32)
    return tmp_path / "dem.twz"


def read_tile(path):
    """Return (samples, JSON)."""
    about = json.loads(path.with_name(f"{path.name}.json").read_text(encoding="utf-8"))
    if path.suffix == ".png":
        with rasterio.open(path) as dataset:
            assert dataset.dtypes == ("uint16",)
            return dataset.read(1), about
    samples = np.fromfile(path, dtype="<u2")
    return samples.reshape(about["rows"], about["columns"]), about


def tile_of(tmp_path, heights, name="tile.r16", profile=None, **options):
    tmp_path.mkdir(exist_ok=True)
    source = make(tmp_path, heights, **(profile or {}))
    path = tmp_path / name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)  # of windows that are stretched
        assert decompress(source, path, threads=1, **options) == str(path)
    return read_tile(path)


def heights_of(samples, about):
    return about["offset"] + about["scale"] * samples.astype(np.float64)


@pytest.mark.parametrize("name", ["tile.r16", "tile.png"])
def test_a_square_of_a_tiles_size_is_written_sample_by_sample(tmp_path, name):
    heights = terrain_like(65, 65)
    samples, about = tile_of(tmp_path, heights, name)
    assert samples.shape == (65, 65)
    assert about["resampled"] is None
    difference = np.abs(heights_of(samples, about) - heights)
    assert difference.max() <= about["error"]["quantisation"] + 1e-12
    assert about["error"]["quantisation"] <= np.ptp(heights) / 131070 * (1 + 1e-9)


def test_the_whole_range_of_16_bits_is_used(tmp_path):
    heights = terrain_like(33, 33)
    samples, about = tile_of(tmp_path, heights)
    assert (samples.min(), samples.max()) == (0, 65535)
    assert (about["minimum"], about["offset"]) == (heights.min(), heights.min())
    assert about["maximum"] == pytest.approx(float(heights.max()))


def test_raw_samples_are_little_endian_from_the_first_row(tmp_path):
    heights = np.zeros((3, 3), dtype="int16")
    heights[0, 1] = 255
    heights[2, 2] = 257
    tile_of(tmp_path, heights)
    data = (tmp_path / "tile.r16").read_bytes()
    # 255/257 of 65535 is 65025, 0xFE01
    assert data[2:4] == b"\x01\xfe"
    assert data[16:] == b"\xff\xff"
    assert len(data) == 18


def test_resampling_goes_from_corner_sample_to_corner_sample(tmp_path):
    row, col = np.mgrid[:41, :61]
    heights = (300 * row + 20 * col).astype("float32")
    samples, about = tile_of(tmp_path, heights, size=33)
    expected = 300 * np.linspace(0, 40, 33)[:, None] + 20 * np.linspace(0, 60, 33)[None, :]
    assert np.abs(heights_of(samples, about) - expected).max() <= 13200 / 131070 + 1e-6


def test_bilinear_samples_match_scipy(tmp_path):
    from scipy.interpolate import RegularGridInterpolator

    heights = terrain_like(50, 47).astype("float32")
    samples, about = tile_of(tmp_path, heights, size=65)
    surface = RegularGridInterpolator((np.arange(50), np.arange(47)), heights.astype(np.float64))
    rows, cols = np.meshgrid(np.linspace(0, 49, 65), np.linspace(0, 46, 65), indexing="ij")
    difference = np.abs(heights_of(samples, about) - surface((rows, cols)))
    assert difference.max() <= about["error"]["quantisation"] + 1e-9


def test_window_keeps_its_own_shape_when_asked(tmp_path):
    heights = terrain_like(70, 140)
    samples, about = tile_of(tmp_path, heights, window=(5, 6, 20, 30), size="window")
    assert samples.shape == (20, 30)
    found = heights_of(samples, about)
    np.testing.assert_allclose(found, heights[5:25, 6:36], atol=about["scale"] / 2 + 1e-9)


def test_voids_take_the_lowest_height_and_are_counted(tmp_path):
    heights = terrain_like(33, 33)
    heights[3:5, 7:10] = -32768
    samples, about = tile_of(tmp_path, heights)
    assert about["n_void"] == 6
    assert (samples[3:5, 7:10] == 0).all()
    assert about["offset"] == heights[heights > -32768].min()


def test_resampling_near_a_void_uses_its_valid_neighbours(tmp_path):
    heights = np.full((5, 5), 100, dtype="int16")
    heights[0, 0] = 50
    heights[2, 2] = -32768
    samples, about = tile_of(tmp_path, heights, size=9)
    found = heights_of(samples, about)
    assert about["n_void"] == 1
    assert found[4, 4] == 50  # the void itself
    assert found[3, 4] == pytest.approx(100)
    assert found[5, 5] == pytest.approx(100)


@pytest.mark.parametrize("height", [7, -32768])
def test_flat_and_empty_tiles_have_one_height(tmp_path, height):
    samples, about = tile_of(tmp_path, np.full((5, 5), height, dtype="int16"))
    assert (samples == 0).all()
    assert about["offset"] == (7 if height == 7 else 0)
    assert about["n_void"] == (0 if height == 7 else 25)
    assert about["scale"] > 0


def test_json_tells_place_and_errors(tmp_path):
    heights = terrain_like(41, 61)
    _, about = tile_of(tmp_path, heights, size=33)
    assert about["crs"] == "EPSG:32633"
    assert about["file"] == "tile.r16"
    # the outermost samples: centres of the corner pixels
    assert about["bounds"] == pytest.approx([1005, 4595, 1605, 4995])
    assert about["pixel_size"] == pytest.approx([600 / 32, 400 / 32])
    # pixels around the samples: half of one out from the first
    first = [600 / 32, 0, 1005 - 300 / 32, 0, -400 / 32, 4995 + 200 / 32]
    assert about["transform"] == pytest.approx(first)
    assert about["error"]["decoded"] == 0
    assert about["error"]["sum"] == about["error"]["quantisation"] > 0


def test_scale_and_offset_of_the_band_are_applied(tmp_path):
    heights = terrain_like(17, 17)
    samples, about = tile_of(
        tmp_path, heights, profile={"bands": {"scales": 0.25, "offsets": -3.0}, "units": ("ft",)}
    )
    assert about["offset"] == 0.25 * heights.min() - 3
    assert about["unit"] == "ft"
    assert heights_of(samples, about).max() == pytest.approx(0.25 * heights.max() - 3)


@pytest.mark.parametrize(
    ("shape", "name", "options", "message"),
    [
        *(
            ((33, 33), "tile.r16", {"size": size}, r"2\^n \+ 1")
            for size in (0, 2, 64, 66, 1024, 32769, -3, "big")
        ),
        ((1, 33), "tile.r16", {}, "at least 2 x 2"),
        ((9, 9), "back.tif", {"size": 65}, "height tiles"),
        ((9, 9), "tile.png", {"cog": True}, "COG"),
        ((9, 9), "tile.r16", {"voids": "highest"}, "expected lowest, fill or a height"),
        ((9, 9), "tile.r16", {"voids": float("nan")}, "expected lowest, fill or a height"),
    ],
)
def test_what_no_tile_can_be_is_refused(tmp_path, shape, name, options, message):
    source = make(tmp_path, terrain_like(*shape))
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InvalidHeightsError, match=message):
        decompress(source, tmp_path / name, **options)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("existing", ["tile.r16", "tile.r16.json"])
def test_existing_files_are_kept_and_nothing_is_added(tmp_path, existing):
    source = make(tmp_path, terrain_like(9, 9))
    (tmp_path / existing).write_text("mine")
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(StorageError, match="already exists"):
        decompress(source, tmp_path / "tile.r16")
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert (tmp_path / existing).read_text() == "mine"
    decompress(source, tmp_path / "tile.r16", overwrite=True)
    assert (tmp_path / "tile.r16").stat().st_size == 2 * 81


def with_hole():
    """Return a slope of 50 m a row with a hole, int16."""
    heights = np.repeat(50 * np.arange(33, dtype="int16")[:, None], 33, axis=1)
    heights[10:20, 12:22] = -32768
    return heights


def test_voids_are_filled_from_around(tmp_path):
    samples, about = tile_of(tmp_path, with_hole(), voids="fill")
    heights = heights_of(samples, about)
    assert (about["n_void"], about["void"]) == (100, "filled from around")
    hole = heights[10:20, 12:22]
    assert hole.min() > 450
    assert hole.max() < 1000
    assert (np.diff(hole.mean(axis=1)) > 0).all()
    assert about["minimum"] == 0


def test_voids_become_a_height_that_is_asked_for(tmp_path):
    samples, about = tile_of(tmp_path, with_hole(), voids=-10)
    heights = heights_of(samples, about)
    assert (about["void"], about["minimum"]) == (-10.0, -10.0)
    np.testing.assert_array_equal(heights[10:20, 12:22], -10)
    assert abs(heights[32] - 1600).max() <= about["error"]["quantisation"] + 1e-9


def test_fills_keep_what_is_known_and_lie_between():
    rng = np.random.default_rng(3)
    heights = rng.normal(size=(37, 22))
    valid = rng.random(heights.shape) < 0.2
    filled = fill_voids(heights, valid, 4)
    np.testing.assert_array_equal(filled[valid], heights[valid])
    known = heights[valid]
    assert ((known.min() <= filled) & (filled <= known.max())).all()
    assert not np.isnan(fill_voids(heights, np.zeros_like(valid), 4)).any()
