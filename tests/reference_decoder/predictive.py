"""Method predictive (docs/format-predictive.md, whose sections are cited as P.n)."""

from types import SimpleNamespace

from reference_decoder import mixing
from reference_decoder.mixing import Mixers
from terrainwave.reference.basics import (
    UnsupportedError,
    clamp,
    corrected,
    fold,
    require,
    tables,
    zeros,
)
from terrainwave.reference.range_coder import M, Models, bin_of, lg

PLANES = ("HH", "HL", "LH")
PARITY = {"HH": (1, 1), "HL": (0, 1), "LH": (1, 0)}
PLANE_OF = {parity: plane for plane, parity in PARITY.items()}
REACH = 5  # lattice places farther outside are never read
N_DETAIL_MODELS, N_BORDER_MODELS = 22931, 2860
*STENCILS, WEIGHTS, DETAIL_STARTS, BORDER_STARTS = tables(  # P.9
    "predictive.bin",
    ("h", 8, 20), ("h", 8, 20), ("h", 8, 24), ("h", 3, 3, 18),
    ("H", N_DETAIL_MODELS), ("H", N_BORDER_MODELS),
)  # fmt: skip

# P.5: places in lattice steps from the sample that is predicted.
OWN = [(0, -2), (-2, 0), (-2, -2), (-2, 2)]
_AFTER_OWN = [
    (0, -1), (0, 1), (0, -3), (0, 3), (-1, 0), (1, 0), (-1, -2), (-1, 2), (1, -2), (1, 2),
    (-2, -1), (-2, 1), (2, -1), (2, 1), (-3, 0), (3, 0),
]  # fmt: skip
TAPS = {
    "HH": OWN + [(r, c) for r in (-3, -1, 1, 3) for c in (-3, -1, 1, 3)],
    "HL": OWN + _AFTER_OWN,
    "LH": OWN + [(r, c) for c, r in _AFTER_OWN] + [(-1, -1), (-1, 1), (1, -1), (1, 1)],
}
CORE = {
    "HH": [(-1, -1), (-1, 1), (1, -1), (1, 1)],
    "HL": [(0, -1), (0, 1), (-1, 0), (1, 0)],
    "LH": [(-1, 0), (1, 0), (0, -1), (0, 1)],
}
# P.6: places in the plane of features 0 … 5: W, WW, N, NW, NE, NN.
EARLIER = [(0, -1), (0, -2), (-1, 0), (-1, -1), (-1, 1), (-2, 0)]
# P.6: where features 6, 7 (errors), 17 (activity), 8 (bends) and 13 (lines) are read.
NEAR_ERRORS = {
    "HH": [],
    "HL": [(-1, 0), (1, 0)],
    "LH": [(0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1)],
}
FAR_ERRORS = {
    "HH": [],
    "HL": [(-1, -2), (-1, 2), (1, -2), (1, 2)],
    "LH": [(-2, -1), (-2, 1), (2, -1), (2, 1)],
}
ACTIVE = {"HH": [], "HL": [("HH", 0)], "LH": [("HH", 0), ("HL", 1)]}
BENT = {"HH": CORE["HH"], "HL": [(0, -1), (0, 1)], "LH": [(-1, 0), (1, 0)]}
ODD = (-3, -1, 1, 3)
LINES = {
    "HH": [[(r, c) for c in ODD] for r in (-1, 1)] + [[(r, c) for r in ODD] for c in (-1, 1)],
    "HL": [[(0, c) for c in ODD], [(r, 0) for r in ODD]],
    "LH": [[(0, c) for c in ODD], [(r, 0) for r in ODD]],
}


# P.9, P.10: tables --------------------------------------------------------------------------------


def read_tables(parameters):
    """Return stencils by plane and set, and feature weights by plane and class."""
    stencils = {plane: [*sets] for plane, sets in zip(PLANES, STENCILS, strict=True)}
    weights = {plane: [*classes] for plane, classes in zip(PLANES, WEIGHTS, strict=True)}
    found = SimpleNamespace(stencils=stencils, weights=weights)
    if not parameters:
        return found
    require(parameters[0] == 1, "layout of the parameters", UnsupportedError)
    decoder, models = mixing.MixingDecoder(parameters[1:]), Models(138)

    def magnitude(group, limit):
        value = decoder.magnitude(models, 46 * group, 46 * group + 14, 0)
        require(value <= limit, "number in the parameters")
        return value

    for plane in PLANES:
        sets, taps = stencils[plane], TAPS[plane]
        n_trained, missing = len(sets), taps.index(CORE[plane][0])
        n_new = decoder.raw(4)
        require(n_trained + n_new <= 16, "number of stencils")
        for _ in range(n_new):
            base = decoder.raw(4)
            require(base < n_trained, "base of a stencil")
            shift = decoder.raw(3)
            stencil = list(sets[base])
            for i, tap in enumerate(taps):
                if i != missing:
                    change = magnitude(0 if tap in CORE[plane] else 1, 65_534)
                    if change and decoder.raw(1):
                        change = -change
                    stencil[i] += change << shift
            stencil[missing] = 0
            stencil[missing] = 4096 - sum(stencil)
            require(max(map(abs, stencil)) <= 32_767, "weight of a stencil")
            sets.append(stencil)
        if decoder.raw(1):
            weights[plane].append([magnitude(2, 4096) for _ in range(18)])
    decoder.end()
    return found


# P.3, P.4: shared lines and corners ---------------------------------------------------------------


class SharedDecoder:
    """What is coded before lattices; fills `heights` and `known` of the region."""

    def __init__(self, file, unit, decoder, valid, parent_unit, parent_heights):
        self.n = file.header.step
        self.rings = (file.header.border_rings - 1) // 2
        self.unit, self.decoder, self.valid = unit, decoder, valid
        self.parent_unit, self.parent = parent_unit, parent_heights
        self.models = Models(N_BORDER_MODELS, BORDER_STARTS)
        self.heights = zeros(unit.rows.n, unit.cols.n)
        self.known = zeros(unit.rows.n, unit.cols.n)

    def symbol(self, pass_, s):
        b = bin_of(min(s, 4095))
        if not self.decoder.bit(self.models, 36 * pass_ + b):
            return 0
        first = 180 + 14 * (36 * pass_ + b)
        size = 1 + self.decoder.magnitude(self.models, first, 2700 + 32 * pass_, 0)
        return -size if self.decoder.raw(1) else size

    def put(self, place, prediction, q):
        m = 4 * M // self.n + 1
        row, col = place
        height = clamp(prediction + clamp(q, -m, m) * self.n, -M, M)
        if self.parent is None or self.is_odd(place):
            height = corrected(self.unit, place, height, -M, M)
        self.heights[row][col] = height
        self.known[row][col] = 1

    def is_valid(self, place):
        return self.valid[place[0]][place[1]]

    def parents(self, place):
        """Parent indices, in `parent`, at or before and at or after a place, by axis."""
        found = []
        for i, axis, above in zip(
            place,
            (self.unit.rows, self.unit.cols),
            (self.parent_unit.rows, self.parent_unit.cols),
            strict=True,
        ):
            first = (axis.first + i) >> 1
            second = min((axis.first + i + 1) >> 1, above.last)
            found.append((first - above.first, second - above.first))
        return found

    def is_odd(self, place):
        """Say whether a place is on an odd row or column of its level."""
        return (self.unit.rows.first + place[0]) % 2 or (self.unit.cols.first + place[1]) % 2

    def lines_of(self, axis):
        """Rows (or columns) of each shared side, those inside the region."""
        sides = axis.core, axis.core + axis.n_core - 1
        return [
            [p for p in range(side - self.rings, side + self.rings + 1) if 0 <= p < axis.n]
            for side, is_shared in zip(sides, axis.shared, strict=True)
            if is_shared
        ]

    def decode_shared(self):
        """P.3."""
        rows, cols = self.unit.rows, self.unit.cols
        for side in self.lines_of(rows):
            for other in self.lines_of(cols):
                for place in ((row, col) for row in side for col in other):
                    if not self.known[place[0]][place[1]]:
                        self.decode_corner(place)
        for row in dict.fromkeys(row for side in self.lines_of(rows) for row in side):
            self.decode_line([(row, cols.core + i) for i in range(cols.n_core)], False)
        for col in dict.fromkeys(col for side in self.lines_of(cols) for col in side):
            self.decode_line([(rows.core + i, col) for i in range(rows.n_core)], True)

    def decode_corner(self, place):
        parent_rows, parent_cols = self.parents(place)
        total = sum(self.parent[i][j] for i in parent_rows for j in parent_cols)
        q = self.symbol(0, 16) if self.is_valid(place) and self.is_odd(place) else 0
        self.put(place, (total + 2) >> 2, q)

    def decode_line(self, places, is_column):
        length, n = len(places), self.n
        pairs = []
        for place in places[::2]:
            parent_rows, parent_cols = self.parents(place)
            if is_column:
                pairs.append(sum(self.parent[parent_rows[0]][j] for j in parent_cols))
            else:
                pairs.append(sum(self.parent[i][parent_cols[0]] for i in parent_rows))
        p = [self.predict_line(pairs, i) for i in range(length)]
        is_coded = [not self.known[row][col] for row, col in places]

        def error(i):
            row, col = places[i]
            return self.heights[row][col] - p[i]

        for parity in (0, 1):
            last = before = 0
            for i in range(parity, length, 2):
                if not is_coded[i]:
                    continue
                c, near = 0, last + before
                if parity:
                    left = error(i - 1)
                    right = error(i + 1) if i + 1 < length else left
                    c = (left + right) >> 1
                    near = (2 * abs(left - c) + 2 * abs(right - c)) // n + last
                bend = abs(p[i - 1] - 2 * p[i] + p[i + 1]) if 0 < i < length - 1 else 0
                q = 0
                if self.is_valid(places[i]) and self.is_odd(places[i]):
                    q = self.symbol(parity, 4 * near + min(8 * bend // n, 1024))
                self.put(places[i], p[i] + c, q)
                before, last = last, min(abs(q), 255)

    @staticmethod
    def predict_line(v, i):
        m, k = len(v), i >> 1
        if i % 2 == 0:
            return (v[k] + 1) >> 1
        if k + 1 == m:
            return (3 * v[k] - v[max(k - 1, 0)] + 2) >> 2
        before = v[k - 1] if k > 0 else v[1]
        after = v[k + 2] if k + 2 < m else v[m - 2]
        return (9 * (v[k] + v[k + 1]) - before - after + 16) >> 5

    def decode_root_corners(self):
        """P.4; return S."""
        rows, cols = self.unit.rows, self.unit.cols
        stride = 1
        while stride < max(rows.n_core, cols.n_core) - 1:
            stride *= 2
        for i in range(0, rows.n_core, stride):
            for j in range(0, cols.n_core, stride):
                place = rows.core + i, cols.core + j
                q = self.symbol(2, 16) if self.is_valid(place) else 0
                self.put(place, self.n >> 1, q)
        return stride

    def take_parents(self):
        """P.2: samples of even row and column are the parent's."""
        rows, cols = self.unit.rows, self.unit.cols
        for i in range(rows.n_core):
            for j in range(cols.n_core):
                place = rows.core + i, cols.core + j
                if not self.is_odd(place):
                    parent_rows, parent_cols = self.parents(place)
                    self.heights[place[0]][place[1]] = self.parent[parent_rows[0]][parent_cols[0]]


# P.5: lattices ------------------------------------------------------------------------------------


class Scale:
    """Quanta counted in steps (P.5)."""

    def __init__(self, n):
        self.shift = 0
        while n >> self.shift >= 4096:
            self.shift += 1
        self.inverse = 2**22 // (n >> self.shift)

    def steps(self, d, f):
        return ((min(d, 2**40) >> self.shift) * self.inverse) >> (22 - f)


class Lattice:
    """The core's samples on multiples of a stride, and what is known of planes coded before."""

    def __init__(self, unit, stride, heights):
        self.unit = unit
        self.row, self.col = unit.rows.core, unit.cols.core
        self.stride = stride
        self.heights = heights  # of the region
        self.n_rows = (unit.rows.n_core - 1) // stride + 1
        self.n_cols = (unit.cols.n_core - 1) // stride + 1
        # Where lattice places lie in the core; odd ones are left out where no row or column is odd.
        self.rows, self.cols = (
            {i: stride * fold(i, n) for i in range(-REACH, n + REACH) if n > 1 or i % 2 == 0}
            for n in (self.n_rows, self.n_cols)
        )
        self.errors, self.activity = {}, {}  # by plane: of its samples, [row, column]
        self.bends = {}  # curvature of A by even row and column

    def value(self, r, c):
        """Height at a lattice place, which may lie outside."""
        if r in self.rows and c in self.cols:
            return self.heights[self.row + self.rows[r]][self.col + self.cols[c]]
        around = [
            self.value(a, b)
            for a in ((r - 1, r + 1) if r % 2 else (r,))
            for b in ((c - 1, c + 1) if c % 2 else (c,))
        ]
        return (sum(around) + len(around) // 2) // len(around)

    def of_plane(self, found, r, c):
        """Errors or activities of planes coded before at a lattice place; 0 of empty planes."""
        if r not in self.rows or c not in self.cols:
            return 0
        return found[PLANE_OF[r % 2, c % 2]][self.rows[r] // self.stride // 2][
            self.cols[c] // self.stride // 2
        ]

    def core(self, plane, r, c):
        return [self.value(r + i, c + j) for i, j in CORE[plane]]

    def core_mean(self, plane, r, c):
        return (sum(self.core(plane, r, c)) + 2) >> 2

    def curvature(self, r, c):
        """Curvature of A at an even row and column (P.6)."""
        r, c = fold(r, self.n_rows), fold(c, self.n_cols)
        if (r, c) not in self.bends:
            weights = ((-4, 1), (-2, -4), (0, 6), (2, -4), (4, 1))
            along = abs(sum(w * self.value(r, c + d) for d, w in weights))
            down = abs(sum(w * self.value(r + d, c) for d, w in weights))
            self.bends[r, c] = min(along + down, 2**31 - 1)
        return self.bends[r, c]


class PlaneDecoder:
    """One plane of a lattice (P.5 … P.7)."""

    def __init__(self, lattice, plane, stencil, weights, scale, header, flags, source):
        self.lattice, self.plane = lattice, plane
        self.stencil, self.weights = stencil, weights
        self.scale, self.header = scale, header
        self.is_mixed, self.is_clamped = flags & 1, flags & 2
        self.decoder, self.models, self.mixers = source
        self.parity = PARITY[plane]
        self.n_rows = (lattice.n_rows + 1 - self.parity[0]) // 2
        self.n_cols = (lattice.n_cols + 1 - self.parity[1]) // 2
        self.errors = lattice.errors[plane] = zeros(self.n_rows, self.n_cols)
        self.activity = lattice.activity[plane] = zeros(self.n_rows, self.n_cols)

    def run(self, valid, known):
        for i in range(self.n_rows):
            for j in range(self.n_cols):
                r, c = 2 * i + self.parity[0], 2 * j + self.parity[1]
                row, col = self.place(r, c)
                self.decode_sample(i, j, valid[row][col], known[row][col])
            self.finish_row(i)

    def place(self, r, c):
        """Place in the region of a lattice place inside the lattice."""
        lattice = self.lattice
        return lattice.row + lattice.rows[r], lattice.col + lattice.cols[c]

    def own(self, i, j):
        """Height of the plane being coded at a causal place (P.5)."""
        a, b = max(i, 0), clamp(j, 0, self.n_cols - 1)
        r, c = 2 * a + self.parity[0], 2 * b + self.parity[1]
        if (a, b) != (i, j):
            return self.lattice.core_mean(self.plane, r, c)
        return self.lattice.value(r, c)

    def decode_sample(self, i, j, is_valid, is_known):
        lattice, steps = self.lattice, self.scale.steps
        z_min, z_max, n = self.header.z_min, self.header.z_max, self.header.step
        r, c = 2 * i + self.parity[0], 2 * j + self.parity[1]
        x = {(a, b): self.own(i + a // 2, j + b // 2) for a, b in OWN}
        x |= {(a, b): lattice.value(r + a, c + b) for a, b in TAPS[self.plane][len(OWN) :]}
        core = [x[tap] for tap in CORE[self.plane]]
        c1, c2, c3, c4 = sorted(core)
        total = sum(w * x[tap] for w, tap in zip(self.stencil, TAPS[self.plane], strict=True))
        p = (total + 32) >> 6
        off = abs(p - 16 * (c1 + c2 + c3 + c4))
        if self.is_clamped:
            p = clamp(p, 64 * c1, 64 * c4)
        p = clamp(p, 64 * z_min, 64 * z_max)
        w = (p + 32) >> 6
        row, col = self.place(r, c)
        if not is_known:
            height = w
            if is_valid:
                e = self.expected(i, j, x, core, p, off)
                q = self.decode_detail(e, sorted(core), (x[0, -2], x[-2, 0]), p)
                height = clamp(w + q * n, z_min, z_max)
            lattice.heights[row][col] = corrected(lattice.unit, (row, col), height, z_min, z_max)
        if is_valid or is_known:
            distance = abs(64 * lattice.heights[row][col] - p)
            self.errors[i][j] = min(steps(distance, -1), 32_767)

    # P.6 --------------------------------------------------------------------------------------

    def error(self, i, j):
        """Error at a place of the plane being coded, or beside it."""
        if i < 0:
            return 0
        if j < 0:
            return self.errors[i - 1][0] if i > 0 else 0
        return self.errors[i][min(j, self.n_cols - 1)]

    def finish_row(self, i):
        """Fill in the activity of a row."""
        last = self.n_cols - 1
        e = [self.error(i, j) for j in range(-1, last + 2)]
        u = [0] * (last + 3)
        if i > 0:
            above = self.activity[i - 1]
            u = [above[0], *above, above[last]]

        def smooth(x, j):
            return x[j] + 2 * x[j + 1] + x[j + 2]

        self.activity[i] = [smooth(e, j) + (3 * smooth(u, j) >> 4) for j in range(last + 1)]

    def expected(self, i, j, x, core, p, off):
        """Return E."""
        lattice, plane = self.lattice, self.plane
        r, c = 2 * i + self.parity[0], 2 * j + self.parity[1]
        c1, c2, c3, c4 = sorted(core)
        f = {k: self.error(i + down, j + right) for k, (down, right) in enumerate(EARLIER)}
        f[6], f[7] = (
            sum(lattice.of_plane(lattice.errors, r + a, c + b) for a, b in places)
            for places in (NEAR_ERRORS[plane], FAR_ERRORS[plane])
        )
        f[8] = sum(lattice.curvature(r + a, c + b) for a, b in BENT[plane])
        f[9] = c4 - c1
        f[10] = abs((c2 + c3) * 32 - p)
        f[11] = abs((c1 + c4) * 32 - p)
        # In this order the core has its diagonals outside and inside for HH, its axes for others.
        if plane == "HH":
            f[12] = abs(core[0] + core[3] - core[1] - core[2])
        else:
            f[12] = abs(core[0] + core[1] - core[2] - core[3])
        f[13] = sum(abs(x[a] - x[b] - x[d] + x[e]) for a, b, d, e in LINES[plane])
        f[14] = off
        f[15] = 1
        f[16] = self.activity[i - 1][j] if i > 0 else 0
        f[17] = sum(
            lattice.of_plane(lattice.activity, 2 * (i + down) + PARITY[name][0], 2 * j + 1)
            for name, down in ACTIVE[plane]
        )
        w = self.weights
        d = 64 * sum(w[k] * f[k] for k in (8, 9, 12, 13)) + sum(w[k] * f[k] for k in (10, 11, 14))
        total = sum(w[k] * f[k] for k in (*range(8), 15, 16, 17)) + self.scale.steps(d, -1)
        return min(total >> 6, 2**28 - 1)

    # P.7 --------------------------------------------------------------------------------------

    def bit(self, b, h):
        if self.is_mixed:
            return self.decoder.mean_bit(self.models, b, h)
        return self.decoder.bit(self.models, b)

    def mixed_bit(self, b, h, mixer):
        if self.is_mixed:
            return self.decoder.mixed_bit(self.models, b, h, self.mixers, mixer)
        return self.decoder.bit(self.models, b)

    def decode_detail(self, e, core, near, p):
        """Return q; `near` are the heights at W and N."""
        n, steps = self.header.step, self.scale.steps
        c1, c2, c3, c4 = core
        half, w = n >> 1, (p + 32) >> 6
        phi = p - 64 * w
        beta = clamp(((lg(e) - 24) >> 2) + 1, 0, 43)

        def rho(d):
            return min((lg(d + e + 77) - lg(e + 77)) >> 2, 7)

        six = [*core, *near]
        up = sum(x > w + half for x in six)
        down = sum(x < w - half for x in six)
        same = 6 - up - down
        if not self.bit(
            4 * (8 * beta + rho(steps(c4 - c1, 8))) + min(steps(abs(phi), -3), 3),
            1408 + 4 * (7 * beta + same) + min(up, down, 3),
        ):
            return 0

        def mu(d):
            g, s = max(e, 128), steps(abs(d), 2)
            size = min((lg(2 * s + g) - lg(g)) >> 2, 4)
            return 4 + size if d > 0 and s > 0 else 4 - size

        epsilon = sum(x < 24 + 4 * beta for x in (50, 61, 72, 84))
        side = min((steps(6 * abs(phi), -5) + 1) >> 1, 3)
        sigma = 3 + side if phi > 0 else 3 - side
        b = 9 * (9 * (7 * epsilon + sigma) + mu((c2 + c3) * 32 - p)) + mu((c1 + c4) * 32 - p)
        h = 5475 + 8 * (8 * (beta >> 2) + up) + down
        is_up = self.mixed_bit(2640 + b, h, beta >> 2)
        size = 1 + self.decode_size(beta, rho, is_up, p, core, six)
        return size if is_up else -size

    def decode_size(self, beta, rho, is_up, p, core, six):
        """Return |q| - 1."""
        half, w, steps = self.header.step >> 1, (p + 32) >> 6, self.scale.steps
        kappa = max(0, ((24 + 4 * (beta - 1)) >> 3) - 9) if beta else 0
        room = 64 * core[3] - p if is_up else p - 64 * core[0]
        reach = rho(steps(max(room, 0), 2))
        ahead = []  # upper parts that would bring the height to those of the neighbours
        for x in six:
            t = steps(abs(x - w) + half, 0)
            if (x > w) == bool(is_up) and t > 0:
                ahead.append((t - 1) >> kappa)
        ones = 0
        while ones < 14:
            beyond = min(sum(t > ones for t in ahead), 5)
            here = min(sum(t == ones for t in ahead), 2)
            b = 6179 + 14 * (8 * beta + reach) + ones
            h = 11107 + 18 * (14 * beta + ones) + 3 * beyond + here
            if not self.mixed_bit(b, h, 11 + (beta >> 2)):
                break
            ones += 1
        upper = ones
        if ones == 14:
            n_bits = self.decoder.unary(self.models, 22899, 31)
            upper = 13 + (1 << n_bits | self.decoder.raw(n_bits))
        low, model = 0, 22195 + 16 * beta + 4 * min(ones, 3)
        for k in range(min(kappa, 2)):
            bit = self.decoder.bit(self.models, model)
            low = 2 * low + bit
            model += 1 + bit if k == 0 else 0
        rest = max(kappa - 2, 0)
        return upper << kappa | low << rest | self.decoder.raw(rest)


def decode_predictive(file, unit, payload, valid, parent_unit, parent_heights):
    """Return the heights of the region (P.1)."""
    require(len(payload) >= 1, "payload of predictive is empty")
    flags = payload[0]
    require(flags < 4, "flags of predictive")
    decoder = mixing.MixingDecoder(payload[1:])
    shared = SharedDecoder(file, unit, decoder, valid, parent_unit, parent_heights)
    if parent_unit is None:
        stride = shared.decode_root_corners()
    else:
        shared.decode_shared()
        shared.take_parents()
        stride = 2
    source = decoder, Models(N_DETAIL_MODELS, DETAIL_STARTS), Mixers(22)
    scale = Scale(file.header.step)
    while stride > 1:
        stride //= 2
        lattice = Lattice(unit, stride, shared.heights)
        for plane in PLANES:
            decode_plane(file, lattice, plane, scale, flags, source, valid, shared.known)
    decoder.end()
    return shared.heights


def decode_plane(file, lattice, plane, scale, flags, source, valid, known):
    """Read the header of a plane and decode it, if it has samples (P.5)."""
    if (lattice.n_rows == 1 and PARITY[plane][0]) or (lattice.n_cols == 1 and PARITY[plane][1]):
        return
    number, kind = 0, 2
    if lattice.n_rows * lattice.n_cols >= 1024:
        number, kind = divmod(source[0].raw(6), 4)
    require(number < len(file.tables.stencils[plane]), "set of a plane")
    require(kind < len(file.tables.weights[plane]), "class of a plane")
    stencil = file.tables.stencils[plane][number]
    weights = file.tables.weights[plane][kind]
    PlaneDecoder(lattice, plane, stencil, weights, scale, file.header, flags, source).run(
        valid, known
    )
