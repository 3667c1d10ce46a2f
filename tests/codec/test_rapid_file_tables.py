"""Tables that a file of rapid brings along: their bytes, damage, and what they are fitted to."""

import numpy as np
import pytest
from lone_units import rough

from terrainwave.codec.planes import FileStencil
from terrainwave.codec.rapid import file_tables as module
from terrainwave.codec.rapid import fit, fit_weights
from terrainwave.codec.rapid.file_tables import (
    EXISTS,
    NEAR,
    NUMBER_OF_CODE,
    PLANES,
    RESTS,
    annex,
    codes_of,
    freqs_of,
    missing_tap,
    pack_file_tables,
    parse_file_tables,
    plain_tables,
    tables_from,
    tables_of,
)
from terrainwave.codec.rapid.layout import HH, MAX_SUM, N_TAPS
from terrainwave.codec.rapid.symbols import (
    ESCAPED,
    N_CLASSES,
    N_SLOTS,
    N_SYMBOLS,
    N_TABLES,
    PAIR_ESCAPE,
    SINGLE_ESCAPE,
    SINGLES,
)
from terrainwave.codec.rapid.unit import UnitCoder
from terrainwave.codec.refiner import GroupSpec
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Grid, Region

pytestmark = pytest.mark.kernels


def stencil(plane, base=2, shift=3, seed=1):
    deltas = np.random.default_rng(seed).integers(-40, 40, N_TAPS[plane])
    deltas[missing_tap(plane)] = 0
    return FileStencil(base, shift, tuple(deltas.tolist()))


def some_tables():
    """Return tables of which nothing is trained."""
    plain, rng = plain_tables(5, 4), np.random.default_rng(3)
    stencils = tuple(
        tuple(stencil(plane, k, k, seed=k) if k % 2 else FileStencil(k) for plane in PLANES)
        for k in range(4)
    )
    weights = rng.integers(0, 200, plain.weights.shape)
    weights[:, HH - 1, NEAR] = 0
    codes = {}
    for table in (0, 7, 20, SINGLES, SINGLES + 30, ESCAPED):
        counts = rng.integers(0, 900, (1, N_SYMBOLS)) * EXISTS[table]
        codes[table] = fit.codes_for(counts, np.array([table]))[0]
    return plain._replace(stencils=stencils, weights=weights, cut=21, codes=codes)


def same(first, second):
    assert first[:3] == second[:3]
    np.testing.assert_array_equal(first.weights, second.weights)
    assert first.cut == second.cut
    assert list(first.codes) == list(second.codes)
    for table, own in first.codes.items():
        rest = np.arange(N_SYMBOLS) != RESTS[table]
        np.testing.assert_array_equal(own[rest], second.codes[table][rest])


def test_tables_survive():
    tables = some_tables()
    same(parse_file_tables(pack_file_tables(tables), 1), tables)


@pytest.mark.parametrize(("step", "family"), [(1, 0), (3, 1), (5, 2), (999, 2)])
def test_no_bytes_stand_for_the_trained_tables_of_the_step(step, family):
    same(parse_file_tables(b"", step), plain_tables(0, family))


@pytest.mark.parametrize("family", range(6))
def test_trained_tables_alone_are_one_byte(family):
    tables = plain_tables(31, family)
    section = pack_file_tables(tables)
    assert section == bytes([31 | family << 5])
    same(parse_file_tables(section, 1), tables)
    made = tables_of(section, 1)
    assert made.k_max == 31
    np.testing.assert_array_equal(made.weights, NUMBER_OF_CODE[annex().weights[family]])


def test_frequencies_fill_all_slots_and_leave_no_sample_without_one():
    for family in range(6):
        freqs = freqs_of(annex().codes[family])
        np.testing.assert_array_equal(freqs.sum(1), np.where(EXISTS.any(1), N_SLOTS, 0))
        samples = [*range(SINGLES, SINGLES + N_CLASSES), ESCAPED]
        assert freqs[samples, : SINGLE_ESCAPE + 1].min() == 1
        assert freqs[:N_CLASSES, PAIR_ESCAPE].min() >= 1


def test_codes_stand_for_the_numbers_that_the_format_says():
    assert NUMBER_OF_CODE[[0, 31, 32, 47, 48, 255]].tolist() == [0, 31, 33, 63, 66, 516096]
    numbers = np.arange(5000)
    nearest = np.abs(NUMBER_OF_CODE[:, None] - numbers).min(0)
    np.testing.assert_array_equal(np.abs(NUMBER_OF_CODE[codes_of(numbers)] - numbers), nearest)


def refused(tables, words):
    with pytest.raises(CorruptStreamError, match=words):
        tables_of(pack_file_tables(tables), 1)


@pytest.mark.large
def test_every_prefix_and_an_extra_byte_are_refused():
    section = pack_file_tables(some_tables())
    for length in range(2, len(section)):
        with pytest.raises(CorruptStreamError):
            tables_from(parse_file_tables(section[:length], 1))
    with pytest.raises(CorruptStreamError):
        parse_file_tables(section + b"\0", 1)


@pytest.mark.large
def test_damaged_bytes_give_tables_within_their_limits_or_our_own_error():
    rng, section = np.random.default_rng(11), pack_file_tables(some_tables())
    n_sound = 0
    for trial in range(3000):
        data = bytearray(section if trial % 2 else rng.bytes(int(rng.integers(2, 60))))
        for _ in range(int(rng.integers(1, 4))):
            data[rng.integers(len(data))] = rng.integers(256)
        data[0] %= 6 << 5
        try:
            made = tables_from(parse_file_tables(bytes(data), 1))
        except CorruptStreamError:
            continue
        n_sound += 1
        assert np.abs(made.stencils).max() < 1 << 15
        assert np.abs(made.stencils).sum(2).max() <= MAX_SUM
        assert (made.stencils.sum(2) == 4096).all()
        assert 0 <= made.weights.min() <= made.weights.max() < 1 << 31
        assert 0 <= made.frequencies.cut <= N_CLASSES
        assert (made.frequencies.freqs.sum(1) == N_SLOTS).all()
    assert n_sound  # not all of them are refused


def fitted(heights, step, valid=None, each=map):
    grid = Grid(*heights.shape, 256)
    valid = np.ones(heights.shape, dtype=bool) if valid is None else valid

    def part(array):
        def read(level, region):
            stride = grid.stride(level)
            whole = Region(0, 0, 1 << 30, 1 << 30)
            return np.ascontiguousarray(array[::stride, ::stride][region.slices_in(whole)])

        return read

    return fit.fit_tables(grid, step, part(heights), part(valid), each=each)


def size_of(tables, heights, step):
    low, high = int(heights.min()), int(heights.max())
    spec = GroupSpec.alone(Region(0, 0, *heights.shape), step, low, high)
    payload, coded, _ = UnitCoder(tables_from(tables)).encode(spec, None, heights, None)
    assert np.abs(coded.astype(np.int64) - heights).max() <= step // 2
    return len(payload) + len(pack_file_tables(tables))


@pytest.mark.large
@pytest.mark.parametrize("step", [1, 9])
def test_fitted_tables_make_a_strange_surface_smaller(step):
    heights = rough((401, 401))
    tables = fitted(heights, step)
    assert any(own.deltas for row in tables.stencils for own in row)
    assert tables.codes
    plain = plain_tables(tables.k_max, tables.family % 3)
    assert size_of(tables, heights, step) < 0.97 * size_of(plain, heights, step)


def test_rasters_of_voids_or_of_one_height_have_tables_that_are_sound():
    heights = np.full((300, 300), 7, dtype=np.int32)
    none = np.zeros(heights.shape, dtype=bool)
    assert len(pack_file_tables(fitted(heights, 1, none))) == 1
    size_of(fitted(heights, 1), heights, 1)


def test_tables_do_not_depend_on_heights_of_voids():
    heights, rng = rough((600, 500), seed=3), np.random.default_rng(5)
    valid = np.ones(heights.shape, dtype=bool)
    valid[100:480, 60:400] = valid[::7, ::5] = False
    found = []
    for _ in range(2):
        heights[~valid] = rng.integers(-30000, 30000, np.count_nonzero(~valid))
        found.append(pack_file_tables(fitted(heights, 1, valid)))
    assert found[0] == found[1]


def test_counts_by_class_are_those_of_the_kernels():
    heights = rough((321, 319), seed=2)
    valid = np.random.default_rng(1).random(heights.shape) < 0.9
    tables = plain_tables(0, 1)._replace(cut=25)
    sample = fit._Sample(heights[None], valid[None], 3, 1.0)
    seen = fit.observed(tables, sample)
    found = fit_weights.count_by_class(seen, tables_from(tables).weights, 3)
    kernels = fit.count(tables, sample)
    np.testing.assert_array_equal(fit.counts_of(found, 25), kernels)
    assert kernels[SINGLES:].any()
    assert kernels.shape == (N_TABLES, N_SYMBOLS)


def test_weights_are_fitted_to_samples_of_all_columns():
    """Planes of 128 columns, and one sample of so many that divide them: once all of column 0."""
    features = np.zeros((3, 128 * 1024), dtype=np.int32)
    features[2] = np.arange(features.shape[1]) % 128
    details = np.zeros(features.shape[1], dtype=np.int32)
    seen = fit_weights.Seen(0, HH, 0, features, details, np.ones(len(details), dtype=bool))
    columns = fit_weights._in_steps(seen, 16, 3)[3]
    assert len(columns) == len(details) // 16
    assert set(columns) == set(range(128))


def test_bytes_do_not_follow_from_what_was_coded_before():
    """Planes have odd numbers of columns here: the last sample of a row is a pair alone."""
    others, heights = rough((129, 129), seed=7) * 50, rough((129, 129))
    tables = tables_of(pack_file_tables(plain_tables(0, 1)), 3)
    found = []
    for before in (heights, others):
        for target in (before, heights):
            low, high = int(target.min()), int(target.max())
            spec = GroupSpec.alone(Region(0, 0, *target.shape), 3, low, high)
            payload, _, _ = UnitCoder(tables).encode(spec, None, target, None)
        found.append(payload)
    assert found[0] == found[1]


def test_weights_are_found_that_made_the_details():
    rng = np.random.default_rng(4)
    rows = np.ones((5, 6000))
    rows[1:4] = rng.gamma(1.0, 3.0, (3, 6000))
    truth = np.array([0.3, 0.2, 0.0, 0.6])
    rows[4] = np.rint(rng.exponential(truth @ rows[:4]))
    weights = fit_weights._fitted([rows], np.array([[1.0, 0.1, 0.1, 0.1]]))[0]
    np.testing.assert_allclose(weights, truth, atol=0.12)
    assert weights.min() >= 0
    assert module.N_FEATURES == len(weights)
