"""Samples of coarse levels are void where the full grid is; what has no voids says so."""

import numpy as np
import pytest
import rasterio
import reference
from cases import some
from containers import open_container
from strategies import terrain_like, write_geotiff
from twz import twz_bytes

import terrainwave
from terrainwave.errors import InvalidArgumentError

NODATA = -32768
METHODS = ["rapid", "predictive", "cdf97", "cdf53", "store"]
SHAPE = (140, 101)


def valid_samples(shape=SHAPE):
    """Return validity with a lake and its island, void specks and a few valid ones in the open."""
    row, col = np.indices(shape)
    distance = (row - shape[0] // 3) ** 2 + (col - shape[1] // 2) ** 2
    valid = ((row * 31 + col * 17) % 97 != 0) & ((distance > 23**2) | (distance < 4))
    valid[shape[0] * 2 // 3 :, : shape[1] // 2] = False
    valid[-9:-3, 7:11] = True
    return valid


VALID = valid_samples()
HEIGHTS = np.where(VALID, terrain_like(*SHAPE, seed=3), NODATA).astype("int16")


def made(method="rapid", heights=HEIGHTS, **options):
    return twz_bytes(
        heights, **{"max_error": 2, "nodata": NODATA, "method": method, "mesh": "none", **options}
    )


def own(terrain, level, valid=VALID):
    """Return which samples of a level are valid in the full grid."""
    stride = terrain.grid.stride(terrain.level_index(level))
    return valid[::stride, ::stride]


@pytest.mark.parametrize("border_rings", [1, 3])
@pytest.mark.parametrize("method", METHODS)
def test_exact_voids_are_those_of_the_full_grid(method, border_rings):
    if border_rings == 3 and method in ("cdf53", "rapid"):
        return
    data = made(method, border_rings=border_rings)
    with terrainwave.open(data, threads=1) as terrain:
        assert terrain.info().has_voids
        assert list(terrain.check()) == []
        n_fills = 0
        for level in range(terrain.n_levels):
            shift = terrain.n_levels - 1 - level
            heights, valid = terrain.read_with_mask(level=level, voids="exact")
            filled, is_near = terrain.read_with_mask(level=level, voids="any")
            np.testing.assert_array_equal(valid, own(terrain, level))
            np.testing.assert_array_equal(is_near, reference.level_mask(VALID, shift))
            np.testing.assert_array_equal(heights, np.where(valid, filled, NODATA))
            n_fills += np.count_nonzero(is_near & ~valid)
        assert n_fills > 100


@pytest.mark.parametrize("method", ["rapid", "cdf53"])
@pytest.mark.parametrize("shape", [SHAPE, (30, 30)], ids=["levels", "one-level"])
def test_a_file_says_whether_any_sample_is_void(method, shape):
    part = np.s_[: shape[0], : shape[1]]
    whole, void = terrain_like(*shape, seed=3).astype("int16"), np.full(shape, NODATA, "int16")
    one = whole.copy()
    one[-1, -1] = NODATA
    for heights, has_voids in ((whole, False), (HEIGHTS[part], True), (one, True), (void, True)):
        with terrainwave.open(made(method, heights), threads=1) as terrain:
            assert (terrain.header.has_voids, terrain.info().voids) == (has_voids, "nodata")
            np.testing.assert_array_equal(terrain.read() == NODATA, heights == NODATA)


def test_exact_voids_are_the_default():
    with terrainwave.open(made(), threads=2) as terrain:
        for level in range(terrain.n_levels):
            expected = own(terrain, level)
            read = terrain.read(level=level, masked=True)
            np.testing.assert_array_equal(~np.ma.getmaskarray(read), expected)
            np.testing.assert_array_equal(read.data == NODATA, ~expected)
            row, col, n_rows, n_cols = 3, 1, *(n // 2 for n in expected.shape)
            part = terrain.read((row, col, n_rows, n_cols), level=level)
            at = np.s_[row : row + n_rows, col : col + n_cols]
            np.testing.assert_array_equal(part != NODATA, expected[at])
        shape = terrain.level_shape(-3)
        full_shape = tuple(4 * n for n in shape)
        # Samples of a level four times coarser than what is asked for.
        window = (0, 0, *(min(n, size) for n, size in zip(full_shape, SHAPE, strict=True)))
        size = window[2] // 4, window[3] // 4
        resampled = terrain.read(window, out_shape=size)
        filled = terrain.read(window, out_shape=size, voids="any")
        assert np.count_nonzero(resampled == NODATA) > np.count_nonzero(filled == NODATA)


def test_samples_beside_voids_are_told_from_fills():
    with terrainwave.open(made(), threads=1) as terrain:
        level = terrain.n_levels - 2
        filled = terrain.read_with_mask(level=level, voids="any")[1]
        exact = own(terrain, level)
        rows, cols = np.nonzero(filled & ~exact)
        a, _, c, _, e, f = terrain.transform_of(level)[:6]
        places = np.stack([c + a * (cols + 0.5), f + e * (rows + 0.5)], axis=1)
        assert np.isnan(terrain.sample(places, level=level)).all()
        assert np.isfinite(terrain.sample(places, level=level, voids="any")).all()
        rows, cols = np.nonzero(exact)
        places = np.stack([c + a * (cols + 0.5), f + e * (rows + 0.5)], axis=1)
        assert np.isfinite(terrain.sample(places, level=level)).all()
        assert np.isnan(terrain.sample([(0.0, 0.0)], level=level)).all()


def test_a_damaged_unit_of_the_full_grid_hides_nothing_of_coarse_levels():
    data = bytearray(made("store"))
    with open_container(data) as container:
        key = container.grid.blocks(container.grid.k_max - 1)[0]
        (place,) = [at for at in range(len(data)) if data[at:].startswith(container.payload(key))]
    data[place + 8] ^= 255
    with terrainwave.open(bytes(data), threads=1) as terrain:
        _, valid = terrain.read_with_mask(level=-2)
        np.testing.assert_array_equal(valid, own(terrain, -2))


def test_early_reads_leave_fills_out():
    with terrainwave.open(made("cdf53"), threads=1) as terrain:
        for level in range(terrain.n_levels):
            found = terrain.read_early(level=level, quality=0.5)
            np.testing.assert_array_equal(found.valid, own(terrain, level))
            found = terrain.read_early(level=level, quality=0.5, voids="any")
            shift = terrain.n_levels - 1 - level
            np.testing.assert_array_equal(found.valid, reference.level_mask(VALID, shift))


@pytest.mark.parametrize("kind", some(["mask", "nan", "nodata"], 3))
def test_geotiffs_of_levels_are_void_where_the_raster_is(tmp_path, kind):
    heights, profile = HEIGHTS, {"nodata": NODATA}
    if kind == "nan":
        heights, profile = np.where(VALID, HEIGHTS, np.nan).astype("float32"), {}
    if kind == "mask":
        heights, profile = np.where(VALID, HEIGHTS, 5).astype("int16"), {"mask": VALID}
    source, file = tmp_path / "dem.tif", tmp_path / "dem.twz"
    write_geotiff(source, heights, **profile)
    terrainwave.compress(source, file, max_error=2, block=32, mesh="none")
    with terrainwave.open(file) as terrain:
        n_levels = terrain.n_levels
    for level in (-2, -n_levels):
        for voids, expected in (
            (None, VALID[:: 2 ** (-level - 1), :: 2 ** (-level - 1)]),
            ("exact", VALID[:: 2 ** (-level - 1), :: 2 ** (-level - 1)]),
            ("any", reference.level_mask(VALID, -level - 1)),
        ):
            target = tmp_path / "level.tif"
            terrainwave.decompress(file, target, level=level, voids=voids, overwrite=True)
            with rasterio.open(target) as dataset:
                found = dataset.read_masks(1) > 0
                if kind == "nan":
                    found = np.isfinite(dataset.read(1))
            np.testing.assert_array_equal(found, expected)
    with pytest.raises(InvalidArgumentError, match="voids 'lowest', which is for height tiles"):
        terrainwave.decompress(file, tmp_path / "other.tif", level=-2, voids="lowest")
