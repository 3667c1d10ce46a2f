"""Method rapid (docs/format-rapid.md, whose sections are cited as R.n)."""

import base64
import zlib
from types import SimpleNamespace

import numpy as np

from reference_decoder import range_coder
from reference_decoder.basics import UnsupportedError, clamp, corrected, read_varint, require, zeros
from reference_decoder.predictive import SharedDecoder, fold
from reference_decoder.range_coder import Models
from terrainwave.codec.rapid import trained as annex

# The annexes (R.10): numbers alone.
from terrainwave.codec.rapid import trained_reach as reach_annex

PLANES = ("HH", "HL", "LH")
PARITY = {"A": (0, 0), "HH": (1, 1), "HL": (0, 1), "LH": (1, 0)}
CODES = [
    np.frombuffer(zlib.decompress(base64.b85decode(codes)), np.uint8).reshape(6, 176, 63).tolist()
    for codes in (annex._CODES, reach_annex._CODES)
]
MEAN, REACH, WEIGHTS = 1, 3, 5


def own(plane):
    return [(plane, -1, -1), (plane, -1, 0), (plane, -1, 1)]


def of(plane, *places):
    return [(plane, row, col) for row, col in places]


# R.6
TAPS = {
    "HH": of("A", *((row, col) for row in (-1, 0, 1, 2) for col in (-1, 0, 1, 2))) + own("HH"),
    "HL": of("A", (0, -1), (0, 0), (0, 1), (0, 2), (-1, 0), (-1, 1), (1, 0), (1, 1))
    + of("HH", (-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 0), (0, 1), (-2, 0), (1, 0))
    + own("HL"),
    "LH": of("A", (-1, 0), (0, 0), (1, 0), (2, 0), (0, -1), (0, 1), (1, -1), (1, 1))
    + own("LH")
    + of("HH", (0, -2), (0, -1), (0, 0), (0, 1), (-1, -1), (-1, 0), (1, -1), (1, 0))
    + of("HL", (0, -1), (0, 0), (1, -1), (1, 0)),
}
CORE = {
    "HH": of("A", (0, 0), (0, 1), (1, 0), (1, 1)),
    "HL": of("A", (0, 0), (0, 1)) + of("HH", (-1, 0), (0, 0)),
    "LH": of("A", (0, 0), (1, 0)) + of("HH", (0, -1), (0, 0)),
}
# R.7
BENT = {
    "HH": [(0, 0), (0, 1), (1, 0), (1, 1)],
    "HL": [(0, 0), (0, 1)],
    "LH": [(0, 0), (1, 0)],
}
NEAR = {
    "HH": [],
    "HL": of("HH", (-1, 0), (0, 0)),
    "LH": of("HH", (0, -1), (0, 0)) + of("HL", (0, -1), (0, 0), (1, -1), (1, 0)),
}
FAR = {
    "HH": [],
    "HL": of("HH", (-1, -1), (0, -1), (-1, 1), (0, 1)),
    "LH": of("HH", (-1, -1), (-1, 0), (1, -1), (1, 0)),
}
OF_ERRORS, OF_RANGES = (1, 2, 3, 7, 8), (4, 5, 6)
# R.10: weights of features
SHIFTS = [14, 7, 7, 7, 13, 13, 9, 7, 7]
USUAL = {
    "HH": [12, 58, 50, 25, 33, 35, 57],
    "HL": [4, 39, 37, 10, 25, 24, 37, 49, 32],
    "LH": [4, 35, 19, 18, 22, 22, 35, 48, 23],
}


def lg(x):
    return x.bit_length() - 1


# R.10: tables ------------------------------------------------------------------------------------


def value_of_code(g):
    if g < 32:
        return g
    e = ((g - 32) >> 4) + 1
    return ((16 + g % 16) << e) + (1 << (e - 1))


def frequencies(codes, rest):
    found = [value_of_code(g) for g in codes]
    found[rest] = 0
    found[rest] = 2048 - sum(found)
    require(found[rest] >= 1 and found[0] >= 1, "frequencies of a context")
    return found


def read_rapid_tables(parameters, n):
    """Return K, stencils by class and plane, features by class, frequencies by context."""
    family = 0 if n == 1 else 1 if n == 3 else 2
    numbers = dict(zip(PLANES, (1, 2, 3), strict=True))
    sets = {plane: annex.STENCILS[i].tolist() for plane, i in numbers.items()}
    if not parameters:
        stencils = [{plane: sets[plane][0] for plane in PLANES}] * 4
        return tables_of(0, 0, family, stencils, [], CODES[0][family])
    layout = parameters[0]
    require(layout in (MEAN, REACH, WEIGHTS), "layout of the parameters", UnsupportedError)
    decoder, models = range_coder.RangeDecoder(parameters[1:]), Models(416)

    def magnitude(group, limit):
        value = decoder.magnitude(models, 46 * group, 46 * group + 14, 0)
        require(value <= limit, "number in the parameters")
        return value

    def changed(code):
        change = magnitude(8, 127)
        code += -change if change and decoder.raw(1) else change
        require(0 <= code <= 127, "code of a weight")
        return code

    k_max, family = decoder.raw(5), decoder.raw(3)
    require(family < 6, "family of frequencies")
    is_by_reach = decoder.raw(1) if layout == WEIGHTS else int(layout == REACH)
    n_weighted = decoder.raw(2) + 1 if layout == WEIGHTS else 0
    stencils, weights, before = [], [], USUAL
    for _ in range(4):
        stencils.append({})
        for plane in PLANES:
            base = decoder.raw(4)
            require(base < len(sets[plane]), "set of stencils")
            stencil = list(sets[plane][base])
            if decoder.raw(1):
                shift, missing = decoder.raw(3), TAPS[plane].index(CORE[plane][0])
                for i, tap in enumerate(TAPS[plane]):
                    if i != missing:
                        change = magnitude(0 if tap in CORE[plane] else 1, 65_534)
                        if change and decoder.raw(1):
                            change = -change
                        stencil[i] += change << shift
                stencil[missing] = 0
                stencil[missing] = 4096 - sum(stencil)
                require(max(map(abs, stencil)) <= 32_767, "weight of a stencil")
            stencils[-1][plane] = stencil
    for _ in range(n_weighted):
        before = {plane: [changed(code) for code in before[plane]] for plane in PLANES}
        weights.append({plane: weights_of(before[plane], plane) for plane in PLANES})
    of_family = CODES[is_by_reach][family]
    codes, is_own = [list(row) for row in of_family], 0
    for context in range(176):
        is_own = decoder.bit(models, 414 + is_own)
        if not is_own:
            continue
        trained, before = of_family[context], 0
        for symbol in range(63):
            g = trained[symbol]
            if symbol != trained.index(max(trained)):
                before = magnitude((5 if g else 2) + min(before.bit_length(), 2), 127)
                is_less = before and g and decoder.raw(1)
                codes[context][symbol] = g - before if is_less else g + before
                require(0 <= codes[context][symbol] <= 127, "code of a frequency")
        frequencies(codes[context], trained.index(max(trained)))
    decoder.end()
    return tables_of(k_max, is_by_reach, family, stencils, weights, codes)


def weights_of(codes, plane):
    """Return the nine weights of a plane; those of features that it has not are 0."""
    codes = codes + [0] * (9 - len(codes))
    weights = [value_of_code(g) << shift for g, shift in zip(codes, SHIFTS, strict=True)]
    taps = {1: 1, 2: 2, 3: 1, 7: len(NEAR[plane]), 8: len(FAR[plane])}
    errors = sum(weights[k] * n for k, n in taps.items())
    ranges = weights[4] + weights[5] + weights[6] * len(BENT[plane])
    require(8 * errors + ranges < 2**24 - 2**15, "weights of features")
    return weights


def tables_of(k_max, is_by_reach, family, stencils, weights, codes):
    rests = [row.index(max(row)) for row in CODES[is_by_reach][family]]
    symbols = []
    for row, rest in zip(codes, rests, strict=True):
        slots = []
        for symbol, f in enumerate(frequencies(row, rest)):
            slots += [(symbol, f, i) for i in range(f)]
        symbols.append(slots)
    widest = max(sum(map(abs, weights)) for row in stencils for weights in row.values())
    features = annex.FEATURES[family // 3].tolist()
    for rows, own in zip(features, weights, strict=False):
        rows[:3] = [own[plane] for plane in PLANES]
    return SimpleNamespace(
        k_max=k_max, stencils=stencils, features=features,
        slots=symbols, widest=widest, is_by_reach=bool(is_by_reach),
    )  # fmt: skip


# R.1, R.8, R.9: streams --------------------------------------------------------------------------


class Streams:
    """States, words and raw bits; past their ends there are zeros."""

    def __init__(self, payload, slots):
        require(payload and payload[0] < 4, "flags of rapid")
        self.is_wide = bool(payload[0] & 1)
        n_states = 1 if payload[0] & 2 else 8
        n_words, at = read_varint(payload, 1)
        require(at + 4 * n_states + 2 * n_words <= len(payload), "states and words")
        numbers = range(at, at + 4 * n_states, 4)
        self.states = [int.from_bytes(payload[i : i + 4], "little") for i in numbers]
        at += 4 * n_states
        numbers = range(at, at + 2 * n_words, 2)
        self.words = [int.from_bytes(payload[i : i + 2], "little") for i in numbers]
        self.raw_bytes = payload[at + 2 * n_words :]
        self.bits = int.from_bytes(self.raw_bytes, "little")
        self.slots = slots
        self.n_symbols = self.n_words_used = self.n_bits_used = 0

    def symbol(self, context):
        k = self.n_symbols % len(self.states)
        x = self.states[k]
        s, f, i = self.slots[context][x % 2048]
        x = f * (x >> 11) + i
        if x < 65536:
            at = self.n_words_used
            x = 65536 * x + (self.words[at] if at < len(self.words) else 0)
            self.n_words_used += 1
        self.states[k] = x
        self.n_symbols += 1
        return s

    def raw(self, k):
        value = self.bits >> self.n_bits_used & ((1 << k) - 1)
        self.n_bits_used += k
        return value

    def end(self):
        require(self.n_words_used == len(self.words), "number of words")
        require(all(x == 65536 for x in self.states), "states at the end")
        require((self.n_bits_used + 7) // 8 == len(self.raw_bytes), "number of raw bits")
        require(self.bits >> self.n_bits_used == 0, "filling of the raw bits")


class Rows:
    """R.6, R.7, R.9 for rows of samples whose surroundings are known."""

    def __init__(self, unit, n, low, high, is_by_reach, streams):
        self.unit = unit
        self.n, self.low, self.high, self.streams = n, low, high, streams
        self.is_by_reach = is_by_reach
        self.r = max(lg(n) - 4, 0)
        self.most = (1 << (15 + min(lg(n), 4))) - 1

    def scaled(self, weights):
        found = []
        for k, v in enumerate(weights):
            s = lg(self.n) if k in OF_ERRORS else self.r if k in OF_RANGES else 0
            found.append((((v << s) // (self.n if k else 1)) + 128) >> 8)
        return found

    def range_features(self, x):
        return [
            1, 0, 0, 0, min((max(x.core) - min(x.core)) >> self.r, self.most),
            min(x.twist >> self.r, self.most), 0, 0, 0,
        ]  # fmt: skip

    def finish(self, x, weights, features):
        """Clamp P, find w, side and the context of a sample."""
        x.p = clamp(x.p, 64 * min(x.core), 64 * max(x.core))
        x.w = (x.p + 32) >> 6
        n = self.n
        total = sum(a * b for a, b in zip(weights, features, strict=True))
        x.e = e = total >> 4
        b = clamp(2 * lg(e) + (e >> (lg(e) - 1) & 1) - 10, 0, 43) if e >= 32 else 0
        if n in (1, 3) and (b < 16 or not self.is_by_reach):
            x.side = x.p - 64 * x.w
            sigma = min((abs(x.side) * (65536 // (8 * n))) >> 16, 3) if b < 16 else 0
        else:
            x.side = 16 * x.sum - x.p
            if not self.is_by_reach:
                far, marks = abs(x.side), (4, 11, 24)
            else:
                far = 64 * max(x.core) - x.p if x.side < 0 else x.p - 64 * min(x.core)
                marks = 8, 24, 48
            s = max(lg(n) - 5, 0)
            d = min(far >> s, 2**20 - 1) * ((1024 << lg(n)) // n) >> (2 + lg(n) - s)
            sigma = sum(4 * d > mark * e for mark in marks)
        x.context = 4 * b + sigma

    def decode(self, row):
        """Give the samples of a row, those with `is_coded`, their heights."""
        for x in row:
            x.symbol = self.streams.symbol(x.context) if x.is_coded else 31
        for x in row:
            kappa = max((x.context >> 3) - 8, 0)
            d = x.symbol - 31
            if x.is_coded and (x.symbol == 0 or kappa):
                if x.symbol == 0:
                    d = self.streams.raw(33)
                    d -= (d >> 32) << 33
                else:
                    d = (d << kappa) + self.streams.raw(kappa)
                most = (self.high - self.low) // self.n + 1
                d = clamp(d, -most, most)
            x.q = -d if x.side < 0 else d
            x.height = clamp(x.w + x.q * self.n, self.low, self.high)
            x.height = corrected(self.unit, x.place, x.height, self.low, self.high)


# R.3 ---------------------------------------------------------------------------------------------


class Shared(SharedDecoder):
    """Shared samples; places and their order are those of format-predictive.md."""

    def __init__(self, file, unit, valid, parent_unit, parent_heights, rows, features):
        super().__init__(file, unit, None, valid, parent_unit, parent_heights)
        self.rows_of = rows
        self.weights = rows.scaled(features)

    def decode_row(self, row):
        for x in row:
            x.is_coded = self.is_valid(x.place)
            self.rows_of.finish(x, self.weights, self.rows_of.range_features(x))
        self.rows_of.decode(row)
        for x in row:
            i, j = x.place
            self.heights[i][j], self.known[i][j] = x.height, 1

    def decode_shared(self):
        rows, cols = self.unit.rows, self.unit.cols
        corners = [
            place
            for side in self.lines_of(rows)
            for other in self.lines_of(cols)
            for place in ((row, col) for row in side for col in other)
        ]
        for i, j in corners:
            (a, _), (b, _) = self.parents((i, j))
            self.known[i][j] = 1
            self.heights[i][j] = self.parent[a][b]  # if it is inherited
        odd = [place for place in dict.fromkeys(corners) if self.is_odd(place)]
        for first in range(0, len(odd), 64):
            row = []
            for place in odd[first : first + 64]:
                parent_rows, parent_cols = self.parents(place)
                core = [self.parent[i][j] for i in parent_rows for j in parent_cols]
                row.append(
                    SimpleNamespace(
                        place=place, core=core, sum=sum(core), p=16 * sum(core),
                        twist=abs(core[0] - core[1] - core[2] + core[3]),
                    )
                )  # fmt: skip
            self.decode_row(row)
        for row in dict.fromkeys(row for side in self.lines_of(rows) for row in side):
            self.decode_line([(row, cols.core + i) for i in range(cols.n_core)], False)
        for col in dict.fromkeys(col for side in self.lines_of(cols) for col in side):
            self.decode_line([(rows.core + i, col) for i in range(rows.n_core)], True)

    def decode_line(self, places, is_column):
        u, v = [], []
        for place in places[::2]:
            parent_rows, parent_cols = self.parents(place)
            u.append(self.parent[parent_rows[0]][parent_cols[0]])
            v.append(self.parent[parent_rows[-is_column + 1]][parent_cols[is_column]])
        m = len(u)

        def at(line, k):
            k = min(1, m - 1) if k < 0 else k
            return line[k if k < m else max(2 * m - 2 - k, 0)]

        unknown = [k for k, (i, j) in enumerate(places) if not self.known[i][j]]
        even, odd = ([k for k in unknown if k % 2 == parity] for parity in (0, 1))
        if self.is_odd_line(places, is_column):
            t = [a + b for a, b in zip(u, v, strict=True)]
            self.decode_row(
                [
                    SimpleNamespace(
                        place=places[k], core=[u[k // 2], v[k // 2]], sum=2 * t[k // 2],
                        p=32 * t[k // 2],
                        twist=abs(at(t, k // 2 - 1) - 2 * t[k // 2] + at(t, k // 2 + 1)),
                    )
                    for k in even
                ]
            )  # fmt: skip
        else:
            for k in even:
                i, j = places[k]
                self.heights[i][j], self.known[i][j] = u[k // 2], 1
        h = [self.heights[i][j] for i, j in places[::2]]
        row = []
        for k in odd:
            a, b, c, d = core = [at(h, k // 2 + offset) for offset in (-1, 0, 1, 2)]
            row.append(
                SimpleNamespace(
                    place=places[k], core=core, sum=2 * (b + c), p=4 * (9 * (b + c) - a - d),
                    twist=abs(a - b - c + d),
                )
            )  # fmt: skip
        self.decode_row(row)

    def is_odd_line(self, places, is_column):
        row, col = places[0]
        first = self.unit.cols.first + col if is_column else self.unit.rows.first + row
        return first % 2 == 1


# R.5 ---------------------------------------------------------------------------------------------


class Lattice:
    """Planes of a lattice, whose errors and heights are read outside as R.5 says."""

    def __init__(self, unit, stride, heights, known, valid, rows, stencils, features):
        self.unit, self.stride, self.heights, self.known = unit, stride, heights, known
        self.valid, self.rows_of, self.stencils = valid, rows, stencils
        self.weights = {p: rows.scaled(features[k]) for k, p in enumerate(PLANES)}
        self.shape = [(axis.n_core - 1) // stride + 1 for axis in (unit.rows, unit.cols)]
        self.sizes = {
            plane: [(n + 1 - odd) >> 1 for n, odd in zip(self.shape, parity, strict=True)]
            for plane, parity in PARITY.items()
        }
        self.errors = {}
        self.first_row_of = None  # the plane whose row 0 is being coded

    def place(self, plane, i, j):
        """Place of a plane's sample in the region."""
        r, c = 2 * i + PARITY[plane][0], 2 * j + PARITY[plane][1]
        return self.unit.rows.core + r * self.stride, self.unit.cols.core + c * self.stride

    def a(self, i, j):
        row, col = (fold(2 * k, n) // 2 for k, n in zip((i, j), self.shape, strict=True))
        i, j = self.place("A", row, col)
        return self.heights[i][j]

    def mean(self, plane, i, j):
        here, east, south = self.a(i, j), self.a(i, j + 1), self.a(i + 1, j)
        if plane == "HH":
            return (here + east + south + self.a(i + 1, j + 1) + 2) >> 2
        return (here + (east if plane == "HL" else south) + 1) >> 1

    def value(self, plane, i, j):
        if plane == "A":
            return self.a(i, j)
        n_rows, n_cols = self.sizes[plane]
        if n_rows == 0 or n_cols == 0:
            n = max(self.shape[1] >> 1, 1) if plane == "HH" else 1
            return self.mean(plane, i, clamp(j, 0, n - 1))
        if plane == self.first_row_of and i < 0:
            return self.mean(plane, 0, clamp(j, 0, n_cols - 1))
        row, col = self.place(plane, clamp(i, 0, n_rows - 1), clamp(j, 0, n_cols - 1))
        return self.heights[row][col]

    def error(self, plane, i, j):
        n_rows, n_cols = self.sizes[plane]
        if n_rows == 0 or n_cols == 0 or (plane == self.first_row_of and i < 0):
            return 0
        return self.errors[plane, clamp(i, 0, n_rows - 1), clamp(j, 0, n_cols - 1)]

    def curvature(self, i, j):
        i, j = (clamp(k, 0, n - 1) for k, n in zip((i, j), self.sizes["A"], strict=True))
        weights = ((-2, 1), (-1, -4), (0, 6), (1, -4), (2, 1))
        along = abs(sum(w * self.a(i, j + d) for d, w in weights))
        down = abs(sum(w * self.a(i + d, j) for d, w in weights))
        return min((along + down) >> self.rows_of.r, self.rows_of.most)

    def decode(self):
        for t in range(self.sizes["A"][0] + 2):
            for delay, plane in enumerate(PLANES):
                i = t - delay
                if 0 <= i < self.sizes[plane][0] and self.sizes[plane][1]:
                    self.decode_row(plane, i)

    def decode_row(self, plane, i):
        self.first_row_of = plane if i == 0 else None
        row = [self.predict(plane, i, j) for j in range(self.sizes[plane][1])]
        coded = [x for x in row if not x.is_known]
        self.rows_of.decode(coded)
        for x in coded:
            self.heights[x.place[0]][x.place[1]] = x.height
        n = self.rows_of.n
        for j, x in enumerate(row):
            height = self.heights[x.place[0]][x.place[1]]
            self.errors[plane, i, j] = min(abs(64 * height - x.p) >> lg(n), 2**18 - 1)

    def predict(self, plane, i, j):
        x = SimpleNamespace(place=self.place(plane, i, j))
        x.is_known = self.known[x.place[0]][x.place[1]]
        x.is_coded = self.valid[x.place[0]][x.place[1]]
        values = [self.value(p, i + r, j + c) for p, r, c in TAPS[plane]]
        x.p = (sum(a * b for a, b in zip(self.stencils[plane], values, strict=True)) + 32) >> 6
        x.core = c = [self.value(p, i + r, j + q) for p, r, q in CORE[plane]]
        x.sum = sum(c)
        x.twist = abs(c[0] - c[1] - c[2] + c[3] if plane == "HH" else c[0] + c[1] - c[2] - c[3])
        features = self.rows_of.range_features(x)
        features[1] = self.error(plane, i - 1, j)
        features[2] = self.error(plane, i - 1, j - 1) + self.error(plane, i - 1, j + 1)
        features[3] = self.error(plane, i - 2, j)
        features[6] = sum(self.curvature(i + r, j + q) for r, q in BENT[plane])
        features[7] = sum(self.error(p, i + r, j + q) for p, r, q in NEAR[plane])
        features[8] = sum(self.error(p, i + r, j + q) for p, r, q in FAR[plane])
        self.rows_of.finish(x, self.weights[plane], features)
        return x


def limits(header, widest, is_wide, parent):
    """R.2: low and high."""
    if is_wide:
        return header.z_min, header.z_max
    most = 2**31 - 64
    o = 0
    if parent is not None and max(-header.z_min, header.z_max) * widest > most:
        o = (min(map(min, parent)) + max(map(max, parent))) >> 1
    low, high = max(header.z_min, o - most // widest), min(header.z_max, o + most // widest)
    require(low <= high, "a unit that is not wide has no heights")
    return low, high


def decode_rapid(file, unit, payload, valid, parent_unit, parent_heights):
    """Return the heights of the region, before the wrapper's steps."""
    tables, n = file.tables, file.header.step
    streams = Streams(payload, tables.slots)
    low, high = limits(file.header, tables.widest, streams.is_wide, parent_heights)
    rows = Rows(unit, n, low, high, tables.is_by_reach, streams)
    level = unit.key[0] + 1

    def of_class(stride):
        which = clamp(tables.k_max - level + lg(stride), 0, 3)
        return tables.stencils[which], tables.features[which]

    if parent_heights is not None:
        parent = [[clamp(z, low, high) for z in row] for row in parent_heights]
        shared = Shared(file, unit, valid, parent_unit, parent, rows, of_class(1)[1][3])
        shared.decode_shared()
        shared.take_parents()
        Lattice(unit, 1, shared.heights, shared.known, valid, rows, *of_class(1)).decode()
        streams.end()
        return shared.heights
    heights, known = zeros(unit.rows.n, unit.cols.n), zeros(unit.rows.n, unit.cols.n)
    stride = 1
    while stride < max(unit.rows.n_core, unit.cols.n_core) - 1:
        stride *= 2
    for i in range(0, unit.rows.n_core, stride):
        for j in range(0, unit.cols.n_core, stride):
            heights[i][j] = (low + high) >> 1
            if valid[i][j]:
                index = streams.raw(((high - low) // n).bit_length())
                heights[i][j] = min(low + index * n + (n >> 1), high)
            heights[i][j] = corrected(unit, (i, j), heights[i][j], low, high)
    while stride > 1:
        stride //= 2
        Lattice(unit, stride, heights, known, valid, rows, *of_class(stride)).decode()
    streams.end()
    return heights
