"""Windows that end inside a unit: its first rows alone are decoded (format-rapid.md, R.5)."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from lone_units import terrain as heights_of
from twz import twz_bytes

from terrainwave import Terrain
from terrainwave.codec import group
from terrainwave.codec.group import decode_unit, encode_unit
from terrainwave.codec.rapid.refiner import RapidRefiner
from terrainwave.codec.refiner import ALL_ROWS, Decoded, Sides, Validity
from terrainwave.codec.unit_specs import unit_spec
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid

SHAPE = 230, 301
HEIGHTS = heights_of(SHAPE)
VOIDS = np.random.default_rng(5).random((8, 11)).repeat(29, 0).repeat(28, 1)[:230, :301] < 0.2
FILES = {
    "all valid": (HEIGHTS.astype("int16"), {}),
    "three rings": (HEIGHTS.astype("int16"), {"border_rings": 3}),
    "voids": (np.where(VOIDS, -32768, HEIGHTS).astype("int16"), {"nodata": -32768}),
    # Many heights would decode to the nodata value: sections of exceptions.
    "nodata among heights": (np.where(VOIDS, 7, HEIGHTS | 8).astype("int16"), {"nodata": 7}),
    "remainders": (np.float32(HEIGHTS) + np.float32(0.1), {"max_error": 0}),
    "predictive": (HEIGHTS.astype("int16"), {"method": "predictive"}),
    "cdf53": (HEIGHTS.astype("int16"), {"method": "cdf53"}),
}


@pytest.fixture(params=FILES, name="data")
def _data(request):
    heights, options = FILES[request.param]
    return twz_bytes(heights, **{"max_error": 2, "method": "rapid", "block": 32} | options)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_window_of_any_level_that_ends_anywhere_is_that_part_of_the_level(data, threads):
    rng = np.random.default_rng(1)
    with Terrain(data, threads=1, native=False) as terrain:
        levels = [terrain.read(level=level) for level in range(terrain.n_levels)]
    for level, whole in enumerate(levels):
        with Terrain(data, threads=threads, native=False) as terrain:
            for _ in range(9):
                first = [int(rng.integers(0, n)) for n in whole.shape]
                sizes = [int(rng.integers(1, n + 1)) for n in whole.shape]
                part = np.s_[first[0] : first[0] + sizes[0], first[1] : first[1] + sizes[1]]
                np.testing.assert_array_equal(
                    terrain.read((*first, *sizes), level=level), whole[part]
                )


@pytest.fixture(name="decoded")
def _decoded(monkeypatch):
    """Units that are decoded, with how many rows they have."""
    found = []

    def noting(refiner, spec, parent, payload, n_rows=ALL_ROWS):
        unit = decode_unit(refiner, spec, parent, payload, n_rows)
        found.append((spec.level, spec.region.row, spec.region.col, len(unit.heights)))
        return unit

    monkeypatch.setattr(group, "decode_unit", noting)
    return found


@cache
def plain_file():
    return twz_bytes(HEIGHTS.astype("int16"), max_error=2, method="rapid", block=32)


def test_no_more_rows_are_decoded_than_a_window_wants(decoded):
    plain_file()
    decoded.clear()
    with Terrain(plain_file(), threads=1, native=False) as terrain:
        terrain.read((64, 64, 10, 20))
    # Of the unit rows 64 … 73. Its block is rows 32 … 64 of a group, the last ones; that one's is
    # rows 0 … 32 of the next, the first ones; levels 0 and 1 have no more rows than are wanted.
    assert decoded == [(0, 0, 0, 15), (1, 0, 0, 29), (2, 0, 0, 33), (3, 0, 0, 65), (4, 64, 64, 10)]


def test_a_unit_is_decoded_at_most_twice_in_a_cache_with_room(decoded):
    whole = Terrain(plain_file(), threads=1, native=False).read()
    decoded.clear()
    with Terrain(plain_file(), threads=1, native=False) as terrain:
        for row in range(0, SHAPE[0], 7):
            np.testing.assert_array_equal(terrain.read((row, 0, 7, 301)), whole[row : row + 7])
    places = [place for *place, _ in decoded]
    assert max(places.count(place) for place in places) == 2


def test_a_window_of_whole_units_decodes_each_unit_once(decoded):
    plain_file()
    decoded.clear()
    with Terrain(plain_file(), threads=1, native=False) as terrain:
        terrain.read((0, 0, 128, 301))
        places = [place for *place, _ in decoded]
        assert len(places) == len({tuple(place) for place in places})


def test_a_part_of_a_unit_counts_with_the_memory_that_it_keeps():
    with Terrain(plain_file(), threads=1, native=False, cache_bytes=1 << 20) as terrain:
        decoder = terrain.decoder
        terrain.read((64, 64, 10, 20))
        unit = decoder.unit(Block(3, 1, 1), {Block(3, 1, 1): 10})
        assert unit.heights.shape == (10, 65)
        assert decoder._cache._size >= 65 * 65 * 4


GRID = Grid(129, 129, 32)


def lone_unit(target=None, **options):
    """Return a group with neighbours, its parent's block, its payload and what that decodes to."""
    spec = unit_spec(GRID, CodecParameters(5, -9000, 9000, (1, 0), 1, 0), Block(1, 1, 1))
    spec = replace(spec, shared=Sides(True, True, True, True), **options)
    target = heights_of(spec.region.shape, seed=4) if target is None else target
    parent = Decoded(np.ascontiguousarray(target[::2, ::2]), Validity(None))
    refiner = RapidRefiner()
    payload, whole = encode_unit(refiner, spec, parent, target, np.ones(target.shape, dtype=bool))
    return refiner, spec, parent, payload, whole


@pytest.mark.parametrize("n_rows", [1, 2, 3, 8, 31, 32, 63, 64])
def test_the_first_rows_of_a_unit_are_those_of_the_whole(n_rows):
    refiner, spec, parent, payload, whole = lone_unit()
    found = decode_unit(refiner, spec, parent, payload, n_rows)
    assert found.heights.shape == (n_rows, 65)
    np.testing.assert_array_equal(found.heights, whole.heights[:n_rows])


def test_bytes_after_the_first_rows_are_not_looked_at_and_bytes_within_are():
    refiner, spec, parent, payload, whole = lone_unit()
    more = payload + b"more"
    found = decode_unit(refiner, spec, parent, more, 9)
    np.testing.assert_array_equal(found.heights, whole.heights[:9])
    with pytest.raises(CorruptStreamError):
        decode_unit(refiner, spec, parent, more)
    for n_bytes in range(len(payload)):
        try:
            found = decode_unit(refiner, spec, parent, payload[:n_bytes], 9)
        except CorruptStreamError:
            continue
        assert n_bytes == 0 or found.heights.shape == (9, 65)


def test_exceptions_of_the_first_rows_are_the_first_ones():
    target = np.random.default_rng(8).choice(np.int32([-1, 7]), (65, 65))
    refiner, spec, parent, payload, whole = lone_unit(target, forbidden=(0, 6))
    assert payload[0] & 2  # it has exceptions
    for n_rows in (5, 20, 64):
        found = decode_unit(refiner, spec, parent, payload, n_rows)
        np.testing.assert_array_equal(found.heights, whole.heights[:n_rows])
