"""Validity comes back exactly, costs little where it is simple, and survives damage."""

from unittest.mock import patch

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import valid_masks

from terrainwave.codec import masks
from terrainwave.codec.masks import Above, decode_validity, encode_validity
from terrainwave.codec.refiner import Validity, all_void, as_array
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Region


class Levels:
    """Validity of all levels of a raster, each coded as one unit below the level above."""

    def __init__(self, valid, n_levels):
        shifts = range(n_levels - 1, -1, -1)
        own = [valid[:: 1 << shift, :: 1 << shift] for shift in shifts]
        self.levels = [
            Validity.of(reference.level_mask(valid, shift), part)
            for shift, part in zip(shifts, own, strict=True)
        ]
        self.regions = [Region(0, 0, *part.shape) for part in own]

    def place(self, index):
        """Return the region of a level, what is above, and whether it is the finest."""
        above = Above(self.regions[index - 1], self.levels[index - 1]) if index else None
        return self.regions[index], above, index == len(self.levels) - 1

    def coded(self, index):
        region, above, is_finest = self.place(index)
        return encode_validity(self.levels[index], region, above, is_finest=is_finest)

    def decoded(self, index, section):
        region, above, is_finest = self.place(index)
        return decode_validity(section, region, above, is_finest=is_finest)


def arrays(validity, region):
    """Return which samples are valid, and which by themselves."""
    return as_array(validity.mask, region.shape), as_array(validity.own_mask, region.shape)


def alone(valid):
    """Return the section of a mask that is a raster's only level."""
    region = Region(0, 0, *valid.shape)
    return encode_validity(Validity.of(valid), region, None, is_finest=True)


def specks(n_rows, n_cols):
    """Return validity with single void samples and single valid ones, a lake and its island."""
    row, col = np.indices((n_rows, n_cols))
    valid = (row * 31 + col * 17) % 97 != 0
    distance = (row - n_rows // 3) ** 2 + (col - n_cols // 2) ** 2
    valid &= (distance > (n_rows // 5) ** 2) | (distance < 9)
    return valid & (row + 2 * col > n_rows // 4) | ((row % 29 == 7) & (col % 23 == 5))


shapes = st.sampled_from([(1, 1), (1, 2), (1, 17), (2, 70), (16, 2), (17, 13), (9, 22)])


@given(st.data(), shapes)
def test_validity_comes_back_on_each_level(data, shape):
    levels = Levels(data.draw(valid_masks(shape)), 3)
    for index, expected in enumerate(levels.levels):
        found = levels.decoded(index, levels.coded(index))
        region = levels.regions[index]
        np.testing.assert_array_equal(arrays(found, region), arrays(expected, region))
        assert [part is None for part in found] == [part is None for part in expected]


@given(
    st.tuples(*[st.integers(0, 9)] * 2), st.tuples(*[st.integers(1, 70)] * 2),
    st.tuples(*[st.integers(0, 1)] * 4), st.integers(0, 99), st.booleans(),
)  # fmt: skip
def test_validity_comes_back_of_regions_that_begin_anywhere(corner, shape, aprons, seed, is_finest):
    region, outer = Region(*corner, *shape), reference.outer_region(corner, shape, aprons)
    rng = np.random.default_rng(seed)
    above_own = rng.random(outer.shape) < rng.random()
    above = Validity.of(above_own | (rng.random(outer.shape) < 0.5), above_own)
    implied = reference.implied_voids(region, outer, as_array(above.mask, outer.shape))
    own = ~implied & (rng.random(shape) < rng.random())
    rows, cols = (first + (first & 1) >> 1 for first in corner)
    inherited = own[corner[0] & 1 :: 2, corner[1] & 1 :: 2]
    inherited[...] = above_own[rows - outer.row :, cols - outer.col :][
        : inherited.shape[0], : inherited.shape[1]
    ]
    near = np.pad(own, 1)
    beside = np.zeros(shape, dtype=bool)
    for i in range(3):
        for j in range(3):
            beside |= near[i : i + shape[0], j : j + shape[1]]
    mask = own if is_finest else ~implied & (beside | (rng.random(shape) < 0.5))
    around = Above(outer, above)
    section = encode_validity(Validity.of(mask, own), region, around, is_finest=is_finest)
    found = decode_validity(section, region, around, is_finest=is_finest)
    np.testing.assert_array_equal(arrays(found, region), (mask, own))
    simplest = decode_validity(b"", region, around, is_finest=False)
    np.testing.assert_array_equal(as_array(simplest.mask, shape), ~implied)


def test_what_follows_from_the_level_above_takes_no_bytes():
    valid = np.ones((33, 29), dtype=bool)
    assert not any(Levels(valid, 3).coded(index) for index in range(3))
    outer, region = Region(0, 0, 9, 9), Region(0, 0, 17, 17)
    above = np.ones((9, 9), dtype=bool)
    above[3:6] = False
    mask = ~reference.implied_voids(region, outer, above)
    around = Above(outer, Validity.of(above))
    assert encode_validity(Validity.of(mask), region, around, is_finest=True) == b""


def test_a_disc_costs_less_than_four_bits_per_sample_of_its_outline():
    # Its outline has about 2 pi 24 = 150 samples; the 4225 inside and outside say nothing new.
    row, col = np.indices((65, 65))
    assert 8 * len(alone((row - 32) ** 2 + (col - 32) ** 2 < 24**2)) < 4 * 150


@pytest.mark.large
@pytest.mark.parametrize(("share", "most"), [(0.05, 1.1), (0.2, 1.06), (0.5, 1.04)])
def test_noise_costs_hardly_more_than_its_entropy(share, most):
    mask = np.random.default_rng(0).random((257, 257)) < share
    entropy = -(share * np.log2(share) + (1 - share) * np.log2(1 - share)) * mask.size
    assert 8 * len(alone(mask)) < most * entropy


@pytest.mark.large
@pytest.mark.parametrize("is_valid", [False, True])
def test_samples_that_are_as_their_neighbours_are_not_read_one_by_one(is_valid):
    """Of 263,169 samples, those that share a bit are 32 at a time."""
    valid = np.full((513, 513), is_valid)
    valid[100, 200] = not is_valid
    logged = []

    def count(models, bits):
        logged.append(models.size)
        return b"\0"

    with patch.object(masks, "_packed", count):
        alone(valid)
    assert sum(logged) < 1.2 * valid.size / masks.GROUP


@pytest.mark.parametrize("index", [0, 1, 2])
def test_damage_is_found_or_gives_some_validity_whose_own_samples_are_valid(index):
    levels = Levels(specks(60, 55), 3)
    section = levels.coded(index)
    region, above, _ = levels.place(index)
    n_found = 0
    for at in range(0, 8 * len(section), 7):
        broken = bytearray(section)
        broken[at // 8] ^= 1 << at % 8
        try:
            found = levels.decoded(index, bytes(broken))
        except CorruptStreamError:
            n_found += 1
        else:
            valid, own = arrays(found, region)
            assert not (own & ~valid).any()
            if above is not None:
                outer_valid = as_array(above.validity.mask, above.region.shape)
                implied = reference.implied_voids(region, above.region, outer_valid)
                assert not (valid & implied).any()
    assert n_found


@pytest.mark.parametrize("shape", [(20, 21), (90, 91)])
def test_every_prefix_and_more_bytes_are_rejected(shape):
    """Of sections with one state, and with four."""
    valid = np.random.default_rng(1).random(shape) < 0.5
    section, region = alone(valid), Region(0, 0, *shape)
    assert (section[0] >= 128) == (shape == (90, 91))
    damaged = [section[:n] for n in range(1, len(section), 1 + len(section) // 20)]
    for data in [*damaged, section + b"\0", section + b"\0\0", section + bytes(99)]:
        with pytest.raises(CorruptStreamError):
            decode_validity(data, region, None, is_finest=True)


@given(st.binary(min_size=1, max_size=80), valid_masks((13, 12)), st.booleans(), st.booleans())
def test_any_bytes_are_decoded_or_refused(data, valid, is_root, is_finest):
    region = Region(0, 0, 13, 11) if is_root else Region(6, 4, 13, 11)
    outer = Region(3, 2, 7, 6)
    own = valid[:7, :6]
    above = None if is_root else Above(outer, Validity.of(own | valid[6:, 6:], own))
    try:
        found = decode_validity(data, region, above, is_finest=is_finest)
    except CorruptStreamError:
        return
    mask, by_itself = arrays(found, region)
    assert mask.shape == by_itself.shape == region.shape
    assert not (by_itself & ~mask).any()


def test_a_parent_without_a_valid_sample_implies_that_all_are_void():
    outer, region = Region(0, 0, 3, 3), Region(0, 0, 5, 5)
    found = decode_validity(b"", region, Above(outer, all_void((3, 3))), is_finest=True)
    assert not as_array(found.mask, region.shape).any()
