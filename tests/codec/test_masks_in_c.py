"""Does the native library code masks to the bits that NumPy's code notes?"""

import numpy as np
import pytest

from terrainwave.codec import in_c, masks
from terrainwave.codec.masks import N_MODELS, N_SLOTS, Above
from terrainwave.codec.refiner import Validity
from terrainwave.grid.quadtree import Region

pytestmark = [pytest.mark.native, pytest.mark.full]
CODE_KNOWN, WRITE_BITS = masks.code_known.__wrapped__, masks.write_bits.__wrapped__
# Bits of a sample: own, and valid, which is not told on the finest level.
TOLD = {True: 1, False: 3}


def field(rng, shape):
    """Return which samples are valid: by chance, all, or areas, some with specks."""
    kind = rng.integers(4)
    if kind == 0:
        return rng.random(shape) < rng.random()
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    waves = rng.uniform(3, 30, 2)
    found = np.sin(rows / waves[0]) + np.cos(cols / waves[1]) > rng.uniform(-1.5, 1.5)
    if kind == 1:
        found[:] = True
    return found ^ (rng.random(shape) < 0.01) if kind == 2 else found


def drawn_mask(rng):
    """Return own samples, valid ones, the region, and what is known above it."""
    n_rows, n_cols = (int(rng.integers(1, 4 if rng.random() < 0.2 else 140)) for _ in range(2))
    if rng.random() < 0.4:
        own = field(rng, (n_rows, n_cols))
        return own, own | field(rng, own.shape), Region(0, 0, n_rows, n_cols), None
    row, col = (int(n) for n in rng.integers(0, 9, 2))
    first_row = max(row // 2 - int(rng.integers(2)), 0)
    last_row, last_col = (row + n_rows) // 2 + int(rng.integers(2)), (col + n_cols) // 2 + 1
    parent = Region(first_row, col // 2, last_row - first_row + 1, last_col - col // 2 + 1)
    own_above = field(rng, parent.shape)
    valid_above = own_above | field(rng, parent.shape)
    own = field(rng, (n_rows, n_cols))
    down, across = row & 1, col & 1
    part = own[down::2, across::2]
    at = (row + 1 >> 1) - parent.row, (col + 1 >> 1) - parent.col
    part[:] = own_above[at[0] :, at[1] :][: part.shape[0], : part.shape[1]]
    above = Above(parent, Validity(None if valid_above.all() else valid_above, own_above))
    return own, own | field(rng, own.shape), Region(row, col, n_rows, n_cols), above


@pytest.mark.large
@pytest.mark.parametrize("seed", range(6))
def test_bits_of_masks_and_their_words_are_the_same(seed, with_library):
    rng = np.random.default_rng([55, seed])
    for _ in range(80):
        own, mask, region, above = drawn_mask(rng)
        is_finest = bool(rng.random() < 0.4)
        found = []
        for code in (CODE_KNOWN, in_c.code_known):
            cells, models, bits = code(own, mask, region, above, is_finest)
            told = cells & TOLD[is_finest]
            found.append((told.tobytes(), models.tobytes(), bits.tobytes()))
        assert found[0] == found[1], region
        models, bits = (np.frombuffer(part, dtype=np.uint8) for part in found[0][1:])
        freqs = rng.integers(1, N_SLOTS, N_MODELS).astype(np.uint32)
        coded = []
        for write in (WRITE_BITS, in_c.write_bits):
            words = np.zeros(models.size, dtype=np.uint16)
            states = np.full(1 + 3 * (region.n_rows & 1), 1 << 16, dtype=np.uint32)
            at = int(write(models, bits, freqs, words, states))
            coded.append((words[at:].tobytes(), states.tobytes()))
        assert coded[0] == coded[1]


@pytest.mark.large
def test_what_follows_from_the_level_above_is_the_same(with_library):
    rng = np.random.default_rng(56)
    for _ in range(80):
        _, mask, region, above = drawn_mask(rng)
        is_finest = bool(rng.random() < 0.4)
        found = []
        for code in (CODE_KNOWN, in_c.code_known):
            cells, _, _ = code(None, mask, region, above, is_finest)
            found.append((cells & TOLD[is_finest]).tobytes())
        assert found[0] == found[1], region


def test_more_bits_than_there_is_room_for_are_refused(with_library, monkeypatch):
    region = Region(0, 0, 40, 40)
    own = np.indices(region.shape).sum(0) % 2 == 0
    monkeypatch.setattr(in_c, "room_for", lambda _: 20)
    with pytest.raises(ValueError, match="room for 20 bits, too few"):
        in_c.code_known(own, own, region, None, True)
