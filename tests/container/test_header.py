"""The fixed header: round trip, and every rule of FORMAT.md §4.1 with a valid checksum."""

import struct
import zlib
from fractions import Fraction

import pytest
from container.toys import toy_header
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.container.header import (
    DTYPE_CODES,
    HAS_VOIDS,
    HEADER_SIZE,
    Extents,
    Header,
    pack_header,
    unpack_header,
)
from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    TerrainwaveError,
    TruncatedStreamError,
    UnsupportedVersionError,
)
from terrainwave.names import METHODS

EXTENTS = Extents(5000, 100, 0xDEADBEEF, 20, 7, 300)


def packed(**changes):
    return pack_header(toy_header(**changes), EXTENTS)


def patched(offset, layout, *values):
    """Return a header with other bytes at `offset` and the checksum that belongs to them."""
    data = bytearray(packed())
    struct.pack_into("<" + layout, data, offset, *values)
    return bytes(data[:124]) + struct.pack("<I", zlib.crc32(data[:124]))


bounds = st.floats(0, 1e6)
headers = st.builds(
    Header,
    n_rows=st.integers(1, 2**25),
    n_cols=st.integers(1, 2**25),
    block=st.sampled_from([32, 64, 128, 256, 512, 1024]),
    border_rings=st.sampled_from([1, 3]),
    method=st.sampled_from([name for name, method in METHODS.items() if method.has_rings]),
    dtype=st.sampled_from(sorted(DTYPE_CODES)),
    effort=st.integers(0, 9),
    quantum=st.builds(Fraction, st.integers(1, 2**20), st.integers(1, 2**62)),
    base=st.integers(-(2**42), 2**42),
    step=st.integers(0, 2**30 - 1).map(lambda half: 2 * half + 1),
    z_min=st.integers(-(2**29), 0),
    z_max=st.integers(0, 2**29 - 1),
    max_error=st.just(1e6),
    effective_bound=bounds,
    rho=bounds,
).filter(lambda header: header.border_rings == 1 or METHODS[header.method].has_rings)


@given(header=headers)
def test_header_comes_back_from_its_bytes(header):
    data = pack_header(header, EXTENTS)
    assert len(data) == HEADER_SIZE
    assert unpack_header(data) == (header, EXTENTS)


@pytest.mark.parametrize(
    "changes",
    [
        {"n_rows": 2**31, "n_cols": 2**19},
        {"z_min": 0, "z_max": -1, "features": HAS_VOIDS},
        {"z_min": -(2**30), "z_max": -1},
        {"step": 2**31 - 1},
        {"quantum": Fraction(1, 2**63 - 1), "base": 2**62},
        {"base": 2**63 - 1 - 2**31, "quantum": Fraction(1)},
    ],
)
def test_extreme_but_legal_values_come_back(changes):
    header = toy_header(metadata={}, file_tables=b"", **changes)
    assert unpack_header(pack_header(header, EXTENTS))[0] == header


@pytest.mark.parametrize("length", [8, 9, 64, 127])
def test_a_short_header_is_truncated(length):
    with pytest.raises(TruncatedStreamError, match=f"byte {length}"):
        unpack_header(packed()[:length])


def test_text_mode_damage_shows_in_the_magic():
    with pytest.raises(CorruptStreamError, match="line ends were changed"):
        unpack_header(packed().replace(b"\r\n", b"\n"))


def test_a_damaged_version_is_no_newer_one():
    for version in set(range(256)) - {2}:
        data = bytearray(packed())
        data[8] = version
        with pytest.raises(CorruptStreamError, match=f"byte 8 is damaged.* version {version},"):
            unpack_header(bytes(data))


UNSUPPORTED = [
    *(
        (
            8,
            "B",
            old,
            f"found format version {old}, expected 2: made by a development build:"
            " compress the raster again",
        )
        for old in (0, 1)
    ),
    (8, "B", 3, "found format version 3, expected 2: install a newer terrainwave"),
    (35, "B", 0, "unknown data type 0"),
    (35, "B", 9, "unknown data type 9"),
    (39, "B", 128, "reserved"),
]


@pytest.mark.parametrize(("offset", "layout", "value", "message"), UNSUPPORTED)
def test_what_a_newer_version_may_write_is_unsupported(offset, layout, value, message):
    with pytest.raises(UnsupportedVersionError, match=message) as raised:
        unpack_header(patched(offset, layout, value))
    assert ("install a newer terrainwave" in str(raised.value)) == ("development" not in message)


CORRUPT = [
    (16, "Q", 547, "does not hold"),
    (16, "Q", 2**63, "does not hold"),
    (28, "I", 0, "n_cols is 0"),
    (28, "I", 2**32 - 1, "n_cols"),
    (24, "II", (2**31, 2**20), "more than 2"),
    (33, "B", 0, "border_rings is 0"),
    (40, "Q", 2**63, "not positive"),
    (48, "Q", 0, "not positive"),
    (40, "Q", 2**40 + 1, "overflow 64 bits"),
    (56, "q", -(2**63), "overflow 64 bits"),
    (64, "I", 0, "step is 0"),
    (68, "ii", (0, -1), "no sample is valid, and none may be void"),
    (68, "ii", (1, 0), "heights 1 ... 0"),
    (68, "i", -(2**30) - 1, "out of range"),
    (72, "i", 2**30 + 1, "out of range"),
    (68, "ii", (-1, 2**30 - 1), "out of range"),
    (76, "I", 2**20 + 1, "metadata of 1048577"),
    (80, "d", -0.5, "negative or not finite"),
    (80, "d", float("inf"), "negative or not finite"),
    (88, "d", float("nan"), "negative or not finite"),
    (116, "I", 0, "top page of 0"),
    (116, "I", 2**15 + 1, "top page of 32769"),
]


@pytest.mark.parametrize(("offset", "layout", "value", "message"), CORRUPT)
def test_a_field_out_of_range_is_corrupt_though_the_checksum_is_right(
    offset, layout, value, message
):
    values = value if isinstance(value, tuple) else (value,)
    with pytest.raises(CorruptStreamError, match=message):
        unpack_header(patched(offset, layout, *values))


@given(fields=st.binary(min_size=112, max_size=112))
def test_any_fields_with_a_right_checksum_give_a_header_or_our_own_error(fields):
    data = packed()[:12] + fields
    data += struct.pack("<I", zlib.crc32(data))
    try:
        header, _ = unpack_header(data)
    except TerrainwaveError:
        return
    assert header.n_rows * header.n_cols <= 2**50


@pytest.mark.parametrize(
    "changes",
    [
        {"block": 48},
        {"block": 0},
        {"method": "jpeg"},
        {"dtype": "int8"},
        {"step": 2},
        {"max_error": float("nan")},
        {"quantum": Fraction(0)},
        {"n_rows": 0},
    ],
)
def test_a_header_outside_the_limits_is_not_written(changes):
    with pytest.raises(InvalidHeightsError):
        pack_header(toy_header(**changes), EXTENTS)
