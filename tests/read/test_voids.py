"""Samples of coarse levels are void where the full grid is, in files of both formats."""

import json
import re
import warnings

import numpy as np
import pytest
import rasterio
import reference
from cases import some
from click.testing import CliRunner
from containers import open_container
from golden_files import GOLDEN
from reference_decoder.files import read_file
from strategies import terrain_like, write_geotiff
from twz import twz_bytes

import terrainwave
from terrainwave.cli import main
from terrainwave.codec import group
from terrainwave.codec.registry import newer_layout
from terrainwave.errors import (
    CorruptStreamError,
    InvalidArgumentError,
    TerrainwaveWarning,
    UnsupportedVersionError,
)
from terrainwave.grid.quadtree import Region

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


def without_warning(action):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return action()


@pytest.mark.large
@pytest.mark.parametrize("file_format", ["1.0", "1.1"])
@pytest.mark.parametrize("border_rings", [1, 3])
@pytest.mark.parametrize("method", METHODS)
def test_exact_voids_are_those_of_the_full_grid(method, border_rings, file_format):
    if border_rings == 3 and method == "cdf53":
        return
    data = made(method, border_rings=border_rings, format=file_format)
    with terrainwave.open(data, threads=1) as terrain:
        assert terrain.info().format == file_format
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


@pytest.mark.large
@pytest.mark.parametrize("method", METHODS)
def test_heights_are_those_of_a_file_that_does_not_tell(method):
    # The tables of rapid are by the mean in both: the raster is not rough.
    with (
        terrainwave.open(made(method), threads=1) as new,
        terrainwave.open(made(method, format="1.0"), threads=1) as old,
    ):
        assert (new.header.has_fills, old.header.has_fills) == (True, False)
        for level in range(new.n_levels):
            found, expected = (file.read_with_mask(level=level, voids="any") for file in (new, old))
            np.testing.assert_array_equal(found[0], expected[0])
            np.testing.assert_array_equal(found[1], expected[1])
        assert new.info().n_bytes < 1.02 * old.info().n_bytes


def test_what_has_no_voids_is_the_same_in_both_formats():
    whole = terrain_like(*SHAPE, seed=3)
    assert made(heights=whole) == made(heights=whole, format="1.0")
    one_level = HEIGHTS[:30, :30]
    assert (one_level == NODATA).any()
    assert made(heights=one_level) == made(heights=one_level, format="1.0")
    void = np.full(SHAPE, NODATA, "int16")
    assert made(heights=void) == made(heights=void, format="1.0")


@pytest.mark.large
def test_exact_voids_are_the_default_of_a_file_that_tells_them():
    with terrainwave.open(made(), threads=2) as terrain:
        for level in range(terrain.n_levels):
            expected = own(terrain, level)
            read = without_warning(lambda level=level: terrain.read(level=level, masked=True))
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
    for file_format in ("1.0", "1.1"):
        with terrainwave.open(made(format=file_format), threads=1) as terrain:
            level = terrain.n_levels - 2
            filled = terrain.read_with_mask(level=level, voids="any")[1]
            exact = own(terrain, level)
            rows, cols = np.nonzero(filled & ~exact)
            a, _, c, _, e, f = terrain.transform_of(level)[:6]
            places = np.stack([c + a * (cols + 0.5), f + e * (rows + 0.5)], axis=1)
            assert np.isnan(terrain.sample(places, level=level, voids="exact")).all()
            assert np.isfinite(terrain.sample(places, level=level, voids="any")).all()
            rows, cols = np.nonzero(exact)
            places = np.stack([c + a * (cols + 0.5), f + e * (rows + 0.5)], axis=1)
            assert np.isfinite(terrain.sample(places, level=level, voids="exact")).all()
            if file_format == "1.1":
                assert np.isnan(terrain.sample([(0.0, 0.0)], level=level)).all()


def test_an_older_file_says_once_that_it_does_not_tell():
    with terrainwave.open(made(format="1.0"), threads=1) as terrain:
        without_warning(terrain.read)  # of the full grid all is known
        without_warning(lambda: terrain.read(level=-2, voids="any"))
        without_warning(lambda: terrain.read(level=-2, voids="exact"))
        with pytest.warns(TerrainwaveWarning, match=r"format 1\.0.*voids 'exact'") as found:
            heights = terrain.read(level=-2)
        assert len(found) == 1
        assert found[0].filename == __file__
        np.testing.assert_array_equal(heights, terrain.read(level=-2, voids="any"))
        without_warning(lambda: terrain.read(level=-3))
    with terrainwave.open(made(heights=terrain_like(*SHAPE, seed=3), format="1.0")) as terrain:
        without_warning(lambda: terrain.read(level=-2))


def test_an_older_files_finest_payloads_are_read_for_their_masks_alone(monkeypatch):
    data = made(format="1.0")
    with terrainwave.open(data, threads=1) as terrain:
        heights, _ = terrain.read_with_mask(level=-2, voids="any")
        expected = own(terrain, -2)

        def refuse(*_):
            raise AssertionError("heights were decoded")

        monkeypatch.setattr(group, "decode_unit", refuse)
        # What the first read has decoded is at hand.
        found, valid = terrain.read_with_mask(level=-2, voids="exact")
        np.testing.assert_array_equal(valid, expected)
        np.testing.assert_array_equal(found, np.where(expected, heights, NODATA))


@pytest.mark.parametrize("file_format", ["1.0", "1.1"])
def test_a_damaged_unit_of_the_full_grid_hides_its_own_samples_alone(file_format):
    data = bytearray(made("store", format=file_format))
    with open_container(data) as container:
        key = container.grid.blocks(container.grid.k_max - 1)[0]
        (place,) = [at for at in range(len(data)) if data[at:].startswith(container.payload(key))]
        where = container.grid.group_region(key)
    data[place + 8] ^= 255
    with terrainwave.open(bytes(data), threads=1) as terrain:
        expected = own(terrain, -2)
        if file_format == "1.0":
            with pytest.raises(CorruptStreamError):
                terrain.read(level=-2, voids="exact")
            _, valid = terrain.read_with_mask(level=-2, voids="exact", on_error="mask")
            inside = Region(0, 0, where.n_rows // 2, where.n_cols // 2)
            assert not valid[: inside.n_rows, : inside.n_cols].any()
            expected = expected.copy()
            expected[: where.n_rows // 2 + 1, : where.n_cols // 2 + 1] = False
            expected[where.n_rows // 2, :] = valid[where.n_rows // 2, :]
            expected[:, where.n_cols // 2] = valid[:, where.n_cols // 2]
            np.testing.assert_array_equal(valid, expected)
        else:
            _, valid = terrain.read_with_mask(level=-2)
            np.testing.assert_array_equal(valid, expected)


def test_early_reads_leave_fills_out():
    for file_format in ("1.0", "1.1"):
        data = made("cdf53", format=file_format)
        with terrainwave.open(data, threads=1) as terrain:
            for level in range(terrain.n_levels):
                found = terrain.read_early(level=level, quality=0.5, voids="exact")
                np.testing.assert_array_equal(found.valid, own(terrain, level))
                found = terrain.read_early(level=level, quality=0.5, voids="any")
                shift = terrain.n_levels - 1 - level
                np.testing.assert_array_equal(found.valid, reference.level_mask(VALID, shift))


def test_other_voids_are_refused():
    with terrainwave.open(made(), threads=1) as terrain:
        for action in (
            lambda: terrain.read(voids="all"),
            lambda: terrain.read(level=-2, voids="all", out_shape=(3, 3)),
            lambda: terrain.read_with_mask(voids=True),
            lambda: terrain.sample([(5.0, 5.0)], voids="fill"),
        ):
            with pytest.raises(InvalidArgumentError, match="expected exact or any"):
                action()


@pytest.mark.large
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


def test_format_1_0_has_no_bit_and_no_layout_of_1_1(tmp_path):
    # Rough ground, whose tables have weights or contexts by reach where they may have.
    rough = np.random.default_rng(1).integers(0, 2, (140, 140)).repeat(3, 0)[:140] * 500
    rough += np.indices((140, 140)).sum(0)
    rough[30:60, 70:90] = NODATA
    rough = rough.astype("int16")
    with terrainwave.open(made(heights=rough, max_error=0)) as terrain:
        layout = newer_layout("rapid", terrain.header.parameters)
        assert layout, "the raster is not rough enough for the test"
        assert terrain.header.features == 16 + {3: 8, 5: 32}[layout]
        assert terrain.info().format == "1.1"
    data = made(heights=rough, max_error=0, format="1.0")
    header = read_file(data).header
    assert header.features == 0
    with terrainwave.open(data) as terrain:
        assert newer_layout("rapid", terrain.header.parameters) == 0
        assert terrain.info().format == "1.0"
        np.testing.assert_array_equal(terrain.read(), rough)
    with pytest.raises(InvalidArgumentError, match=r"found format '1\.2', expected 1\.0 or 1\.1"):
        made(format="1.2")


def test_kept_bits_are_refused_by_name():
    for name, words in (
        ("5", "unknown features .*weights"),  # of method store, as the next one
        ("6", "corrections of method store"),
        ("7", "unknown features .*zero"),
    ):
        with pytest.raises(UnsupportedVersionError, match=words):
            terrainwave.open(GOLDEN / "v1" / "invalid" / f"feature-kept-{name}.twz")


def test_tables_by_reach_without_their_bit_are_of_format_1_1():
    for name in ("rapid-reach-int16-lossless", "rapid-reach-told-int16"):
        with terrainwave.open(GOLDEN / "v1" / f"{name}.twz") as terrain:
            assert terrain.info().format == "1.1"


def test_the_command_line_writes_formats_and_shows_voids(tmp_path):
    source, file, target = tmp_path / "dem.tif", tmp_path / "dem.twz", tmp_path / "level.tif"
    write_geotiff(source, HEIGHTS, nodata=NODATA)

    def run(*arguments):
        done = CliRunner().invoke(main, [*map(str, arguments)])
        assert done.exit_code == 0, done.output + done.stderr
        return done

    for file_format in ("1.0", "1.1"):
        more = ["--max-error", 2, "--block", 32, "--no-mesh", "--overwrite"]
        run("compress", source, file, *more, *(["--format", "1.0"] * (file_format == "1.0")))
        assert re.search(rf"^format +{re.escape(file_format)}", run("info", file).stdout, re.M)
        assert json.loads(run("info", file, "--json").stdout)["format"] == file_format
        for voids in (None, "exact", "any"):
            options = [] if voids is None else ["--voids", voids]
            done = run("decompress", file, target, "--level=-2", "--overwrite", *options)
            is_told = voids is not None or file_format == "1.1"
            assert ("note: the file is of format 1.0" in done.stderr) != is_told
            assert ("--voids 'exact'" in done.stderr) != is_told
            is_exact = voids == "exact" or (voids is None and file_format == "1.1")
            with rasterio.open(target) as dataset:
                found = dataset.read_masks(1) > 0
            expected = VALID[::2, ::2] if is_exact else reference.level_mask(VALID, 1)
            np.testing.assert_array_equal(found, expected)
