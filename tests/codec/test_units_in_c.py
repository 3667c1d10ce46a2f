"""Does the native library encode units of rapid to the bytes that numba's kernels make?"""

import ctypes

import numpy as np
import pytest
from lone_units_drawn import Drawn, drawn_unit

from terrainwave.codec import in_c
from terrainwave.codec.rapid import unit_in_c
from terrainwave.codec.rapid.details import count_seen
from terrainwave.codec.rapid.file_tables import N_FAMILIES, plain_tables, tables_from
from terrainwave.codec.rapid.fit import _for_counts
from terrainwave.codec.rapid.fit_weights import Observer
from terrainwave.codec.rapid.layout import WEIGHT_BITS
from terrainwave.codec.rapid.symbols import N_CLASSES, N_SYMBOLS, N_TABLES
from terrainwave.codec.rapid.tables import weights_of
from terrainwave.codec.rapid.unit import UnitCoder
from terrainwave.codec.refiner import GroupSpec
from terrainwave.coding import native_library
from terrainwave.grid.quadtree import Region

pytestmark = [pytest.mark.native, pytest.mark.full]
# Both, whatever `also_in_c` chooses.
BY_NUMBA = UnitCoder.encode.__wrapped__, UnitCoder.count.__wrapped__
K_MAX = 5


def coder_of(rng, kind=UnitCoder, tables=tables_from):
    """Return a coder with the tables of a family, or with stencils of the largest weights."""
    file = plain_tables(K_MAX, int(rng.integers(N_FAMILIES)))
    made = tables(file)
    if rng.random() < 0.2:
        stencils = np.zeros_like(made.stencils)
        stencils[..., :3] = 1 << 15 - 1, -(1 << 15 - 1), 1 << WEIGHT_BITS
        made = made._replace(stencils=stencils)
    return kind(made)


def outcomes(drawn, coder):
    """Return payload, heights and corrections by numba and by C."""
    found = []
    for encode in (BY_NUMBA[0], unit_in_c.encode):
        corrections = drawn.corrections()
        payload, heights, _ = encode(
            coder, drawn.spec, drawn.parent, drawn.target, drawn.mask, corrections
        )
        found.append((payload, heights.tobytes(), corrections.added.tobytes()))
    return found


@pytest.mark.large
@pytest.mark.parametrize("seed", range(8))
def test_payloads_heights_and_corrections_are_the_same(seed, with_library):
    rng = np.random.default_rng([54, seed])
    for number in range(60):
        drawn = drawn_unit(rng)
        by_numba, in_c = outcomes(drawn, coder_of(rng))
        assert by_numba == in_c, f"unit {number}: {drawn.spec}"


@pytest.mark.large
def test_units_of_several_bands_are_the_same(with_library):
    rng = np.random.default_rng(3)
    n_bands = set()
    for number, relief in enumerate((4000, 1, 30, 3, 300, 8, 100, 15) * 2):
        shape = tuple(int(n) for n in rng.integers(250, 400, 2))
        target = rng.integers(-relief, relief + 1, shape).astype(np.int32)
        above = Region(0, 0, (shape[0] + 1) // 2, (shape[1] + 1) // 2)
        spec = GroupSpec.alone(Region(0, 0, *shape), 3, -5000, 5000, parent_region=above)
        mask = rng.random(shape) < 0.7 if number % 3 == 0 else None
        drawn = Drawn(spec, target[::2, ::2].copy(), target, mask, None)
        by_numba, in_c = outcomes(drawn, coder_of(rng))
        assert by_numba == in_c
        n_bands.add((by_numba[0][0] >> 3 & 3) + 1)
    assert n_bands == {1, 2, 3, 4}


@pytest.mark.large
def test_counts_and_what_is_seen_of_samples_are_the_same(with_library):
    rng, n_seen = np.random.default_rng(4), 0
    for _ in range(80):
        drawn = drawn_unit(rng)
        found = []
        for count in (BY_NUMBA[1], unit_in_c.count):
            counts = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64)
            coder = Observer(_for_counts(plain_tables(K_MAX, 0)))
            heights = count(coder, drawn.spec, drawn.parent, drawn.target, drawn.mask, counts)
            seen = [(*one[:3], *(part.tobytes() for part in one[3:])) for one in coder.samples]
            found.append((counts.tobytes(), heights.tobytes(), seen))
        assert found[0] == found[1], drawn.spec
        n_seen += len(found[0][2])
    assert n_seen > 80


def test_symbols_of_samples_are_counted_the_same(with_library):
    rng = np.random.default_rng(6)
    for n in (2, 254, 1024, 1030, 4096):
        features = rng.integers(0, 1 << rng.integers(2, 14), (3, n)).astype(np.int32)
        features[2] = np.minimum(features[2], 6 * 4095)
        details = (rng.normal(size=n) * 10.0 ** rng.integers(0, 4)).astype(np.int32)
        details[:2] = -(2**31) + 1, 2**31 - 1
        is_coded = rng.random(n) < 0.9
        weights = rng.integers(0, [[6, 6, 9, 60]] * 3) * 999
        made = weights_of(weights, 3, 0)[2]
        found = []
        for count in (count_seen, unit_in_c.count_seen):
            shapes = (N_CLASSES, 226), (N_CLASSES, N_CLASSES, 64), (N_CLASSES, 64)
            counts = [np.zeros(shape, dtype=np.int64) for shape in shapes]
            floats, classes = np.zeros(1024, np.float32), np.zeros((2, 1024), np.int8)
            memory = np.zeros(1024, np.int32), floats, floats.view(np.int32), *classes
            count(features, details, is_coded, made, memory, *counts)
            found.append([one.tobytes() for one in counts])
            assert counts[0].any() or counts[1].any()
        assert found[0] == found[1]


def test_what_no_file_can_hold_is_refused(with_library):
    coder = UnitCoder(tables_from(plain_tables(K_MAX, 0)))
    spec = GroupSpec.alone(Region(0, 0, 2, 2), 1, -(2**31), 2**31 - 1)
    with pytest.raises(ValueError, match="heights from -2147483648 to 2147483647"):
        unit_in_c.encode(coder, spec, None, np.zeros((2, 2), dtype=np.int32), None)


def test_a_library_without_memory_raises_as_python_does(with_library, monkeypatch):
    class Full:
        def call(self, *_arguments):
            failure = native_library.Failure(native_library.NO_MEMORY, b"no memory for 3 bytes")
            raise native_library.NativeError(failure)

    monkeypatch.setattr(in_c, "library", Full)
    coder = UnitCoder(tables_from(plain_tables(K_MAX, 0)))
    spec = GroupSpec.alone(Region(0, 0, 3, 3), 1, 0, 9)
    with pytest.raises(MemoryError, match="no memory for 3 bytes"):
        coder.encode(spec, None, np.ones((3, 3), dtype=np.int32), None)


def test_a_job_of_another_size_is_refused(with_library):
    """As one of other sources would be, if the digest did not tell."""
    encoder = in_c.Owned("twz_python_encoder_new", "twz_python_encoder_free")
    job = unit_in_c._Job(size=ctypes.sizeof(unit_in_c._Job) - 8)
    tables = unit_in_c._new_tables(tables_from(plain_tables(K_MAX, 0)), is_read=False)
    with pytest.raises(ValueError, match="a job of"):
        in_c.call("twz_python_encode", encoder.address, tables.address, ctypes.byref(job))
