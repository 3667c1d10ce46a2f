"""Orthophotos warped to a terrain's grid: where they lie, how large they get, what is refused."""

import math

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.enums import ColorInterp

from benchmarks.slow_server import SlowServer
from terrainwave.errors import InvalidHeightsError, StorageError
from terrainwave.raster_io.drape import Photo

# A grid of 30 m pixels in UTM zone 33 north.
GRID = (30.0, 0.0, 500000.0, 0.0, -30.0, 5200000.0)
SHAPE = (40, 60)
LIMITS = {"max_side": 4096, "max_bytes": 1 << 24}


def write(path, bands, *, crs="EPSG:32633", transform=GRID, alpha=False, colormap=None):
    bands = np.asarray(bands)
    with rasterio.open(
        path, "w", driver="GTiff", count=bands.shape[0], height=bands.shape[1],
        width=bands.shape[2], dtype=bands.dtype, crs=crs, transform=rasterio.Affine(*transform),
    ) as target:  # fmt: skip
        if alpha:
            target.colorinterp = [*target.colorinterp[:-1], ColorInterp.alpha]
        target.write(bands)
        if colormap:
            target.write_colormap(1, colormap)
    return str(path)


def drape(path, *, crs="EPSG:32633", affine=GRID, shape=SHAPE, **limits):
    with Photo(path, crs=crs, affine=affine, shape=shape) as photo:
        return photo.whole(**(LIMITS | limits))


def noise(*shape, seed=1):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_a_photo_on_the_same_grid_comes_back_as_it_is(tmp_path):
    bands = noise(3, *SHAPE)
    found = drape(write(tmp_path / "a.tif", bands))
    np.testing.assert_array_equal(found.pixels[..., :3], np.moveaxis(bands, 0, -1))
    assert (found.pixels[..., 3] == 255).all()
    assert found[1:] == (0, 0, 60, 40)


def test_a_photo_of_a_part_is_kept_at_its_own_resolution(tmp_path):
    bands = noise(3, 100, 50)
    path = write(tmp_path / "a.tif", bands, transform=(3, 0, 500300, 0, -3, 5199700))
    found = drape(path)
    assert found[1:] == (10, 10, 5, 10)
    np.testing.assert_array_equal(found.pixels[..., :3], np.moveaxis(bands, 0, -1))


def test_what_reaches_past_the_terrain_is_left_out(tmp_path):
    path = write(tmp_path / "a.tif", noise(3, 90, 90), transform=(30, 0, 499400, 0, -30, 5200900))
    found = drape(path)
    assert found[1:] == (0, 0, 60, 40)
    assert found.pixels.shape == (40, 60, 4)


def test_another_projection_is_warped_to_the_place_it_shows(tmp_path):
    """Each pixel holds its own longitude and latitude, in 256 steps."""
    left, bottom, right, top = 14.99, 46.94, 15.03, 46.96
    n = 256
    ramp = np.arange(n, dtype=np.uint8)
    bands = [np.tile(ramp, (n, 1)), np.tile(ramp[:, None], (1, n)), np.zeros((n, n), np.uint8)]
    transform = ((right - left) / n, 0, left, 0, (bottom - top) / n, top)
    found = drape(write(tmp_path / "a.tif", bands, crs="EPSG:4326", transform=transform))
    height, width = found.pixels.shape[:2]
    rows, cols = np.mgrid[2 : height - 2 : 7, 2 : width - 2 : 7]
    x = 500000 + 30 * (found.col + (cols + 0.5) * found.n_cols / width)
    y = 5200000 - 30 * (found.row + (rows + 0.5) * found.n_rows / height)
    longitude, latitude = rasterio.warp.transform(
        "EPSG:32633", "EPSG:4326", x.ravel().tolist(), y.ravel().tolist()
    )
    expected_x = (np.array(longitude) - left) / (right - left) * n - 0.5
    expected_y = (top - np.array(latitude)) / (top - bottom) * n - 0.5
    pixels = found.pixels[rows.ravel(), cols.ravel()].astype(float)
    known = pixels[:, 3] == 255
    assert known.sum() > 100
    assert np.abs(pixels[:, 0] - expected_x)[known].max() < 1.5
    assert np.abs(pixels[:, 1] - expected_y)[known].max() < 1.5


@pytest.mark.parametrize(
    ("limits", "size"),
    [({"max_side": 100}, (66, 100)), ({"max_bytes": 6000 * 4}, (63, 94))],
)
def test_a_large_photo_shrinks_to_the_limits(tmp_path, limits, size):
    path = write(tmp_path / "a.tif", noise(3, 400, 600), transform=(3, 0, 500000, 0, -3, 5200000))
    assert drape(path, **limits).pixels.shape == (*size, 4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transform": (30, 0, 900000, 0, -30, 5200000)}, "beside the terrain"),
        ({"crs": None}, "has no coordinate reference system and the terrain has one"),
        ({"transform": (1, 0, 0, 0, 1, 0)}, "does not say where it lies"),
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_photo_in_the_wrong_place_is_refused(tmp_path, options, message):
    path = write(tmp_path / "a.tif", noise(3, *SHAPE), **options)
    with pytest.raises(InvalidHeightsError, match=message):
        drape(path)


@pytest.mark.parametrize("bands", [noise(2, 9, 9), noise(3, 9, 9).astype(np.uint16)])
def test_what_is_no_picture_of_eight_bits_is_refused(tmp_path, bands):
    with pytest.raises(InvalidHeightsError, match="expected a picture of 1 or 3 bands of 8 bits"):
        drape(write(tmp_path / "a.tif", bands))


@pytest.mark.full
def test_of_a_large_file_on_a_server_only_what_a_window_needs_is_read(tmp_path):
    path, side = tmp_path / "a.tif", 4096
    bands = noise(3, side, side)
    with rasterio.open(
        path, "w", driver="COG", count=3, height=side, width=side, dtype="uint8", blocksize=256,
        crs="EPSG:32633", transform=rasterio.Affine(0.4, 0, 500000, 0, -0.4, 5200000),
    ) as target:  # fmt: skip
        target.write(bands)
    with (
        SlowServer(tmp_path, 0.0, 0) as server,
        Photo(server.url("a.tif"), crs="EPSG:32633", affine=GRID, shape=SHAPE) as photo,
    ):
        assert photo.whole(250, 1 << 24).pixels.shape == (181, 250, 4)
        assert server.n_bytes < 0.1 * path.stat().st_size
        found = photo.part((10.0, 20.0, 2.0, 2.0), (150, 150))  # 60 m of 0.4 m
        assert server.n_bytes < 0.15 * path.stat().st_size
        expected = np.moveaxis(bands[:, 1500:1650, 750:900], 0, -1)
        np.testing.assert_array_equal(found.pixels[..., :3], expected)
        server.is_down = True
        with pytest.raises(StorageError, match=r"cannot warp http.*a\.tif") as raised:
            photo.part((40.0, 30.0, 2.0, 2.0), (150, 150))
        assert "\n" not in str(raised.value)


def test_of_tiles_those_of_the_zoom_that_fits_are_fetched_and_missing_ones_are_clear(tmp_path):
    # 1,800 m in 256 texels are 7.0 m; at 47 degrees, pixels of zoom 14 are 6.5 m.
    left, bottom, right, top = rasterio.warp.transform_bounds(
        "EPSG:32633", "EPSG:3857", 500000, 5198800, 501800, 5200000
    )
    edge = math.pi * 6378137
    cols, rows = (
        range(int((edge + low) / (2 * edge) * 2**14), int((edge + high) / (2 * edge) * 2**14) + 1)
        for low, high in ((left, right), (-top, -bottom))
    )
    for col in cols:
        (tmp_path / f"14/{col}").mkdir(parents=True)
        for row in rows:
            Image.new("RGB", (256, 256), (200, col % 256, row % 256)).save(
                tmp_path / f"14/{col}/{row}.png"
            )
    with (
        SlowServer(tmp_path, 0.0, 0) as server,
        Photo(
            server.url("{z}/{x}/{y}.png?key=a&b=c"), crs="EPSG:32633", affine=GRID, shape=SHAPE
        ) as photo,
    ):
        pixels = photo.whole(256, 1 << 24).pixels
        assert max(pixels.shape) in (255, 256)
        assert (pixels[..., 3] == 255).all()
        assert (pixels[..., 0] == 200).all()
        assert set(np.unique(pixels[..., 1])) <= {col % 256 for col in cols}
        asked = {exchange.path for exchange in server.log}
        expected = {f"/14/{col}/{row}.png?key=a&b=c" for col in cols for row in rows}
        assert asked == expected
        assert {exchange.user_agent for exchange in server.log} == {"terrainwave"}
        clear = photo.part((10.0, 20.0, 2.0, 2.0), (200, 200)).pixels  # zooms that are not there
        assert not clear[..., 3].any()
        server.is_down = True
        with pytest.raises(StorageError, match="cannot warp http"):
            photo.part((0.0, 0.0, 60.0, 40.0), (60, 40))


def test_grey_alpha_and_palettes_become_colours(tmp_path):
    grey, alpha = noise(*SHAPE), noise(*SHAPE, seed=2) // 128 * 255
    found = drape(write(tmp_path / "g.tif", [grey, alpha], alpha=True)).pixels
    assert (found[..., 3] == alpha).all()
    seen = alpha == 255
    assert (found[seen, :3] == grey[seen, None]).all()
    table = {0: (255, 0, 0, 255), 1: (0, 255, 0, 255), 2: (9, 9, 9, 255)}
    classes = noise(*SHAPE) % 3
    found = drape(write(tmp_path / "p.tif", [classes], colormap=table)).pixels
    expected = np.array([table[k] for k in range(3)])[classes]
    np.testing.assert_array_equal(found, expected)
