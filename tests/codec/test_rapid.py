"""Units of `rapid`: ranges, lines, bands, rows, damage; what it shares is in `test_refiners`."""

import contextlib
import dataclasses

import numpy as np
import pytest
from lone_units import ALL_SHARED, check_refiner, coarse_of, lone_spec, terrain

from terrainwave.codec.rapid import unit as rapid_unit
from terrainwave.codec.rapid.layout import CORES, HH, HL, LH, LIMIT, TAPS
from terrainwave.codec.rapid.needed import needed_for
from terrainwave.codec.rapid.prediction import predict_on_line
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
from terrainwave.codec.rapid.unit import UnitCoder, _Memory
from terrainwave.codec.refiner import FREE, NOT_SHARED, Corrections, Raw, Rows, Sides
from terrainwave.errors import CorruptStreamError

# Compiling its kernels takes half a minute: `make test-all`.
pytestmark = pytest.mark.full

NARROW, HAS_ORIGIN = 1, 32
CUT = 28


def stencils():
    """Return cubic stencils for HH, and the mean of the core for the others."""
    cubic, found = {-1: -1, 0: 9, 1: 9, 2: -1}, np.zeros((4, 3, 24), dtype=np.int64)
    for number, (_, row, col) in enumerate(TAPS[HH]):
        found[:, HH - 1, number] = cubic[row] * cubic[col] * 16
    for plane in (HL, LH):
        for number, tap in enumerate(TAPS[plane]):
            found[:, plane - 1, number] = 1024 if tap in CORES[plane] else 0
    return found


def frequencies(counts, cut=CUT):
    """Return frequencies in proportion; samples and escapes have one slot at least."""
    freqs = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64)
    for table, own in enumerate(counts):
        n = PAIR_ESCAPE + 1 if table < SINGLES else SINGLE_ESCAPE + 1
        own = own[:n] if own.any() else np.ones(n, dtype=np.int64)
        least = np.where(np.arange(n) == PAIR_ESCAPE, 1, own > 0) if table < SINGLES else 1
        made = np.maximum(own * (N_SLOTS // 2) // own.sum(), least)
        made[made.argmax()] += N_SLOTS - made.sum()
        freqs[table, :n] = made
    return frequencies_of(cut, freqs)


def coder(counts=None, cut=CUT):
    """Return a coder with tables that a few counts make; without, all symbols are alike."""
    counts = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64) if counts is None else counts
    weights = np.full((4, 3, 4), 6000, dtype=np.int64)
    return UnitCoder(Tables(1, stencils(), weights, frequencies(counts, cut)))


def unit(heights, step, shared=NOT_SHARED, has_parent=True, **options):
    """Return the spec of a unit with a range of heights that fits, and its parent."""
    half = step >> 1
    spec = dataclasses.replace(
        lone_spec(heights.shape, step, 1, shared, has_parent),
        z_min=int(heights.min()) - half, z_max=int(heights.max()) + half, **options,
    )  # fmt: skip
    return spec, coarse_of(heights, step) if has_parent else None


def check(heights, step, shared=NOT_SHARED, has_parent=True, mask=None, cut=CUT):
    """Check everything promised, with tables as the unit's symbols ask; return the payload."""
    spec, parent = unit(heights, step, shared, has_parent)
    counts = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64)
    coder(cut=cut).count(spec, parent, heights, mask, counts)
    return check_refiner(coder(counts, cut), spec, parent, heights, mask)[0]


@pytest.mark.parametrize("step", [1, 3, 21])
@pytest.mark.parametrize("shape", [(64, 65), (65, 34), (70, 1), (3, 70)])
@pytest.mark.parametrize("cut", [0, 20, CUT, 60])
def test_any_class_may_have_pairs_or_none(shape, step, cut):
    for shared in (NOT_SHARED, Sides(True, True, False, False)):
        check(terrain(shape), step, shared, cut=cut)
    check(terrain(shape), step, has_parent=False, cut=cut)


def test_voids_cost_nothing_and_neighbours_of_them_keep_the_bound():
    heights, mask = terrain((65, 66)), np.random.default_rng(1).random((65, 66)) < 0.1
    voids_alone = len(check(heights, 3, mask=np.zeros_like(mask)))
    assert voids_alone < 20
    assert voids_alone < len(check(heights, 3, mask=mask)) < len(check(heights, 3)) / 2


def test_an_odd_end_of_a_row_holds_nothing_of_what_was_coded_before():
    """Memory is used again: bytes follow from the unit alone."""
    heights = terrain((31, 33))
    spec, parent = unit(heights, 3)
    first = coder().encode(spec, parent, heights, None)[0]
    noise = np.random.default_rng(1).integers(-9000, 9000, (33, 31)).astype(np.int32)
    check(noise, 1)
    assert coder().encode(spec, parent, heights, None)[0] == first


class Spoiled:
    """Memory that another thread writes to as soon as it is given back."""

    @contextlib.contextmanager
    def lent(self):
        memory = _Memory()
        yield memory
        log, raw, places = memory._streams.log, memory._streams.raw, memory._streams.places
        for array in (*log, raw, places, *memory._workspace[1:]):
            array[:] = 77


@pytest.mark.parametrize("has_parent", [True, False])
def test_nothing_is_read_of_memory_that_was_given_back(has_parent, monkeypatch):
    heights = terrain((61, 66))
    spec, parent = unit(heights, 1, has_parent=has_parent)
    found = []
    for _ in range(2):
        counts = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64)
        coded = coder().count(spec, parent, heights, None, counts)
        payload, made, _ = coder().encode(spec, parent, heights, None)
        decoded = coder().decode(spec, parent, None, payload)[0]
        found.append((counts.tolist(), payload, *(own.tolist() for own in (coded, made, decoded))))
        monkeypatch.setattr(rapid_unit, "_MEMORY", Spoiled())
    assert found[0] == found[1]


@pytest.mark.parametrize("step", [LIMIT - 2, LIMIT, LIMIT + 2, (1 << 31) - 1])
def test_steps_up_to_the_largest(step):
    heights = np.random.default_rng(0).integers(-(1 << 28), 1 << 28, (33, 33)).astype(np.int32)
    check(heights, step, ALL_SHARED)
    check(heights // (1 << 16), step, ALL_SHARED)


def test_heights_far_from_the_middle_of_the_range_have_an_origin():
    heights = terrain((33, 33)) + 1_000_000
    spec, parent = unit(heights, 3)
    spec = dataclasses.replace(spec, z_min=-(1 << 29) + 1, z_max=(1 << 29) - 1)
    payload, *_ = check_refiner(coder(), spec, parent, heights)
    assert payload[0] & (NARROW | HAS_ORIGIN) == NARROW | HAS_ORIGIN


def test_narrow_units_of_the_largest_heights_and_sums_of_predictions():
    """Weights of 2**18 in all, heights 8191 from the origin: sums that just fit 32 bits."""
    heights = np.where(np.indices((33, 33)).sum(0) & 1, LIMIT - 1, 1 - LIMIT).astype(np.int32)
    steep = np.zeros((4, 3, 24), dtype=np.int64)
    steep[..., ::2], steep[..., 1::2] = 10000, -10000
    steep[:, 0, 16:] = 0
    steep[..., 0] += 4096
    own = coder()._tables._replace(stencils=steep)
    spec, parent = unit(heights, 1, ALL_SHARED)
    check_refiner(UnitCoder(own), spec, parent, heights)


@pytest.mark.parametrize("plane", [HH, HL, LH])
def test_predictions_stay_between_the_nearest_known_samples(plane):
    """A step too large for any detail; all weight on the first tap, which lies further away."""
    heights = np.random.default_rng(5).integers(-1000, 1000, (17, 19)).astype(np.int32)
    far = stencils()
    far[:, plane - 1], far[:, plane - 1, 0] = 0, 4096
    spec, parent = unit(heights, 5001)
    own = UnitCoder(coder()._tables._replace(stencils=far))
    found, _ = own.decode(spec, parent, None, own.encode(spec, parent, heights, None)[0])
    planes = {
        0: found[::2, ::2], HH: found[1::2, 1::2], HL: found[::2, 1::2], LH: found[1::2, ::2],
    }  # fmt: skip
    i, j = 3, 4
    of_core = [planes[at][i + row, j + col] for at, row, col in CORES[plane]]
    at, row, col = TAPS[plane][0]
    wanted = np.clip(planes[at][i + row, j + col], min(of_core), max(of_core))
    assert planes[plane][i, j] == wanted


@pytest.mark.parametrize("scale", [1, 100_000])
def test_neighbours_have_the_same_heights_on_the_line_that_they_share(scale):
    """Whatever lies beside the line, in voids too; and however far heights are apart there."""
    heights = terrain((65, 129))
    heights[:, :60] *= scale
    mask = np.random.default_rng(2).random(heights.shape) < 0.8
    parent, lines = coarse_of(heights, 5), []
    for cols, side in ((np.s_[:65], "right"), (np.s_[64:], "left")):
        shared = NOT_SHARED._replace(**{side: True})
        spec, _ = unit(heights[:, cols], 5, shared)
        spec = dataclasses.replace(spec, z_min=int(heights.min()), z_max=int(heights.max()))
        above = parent[:, :33] if side == "right" else parent[:, 32:]
        coded = coder().encode(spec, above, heights[:, cols], mask[:, cols])[1]
        lines.append(coded[:, -1 if side == "right" else 0])
    np.testing.assert_array_equal(*lines)


def test_predictions_on_lines_are_cubic_and_between_the_nearest_four():
    heights = np.array([0, 8, 27, 64, 1 << 29, -(1 << 29)], dtype=np.int32)
    assert predict_on_line(heights, (0, 1, 6, 1), 1)[0] == round((9 * (8 + 27) - 0 - 64) / 16)
    assert predict_on_line(heights, (0, 1, 6, 3), 1)[0] <= 1 << 29
    assert predict_on_line(heights, (2, 1, 1, 0), 1) == (27, False)


@pytest.mark.large
@pytest.mark.parametrize("shape", [(257, 255), (130, 513)])
@pytest.mark.parametrize("high", [2500, 5])
def test_rows_need_what_the_refiner_says_and_no_more(shape, high):
    """Rows of the parent that it does not name may hold anything."""
    heights = np.random.default_rng(0).integers(-high, high, shape).astype(np.int32)
    spec, parent = unit(heights, 1, ALL_SHARED)
    own = coder()
    payload, whole, _ = own.encode(spec, parent, heights, None)
    for first in range(0, shape[0], 13):
        rows = Rows(first, min(first + 1 + first % 40, shape[0]))
        above = own.rows_above(spec, payload, rows)
        known = np.full_like(parent, FREE)
        known[above.first : above.end] = parent[above.first : above.end]
        out = np.zeros(shape, dtype=np.int32)
        own.decode_into(spec, known, None, payload, out, rows=rows)
        part = slice(*rows)
        np.testing.assert_array_equal(out[part], whole[part])


@pytest.mark.parametrize("n_rows", [1, 2, 16, 17, 64, 513])
@pytest.mark.parametrize("n_bands", [1, 2, 3, 4])
def test_strips_of_bands_are_all_strips(n_rows, n_bands):
    needed = needed_for((n_rows, 9), Rows(0, n_rows), n_bands)
    strips = [strip for own in needed.strips for strip in range(*own)]
    assert strips == list(range(len(strips)))
    # Each row of HL is in one, and each of LH a row further down.
    assert len(strips) * 8 >= max((n_rows + 1) // 2, n_rows // 2 + 1) > (len(strips) - 1) * 8


@pytest.mark.parametrize("has_parent", [True, False])
@pytest.mark.parametrize("scale", [1, 10_000])
def test_heights_that_are_kept_come_back(has_parent, scale):
    heights = terrain((33, 34)) * scale
    spec, parent = unit(heights, 9, Sides(True, True, False, False), has_parent)
    kept = np.where(np.random.default_rng(4).random(heights.shape) < 0.5, heights - 3, FREE)
    kept = kept.astype(np.int32)
    if has_parent:
        kept[::2, ::2] = FREE
    given = Corrections(kept, np.zeros_like(kept))
    target = np.where(kept == FREE, heights, kept)
    payload, coded, _ = coder().encode(spec, parent, target, None, given)
    assert (coded[kept != FREE] == kept[kept != FREE]).all()
    read = Corrections(np.zeros((0, 0), dtype=np.int32), given.added)
    decoded, _ = coder().decode(spec, parent, None, payload, read)
    np.testing.assert_array_equal(decoded, coded)


def small_unit(has_parent=True):
    heights = terrain((21, 18))
    spec, parent = unit(heights, 5, Sides(True, False, False, True), has_parent)
    return spec, parent, coder().encode(spec, parent, heights, None)[0]


def test_inherited_heights_beyond_the_range_are_clamped():
    """A damaged parent may have them."""
    spec, parent, payload = small_unit()
    high = np.full_like(parent, 2**31 - 1)
    for above in (high, -high, np.where(np.indices(parent.shape).sum(0) & 1, high, -high)):
        try:
            heights, _ = coder().decode(spec, above.astype(np.int32), None, payload)
        except CorruptStreamError:
            continue
        assert heights.min() >= spec.z_min
        assert heights.max() <= spec.z_max


@pytest.mark.parametrize("dtype", [np.int16, np.int32])
@pytest.mark.parametrize("missing", [0, 1])
def test_raw_heights_go_to_a_readers_memory_once_all_is_known_to_be_good(dtype, missing):
    """In a part of a larger array, with or without the last row and column; nothing beside it."""
    spec, parent, payload = small_unit()
    heights, _ = coder().decode(spec, parent, None, payload)
    memory = np.full(30 * 40, 99, dtype=dtype)
    wanted = memory.reshape(30, 40)[3 : 24 - missing, 5 : 23 - missing]

    def decode(payload):
        return coder().decode_into(
            spec, parent, None, payload, np.empty_like(heights), raw=Raw(wanted, 7)
        )

    for place in range(len(payload)):
        broken = bytearray(payload)
        broken[place] ^= 1
        try:
            decode(bytes(broken))
        except CorruptStreamError:
            assert (memory == 99).all()
        memory[:] = 99
    assert decode(payload)
    np.testing.assert_array_equal(wanted, heights[: wanted.shape[0], : wanted.shape[1]] + 7)
    wanted[:] = 99
    assert (memory == 99).all()


@pytest.mark.parametrize("scale", [1 << 16, 1])
def test_raw_heights_stay_where_they_do_not_fit(scale):
    """Units that need 32 bits, and memory that is no part of a flat array, are left to a copy."""
    heights = np.random.default_rng(0).integers(-64, 64, (65, 65)).astype(np.int32) * scale
    spec, parent = unit(heights, 1)
    payload, coded, _ = coder().encode(spec, parent, heights, None)
    wanted, out = np.full((65, 130), 99, dtype=np.int32)[:, ::2], np.empty_like(heights)
    assert not coder().decode_into(spec, parent, None, payload, out, raw=Raw(wanted, 7))
    assert (wanted == 99).all()
    np.testing.assert_array_equal(out, coded)


@pytest.mark.parametrize("height", [100_000, 600_000, 3_000_000, 2**29])
def test_a_spike_comes_back_where_levels_are_rounded_down(height):
    """Predictions may lie below the lowest height, so details may be larger than the range."""
    heights = np.zeros((3, 3), dtype=np.int32)
    heights[1, 1] = height
    heights -= height // 2
    check(heights, 1)


def test_origins_lie_within_the_range_of_heights_whatever_is_kept():
    """Heights of voids may be kept that lie beyond all limits."""
    heights = np.zeros((9, 9), dtype=np.int32)
    heights[4] = 100
    spec, _ = unit(heights, 3, has_parent=False)
    mask = np.ones(heights.shape, dtype=bool)
    mask[2, 3] = False
    kept = np.full(heights.shape, FREE, dtype=np.int32)
    kept[2, 3] = 2**26 + 100
    corrections = Corrections(kept, np.zeros(heights.shape, dtype=np.int32))
    own = coder()
    payload, coded, _ = own.encode(spec, None, heights, mask, corrections)
    read = Corrections(np.zeros((0, 0), dtype=np.int32), corrections.added)
    decoded, _ = own.decode(spec, None, mask, payload, read)
    np.testing.assert_array_equal(decoded, coded)
