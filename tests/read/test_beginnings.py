"""Windows that take rows of a unit: these alone are decoded (format-rapid.md, R.9)."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from lone_units import terrain as heights_of
from twz import twz_bytes

from terrainwave import Terrain
from terrainwave.codec import group
from terrainwave.codec.group import decode_unit, encode_unit, rows_above
from terrainwave.codec.rapid.refiner import RapidRefiner
from terrainwave.codec.refiner import ALL_ROWS, Decoded, Rows, Sides, Validity
from terrainwave.codec.unit_specs import unit_spec
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.read.decoder import units_of

SHAPE = 230, 301
HEIGHTS = heights_of(SHAPE)
NOISE = np.random.default_rng(6).integers(-30_000, 30_000, (200, 280)).astype("int16")
VOIDS = np.random.default_rng(5).random((8, 11)).repeat(29, 0).repeat(28, 1)[:230, :301] < 0.2
FILES = {
    "all valid": (HEIGHTS.astype("int16"), {}),
    "long payloads": (NOISE, {"block": 64, "max_error": 0}),
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


@pytest.mark.few(1)
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
    """Units that are decoded, with the rows that they have."""
    found = []

    def noting(refiner, spec, parent, payload, rows=ALL_ROWS, raw=None):
        unit = decode_unit(refiner, spec, parent, payload, rows, raw)
        found.append((spec.level, spec.region.row, spec.region.col, unit.rows))
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
    # Rows 64 … 73 are the first ten of their unit. They need what its first strip does, ten rows of
    # its block, which begins at row 32 of a group. The first three strips of that one need 26 rows
    # of a block that begins at row 0, and so on: all these have one band.
    assert decoded == [
        (0, 0, 0, ALL_ROWS), (1, 0, 0, Rows(0, 18)), (2, 0, 0, Rows(0, 26)),
        (3, 0, 0, Rows(32, 42)), (4, 64, 64, Rows(0, 10)),
    ]  # fmt: skip


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


@pytest.mark.full
def test_units_that_leave_the_cache_after_the_plan_are_decoded_as_their_children_need():
    """Other threads put theirs in the place of units that were at hand."""
    rng = np.random.default_rng(3)
    whole = Terrain(plain_file(), threads=1, native=False).read()
    with Terrain(plain_file(), threads=1, native=False) as terrain:
        decoder, level = terrain.decoder, terrain.n_levels - 1
        for _ in range(200):
            region = Region(*(int(rng.integers(0, n - 90)) for n in SHAPE), 15, 90)
            keys, kept = units_of(terrain.grid, level, region), decoder._cache._values
            for key in [key for key in kept if rng.random() < 0.5]:
                del kept[key]
            _, rows = decoder.prefetch_for(keys, region)
            kept.clear()
            for key in keys:
                (at_rows, at_cols), unit = decoder.part(key, region, rows)
                part = whole[region.row :, region.col :][at_rows, at_cols]
                np.testing.assert_array_equal(terrain.quantizer.dequantize(unit.heights), part)


def lone_unit(target=None, **options):
    """Return a group with neighbours, its parent's block, its payload and what that decodes to."""
    target = heights_of((65, 65), seed=4) if target is None else target
    grid = Grid(2 * target.shape[0] - 1, 2 * target.shape[1] - 1, target.shape[0] // 2)
    spec = unit_spec(grid, CodecParameters(5, -9000, 9000, (1, 0), 1, 0), Block(1, 1, 1))
    spec = replace(spec, shared=Sides(True, True, True, True), **options)
    parent = Decoded(np.ascontiguousarray(target[::2, ::2]), Validity(None))
    refiner = RapidRefiner()
    payload, whole = encode_unit(refiner, spec, parent, target, np.ones(target.shape, dtype=bool))
    return refiner, spec, parent, payload, whole


@pytest.mark.parametrize(
    "rows",
    [(0, 1), (0, 2), (0, 64), (1, 2), (9, 10), (5, 31), (32, 33), (40, 57), (63, 64), (64, 65)],
)
@pytest.mark.parametrize("is_long", [False, True])
def test_rows_of_a_unit_are_those_of_the_whole(rows, is_long):
    """Whatever its parent has in rows that they do not need."""
    target = np.random.default_rng(3).integers(-9000, 9000, (65, 65)).astype(np.int32)
    refiner, spec, parent, payload, whole = lone_unit(target if is_long else None)
    first, end = rows_above(refiner, spec, payload, Rows(*rows))
    known = np.full_like(parent.heights, -(2**31))
    known[first:end] = parent.heights[first:end]
    found = decode_unit(refiner, spec, parent._replace(heights=known), payload, Rows(*rows))
    assert found.rows == rows
    part = slice(*rows)
    np.testing.assert_array_equal(found.heights[part], whole.heights[part])


def test_bytes_of_other_rows_are_not_looked_at():
    target = np.random.default_rng(3).integers(-9000, 9000, (331, 331)).astype(np.int32)
    refiner, spec, parent, payload, whole = lone_unit(target)
    assert payload[1] >> 3 & 3 == 3  # four bands
    damaged = payload[:-9] + bytes(9)
    found = decode_unit(refiner, spec, parent, damaged, Rows(0, 9))
    np.testing.assert_array_equal(found.heights[:9], whole.heights[:9])
    with pytest.raises(CorruptStreamError):
        decode_unit(refiner, spec, parent, damaged, Rows(320, 331))


def test_the_parent_of_rows_is_decoded_in_part():
    refiner, spec, _, payload, _ = lone_unit(
        np.random.default_rng(3).integers(-9000, 9000, (331, 331)).astype(np.int32)
    )
    assert rows_above(refiner, spec, payload, Rows(150, 160)) == (38, 90)
    assert rows_above(refiner, spec, payload, Rows(0, 1)) == (0, 10)


def test_exceptions_are_counted_from_the_first_row_on():
    target = np.random.default_rng(8).choice(np.int32([-1, 7]), (65, 65))
    refiner, spec, parent, payload, whole = lone_unit(target, forbidden=(0, 6))
    assert payload[0] & 2  # it has exceptions
    for rows in (Rows(0, 5), Rows(9, 20), Rows(3, 64)):
        found = decode_unit(refiner, spec, parent, payload, rows)
        assert found.rows == (0, rows.end)
        np.testing.assert_array_equal(found.heights[: rows.end], whole.heights[: rows.end])
