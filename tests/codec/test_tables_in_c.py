"""Does the native library code tables to the bytes of the kernel, and read any bytes alike?"""

import numpy as np
import pytest

from terrainwave.codec.planes import FileStencil
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
def test_bytes_are_the_same_and_so_is_what_any_bytes_say(seed, with_library, monkeypatch):
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
        monkeypatch.setenv(native_library.SWITCH, "0")
        assert pack_file_tables(tables) == section
        assert [parsed(bytes(data)) for data in (section, *damaged)] == said
        monkeypatch.setenv(native_library.SWITCH, "1")
