"""Wavelet coefficients of decoded tiles, by the samples they belong to."""

import numpy as np
import pytest

import terrainwave
from terrainwave.codec.cdf53 import refiner as cdf53
from terrainwave.errors import InvalidArgumentError
from terrainwave.grid.quadtree import Region
from terrainwave.read import tile_decoder
from terrainwave.read.tile_decoder import with_coefficients

SHAPE = (150, 205)


@pytest.fixture(scope="module")
def rough():
    rng = np.random.default_rng(3)
    return np.round(np.cumsum(rng.normal(size=SHAPE), axis=1) * 4).astype(np.int16)


@pytest.fixture
def many_tiles(monkeypatch):
    """Tiles of two blocks a side: 3 x 4 of them below the root tile."""
    monkeypatch.setattr("terrainwave.codec.cdf53.tile_layout._TILE_LOG2", 6)


def compressed(heights, path, **options):
    terrainwave.compress(heights, path, block=32, mesh="none", **options)
    return terrainwave.open(path, threads=1)


@pytest.mark.parametrize("max_error", [0, 3])
def test_they_are_the_numbers_that_the_file_holds(
    rough, many_tiles, tmp_path, monkeypatch, max_error
):
    """Those that `decode_tile` hands to the inverse transform, place by place."""
    decoded, inverse = [], cdf53.inverse_transform

    def seen(field, n_transforms, held):
        decoded.append((field.copy(), n_transforms))
        return inverse(field, n_transforms, held)

    monkeypatch.setattr(cdf53, "inverse_transform", seen)
    with compressed(rough, tmp_path / "a.twz", method="cdf53", max_error=max_error) as terrain:
        tiles = with_coefficients(terrain.decoder)
        layout = tiles._layout
        step = terrain.header.step
        assert (step > 1) == (max_error > 0)
        found = tiles.coefficients(terrain.n_levels - 1, Region(0, 0, *SHAPE))
        n_checked = 0
        for key in layout.keys():
            decoded.clear()
            tiles._decode_tile(key)
            (field, n_transforms), spec = decoded[-1], layout.spec(key)
            stride = terrain.grid.stride(spec.last)
            here = found[::stride, ::stride][spec.region.slices_in(Region(0, 0, *SHAPE))]
            n_rows, n_cols = field.shape
            for row, col in np.ndindex(n_rows, n_cols):
                both = row | col | 1 << n_transforms
                t = min((both & -both).bit_length() - 1, n_transforms)
                if t == n_transforms:
                    continue  # of the tile above
                # Band of transform t + 1: (high rows begin behind the low ones, likewise columns).
                half_rows, half_cols = (((n - 1) >> t + 1) + 1 for n in (n_rows, n_cols))
                i, j = row >> t + 1, col >> t + 1
                i += half_rows if row >> t & 1 else 0
                j += half_cols if col >> t & 1 else 0
                assert here[row, col] == abs(field[i, j]) * step
                n_checked += 1
        assert n_checked > rough.size
        assert found[0, 0] == 0


def test_a_sample_has_one_coefficient_on_all_levels_and_in_all_windows(rough, many_tiles, tmp_path):
    with compressed(rough, tmp_path / "a.twz", method="cdf53", max_error=0) as terrain:
        found = with_coefficients(terrain.decoder).coefficients(
            terrain.n_levels - 1, Region(0, 0, *SHAPE)
        )
        for level in range(terrain.n_levels):
            stride = terrain.grid.stride(level)
            for block in terrain.grid.blocks(level):
                region = terrain.grid.block_region(block)
                part = found[::stride, ::stride][region.slices_in(Region(0, 0, *SHAPE))]
                own = with_coefficients(terrain.decoder).coefficients(level, region)
                np.testing.assert_array_equal(own, part)


def test_other_methods_have_none(rough, tmp_path):
    with (
        compressed(rough, tmp_path / "a.twz", max_error=1) as terrain,
        pytest.raises(InvalidArgumentError, match="method cdf53"),
    ):
        with_coefficients(terrain.decoder)


def test_a_block_needs_no_other_tile_for_its_last_line():
    assert list(tile_decoder._blocks_along(0, 33, 32)) == [0]
    assert list(tile_decoder._blocks_along(31, 3, 32)) == [0, 1]
    assert list(tile_decoder._blocks_along(64, 1, 32)) == [1]
    assert list(tile_decoder._blocks_along(0, 1, 32)) == [0]
