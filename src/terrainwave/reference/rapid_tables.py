"""Tables of method rapid (format-rapid.md R.10, R.11), and the taps that they are for (R.6)."""

from itertools import accumulate
from types import SimpleNamespace

from terrainwave.reference.basics import require, tables
from terrainwave.reference.range_coder import Models, RangeDecoder

PLANES = ("HH", "HL", "LH")
STENCILS, CUTS, WEIGHTS, PAIRS, SAMPLES = tables(  # R.11
    "rapid.bin",
    ("h", 3, 16, 24), ("B", 6), ("B", 6, 4, 3, 4), ("B", 6, 60, 226), ("B", 6, 61, 64),
)  # fmt: skip
ESCAPE = 225  # R.9
REST_PAIR, REST_SAMPLE = 112, 31  # R.10


def at(plane, *places):
    return [(plane, i, j) for i, j in places]


def square(rows, cols):
    return at("A", *((i, j) for i in rows for j in cols))


TAPS = {  # R.6
    "HH": square((-1, 0, 1, 2), (-1, 0, 1, 2)),
    "HL": square((-1, 0, 1), (-1, 0, 1, 2))
    + at("HH", (-2, 0), (-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 0), (0, 1), (1, 0)),
    "LH": square((-1, 0, 1, 2), (-1, 0, 1))
    + at("HH", (-1, -1), (-1, 0), (0, -2), (0, -1), (0, 0), (0, 1), (1, -1), (1, 0))
    + at("HL", (0, -1), (0, 0), (1, -1), (1, 0)),
}
CORE = {
    "HH": square((0, 1), (0, 1)),
    "HL": square((0,), (0, 1)) + at("HH", (-1, 0), (0, 0)),
    "LH": square((0, 1), (0,)) + at("HH", (0, -1), (0, 0)),
}


def value(g):
    """R.10."""
    e = (g - 16) >> 4
    return g if g < 32 else ((16 + g % 16) << e) + (1 << (e - 1))


def table(codes, rest):
    """Return f and F of a table (R.10)."""
    f = [value(g) + (rest == REST_SAMPLE or y == ESCAPE) for y, g in enumerate(codes)]
    f[rest] += 4096 - sum(f)
    require(f[rest] >= 1, "frequencies of a table")
    return f, [0, *accumulate(f)]


def read_rapid_tables(parameters, n):
    """R.10."""
    first = parameters[0] if parameters else {1: 0, 3: 1}.get(n, 2) << 5
    family = first >> 5
    require(family < len(CUTS), "family of tables")
    found = SimpleNamespace(level=first & 31, cut=CUTS[family])
    found.stencils = [{p: sets[0] for p, sets in zip(PLANES, STENCILS)}] * 4
    weights = [{p: w[: 3 + (p != "HH")] for p, w in zip(PLANES, ws)} for ws in WEIGHTS[family]]
    pairs, samples = PAIRS[family], SAMPLES[family]
    if len(parameters) > 1:
        stream = TableStream(parameters[1:])
        found.stencils = [
            {p: stream.stencil(p, sets) for p, sets in zip(PLANES, STENCILS)} for _ in range(4)
        ]
        weights = [{p: stream.codes(8, w) for p, w in planes.items()} for planes in weights]
        found.cut = stream.decoder.raw(6)
        require(found.cut <= 60, "cut")
        pairs = [stream.frequencies(codes, REST_PAIR) for codes in pairs[: found.cut]]
        samples = [stream.frequencies(codes, REST_SAMPLE) for codes in samples]
        stream.decoder.end()
    found.weights = [{p: [*map(value, w), 0] for p, w in planes.items()} for planes in weights]
    found.pairs = [table(codes, REST_PAIR) for codes in pairs[: found.cut]]
    found.samples = [table(codes, REST_SAMPLE) for codes in samples]  # the last: of escaped pairs
    return found


class TableStream:
    """The stream of the parameters section."""

    def __init__(self, data):
        self.decoder, self.models, self.is_own = RangeDecoder(data), Models(646), 0

    def signed(self, group, limit, has_sign=True):
        m = self.decoder.magnitude(self.models, 46 * group, 46 * group + 14, 0)
        require(m <= limit, "number in the parameters")
        return -m if m and has_sign and self.decoder.raw(1) else m

    def codes(self, j, known):
        found, size = [], 0
        for g in known:
            m = self.signed(j + size + 3 * (g > 0), 255, g > 0)
            require(0 <= g + m <= 255, "code in the parameters")
            found.append(g + m)
            size = min(abs(m).bit_length(), 2)
        return found

    def stencil(self, plane, sets):
        taps, core = TAPS[plane], CORE[plane]
        weights = sets[self.decoder.raw(4)][: len(taps)]
        if not self.decoder.raw(1):
            return weights
        shift, missing = self.decoder.raw(3), taps.index(core[0])
        for i, tap in enumerate(taps):
            if i != missing:
                weights[i] += self.signed(0 if tap in core else 1, 65534) << shift
        weights[missing] += 4096 - sum(weights)
        sizes = [*map(abs, weights)]
        require(max(sizes) <= 32767 and sum(sizes) <= 2**18, "weights of a stencil")
        return weights

    def frequencies(self, known, rest):
        self.is_own = self.decoder.bit(self.models, 644 + self.is_own)
        if not self.is_own:
            return known
        codes = self.codes(2, known[:rest] + known[rest + 1 :])
        return [*codes[:rest], 0, *codes[rest:]]
