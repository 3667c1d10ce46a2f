"""The `rapid` refiner: ranges, damage, its tables; what it shares is in `test_refiners`."""

import dataclasses
import itertools
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lone_units import (
    ALL_SHARED,
    check_refiner,
    coarse_of,
    lone_spec,
    terrain,
)

from terrainwave.codec.rapid import coder as rapid_coder
from terrainwave.codec.rapid import fit as rapid_fitting
from terrainwave.codec.rapid import fit_weights as rapid_weights
from terrainwave.codec.rapid import trained as rapid_tables
from terrainwave.codec.rapid.file_tables import (
    MAX_CODE,
    N_CLASSES,
    N_FAMILIES,
    PLANES,
    FileStencil,
    FileTables,
    Tables,
    are_sound,
    code_of,
    default_codes,
    default_freqs,
    freq_of,
    freqs_of,
    pack_file_tables,
    parse_file_tables,
    rest_symbols,
)
from terrainwave.codec.rapid.fit import codes_for
from terrainwave.codec.rapid.fit_stencils import FitSamples, _normal, _solved, fit_weights, gather
from terrainwave.codec.rapid.fit_weights import samples as rapid_samples
from terrainwave.codec.rapid.layout import (
    CORES,
    F_BEND,
    F_CONST,
    F_RANGE,
    F_TWIST,
    FEATURE_TAPS,
    MAX_TAPS,
    N_FEATURES,
    TAPS,
)
from terrainwave.codec.rapid.magnitude import MOST_ERROR, N_CONTEXTS, scale_of, scaled_features
from terrainwave.codec.rapid.refiner import RapidRefiner
from terrainwave.codec.rapid.symbols import ESCAPE, N_SYMBOLS
from terrainwave.codec.refiner import Sides
from terrainwave.errors import CorruptStreamError, UnsupportedVersionError
from terrainwave.grid.quadtree import Grid

# Compiling its kernels takes a minute: `make test-all`.
pytestmark = pytest.mark.full

WIDE = 1


def check(spec, parent, target, mask=None, refiner=None):
    """Check everything promised; return the payload and the heights."""
    payload, heights, labels = check_refiner(refiner or RapidRefiner(), spec, parent, target, mask)
    assert labels is None
    return payload, heights


def refiner_of(family):
    """Return a refiner with nothing of the file's own but the family."""
    stencils = ((FileStencil(0),) * len(PLANES),) * N_CLASSES
    return RapidRefiner(pack_file_tables(FileTables(0, family, stencils, {})))


@pytest.mark.large
def test_units_with_many_rows_keep_the_bound():
    # More rows than the workspace holds of a plane, and more columns than a vector.
    target = terrain((301, 150))
    for step in (1, 7):
        check(lone_spec(target.shape, step, 1, ALL_SHARED), coarse_of(target, step), target)
        check(lone_spec(target.shape, step, parent=False), None, target)


# Ranges -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", [None, 7])
@pytest.mark.parametrize("largest", [300, 40_000, 400_000, 1 << 29])
def test_rows_of_32_bits_give_the_same_bytes_as_rows_of_64(family, largest, monkeypatch):
    rng = np.random.default_rng(largest)
    target = rng.integers(-150, 151, (40, 35)).astype(np.int32) + largest - 150
    spec = dataclasses.replace(lone_spec(target.shape, 3), z_min=-largest, z_max=largest)
    parent = coarse_of(target, 3).clip(-largest, largest)
    refiner = RapidRefiner() if family is None else refiner_of(family)
    payload, heights = check(spec, parent, target, refiner=refiner)
    assert not payload[0] & WIDE
    monkeypatch.setattr(RapidRefiner, "_is_wide", lambda *_: True)
    wide_payload, wide_heights = check(spec, parent, target, refiner=refiner)
    assert wide_payload[0] & WIDE
    assert payload[1:] == wide_payload[1:]
    np.testing.assert_array_equal(heights, wide_heights)


def test_heights_far_apart_get_64_bits():
    target = terrain((33, 33))
    target[5, 5] = 1 << 27
    payload, _ = check(lone_spec(target.shape, 1), coarse_of(target, 1), target)
    assert payload[0] & WIDE


def test_sums_of_narrow_units_fit_32_bits():
    widest = RapidRefiner()._widest
    assert rapid_coder._LIMIT32 // widest * widest + 32 < 1 << 31
    for table, step in itertools.product(rapid_tables.FEATURES, (1, 2, 3, 15, 16, 17, 1023, 65537)):
        scale = scale_of(step, -1000, 1000, False)
        most = [1, *[(1 << 18) - 1] * 3, *[scale.most_range] * 3, *[(1 << 18) - 1] * 2]
        times = np.array([1, 1, 2, 1, 1, 1, 4, 6, 4])
        for features in table.reshape(-1, 9):
            total = int((scaled_features(features, scale) * most * times).sum())
            assert total < 1 << 31
            assert 12 * (total >> 4) < 1 << 31  # as contexts compare it


# Damage -----------------------------------------------------------------------------------------


@cache
def small_payload():
    target = terrain((21, 18))
    spec = lone_spec(target.shape, 5, 1, Sides(True, False, False, True))
    parent, mask = coarse_of(target, 5), np.ones(target.shape, dtype=bool)
    payload, _, _ = RapidRefiner().encode(spec, parent, target, mask)
    return spec, parent, mask, payload


def test_unknown_flags_are_rejected():
    spec, parent, mask, payload = small_payload()
    with pytest.raises(CorruptStreamError, match="flags 0x4 are not defined"):
        RapidRefiner().decode(spec, parent, mask, b"\4" + payload[1:])


def test_symbols_that_end_in_another_state_are_rejected():
    spec, parent, mask, payload = small_payload()
    state = payload.index(payload[2:6])
    broken = bytearray(payload)
    broken[state] ^= 1
    with pytest.raises(CorruptStreamError):
        RapidRefiner().decode(spec, parent, mask, bytes(broken))


def test_filling_bits_must_be_zero():
    target = np.random.default_rng(5).integers(-9000, 9000, (9, 9)).astype(np.int32)
    spec, parent = lone_spec(target.shape, 1), coarse_of(target, 1)
    mask = np.ones(target.shape, dtype=bool)
    for noise in range(8):
        target[1, 1] += 1 + noise
        payload, _, _ = RapidRefiner().encode(spec, parent, target, mask)
        broken = bytearray(payload)
        broken[-1] |= 0x80
        if bytes(broken) == payload:
            continue
        try:
            heights, _ = RapidRefiner().decode(spec, parent, mask, bytes(broken))
        except CorruptStreamError as error:
            if "not filled with 0" in str(error):
                return
        else:
            assert not np.array_equal(heights, target)  # a real bit
    pytest.fail("no payload had bits to spare")


@pytest.mark.parametrize("shape", [(1, 6), (5, 1), (2, 3), (12, 9), (90, 7)])
def test_what_a_thread_decoded_before_leaves_no_trace(shape):
    target = np.random.default_rng(5).integers(-90, 90, shape).astype(np.int32)
    spec, parent = lone_spec(shape, 3, 1), coarse_of(target, 3)
    spec = dataclasses.replace(spec, z_min=-200, z_max=200)
    mask = np.ones(shape, dtype=bool)
    with rapid_coder._MEMORY.lent() as lent:
        memory = lent.workspace(False).m
    results = []
    for filling in (0, 1 << 20, -7):
        memory.fill(filling)
        payload, _, _ = RapidRefiner().encode(spec, parent, target, mask)
        memory.fill(-filling)
        heights, _ = RapidRefiner().decode(spec, parent, mask, payload)
        results.append((payload, heights.tobytes()))
    assert results[0] == results[1] == results[2]


# Tables -----------------------------------------------------------------------------------------


def test_stencils_keep_a_constant():
    for plane, sets in rapid_tables.STENCILS.items():
        assert sets.shape[1] == len(TAPS[plane])
        assert (sets.sum(1, dtype=np.int64) == 4096).all()
        assert 1 <= len(sets) <= 16


def test_no_tap_is_of_the_row_at_hand_and_all_are_decoded_before():
    for plane, taps in TAPS.items():
        assert set(CORES[plane]) <= set(taps)
        assert len(set(taps)) == len(taps)
        for other, row, _ in taps:
            assert other < plane or (other == plane and row < 0)
            # HH is one row ahead of HL, HL one of LH.
            assert other == 0 or row <= plane - other


def test_frequencies_have_codes_within_a_sixteenth():
    assert [code_of(freq) for freq in range(33)] == list(range(33))
    for freq in range(1, 2048):
        assert abs(freq_of(code_of(freq)) - freq) <= freq / 32
    assert code_of(2047) == MAX_CODE
    assert [code_of(freq_of(code)) for code in range(MAX_CODE + 1)] == list(range(MAX_CODE + 1))


@pytest.mark.parametrize("family", range(N_FAMILIES))
def test_trained_frequencies_fill_all_slots(family):
    freqs = default_freqs(family)
    assert freqs.shape == (N_CONTEXTS, N_SYMBOLS)
    assert (freqs.sum(1) == 2048).all()
    assert (freqs[:, ESCAPE] > 0).all()
    assert freqs.min() >= 0
    assert freqs.max() < 2048


def some_weights(n_classes):
    """Return codes of weights of the finest classes, none of which is too large."""
    codes = np.random.default_rng(n_classes).integers(0, 50, (n_classes, 3, N_FEATURES))
    codes[:, 0, 7:] = 0  # HH has no earlier planes
    assert are_sound(codes)
    return codes


def some_tables(family=4, n_weighted=0):
    """Return tables with everything that can be stored."""
    rng = np.random.default_rng(8)
    rows = []
    for which in range(N_CLASSES):
        row = []
        for plane in PLANES:
            deltas = rng.integers(-200, 200, len(TAPS[plane]))
            deltas[TAPS[plane].index(CORES[plane][0])] = 0
            is_fitted = (which + plane) % 2
            row.append(
                FileStencil(which, 1, tuple(deltas.tolist())) if is_fitted else FileStencil(plane)
            )
        rows.append(tuple(row))
    fitted = codes_for(rng.integers(0, 999, (N_CONTEXTS, N_SYMBOLS)) + 1, family)
    codes = {context: fitted[context] for context in (0, 3, 4, 99, 175)}
    weights = some_weights(n_weighted) if n_weighted else None
    return FileTables(9, family, tuple(rows), codes, weights)


@pytest.mark.parametrize("n_weighted", [0, 1, 2, 4])
@pytest.mark.parametrize("family", [4, 10])
def test_parameters_come_back(family, n_weighted):
    tables = some_tables(family, n_weighted)
    section = pack_file_tables(tables)
    assert section[0] == (5 if n_weighted else 1 if family == 4 else 3)
    own = Tables(tables).features != Tables(some_tables(family)).features
    assert own[:n_weighted, :3].any((1, 2)).all()
    assert not own[n_weighted:].any()
    assert not own[:, 3].any()
    read, wanted = parse_file_tables(section), Tables(tables)
    np.testing.assert_array_equal(read.stencils, wanted.stencils)
    np.testing.assert_array_equal(read.features, wanted.features)
    np.testing.assert_array_equal(read.slots(3), wanted.slots(3))
    assert read.k_max == 9
    assert read.is_by_reach == wanted.is_by_reach == (family == 10)


@pytest.mark.large
@pytest.mark.parametrize("n_weighted", [0, 2])
def test_every_prefix_of_parameters_is_rejected(n_weighted):
    section = pack_file_tables(some_tables(n_weighted=n_weighted))
    accepted = []
    for length in range(1, len(section)):
        try:
            accepted.append(parse_file_tables(section[:length])._file)
        except CorruptStreamError:
            continue
    # Zeros after stencils and some weights are whole tables, as all else is as usual then. Only the
    # checksum of the section tells.
    assert len(accepted) <= bool(n_weighted)
    assert not any(tables.codes for tables in accepted)
    with pytest.raises(CorruptStreamError):
        parse_file_tables(section + b"\0")


@pytest.mark.parametrize("layout", [0, 2, 4])
def test_an_unknown_layout_is_unsupported(layout):
    with pytest.raises(UnsupportedVersionError, match=f"layout {layout}"):
        parse_file_tables(bytes([layout]) + b"abc")


@given(st.sampled_from([b"\1", b"\3", b"\5"]), st.binary(max_size=200))
def test_any_parameters_give_tables_or_our_own_error(layout, section):
    try:
        tables = parse_file_tables(layout + section)
    except CorruptStreamError:
        return
    assert (np.abs(tables.stencils) < 1 << 15).all()
    assert all(
        0 <= total < 1 << 31 for step in (1, 3, 7, 101, 65537) for total in most(tables, step)
    )
    slots = tables.slots(1)
    assert slots.shape == (N_CONTEXTS << 11,)
    symbols, freqs, places = slots & 63, slots >> 6 & 4095, slots >> 18
    assert symbols.max() < N_SYMBOLS
    assert (places < freqs).all()


def most(tables, step):
    """Yield the largest sums of weights times features that any heights make (R.7)."""
    scale = scale_of(step, 0, 0, False)
    for features in tables.features[:, :3]:
        for plane, weights in zip(PLANES, features, strict=True):
            limits = np.zeros(N_FEATURES, dtype=np.int64)
            limits[[F_CONST, F_RANGE, F_TWIST]] = 1, scale.most_range, scale.most_range
            for feature, taps in FEATURE_TAPS[plane].items():
                limits[feature] = len(taps) * (
                    scale.most_range if feature == F_BEND else MOST_ERROR
                )
            yield int((scaled_features(weights, scale) * limits).sum())


@pytest.mark.parametrize("feature", range(N_FEATURES))
def test_weights_are_rejected_just_where_a_sum_may_pass_31_bits(feature):
    for plane in range(3):
        codes = np.zeros((1, 3, N_FEATURES), dtype=np.int64)
        sound = []
        for code in range(MAX_CODE + 1):
            codes[0, plane, feature] = code
            sound.append(are_sound(codes))
            tables = FileTables(0, 2, ((FileStencil(0),) * 3,) * 4, {}, codes)
            if sound[-1]:
                assert max(t for n in (1, 3, 101) for t in most(Tables(tables), n)) < 1 << 31
            if code == MAX_CODE and not sound[-1]:
                with pytest.raises(CorruptStreamError, match="out of range"):
                    parse_file_tables(pack_file_tables(tables))
        assert sound == sorted(sound, reverse=True)


@pytest.mark.parametrize("code", [-1, MAX_CODE + 1])
def test_a_code_of_a_weight_outside_its_range_is_rejected(code):
    weights = some_weights(2)
    weights[1, 1, 5] = code
    plain = ((FileStencil(0),) * 3,) * 4
    with pytest.raises(CorruptStreamError, match="out of range"):
        parse_file_tables(pack_file_tables(FileTables(0, 2, plain, {}, weights)))


def test_frequencies_that_leave_nothing_or_no_escape_are_rejected():
    codes, rest = default_codes(0)[50:51].copy(), rest_symbols(0)[50:51]
    codes[0, ESCAPE] = 0
    with pytest.raises(CorruptStreamError, match="do not fit"):
        freqs_of(codes, rest)
    codes[0, ESCAPE] = MAX_CODE
    with pytest.raises(CorruptStreamError, match="do not fit"):
        freqs_of(codes, rest)


def fit(target, step, mask=None):
    mask = np.ones(target.shape, dtype=bool) if mask is None else mask
    grid = Grid(*target.shape, 8)

    def part(array):
        def read(level, region):
            stride = 1 << (grid.k_max - level)
            rows, cols = (
                slice(r * stride, (r + n - 1) * stride + 1, stride)
                for r, n in ((region.row, region.n_rows), (region.col, region.n_cols))
            )
            return array[rows, cols]

        return read

    return RapidRefiner().fitted(grid, step, part(target), part(mask))


@pytest.mark.large
@pytest.mark.parametrize("step", [1, 3, 9])
def test_fitted_tables_make_smaller_payloads_and_are_worth_their_bytes(step):
    rows, cols = np.mgrid[:300, :260]
    target = (90 * np.sin(rows / 2.1) * np.cos(cols / 2.9) + terrain((300, 260))).astype(np.int32)
    refiner = fit(target, step)
    k_max = parse_file_tables(refiner.file_tables).k_max
    spec = dataclasses.replace(lone_spec(target.shape, step, parent=False), level=k_max)
    fitted, _ = check(spec, None, target, refiner=refiner)
    plain, _ = check(spec, None, target)
    assert len(fitted) + len(refiner.file_tables) < 0.97 * len(plain)


def houses(shape):
    """Return smooth heights with blocks on them."""
    target, rng = terrain(shape, relief=40), np.random.default_rng(6)
    for row, col, tall in rng.integers(0, (*shape, 60), (shape[0] * shape[1] // 90, 3)):
        target[row : row + 4, col : col + 5] += tall
    return target


@pytest.mark.parametrize("step", [1, 3, 9])
def test_contexts_are_by_reach_where_that_makes_payloads_smaller(step, monkeypatch):
    target = houses((90, 100))
    spec = lone_spec(target.shape, step, parent=False)
    monkeypatch.setattr(rapid_fitting, "_with_weights", lambda tables, *_: tables)
    refiner = fit(target, step)
    assert parse_file_tables(refiner.file_tables).is_by_reach
    own, _ = check(spec, None, target, refiner=refiner)
    monkeypatch.setattr(rapid_fitting, "_SAVED_BY_REACH", 1.0)
    refiner = fit(target, step)
    assert not parse_file_tables(refiner.file_tables).is_by_reach
    other, _ = check(spec, None, target, refiner=refiner)
    assert len(own) < 0.99 * len(other)


@pytest.mark.parametrize("step", [1, 3, 9])
def test_weights_of_the_file_make_payloads_smaller(step, monkeypatch):
    target = houses((230, 240))
    refiner = fit(target, step)
    assert refiner.file_tables[0] == 5
    spec = lone_spec(target.shape, step, parent=False)
    spec = dataclasses.replace(spec, level=parse_file_tables(refiner.file_tables).k_max)
    own, _ = check(spec, None, target, refiner=refiner)
    monkeypatch.setattr(rapid_fitting, "_with_weights", lambda tables, *_: tables)
    other = fit(target, step)
    assert other.file_tables[0] in (1, 3)
    plain, _ = check(spec, None, target, refiner=other)
    assert len(own) + len(refiner.file_tables) < len(plain) + len(other.file_tables)


def test_weights_are_what_non_negative_least_squares_finds():
    nnls = pytest.importorskip("scipy.optimize").nnls
    rng = np.random.default_rng(5)
    for _ in range(20):
        features = rng.exponential(1, (N_FEATURES, 512)).round(3)
        goal = rng.normal(0.2, 0.5, N_FEATURES) @ features
        rows = np.rint(np.vstack([features, goal]) * 1000)
        (found,) = rapid_weights._not_negative((rows @ rows.T)[None])
        np.testing.assert_allclose(found, nnls(rows[:-1].T, rows[-1])[0], atol=1e-3)


def test_weights_are_the_same_from_rows_in_parts():
    """Sums of whole numbers: exact in whatever order."""
    rng = np.random.default_rng(6)
    rows = rng.exponential(1, (N_FEATURES + 1, 4096))
    first = np.full(N_FEATURES, 0.1)
    again = rows[:, rng.permutation(4096)]
    (found, units), (other, other_units) = (
        rapid_weights._products(own, 1, first) for own in (rows, again)
    )
    np.testing.assert_array_equal(found, other)
    np.testing.assert_array_equal(units, other_units)


def test_weights_of_no_sample_are_none():
    assert rapid_weights._fitted([], np.zeros((0, N_FEATURES))).shape == (0, N_FEATURES)


@pytest.mark.parametrize("step", [1, 3, 5, 41])
@pytest.mark.parametrize("family", [0, 3, 6, 9])
@pytest.mark.parametrize("has_void", [False, True])
def test_samples_have_the_contexts_and_symbols_that_the_kernels_give_them(step, family, has_void):
    """Counted without coding: never more of a kind than were coded, and nearly as many in all."""
    window = terrain((127, 127)) + np.arange(127, dtype=np.int32)[:, None] ** 2 * 3
    mask = np.ones(window.shape, dtype=bool)
    if has_void:
        mask[20:50, 60:90] = False
    file = FileTables(7, rapid_tables.family_of(step) + family, ((FileStencil(1),) * 3,) * 4, {})
    both = window[None], mask[None]
    decoded = np.stack(
        rapid_fitting._coded(
            Tables(file), rapid_fitting._Sample(*both, step, 1.0, is_inner=True), map
        )[1]
    )
    seen = rapid_samples.look_at(decoded, mask[None], Tables(file), step)
    counted = rapid_samples.Counter(seen, step).counts(Tables(file))
    coded = rapid_fitting.count(file, *both, step, is_inner=True)
    assert (counted <= coded).all()
    assert counted.sum() > 0.75 * coded.sum()


def test_smooth_ground_keeps_contexts_by_the_mean():
    assert not parse_file_tables(fit(terrain((90, 100)), 3).file_tables).is_by_reach


def test_tiny_and_void_rasters_get_plain_tables():
    for target, mask in (
        (terrain((5, 5)), None),
        (terrain((40, 40)), np.zeros((40, 40), dtype=bool)),
    ):
        refiner = fit(target, 3, mask)
        assert len(refiner.file_tables) < 20
        tables = parse_file_tables(refiner.file_tables)
        np.testing.assert_array_equal(tables.slots(3), Tables(None).slots(3))


@pytest.mark.large
def test_windows_whose_tried_part_is_void_do_no_harm():
    target = terrain((300, 280))
    mask = np.zeros(target.shape, dtype=bool)
    mask[180:, 170:] = True
    tables = parse_file_tables(fit(target, 3, mask).file_tables)
    assert tables.slots(3).shape == (N_CONTEXTS << 11,)
    spec = lone_spec(target.shape, 3, parent=False)
    check(spec, None, target, mask, fit(target, 3, mask))


def test_the_same_raster_gives_the_same_tables():
    target = terrain((60, 70))
    assert fit(target, 3).file_tables == fit(target.copy(), 3).file_tables


def test_sums_of_fits_do_not_depend_on_their_order():
    windows = np.stack([terrain((120, 130), seed) for seed in range(2)])
    samples = gather(2, windows, np.ones(windows.shape, dtype=bool), 0, 3)
    order = np.random.default_rng(3).permutation(len(samples.values))
    shuffled = samples._replace(values=samples.values[order])
    weights = rapid_tables.STENCILS[2][0].astype(np.float64)
    weights = np.pad(weights, (0, MAX_TAPS - len(weights)))
    for start in (None, weights):
        own, other = (_normal(one, start, 1) for one in (samples, shuffled))
        np.testing.assert_array_equal(own[0], other[0])
        assert own[1] == other[1]


def test_a_fitted_stencil_finds_the_weights_that_made_the_heights():
    rng = np.random.default_rng(4)
    taps = rng.integers(-(1 << 14), 1 << 14, (1024, MAX_TAPS)).astype(np.float64)
    taps[:, len(TAPS[1]) :] = 0
    true = np.zeros(MAX_TAPS)
    true[[1, 5, 6, 9, 10, 17]] = [-512, 1500, 1400, 1300, 1200, -792]
    samples = FitSamples(np.column_stack([taps, np.rint(taps @ true / 4096)]), 1.0)
    (found,) = fit_weights({(0, 1): samples}, [0.0])
    np.testing.assert_allclose(found[0, 1], true, atol=2)


def test_equations_without_a_solution_are_no_warning():
    assert not np.isfinite(_solved(np.zeros((2, 3, 4)))).any()


def test_windows_without_a_valid_sample_are_not_coded():
    # Their fills may be too far from 0 for units of 32 bits, which valid heights alone ask for.
    heights = np.full((3, 257, 257), -17_000_000, dtype=np.int32)
    heights[0] = np.add.outer(np.arange(257), np.arange(257)) // 3
    masks = np.zeros(heights.shape, dtype=bool)
    masks[0] = True
    tables = FileTables(7, rapid_tables.family_of(3), ((FileStencil(1),) * 3,) * 4, {})
    alone = rapid_fitting.count(tables, heights[:1], masks[:1], 3)
    np.testing.assert_array_equal(rapid_fitting.count(tables, heights, masks, 3), alone)
