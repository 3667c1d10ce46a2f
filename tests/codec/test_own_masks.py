"""Validity with fills comes back exactly, and survives damage."""

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import valid_masks

from terrainwave.codec import own_masks as ownmask
from terrainwave.codec.group import voids_below
from terrainwave.codec.own_masks import (
    Above,
    Sections,
    decode_validity,
    encode_validity,
)
from terrainwave.codec.refiner import Validity, as_array
from terrainwave.coding.rangecoder import (
    SETTLED_ON_ONES,
    code_step,
    new_decoder,
    new_models,
    take_out,
)
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Region


class Levels:
    """Validity of all levels of a raster, each coded as one unit below the level above."""

    def __init__(self, valid, n_levels):
        self.levels = [
            Validity.of(reference.level_mask(valid, shift), valid[:: 1 << shift, :: 1 << shift])
            for shift in range(n_levels - 1, -1, -1)
        ]
        self.regions = [
            Region(0, 0, *valid[:: 1 << shift, :: 1 << shift].shape)
            for shift in range(n_levels - 1, -1, -1)
        ]

    def place(self, index):
        """Return region, implied voids and what is above of a level, and whether it is finest."""
        region = self.regions[index]
        is_finest = index == len(self.levels) - 1
        if index == 0:
            return np.zeros(region.shape, dtype=bool), region, None, is_finest
        above = self.levels[index - 1]
        outer = self.regions[index - 1]
        implied = voids_below(region, outer, above.mask)
        return implied, region, Above(outer, above.own_mask), is_finest

    def coded(self, index):
        implied, region, above, is_finest = self.place(index)
        return encode_validity(self.levels[index], implied, region, above, is_finest=is_finest)

    def decoded(self, index, sections):
        implied, region, above, is_finest = self.place(index)
        return decode_validity(sections, implied, region, above, is_finest=is_finest)


def arrays(validity, region):
    """Return which samples are valid, and which by themselves."""
    return as_array(validity.mask, region.shape), as_array(validity.own_mask, region.shape)


def specks(n_rows, n_cols):
    """Return validity with single void samples and single valid ones, a lake and its island."""
    row, col = np.indices((n_rows, n_cols))
    valid = (row * 31 + col * 17) % 97 != 0
    distance = (row - n_rows // 3) ** 2 + (col - n_cols // 2) ** 2
    valid &= (distance > (n_rows // 5) ** 2) | (distance < 9)
    return valid & (row + 2 * col > n_rows // 4) | ((row % 29 == 7) & (col % 23 == 5))


@given(st.data(), st.sampled_from([(1, 1), (1, 17), (16, 2), (17, 13), (9, 22)]))
def test_validity_comes_back_on_each_level(data, shape):
    levels = Levels(data.draw(valid_masks(shape)), 3)
    for index, expected in enumerate(levels.levels):
        sections = levels.coded(index)
        found = levels.decoded(index, sections)
        region = levels.regions[index]
        np.testing.assert_array_equal(arrays(found, region), arrays(expected, region))
        assert [part is None for part in found] == [part is None for part in expected]
        if index == len(levels.levels) - 1:
            assert sections.own == b""
            assert found.own is None


def test_what_follows_from_the_level_above_takes_no_bytes():
    valid = np.ones((33, 29), dtype=bool)
    assert not any(any(Levels(valid, 3).coded(index)) for index in range(3))


@pytest.mark.parametrize("index", [0, 1, 2])
def test_damage_is_found_or_gives_some_validity_whose_own_samples_are_valid(index):
    levels = Levels(specks(60, 55), 3)
    sections = levels.coded(index)
    assert sections.mask
    assert bool(sections.own) == (index < 2)
    n_found = 0
    for name in sections._fields:
        section = getattr(sections, name)
        damaged = [section[:n] for n in range(1, len(section))] + [section + b"\0"]
        for at in range(len(section)):
            for bit in (0, 3, 7):
                damaged.append(section[:at] + bytes([section[at] ^ 1 << bit]) + section[at + 1 :])
        for data in damaged if section else ():
            try:
                found = levels.decoded(index, sections._replace(**{name: data}))
            except CorruptStreamError:
                n_found += 1
            else:
                valid, by_itself = arrays(found, levels.regions[index])
                assert not (by_itself & ~valid).any()
                assert not (valid & levels.place(index)[0]).any()
    assert n_found


@given(st.binary(max_size=40), st.binary(max_size=40), valid_masks((13, 12)), st.booleans())
def test_any_bytes_are_decoded_or_refused(mask, own, valid, is_finest):
    # `above` need not fit the voids that are implied: only own samples of the parent are not void.
    outer = Region(3, 2, 7, 6)
    region = Region(6, 4, 13, 11)
    own_above = valid[:7, :6]
    above = Above(outer, None if own_above.all() else own_above)
    implied = voids_below(region, outer, valid[:7, :6] | valid[6:, 6:])
    try:
        found = decode_validity(
            Sections(mask, b"" if is_finest else own), implied, region, above, is_finest=is_finest
        )
    except CorruptStreamError:
        return
    found_mask, found_own = arrays(found, region)
    assert found_mask.shape == found_own.shape == region.shape
    assert not (found_own & ~found_mask).any()


def test_runs_of_settled_models_are_coded_as_sample_by_sample():
    """Large enough that models settle; with voids that end runs."""
    rng = np.random.default_rng(3)
    valid = np.ones((257, 257), dtype=bool)
    for row, col in rng.integers(0, 250, (9, 2)):
        valid[row : row + rng.integers(1, 5), col : col + rng.integers(1, 7)] = False
    levels = Levels(valid, 2)
    implied, region, above, is_finest = levels.place(1)
    sections = encode_validity(levels.levels[1], implied, region, above, is_finest=is_finest)
    # As a reader without runs has it.
    n_rows, n_cols = region.shape
    known = ownmask._known_of_own(implied, region, above)[:-1, 1:-1]
    models = new_models(ownmask.N_MODELS)
    coder = new_decoder(sections.mask, models)
    at, n_settled = take_out(coder.state), 0
    bits = np.zeros((n_rows + 1, n_cols + 2), dtype=int)
    ahead = np.zeros((n_rows + 1, n_cols + 2), dtype=int)
    ahead[:-1, 1:-1] = known
    for row in range(n_rows):
        for col in range(n_cols):
            here, west = col + 1, bits[row + 1, col]
            if known[row, col] == ownmask.UNKNOWN:
                north, north_west, north_east = bits[row, here], bits[row, col], bits[row, here + 1]
                model = 81 * (8 * west + 4 * north + 2 * north_west + north_east)
                model += 27 * ahead[row, here + 1] + 9 * ahead[row + 1, here]
                model += 3 * ahead[row + 1, here + 1] + ahead[row + 1, col]
                n_settled += models[model] == SETTLED_ON_ONES
                bit, at = code_step(
                    at, coder.state, coder.stream, models, coder.is_encoder, model, np.int64(0)
                )
            else:
                bit = known[row, col] == ownmask.VALID
            bits[row + 1, here] = bit
    assert n_settled > 10_000
    np.testing.assert_array_equal(bits[1:, 1:-1].astype(bool), valid)
    found = decode_validity(sections, implied, region, above, is_finest=is_finest)
    np.testing.assert_array_equal(found.mask, valid)
