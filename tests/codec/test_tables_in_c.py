"""Does the native library code tables to the bytes of the kernel, and read any bytes alike?"""

from unittest.mock import patch

import numpy as np
import pytest

from terrainwave.codec.planes import FileStencil
from terrainwave.codec.rapid import fit_stencils, fit_weights, tables_in_c
from terrainwave.codec.rapid.file_tables import (
    EXISTS,
    MAX_CODE,
    N_FAMILIES,
    N_SETS,
    N_TAPS,
    PLANES,
    FileTables,
    annex,
    missing_tap,
    pack_file_tables,
    parse_file_tables,
    plain_tables,
)
from terrainwave.codec.rapid.layout import N_LEVEL_CLASSES
from terrainwave.codec.rapid.symbols import N_CLASSES, N_SYMBOLS
from terrainwave.coding import native_library
from terrainwave.errors import CorruptStreamError

pytestmark = [pytest.mark.native, pytest.mark.large]


def drawn_stencil(rng, plane):
    deltas = rng.integers(-300, 300, N_TAPS[plane])
    deltas[missing_tap(plane)] = 0
    base = int(rng.integers(N_SETS))
    if rng.random() < 0.5:
        return FileStencil(base)
    return FileStencil(base, int(rng.integers(6)), tuple(deltas.tolist()))


def drawn_tables(rng):
    family = int(rng.integers(N_FAMILIES))
    plain = plain_tables(int(rng.integers(20)), family)
    stencils = tuple(
        tuple(drawn_stencil(rng, plane) for plane in PLANES) for _ in range(N_LEVEL_CLASSES)
    )
    weights = np.clip(plain.weights + rng.integers(-9, 9, plain.weights.shape), 0, MAX_CODE)
    codes = {}
    for table in np.flatnonzero(EXISTS.any(1) & (rng.random(len(EXISTS)) < 0.3)).tolist():
        changes = rng.integers(-4, 4, N_SYMBOLS) * (rng.random(N_SYMBOLS) < 0.3)
        own = np.clip(annex().codes[family][table] + changes, 0, MAX_CODE)
        codes[table] = np.where(EXISTS[table], own, 0)
    cut = int(rng.integers(N_CLASSES + 1))
    return FileTables(plain.k_max, family, stencils, weights, cut, codes)


def parsed(section):
    """Return what a section says, or why it is refused."""
    try:
        found = parse_file_tables(section, 3)
    except CorruptStreamError as error:
        return str(error)
    codes = {table: own.tolist() for table, own in found.codes.items()}
    return found._replace(weights=found.weights.tolist(), codes=codes)


@pytest.mark.parametrize("seed", range(4))
def test_bytes_are_the_same_and_so_is_what_any_bytes_say(seed, with_library):
    rng = np.random.default_rng(seed)
    for _ in range(5):
        tables = drawn_tables(rng)
        section = pack_file_tables(tables)
        damaged = [bytearray(section) for _ in range(4)]
        for number, data in enumerate(damaged):
            data[rng.integers(1, len(data))] ^= 1 << rng.integers(8)
            if number > 1:
                del data[rng.integers(2, len(data)) :]
        said = [parsed(bytes(data)) for data in (section, *damaged)]
        with patch.object(native_library, "is_used", lambda: False):
            assert pack_file_tables(tables) == section
            assert [parsed(bytes(data)) for data in (section, *damaged)] == said


@pytest.fixture
def rng():
    return np.random.default_rng(54)


def in_c(function):
    """Return what stands for a function where the library does its work."""
    return getattr(tables_in_c, function.__name__)


def both(function, *arguments):
    """Return what the library and NumPy make of the same arguments, which they may change."""
    own = [tuple(np.copy(a) if isinstance(a, np.ndarray) else a for a in arguments) for _ in "12"]
    return in_c(function)(*own[0]), function.__wrapped__(*own[1])


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("step", [1, 3, 7001])
@pytest.mark.parametrize("has_void", [False, True])
def test_samples_are_gathered_alike(monkeypatch, rng, plane, step, has_void):
    high = int(rng.choice([300, 2**31 - 1]))
    windows = rng.integers(-high, high, (2, 70, 90), dtype=np.int32)
    masks = np.ones(windows.shape, dtype=bool)
    if has_void:
        masks = rng.random(windows.shape) < 0.98
    ways = in_c(fit_stencils.gather_at), fit_stencils.gather_at.__wrapped__
    results = []
    for way in ways:
        monkeypatch.setattr(fit_stencils, "gather_at", way)
        results.append(fit_stencils.gather(plane, windows, masks, 0, step))
    found, expected = results
    assert found.every == expected.every
    np.testing.assert_array_equal(found.values, expected.values)


def drawn_samples(rng, n=512):
    values = np.rint(rng.normal(0, 10 ** rng.uniform(0, 4.5), (n, 25))).clip(-(2**17), 2**17)
    return np.ascontiguousarray(values)


@pytest.mark.parametrize("turn", range(4))
def test_errors_costs_and_products_are_alike(rng, turn):
    values, every = drawn_samples(rng, 128 << turn), 1 << turn
    weights = rng.integers(-4096, 4096, (5, int(rng.choice([16, 20, 24]))))
    parts = values[::every]
    for function, arguments in [
        (fit_stencils.errors_of, (weights,)),
        (fit_stencils.sums_of_bits, (weights, rng.random(5) * 4)),
        (fit_stencils.products_of, (rng.random(len(parts)),)),
    ]:
        expected = function.__wrapped__(np.ascontiguousarray(parts), *arguments)
        np.testing.assert_equal(in_c(function)(parts, *arguments), expected)
    zeros = np.zeros((128, 25))
    np.testing.assert_equal(*both(fit_stencils.products_of, zeros, np.ones(128)))


def test_sums_of_more_samples_than_are_exact_at_once_are_alike(rng):
    """Sums of 15360 products of 40 bits have up to 54 bits, which doubles do not hold."""
    values = (2.0**17 - rng.integers(0, 1000, (15360, 25))) * rng.choice([-1, 1], (15360, 1))
    roots = 1 - 0.01 * rng.random(len(values))
    np.testing.assert_equal(*both(fit_stencils.products_of, values, roots))


def test_systems_are_solved_alike_and_those_without_a_solution_too(rng):
    parts = rng.normal(size=(6, 200, 25))
    systems = np.rint(1000 * parts[:, :, :24].transpose(0, 2, 1) @ parts)
    systems[1, 5] = systems[1, :, 5] = 0
    systems[2] = 0
    found, expected = both(fit_stencils.solve, systems)
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(found[0]).all()
    assert not np.isfinite(found[2]).any()


@pytest.mark.parametrize("every", [1, 2, 5, 1000])
def test_rows_and_their_products_are_alike(rng, every):
    n = 5000
    features = rng.integers(0, 2**20, (3, n), dtype=np.int32)
    features[2, ::3] = 0
    details = rng.integers(-(2**18), 2**18, n, dtype=np.int32)
    details[0] = -(2**31)
    is_coded = rng.random(n) < 0.9
    rows, expected = both(fit_weights.rows_of, features, details, is_coded, every, 4.0 / 3)
    np.testing.assert_array_equal(rows, expected)
    for weights in ([0.5, 0.25, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0], [3.9, 3.9, 3.9, 3.9]):
        found = both(fit_weights.weighed_products, rows, np.array(weights))
        np.testing.assert_array_equal(*found)
