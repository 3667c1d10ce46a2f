"""Masks and the payload wrapper (docs/FORMAT.md §2.3, §5)."""

import numpy as np

from reference_decoder import range_coder
from reference_decoder.basics import (
    ceil_div,
    clamp,
    inflate,
    read_varint,
    require,
    zeros,
)
from reference_decoder.cdf97 import decode_cdf97
from reference_decoder.files import DTYPES, METHODS
from reference_decoder.predictive import decode_predictive
from reference_decoder.range_coder import Models
from reference_decoder.rapid import decode_rapid
from reference_decoder.store import decode_store

DECODERS = {
    "store": decode_store,
    "cdf97": decode_cdf97,
    "predictive": decode_predictive,
    "rapid": decode_rapid,
}


def implied_void(unit, parent_unit, parent_valid):
    """Samples of the region that a void parent sample touches (§5.1)."""
    n_rows, n_cols = unit.rows.n, unit.cols.n
    if parent_unit is None:
        return [[False] * n_cols for _ in range(n_rows)]

    def touching(axis, parent_axis, i):
        place = axis.first + i
        return [
            clamp(p, parent_axis.first, parent_axis.last) - parent_axis.first
            for p in (place // 2, (place + 1) // 2)
        ]

    return [
        [
            not all(
                parent_valid[i][j]
                for i in touching(unit.rows, parent_unit.rows, r)
                for j in touching(unit.cols, parent_unit.cols, c)
            )
            for c in range(n_cols)
        ]
        for r in range(n_rows)
    ]


def known_of_own(unit, parent_unit, implied):
    """Return K of own samples (§5.2): 0 nothing is known, 1 the bit is 0, 2 it is 1."""
    known = [[int(is_void) for is_void in row] for row in implied]
    for r in range(unit.rows.n):
        for c in range(unit.cols.n):
            row, col = unit.rows.first + r, unit.cols.first + c
            if parent_unit is not None and row % 2 == 0 and col % 2 == 0:
                i, j = row // 2 - parent_unit.rows.first, col // 2 - parent_unit.cols.first
                known[r][c] = 2 if parent_unit.own[i][j] else 1
    return known


def known_of_mask(implied, own):
    """Return K of the mask of a level that is not the finest (§5.2)."""
    n_rows, n_cols = len(own), len(own[0])

    def is_beside(r, c):
        return any(
            own[i][j]
            for i in range(max(r - 1, 0), min(r + 2, n_rows))
            for j in range(max(c - 1, 0), min(c + 2, n_cols))
        )

    return [
        [1 if implied[r][c] else 2 * is_beside(r, c) for c in range(n_cols)] for r in range(n_rows)
    ]


def decode_map(section, known):
    """§5.2."""
    n_rows, n_cols = len(known), len(known[0])
    bits = [[0] * n_cols for _ in range(n_rows)]

    def at(grid, i, j):
        return grid[i][j] if 0 <= i < n_rows and 0 <= j < n_cols else 0

    decoder = None if section is None else range_coder.RangeDecoder(section)
    models = Models(1296)
    for i in range(n_rows):
        for j in range(n_cols):
            if known[i][j]:
                bits[i][j] = known[i][j] - 1
            elif decoder is None:
                bits[i][j] = 1
            else:
                model = 0
                for di, dj in ((0, -1), (-1, 0), (-1, -1), (-1, 1)):
                    model = 2 * model + at(bits, i + di, j + dj)
                for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
                    model = 3 * model + at(known, i + di, j + dj)
                bits[i][j] = decoder.bit(models, model)
    if decoder is not None:
        decoder.end()
    return bits


def decode_valid(file, unit, mask, own, parent_unit, parent_valid):
    """Return the mask of a unit, of its sections or None; sets its own samples (§5.2)."""
    implied = implied_void(unit, parent_unit, parent_valid)
    if unit.level == file.grid.k_max:
        valid = unit.own = decode_map(mask, known_of_own(unit, parent_unit, implied))
    else:
        unit.own = decode_map(own, known_of_own(unit, parent_unit, implied))
        valid = decode_map(mask, known_of_mask(implied, unit.own))
    return valid


def decode_payload(file, unit, payload, parent_unit, parent_heights, parent_valid):
    """Return final heights, mask, remainders (None: all are 0) of a unit's region (§5.1)."""
    h = file.header
    n_rows, n_cols = unit.rows.n, unit.cols.n
    if not payload:
        require(h.features & 1, "a unit without a payload in a file without voids")
        unit.own = zeros(n_rows, n_cols)
        return zeros(n_rows, n_cols), zeros(n_rows, n_cols), None
    flags, at = payload[0], 1
    may_have_remainders = h.features & 2 and unit.level == file.grid.k_max
    known = 2 | (4 if may_have_remainders else 0)
    if h.features & 1:
        known |= 1 if unit.level == file.grid.k_max else 9
    known |= 16 if h.features & 8 else 0
    require(not flags & ~known, "flags of a payload")
    sections = [None] * 5
    for bit in range(5):
        if flags >> bit & 1:
            n, at = read_varint(payload, at)
            require(1 <= n <= len(payload) - at, "length of a section")
            sections[bit] = payload[at : at + n]
            at += n
    mask, exceptions, rest, own, corrections = sections
    valid = decode_valid(file, unit, mask, own, parent_unit, parent_valid)
    require(any(map(any, valid)), "payload of a unit without valid samples")
    unit.corrections = corrections and decode_corrections(corrections, unit, h.step)
    decode_method = DECODERS[METHODS[h.method]]
    heights = decode_method(file, unit, payload[at:], valid, parent_unit, parent_heights)
    # 1.
    heights = [[clamp(z, h.z_min, h.z_max) for z in row] for row in heights]
    # 2.
    taken = quanta_of_nodata(file)
    n_met = 0
    if taken:
        a, b = taken
        for r in range(n_rows):
            for c in range(n_cols):
                if valid[r][c] and a <= heights[r][c] <= b:
                    is_down = False
                    if exceptions is not None:
                        require(n_met // 8 < len(exceptions), "length of the exception section")
                        is_down = exceptions[n_met // 8] >> (7 - n_met % 8) & 1
                    heights[r][c] = a - 1 if is_down else b + 1
                    n_met += 1
    if exceptions is not None:
        require(len(exceptions) == ceil_div(n_met, 8), "length of the exception section")
        last = int.from_bytes(exceptions, "big") & ((1 << (-n_met % 8)) - 1)
        require(last == 0, "filling of the exception section")
    return heights, valid, rest and decode_remainders(rest, n_rows, n_cols, h)


def decode_remainders(section, n_rows, n_cols, h):
    """§5.3."""
    width, n = np.dtype(DTYPES[h.dtype]).itemsize, section[0]
    require(1 <= n <= width, "bytes of a remainder")
    data = inflate(section[1:], n * n_rows * n_cols)
    require(len(data) == n * n_rows * n_cols, "length of the remainders")
    remainders = []
    for i in range(n_rows * n_cols):
        number = sum(data[plane * n_rows * n_cols + i] << 8 * plane for plane in range(n))
        remainders.append(-(number + 1 >> 1) if number & 1 else number >> 1)
    return [remainders[r * n_cols : (r + 1) * n_cols] for r in range(n_rows)]


def decode_corrections(section, unit, n):
    """§5.4."""
    n_rows, n_cols = unit.rows.n, unit.cols.n
    decoder, models = range_coder.RangeDecoder(section), Models(170)
    k = max(n.bit_length() - 5, 0)
    found, pieces = zeros(n_rows, n_cols), {}

    def count(*places):
        return sum(0 <= i < n_rows and 0 <= j < n_cols and found[i][j] != 0 for i, j in places)

    for i in range(n_rows):
        p = (unit.rows.first + i) % 2
        for first in range(0, n_cols, 32):
            before = [pieces.get(at, 0) for at in ((i, first - 32), (i - 1, first), (i - 2, first))]
            model = 8 * p + 4 * before[0] + 2 * before[1] + before[2]
            pieces[i, first] = decoder.bit(models, model)
            if not pieces[i, first]:
                continue
            for j in range(first, min(first + 32, n_cols)):
                q = (unit.cols.first + j) % 2
                if unit.key[0] >= 0 and not p and not q:
                    continue
                w, north = count((i, j - 1), (i, j - 2)), count((i - 1, j), (i - 2, j))
                diagonal = count((i - 1, j - 1), (i - 1, j + 1))
                if decoder.bit(models, 16 + 27 * (2 * p + q) + 9 * w + 3 * north + diagonal):
                    sign = -1 if decoder.raw(1) else 1
                    size = decoder.magnitude(models, 124, 138, k) + 1
                    require(size <= 2**31 - 1, "a correction")
                    found[i][j] = sign * size
    decoder.end()
    require(any(map(any, found)), "corrections that are all 0")
    return found


def with_remainder(height, remainder):
    """Return the height whose number in the order of heights is `remainder` more (§5.3)."""
    bits = height.dtype.itemsize * 8
    order = height.view(f"i{height.dtype.itemsize}").item()
    is_float = height.dtype.kind == "f"

    def swapped(b):
        return b if b >= 0 or not is_float else b ^ (2 ** (bits - 1) - 1)

    number = (swapped(order) + remainder + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
    result = np.array(swapped(number), f"i{height.dtype.itemsize}").view(height.dtype)[()]
    require(np.isfinite(result), "a height that is not finite")
    return result


def raw_height(h, k):
    """Return the raw height of quantum number k, in the dtype of the file."""
    dtype = np.dtype(DTYPES[h.dtype])
    p = (h.base + k) * h.quantum_num
    if dtype.kind == "f":
        return dtype.type(float(p) / float(h.quantum_den))
    nearest = p if h.quantum_den == 1 else round(float(p) / float(h.quantum_den))
    limits = np.iinfo(dtype)
    return dtype.type(clamp(nearest, int(limits.min), int(limits.max)))


def nodata_in_dtype(file):
    """Return the nodata value as a number of the file's dtype; None if there is none."""
    nodata = file.metadata.get("nodata")
    if nodata is None:
        return None
    with np.errstate(under="ignore"):
        return np.dtype(DTYPES[file.header.dtype]).type(float(nodata))


def quanta_of_nodata(file):
    """Return the first and last quantum number in [z_min, z_max] that becomes nodata, or None."""
    h, nodata = file.header, nodata_in_dtype(file)
    if nodata is None or nodata != nodata:
        return None

    def first(is_reached):  # by bisection: raw heights never fall
        low, high = h.z_min, h.z_max + 1
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if is_reached(raw_height(h, middle)) else (middle + 1, high)
        return low

    a, b = first(lambda z: z >= nodata), first(lambda z: z > nodata) - 1
    return (a, b) if a <= b else None
