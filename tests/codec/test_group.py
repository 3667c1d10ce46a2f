"""One coded unit: masks exact, voids implied, nodata never met by accident, damage survived."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import implied_voids, level_mask
from strategies import valid_masks

from terrainwave.codec import group
from terrainwave.codec.group import decode_unit, encode_unit
from terrainwave.codec.masks import encode_validity
from terrainwave.codec.refiner import Decoded, Validity
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.unit_specs import block_of_unit, unit_spec
from terrainwave.codec.varint import encode_varint
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid, Region

STORE = refiner_by_name("store")
BIG = 1 << 29


def parameters(step=1, z_min=-BIG, z_max=BIG, forbidden=(0, -1), rings=1):
    return CodecParameters(step, z_min, z_max, forbidden, rings, 0)


def root_spec(n_rows, n_cols, **options):
    """Return the spec of the only unit of a small raster."""
    return unit_spec(Grid(n_rows, n_cols, 32), parameters(**options), Block(-1, 0, 0))


def round_trip(spec, target, mask, parent=None, refiner=STORE, own=None):
    """Encode and decode; return the payload and the decoded unit."""
    target = np.asarray(target, dtype=np.int32)
    payload, encoded = encode_unit(refiner, spec, parent, target, mask, own=own)
    decoded = decode_unit(refiner, spec, parent, payload)
    np.testing.assert_array_equal(decoded.heights, encoded.heights)
    np.testing.assert_array_equal(decoded.mask, encoded.mask)
    return payload, decoded


def valid_everywhere(spec):
    return np.ones(spec.region.shape, dtype=bool)


@given(st.data(), st.integers(1, 9), st.integers(1, 9))
def test_masks_come_back_exactly(data, n_rows, n_cols):
    mask = data.draw(valid_masks((n_rows, n_cols)))
    _, decoded = round_trip(root_spec(n_rows, n_cols), np.zeros((n_rows, n_cols)), mask)
    np.testing.assert_array_equal(decoded.mask, mask)


def test_an_all_void_unit_has_no_payload():
    spec = root_spec(9, 9)
    payload, _ = round_trip(spec, np.zeros((9, 9)), ~valid_everywhere(spec))
    assert payload == b""


def pyramid_of_masks(valid, grid):
    return [level_mask(valid, grid.k_max - level) for level in range(grid.k_max + 1)]


def decode_all_masks(grid, valid, rings):
    """Code every unit of a raster from the root down; return {key: (spec, payload, decoded)}."""
    masks = pyramid_of_masks(valid, grid)
    found = {}
    keys = grid.root_keys()
    for key in keys:
        spec = unit_spec(grid, parameters(rings=rings), key)
        parent = None
        if key.level >= 0:
            above = Block(-1, *key[1:]) if key.level == 0 else key.parent
            above_spec, _, above_decoded = found[above]
            parent = block_of_unit(grid, above_spec, above_decoded, key)
        here = spec.region.slices_in(Region(0, 0, *masks[spec.level].shape))
        stride = grid.stride(spec.level)
        mask, own = masks[spec.level][here], valid[::stride, ::stride][here]
        payload, decoded = round_trip(spec, np.zeros(mask.shape), mask, parent, own=own)
        np.testing.assert_array_equal(decoded.own_mask, own)
        found[key] = spec, payload, decoded
        blocks = [Block(0, *key[1:])] if key.level < 0 else grid.children(key)
        keys += [block for block in blocks if block.level < grid.k_max]
    return found, masks


@pytest.mark.large
@pytest.mark.parametrize("rings", [1, 3])
@pytest.mark.parametrize("share", [0.0001, 0.01, 0.5, 0.99])
def test_masks_of_all_levels_come_back_exactly(share, rings):
    grid = Grid(150, 141, 32)
    valid = np.random.default_rng(1).random((150, 141)) < share
    found, masks = decode_all_masks(grid, valid, rings)
    for spec, _, decoded in found.values():
        whole = Region(0, 0, *masks[spec.level].shape)
        np.testing.assert_array_equal(decoded.mask, masks[spec.level][spec.region.slices_in(whole)])


def test_implied_voids_cost_no_mask():
    grid = Grid(2 * 32 + 1, 3, 32)
    spec = unit_spec(grid, parameters(), Block(0, 0, 0))
    above = np.ones(spec.parent_region.shape, dtype=bool)
    above[5:9] = False
    parent = Decoded(np.zeros(above.shape, dtype=np.int32), Validity.of(above))
    mask = ~implied_voids(spec.region, spec.parent_region, above)
    payload, _ = round_trip(spec, np.zeros(mask.shape), mask, parent)
    assert len(payload) == 1 + 5


@pytest.mark.parametrize("method", ["store", "cdf97"])
@pytest.mark.parametrize("step", [3, 9, 101])
@pytest.mark.parametrize("forbidden", [(7, 7), (-2, 5), (-20, -20)])
@pytest.mark.parametrize("share", [0.8, 2])
def test_no_valid_sample_takes_a_forbidden_height_and_all_keep_the_bound(
    method, step, forbidden, share
):
    rng = np.random.default_rng(3)
    spec = root_spec(6, 7, step=step, z_min=-40, z_max=40, forbidden=forbidden)
    target = rng.integers(-40, 41, (6, 7))
    target[(target >= forbidden[0]) & (target <= forbidden[1])] = 30
    mask = rng.random((6, 7)) < share
    _, decoded = round_trip(spec, target, mask, refiner=refiner_by_name(method))
    heights = decoded.heights[mask]
    assert not ((heights >= forbidden[0]) & (heights <= forbidden[1])).any()
    assert np.abs(heights - target[mask]).max() <= spec.half


def test_a_height_just_below_nodata_stays_below_it():
    # Step 3 from z_min = 0: 3, 4 and 5 become 4. With 4 forbidden, 3 stays 3 and 5 becomes 5.
    spec = root_spec(1, 4, step=3, z_min=0, z_max=8, forbidden=(4, 4))
    _, decoded = round_trip(spec, [[0, 3, 5, 8]], np.ones((1, 4), dtype=bool))
    assert decoded.heights.tolist() == [[1, 3, 5, 7]]


def test_a_height_that_is_itself_forbidden_moves_within_the_range():
    # Where quanta are coarser than heights, a valid height may round to nodata's quantum.
    # The store's heights are 2 and 7 here.
    spec = root_spec(1, 3, step=5, z_min=0, z_max=7, forbidden=(7, 7))
    _, decoded = round_trip(spec, [[7, 7, 0]], np.ones((1, 3), dtype=bool))
    assert decoded.heights.tolist() == [[6, 6, 2]]


def test_heights_are_clamped_to_the_range_of_the_originals():
    spec = root_spec(1, 2, step=101, z_min=-3, z_max=3)
    _, decoded = round_trip(spec, [[-3, 3]], np.ones((1, 2), dtype=bool))
    assert np.abs(decoded.heights).max() <= 3


@pytest.mark.parametrize("method", ["store", "rapid"])
@pytest.mark.parametrize("forbidden", [(0, -1), (2, 2)])
@pytest.mark.parametrize("has_voids", [False, True])
def test_units_decode_into_memory_with_anything_in_it(monkeypatch, method, forbidden, has_voids):
    rng = np.random.default_rng(6)
    spec = root_spec(7, 9, step=5, z_min=-50, z_max=50, forbidden=forbidden)
    target = rng.integers(-50, 51, (7, 9))
    target[target == 2] = 1
    mask = rng.random((7, 9)) < (0.7 if has_voids else 2)
    refiner = refiner_by_name(method)
    payload, plain = round_trip(spec, target, mask, refiner=refiner)
    for filling in (-99, 99):
        out = np.full((7, 9), filling, dtype=np.int32)
        monkeypatch.setattr(group, "new_heights", lambda _shape, out=out: out)
        decoded = decode_unit(refiner, spec, None, payload)
        np.testing.assert_array_equal(decoded.heights, plain.heights)
        np.testing.assert_array_equal(decoded.mask, mask)
        assert np.shares_memory(decoded.heights, out) == (method == "rapid")


def small_unit(method, has_exceptions=True):
    rng = np.random.default_rng(5)
    forbidden = (2, 2) if has_exceptions else (0, -1)  # the store's heights are -48, -43 … 2 …
    spec = root_spec(7, 9, step=5, z_min=-50, z_max=50, forbidden=forbidden)
    target = rng.integers(-50, 51, (7, 9))
    target[target == 2] = 1
    mask = rng.random((7, 9)) < 0.7
    payload, _ = round_trip(spec, target, mask, refiner=refiner_by_name(method))
    return spec, payload


def outcome(method, spec, payload):
    try:
        decoded = decode_unit(refiner_by_name(method), spec, None, payload)
    except CorruptStreamError as error:
        return error
    heights = decoded.heights[decoded.mask]
    assert decoded.heights.shape == decoded.mask.shape == spec.region.shape
    assert heights.min(initial=0) >= spec.z_min
    assert heights.max(initial=0) <= spec.z_max
    return decoded


methods = pytest.mark.parametrize("method", ["store", "cdf97"])


@methods
def test_every_prefix_is_rejected(method):
    spec, payload = small_unit(method)
    for length in range(1, len(payload)):  # an empty one is a unit without valid samples
        assert isinstance(outcome(method, spec, payload[:length]), CorruptStreamError), length


@methods
def test_an_extra_byte_is_rejected(method):
    spec, payload = small_unit(method)
    assert isinstance(outcome(method, spec, payload + b"\0"), CorruptStreamError)


@methods
def test_every_flipped_bit_gives_heights_in_range_or_our_own_error(method):
    spec, payload = small_unit(method)
    for bit in range(8 * len(payload)):
        broken = bytearray(payload)
        broken[bit // 8] ^= 1 << bit % 8
        outcome(method, spec, bytes(broken))


@methods
@given(payload=st.binary(max_size=60), step=st.sampled_from([1, 5, (1 << 30) + 1]))
def test_any_bytes_give_heights_in_range_or_our_own_error(method, payload, step):
    outcome(method, root_spec(7, 9, step=step, z_min=-50, z_max=50, forbidden=(3, 3)), payload)


@methods
@given(rest=st.binary(max_size=60), flags=st.sampled_from([0, 1, 2, 3]))
def test_any_bytes_below_a_parent_with_voids_do_too(method, rest, flags):
    grid = Grid(131, 3, 32)
    spec = unit_spec(grid, parameters(step=3, z_min=-50, z_max=50), Block(2, 1, 0))
    rng = np.random.default_rng(6)
    shape = spec.parent_region.shape
    heights = rng.integers(-50, 51, shape).astype(np.int32)
    parent = Decoded(heights, Validity.of(rng.random(shape) < 0.6))
    try:
        decoded = decode_unit(refiner_by_name(method), spec, parent, bytes([flags]) + rest)
    except CorruptStreamError:
        return
    assert not (decoded.mask & implied_voids(spec.region, spec.parent_region, parent.mask)).any()


def test_a_payload_for_a_unit_without_valid_samples_is_corrupt():
    spec = root_spec(2, 2)
    nothing = Validity.of(np.zeros((2, 2), dtype=bool))
    section = encode_validity(nothing, spec.region, None, is_finest=True)
    payload = bytes([1]) + encode_varint(len(section)) + section
    with pytest.raises(CorruptStreamError, match="without a valid sample"):
        decode_unit(STORE, spec, None, payload)


def test_a_one_in_the_filling_of_the_exceptions_is_corrupt():
    # Step 3 on heights 1 … 5: index 1 decodes to 5 = nodata, once; the original 4 lies below.
    spec = root_spec(1, 2, step=3, z_min=1, z_max=6, forbidden=(5, 5))
    payload, _ = round_trip(spec, [[4, 2]], valid_everywhere(spec))
    assert payload[:3] == bytes([2, 1, 0x80])  # one exception section of one bit
    with pytest.raises(CorruptStreamError, match="not filled with 0"):
        decode_unit(STORE, spec, None, payload[:2] + b"\x81" + payload[3:])
