"""Masks and the payload wrapper (docs/FORMAT.md §2.3, §5)."""

import numpy as np

from terrainwave.reference import range_coder
from terrainwave.reference.basics import (
    ceil_div,
    clamp,
    inflate,
    read_varint,
    require,
    tables,
    zeros,
)
from terrainwave.reference.cdf97 import decode_cdf97
from terrainwave.reference.files import DTYPES, METHODS
from terrainwave.reference.range_coder import Models
from terrainwave.reference.rapid import decode_rapid
from terrainwave.reference.store import decode_store

MASK_SAMPLES, MASK_GROUPS = tables("masks.bin", ("H", 16, 49), ("H", 7, 13))  # §5.2
DECODERS = {"store": decode_store, "cdf97": decode_cdf97, "rapid": decode_rapid}


def implied_void(unit, parent_unit, parent_valid):
    """Return the samples of the region that a void parent sample touches (§5.1)."""
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


class Bits:
    """The bits of a mask section (§5.2)."""

    def __init__(self, section):
        n_states = 4 if section[0] & 128 else 1
        first = 1
        if section[0] // 16 % 8 == 7:
            first += 62
            require(section[0] % 16 == 0, "sets of a mask")
            self.ones = [16 * byte + 8 for byte in section[1:first]]
        else:
            self.ones = MASK_SAMPLES[section[0] % 16] + MASK_GROUPS[section[0] // 16 % 8]
        rest = section[first + 4 * n_states :]
        is_whole = len(section) >= first + 4 * n_states and len(rest) % 2 == 0
        require(is_whole, "length of a mask")
        at = [first + 4 * k for k in range(n_states)]
        self.states = [int.from_bytes(section[k : k + 4], "little") for k in at]
        self.words = [int.from_bytes(rest[k : k + 2], "little") for k in range(0, len(rest), 2)]
        self.n_read = self.at = 0

    def read(self, model):
        """Return the next bit."""
        k = self.n_read % len(self.states)
        ones, state = self.ones[model], self.states[k]
        bit = int(state % 4096 < ones)
        own, first = (ones, 0) if bit else (4096 - ones, ones)
        state = own * (state // 4096) + state % 4096 - first
        if state < 65536:
            require(self.at < len(self.words), "end of a mask")
            state = state * 65536 + self.words[self.at]
            self.at += 1
        self.states[k] = state
        self.n_read += 1
        return bit

    def end(self):
        """Raise unless this is the end."""
        is_end = self.at == len(self.words) and set(self.states) == {65536}
        require(is_end, "end of a mask")


def decode_plane(bits, plane, own, implied, rows, cols, near):
    """Read the samples of a plane of a lattice into `own` (§5.2); `near`: own bits of a place."""
    contexts = {}
    for r in rows:
        for c in cols:
            if not implied[r][c]:
                contexts[r, c] = sum(bit << k for k, bit in enumerate(near(r, c)))
    groups = [
        [(r, c) for c in cols[k : k + 32] if (r, c) in contexts]
        for r in rows
        for k in range(0, len(cols), 32)
    ]
    sizes = [len(cols[k : k + 32]) for _ in rows for k in range(0, len(cols), 32)]
    coded = []
    for group, size in zip(groups, sizes, strict=True):
        alike = [at for at in group if contexts[at] in (0, 15)]
        is_mixed = len(alike) < len(group)
        is_open = 0
        if alike:
            kind = 3 if len(alike) >= 16 else 2
            if not is_mixed:
                kind = (
                    0 if all(contexts[at] == 15 for at in alike) and size == 32 == len(alike) else 1
                )
            is_open = bits.read(50 + 4 * plane + kind)
        coded += [at for at in group if is_open or at not in alike]
        for r, c in alike:
            own[r][c] = contexts[r, c] // 15
    for r, c in coded:
        own[r][c] = bits.read(16 * plane + contexts[r, c])


def decode_lattice(bits, rows, cols, own, implied, above):
    """Read the samples of a lattice between those of the level above (§5.2).

    `rows` and `cols` are the numbers of its first ones and how many there are; ``above(i, j)`` says
    whether sample (i, j) of the level above is own.
    """
    (row0, n_rows), (col0, n_cols) = rows, cols
    odd_rows = [r for r in range(n_rows) if (row0 + r) % 2]
    odd_cols = [c for c in range(n_cols) if (col0 + c) % 2]
    even_rows = [r for r in range(n_rows) if (row0 + r) % 2 == 0]
    even_cols = [c for c in range(n_cols) if (col0 + c) % 2 == 0]
    for r in even_rows:
        for c in even_cols:
            own[r][c] = above((row0 + r) // 2, (col0 + c) // 2)

    def near_hh(r, c):
        i, j = (row0 + r) // 2, (col0 + c) // 2
        return [above(i, j), above(i, j + 1), above(i + 1, j), above(i + 1, j + 1)]

    def near_hl(r, c):
        i, j = (row0 + r) // 2, (col0 + c) // 2
        sides = [above(i, j), above(i, j + 1)]
        if not odd_rows:
            return sides + sides
        up = [k if 0 <= k < n_rows else 2 * r - k for k in (r - 1, r + 1)]
        return sides + [own[k][c] for k in up]

    def near_lh(r, c):
        i, j = (row0 + r) // 2, (col0 + c) // 2
        sides = [above(i, j), above(i + 1, j)]
        if not odd_cols:
            return sides + sides
        beside = [k if 0 <= k < n_cols else 2 * c - k for k in (c - 1, c + 1)]
        return sides + [own[r][k] for k in beside]

    decode_plane(bits, 0, own, implied, odd_rows, odd_cols, near_hh)
    decode_plane(bits, 1, own, implied, even_rows, odd_cols, near_hl)
    decode_plane(bits, 2, own, implied, odd_rows, even_cols, near_lh)


def decode_root(bits, n_rows, n_cols):
    """Return the own samples of a root block (§5.2)."""
    own = [[bits.read(48)]]
    shift = max(n_rows - 1, n_cols - 1).bit_length()
    for k in reversed(range(shift)):
        coarse, rows, cols = own, ((n_rows - 1) >> k) + 1, ((n_cols - 1) >> k) + 1
        own = zeros(rows, cols)

        def above(i, j, coarse=coarse):
            return coarse[min(i, len(coarse) - 1)][min(j, len(coarse[0]) - 1)]

        decode_lattice(bits, (0, rows), (0, cols), own, zeros(rows, cols), above)
    return own


def decode_valid(file, unit, section, parent_unit, parent_valid):
    """Return the mask of a unit, of its section or None; sets its own samples (§5.2)."""
    n_rows, n_cols = unit.rows.n, unit.cols.n
    implied = implied_void(unit, parent_unit, parent_valid)
    places = [(r, c) for r in range(n_rows) for c in range(n_cols)]
    own = [[int(not is_void) for is_void in row] for row in implied]
    bits = section and Bits(section)

    def above(i, j):
        rows, cols = parent_unit.rows, parent_unit.cols
        i, j = clamp(i, rows.first, rows.last), clamp(j, cols.first, cols.last)
        return int(parent_unit.own[i - rows.first][j - cols.first])

    if parent_unit is None:
        own = decode_root(bits, n_rows, n_cols) if section else own
    elif section:
        own = zeros(n_rows, n_cols)
        ends = (unit.rows.first, n_rows), (unit.cols.first, n_cols)
        decode_lattice(bits, *ends, own, implied, above)
    else:
        for r, c in places:
            row, col = unit.rows.first + r, unit.cols.first + c
            if row % 2 == 0 and col % 2 == 0:
                own[r][c] = above(row // 2, col // 2)
    unit.own = valid = own
    if unit.level < file.grid.k_max:
        valid = zeros(n_rows, n_cols)
        for r, c in places:
            near = [row[max(c - 1, 0) : c + 2] for row in own[max(r - 1, 0) : r + 2]]
            if not implied[r][c]:
                valid[r][c] = 1 if any(map(any, near)) or not section else bits.read(49)
    if section:
        bits.end()
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
    known = 2 | h.features & 1 | (4 if may_have_remainders else 0) | h.features & 8
    require(not flags & ~known, "flags of a payload")
    sections = [None] * 4
    for bit in range(4):
        if flags >> bit & 1:
            n, at = read_varint(payload, at)
            require(1 <= n <= len(payload) - at, "length of a section")
            sections[bit] = payload[at : at + n]
            at += n
    mask, exceptions, rest, corrections = sections
    valid = decode_valid(file, unit, mask, parent_unit, parent_valid)
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
    """Return the nodata value as a number of the file's dtype; None without one."""
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
