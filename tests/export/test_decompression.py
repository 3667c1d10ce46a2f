"""Back to GeoTIFF and COG: heights, masks, metadata, places."""

import os

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine
from strategies import read_geotiff, terrain_like, write_geotiff

from terrainwave.errors import StorageError, TerrainwaveWarning
from terrainwave.export.geotiff import decompress
from terrainwave.raster_io.geotiff.sink import RasterSink
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.terrain import Terrain
from terrainwave.write.compress import compress

HEIGHTS = terrain_like(261, 140)
HEIGHTS[100:150, 20:90] = -32768
TRANSFORM = Affine(10.0, 0.0, 1000.0, 0.0, -10.0, 5000.0)
PROFILE = {"transform": TRANSFORM, "crs": "EPSG:32633", "nodata": -32768}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return a folder with dem.tif and its lossless dem.twz with nested levels."""
    folder = tmp_path_factory.mktemp("files")
    write_geotiff(folder / "dem.tif", HEIGHTS, **PROFILE)
    compress(folder / "dem.tif", folder / "dem.twz", max_error=0, method="store", block=32)
    return folder


def back_from(files, tmp_path, **options):
    """Decompress; return (heights, valid, profile)."""
    path = decompress(files / "dem.twz", tmp_path / "back.tif", threads=1, **options)
    return read_geotiff(path)


def round_trip(tmp_path, source, *, cog=False, **options):
    """Compress and decompress a GeoTIFF; return the path of the result."""
    compress(source, tmp_path / "dem.twz", block=32, threads=1, **options)
    return decompress(tmp_path / "dem.twz", tmp_path / "back.tif", threads=1, cog=cog)


def test_heights_and_voids_come_back(files, tmp_path):
    heights, valid, _ = back_from(files, tmp_path)
    np.testing.assert_array_equal(heights, HEIGHTS)
    np.testing.assert_array_equal(valid, HEIGHTS != -32768)


@pytest.mark.parametrize("name", ["transform", "crs", "nodata", "dtype", "width", "height"])
def test_what_the_profile_says_comes_back(files, tmp_path, name):
    _, _, profile = back_from(files, tmp_path)
    assert profile[name] == read_geotiff(files / "dem.tif")[2][name]


def test_tags_of_the_band_come_back(tmp_path):
    source = write_geotiff(
        tmp_path / "dem.tif",
        np.array([[1, 2], [3, 4]], dtype="int16"),
        units=("foot",),
        tags={"AREA_OR_POINT": "Point"},
        bands={"scales": 0.25, "offsets": -3.0, "descriptions": "bare earth"},
        **PROFILE,
    )
    with rasterio.open(round_trip(tmp_path, source, max_error=0)) as dataset:
        found = dataset.units, dataset.scales, dataset.offsets, dataset.descriptions
        assert found == (("foot",), (0.25,), (-3.0,), ("bare earth",))
        assert dataset.tags()["AREA_OR_POINT"] == "Point"


def tagged(tmp_path, color="gray", band_tags=None, **tags):
    """Return a GeoTIFF with tags, and what of it comes back as a dataset's fields."""
    source = write_geotiff(tmp_path / "dem.tif", np.arange(12, dtype="int16").reshape(3, 4))
    with rasterio.open(source, "r+") as dataset:
        dataset.colorinterp = (ColorInterp[color],)
        dataset.update_tags(**tags)
        dataset.update_tags(1, **(band_tags or {}))
    return source


@pytest.mark.parametrize("cog", [False, True])
def test_provenance_comes_back(tmp_path, cog):
    said = {"LICENCE": "CC BY 4.0 ∂", "TIFFTAG_COPYRIGHT": "me", "source": "a survey\nof 2020"}
    source = tagged(tmp_path, color="red", band_tags={"sensor": "lidar"}, **said)
    with rasterio.open(round_trip(tmp_path, source, max_error=0, cog=cog)) as dataset:
        tags = dataset.tags()
        assert {name: tags[name] for name in said} == said
        assert dataset.tags(1)["sensor"] == "lidar"
        assert dataset.colorinterp == (ColorInterp.red,)
    assert sorted(os.listdir(tmp_path)) == ["back.tif", "dem.tif", "dem.twz"]


def test_statistics_of_the_original_do_not_come_back(tmp_path):
    source = tagged(tmp_path, band_tags={"STATISTICS_MEAN": "5.5", "STATISTICS_X": "1", "a": "b"})
    with rasterio.open(round_trip(tmp_path, source, max_error=0)) as dataset:
        assert dataset.tags(1) == {"a": "b"}


def test_tags_of_a_hostile_file_do_no_harm(tmp_path):
    tags = {
        "ns": "a", "bidx": "7", "a=b": "c", "": "d", "AREA_OR_POINT": "Nowhere", "\0": "e",
        "nul": "f\0g", "<GDALMetadata>": "]]></Item>", "esc": "\x1b[31m",
        "TIFFTAG_XRESOLUTION": "x",
    }  # fmt: skip
    info = RasterInfo(
        2, 2, "int16", tags=tuple(tags.items()), band_tags=tuple(tags.items()),
        color_interpretation="__class__",
    )  # fmt: skip
    assert RasterInfo.from_metadata(info.to_metadata() | {"n_rows": 2}).band_tags
    with RasterSink(tmp_path / "a.tif", info) as sink:
        sink.write(0, 0, np.ones((2, 2), dtype="int16"), np.ones((2, 2), dtype=bool))
    with rasterio.open(tmp_path / "a.tif") as dataset:
        assert dataset.read(1).tolist() == [[1, 1], [1, 1]]
        assert dataset.tags(1)["<GDALMetadata>"] == "]]></Item>"
        assert not {"ns", "bidx", "nul", "a"} & set(dataset.tags(1))


@pytest.mark.parametrize(
    ("options", "at", "transform"),
    [
        ({"window": (7, 3, 20, 30)}, np.s_[7:27, 3:33], (10, 0, 1030, 0, -10, 4930)),
        ({"bounds": (1030, 4900, 1050, 4930)}, np.s_[7:10, 3:5], (10, 0, 1030, 0, -10, 4930)),
        # The first centre stays at (1005, 4995): pixels of 20 m begin at 995 and 5005.
        ({"level": -2}, np.s_[::2, ::2], (20, 0, 995, 0, -20, 5005)),
        ({"level": -3}, np.s_[::4, ::4], (40, 0, 985, 0, -40, 5015)),
        (
            {"level": -2, "window": (5, 3, 8, 9)},
            np.s_[10:26:2, 6:24:2],
            (20, 0, 1055, 0, -20, 4905),
        ),
    ],
)
def test_a_part_has_its_heights_and_its_place(files, tmp_path, options, at, transform):
    heights, _, profile = back_from(files, tmp_path, **options)
    # A coarse sample beside valid ones is valid, and filled, though the raster is void there.
    known = HEIGHTS[at] != -32768
    assert heights.shape == known.shape
    np.testing.assert_array_equal(heights[known], HEIGHTS[at][known])
    assert tuple(profile["transform"])[:6] == transform


@pytest.mark.parametrize(
    ("options", "at", "words"),
    [
        ({"window": (250, 130, 99, 99)}, np.s_[250:, 130:], "window reaches beyond the level's"),
        ({"window": (-3, 0, 8, 9)}, np.s_[:5, :9], "window reaches beyond the level's"),
        ({"window": (0, 0, 999, 9), "level": -2}, np.s_[::2, :18:2], "window reaches beyond"),
        ({"bounds": (0, 4900, 1050, 4930)}, np.s_[7:10, :5], "bounds reach beyond the raster's"),
    ],
)
def test_a_part_that_reaches_beyond_the_raster_is_cut_with_a_warning(
    files, tmp_path, options, at, words
):
    with pytest.warns(TerrainwaveWarning, match=words) as caught:
        heights, _, _ = back_from(files, tmp_path, **options)
    n_rows, n_cols = HEIGHTS[at].shape
    assert heights.shape == (n_rows, n_cols)
    (note,) = (str(one.message) for one in caught if words in str(one.message))
    assert f"is taken, {n_rows} x {n_cols} samples from row " in note


@pytest.mark.parametrize("n_samples", [1, 64 * 64, 10_000])
def test_the_size_of_windows_does_not_matter(files, tmp_path, monkeypatch, n_samples):
    monkeypatch.setattr("terrainwave.export.geotiff._WINDOW_SAMPLES", n_samples)
    heights, _, _ = back_from(files, tmp_path, window=(13, 5, 240, 130))
    np.testing.assert_array_equal(heights, HEIGHTS[13:253, 5:135])


def test_an_existing_target_is_refused_and_replaced_when_asked(files, tmp_path):
    (tmp_path / "back.tif").write_bytes(b"precious")
    with pytest.raises(StorageError, match="exists"):
        back_from(files, tmp_path)
    assert (tmp_path / "back.tif").read_bytes() == b"precious"
    np.testing.assert_array_equal(back_from(files, tmp_path, overwrite=True)[0], HEIGHTS)


def test_progress_ends_with_all_samples(files, tmp_path):
    seen = []
    back_from(files, tmp_path, progress=seen.append)
    assert (seen[-1].done, seen[-1].total) == (261 * 140, 261 * 140)


LARGE = terrain_like(1100, 1060, dtype="float32", seed=2)


@pytest.fixture(scope="module")
def cog(tmp_path_factory):
    """Return (decoded heights, path of the COG); the file's levels are low-pass filtered."""
    folder = tmp_path_factory.mktemp("cog")
    compress(LARGE, folder / "dem.twz", max_error=0.5, method="cdf97")
    with Terrain(folder / "dem.twz") as terrain:
        decoded = terrain.read()
    return decoded, decompress(folder / "dem.twz", folder / "dem.tif", cog=True)


@pytest.mark.full
def test_a_cog_is_one(cog):
    with rasterio.open(cog[1]) as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
