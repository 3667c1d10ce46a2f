"""The library reads what docs/FORMAT.md says: it against a decoder written from that alone."""

import json
import re
import zlib
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import reference_decoder
from reference import bilinear_error
from reference_decoder import (
    GAIN,
    HEADER,
    HL_ALONG,
    LH_ALONG,
    NAMES,
    THRESHOLDS,
    WEIGHTS,
    CorruptError,
    Models,
    RangeDecoder,
    RangeEncoder,
    bin_of,
    block_codes,
    decode,
    decode_cdf97,
    decode_mask,
    decode_payload,
    decode_units,
    file_order,
    implied_void,
    read_file,
    segment_layout,
)
from twz import twz_bytes

import terrainwave
from terrainwave.container.deflate import deflate
from terrainwave.container.dictionary import DICTIONARY
from terrainwave.errors import CorruptStreamError
from terrainwave.quadtree import Block

DOCUMENT = Path(__file__).parents[1] / "docs" / "FORMAT.md"

# Rasters ---------------------------------------------------------------------------------------


def hills(rng, shape):
    """Return smooth relief of some hundreds with rough patches."""
    heights = np.cumsum(np.cumsum(rng.normal(size=shape), 0), 1) * 3
    return np.clip(heights + rng.normal(size=shape) * (heights > 0), -30_000, 30_000)


def with_voids(rng, heights, nodata):
    """Return a copy with single voids and a void rectangle."""
    heights = heights.copy()
    n_rows, n_cols = heights.shape
    heights[rng.random(heights.shape) < 0.03] = nodata
    heights[n_rows // 2 :, : n_cols // 3] = nodata
    return heights


def decimals(rng, shape):
    return np.round(hills(rng, shape) / 10, 1).astype("float32")


def whole(rng, shape):
    return hills(rng, shape).astype("int16")


def far_apart(rng, shape):
    return rng.choice([-(2**31), -1, 0, 2**31 - 1], shape).astype("int32")


def spikes(rng, shape):
    return np.where(rng.random(shape) < 0.01, 1e6, rng.normal(size=shape))


# What the raster is; its maker; options that go with it.
RASTERS = {
    "lossless": (whole, {"max_error": 0}),
    "bound 2": (whole, {"max_error": 2}),
    "bound 40": (whole, {"max_error": 40}),
    "voids": (
        lambda rng, shape: with_voids(rng, whole(rng, shape), -1),
        {"max_error": 1, "nodata": -1},
    ),
    "nodata among the heights": (
        lambda rng, shape: rng.integers(-5, 5, shape).astype("int32"),
        {"max_error": 2, "nodata": 0},
    ),
    "decimals": (decimals, {"max_error": 0}),
    "decimals, bound 0.3": (decimals, {"max_error": 0.3}),
    "decimal nodata": (
        lambda rng, shape: with_voids(rng, decimals(rng, shape), np.float32(0.1)),
        {"max_error": 0.2, "nodata": 0.1},
    ),
    "continuous": (hills, {"max_error": 0.01}),
    "continuous, NaN": (
        lambda rng, shape: with_voids(rng, hills(rng, shape).astype("float32"), np.nan),
        {"max_error": 3},
    ),
    "noise": (
        lambda rng, shape: rng.integers(-32_768, 32_768, shape).astype("int16"),
        {"max_error": 0},
    ),
    "noise, bound 5": (
        lambda rng, shape: rng.integers(0, 65_536, shape).astype("uint16"),
        {"max_error": 5},
    ),
    "all of int32": (far_apart, {"max_error": 1000}),
    "spikes": (spikes, {"max_error": 0.1}),
    "constant": (lambda rng, shape: np.full(shape, 77, "uint8"), {"max_error": 1}),
    "all void": (lambda rng, shape: np.full(shape, -1, "int16"), {"max_error": 1, "nodata": -1}),
}
SMALL = [(1, 1), (1, 9), (5, 5), (2, 34), (33, 40)]
# Four levels; the finest one's last blocks have only one or two rows and columns.
LARGE = [(66, 131)]


def check_same(data):
    """Compare the heights and masks of all levels."""
    with terrainwave.open(data) as terrain:
        for level in range(terrain.n_levels):
            heights, valid = terrain.read_with_mask(level=level)
            expected, expected_valid = decode(data, level)
            np.testing.assert_array_equal(valid, expected_valid)
            assert heights.dtype == expected.dtype
            np.testing.assert_array_equal(heights, expected)


def check_raster(name, shapes, method, border_rings):
    make, options = RASTERS[name]
    for shape in shapes:
        heights = make(np.random.default_rng(shape), shape)
        check_same(twz_bytes(heights, method=method, border_rings=border_rings, **options))


@pytest.mark.parametrize("border_rings", [1, 3])
@pytest.mark.parametrize("method", ["store", "cdf97"])
@pytest.mark.parametrize("name", RASTERS)
def test_small_rasters_decode_as_format_says(name, method, border_rings):
    check_raster(name, SMALL, method, border_rings)


@pytest.mark.large
@pytest.mark.parametrize("border_rings", [1, 3])
@pytest.mark.parametrize("method", ["store", "cdf97"])
@pytest.mark.parametrize("name", RASTERS)
def test_rasters_of_several_levels_decode_as_format_says(name, method, border_rings):
    check_raster(name, LARGE, method, border_rings)


@pytest.mark.large
@pytest.mark.parametrize("method", ["store", "cdf97"])
@pytest.mark.parametrize(("shape", "border_rings"), [((1, 17_000), 3), ((4100, 2), 1)])
def test_files_of_many_segments_decode_as_format_says(shape, border_rings, method):
    rng = np.random.default_rng(0)
    heights = np.cumsum(rng.normal(0, 9, shape[0] * shape[1])).astype("int16").reshape(shape)
    # Whole segments are void and absent (§3.4).
    heights.reshape(-1)[shape[0] * shape[1] // 3 :][: shape[0] * shape[1] // 2] = -1
    options = dict(max_error=3, nodata=-1, method=method, border_rings=border_rings)
    data = twz_bytes(heights, **options)
    file = read_file(data)
    segments = set(file.segment_of_key.values())
    assert len(segments) >= 10
    assert any(
        not any(file.payloads[key] for key, head in file.segment_of_key.items() if head == segment)
        for segment in segments
    )
    check_same(data)


# Codes of blocks (§4.4) ------------------------------------------------------------------------


@pytest.mark.large
@pytest.mark.parametrize(("shape", "border_rings"), [((140, 37), 1), ((5, 2100), 3)])
def test_boxes_and_errors_of_blocks_hold_as_format_says(shape, border_rings):
    rng = np.random.default_rng(1)
    heights = with_voids(rng, hills(rng, shape).astype("int16"), -1)
    options = dict(max_error=3, nodata=-1, method="cdf97", border_rings=border_rings)
    data = twz_bytes(heights, **options)
    file = read_file(data)
    grid, originals = file.grid, heights.astype(int) - file.header.base
    codes = block_codes(data)
    with terrainwave.open(data) as terrain:
        assert {block: code[2] for block, code in codes.items()} == {
            block: terrain.block_error(Block(*block)) for block in codes
        }
    surfaces = {}  # block -> range of its decoded samples
    for level in range(grid.k_max + 1):
        stride = 2 ** (grid.k_max - level)
        for unit, decoded, valid in decode_units(file, level):
            for block in grid.blocks_of_key(unit.key):
                first = [i * grid.n_cells for i in block[1:]]
                rows = slice(first[0] - unit.rows.first, first[0] - unit.rows.first + 33)
                cols = slice(first[1] - unit.cols.first, first[1] - unit.cols.first + 33)
                samples = np.array(decoded)[rows, cols]
                is_valid = np.array(valid)[rows, cols] == 1
                under = tuple(slice(i * stride, (i + 32) * stride + 1) for i in first)
                if not is_valid.any():
                    assert file.codes[block] == (0, 0, 0, 0)
                    continue
                low, high, error = codes[block]
                present = heights[under] != -1
                exact = bilinear_error(samples, stride, originals[under], present)
                assert error * 8 / 9 - 1 <= exact <= error
                assert low <= originals[under][present].min()
                assert originals[under][present].max() <= high
                surfaces[block] = samples[is_valid].min(), samples[is_valid].max()
    for block, (lowest, highest) in surfaces.items():
        while True:  # each surface lies in the boxes of all blocks above it
            assert codes[block][0] <= lowest
            assert highest <= codes[block][1]
            if block[0] == 0:
                break
            block = block[0] - 1, block[1] >> 1, block[2] >> 1


# Tables and examples of the document -----------------------------------------------------------


def section(number):
    text = DOCUMENT.read_text(encoding="utf-8")
    return re.search(rf"^#+ {re.escape(number)}\.? .*?(?=^#)", text, re.M | re.S)[0]


def table(text, first_cell):
    """Return the rows of the table whose head begins with a cell, as lists of text."""
    lines = iter(text.splitlines())
    head = next(line for line in lines if line.startswith(f"| {first_cell} |".replace("  ", " ")))
    rows = [head]
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append(line)
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in [rows[0], *rows[2:]]]


def test_the_range_coder_has_the_states_of_format_6_4():
    encoder, models = RangeEncoder(), Models(1)
    for bit, *expected in table(section("6.4"), "after bit")[1:]:
        encoder.bit(models, 0, int(bit))
        state = [encoder.range, encoder.low, models.probability[0], models.count[0]]
        assert state == [int(number) for number in expected]


def test_the_range_coder_makes_the_bytes_of_format_6_4_and_reads_them():
    one, many = re.search(
        r"is the byte (\w\w)\..* give ((?:\w\w ?)+)\.", section("6.4"), re.S
    ).groups()
    for stream, n_times in ((bytes.fromhex(one), 1), (bytes.fromhex(many), 8)):
        bits = [1, 0, 0, 1, 0] * n_times
        encoder, models = RangeEncoder(), Models(1)
        for bit in bits:
            encoder.bit(models, 0, bit)
        assert encoder.end() == stream
        decoder, models = RangeDecoder(stream), Models(1)
        assert [decoder.bit(models, 0) for _ in bits] == bits
        decoder.end()


def test_a_stream_of_no_symbols_is_the_byte_of_format_6_3():
    assert RangeEncoder().end() == b"\0"
    RangeDecoder(b"\0").end()
    with pytest.raises(CorruptError):
        RangeDecoder(b"").end()


def test_raw_bits_and_carries_come_back_through_the_range_coder():
    rng = np.random.default_rng(0)
    for _ in range(20):
        numbers = [(int(rng.integers(2**k)), int(k)) for k in rng.integers(0, 33, 50)]
        encoder, models = RangeEncoder(), Models(2)
        for number, k in numbers:
            encoder.bit(models, k % 2, number % 2)
            encoder.raw(number, k)
        decoder, models = RangeDecoder(encoder.end()), Models(2)
        for number, k in numbers:
            assert decoder.bit(models, k % 2) == number % 2
            assert decoder.raw(k) == number
        decoder.end()


def test_bins_are_those_of_format_6_6():
    numbers = re.search(r"^(1 2 3 [\d ]+)\.$", section("6.6"), re.M)[1]
    assert THRESHOLDS == [int(number) for number in numbers.split()]
    assert [bin_of(s) for s in (0, 1, 7, 8, 3263, 3264, 4095)] == [0, 1, 6, 7, 32, 33, 33]


def test_gains_and_weights_are_those_of_format_7_5():
    head, *rows = table(section("7.5"), "t")
    assert head[1:] == [str(t) for t in range(12)]
    for row in rows:
        for band in row[0].split(", "):
            assert GAIN[band] == [int(cell) for cell in row[1:]]
    head, *rows = table(section("7.5"), "")
    assert head[1:] == ["W", "N", "NW", "NE", "WW", "NN"]
    found = {name: tuple(map(int, cells)) for name, *cells in rows}
    assert found == {
        "HL, LH": WEIGHTS["HL"],
        "HH": WEIGHTS["HH"],
        "HL at t = 0 if HL-along": HL_ALONG,
        "LH at t = 0 if LH-along": LH_ALONG,
    }
    assert WEIGHTS["HL"] == WEIGHTS["LH"]


# Files that no encoder writes ------------------------------------------------------------------


def planes(values, width):
    """§3.3: all lowest bytes, then the second ones, …"""
    return b"".join(bytes(value >> 8 * p & 255 for value in values) for p in range(width))


def assembled(file, **changes):
    """Return the bytes of a file of one segment: `file` with other header fields."""
    keys, blocks, heads = segment_layout(file.grid, None)
    assert not heads
    payloads = [file.payloads[key] for key in keys]
    columns = planes([*map(len, payloads)], 4)
    columns += bytes(4 * len(keys)) + bytes(len(keys)) + bytes(4 * len(blocks))
    columns += planes([*map(zlib.crc32, payloads)], 4) + bytes(4 * len(keys))
    page = bytes(8) + zlib.compress(columns)
    page = zlib.crc32(page).to_bytes(4, "little") + page
    metadata = deflate(json.dumps(file.metadata).encode(), DICTIONARY)
    body = metadata + page + b"".join(file.payloads[key] for key in file_order(keys))
    fields = vars(file.header) | changes
    fields |= dict(
        file_size=128 + len(body),
        metadata_length=len(metadata),
        metadata_crc=zlib.crc32(metadata),
        top_page_length=len(page),
    )
    header = HEADER.pack(*(fields[name] for name in NAMES))[:124]
    return header + zlib.crc32(header).to_bytes(4, "little") + body


class RandomCoder(RangeEncoder):
    """In a decoder's place it answers at random, and encodes what it answered."""

    def __init__(self, rng, share_of_ones):
        super().__init__()
        self.rng = rng
        self.share_of_ones = share_of_ones
        self.stream = None

    def bit(self, models, i):
        share = self.share_of_ones
        if share is None:  # as the model expects
            share = models.probability[i] / 2**22
        bit = int(self.rng.random() < share)
        super().bit(models, i, bit)
        return bit

    def raw(self, k):
        value = int(self.rng.integers(0, 1 << k))
        super().raw(value, k)
        return value

    def end(self):
        self.stream = super().end()

    unary = RangeDecoder.unary
    magnitude = RangeDecoder.magnitude


def varint(value):
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def random_payload(rng, file, unit, parent_unit, parent_heights, parent_valid):
    """Return a payload of cdf97 that is legal and otherwise random."""

    def coder():
        shares = [None, None, 0.05, 0.3, 0.5, 0.8, 0.97]
        return RandomCoder(rng, shares[rng.integers(len(shares))])

    implied = implied_void(unit, parent_unit, parent_valid)
    valid = [[int(not is_void) for is_void in row] for row in implied]
    payload = b"\0"
    if rng.random() < 0.5:
        source = RandomCoder(rng, rng.choice([0.5, 0.97]))
        with patch.object(reference_decoder, "RangeDecoder", lambda data: source):
            valid = decode_mask(b"", implied)
        payload = b"\1" + varint(len(source.stream)) + source.stream
    if not any(map(any, valid)):
        return b""
    flags = int(rng.choice([0, 1, 2, 3, 3, 3, 4]))
    head = bytes([flags])
    if flags == 4:
        base = int(rng.integers(-(2**30), 2**30 + 1)) >> int(rng.integers(0, 31))
        zigzag = 2 * base if base >= 0 else -2 * base - 1
        head += bytes([rng.integers(0, 33)]) + varint(zigzag)
    if flags & 1:
        step_code = int(rng.integers(1, 2**32 + 1)) >> int(rng.integers(0, 32)) or 1
        head += varint(step_code) + bytes([rng.integers(0, 64)])
    if flags & 2:
        head += bytes([rng.integers(0, len(reference_decoder.TERM_WEIGHTS_97))])
    source = coder()
    with patch.object(reference_decoder, "RangeDecoder", lambda data: source):
        decode_cdf97(file.header, unit, head, valid, parent_unit, parent_heights)
    return payload + head + source.stream


def random_file(rng, shape, border_rings):
    """Return a legal file of random payloads, whose heights and steps may be extreme."""
    options = dict(max_error=0, method="cdf97", border_rings=border_rings)
    template = twz_bytes(np.zeros(shape, "int32"), **options)
    file = read_file(template)
    span = 2 ** int(rng.integers(4, 31)) - 1
    z_min = int(rng.integers(-(2**30), 2**30 - span + 1))
    changes = dict(
        method=1,
        z_min=z_min,
        z_max=z_min + span,
        step=int(rng.integers(0, 2**30)) >> int(rng.integers(0, 31)) << 1 | 1,
    )
    for name, value in changes.items():
        setattr(file.header, name, value)
    if rng.random() < 0.5:
        file.metadata["nodata"] = z_min + int(rng.choice([0, rng.integers(span), span]))

    def generate(file, unit, payload, *parent):
        file.payloads[unit.key] = payload = random_payload(rng, file, unit, *parent)
        return decode_payload(file, unit, payload, *parent)

    with patch.object(reference_decoder, "decode_payload", generate):
        decode_units(file, file.grid.k_max)
    return assembled(file)


def test_a_file_put_together_by_the_document_is_read_by_the_library():
    heights = np.arange(25, dtype="int16").reshape(5, 5)
    file = read_file(twz_bytes(heights, max_error=0, method="cdf97"))
    with terrainwave.open(assembled(file)) as terrain:
        np.testing.assert_array_equal(terrain.read(), np.arange(25).reshape(5, 5))


def check_units(data):
    """Compare all units of a file: masks, and heights of valid and void samples.

    Neighbours of a random file don't agree about the samples they share.
    """
    file = read_file(data)
    with terrainwave.open(data) as terrain:
        for level in range(file.grid.k_max + 1):
            for unit, heights, valid in decode_units(file, level):
                decoded = terrain._decoder.unit(Block(*unit.key))
                np.testing.assert_array_equal(decoded.mask, np.array(valid) == 1)
                np.testing.assert_array_equal(decoded.heights, heights)


@pytest.mark.parametrize("border_rings", [1, 3])
@pytest.mark.parametrize("seed", range(10))
def test_random_payloads_of_a_root_decode_as_format_says(seed, border_rings):
    check_units(random_file(np.random.default_rng(seed), (6, 11), border_rings))


@pytest.mark.large
@pytest.mark.parametrize("border_rings", [1, 3])
@pytest.mark.parametrize("seed", range(10))
def test_random_payloads_of_groups_decode_as_format_says(seed, border_rings):
    for shape in ((33, 40), (9, 140), (140, 4)):
        check_units(random_file(np.random.default_rng(seed), shape, border_rings))


def test_of_damaged_payloads_the_library_rejects_those_that_format_calls_corrupt():
    rng = np.random.default_rng(0)
    heights = with_voids(rng, whole(rng, (12, 17)), -1)
    n_read = 0
    for _ in range(150):
        data = twz_bytes(
            heights, max_error=1, nodata=-1, method=str(rng.choice(["store", "cdf97"]))
        )
        file = read_file(data)
        key = (-1, 0, 0)
        payload = bytearray(file.payloads[key])
        kind = rng.integers(4)
        if kind == 0:
            del payload[rng.integers(len(payload)) :]
        elif kind == 1:
            payload += rng.bytes(int(rng.integers(1, 3)))
        else:
            payload[int(rng.integers(len(payload)) >> 4 * (kind == 3))] ^= 1 << rng.integers(8)
        file.payloads[key] = bytes(payload)
        data = assembled(file)
        with terrainwave.open(data) as terrain:
            try:
                expected, expected_valid = decode(data)
            except CorruptError:
                with pytest.raises(CorruptStreamError):
                    terrain.read()
                continue
            found, valid = terrain.read_with_mask()
            np.testing.assert_array_equal(valid, expected_valid)
            np.testing.assert_array_equal(found, expected)
            n_read += 1
    assert n_read > 10
