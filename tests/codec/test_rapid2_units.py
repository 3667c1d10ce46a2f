"""Units of the next default codec: what is decoded is what was encoded, within the bound."""

import numpy as np
import pytest

from terrainwave.codec.rapid.layout import CORES, HH, HL, LH, TAPS
from terrainwave.codec.rapid.symbols import (
    N_SLOTS,
    N_SYMBOLS,
    N_TABLES,
    PAIR_ESCAPE,
    SINGLE_ESCAPE,
    SINGLES,
    frequencies_of,
)
from terrainwave.codec.rapid.tables import Tables
from terrainwave.codec.rapid.unit import UnitCoder
from terrainwave.codec.refiner import NOT_SHARED, GroupSpec, Sides
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Region

pytestmark = pytest.mark.kernels
CUT = 28

ALL_SHARED = Sides(top=True, left=True, bottom=True, right=True)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def stencils():
    """Return cubic stencils for HH, and the mean of the core for the others."""
    cubic, found = {-1: -1, 0: 9, 1: 9, 2: -1}, np.zeros((4, 3, 24), dtype=np.int64)
    for number, (_, row, col) in enumerate(TAPS[HH]):
        found[:, HH - 1, number] = cubic[row] * cubic[col] * 16
    for plane in (HL, LH):
        for number, tap in enumerate(TAPS[plane]):
            found[:, plane - 1, number] = 1024 if tap in CORES[plane] else 0
    return found


def frequencies(counts):
    """Return frequencies in proportion; samples and escapes have one slot at least."""
    freqs = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64)
    for table, own in enumerate(counts):
        n = PAIR_ESCAPE + 1 if table < SINGLES else SINGLE_ESCAPE + 1
        own = own[:n] if own.any() else np.ones(n, dtype=np.int64)
        least = np.where(np.arange(n) == PAIR_ESCAPE, 1, own > 0) if table < SINGLES else 1
        made = np.maximum(own * (N_SLOTS // 2) // own.sum(), least)
        made[made.argmax()] += N_SLOTS - made.sum()
        freqs[table, :n] = made
    return frequencies_of(CUT, freqs)


def coder(counts=None):
    weights = np.full((4, 3, 4), 6000, dtype=np.int64)
    counts = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64) if counts is None else counts
    return UnitCoder(Tables(1, stencils(), weights, frequencies(counts)))


def check(heights, step, mask=None, shared=NOT_SHARED, parent=None):
    """Code a unit with the tables that its symbols ask for; return the payload."""
    low, high = int(heights.min()), int(heights.max())
    spec = GroupSpec.alone(
        Region(0, 0, *heights.shape),
        step,
        low,
        high,
        parent_region=None if parent is None else Region(0, 0, *parent.shape),
        shared=shared,
    )
    counts = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64)
    coder().count(spec, parent, heights, mask, counts)
    own = coder(counts)
    payload, coded, _ = own.encode(spec, parent, heights, mask)
    decoded, _ = own.decode(spec, parent, mask, payload)
    np.testing.assert_array_equal(decoded, coded)
    is_coded = np.ones(heights.shape, bool) if mask is None else mask.copy()
    if parent is not None:
        is_coded[::2, ::2] = False
        np.testing.assert_array_equal(coded[::2, ::2], parent)
    errors = np.abs(coded.astype(np.int64) - heights)[is_coded]
    assert errors.max(initial=0) <= step // 2
    return payload


def hills(rng, shape, scale=0.05):
    relief = np.cumsum(np.cumsum(rng.normal(size=shape), 0), 1) * scale
    return np.round(relief).astype(np.int32)


@pytest.mark.parametrize("step", [1, 3, 21])
@pytest.mark.parametrize(
    "shape", [(1, 1), (1, 9), (2, 2), (5, 5), (2, 34), (33, 34), (70, 1), (3, 70), (64, 65)]
)
def test_roots_decode_to_what_was_encoded(rng, shape, step):
    check(hills(rng, shape, 3.0), step)


@pytest.mark.parametrize("shape", [(65, 65), (64, 65), (65, 64)])
def test_groups_with_shared_lines_and_voids(rng, shape):
    shared = Sides(top=True, left=True, bottom=shape[0] % 2 == 1, right=shape[1] % 2 == 1)
    heights = hills(rng, shape)
    parent, mask = heights[::2, ::2].copy(), rng.random(shape) < 0.9
    check(heights, 3, None, shared, parent)
    check(heights, 3, mask, shared, parent)
    check(heights * 1000, 301, mask, shared, parent * 1000)


def test_neighbours_have_the_same_heights_on_the_line_that_they_share(rng):
    """Whatever lies beside the line, in voids too."""
    heights = hills(rng, (65, 129), 3.0)
    mask = rng.random(heights.shape) < 0.8
    lines = []
    for cols, shared in (
        (np.s_[:65], Sides(top=False, left=False, bottom=False, right=True)),
        (np.s_[64:], Sides(top=False, left=True, bottom=False, right=False)),
    ):
        part = np.ascontiguousarray(heights[:, cols])
        parent = np.ascontiguousarray(part[::2, ::2])
        spec = GroupSpec.alone(
            Region(0, 0, 65, 65), 5, int(heights.min()), int(heights.max()),
            parent_region=Region(0, 0, 33, 33), shared=shared,
        )  # fmt: skip
        own = np.ascontiguousarray(mask[:, cols])
        coded = coder().encode(spec, parent, part, own)[1]
        lines.append(coded[:, -1 if shared.right else 0])
    np.testing.assert_array_equal(*lines)


@pytest.mark.parametrize("scale", [1, 1000, 1 << 22])
def test_any_relief_takes_the_same_path(rng, scale):
    """Heights far beyond 16 bits are exact all the same."""
    heights = rng.integers(-64, 64, (65, 65)).astype(np.int32) * scale
    check(heights, 1)
    check(heights, 1, None, ALL_SHARED, heights[::2, ::2].copy())


@pytest.mark.large
def test_long_payloads_have_bands(rng):
    heights = rng.integers(-3000, 3000, (257, 257)).astype(np.int32)
    payload = check(heights, 3, None, ALL_SHARED, heights[::2, ::2].copy())
    assert payload[0] >> 3 & 3 == 3


@pytest.mark.parametrize("trial", range(20))
def test_damaged_payloads_are_refused_or_decode_to_something(trial):
    rng = np.random.default_rng(trial)
    heights = hills(rng, (33, 33), 3.0)
    parent = heights[::2, ::2].copy()
    spec = GroupSpec.alone(
        Region(0, 0, 33, 33), 3, int(heights.min()), int(heights.max()),
        parent_region=Region(0, 0, 17, 17),
    )  # fmt: skip
    own = coder()
    payload = bytearray(own.encode(spec, parent, heights, None)[0])
    if trial % 2:
        payload = payload[: rng.integers(len(payload))]
    else:
        payload[rng.integers(len(payload))] ^= 1 << rng.integers(8)
    try:
        decoded, _ = own.decode(spec, parent, None, bytes(payload))
    except CorruptStreamError:
        return
    assert decoded.min() >= spec.z_min
    assert decoded.max() <= spec.z_max
