"""Corrections come back exactly, take about their entropy, and bring kept heights back."""

import re
from pathlib import Path

import numpy as np
import pytest
from cases import some
from hypothesis import given
from hypothesis import strategies as st
from reference import level_mask

from terrainwave.codec import registry
from terrainwave.codec.corrections import decode_corrections, encode_corrections
from terrainwave.codec.group import decode_unit, encode_unit
from terrainwave.codec.refiner import FREE
from terrainwave.codec.shared_lines import plan_border, shared_samples
from terrainwave.codec.unit_specs import block_of_unit, unit_spec
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.reference import grid as reference_grid
from terrainwave.reference.payloads import decode_corrections as decode_slowly

GRID = Grid(90, 75, 32)
KEYS = [Block(-1, 0, 0), Block(0, 0, 0), Block(1, 0, 0), Block(1, 1, 0)]
STEPS = (3, 5, 21, 4001)


def spec_of(key, rings=1, step=5, **limits):
    limits = {"z_min": -9000, "z_max": 9000, "forbidden": (1, 0)} | limits
    parameters = CodecParameters(step, rings=rings, effort=1, has_corrections=True, **limits)
    return unit_spec(GRID, parameters, key)


def is_inherited(spec):
    """Return which samples of a unit are the parent's."""
    row, col = np.indices(spec.region.shape)
    even = (row + spec.region.row) % 2 + (col + spec.region.col) % 2 == 0
    return even & (spec.parent_region is not None)


def drawn(spec, seed, share, most=None):
    """Return corrections of a share of the samples, in patches and alone."""
    rng = np.random.default_rng(seed)
    most = spec.half if most is None else most
    values = rng.integers(-most, most, spec.region.shape, np.int32, endpoint=True)
    rows = rng.random((spec.region.n_rows, 1)) < 0.3
    values[
        (rng.random(values.shape) >= share) & ~(rows & (rng.random(values.shape) < share * 5))
    ] = 0
    values[is_inherited(spec)] = 0
    return values


@pytest.mark.few(3)
@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("rings", [1, 3])
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.002, 0.1, 0.9]), st.sampled_from(STEPS))
def test_corrections_come_back_here_and_by_the_slow_decoder(key, rings, seed, share, step):
    spec = spec_of(key, rings, step)
    added = drawn(spec, seed, share, most=(seed % 7 and spec.half) or 2**31 - 1)
    section = encode_corrections(added, spec)
    assert (section == b"") == (not added.any())
    if section:
        np.testing.assert_array_equal(decode_corrections(section, spec).added, added)
        unit = reference_grid.Grid(90, 75, 32, rings).unit(tuple(key))
        np.testing.assert_array_equal(decode_slowly(section, unit, step), added)


def test_the_example_of_the_format_holds():
    """FORMAT.md §5.4: root block of 3 × 5 samples, n = 5."""
    document = (Path(__file__).parents[2] / "docs" / "FORMAT.md").read_text(encoding="utf-8")
    text = document[document.index("### 5.4 ") : document.index("## 6. ")]
    data = bytes.fromhex(re.search(r"are the bytes ((?:[0-9a-f]{2} ?)+)\.", text)[1])
    parameters = CodecParameters(5, -99, 99, (1, 0), 1, 1, has_corrections=True)
    spec = unit_spec(Grid(3, 5, 32), parameters, Block(-1, 0, 0))
    expected = [[0, -1, 0, 0, 0], [0, 2, 0, 0, 0], [0, 0, 0, 0, 0]]
    np.testing.assert_array_equal(decode_corrections(data, spec).added, expected)
    assert encode_corrections(np.array(expected, np.int32), spec) == data


@pytest.mark.large
@pytest.mark.parametrize(("share", "step"), [(0.01, 5), (0.01, 81), (0.2, 5), (0.5, 401)])
def test_a_section_takes_about_its_entropy(share, step):
    grid = Grid(600, 600, 256)
    parameters = CodecParameters(step, -9000, 9000, (1, 0), 1, 1, has_corrections=True)
    spec = unit_spec(grid, parameters, Block(0, 0, 0))
    rng = np.random.default_rng(1)
    added = rng.integers(1, spec.half, spec.region.shape, np.int32, endpoint=True)
    added *= rng.choice(np.int32([-1, 1]), added.shape)
    is_coded = ~is_inherited(spec)
    added[(rng.random(added.shape) >= share) | ~is_coded] = 0
    n, n_corrected = np.count_nonzero(is_coded), np.count_nonzero(added)
    p = n_corrected / n
    flags = -n * (p * np.log2(p) + (1 - p) * np.log2(1 - p))
    entropy = (flags + n_corrected * np.log2(2 * spec.half)) / 8
    assert entropy * 0.98 <= len(encode_corrections(added, spec)) <= 1.06 * entropy + 50


@pytest.mark.few(3)
@pytest.mark.large
@pytest.mark.parametrize(("method", "rings"), [("rapid", 1), ("predictive", 1), ("predictive", 3)])
@pytest.mark.parametrize(("step", "has_void"), some([(5, True), (3, False), (4001, True)], 1))
def test_kept_heights_come_back(method, rings, step, has_void):
    """Of all kinds of samples: corners of root blocks, shared lines, lattices; voids too."""
    refiner, rng = registry.refiner_by_name(method), np.random.default_rng(step)
    parent = {}
    valid = rng.random((GRID.n_rows, GRID.n_cols)) < (0.9 if has_void else 2)
    for key in [*KEYS[:2], KEYS[3]]:
        spec = spec_of(key, rings, step)
        above = None if key.is_root_key else parent[key]
        rows, cols = np.indices(spec.region.shape)
        target = 3000 * np.sin((rows + spec.region.row) / 17) * np.cos(cols / 11)
        target = (target + rng.normal(0, 9, target.shape)).astype(np.int32)
        shift, stride = GRID.k_max - spec.level, GRID.stride(spec.level)
        at = spec.region.slices_in(Region(0, 0, *GRID.level_shape(spec.level)))
        mask, own = level_mask(valid, shift)[at], valid[::stride, ::stride][at]
        apart = rng.integers(-40 - step, 40 + step, target.shape, np.int32, endpoint=True)
        kept = np.where(rng.random(target.shape) < 0.3, target + apart, FREE)
        payload, coded = encode_unit(refiner, spec, above, target, mask, own=own, kept=kept)
        found = decode_unit(refiner, spec, above, payload)
        np.testing.assert_array_equal(found.heights, coded.heights)
        must_stay = (kept != FREE) & ~is_inherited(spec)
        np.testing.assert_array_equal(found.heights[must_stay], kept[must_stay])
        error = np.abs(found.heights.astype(np.int64) - target)
        is_free = mask & (kept == FREE) & ~is_inherited(spec)
        assert error[is_free].max() <= spec.half
        for block in GRID.key_blocks(key):
            parent[block] = block_of_unit(GRID, spec, found, block)


@pytest.mark.large
@pytest.mark.parametrize("method", ["rapid", "predictive"])
def test_where_nothing_is_kept_the_payload_is_that_without_corrections(method):
    refiner, spec = registry.refiner_by_name(method), spec_of(Block(-1, 0, 0))
    rng = np.random.default_rng(0)
    target = rng.integers(-99, 99, spec.region.shape, np.int32)
    mask = np.ones(target.shape, bool)
    payload, coded = encode_unit(refiner, spec, None, target, mask)
    free = np.full(target.shape, FREE)
    assert encode_unit(refiner, spec, None, target, mask, kept=free)[0] == payload
    # Nor where what is kept comes by itself.
    assert encode_unit(refiner, spec, None, target, mask, kept=coded.heights)[0] == payload


@pytest.mark.parametrize("key", KEYS)
@given(st.binary(min_size=1, max_size=60))
def test_any_bytes_are_corrections_or_corrupt(key, data):
    spec = spec_of(key)
    try:
        added = decode_corrections(data, spec).added
    except CorruptStreamError:
        return
    assert encode_corrections(added, spec)
    assert not added[is_inherited(spec)].any()


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("rings", [1, 3])
def test_shared_samples_are_those_of_corners_and_lines(key, rings):
    spec = spec_of(key, rings)
    expected = np.zeros(spec.region.shape, bool)
    plan = plan_border(spec)
    for place in plan.corners:
        expected[place] = True
    for line in plan.lines:
        at = slice(line.start + line.first, line.start + line.stop)
        expected[(at, line.place) if line.is_column else (line.place, at)] = True
    np.testing.assert_array_equal(shared_samples(spec), expected)
