"""SPIHT against a slow reading of docs/format-cdf53.md C.5, and against planes walked by hand."""

from itertools import pairwise

import numpy as np
import pytest
from reference_decoder.spiht import Spiht, Stop
from strategies import terrain_like

from terrainwave.codec.cdf53.spiht import decode_field, encode_field, make_geometry
from terrainwave.coding.lifting53 import forward_transform
from terrainwave.errors import CorruptStreamError, TruncatedStreamError
from terrainwave.reference.range_coder import Models, RangeDecoder

SHAPES = [(9, 9, 3), (8, 11, 3), (13, 6, 2), (1, 17, 4), (5, 1, 3), (2, 2, 1)]


def random_field(shape, seed=0, spread=30):
    """Return coefficients that fall off towards the fine bands, as those of terrain do."""
    rng = np.random.default_rng(seed)
    field = rng.laplace(size=shape) * spread
    rows, cols = np.indices(shape)
    return (field / (1 + np.maximum(rows, cols))).astype(np.int64)


def without_low(field, n_transforms):
    """Return the field with zeros in its LL band."""
    field = field.copy()
    field[
        : (field.shape[0] - 1 >> n_transforms) + 1, : (field.shape[1] - 1 >> n_transforms) + 1
    ] = 0
    return field


def slow_decode(stream, n_planes, shape, n_transforms, is_cut):
    """Decode with the slow traversal and the reference's range decoder."""
    slow, models, decoder = Spiht(shape, n_transforms), Models(1515), RangeDecoder(stream)

    def decide(model, truth):
        if is_cut and decoder.position > len(stream):
            raise Stop
        return decoder.bit(models, model)

    slow.run(n_planes, decide)
    field = np.zeros(shape, dtype=np.int64)
    for place, value in slow.guesses().items():
        field[place] = value
    return field


def trace_of(field, n_transforms):
    trace = np.zeros(100_000, dtype=np.uint8)
    coded = encode_field(field, n_transforms, trace)
    return coded, trace[: coded.n_decisions].tolist()


def test_a_field_of_one_transform_is_sorted_pixel_by_pixel():
    # 2 x 2: HL, LH and HH have one coefficient each, no sets. Planes 1 and 0 of 3, 0, -1:
    # HL 1 + (significant, positive); LH 0; HH 0; no refinement. Then LH 0; HH 1 - (1, 1);
    # refinement of HL: 1.
    field = np.array([[0, 3], [0, -1]])
    coded, trace = trace_of(field, 1)
    assert coded.n_planes == 2
    assert trace == [1, 0, 0, 0, 0, 1, 1, 1]


def test_a_set_is_opened_when_a_descendant_is_significant():
    # 4 x 4, two transforms. LL (0, 0); HL, LH, HH of transform 1 at (0, 1), (1, 0), (1, 1); the
    # children of (0, 1) are (0, 2), (0, 3), (1, 2), (1, 3). Only (1, 2) is not zero: -1, no shift.
    field = np.zeros((4, 4), dtype=np.int64)
    field[1, 2] = -1
    # One plane, 0. HL and LH of transform 1 have shift 1 > 0: not coded; HH: 0. Set D of HL: 1,
    # its children 0, 0, 1 - (1, 1), 0; D of LH: 0, of HH: 0.
    coded, trace = trace_of(field, 2)
    assert coded.n_planes == 1
    assert trace == [0, 1, 0, 0, 1, 1, 0, 0, 0]


def test_grandchildren_are_a_set_of_their_own():
    # 8 x 8, three transforms: HL of transform 2 at (0, 1), of 1 at rows 0-1, columns 2-3, of 0 at
    # rows 0-3, columns 4-7. Only (2, 5) is not zero: 1. It is the child of (1, 2), grandchild of
    # (0, 1).
    field = np.zeros((8, 8), dtype=np.int64)
    field[2, 5] = 1
    # Plane 0. Shifts of HL, LH 2, 2, of HH 1 at transform 2: none coded. D of HL: 1; its children
    # have shift 1, not coded; L of HL is appended. D of LH 0, of HH 0. L of HL: 1; four D are
    # appended: of (0, 2) 0, (0, 3) 0, (1, 2) 1: children (2, 4) 0, (2, 5) 1 + (1, 0), (3, 4) 0,
    # (3, 5) 0, no grandchildren; of (1, 3) 0.
    assert trace_of(field, 3)[1] == [1, 0, 0, 1, 0, 0, 1, 0, 1, 0, 0, 0, 0]


@pytest.mark.parametrize("shape", SHAPES)
def test_decisions_are_those_of_the_slow_version(shape):
    *shape, n_transforms = shape
    field = random_field(tuple(shape))
    coded, trace = trace_of(field, n_transforms)
    slow, expected = Spiht(tuple(shape), n_transforms), []

    def decide(model, truth):
        expected.append(int(truth))
        return truth

    slow.run(coded.n_planes, decide, without_low(field, n_transforms))
    assert trace == expected


@pytest.mark.parametrize("shape", SHAPES)
def test_the_slow_version_decodes_the_stream(shape):
    *shape, n_transforms = shape
    field = random_field(tuple(shape), seed=1)
    coded = encode_field(field, n_transforms)
    found = slow_decode(coded.stream, coded.n_planes, tuple(shape), n_transforms, False)
    np.testing.assert_array_equal(found, without_low(field, n_transforms))


@pytest.mark.parametrize("share", [0, 0.1, 0.3, 0.5, 0.8, 0.95])
def test_a_cut_stream_decodes_as_the_slow_version_does(share):
    field = random_field((9, 11), seed=2, spread=300)
    coded = encode_field(field, 3)
    stream = coded.stream[: int(share * len(coded.stream))]
    found = decode_field(stream, coded.n_planes, field.shape, 3, is_cut=True)
    expected = slow_decode(stream, coded.n_planes, field.shape, 3, True)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_whole_stream_gives_all_coefficients(shape):
    *shape, n_transforms = shape
    field = random_field(tuple(shape), seed=3, spread=1e6)
    coded = encode_field(field, n_transforms)
    found = decode_field(coded.stream, coded.n_planes, field.shape, n_transforms, is_cut=False)
    np.testing.assert_array_equal(found, without_low(field, n_transforms))


def test_the_bytes_of_a_plane_decode_it():
    field = random_field((17, 17), seed=4, spread=3000)
    coded = encode_field(field, 4)
    for plane in range(coded.n_planes):
        stream = coded.stream[: coded.ends[plane]]
        found = decode_field(stream, coded.n_planes, field.shape, 4, is_cut=True)
        # No shift here is above 4: what is left of a coefficient is less than the plane's unit.
        assert np.abs(found - without_low(field, 4)).max() < 2**plane + 1


def test_more_bytes_never_make_a_field_much_worse():
    field = random_field((17, 17), seed=5, spread=3000)
    coded = encode_field(field, 4)
    errors = [
        np.square(
            decode_field(coded.stream[:n], coded.n_planes, field.shape, 4, is_cut=True)
            - without_low(field, 4)
        ).sum()
        for n in range(0, len(coded.stream), 16)
    ]
    assert all(later <= 1.05 * earlier for earlier, later in pairwise(errors))


def test_a_stream_is_smaller_than_its_decisions():
    # Adaptive models against one raw bit each, which is SPIHT without arithmetic coding.
    field = terrain_like(65, 65, seed=6).astype(np.int64)
    forward_transform(field, 6, 0)
    coded = encode_field(field, 6)
    assert 8 * len(coded.stream) < 0.97 * coded.n_decisions


def test_every_coefficient_has_one_parent_or_is_a_root():
    geometry = make_geometry((13, 6), 3)
    slow = Spiht((13, 6), 3)
    expected = {p for p in slow.places if slow.parent(p) is None}
    found = {slow.at[divmod(int(at) - geometry.width - 1, geometry.width)] for at in geometry.roots}
    assert found == expected
    assert geometry.n_sets == sum(bool(slow.children(p)) for p in slow.places)


def test_a_whole_stream_cut_short_is_truncated():
    field = random_field((9, 9), seed=7, spread=300)
    coded = encode_field(field, 3)
    with pytest.raises(TruncatedStreamError):
        decode_field(coded.stream[:-8], coded.n_planes, field.shape, 3, is_cut=False)


def test_bytes_left_over_are_rejected():
    field = random_field((9, 9), seed=7)
    coded = encode_field(field, 3)
    with pytest.raises(CorruptStreamError, match="left over"):
        decode_field(coded.stream + b"\0\0", coded.n_planes, field.shape, 3, is_cut=False)


@pytest.mark.parametrize("seed", range(5))
def test_any_bytes_give_bounded_coefficients_or_our_error(seed):
    rng = np.random.default_rng(seed)
    stream = rng.integers(0, 256, rng.integers(0, 60), dtype=np.uint8).tobytes()
    for is_cut in (True, False):
        try:
            found = decode_field(stream, int(rng.integers(1, 61)), (9, 7), 3, is_cut=is_cut)
        except CorruptStreamError:
            continue
        assert np.abs(found).max() <= 2**34
