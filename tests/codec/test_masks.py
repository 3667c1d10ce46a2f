"""Masks come back exactly, cost little where they are simple, and survive damage."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import valid_masks

from terrainwave.codec.masks import decode_mask, encode_mask, start_models
from terrainwave.errors import CorruptStreamError

shapes = st.tuples(st.integers(1, 12), st.integers(1, 12))


@st.composite
def masks(draw):
    """Draw a mask and what is implied to be void in it."""
    shape = draw(shapes)
    mask, implied = draw(valid_masks(shape)), draw(valid_masks(shape))
    return mask & ~implied, implied


@given(masks())
def test_masks_come_back_exactly(case):
    mask, implied = case
    np.testing.assert_array_equal(decode_mask(encode_mask(mask, implied), implied), mask)


def none_implied(mask):
    return np.zeros(mask.shape, dtype=bool)


def test_a_disc_costs_less_than_four_bits_per_sample_of_its_outline():
    # Its outline has about 2 pi 24 = 150 samples; the 4225 inside and outside say nothing new.
    row, col = np.indices((65, 65))
    mask = (row - 32) ** 2 + (col - 32) ** 2 < 24**2
    assert 8 * len(encode_mask(mask, none_implied(mask))) < 4 * 150


@pytest.mark.large
def test_noise_costs_hardly_more_than_its_entropy():
    mask = np.random.default_rng(0).random((257, 257)) < 0.2
    entropy = -(0.2 * np.log2(0.2) + 0.8 * np.log2(0.8)) * mask.size
    assert 8 * len(encode_mask(mask, none_implied(mask))) < 1.05 * entropy


def test_samples_implied_to_be_void_cost_nothing():
    mask = np.random.default_rng(0).random((9, 9)) < 0.5
    assert len(encode_mask(mask & False, ~(mask & False))) <= 4


def small():
    mask = np.random.default_rng(1).random((9, 11)) < 0.5
    implied = none_implied(mask)
    implied[:, 4] = True
    mask &= ~implied
    return encode_mask(mask, implied), implied


def outcome(data, implied):
    try:
        mask = decode_mask(data, implied)
    except CorruptStreamError as error:
        return error
    assert mask.shape == implied.shape
    assert not (mask & implied).any()
    return mask


def test_every_prefix_is_rejected():
    data, implied = small()
    for length in range(len(data)):
        assert isinstance(outcome(data[:length], implied), CorruptStreamError), length


def test_an_extra_byte_is_rejected():
    data, implied = small()
    for extra in (0, 255):
        assert isinstance(outcome(data + bytes([extra]), implied), CorruptStreamError)


def test_every_flipped_bit_gives_a_mask_or_our_own_error():
    data, implied = small()
    for bit in range(8 * len(data)):
        broken = bytearray(data)
        broken[bit // 8] ^= 1 << bit % 8
        outcome(bytes(broken), implied)


@given(st.binary(max_size=40), shapes)
def test_any_bytes_give_a_mask_or_our_own_error(data, shape):
    outcome(data, np.zeros(shape, dtype=bool))


def test_start_values_are_those_of_the_format():
    document = (Path(__file__).parents[2] / "docs" / "FORMAT.md").read_text(encoding="utf-8")
    numbers = re.search(r"^```starts\n(.*?)^```", document, re.M | re.S)[1].split()
    # Models: the probability in the upper 22 bits, the number of bits seen in the lower ten.
    assert [(model >> 24, model & 0xFFFFFF) for model in start_models().tolist()] == [
        (int(number), 2) for number in numbers
    ]
