"""Damaged and hostile files: the right result or a TerrainwaveError, in bounded time and memory.

Checksums find accidents, so most of these tests repair them: safety must not depend on them.
"""

import zlib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from container.toys import forge, toy_header
from containers import open_container
from costs import n_calls, peak_memory
from hypothesis import given
from hypothesis import strategies as st
from strategies import terrain_like
from twz import twz_bytes

from terrainwave.container.header import HAS_VOIDS
from terrainwave.container.page import empty_page, page_layout
from terrainwave.errors import (
    LimitExceededError,
    TerrainwaveError,
)
from terrainwave.grid.quadtree import Block
from terrainwave.names import METHODS
from terrainwave.read.decoder import TreeDecoder
from terrainwave.terrain import Terrain

HEIGHTS = terrain_like(131, 6, seed=8)  # four levels
HEIGHTS[20:30, 2:] = -32768
HEIGHTS[100, 3] = -32768


@pytest.fixture(scope="module", params=["rapid", "cdf97", "cdf53", "store"])
def method(request):
    return request.param


@pytest.fixture(scope="module")
def data(method):
    rings = 3 if METHODS[method].has_rings else 1
    return twz_bytes(HEIGHTS, max_error=1, nodata=-32768, method=method, border_rings=rings)


@pytest.fixture(scope="module")
def expected(data):
    """Return what the sound file decodes to."""
    return everything(data)


def everything(data):
    """Read every level of a small file; return the arrays."""
    with Terrain(data, threads=1) as terrain:
        return [
            array
            for level in range(terrain.n_levels)
            for array in terrain.read_with_mask((0, 0, 300, 300), level=level)
        ]


def outcome(data):
    """Return what can be read, or the error if it is one of ours; nothing else may happen."""
    try:
        return everything(data)
    except TerrainwaveError as error:
        return error


def is_same(one, other):
    return len(one) == len(other) and all(map(np.array_equal, one, other))


def changed(data, byte_pos, change):
    damaged = bytearray(data)
    damaged[byte_pos] ^= change
    return bytes(damaged)


# Each third bit meets each byte; fewer for `make test`. Fuzzers do the rest (fuzz/, native/fuzz/).
STEPS = pytest.mark.parametrize(
    "step", [pytest.param(3, marks=pytest.mark.full, id="3rd"), pytest.param(23, id="23rd")]
)


def test_the_files_are_small_and_sound(data, expected):
    assert len(data) < 3000
    np.testing.assert_array_equal(expected[-1], HEIGHTS != -32768)


@pytest.mark.large
@STEPS
def test_flipped_bits_of_the_first_300_bytes_are_found_or_harmless(data, expected, step):
    for bit in range(0, 8 * 300, step):
        result = outcome(changed(data, bit // 8, 1 << bit % 8))
        assert isinstance(result, TerrainwaveError) or is_same(result, expected), bit


@pytest.mark.large
@STEPS
def test_flipped_bytes_of_the_rest_are_found_or_harmless(data, expected, step):
    for byte_pos in range(300, len(data), step):
        result = outcome(changed(data, byte_pos, 1 << byte_pos % 8))
        assert isinstance(result, TerrainwaveError) or is_same(result, expected), byte_pos


# Attacks: checksums are right

# Fields of the header, FORMAT.md §4.1.
METADATA_LENGTH, METADATA_CRC, PARAMETERS_LENGTH, PAGE_LENGTH, HEADER_CRC = 76, 104, 108, 116, 124
HEADER_SIZE = 128


def number_at(data, byte_pos):
    return int.from_bytes(data[byte_pos : byte_pos + 4], "little")


def repaired(data):
    """Return the file with the checksums of header, metadata and top page made right."""
    repaired = bytearray(data)
    end = HEADER_SIZE + number_at(data, METADATA_LENGTH)
    page = end + number_at(data, PARAMETERS_LENGTH)
    page_end = page + number_at(data, PAGE_LENGTH)
    repaired[METADATA_CRC : METADATA_CRC + 4] = crc(repaired[HEADER_SIZE:end])
    if page + 4 <= page_end <= len(data):
        repaired[page : page + 4] = crc(repaired[page + 4 : page_end])
    repaired[HEADER_CRC:HEADER_SIZE] = crc(repaired[:HEADER_CRC])
    return bytes(repaired)


def crc(data):
    return zlib.crc32(data).to_bytes(4, "little")


@pytest.fixture
def unchecked(monkeypatch):
    """Let payloads with wrong checksums reach the decoder."""
    monkeypatch.setattr("terrainwave.container.reader.check_crc", lambda *_: None)


def payload_places(data):
    """Return the place and length of each payload."""
    with open_container(data) as container:
        keys = page_layout(container.grid, None).keys
        return {
            key: segment.payload_range(row)
            for key, (segment, row) in zip(keys, container._rows(keys), strict=True)
        }


def test_repairing_a_sound_file_changes_nothing(data):
    assert repaired(data) == data


@pytest.mark.large
@STEPS
def test_flipped_bits_of_the_header_give_heights_or_our_own_error(data, step):
    for bit in range(0, 8 * HEADER_CRC, step):
        outcome(repaired(changed(data, bit // 8, 1 << bit % 8)))


@pytest.mark.large
@STEPS
def test_flipped_bits_of_metadata_and_page_give_heights_or_our_own_error(data, step):
    first = min(place.offset for place in payload_places(data).values())
    for bit in range(8 * HEADER_SIZE, 8 * first, step):
        outcome(repaired(changed(data, bit // 8, 1 << bit % 8)))


@pytest.mark.few(1)
@pytest.mark.large
@STEPS
def test_flipped_bits_of_payloads_give_heights_or_our_own_error(data, unchecked, step):
    first = min(place.offset for place in payload_places(data).values())
    for bit in range(8 * first, 8 * len(data), step):
        outcome(changed(data, bit // 8, 1 << bit % 8))


@pytest.mark.large
def test_any_payloads_give_heights_or_our_own_error(data, unchecked):
    places = [place for place in payload_places(data).values() if place.length]
    rng = np.random.default_rng(9)
    n_decoded = 0
    for _ in range(400):
        damaged = bytearray(data)
        for offset, length in places:
            kept = int(rng.integers(0, length + 1))  # random from here on
            damaged[offset + kept : offset + length] = rng.bytes(length - kept)
        n_decoded += not isinstance(outcome(bytes(damaged)), TerrainwaveError)
    assert n_decoded < 400


small_numbers = st.integers(0, 2**8 - 1)
numbers = st.one_of(
    small_numbers,
    st.sampled_from([2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1]),
    st.integers(0, 2**64 - 1),
)
# Fields that heights are computed from: numerator, denominator, base, step, z_min, z_max, bounds.
FIELDS = {40: 8, 48: 8, 56: 8, 64: 4, 68: 4, 72: 4, 80: 8, 88: 8, 96: 8}


@given(st.dictionaries(st.sampled_from(sorted(FIELDS)), numbers, max_size=4))
def test_any_numbers_in_the_header_give_heights_or_our_own_error(fields):
    damaged = bytearray(tiny())
    for byte_pos, number in fields.items():
        size = FIELDS[byte_pos]
        damaged[byte_pos : byte_pos + size] = (number % 256**size).to_bytes(size, "little")
    outcome(repaired(damaged))


@cache
def tiny():
    """Return a file of twelve heights."""
    heights = np.arange(12, dtype="float32").reshape(3, 4) / 10
    return twz_bytes(heights, max_error=0.1, method="store")


@pytest.mark.parametrize(
    ("z_min", "z_max"), [(-(2**30), -(2**30)), (2**30, 2**30), (0, 2**30 - 1), (-5, -5)]
)
@pytest.mark.parametrize("step", [1, 2**31 - 1])
def test_extreme_numbers_that_are_legal_are_read(z_min, z_max, step):
    damaged = bytearray(tiny())
    for byte_pos, number in ((64, step), (68, z_min), (72, z_max)):
        damaged[byte_pos : byte_pos + 4] = (number % 2**32).to_bytes(4, "little")
    with Terrain(repaired(damaged), threads=1) as terrain:
        assert terrain.read().shape == (3, 4)
        assert terrain.info().minimum is not None


def claims(n_rows, n_cols, block=1024, dtype="int16"):
    """Return a file of about 200 bytes that claims a raster; all of it is void."""
    header = toy_header(
        n_rows, n_cols, block, dtype=dtype, metadata={"nodata": 0}, file_tables=b"",
        features=HAS_VOIDS,
    )  # fmt: skip
    return forge(header, empty_page(page_layout(header.grid, None)))


@pytest.fixture
def huge():
    return claims(2**31, 2**19)


def test_opening_a_huge_raster_allocates_next_to_nothing(huge):
    Terrain(huge).close()
    assert peak_memory(lambda: Terrain(huge).close()) < 1 << 20


def test_a_window_of_a_huge_void_raster_is_void(huge):
    # Its segments are absent, so all payloads are empty: no valid samples.
    with Terrain(huge, threads=1) as terrain:
        heights, valid = terrain.read_with_mask((2**31 - 9, 2**19 - 9, 9, 9))
    assert not valid.any()
    assert (heights == 0).all()


def test_reading_all_of_a_huge_raster_is_refused(huge):
    with Terrain(huge) as terrain, pytest.raises(LimitExceededError):
        terrain.read()


@pytest.mark.parametrize("level", [0, -10, -1])
def test_a_huge_raster_is_refused_or_read_within_the_callers_limit(huge, level):
    with Terrain(huge, threads=1) as terrain, pytest.raises(LimitExceededError):
        terrain.read(level=level, max_bytes=1000)


def test_info_of_a_huge_raster_looks_at_none_of_its_blocks(huge):
    with Terrain(huge) as terrain:
        terrain.info()  # what the first call alone does
        assert n_calls(terrain.info) < 5000  # of 2^30 blocks
        assert peak_memory(terrain.info) < 1 << 20


def test_checking_a_huge_void_raster_decodes_no_more_than_is_there(huge, monkeypatch):
    decode, n_units = TreeDecoder.unit, 0

    def counting(self, key, *begun):
        nonlocal n_units
        n_units += 1
        assert n_units < 1000  # of 2^30
        return decode(self, key, *begun)

    monkeypatch.setattr(TreeDecoder, "unit", counting)
    with Terrain(huge) as terrain:
        assert list(terrain.check()) == []


@pytest.mark.few(1)
@pytest.mark.large
@pytest.mark.parametrize("change", [0x01, 0x80])
def test_damage_never_costs_memory(data, change):
    outcome(data)
    for byte_pos in range(0, len(data), 7):
        damaged = repaired(changed(data, byte_pos, change))
        assert peak_memory(lambda damaged=damaged: outcome(damaged)) < 32 << 20, byte_pos


def test_a_valid_sample_in_a_file_without_heights_is_read_in_range(unchecked):
    # z_min = 0 and z_max = -1 say "no valid sample"; a hostile root has some all the same.
    void = twz_bytes(np.full((3, 4), np.nan, dtype="float32"), max_error=0.1, method="store")
    place = payload_places(tiny())[Block(-1, 0, 0)]
    payload = tiny()[place.offset : place.end]
    with open_container(void) as container:
        header = container.header
    layout = page_layout(header.grid, None)
    page = replace(
        empty_page(layout),
        payload_lengths=np.array([len(payload)], dtype=np.uint32),
        payload_crcs=np.array([zlib.crc32(payload)], dtype=np.uint32),
    )
    (*_, heights, valid) = everything(forge(header, page, body=payload))
    assert valid.all()
    # The quantum is 1: heights are quanta.
    assert ((header.z_max <= heights) & (heights <= header.z_min)).all()
