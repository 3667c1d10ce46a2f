"""SPIHT: bit planes of wavelet coefficients, sorted by trees (format-cdf53.md, C.5).

A. Said and W. A. Pearlman, "A new, fast, and efficient image codec based on set partitioning in
hierarchical trees" (1996): a list of insignificant pixels, one of insignificant sets (D, all
descendants of a coefficient, and L, those but its children) and one of significant pixels.

Departures: the LL band is not coded (a tile gets it from above); the roots are all coefficients
without a parent in the next coarser band; coefficients are shifted by about the norm of their basis
functions, and bits known to be zero are not coded; every decision is coded with an adaptive model
chosen by known neighbours, instead of as one raw bit.

Encoder and decoder are one traversal, `_code_planes`, whose goal is None in a decoder. No index
comes from the stream. The stream only selects the path through lists built from the field's
geometry: a coefficient is in one list of pixels at a time, and a set enters the list of sets at
most once as D and once as L.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.coding.lifting53 import level_shapes
from terrainwave.coding.rangecoder import (
    BYTE_POS,
    STATE_SIZE,
    Coder,
    code_step,
    finish_decoder,
    finish_encoder,
    n_bytes_begun,
    new_models,
    put_back,
    reset_encoder,
    start_decoder,
    take_out,
)
from terrainwave.coding.status import raise_for_status

# Largest unshifted magnitude in a valid field; shifted ones fit MAX_PLANES.
_MAX_MAGNITUDE = 1 << 34
MAX_PLANES = 60

# Columns of the geometry of a field: 3 * transform + band - 1, or -1 in LL and the frame; position
# of the first child, or -1; 1 for one row of children, 2 for one column (else two of both);
# position of the parent, or of the frame.
_BAND, _CHILD, _SINGLE, _PARENT = 0, 1, 2, 3

# Entries of the traversal's state after those of the range coder.
IS_CUT, IS_STOPPED, N_DECISIONS = STATE_SIZE, STATE_SIZE + 1, STATE_SIZE + 2
N_PIXELS, N_ENTRIES, N_SIGNIFICANT, N_REFINED = (STATE_SIZE + 3 + i for i in range(4))
WALK_STATE_SIZE = STATE_SIZE + 7

# An unknown remainder of a magnitude, r bits wide, counts as 3 / 8 of 2^r: most are small.
_REST_NUM, _REST_BITS = 3, 3

# Flags of sets: D and L are known to be significant.
_D_KNOWN, _L_KNOWN = 1, 2

_MAX_UNITS = 6  # neighbours count up to this multiple of the threshold
# The bin of a sum is the number of these that are <= the sum.
_THRESHOLDS = np.array([1, 2, 3, 4, 5, 6, 7, 9, 11, 14, 18, 24, 32, 40, 48], dtype=np.int64)
_LAST_BIN_AT = 48
_BINS = np.searchsorted(_THRESHOLDS, np.arange(_LAST_BIN_AT + 1), side="right")
_N_BINS = 16
_N_DEPTHS = 4
_N_CLASSES = 3 * _N_DEPTHS
_SET_BINS = 8
_PIXEL_MODELS = 0
_CHILD_MODELS = _PIXEL_MODELS + _N_CLASSES * _N_BINS
_D_MODELS = _CHILD_MODELS + 2 * _N_CLASSES * _N_BINS
_L_MODELS = _D_MODELS + _N_CLASSES * 4 * _SET_BINS
_SIGN_MODELS = _L_MODELS + _N_CLASSES * 5 * _SET_BINS
_REFINE_MODELS = _SIGN_MODELS + 27
N_SPIHT_MODELS = _REFINE_MODELS + 3 * _N_BINS


@dataclass(frozen=True)
class Geometry:
    """Positions of the coefficients of a field of one shape, flat, with a frame of one sample.

    `table` is int32, shape (n_places, 4); `width` the positions in a row.
    """

    table: NDArray[np.int32]
    width: int
    n_coefficients: int
    n_sets: int
    roots: NDArray[np.int32]


def make_geometry(shape: tuple[int, int], n_transforms: int) -> Geometry:
    """Return the geometry of a field transformed `n_transforms` times."""
    width = shape[1] + 2
    table = np.zeros(((shape[0] + 2) * width, 4), dtype=np.int32)
    table[:, (_BAND, _CHILD)] = -1
    sizes = np.array(level_shapes(shape, n_transforms), dtype=np.int64)
    low = sizes[-1]
    n_coefficients = int(shape[0]) * int(shape[1]) - int(low[0]) * int(low[1])
    roots = np.empty(n_coefficients, dtype=np.int32)
    n_roots, n_sets = _fill_geometry(sizes, width, table, roots)
    return Geometry(table, width, n_coefficients, n_sets, roots[:n_roots].copy())


@kernel
def _band_origin(sizes, transform, band):
    """Return first row, first column, rows and columns of a band."""
    row = sizes[transform + 1, 0] if band >> 1 else 0
    col = sizes[transform + 1, 1] if band & 1 else 0
    n_rows = sizes[transform, 0] - row if band >> 1 else sizes[transform + 1, 0]
    n_cols = sizes[transform, 1] - col if band & 1 else sizes[transform + 1, 1]
    return row, col, n_rows, n_cols


@kernel
def _fill_geometry(sizes, width, table, roots):
    """Fill `table` and `roots`; return the numbers of roots and of sets."""
    n_transforms = sizes.shape[0] - 1
    n_roots = n_sets = 0
    for transform in range(n_transforms - 1, -1, -1):
        for band in range(1, 4):
            row, col, n_rows, n_cols = _band_origin(sizes, transform, band)
            above_rows = above_cols = below_rows = below_cols = 0
            above_row = above_col = below_row = below_col = 0
            if transform + 1 < n_transforms:
                above_row, above_col, above_rows, above_cols = _band_origin(
                    sizes, transform + 1, band
                )
            if transform > 0:
                below_row, below_col, below_rows, below_cols = _band_origin(
                    sizes, transform - 1, band
                )
            for i in range(n_rows):
                for j in range(n_cols):
                    place = (row + i + 1) * width + col + j + 1
                    table[place, _BAND] = 3 * transform + band - 1
                    if (i >> 1) < above_rows and (j >> 1) < above_cols:
                        parent = (above_row + (i >> 1) + 1) * width + above_col + (j >> 1) + 1
                        table[place, _PARENT] = parent
                    else:
                        roots[n_roots] = place
                        n_roots += 1
                    if 2 * i < below_rows and 2 * j < below_cols:
                        n_sets += 1
                        child = (below_row + 2 * i + 1) * width + below_col + 2 * j + 1
                        table[place, _CHILD] = child
                        single = 1 if 2 * i + 1 >= below_rows else 0
                        table[place, _SINGLE] = single + (2 if 2 * j + 1 >= below_cols else 0)
    return n_roots, n_sets


class Walk(NamedTuple):
    """Arrays of one traversal besides its state.

    `known` are the bits of magnitudes coded so far and `signs` their signs; `sets` the flags of D
    and L. The lists: insignificant `pixels`, `entries` (a set's position times two, plus one for
    type B), `significant` pixels.
    """

    trace: NDArray[np.uint8]
    table: NDArray[np.int32]
    width: int
    known: NDArray[np.int64]
    signs: NDArray[np.int8]
    sets: NDArray[np.uint8]
    pixels: NDArray[np.int32]
    entries: NDArray[np.int32]
    significant: NDArray[np.int32]


class Goal(NamedTuple):
    """Coefficients to encode.

    `values` are the shifted coefficients and `tops` the highest bits of each coefficient, its D and
    its L (-1: zero). ``ends[plane]`` becomes the number of bytes that decode all planes down to
    `plane`.
    """

    values: NDArray[np.int64]
    tops: NDArray[np.int8]
    ends: NDArray[np.int64]


# One decision


@kernel
def _decide(coder, walk, index, bit):
    """Code one decision with ``models[index]``; return it.

    A decoder of a cut stream stops for good before the first decision that needs a byte past the
    end, and returns 0 for it.
    """
    state, stream, models, is_encoder = coder
    if is_encoder is None:
        if state[IS_CUT] and state[BYTE_POS] > stream.shape[0]:
            state[IS_STOPPED] = 1
        if state[IS_STOPPED]:
            return np.int64(0)
    bit, at = code_step(take_out(state), state, stream, models, is_encoder, index, bit)
    put_back(at, state)
    count = state[N_DECISIONS]
    if count < walk.trace.shape[0]:
        walk.trace[count] = bit
    state[N_DECISIONS] = count + 1
    return bit


@kernel
def _n_bytes_decided(state):
    """Return the number of bytes of an encoder's stream that decode all its decisions so far."""
    return n_bytes_begun(state) + 4


# Contexts


@kernel
def _shift_of(band):
    """Return the number of bits by which coefficients of a band are shifted."""
    transform = band // 3
    return max(transform - 1, 0) if band % 3 == 2 else transform


@kernel
def _class_of(band):
    """Return the class of models of a band."""
    return min(band // 3, _N_DEPTHS - 1) * 3 + band % 3


@kernel
def _units(known, place, plane):
    """Return the known magnitude at `place` in units of 2^plane, at most `_MAX_UNITS`."""
    return min(known[place] >> plane, _MAX_UNITS)


@kernel
def _neighbourhood(walk, place, plane):
    """Return the bin of known magnitudes around: twice W, E, N, S and parent, and diagonals."""
    known, width = walk.known, walk.width
    near = (
        _units(known, place - 1, plane)
        + _units(known, place + 1, plane)
        + _units(known, place - width, plane)
        + _units(known, place + width, plane)
        + _units(known, walk.table[place, _PARENT], plane)
    )
    diagonal = (
        _units(known, place - width - 1, plane)
        + _units(known, place - width + 1, plane)
        + _units(known, place + width - 1, plane)
        + _units(known, place + width + 1, plane)
    )
    return _BINS[min(2 * near + diagonal, _LAST_BIN_AT)]


@kernel
def _set_neighbours(walk, place, flag):
    """Return how many of the eight neighbours have a set known to be significant."""
    count = 0
    for row in range(-1, 2):
        for col in range(-1, 2):
            if walk.sets[place + row * walk.width + col] & flag:
                count += 1
    return min(count, _SET_BINS - 1)


@kernel
def _sign_model(walk, place, band):
    """Return the model of a sign: the band and the signs of W and E, N and S."""
    signs, width = walk.signs, walk.width
    across = min(max(signs[place - 1] + signs[place + 1], -1), 1)
    down = min(max(signs[place - width] + signs[place + width], -1), 1)
    return _SIGN_MODELS + 9 * (band % 3) + 3 * (across + 1) + down + 1


@kernel
def _children(table, place):
    """Return the first child of `place` and the numbers of rows and columns of children."""
    single = table[place, _SINGLE]
    return table[place, _CHILD], 1 if single & 1 else 2, 1 if single & 2 else 2


@kernel
def _n_significant_children(walk, place):
    child, n_rows, n_cols = _children(walk.table, place)
    count = 0
    for row in range(n_rows):
        for col in range(n_cols):
            if walk.known[child + row * walk.width + col]:
                count += 1
    return count


# The traversal


@kernel
def _code_pixel(coder, walk, goal, plane, place, first_model):
    """Code whether a coefficient is significant, and its sign if so; return whether it is."""
    state = coder.state
    value = np.int64(0)
    if goal is not None:
        value = goal.values[place]
    index = first_model + _neighbourhood(walk, place, plane)
    if not _decide(coder, walk, index, np.int64(abs(value) >> plane != 0)):
        return False
    index = _sign_model(walk, place, walk.table[place, _BAND])
    is_negative = _decide(coder, walk, index, np.int64(value < 0))
    if state[IS_STOPPED]:
        return False
    walk.known[place] = np.int64(1) << plane
    walk.signs[place] = -1 if is_negative else 1
    walk.significant[state[N_SIGNIFICANT]] = place
    state[N_SIGNIFICANT] += 1
    return True


@kernel
def _sort_pixels(coder, walk, goal, plane):
    """Move newly significant pixels to the list of significant ones."""
    state = coder.state
    n_kept = 0
    for at in range(state[N_PIXELS]):
        place = np.int64(walk.pixels[at])
        band = walk.table[place, _BAND]
        if _shift_of(band) > plane:
            continue  # all its bits are coded: it is zero
        first_model = _PIXEL_MODELS + _class_of(band) * _N_BINS
        if state[IS_STOPPED] or not _code_pixel(coder, walk, goal, plane, place, first_model):
            walk.pixels[n_kept] = place
            n_kept += 1
    state[N_PIXELS] = n_kept


@kernel
def _open_d(coder, walk, goal, plane, place):
    """Code the children of a D that became significant."""
    state = coder.state
    child, n_rows, n_cols = _children(walk.table, place)
    n_significant = 0
    for row in range(n_rows):
        for col in range(n_cols):
            here = np.int64(child + row * walk.width + col)
            band = walk.table[here, _BAND]
            first = _CHILD_MODELS + (2 * _class_of(band) + min(n_significant, 1)) * _N_BINS
            is_coded = _shift_of(band) <= plane and not state[IS_STOPPED]
            if is_coded and _code_pixel(coder, walk, goal, plane, here, first):
                n_significant += 1
            else:
                walk.pixels[state[N_PIXELS]] = here
                state[N_PIXELS] += 1


@kernel
def _open_l(walk, place, n_entries):
    """Append the D of the children of an L that became significant; return the new length."""
    child, n_rows, n_cols = _children(walk.table, place)
    for row in range(n_rows):
        for col in range(n_cols):
            here = child + row * walk.width + col
            if walk.table[here, _CHILD] >= 0:
                walk.entries[n_entries] = 2 * here
                n_entries += 1
    return n_entries


@kernel
def _decide_set(coder, walk, goal, plane, place, is_l):
    """Code whether a set is significant."""
    class_ = _class_of(walk.table[place, _BAND])
    bit = np.int64(0)
    if goal is not None:
        bit = np.int64(goal.tops[place, 1 + is_l] >= plane)
    if is_l:
        context = 5 * class_ + _n_significant_children(walk, place)
        index = _L_MODELS + context * _SET_BINS + _set_neighbours(walk, place, _L_KNOWN)
    else:
        context = 4 * class_ + min(walk.known[place] >> plane, 3)
        index = _D_MODELS + context * _SET_BINS + _set_neighbours(walk, place, _D_KNOWN)
    return _decide(coder, walk, index, bit)


@kernel
def _sort_sets(coder, walk, goal, plane):
    """Open the sets that become significant, and then the sets that these contain."""
    state = coder.state
    n_kept = at = 0
    n_entries = state[N_ENTRIES]
    while at < n_entries:
        entry = np.int64(walk.entries[at])
        at += 1
        place, is_l = entry >> 1, entry & 1
        if state[IS_STOPPED] or not _decide_set(coder, walk, goal, plane, place, is_l):
            walk.entries[n_kept] = entry
            n_kept += 1
        elif is_l:
            walk.sets[place] |= _L_KNOWN
            n_entries = _open_l(walk, place, n_entries)
        else:
            walk.sets[place] |= _D_KNOWN
            _open_d(coder, walk, goal, plane, place)
            # Of all children the first has the most descendants.
            if walk.table[walk.table[place, _CHILD], _CHILD] >= 0:
                walk.entries[n_entries] = 2 * place + 1
                n_entries += 1
    state[N_ENTRIES] = n_kept


@kernel
def _refine(coder, walk, goal, plane, n_old):
    """Code one more bit of the first `n_old` significant pixels; N_REFINED counts them."""
    state = coder.state
    for at in range(n_old):
        state[N_REFINED] = at
        place = np.int64(walk.significant[at])
        if _shift_of(walk.table[place, _BAND]) > plane:
            continue
        so_far = walk.known[place] >> (plane + 1)
        age = 0 if so_far == 1 else (1 if so_far < 4 else 2)
        index = _REFINE_MODELS + age * _N_BINS + _neighbourhood(walk, place, plane)
        bit = np.int64(0)
        if goal is not None:
            bit = (abs(goal.values[place]) >> plane) & 1
        bit = _decide(coder, walk, index, bit)
        if state[IS_STOPPED]:
            return
        walk.known[place] += bit << plane
    state[N_REFINED] = n_old


@kernel
def _code_planes(coder, walk, goal, n_planes):
    """Encode the planes of `goal` from `n_planes` - 1 down, or decode them if it is None.

    Return (plane, old pixels) where it stopped.
    """
    state = coder.state
    n_old = state[N_SIGNIFICANT]
    for plane in range(n_planes - 1, -1, -1):
        n_old = state[N_SIGNIFICANT]
        state[N_REFINED] = 0
        _sort_pixels(coder, walk, goal, plane)
        _sort_sets(coder, walk, goal, plane)
        if not state[IS_STOPPED]:
            _refine(coder, walk, goal, plane, n_old)
        if state[IS_STOPPED]:
            return plane, n_old
        if goal is not None:
            goal.ends[plane] = _n_bytes_decided(state)
        elif not state[IS_CUT] and state[BYTE_POS] > coder.stream.shape[0] + 4:
            return plane, n_old  # `finish_decoder` reports it
    return np.int64(0), n_old


@kernel
def _guess_values(state, walk, plane, n_old, values):
    """Fill `values` with the best estimate of each coefficient, unshifted."""
    for at in range(state[N_SIGNIFICANT]):
        place = walk.significant[at]
        shift = _shift_of(walk.table[place, _BAND])
        # Old pixels after the last refined one lack this plane's bit.
        n_bits = plane + 1 if state[N_REFINED] <= at < n_old else plane
        rest = (_REST_NUM << n_bits) >> _REST_BITS if n_bits > shift else 0
        magnitude = min((walk.known[place] + rest) >> shift, _MAX_MAGNITUDE)
        values[place] = np.int64(walk.signs[place]) * magnitude


@kernel
def _fill_goal(table, values, tops):
    """Shift coefficients by their bands' shifts, and fill their tops.

    Positions without a coefficient become 0.
    """
    for place in range(values.shape[0]):
        band = table[place, _BAND]
        values[place] = 0 if band < 0 else values[place] << _shift_of(band)
        value = abs(values[place])
        top = -1
        while value >> (top + 1):
            top += 1
        tops[place, 0] = top


@kernel
def _fill_set_tops(table, width, transform, n_rows, n_cols, tops):
    """Fill the tops of D and L of a transform's coefficients, within `n_rows` and `n_cols`.

    The tops of the finer transforms must be filled already.
    """
    for row in range(n_rows):
        for col in range(n_cols):
            place = (row + 1) * width + col + 1
            if table[place, _BAND] // 3 != transform or table[place, _CHILD] < 0:
                continue
            child, child_rows, child_cols = _children(table, place)
            d_top = l_top = np.int64(-1)
            for i in range(child_rows):
                for j in range(child_cols):
                    here = child + i * width + j
                    l_top = max(l_top, np.int64(tops[here, 1]))
                    d_top = max(d_top, np.int64(tops[here, 0]))
            tops[place, 1] = max(d_top, l_top)
            tops[place, 2] = l_top


# Fields


class CodedField(NamedTuple):
    """A coded field: the stream, its number of planes, and where it can be cut.

    ``ends[plane]`` bytes decode all planes down to `plane`.
    """

    stream: bytes
    n_planes: int
    ends: NDArray[np.int64]
    n_decisions: int


@lru_cache(maxsize=8)
def geometry_of(shape: tuple[int, int], n_transforms: int) -> Geometry:
    """Return `make_geometry`'s result, cached for the next field of that shape."""
    return make_geometry(shape, n_transforms)


def encode_field(
    field: NDArray[np.int64],
    n_transforms: int,
    trace: NDArray[np.uint8] | None = None,
) -> CodedField:
    """Return the bit planes of a transformed field, without its LL band.

    Parameters
    ----------
    field : ndarray of int64, shape (n_rows, n_cols)
        As `forward_transform` leaves it; magnitudes below 2^34.
    trace : ndarray of uint8, optional
        Receives the decisions, as many as fit.
    """
    geometry = geometry_of(field.shape, n_transforms)
    n_places = geometry.table.shape[0]
    goal = Goal(
        np.zeros(n_places, dtype=np.int64),
        np.full((n_places, 3), -1, dtype=np.int8),
        np.zeros(MAX_PLANES, dtype=np.int64),
    )
    _inner(goal.values, field.shape)[:] = field
    _fill_goal(geometry.table, goal.values, goal.tops)
    for transform, (n_rows, n_cols) in enumerate(level_shapes(field.shape, n_transforms)[:-1]):
        _fill_set_tops(geometry.table, geometry.width, transform, n_rows, n_cols, goal.tops)
    n_planes = int(goal.tops[:, 0].max(initial=-1)) + 1
    state, walk = _start(geometry, trace)
    reset_encoder(state)
    stream = _stream_for(field)
    _code_planes(Coder(state, stream, new_models(N_SPIHT_MODELS), True), walk, goal, n_planes)
    n_decisions = int(state[N_DECISIONS])
    n_bytes = int(finish_encoder(state, stream))
    if n_bytes > stream.shape[0]:
        raise AssertionError(f"a stream of {n_bytes} bytes is longer than was thought possible")
    ends = np.minimum(goal.ends[:n_planes], n_bytes)
    return CodedField(stream[:n_bytes].tobytes(), n_planes, ends, n_decisions)


def decode_field(
    stream: bytes, n_planes: int, shape: tuple[int, int], n_transforms: int, *, is_cut: bool
) -> NDArray[np.int64]:
    """Return the field of `encode_field`; zeros in its LL band.

    Parameters
    ----------
    is_cut : bool
        `stream` may be any prefix: missing bits are estimated.
    """
    geometry = geometry_of(shape, n_transforms)
    # A writable copy, because numba infers the types of encoder branches as well.
    data = np.frombuffer(stream, dtype=np.uint8).copy()
    state, walk = _start(geometry)
    state[IS_CUT] = is_cut
    start_decoder(state, data)
    coder = Coder(state, data, new_models(N_SPIHT_MODELS), None)
    plane, n_old = _code_planes(coder, walk, None, n_planes)
    if not is_cut:
        raise_for_status(*finish_decoder(state, data))
    values = np.zeros(geometry.table.shape[0], dtype=np.int64)
    _guess_values(state, walk, plane, n_old, values)
    return _inner(values, shape).copy()


def _inner(values: NDArray[np.int64], shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the field inside the frame of flat `values`; a view."""
    return values.reshape(shape[0] + 2, shape[1] + 2)[1:-1, 1:-1]


def _stream_for(field: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return an array for the stream of a field: no decision takes more than 16 bits."""
    n_bits = int(np.abs(field).max(initial=0)).bit_length() + 2
    return np.empty(4096 + 4 * field.size * n_bits, dtype=np.uint8)


def _start(
    geometry: Geometry, trace: NDArray[np.uint8] | None = None
) -> tuple[NDArray[np.int64], Walk]:
    """Return the initial state and arrays of a traversal."""
    n_places = geometry.table.shape[0]
    walk = Walk(
        trace=np.empty(0, dtype=np.uint8) if trace is None else trace,
        table=geometry.table,
        width=geometry.width,
        known=np.zeros(n_places, dtype=np.int64),
        signs=np.zeros(n_places, dtype=np.int8),
        sets=np.zeros(n_places, dtype=np.uint8),
        pixels=np.empty(geometry.n_coefficients, dtype=np.int32),
        entries=np.empty(2 * geometry.n_sets, dtype=np.int32),
        significant=np.empty(geometry.n_coefficients, dtype=np.int32),
    )
    state = np.zeros(WALK_STATE_SIZE, dtype=np.int64)
    roots = geometry.roots
    walk.pixels[: roots.size] = roots
    with_sets = roots[geometry.table[roots, _CHILD] >= 0]
    walk.entries[: with_sets.size] = 2 * with_sets
    state[N_PIXELS], state[N_ENTRIES] = roots.size, with_sets.size
    return state, walk
