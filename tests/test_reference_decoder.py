"""The library reads what docs/FORMAT.md says: it against a decoder written from that alone."""

import json
import re
import zlib
from itertools import product
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from cases import some
from commands import python, python_with
from conformance import rapid as any_rapid
from golden_files import GOLDEN
from reference import bilinear_error
from reference_decoder import cdf53, mixing, predictive
from reference_decoder.mixing import MixingDecoder as RangeDecoder
from reference_decoder.mixing import RangeEncoder
from reference_decoder.spiht import Spiht
from twz import twz_bytes

import terrainwave
from terrainwave.codec.predictive.file_tables import all_tables, parse_file_tables
from terrainwave.coding.deflate import deflate
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Block
from terrainwave.mesh.statistics import mesh_levels
from terrainwave.reference import cdf97, payloads, range_coder, rapid, units
from terrainwave.reference.basics import CorruptError
from terrainwave.reference.files import (
    DICTIONARY,
    HEADER,
    METHODS,
    NAMES,
    block_codes,
    file_order,
    read_file,
    segment_layout,
)
from terrainwave.reference.payloads import MASK_GROUPS, MASK_SAMPLES, decode_payload, decode_valid
from terrainwave.reference.range_coder import THRESHOLDS, Models, bin_of
from terrainwave.reference.rapid_tables import read_rapid_tables
from terrainwave.reference.units import decode, decode_units, decode_with_own

DOCUMENT = Path(__file__).parents[1] / "docs" / "FORMAT.md"


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
    "voids": (
        lambda rng, shape: with_voids(rng, whole(rng, shape), -1),
        {"max_error": 1, "nodata": -1},
    ),
    "half of the samples void": (
        lambda rng, shape: np.where(rng.random(shape) < 0.5, -1, whole(rng, shape) | 1).astype(
            "int16"
        ),
        {"max_error": 2, "nodata": -1},
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
    "every bit, NaN": (
        lambda rng, shape: with_voids(rng, hills(rng, shape) / 3, np.nan),
        {"max_error": 0},
    ),
    "every bit of int32": (far_apart, {"max_error": 0}),
}
# Their outermost values are heights here.
VOIDS_OF_INT32 = pytest.mark.filterwarnings("ignore:.*far from all others")
SMALL = [(1, 1), (33, 34), (1, 9), (70, 3), (5, 5), (2, 34), (1, 70)]
# Several levels; the finest one's last blocks have only one or two rows and columns. Smaller for
# methods that take longer here.
LARGE = {
    "store": (66, 131),
    "cdf97": (66, 131),
    "predictive": (66, 70),
    "rapid": (66, 131),
    "cdf53": (35, 66),
}


def pairs(every=1):
    """Return all rasters with all methods, or with each `every`-th; with 1 and 3 rings in turns.

    `make test` takes the codec after that of the raster before, of each fourth raster: `rapid` with
    64 bits is left to `make test-all`.
    """
    found = []
    for i, name in enumerate(RASTERS):
        for j, method in enumerate(LARGE):
            rings = 3 if (i + j) % 2 and method not in ("rapid", "cdf53") else 1
            # Tiles have no remainders.
            if (i + j) % every == 0 and not (name.startswith("every bit") and method == "cdf53"):
                marks = [] if i % 4 == 0 and j == i // 4 else pytest.mark.full
                found.append(pytest.param(name, method, rings, marks=marks))
    return found


def check_same(data):
    """Compare the heights, masks and own samples of all levels."""
    with terrainwave.open(data) as terrain:
        for level in range(terrain.n_levels):
            heights, valid = terrain.read_with_mask(level=level, voids="any")
            expected, expected_valid, expected_own = decode_with_own(data, level)
            np.testing.assert_array_equal(valid, expected_valid)
            if terrain.header.has_voids:
                own = terrain.read_with_mask(level=level, voids="exact")[1]
                np.testing.assert_array_equal(own, expected_own)
            assert heights.dtype == expected.dtype
            np.testing.assert_array_equal(heights, expected)


def some_small(name, method):
    """Return three small shapes, in turns: each method has each, and so has each raster."""
    first = 3 * [*RASTERS].index(name) + [*LARGE].index(method)
    return [SMALL[(first + i) % len(SMALL)] for i in range(3)]


def check_raster(name, shapes, method, border_rings):
    make, options = RASTERS[name]
    for shape in shapes:
        heights = make(np.random.default_rng(shape), shape)
        check_same(twz_bytes(heights, method=method, border_rings=border_rings, **options))


@VOIDS_OF_INT32
@pytest.mark.parametrize(("name", "method", "border_rings"), pairs())
def test_small_rasters_decode_as_format_says(name, method, border_rings):
    check_raster(name, some_small(name, method), method, border_rings)


@VOIDS_OF_INT32
@pytest.mark.full
@pytest.mark.parametrize(("name", "method", "border_rings"), pairs(every=3))
def test_rasters_of_several_levels_decode_as_format_says(name, method, border_rings):
    check_raster(name, [LARGE[method]], method, border_rings)


@pytest.mark.large
@pytest.mark.parametrize("method", some(["store", "cdf97"], 2))
@pytest.mark.parametrize(("shape", "border_rings"), some([((1, 17_000), 3), ((4100, 2), 1)], 2))
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


@pytest.mark.large
@pytest.mark.parametrize("border_rings", some([1, 3], 2))
@pytest.mark.parametrize(
    "name", some(["voids", "lossless", "noise, bound 5", "continuous, NaN"], 4)
)
def test_faithful_files_decode_as_format_says(name, border_rings):
    make, options = RASTERS[name]
    heights = make(np.random.default_rng(4), (66, 70))
    options = options | {"method": "cdf97", "faithful": True, "border_rings": border_rings}
    data = twz_bytes(heights, **options)
    has_voids = "voids" in name or "NaN" in name
    assert read_file(data).header.features == 4 + has_voids
    check_same(data)


@pytest.mark.large
def test_significant_nodes_are_those_with_coefficients():
    heights = whole(np.random.default_rng(4), (66, 70))
    data = twz_bytes(heights, max_error=20, method="cdf97", faithful=True, mesh="zerotree")
    decode_coefficients = cdf97.decode_coefficients
    counts = []

    def recorded(*args):
        found = decode_coefficients(*args)
        finest = np.array([found[1][0][band] for band in cdf97.BANDS])
        counts.append((np.count_nonzero(finest.any(axis=0)), finest[0].size))
        return found

    with patch.object(cdf97, "decode_coefficients", recorded):
        decode(data)
    with terrainwave.open(data) as terrain:
        shares = [found.significant for found in mesh_levels(terrain)]
    # Of the root unit, which refines no block, of its group, and of the four groups below.
    assert len(counts) == 1 + 1 + 4
    below = [sum(column) for column in zip(*counts[2:], strict=True)]
    assert shares == [counts[1][0] / counts[1][1], below[0] / below[1], None]
    assert 0 < shares[1] < 1


# Kernels with one model for each decision are compiled for the lowest effort alone.
@pytest.mark.parametrize(
    "effort", ["default", "best", pytest.param("fast", marks=pytest.mark.full)]
)
@pytest.mark.parametrize("border_rings", [1, 3])
def test_every_effort_of_predictive_decodes_as_format_says(border_rings, effort):
    rng = np.random.default_rng(3)
    heights = with_voids(rng, whole(rng, (34, 36)), -1)
    options = dict(max_error=1, nodata=-1, border_rings=border_rings, effort=effort)
    check_same(twz_bytes(heights, method="predictive", **options))


@pytest.mark.parametrize(
    "path", some(sorted(GOLDEN.glob("v*/*.twz")), 8), ids=lambda path: path.stem
)
def test_golden_files_decode_as_format_says(path):
    check_same(path.read_bytes())


def seen_in(data):
    """Return what of docs/format-rapid.md a file of rapid has."""
    read_payload, file = rapid.read_payload, read_file(data)
    seen = {f"parameters of {min(len(file.parameters), 2)} bytes"}

    def recorded(*args):
        is_narrow, shift, number, bands = found = read_payload(*args)
        seen.add("narrow" if is_narrow else "a shift" if shift else "wide")
        seen.update([f"{len(bands)} bands", f"{len(bands[0].states)} states"])
        seen.update(["an origin"] * (number != 0))
        return found

    class Band(rapid.Band):
        def symbols(self, entries):
            found = super().symbols(entries)
            for entry, y in zip(entries, found, strict=True):
                if entry is not None:
                    kind = "pair" if len(entry[0]) == 226 else "sample"
                    is_last = y == len(entry[0]) - 1
                    seen.add(f"the last symbol of a {kind}" if is_last else f"a {kind}")
            return found

    class Lattice(rapid.Lattice):
        def predict_known(self, *args):
            seen.add("shared lines")
            return super().predict_known(*args)

        def make_heights(self, parent):
            for (plane, i, j), d in self.details.items():
                if j < self.sizes[plane][1] and not self.is_valid(plane, i, j):
                    seen.add("a detail of a void" if d else "a void")
            seen.update(f"no {plane}" for plane, size in self.sizes.items() if 0 in size)
            super().make_heights(parent)

    patches = dict(read_payload=recorded, Band=Band, Lattice=Lattice)
    with patch.multiple(rapid, **patches):
        decode(data)
    return seen


@pytest.mark.full
def test_golden_files_have_all_that_format_rapid_names():
    paths = GOLDEN.glob("v*/rapid*.twz")
    assert set().union(*(seen_in(path.read_bytes()) for path in paths)) == {
        *(f"parameters of {n} bytes" for n in (0, 1, 2)),
        *(f"{n} states" for n in (1, 8, 32)),
        *(f"{n} bands" for n in (1, 3, 4)),  # as long as two take, no golden file is
        *("narrow", "a shift", "wide", "an origin", "shared lines", "no HH", "no HL", "no LH"),
        *("a pair", "a sample", "the last symbol of a pair", "the last symbol of a sample"),
        *("a void", "a detail of a void"),
    }


@pytest.mark.full
@pytest.mark.parametrize("shape", [(2, 1100), (1100, 3)])
def test_tiles_with_a_held_side_decode_as_format_says(shape):
    rng = np.random.default_rng(0)
    heights = np.cumsum(rng.normal(0, 9, shape[0] * shape[1])).astype("int16").reshape(shape)
    heights[0, -30:] = -1
    data = twz_bytes(heights, max_error=3, nodata=-1, method="cdf53")
    assert sum(any(tile.held) for tile in cdf53.tiles_of(read_file(data).grid)) == 2
    check_same(data)


@pytest.mark.full
def test_tiles_with_held_sides_that_meet_decode_as_format_says():
    # The tile of the first 1025 rows and columns would take long; only its last ones are rough.
    heights = np.zeros((1030, 1028), "int16")
    rough = np.random.default_rng(0).laplace(0, 5, heights.shape)
    heights[1024:], heights[:, 1024:] = rough[1024:], rough[:, 1024:]
    data = twz_bytes(heights, max_error=0, method="cdf53")
    file = read_file(data)
    tiles = [tile for tile in cdf53.tiles_of(file.grid) if tile.key != (1, 0, 0)]
    assert [tile.held for tile in tiles[1:]] == [
        (False, True, True, False), (True, False, False, True), (True, True, False, False)
    ]  # fmt: skip
    with terrainwave.open(data) as terrain:
        levels = [terrain.read(level=level) for level in range(terrain.n_levels)]
    for part, found, _ in cdf53.decode_tiles(file, tiles):
        rows = slice(part.rows.first, part.rows.last + 1)
        cols = slice(part.cols.first, part.cols.last + 1)
        expected = levels[part.level][rows, cols] - file.header.base
        np.testing.assert_array_equal(expected, found)


@pytest.mark.parametrize("rate", [7, 9, 12])
def test_files_cut_to_a_rate_decode_as_format_says(rate):
    heights = np.random.default_rng(0).integers(-32_768, 32_768, (30, 36)).astype("int16")
    data = twz_bytes(heights, rate=rate, method="cdf53")
    assert len(data) < len(twz_bytes(heights, max_error=0, method="cdf53"))
    check_same(data)


@pytest.mark.large
@pytest.mark.parametrize(("shape", "border_rings"), some([((140, 37), 1), ((5, 2100), 3)], 2))
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
        for unit, decoded, valid, _ in decode_units(file, level):
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
            assert cdf97.GAIN[band] == [int(cell) for cell in row[1:]]
    head, *rows = table(section("7.5"), "")
    assert head[1:] == ["W", "N", "NW", "NE", "WW", "NN"]
    found = {name: tuple(map(int, cells)) for name, *cells in rows}
    assert found == {
        "HL, LH": cdf97.WEIGHTS["HL"],
        "HH": cdf97.WEIGHTS["HH"],
        "HL at t = 0 if HL-along": cdf97.HL_ALONG,
        "LH at t = 0 if LH-along": cdf97.LH_ALONG,
    }
    assert cdf97.WEIGHTS["HL"] == cdf97.WEIGHTS["LH"]


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
    body = (
        metadata + file.parameters + page + b"".join(file.payloads[key] for key in file_order(keys))
    )
    fields = vars(file.header) | changes
    fields |= dict(
        file_size=128 + len(body),
        metadata_length=len(metadata),
        metadata_crc=zlib.crc32(metadata),
        parameters_length=len(file.parameters),
        parameters_crc=zlib.crc32(file.parameters),
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

    def _answer(self, models, *indices):
        share = self.share_of_ones
        if share is None:  # as the models expect
            share = sum(models.probability[i] for i in indices) / len(indices) / 2**22
        return int(self.rng.random() < share)

    def bit(self, models, i):
        bit = self._answer(models, i)
        super().bit(models, i, bit)
        return bit

    def mean_bit(self, models, a, b):
        bit = self._answer(models, a, b)
        super().mean_bit(models, a, b, bit)
        return bit

    def mixed_bit(self, models, a, b, mixers, i):
        bit = self._answer(models, a, b)
        super().mixed_bit(models, a, b, mixers, i, bit)
        return bit

    def raw(self, k):
        value = int(self.rng.integers(0, 1 << k))
        super().raw(value, k)
        return value

    def end(self):
        self.stream = super().end()

    unary = RangeDecoder.unary
    magnitude = RangeDecoder.magnitude


class RandomBits:
    """In the place of bits of a mask it answers at random, and encodes what it answered (§5.2)."""

    def __init__(self, rng):
        self.rng, self.share = rng, rng.choice([0.5, 0.97])
        self.n_states, self.coded, self.section = int(rng.choice([1, 4])), [], None
        sets = int(rng.integers(16)), int(rng.integers(8))
        self.head = bytes([sets[0] + 16 * sets[1]])
        if sets[1] == 7:
            own = rng.integers(0, 256, 62).tolist()
            self.head = bytes([16 * 7, *own])
            self.ones = [16 * byte + 8 for byte in own]
        else:
            self.ones = MASK_SAMPLES[sets[0]] + MASK_GROUPS[sets[1]]

    def read(self, model):
        bit = int(self.rng.random() < self.share)
        self.coded.append((model, bit))
        return bit

    def end(self):
        states, words = [65536] * self.n_states, []
        for k, (model, bit) in reversed([*enumerate(self.coded)]):
            ones, state = self.ones[model], states[k % self.n_states]
            own, first = (ones, 0) if bit else (4096 - ones, ones)
            if state >= own * 2**20:
                words.insert(0, state % 65536)
                state //= 65536
            states[k % self.n_states] = state // own * 4096 + state % own + first
        first = self.head[0] + 128 * (self.n_states == 4)
        coded = b"".join(state.to_bytes(4, "little") for state in states)
        coded += b"".join(word.to_bytes(2, "little") for word in words)
        self.section = bytes([first]) + self.head[1:] + coded


def random_validity(rng, file, unit, parent_unit, parent_valid):
    """Return which samples of a unit are valid, at random, and the section that says so."""
    source = RandomBits(rng)
    with patch.object(payloads, "Bits", lambda section: source):
        valid = decode_valid(file, unit, b"any", parent_unit, parent_valid)
    return valid, source.section


def varint(value):
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def random_payload(rng, file, unit, parent_unit, parent_heights, parent_valid):
    """Return a payload that is legal and otherwise random."""
    if rng.random() < 0.5:
        valid, mask = random_validity(rng, file, unit, parent_unit, parent_valid)
        payload = b"\1" + varint(len(mask)) + mask
    else:
        valid, payload = decode_valid(file, unit, None, parent_unit, parent_valid), b"\0"
    if not any(map(any, valid)):
        return b""
    if METHODS[file.header.method] == "rapid":
        parents = parent_unit, parent_heights
        return (
            payload + any_rapid.random_bytes(rng, any_rapid.START, file, unit, valid, *parents)[0]
        )
    if METHODS[file.header.method] == "cdf97":
        head, decode_method = random_cdf97_head(rng), cdf97.decode_cdf97
    else:
        head, decode_method = bytes([rng.integers(4)]), predictive.decode_predictive
    shares = [None, None, 0.05, 0.3, 0.5, 0.8, 0.97]
    source = RandomCoder(rng, shares[rng.integers(len(shares))])
    with (
        patch.object(range_coder, "RangeDecoder", lambda data: source),
        patch.object(mixing, "MixingDecoder", lambda data: source),
    ):
        decode_method(file, unit, head, valid, parent_unit, parent_heights)
    return payload + head + source.stream


def random_cdf97_head(rng):
    """Return what a payload of cdf97 has before its stream (§7.1)."""
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
        head += bytes([rng.integers(0, len(cdf97.TERM_WEIGHTS_97))])
    return head


def put_magnitude(encoder, models, first, value):
    """Write what `RangeDecoder.magnitude` reads with k = 0 (§6.5)."""

    def put_unary(first, n, limit):
        for i in range(min(n + 1, limit)):
            encoder.bit(models, first + i, int(i < n))

    put_unary(first, min(value, 14), 14)
    if value >= 14:
        n_bits = (value - 13).bit_length() - 1
        put_unary(first + 14, n_bits, 31)
        encoder.raw(value - 13, n_bits)


def random_parameters(rng):
    """Return tables (P.10) that make all a plane's header can name exist."""
    encoder, models = RangeEncoder(), Models(138)
    for plane in predictive.PLANES:
        taps, core = predictive.TAPS[plane], predictive.CORE[plane]
        n_trained = len(predictive.read_tables(b"").stencils[plane])
        encoder.raw(16 - n_trained, 4)
        for _ in range(16 - n_trained):
            shift = int(rng.integers(8))
            encoder.raw(int(rng.integers(n_trained)), 4)
            encoder.raw(shift, 3)
            for tap in taps:
                if tap != core[0]:
                    size = int(rng.integers(1001 >> shift))
                    put_magnitude(encoder, models, 0 if tap in core else 46, size)
                    if size:
                        encoder.raw(int(rng.integers(2)), 1)
        encoder.raw(1, 1)
        for weight in rng.integers(4097, size=18) >> rng.integers(13, size=18):
            put_magnitude(encoder, models, 92, int(weight))
    return b"\1" + encoder.end()


def random_header(rng, shape, method, border_rings):
    """Return a file to put payloads into, whose heights and steps may be extreme."""
    options = dict(max_error=0, method=method, border_rings=border_rings)
    file = read_file(twz_bytes(np.zeros(shape, "int32"), **options))
    span = 2 ** int(rng.integers(4, 31)) - 1
    z_min = int(rng.integers(-(2**30), 2**30 - span + 1))
    changes = dict(
        z_min=z_min,
        z_max=z_min + span,
        step=int(rng.integers(0, 2**30)) >> int(rng.integers(0, 31)) << 1 | 1,
    )
    changes["features"] = 1
    if method == "cdf97":
        changes["features"] += 4 * int(rng.integers(2))
    for name, value in changes.items():
        setattr(file.header, name, value)
    if rng.random() < 0.5:
        file.metadata["nodata"] = z_min + int(rng.choice([0, rng.integers(span), span]))
    return file


def random_file(rng, shape, method, border_rings):
    """Return a legal file of random payloads."""
    file = random_header(rng, shape, method, border_rings)
    if method == "predictive":
        file.parameters = random_parameters(rng)
        file.tables = predictive.read_tables(file.parameters)
    elif method == "rapid":
        file.parameters = any_rapid.random_section(rng)
        file.tables = read_rapid_tables(file.parameters, file.header.step)

    def generate(file, unit, payload, *parent):
        file.payloads[unit.key] = payload = random_payload(rng, file, unit, *parent)
        return decode_payload(file, unit, payload, *parent)

    with patch.object(units, "decode_payload", generate):
        decode_units(file, file.grid.k_max)
    return assembled(file)


def random_tile_file(rng, shape, n_planes):
    """Return a legal file of one random tile of cdf53, whose stream may be cut."""
    file = random_header(rng, shape, "cdf53", 1)
    (tile,) = cdf53.tiles_of(file.grid)
    outer = outer_valid = None
    sections = []
    for level, part in enumerate(tile.parts, tile.first):
        part.level = level
        outer_valid, mask = random_validity(rng, file, part, outer, outer_valid)
        sections.append(varint(len(mask)) + mask)
        outer = part
    shares = [None, None, 0.05, 0.3, 0.5, 0.8, 0.97]
    source, models = RandomCoder(rng, shares[rng.integers(len(shares))]), Models(1515)
    finest = tile.parts[-1]
    spiht = Spiht((finest.rows.n, finest.cols.n), tile.n_transforms)
    spiht.run(n_planes, lambda model, _truth: source.bit(models, model))
    source.end()
    stream = source.stream if n_planes else b""
    n_stream = len(stream)
    if rng.random() < 0.5:
        n_stream = int(rng.integers(n_stream + 1))
    head = b"\1" + b"".join(sections) + varint(0) + varint(int(rng.integers(2**32 - 1)))
    head += varint(n_planes)
    for plane in range(n_planes):
        head += varint(len(stream) if plane == 0 else 0)
    head += varint(n_stream)
    payload = head + zlib.crc32(head).to_bytes(4, "little")
    for at in range(0, n_stream, cdf53.PIECE):
        piece = stream[at : min(at + cdf53.PIECE, n_stream)]
        payload += piece + zlib.crc32(piece).to_bytes(4, "little")
    file.payloads[tile.key] = payload
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
            for unit, heights, valid, _ in decode_units(file, level):
                decoded = terrain.decoder.unit(Block(*unit.key))
                np.testing.assert_array_equal(decoded.mask, np.array(valid) == 1)
                np.testing.assert_array_equal(decoded.heights, heights)


@pytest.mark.parametrize(
    ("method", "border_rings"),
    [*product(["cdf97", "predictive"], [1, 3]), pytest.param("rapid", 1, marks=pytest.mark.full)],
)
@pytest.mark.parametrize("seed", some(range(10), 5))
def test_random_payloads_of_a_root_decode_as_format_says(seed, method, border_rings):
    check_units(random_file(np.random.default_rng(seed), (6, 11), method, border_rings))


@pytest.mark.large
@pytest.mark.parametrize(
    ("method", "border_rings"),
    [
        *some([*product(["cdf97", "predictive"], [1, 3])], 2),
        pytest.param("rapid", 1, marks=pytest.mark.full),
    ],
)
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(1, 3))]
)
def test_random_payloads_of_groups_decode_as_format_says(seed, method, border_rings):
    for shape in ((33, 40), (9, 140), (140, 4)):
        check_units(random_file(np.random.default_rng(seed), shape, method, border_rings))


@pytest.mark.parametrize("seed", range(10))
def test_random_tiles_decode_as_format_says(seed):
    rng = np.random.default_rng(seed)
    check_same(random_tile_file(rng, (6, 11), n_planes=int(rng.integers(61))))


@pytest.mark.large
@pytest.mark.parametrize("seed", some(range(5), 3))
def test_random_tiles_of_several_levels_decode_as_format_says(seed):
    for shape in ((33, 40), (9, 140), (140, 4)):
        check_same(random_tile_file(np.random.default_rng(seed), shape, n_planes=2 * seed))


def test_tables_of_a_file_are_those_of_p_10():
    section = random_parameters(np.random.default_rng(0))
    found = predictive.read_tables(section)
    expected = all_tables(parse_file_tables(section))
    for number, plane in enumerate(predictive.PLANES, 1):
        np.testing.assert_array_equal(expected.stencils[number], found.stencils[plane])
        np.testing.assert_array_equal(expected.e_weights[number], found.weights[plane])


@pytest.mark.large
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(method, marks=pytest.mark.full) if method == "rapid" else method
        for method in METHODS.values()
    ],
)
def test_of_damaged_payloads_the_library_rejects_those_that_format_calls_corrupt(method):
    rng = np.random.default_rng(0)
    heights = with_voids(rng, whole(rng, (12, 17)), -1)
    file = read_file(twz_bytes(heights, max_error=1, nodata=-1, method=method))
    key = (-1, 0, 0)
    whole_payload = file.payloads[key]
    n_read = 0
    for _ in range(100):
        payload = bytearray(whole_payload)
        kind = rng.integers(4)
        if kind == 0:
            del payload[rng.integers(1, len(payload)) :]  # empty, it means that all is void
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
    # Checksums of its own show cdf53 all damage, and last states and words nearly all to rapid.
    if method != "rapid":
        assert (n_read > 0) == (method != "cdf53")


def as_a_program(*words):
    return python_with(["-m", "terrainwave.reference", *words])


def test_the_decoder_is_a_program_that_imports_no_numba(tmp_path):
    golden = GOLDEN / "v2" / "rapid-digests-float32.twz"
    done = as_a_program(golden, tmp_path / "a.npy")
    assert done.returncode == 0, done.stderr
    with terrainwave.open(golden) as terrain:
        heights, valid = terrain.read_with_mask()
        assert done.stdout.strip() == terrain.digest()
    found, mask = np.load(tmp_path / "a.npy"), np.load(tmp_path / "a.valid.npy")
    np.testing.assert_array_equal(mask, valid)
    np.testing.assert_array_equal(found[valid], heights[valid])
    code = "import sys, terrainwave.reference.units; sys.exit('numba' in sys.modules)"
    assert python(code).returncode == 0


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("predictive-float32-nan.twz", "method predictive, which is not part of this decoder"),
        ("invalid/metadata-crc.twz", "corrupt: metadata_crc"),
        ("missing.twz", "No such file"),
    ],
)
def test_the_program_names_what_it_cannot_decode(name, words, tmp_path):
    done = as_a_program(GOLDEN / "v2" / name, tmp_path / "a.npy")
    assert done.returncode == 1
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1
