"""Several rasters as one: where they lie, what is void, what is refused."""

import numpy as np
import pytest
from click.testing import CliRunner
from rasterio.transform import Affine
from strategies import read_geotiff, terrain_like, write_geotiff

import terrainwave
from terrainwave.cli import main
from terrainwave.errors import InvalidHeightsError, StorageError, TerrainwaveWarning
from terrainwave.raster_io import mosaic
from terrainwave.raster_io import source as source_module
from terrainwave.raster_io.source import RasterSource

CRS = "EPSG:32633"


def tile(path, heights, row=0, col=0, *, pixel=30.0, crs=CRS, **profile):
    """Write heights whose first pixel is (row, col) of a grid of 30 m; return the path."""
    place = Affine(pixel, 0, 500_000 + 30 * col, 0, -pixel, 5_000_000 - 30 * row)
    return write_geotiff(path, heights, transform=place, crs=crs, **profile)


def read_mosaic(paths, **options):
    with RasterSource(paths, **options) as source:
        return source.info, *source.read(0, 0, source.info.n_rows, source.info.n_cols)


@pytest.fixture
def four_tiles(tmp_path):
    """A raster of 40 x 60 and four files that tile it."""
    whole = terrain_like(40, 60)
    paths = [
        tile(tmp_path / f"{row}_{col}.tif", whole[row : row + 20, col : col + 30], row, col)
        for row in (0, 20)
        for col in (0, 30)
    ]
    return whole, paths


def test_tiles_are_the_raster_they_were_cut_from(four_tiles):
    whole, paths = four_tiles
    info, heights, valid = read_mosaic(paths[::-1])  # in any order
    np.testing.assert_array_equal(heights, whole)
    assert valid.all()
    assert info.transform == (30.0, 0.0, 500_000.0, 0.0, -30.0, 5_000_000.0)
    assert (info.crs, info.mask_kind, info.nodata) == (CRS, "none", None)


def test_rasters_without_a_place_are_not_laid_on_each_other(tmp_path):
    paths = [write_geotiff(tmp_path / f"{k}.tif", terrain_like(9, 12) + k) for k in range(2)]
    with pytest.raises(InvalidHeightsError, match=r"0\.tif and 1 more: no transform says where"):
        read_mosaic(paths)


def test_window_across_tiles_is_read(four_tiles):
    whole, paths = four_tiles
    with RasterSource(paths) as source:
        np.testing.assert_array_equal(source.read(15, 25, 10, 10)[0], whole[15:25, 25:35])


def test_gaps_are_void_by_mask_where_whole_numbers_have_no_nodata(four_tiles):
    whole, paths = four_tiles
    with pytest.warns(TerrainwaveWarning, match=r"cover 75 % of the 40 x 60 samples"):
        info, heights, valid = read_mosaic([paths[0], paths[1], paths[3]])
    assert info.mask_kind == "mask"
    gap = np.zeros_like(valid)
    gap[20:, :30] = True
    np.testing.assert_array_equal(valid, ~gap)
    np.testing.assert_array_equal(heights[valid], whole[valid])


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
@pytest.mark.parametrize(
    ("dtype", "nodata", "kind"), [("float32", None, "nan"), ("int16", -9999, "nodata")]
)
def test_gaps_hold_nodata_or_nan(tmp_path, dtype, nodata, kind):
    first = tile(tmp_path / "a.tif", terrain_like(4, 4, dtype), nodata=nodata)
    second = tile(tmp_path / "b.tif", terrain_like(4, 4, dtype), 4, 4, nodata=nodata)
    info, heights, valid = read_mosaic([first, second])
    assert (info.mask_kind, info.nodata) == (kind, nodata)
    expected = np.nan if nodata is None else nodata
    np.testing.assert_array_equal(heights[~valid], np.full(32, expected, dtype))


def test_last_valid_height_counts_where_tiles_overlap(tmp_path):
    low, high = np.full((4, 4), 1, np.int16), np.full((4, 4), 2, np.int16)
    high[0, 0] = -1
    first = tile(tmp_path / "a.tif", low, nodata=-1)
    second = tile(tmp_path / "b.tif", high, 0, 2, nodata=-1)
    _, heights, _ = read_mosaic([first, second])
    np.testing.assert_array_equal(heights, [[1, 1, 1, 2, 2, 2], *[[1, 1, 2, 2, 2, 2]] * 3])


def test_mixed_nodata_become_the_first(tmp_path):
    first, second = np.array([[1, -1]], np.int16), np.array([[5, -9999]], np.int16)
    paths = [
        tile(tmp_path / "a.tif", first, nodata=-1),
        tile(tmp_path / "b.tif", second, 0, 2, nodata=-9999),
    ]
    with pytest.warns(TerrainwaveWarning, match="nodata values -1, -9999; all voids get -1$"):
        info, heights, valid = read_mosaic(paths)
    assert info.nodata == -1
    assert heights.tolist() == [[1, -1, 5, -1]]
    assert valid.tolist() == [[True, False, True, False]]


def test_height_that_is_another_tiles_nodata_is_refused_with_its_place(tmp_path):
    first = tile(tmp_path / "a.tif", np.array([[7, 0], [0, 7]], np.int16), nodata=0)
    second = tile(tmp_path / "b.tif", np.array([[3, 0], [0, 4]], np.int16), 0, 2, nodata=-1)
    with (
        pytest.warns(TerrainwaveWarning, match="nodata values 0, -1"),
        pytest.raises(InvalidHeightsError, match=r"b\.tif: the height at row 0, column 1 is 0"),
    ):
        read_mosaic([first, second])


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
def test_nodata_option_goes_for_every_tile(tmp_path):
    first = tile(tmp_path / "a.tif", np.array([[1, 9]], np.int16), nodata=1)
    second = tile(tmp_path / "b.tif", np.array([[9, 1]], np.int16), 1, 1)
    info, heights, valid = read_mosaic([first, second], nodata=9)
    assert info.nodata == 9
    assert heights.tolist() == [[9, 9, 9], [9, 9, 1]]
    assert valid.tolist() == [[False, False, False], [False, False, True]]
    info, heights, valid = read_mosaic([first, second], nodata="only:9")
    assert info.nodata == 9
    assert heights.tolist() == [[1, 9, 9], [9, 9, 1]]
    assert valid.tolist() == [[True, False, False], [False, False, True]]


def test_mask_of_a_tile_makes_voids(tmp_path):
    mask = np.array([[True, False]])
    first = tile(tmp_path / "a.tif", np.array([[1, 2]], np.int16), mask=mask)
    second = tile(tmp_path / "b.tif", np.array([[3, 4]], np.int16), 0, 2)
    info, _, valid = read_mosaic([first, second])
    assert info.mask_kind == "mask"
    assert valid.tolist() == [[True, False, True, True]]


def test_tiles_that_share_a_row_of_samples_fit(tmp_path):
    # SRTM: 1 degree in 1201 samples, corners half a pixel outside, written with ten digits.
    step, half = 1 / 4, 1 / 8
    rows = terrain_like(9, 5)
    for name, row in (("n", 0), ("s", 4)):
        place = Affine(step, 0, round(8 - half, 3), 0, -step, round(48 + half - row * step, 3))
        write_geotiff(
            tmp_path / f"{name}.tif", rows[row : row + 5], transform=place, crs="EPSG:4326"
        )
    info, heights, _ = read_mosaic([tmp_path / "s.tif", tmp_path / "n.tif"])
    np.testing.assert_array_equal(heights, rows)
    assert info.transform == (0.25, 0.0, 7.875, 0.0, -0.25, 48.125)


def test_south_up_and_rotated_grids_fit(tmp_path):
    whole = terrain_like(6, 8)
    for name, place in (
        ("south", Affine(10, 0, 7, 0, 10, 3)),
        ("turned", Affine(10, 3, 7, 4, -10, 3)),
    ):
        paths = []
        for col in (0, 4):
            moved = place @ Affine.translation(col, 0)
            paths.append(
                write_geotiff(
                    tmp_path / f"{name}{col}.tif", whole[:, col : col + 4], transform=moved
                )
            )
        info, heights, _ = read_mosaic(paths[::-1])
        np.testing.assert_array_equal(heights, whole)
        assert info.transform == pytest.approx(tuple(place)[:6])


# The right half of a raster as GDAL would store it in each order of rows and columns: its samples
# and its transform, by hand. Pixels are 10 wide and 20 high; the half has 6 rows and 4 columns.
ORDERS = {
    "south first": (lambda half: half[::-1], Affine(10, 0, 40, 0, 20, 880)),
    "east first": (lambda half: half[:, ::-1], Affine(-10, 0, 80, 0, -20, 1000)),
    "turned by 180": (lambda half: half[::-1, ::-1], Affine(-10, 0, 80, 0, 20, 880)),
    "rows are columns": (lambda half: half.T, Affine(0, 10, 40, -20, 0, 1000)),
    "turned by 90": (lambda half: np.rot90(half), Affine(0, -10, 80, -20, 0, 1000)),
    "turned by 270": (lambda half: np.rot90(half, 3), Affine(0, 10, 40, 20, 0, 880)),
    "both": (lambda half: half[::-1, ::-1].T, Affine(0, -10, 80, 20, 0, 880)),
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("is_first", [False, True])
def test_rasters_stored_in_another_order_are_turned(tmp_path, order, is_first):
    whole = terrain_like(6, 8)
    store, place = ORDERS[order]
    left = write_geotiff(
        tmp_path / "left.tif", whole[:, :4], transform=Affine(10, 0, 0, 0, -20, 1000)
    )
    right = write_geotiff(tmp_path / "right.tif", store(whole[:, 4:]), transform=place)
    paths = [right, left] if is_first else [left, right]
    with pytest.warns(TerrainwaveWarning, match="stored in another order") as noted:
        info, heights, valid = read_mosaic(paths)
    assert len(noted) == 1
    assert valid.all()
    for (row, col), height in np.ndenumerate(whole):
        x, y = 10 * col + 5, 1000 - 20 * row - 10
        at_col, at_row = ~Affine(*info.transform) @ (x, y)
        assert heights[int(at_row), int(at_col)] == height
    with pytest.warns(TerrainwaveWarning), RasterSource(paths) as source:
        part = source.read(1, 2, info.n_rows - 3, info.n_cols - 3)[0]
    np.testing.assert_array_equal(part, heights[1:-2, 2:-1])


def test_raster_turned_by_another_angle_is_refused_with_the_angle(tmp_path):
    first = tile(tmp_path / "a.tif", terrain_like(4, 4))
    place = Affine.translation(500_120, 5_000_000) @ Affine.rotation(-30) @ Affine.scale(30, -30)
    second = write_geotiff(tmp_path / "b.tif", terrain_like(4, 4), transform=place, crs=CRS)
    with pytest.raises(InvalidHeightsError, match="turned by -30 degrees"):
        RasterSource([first, second])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"crs": "EPSG:32632"}, r"found CRS EPSG:32632, .* expected one CRS.*-t_srs EPSG:32633"),
        ({"crs": None}, "found CRS none"),
        ({"pixel": 25.0}, r"found pixels of 25 x 25, .*gdalwarp -tr 30 30 -tap"),
        ({"col": 4.5, "row": 0.25}, r"0\.5 columns and 0\.25 rows beside.*gdalwarp -tr 30 30 -tap"),
        ({"bands": {"scales": 0.1}}, r"found scale 0\.1"),
        ({"heights": terrain_like(4, 4, "float32")}, "heights are float32"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_rasters_that_do_not_fit_are_refused_with_advice(tmp_path, change, message):
    first = tile(tmp_path / "a.tif", terrain_like(4, 4))
    options = {"heights": terrain_like(4, 4), "col": 4} | change
    second = tile(tmp_path / "b.tif", **options)
    with pytest.raises(InvalidHeightsError, match=message):
        RasterSource([first, second])


def test_tiles_of_other_units_are_refused_with_how_to_convert(tmp_path):
    first = tile(tmp_path / "a.tif", terrain_like(4, 4), units=("metre",))
    second = tile(tmp_path / "b.tif", terrain_like(4, 4), col=4, units=("ft",))
    with pytest.raises(InvalidHeightsError, match=r'b\.tif: found heights in ft.*"A\*0\.3048"'):
        RasterSource([first, second])


@pytest.mark.full
def test_each_file_is_opened_once_more_for_a_scan_and_few_at_a_time(tmp_path, monkeypatch):
    names = [
        tile(tmp_path / f"{row}_{col}.tif", terrain_like(16, 16), row, col)
        for row in range(0, 320, 16)
        for col in range(0, 160, 16)
    ]
    monkeypatch.setattr(mosaic, "_MAX_OPEN", 12)
    opened, most = [], 0
    open_dataset = source_module.open_dataset

    def counted(path):
        nonlocal most
        opened.append(open_dataset(path))
        most = max(most, sum(not dataset.closed for dataset in opened))
        return opened[-1]

    monkeypatch.setattr(source_module, "open_dataset", counted)
    with RasterSource(names, warn=False) as source:
        for window in source.blocks(16 * 160):
            source.read(*window)
    assert len(opened) <= 2 * len(names)
    assert most <= 12 + 1


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
def test_command_makes_one_file_of_tiles_and_it_comes_back(four_tiles, tmp_path):
    whole, paths = four_tiles
    target, back = tmp_path / "out.twz", tmp_path / "back.tif"
    some = [paths[0], paths[1], paths[3]]
    done = CliRunner().invoke(
        main, ["compress", *map(str, some), str(target), "--max-error", "1", "--method", "store"]
    )
    assert done.exit_code == 0, done.output
    assert "cover 75 %" in done.stderr
    terrainwave.decompress(target, back)
    heights, valid, profile = read_geotiff(back)
    assert profile["transform"][:6] == (30.0, 0.0, 500_000.0, 0.0, -30.0, 5_000_000.0)
    assert not valid[20:, :30].any()
    assert np.abs(heights[valid] - whole[valid]).max() <= 1


def test_target_that_is_one_of_the_sources_is_refused(four_tiles):
    _, paths = four_tiles
    link = paths[2].with_suffix(".twz")
    link.symlink_to(paths[2])
    with pytest.raises(StorageError, match="is the file to be read"):
        terrainwave.compress(paths, link, max_error=1, overwrite=True)


def write_vrt(path, parts, nodata):
    """Write a VRT of (file, row, col) as gdalbuildvrt does."""
    declared = f"<NoDataValue>{nodata}</NoDataValue>" if nodata is not None else ""
    sources = "".join(
        f'<SimpleSource><SourceFilename relativeToVRT="1">{file.name}</SourceFilename>'
        f'<SourceBand>1</SourceBand><SrcRect xOff="0" yOff="0" xSize="30" ySize="20"/>'
        f'<DstRect xOff="{col}" yOff="{row}" xSize="30" ySize="20"/></SimpleSource>'
        for file, row, col in parts
    )
    path.write_text(
        f'<VRTDataset rasterXSize="60" rasterYSize="40"><SRS>{CRS}</SRS>'
        "<GeoTransform>500000, 30, 0, 5000000, 0, -30</GeoTransform>"
        f'<VRTRasterBand dataType="Int16" band="1">{declared}{sources}</VRTRasterBand>'
        "</VRTDataset>"
    )
    return path


def test_vrt_is_void_where_it_has_no_source(four_tiles, tmp_path):
    whole, paths = four_tiles
    parts = [(paths[0], 0, 0), (paths[3], 20, 30)]
    _, heights, valid = read_mosaic(write_vrt(tmp_path / "a.vrt", parts, -9999))
    assert not valid[:20, 30:].any()
    np.testing.assert_array_equal(heights[valid], whole[valid])
    assert valid.sum() == 2 * 20 * 30


@pytest.mark.parametrize("order", [1, -1])
def test_a_vertical_datum_that_one_raster_names_is_to_be_named_by_the_other(tmp_path, order):
    first = tile(tmp_path / "a.tif", terrain_like(4, 4), crs="EPSG:2056")
    second = tile(tmp_path / "b.tif", terrain_like(4, 4), 0, 4, crs="EPSG:2056+5728")
    words = r"has a vertical datum, LN02 height.*gdal_edit -a_srs EPSG:2056\+5728"
    with pytest.raises(InvalidHeightsError, match=words):
        RasterSource([first, second][::order])


@pytest.mark.parametrize("lefts", [(179, -180), (-180, 179), (359, 0)])
def test_a_mosaic_of_both_sides_of_180_says_why_it_is_empty(tmp_path, lefts):
    paths = [
        write_geotiff(
            tmp_path / f"{left}.tif", terrain_like(4, 4), nodata=-1, crs="EPSG:4326",
            transform=Affine(0.25, 0, left, 0, -0.25, 10),
        )
        for left in lefts
    ]  # fmt: skip
    with pytest.warns(TerrainwaveWarning, match=r"cover .* void: they lie on both sides of 180"):
        RasterSource(paths).close()
