"""The trivial refiner: raw indices in as many bits as they need."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.codec.refiner import GroupSpec
from terrainwave.codec.store.refiner import StoreRefiner
from terrainwave.errors import TruncatedStreamError
from terrainwave.grid.quadtree import Region


def spec_of(shape, step=1, z_min=-1000, z_max=1000, parent=False, first=(0, 0)):
    """Return the spec of a unit of `shape` whose first sample has the indices `first`."""
    region = Region(*first, *shape)
    above = None
    if parent:
        row, col = first[0] >> 1, first[1] >> 1
        last_row, last_col = first[0] + shape[0] - 1, first[1] + shape[1] - 1
        above = Region(row, col, (last_row + 1 >> 1) - row + 1, (last_col + 1 >> 1) - col + 1)
    return GroupSpec.alone(region, step, z_min, z_max, parent_region=above)


def valid_everywhere(target):
    return np.ones(target.shape, dtype=bool)


def encode(spec, target, parent=None, mask=None):
    mask = valid_everywhere(target) if mask is None else mask
    return StoreRefiner().encode(spec, parent, np.asarray(target, dtype=np.int32), mask)


def test_the_payload_of_two_heights_is_as_the_format_says():
    # Indices from z_min are 5 and 12: least 5, the others 0 and 7 in three bits: 000 111 00.
    target = np.array([[-995, -988]])
    payload, _, _ = encode(spec_of((1, 2)), target)
    assert payload.hex() == "05000000" + "03" + "1c"


@pytest.mark.parametrize("step", [1, 3, 21, 2001])
def test_heights_lie_within_half_a_step(step):
    target = np.random.default_rng(0).integers(-1000, 1001, (6, 9))
    spec = spec_of((6, 9), step)
    _, heights, _ = encode(spec, target)
    assert np.abs(heights - target).max() <= step // 2


@given(
    st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 7, 101])
)
def test_decoding_gives_what_encoding_returned(seed, n_rows, n_cols, step):
    rng = np.random.default_rng(seed)
    target = rng.integers(-1000, 1001, (n_rows, n_cols))
    mask = rng.random(target.shape) < 0.7
    spec = spec_of(target.shape, step)
    payload, heights, _ = encode(spec, target, mask=mask)
    back, _ = StoreRefiner().decode(spec, None, mask, payload)
    np.testing.assert_array_equal(back, heights)


@pytest.mark.parametrize("first", [(0, 0), (4, 6), (3, 5), (4, 5)])
def test_samples_on_even_indices_are_those_of_the_parent(first):
    target = np.random.default_rng(0).integers(-1000, 1001, (5, 6))
    spec = spec_of((5, 6), parent=True, first=first)
    above = np.arange(spec.parent_region.n_rows * spec.parent_region.n_cols, dtype=np.int32)
    above = above.reshape(spec.parent_region.shape)
    _, heights, _ = encode(spec, target, above)
    for row in range(5):
        for col in range(6):
            r, c = first[0] + row, first[1] + col
            if r % 2 == 0 and c % 2 == 0:
                at = r // 2 - spec.parent_region.row, c // 2 - spec.parent_region.col
                assert heights[row, col] == above[at]


def test_void_samples_are_not_stored():
    target = np.array([[0, 1, 0, 1, 0, 1, 0, 1, 0]])
    mask = np.arange(9)[None, :] < 8
    payload, _, _ = encode(spec_of((1, 9)), target, mask=mask)
    assert len(payload) == 5 + 1


def test_the_widest_heights_fit():
    limit = (1 << 30) - 1
    target = np.array([[-limit, limit]])
    _, heights, _ = encode(spec_of((1, 2), 1, -limit, limit), target)
    assert heights.tolist() == target.tolist()


TARGET = np.random.default_rng(2).integers(-900, 900, (4, 5))
SPEC = spec_of((4, 5), 3)
PAYLOAD = encode(SPEC, TARGET)[0]


def decode(payload, spec=SPEC):
    heights, _ = StoreRefiner().decode(spec, None, valid_everywhere(TARGET), payload)
    assert heights.shape == TARGET.shape
    assert heights.min() >= spec.z_min
    assert heights.max() <= spec.z_max


def test_every_prefix_is_truncated():
    for length in range(len(PAYLOAD)):
        with pytest.raises(TruncatedStreamError):
            decode(PAYLOAD[:length])
