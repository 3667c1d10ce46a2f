"""Residual coder: its quantiser against Yusov & Turlapov 2010 (§2.1), its round trip."""

import numpy as np
import pytest

from terrainwave.codec.cdf97 import trained as tables97
from terrainwave.codec.cdf97.residual import (
    CODED,
    FRAME,
    KNOWN,
    N_TERMS,
    VOID,
    code_residuals,
    frame_base,
    new_scratch,
    open_loop_costs,
    rounding_of,
)
from terrainwave.coding.rangecoder import (
    code_bit,
    code_magnitude,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
)

NO_PREDICTION = np.zeros((4, N_TERMS), dtype=np.int32)


def framed(base):
    """Return heights as a framed base in 1/64."""
    wide = np.zeros((base.shape[0] + 2 * FRAME, base.shape[1] + 2 * FRAME), dtype=np.int64)
    wide[FRAME:-FRAME, FRAME:-FRAME] = np.asarray(base, dtype=np.int64) << 6
    frame_base(wide)
    return wide


def encode(target, kinds, base, step, weights, heights=None, *, is_coarse=False):
    """Return the stream and the heights it stands for."""
    heights = np.zeros_like(target) if heights is None else heights.copy()
    out = np.zeros(4096, dtype=np.uint8)
    coder = new_encoder(out, tables97.start_residual_models())
    code_residuals(
        target, heights, kinds, base, step, rounding_of(step, is_coarse=is_coarse), weights,
        tables97.E_WEIGHTS, new_scratch(target.shape[1]), coder,
    )  # fmt: skip
    return out[: finish_encoder(coder.state, out)], heights


def rebuilt(errors, step, *, is_coarse):
    """Return the residuals that come back."""
    target = np.array([errors], dtype=np.int32)
    kinds = np.full(target.shape, CODED, dtype=np.uint8)
    base = framed(np.zeros_like(target))
    return encode(target, kinds, base, step, NO_PREDICTION, is_coarse=is_coarse)[1][0]


@pytest.mark.parametrize("half", [0, 1, 7, 50])
def test_finest_level_is_equation_1_on_the_grid(half):
    # With p = 1 and delta = half: floor((|r| + delta) / (2 delta + p)), the sign of r.
    errors = np.arange(-150, 151)
    printed = np.sign(errors) * ((np.abs(errors) + half) // (2 * half + 1))
    step = 2 * half + 1
    assert rebuilt(errors, step, is_coarse=False).tolist() == (printed * step).tolist()


@pytest.mark.parametrize("half", [1, 2, 7, 50])
def test_coarse_levels_of_faithful_files_are_quantised_as_printed(half):
    # Y10 for coarse levels: r~ = floor(|r| / delta), rebuilt as (r~ + 1/2) delta, 0 as 0.
    errors = np.arange(-40 * half, 40 * half + 1)
    symbols = np.abs(errors) // half
    printed = np.sign(errors) * np.where(symbols > 0, np.floor((symbols + 0.5) * half), 0)
    found = rebuilt(errors, 2 * half + 1, is_coarse=True)
    np.testing.assert_array_equal(found, printed)
    assert np.abs(found - errors).max() <= half


@pytest.mark.parametrize("is_coarse", [False, True])
@pytest.mark.parametrize("half", [1, 1000, 1 << 20, 1 << 28])
@pytest.mark.parametrize("is_down", [False, True])
def test_the_largest_index_is_as_format_7_7_and_7_9_say(half, is_down, is_coarse):
    """What any bytes may say of a lone sample: as by the document, with its numbers of models."""
    most, n = 1 << 30, 2 * half + 1
    d, shift = (half, half >> 1) if is_coarse else (n, 0)
    start = most if is_down else -most
    expected_magnitude = int(tables97.E_WEIGHTS[7]) >> 4
    assert 0 < expected_magnitude < 4096
    eta = min(max((int(8 * np.log2(expected_magnitude)) - 24 >> 2) + 1, 0), 43)
    first = 879 + 14 * (min(eta + 2, 43) if is_coarse else eta)
    highest = 2**31 // d + 1
    for value in (1, 2, highest // 2 + 1, highest - 1, highest, highest + 1, 2**32):
        out = np.zeros(64, dtype=np.uint8)
        coder = new_encoder(out, tables97.start_residual_models())
        code_bit(coder, np.int64(4 * eta), np.int64(1))
        code_bit(coder, np.int64(704 + 7 * (5 * 1 + 2) + 3), np.int64(is_down))
        code_magnitude(coder, np.int64(first), np.int64(1495), np.int64(0), np.int64(value - 1))
        stream = out[: finish_encoder(coder.state, out)].tobytes()
        change = min(value, highest) * d + shift
        height = max(start - change, -most) if is_down else min(start + change, most)
        heights = np.zeros((1, 1), dtype=np.int32)
        kinds, base = np.full((1, 1), CODED, dtype=np.uint8), framed(np.array([[start]]))
        coder = new_decoder(stream, tables97.start_residual_models())
        code_residuals(
            None, heights, kinds, base, n, rounding_of(n, is_coarse=is_coarse), NO_PREDICTION,
            tables97.E_WEIGHTS, new_scratch(1), coder,
        )  # fmt: skip
        assert finish_decoder(coder.state, coder.stream)[0] == 0
        assert heights.item() == height


@pytest.mark.parametrize("is_coarse", [False, True])
def test_decoding_gives_what_was_encoded_with_voids_and_known_samples(is_coarse):
    rng = np.random.default_rng(3)
    target = rng.integers(-40, 40, (9, 12), dtype=np.int32)
    kinds = rng.choice([VOID, CODED, CODED, KNOWN], target.shape).astype(np.uint8)
    base = framed(np.zeros_like(target))
    start = np.where(kinds == KNOWN, target + 1, 0).astype(np.int32)
    weights = tables97.TERM_WEIGHTS[-1]
    stream, heights = encode(target, kinds, base, 5, weights, start, is_coarse=is_coarse)
    back = start.copy()
    coder = new_decoder(stream.tobytes(), tables97.start_residual_models())
    rounding = rounding_of(5, is_coarse=is_coarse)
    code_residuals(
        None, back, kinds, base, 5, rounding, weights, tables97.E_WEIGHTS, new_scratch(12), coder
    )
    assert finish_decoder(coder.state, coder.stream)[0] == 0
    np.testing.assert_array_equal(back, heights)
    assert np.abs(heights - target)[kinds == CODED].max() <= 2
    np.testing.assert_array_equal(heights[kinds == KNOWN], target[kinds == KNOWN] + 1)


def test_errors_that_go_on_are_predicted():
    # The base is 700 too low everywhere; the western error says so, and only that.
    target = np.full((8, 8), 700, dtype=np.int32)
    kinds = np.full(target.shape, CODED, dtype=np.uint8)
    weights = NO_PREDICTION.copy()
    weights[:, 7] = 256
    base = framed(np.zeros_like(target))
    alone, _ = encode(target, kinds, base, 1, NO_PREDICTION)
    predicted, heights = encode(target, kinds, base, 1, weights)
    np.testing.assert_array_equal(heights, target)
    assert len(predicted) < len(alone)
    costs = np.zeros(2, dtype=np.int64)
    sets = np.stack([NO_PREDICTION, weights])
    open_loop_costs(target, kinds, base, 1, sets, 2, new_scratch(8), costs)
    assert costs[1] < costs[0]


def test_a_base_goes_on_straight_outside():
    rows, cols = np.mgrid[:4, :3]
    plane = 5 * rows - 2 * cols
    rows, cols = np.mgrid[-2:6, -2:5]
    np.testing.assert_array_equal(framed(plane), (5 * rows - 2 * cols) * 64)
    np.testing.assert_array_equal(framed(np.array([[7]])), np.full((5, 5), 7 * 64))


def test_weights_are_small_enough_for_the_sums():
    assert np.abs(tables97.TERM_WEIGHTS).max() < 1 << 12
    assert 0 <= tables97.E_WEIGHTS.min() <= tables97.E_WEIGHTS.max() < 1 << 15
