"""Lines that two units share: coded in both, from their parents' samples on the line alone.

So both units find the same heights, whatever lies beside the line.
"""

import numpy as np

from terrainwave.codec.rapid2.details import _class_row
from terrainwave.codec.rapid2.layout import LIMIT
from terrainwave.codec.rapid2.symbols import HIDDEN, log_strip, read_strip
from terrainwave.coding.jit import kernel, kernel_part


@kernel_part
def _at(samples, n, place):
    """Return a sample of a line's even places by symmetry."""
    if n == 1:
        return np.int64(samples[0])
    period = 2 * (n - 1)
    place %= period
    return np.int64(samples[min(place, period - place)])


@kernel_part
def _predict(samples, n, k, step):
    """Return the prediction of odd place k, its side, range and bend."""
    a, b = _at(samples, n, k - 1), _at(samples, n, k)
    c, d = _at(samples, n, k + 1), _at(samples, n, k + 2)
    least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    quarters = min(max((9 * (b + c) - a - d) >> 2, 4 * least), 4 * most)
    whole = (quarters + 2) >> 2
    is_turned = 4 * whole > quarters if step <= 3 else quarters > 2 * (b + c)
    return whole, is_turned, most - least, abs(a - b - c + d)


@kernel
def code_lines(
    is_encoding, goals, has_void, valid, known, evens, n_evens, n_odds, step, low, high, shift,
    weights, most, values, cut, slots, freqs, n_states, states, words, raw, log, places, space,
    lines,
):  # fmt: skip
    """Fill `lines`: the heights at the odd places of the known sides.

    `evens` are their parents' samples, `goals` and `valid` belong to odd places; rows are top,
    left, bottom, right.
    """
    for side in range(4):
        if not known[side]:
            continue
        n = n_odds[side]
        for k in range(n):
            _, _, range_, bend = _predict(evens[side], n_evens[side], k, step)
            both = weights[1] * min(range_ >> shift, 2 * LIMIT)
            both += weights[2] * min(bend >> shift, LIMIT)
            space.expected[k] = np.int32((both >> weights[4]) + weights[0])
        _class_row(space.expected, n, space.floats, space.bits, space.pairs, space.singles)
        if has_void:
            for k in range(n):
                if not valid[side, k]:
                    space.singles[k] = HIDDEN
            for k in range((n + 1) // 2):
                if space.singles[2 * k] == HIDDEN and space.singles[2 * k + 1] == HIDDEN:
                    space.pairs[k] = HIDDEN
        if is_encoding:
            for k in range(n + (n & 1)):
                detail = np.int64(0)
                if k < n and (not has_void or valid[side, k]):
                    whole, is_turned, _, _ = _predict(evens[side], n_evens[side], k, step)
                    detail = (goals[side, k] - whole + (step >> 1)) // step
                    detail = -detail if is_turned else detail
                space.details[k] = np.int32(detail)
            log_strip(
                space.pairs, space.singles, (n + 1) // 2, space.details, cut, freqs, n_states, log,
                places,
            )  # fmt: skip
        else:
            read_strip(
                space.pairs, space.singles, (n + 1) // 2, space.entries, space.symbols,
                space.details, most, values, cut, slots, states, n_states, words, raw, places,
                space.more,
            )  # fmt: skip
        for k in range(n):
            whole, is_turned, _, _ = _predict(evens[side], n_evens[side], k, step)
            detail = np.int64(space.details[k])
            detail = -detail if is_turned else detail
            lines[side, k] = np.int32(min(max(whole + detail * step, low), high))
