"""Method rapid (docs/format-rapid.md, whose sections are cited as R.n)."""

from bisect import bisect_right
from functools import cache

from terrainwave.reference.basics import (
    ceil_div,
    clamp,
    corrected,
    fold,
    read_varint,
    require,
    zeros,
)
from terrainwave.reference.rapid_tables import CORE, ESCAPE, TAPS

PARITY = {"HH": (1, 1), "HL": (0, 1), "LH": (1, 0)}
GOES_ON = 63  # R.9
# R.7: where ranges are read; bends are at the core's places of A, details at these.
RANGES = {"HH": [(0, 0)], "HL": [(0, 0), (-1, 0)], "LH": [(0, 0), (0, -1)]}
DETAILS = {"HH": [], "HL": CORE["HL"][2:], "LH": CORE["LH"][2:] + TAPS["LH"][-4:]}


class Band:
    """States, words and raw bits."""

    def __init__(self, states, words, raw):
        self.states, self.words, self.n_raw = states, words[::-1], len(raw)
        self.bits, self.n_used = int.from_bytes(raw, "little"), 0

    def symbols(self, entries):
        """Read a list; None stands for *none* (R.8)."""
        found = [None] * len(entries)
        for k, entry in enumerate(entries):
            if entry is not None:
                (f, below), i = entry, k % len(self.states)
                x = self.states[i]
                y = found[k] = bisect_right(below, x % 4096) - 1
                x = f[y] * (x >> 12) + x % 4096 - below[y]
                if x < 65536:
                    require(self.words, "words of a band end early")
                    x = x << 16 | self.words.pop()
                self.states[i] = x
        return found

    def raw(self, n):
        self.n_used += n
        require(self.n_used <= 8 * self.n_raw, "raw bits of a band end early")
        return self.bits >> (self.n_used - n) & ((1 << n) - 1)

    def large(self):
        """R.9, step 4."""
        g = self.raw(5)
        h = self.raw(g + 1)
        u = (1 << g) - 1 + (h >> 1) + 32
        return -u if h & 1 else u

    def end(self):
        """R.1."""
        require(not self.words, "words of a band are left over")
        require(all(x == 65536 for x in self.states), "states at the end of a band")
        require(ceil_div(self.n_used, 8) == self.n_raw, "raw bits of a band are left over")
        require(self.bits >> self.n_used == 0, "filling of raw bits")


def read_payload(payload, n, is_root):
    """Return narrow, s, k and the bands (R.1)."""
    rest = payload

    def take(width, count):
        nonlocal rest
        part, rest = rest[: width * count], rest[width * count :]
        require(len(part) == width * count, "payload of rapid is cut off")
        return [int.from_bytes(part[i : i + width], "little") for i in range(0, len(part), width)]

    def varint():
        nonlocal rest
        number, end = read_varint(rest, 0)
        rest = rest[end:]
        return number

    flags = take(1, 1)[0]
    is_narrow, n_bands = flags & 1, (flags >> 3 & 3) + 1
    require(flags < 64 and flags >> 1 & 3 < 3, "flags of rapid")
    require(not is_narrow or n <= 8191, "narrow with a large step")
    require(not is_root or n_bands == 1, "bands of a root block")
    shift = 0 if is_narrow else take(1, 1)[0]
    require(shift <= 30, "shift of levels")
    v = varint() if flags & 32 else 0
    sizes = [(varint(), varint()) for _ in range(n_bands)]
    n_states = (1, 8, 32)[flags >> 1 & 3]
    bands = [Band(take(4, n_states), take(2, words), take(1, raw)) for words, raw in sizes]
    require(all(x >= 65536 for band in bands for x in band.states), "states of a band")
    require(not rest, "bytes after the bands")
    return is_narrow, shift, -(v >> 1) - 1 if v & 1 else v >> 1, bands


class Lattice:
    """The core's samples on multiples of a stride."""

    def __init__(self, unit, stride, heights, valid, tables):
        self.unit, self.stride, self.tables = unit, stride, tables
        self.heights, self.valid = heights, valid
        self.n_rows, self.n_cols = ((axis.n - 1) // stride + 1 for axis in (unit.rows, unit.cols))
        self.sizes = {
            p: ((self.n_rows + 1 - a) // 2, (self.n_cols + 1 - b) // 2)
            for p, (a, b) in PARITY.items()
        }
        self.a = [[unit.level_of(z) for z in row[:: 2 * stride]] for row in heights[:: 2 * stride]]
        self.levels, self.details, self.near = {}, {}, {}  # by plane and place
        self.class_ = clamp(tables.level - unit.level + stride.bit_length() - 1, 0, 3)  # R.2
        self.range, self.bend, self.weights = map(cache, (self.range, self.bend, self.weights))

    def place(self, plane, i, j):
        return tuple((2 * k + odd) * self.stride for k, odd in zip((i, j), PARITY[plane]))

    def is_valid(self, plane, i, j):
        row, col = self.place(plane, i, j)
        return self.valid[row][col]

    def level(self, plane, i, j):
        """R.5."""
        n_rows, n_cols = self.sizes.get(plane, (0, 0))
        if n_rows and n_cols:
            return self.levels[plane, clamp(i, 0, n_rows - 1), clamp(j, 0, n_cols - 1)]
        return self.a[fold(2 * i, self.n_rows) // 2][fold(2 * j, self.n_cols) // 2]

    def range(self, i, j):
        """R.7."""
        four = [self.level("A", i + r, j + c) for r in (0, 1) for c in (0, 1)]
        return max(four) - min(four)

    def bend(self, i, j):
        """R.7."""
        a, w, e, n, s = (
            self.level("A", i + r, j + c) for r, c in ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
        )
        return min(abs(w + e - 2 * a) + abs(n + s - 2 * a), 8191)

    def weights(self, plane):
        """Return v_0 … v_3 and e (R.7)."""
        n, s, e = self.unit.n, self.unit.shift, 16
        c, r, b, g, *_ = self.tables.weights[self.class_][plane]
        while e > 0 and (max(r, b) << (s + e)) // n >= 32768:
            e -= 1
        v1, v2 = (min(((w << (s + e)) // n) >> 2, 8191) for w in (r, b))
        return (c >> 2) + 1, v1, v2, min(g >> 2, 32767), e

    def expected(self, plane, i, j, first):
        """Return E (R.7); `first` is the first row of the band."""
        v0, v1, v2, v3, e = self.weights(plane)
        ranges = sum(self.range(i + r, j + c) for r, c in RANGES[plane])
        bends = sum(self.bend(i + r, j + c) for p, r, c in CORE[plane] if p == "A")
        places = [(p, i + r, j + c) for p, r, c in DETAILS[plane] if i + r >= first]
        near = sum(self.near.get(place, 0) for place in places)
        return ((v1 * ranges + v2 * bends) >> e) + v3 * near + v0

    def read_details(self, bands):
        """R.9."""
        n = ceil_div(max(self.sizes["HL"][0], self.sizes["LH"][0] + 1), 8)
        for k, band in enumerate(bands):
            first, end = k * n // len(bands), (k + 1) * n // len(bands)
            for strip in range(first, end):
                for plane, (n_rows, n_cols) in self.sizes.items():
                    begin = 8 * strip - (plane == "LH")
                    if n_cols:
                        rows = range(max(begin, 0), min(begin + 8, n_rows))
                        self.read_batch(band, plane, rows, 8 * first)

    def read_batch(self, band, plane, rows, first):
        """R.9."""
        n_cols, tables = self.sizes[plane][1], self.tables
        entries, joint, split = [], [], []
        for i in rows:
            e = [self.expected(plane, i, j, first) for j in range(n_cols)]
            valid = [self.is_valid(plane, i, j) for j in range(n_cols)]
            e, valid = [*e, e[-1]], [*valid, False]
            for j in range(0, n_cols, 2):
                class_ = class_of(max((e[j] >> 1) + (e[j + 1] >> 1), 1))
                if not valid[j] and not valid[j + 1]:
                    entries.append(None)
                elif class_ < tables.cut:
                    joint.append((i, j, len(entries)))
                    entries.append(tables.pairs[class_])
                else:
                    for k in (j, j + 1):
                        class_ = class_of(e[k])
                        if valid[k]:
                            split.append((i, k, len(entries), max(class_ - 32, 0) >> 1))
                        entries.append(tables.samples[class_] if valid[k] else None)

        def put(i, j, d, is_clamped):
            unit = self.unit
            reach = unit.z_max - unit.z_min + (1 << unit.shift)
            limit = min(reach // unit.n + 1, 2**31 - 1)
            self.details[plane, i, j] = d = clamp(d, -limit, limit) if is_clamped else d
            if j < n_cols:
                self.near[plane, i, j] = min(abs(d), 4095)

        symbols, escaped = band.symbols(entries), []  # 1.
        for i, j, k in joint:
            if symbols[k] == ESCAPE:
                escaped += [(i, j), (i, j + 1)]
            else:
                put(i, j, symbols[k] // 15 - 7, False)
                put(i, j + 1, symbols[k] % 15 - 7, False)
        second = band.symbols([tables.samples[60]] * len(escaped))  # 2.
        low = [band.raw(b) for *_, b in split]  # 3.
        for (i, j, k, b), a in zip(split, low):  # 4.
            goes_on = symbols[k] == GOES_ON
            u = band.large() if goes_on else symbols[k] - 31
            put(i, j, (u << b) + a, b or goes_on)
        for (i, j), y in zip(escaped, second):  # 5.
            put(i, j, band.large() if y == GOES_ON else y - 31, True)

    def predict(self, plane, i, j):
        """Return the prediction and whether it is turned (R.6)."""
        x = {(p, r, c): self.level(p, i + r, j + c) for p, r, c in TAPS[plane]}
        core = [x[tap] for tap in CORE[plane]]
        total = sum(w * v for w, v in zip(self.tables.stencils[self.class_][plane], x.values()))
        p = clamp(total >> 10, 4 * min(core), 4 * max(core))
        return (((p << self.unit.shift) + 2) >> 2) + self.unit.origin, self.turned(p, sum(core))

    def predict_known(self, u, k):
        """Return the same between samples k and k + 1 of a line (R.3)."""
        four = a, b, c, d = [u[fold(i, len(u))] for i in range(k - 1, k + 3)]
        p = clamp((9 * (b + c) - a - d) >> 2, 4 * min(four), 4 * max(four))
        return (p + 2) >> 2, self.turned(p, 2 * (b + c))

    def turned(self, p, total):
        return 4 * ((p + 2) >> 2) > p if self.unit.n <= 3 else p > total

    def make_heights(self, parent):
        """R.3, R.6."""
        unit, (low, high) = self.unit, self.unit.limits
        for plane, (n_rows, n_cols) in self.sizes.items():
            for i, j in ((i, j) for i in range(n_rows) for j in range(n_cols)):
                row, col = place = self.place(plane, i, j)
                if plane == "HL" and is_known(unit.rows, row):
                    height, turned = self.predict_known(parent[i], j)
                elif plane == "LH" and is_known(unit.cols, col):
                    height, turned = self.predict_known([line[j] for line in parent], i)
                else:
                    height, turned = self.predict(plane, i, j)
                q = self.details.get((plane, i, j), 0)
                height = clamp(height + (-q if turned else q) * unit.n, low, high)
                self.heights[row][col] = height = corrected(unit, place, height, low, high)
                self.levels[plane, i, j] = unit.level_of(height)


def is_known(axis, i):
    """Say whether a row or column is on a shared side (R.3)."""
    return (i == 0 and axis.shared[0]) or (i == axis.n - 1 and axis.shared[1])


def class_of(e):
    """R.7."""
    top = e.bit_length() - 1
    return min(2 * top + (e >> (top - 1) & 1 if top else 0), 59)


def decode_rapid(file, unit, payload, valid, parent_unit, parent_heights):
    """Return the heights of the region."""
    z_min, z_max, n = file.header.z_min, file.header.z_max, file.header.step
    require(file.header.border_rings == 1, "aprons of rapid")  # R.2
    is_narrow, s, k, bands = read_payload(payload, n, parent_unit is None)
    o = ((z_min + z_max) >> 1) + (k << (10 + s))
    require(z_min <= o <= z_max, "origin")
    low, high = (max(z_min, o - 8191), min(z_max, o + 8191)) if is_narrow else (z_min, z_max)
    unit.n, unit.shift, unit.origin, unit.limits = n, s, o, (low, high)
    unit.z_min, unit.z_max = z_min, z_max
    unit.level_of = lambda z: clamp((z - o) >> s, -8191, 8191)
    heights, stride = zeros(unit.rows.n, unit.cols.n), 2
    if parent_unit is None:  # R.4
        stride, n_bits = 1, ((high - low) // n).bit_length()
        while stride < max(unit.rows.n, unit.cols.n) - 1:
            stride *= 2
    for r in range(0, unit.rows.n, stride):
        for c in range(0, unit.cols.n, stride):
            if parent_unit is not None:
                heights[r][c] = clamp(parent_heights[r // 2][c // 2], low, high)
                continue
            z = (low + high) >> 1
            if valid[r][c]:
                z = min(low + bands[0].raw(n_bits) * n + (n >> 1), high)
            heights[r][c] = corrected(unit, (r, c), z, low, high)
    while stride > 1:
        stride //= 2
        lattice = Lattice(unit, stride, heights, valid, file.tables)
        lattice.read_details(bands)
        lattice.make_heights(parent_heights)
    for band in bands:
        band.end()
    return heights
