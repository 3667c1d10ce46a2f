"""Method cdf97 (docs/FORMAT.md §7)."""

from types import SimpleNamespace

from terrainwave.reference import range_coder
from terrainwave.reference.basics import at_or_zero, clamp, read_varint, require, tables, zeros
from terrainwave.reference.range_coder import M, Models, bin_of, lg

TERM_WEIGHTS_97, E_WEIGHTS_97, RESIDUAL_STARTS, TREE_STARTS, BORDER_STARTS = tables(  # §7.8
    "cdf97.bin", ("h", 16, 4, 19), ("h", 8), ("H", 1527), ("H", 4124), ("H", 2860)
)


def extend(x):
    """Extend a line by two samples at both ends: sample i is at i + 2 (§7.2)."""
    n = len(x)
    if n == 1:
        return [x[0]] * 5
    at = dict(enumerate(x))
    at[-1] = 2 * at[0] - at[1]
    at[n] = 2 * at[n - 1] - at[n - 2]
    at[-2] = 2 * at[0] - at[2]
    at[n + 1] = 2 * at[n - 1] - at[n - 3]
    return [at[i] for i in range(-2, n + 2)]


def synthesise(extended, q2):
    """Return 2^14 times the sample at position q2 / 2 of an extended line (§7.2)."""
    i = q2 // 2 + 2
    x = extended
    if q2 % 2 == 0:
        return 18270 * x[i] - 943 * (x[i - 1] + x[i + 1])
    return 9687 * (x[i] + x[i + 1]) - 1495 * (x[i - 1] + x[i + 2])


def predict_region(unit, parent_unit, parent_heights):
    """§7.2, prediction of the region."""
    n_rows, n_cols = unit.rows.n, unit.cols.n
    if parent_unit is None:
        return [[0] * n_cols for _ in range(n_rows)]
    r_off = unit.rows.first - 2 * parent_unit.rows.first
    c_off = unit.cols.first - 2 * parent_unit.cols.first
    wide = []
    for row in parent_heights:
        x = extend(row)
        for i in (0, 1, -2, -1):
            x[i] = clamp(x[i], -(2**31), 2**31)
        wide.append([synthesise(x, c + c_off) for c in range(n_cols)])
    columns = [extend([row[c] for row in wide]) for c in range(n_cols)]
    return [
        [clamp((synthesise(columns[c], r + r_off) + 2**27) >> 28, -M, M) for c in range(n_cols)]
        for r in range(n_rows)
    ]


class BorderDecoder:
    """§7.3."""

    def __init__(self, h, unit, decoder, valid, parent_unit, parent_heights, heights):
        self.n = h.step
        self.m = 2**32 // self.n + 1
        self.reach = (h.border_rings - 1) // 2  # R
        self.unit = unit
        self.decoder = decoder
        self.models = Models(2860, BORDER_STARTS)
        self.valid = valid
        self.parent = parent_heights
        self.heights = heights
        self.known = [[False] * unit.cols.n for _ in range(unit.rows.n)]
        if parent_unit is not None:
            self.offset = (
                unit.rows.first - 2 * parent_unit.rows.first,
                unit.cols.first - 2 * parent_unit.cols.first,
            )

    def rebuild(self, h, q):
        return clamp(h + clamp(q, -self.m, self.m) * self.n, -M, M)

    def symbol(self, place, phase, s):
        if not self.valid[place[0]][place[1]]:
            return 0
        b = bin_of(min(s, 4095))
        if not self.decoder.bit(self.models, 36 * phase + b):
            return 0
        value = 1 + self.decoder.magnitude(
            self.models, 180 + 14 * (36 * phase + b), 2700 + 32 * phase, 0
        )
        return -value if self.decoder.raw(1) else value

    def put(self, place, z):
        self.heights[place[0]][place[1]] = z
        self.known[place[0]][place[1]] = True

    def near_sides(self, axis):
        """Lines within R of each shared side, side by side; those inside the region."""
        sides = (axis.core, axis.core + axis.n_core - 1)
        return [
            [p for p in range(side - self.reach, side + self.reach + 1) if 0 <= p < axis.n]
            for side, is_shared in zip(sides, axis.shared, strict=True)
            if is_shared
        ]

    def run(self):
        rows, cols = self.unit.rows, self.unit.cols
        # Corners.
        for near_rows in self.near_sides(rows):
            for near_cols in self.near_sides(cols):
                for place in ((r, c) for r in near_rows for c in near_cols):
                    if not self.known[place[0]][place[1]]:
                        self.corner(place)
        # Lines: rows, then columns.
        done = set()
        for near_rows in self.near_sides(rows):
            for r in near_rows:
                if r not in done:
                    done.add(r)
                    self.line([(r, cols.core + i) for i in range(cols.n_core)], cols.shared, False)
        done = set()
        for near_cols in self.near_sides(cols):
            for c in near_cols:
                if c not in done:
                    done.add(c)
                    self.line([(rows.core + i, c) for i in range(rows.n_core)], rows.shared, True)

    def corner(self, place):
        p = self.parent
        a, b = place[0] + self.offset[0], place[1] + self.offset[1]  # doubled
        i, j = a // 2, b // 2
        i1, j1 = min((a + 1) // 2, len(p) - 1), min((b + 1) // 2, len(p[0]) - 1)
        h = (p[i][j] + p[i][j1] + p[i1][j] + p[i1][j1] + 2) >> 2
        self.put(place, self.rebuild(h, self.symbol(place, 0, 16)))

    def d(self, place):
        return self.heights[place[0]][place[1]]

    def line(self, places, shared, is_column):
        length = len(places)
        f = self.reach + 1 if shared[0] else 0
        g = length - self.reach - 1 if shared[1] else length
        if f >= g:
            return
        r, c = places[0]
        n_parents = (length + 1) // 2
        if is_column:
            a, start = c + self.offset[1], (r + self.offset[0]) // 2
            lines = list(zip(*self.parent, strict=True))
        else:
            a, start = r + self.offset[0], (c + self.offset[1]) // 2
            lines = self.parent
        first, second = lines[a // 2], lines[min((a + 1) // 2, len(lines) - 1)]
        x = [first[start + i] + second[start + i] for i in range(n_parents)]
        extended = extend(x)
        p = [(synthesise(extended, i) + 2**14) >> 15 for i in range(length)]
        n = self.n
        for phase in (0, 1):
            last = before_last = 0  # l and l'
            for i in range(f, g):
                if i % 2 != phase:
                    continue
                if phase == 0:
                    kappa, t = 0, last + before_last
                else:
                    j = i + 1 if i + 1 < length else i - 1
                    a = self.d(places[i - 1]) - p[i - 1]
                    b = self.d(places[j]) - p[j]
                    kappa = (a + b) >> 1
                    t = (2 * abs(a - kappa) + 2 * abs(b - kappa)) // n + last
                beta = abs(p[i - 1] - 2 * p[i] + p[i + 1]) if 0 < i < length - 1 else 0
                s = 4 * t + min(8 * beta // n, 1024)
                v = self.symbol(places[i], phase, s)
                self.put(places[i], self.rebuild(p[i] + kappa, v))
                before_last, last = last, min(abs(v), 255)


JS, JZTR, JZTC = "JS", "JZTR", "JZTC"  # labels of nodes

GAIN = {
    "LL": [3153, 2275, 1687, 1269, 958, 725, 548, 415, 314, 238, 180, 136],
    "HL": [4050, 3104, 2242, 1663, 1251, 945, 715, 541, 409, 310, 234, 177],
    "HH": [5203, 4235, 2981, 2181, 1634, 1233, 933, 706, 534, 404, 305, 230],
}
GAIN["LH"] = GAIN["HL"]
BANDS = ("HL", "LH", "HH")

# Weights of the neighbours W, N, NW, NE, WW, NN (§7.5).
WEIGHTS = {"HL": (6, 6, 0, 2, 1, 1), "LH": (6, 6, 0, 2, 1, 1), "HH": (6, 5, 1, 2, 1, 1)}
HL_ALONG = (1, 13, 0, 0, 0, 2)
LH_ALONG = (13, 1, 0, 0, 2, 0)
NEIGHBOURS = ((0, -1), (-1, 0), (-1, -1), (-1, 1), (0, -2), (-2, 0))


def node_sizes(n_core_rows, n_core_cols):
    """Return R_t and C_t for t = 0 … T (§7.5)."""
    sizes = [(n_core_rows, n_core_cols)]
    while True:
        t = len(sizes)
        sizes.append((((n_core_rows - 1) >> t) + 1, ((n_core_cols - 1) >> t) + 1))
        if sizes[-1] == (1, 1):
            return sizes


def roughness(n, unit, parent_unit, parent_heights, size):
    """ϱ of the finest nodes (§7.5)."""
    found = zeros(*size)
    if parent_unit is None:
        return found
    p = parent_heights
    first_row = unit.rows.core_first // 2 - parent_unit.rows.first
    first_col = unit.cols.core_first // 2 - parent_unit.cols.first

    def at(i, j):
        return p[clamp(i, 0, len(p) - 1)][clamp(j, 0, len(p[0]) - 1)]

    for i in range(size[0]):
        for j in range(size[1]):
            r, c = first_row + i, first_col + j
            b = abs(at(r - 1, c) + at(r + 1, c) - 2 * at(r, c))
            b += abs(at(r, c - 1) + at(r, c + 1) - 2 * at(r, c))
            found[i][j] = min(4 * b // n, 1024)
    return found


def decode_coefficients(decoder, sizes, rough, along):
    """Return LL and, for each t and band, the coefficients as grids of nodes (§7.5)."""
    models = Models(4124, TREE_STARTS)
    n_transforms = len(sizes) - 1
    coefficients = [{band: zeros(*sizes[t + 1]) for band in BANDS} for t in range(n_transforms)]
    magnitudes = [{band: zeros(*sizes[t + 1]) for band in BANDS} for t in range(n_transforms)]
    labels = [
        [[None] * sizes[t + 1][1] for _ in range(sizes[t + 1][0])] for t in range(n_transforms)
    ]

    e = decoder.unary(models, 4092, 31)
    ll = (1 << e | decoder.raw(e)) - 1
    if ll and decoder.raw(1):
        ll = -ll

    for t in reversed(range(n_transforms)):
        n_rows, n_cols = sizes[t]
        for i in range(sizes[t + 1][0]):
            for j in range(sizes[t + 1][1]):
                is_root = t == n_transforms - 1
                if not is_root and labels[t + 1][i >> 1][j >> 1] != JS:
                    labels[t][i][j] = JZTC
                    continue
                exists = {"HL": j < n_cols >> 1, "LH": i < n_rows >> 1}
                exists["HH"] = exists["HL"] and exists["LH"]
                s = {}
                for band in BANDS:
                    s[band] = 0
                    if not is_root:
                        grid = magnitudes[t + 1][band]
                        i1, j1 = i >> 1, j >> 1
                        around = sum(
                            at_or_zero(grid, i1 + di, j1 + dj)
                            for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1))
                        )
                        s[band] = (2 * grid[i1][j1] + around) >> 2
                    weights = WEIGHTS[band]
                    if t == 0 and band == "HL" and along[0]:
                        weights = HL_ALONG
                    if t == 0 and band == "LH" and along[1]:
                        weights = LH_ALONG
                    for weight, (di, dj) in zip(weights, NEIGHBOURS, strict=True):
                        s[band] += weight * at_or_zero(magnitudes[t][band], i + di, j + dj)
                if t == 0:
                    s["HL"] += rough[i][j]
                    s["LH"] += rough[i][j]
                    s["HH"] += rough[i][j] >> 1
                n_js = (at_or_zero(labels[t], i, j - 1) == JS) + (
                    at_or_zero(labels[t], i - 1, j) == JS
                )
                b = bin_of(min(sum(s.values()) >> 1, 4095))
                if not decoder.bit(models, (3 * min(t, 4) + n_js) * 36 + b):
                    labels[t][i][j] = JZTR
                    continue
                labels[t][i][j] = JS

                def coefficient(number, s, is_not_zero, t=t):
                    b = bin_of(min(s >> 1, 4095))
                    zero_flag = 540 + (3 * min(t, 3) + number) * 36 + b
                    if not is_not_zero and not decoder.bit(models, zero_flag):
                        return 0
                    value = 1 + decoder.magnitude(
                        models,
                        972 + ((3 * min(t, 1) + number) * 36 + b) * 14,
                        3996 + 32 * number,
                        max(0, b // 3 - 6),
                    )
                    return -value if decoder.raw(1) else value

                size = 0  # what is added to S: the magnitudes read before
                for number, band in enumerate(BANDS):
                    if not exists[band]:
                        continue
                    must = band == "HH" and t == 0 and size == 0
                    value = coefficient(number, s[band] + size, must)
                    coefficients[t][band][i][j] = value
                    magnitudes[t][band][i][j] = min(abs(value), 255)
                    size += min(abs(value), 255)
    return ll, coefficients, magnitudes


def inverse_line(x):
    """§7.6, one line."""
    n = len(x)
    if n == 1:
        return x
    x = list(x)
    for first, w in ((0, 1817), (1, 3616), (0, -217), (1, -6497)):
        for i in range(first, n, 2):
            left = x[i - 1] if i > 0 else x[1]
            right = x[i + 1] if i + 1 < n else x[n - 2]
            x[i] -= (w * (left + right) + 2048) >> 12
    return x


def inverse_transform(ll, details, sizes):
    """Return the core's details, 64 to the quantum (§7.6)."""
    low = [[ll]]
    for t in reversed(range(len(details))):
        n_rows, n_cols = sizes[t]
        x = zeros(n_rows, n_cols)
        for grid, high_row, high_col in (
            (low, 0, 0),
            (details[t]["HL"], 0, 1),
            (details[t]["LH"], 1, 0),
            (details[t]["HH"], 1, 1),
        ):
            for r in range(high_row, n_rows, 2):
                for c in range(high_col, n_cols, 2):
                    x[r][c] = grid[r // 2][c // 2]
        columns = [inverse_line(column) for column in zip(*x, strict=True)]
        low = [inverse_line(row) for row in zip(*columns, strict=True)]
    return low


CURVES = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (1, 2), (2, 1))
EARLIER = (
    (0, -1), (0, -2), (-1, 0), (-1, -1), (-1, 1), (-1, -2), (-1, 2),
    (-2, 0), (-2, -1), (-2, 1), (-2, -2), (-2, 2),
)  # fmt: skip


def extended(line):
    """§7.7: two samples more at both ends."""
    last = len(line) - 1
    before = [2 * line[0] - line[min(k, last)] for k in (2, 1)]
    after = [2 * line[last] - line[max(last - k, 0)] for k in (1, 2)]
    return before + list(line) + after


def decode_residuals(decoder, n, is_coarse, base, weights, core, heights, known, is_coded):
    """§7.7, or §7.9 if `is_coarse`.

    `heights` and `known` are those of the region, `core` its place in them.
    """
    models = Models(1527, RESIDUAL_STARTS)
    wide = [extended(row) for row in base]
    wide = list(zip(*(extended(column) for column in zip(*wide, strict=True)), strict=True))
    shift = 0
    while n >> shift >= 4096:
        shift += 1
    inverse = 2**22 // (n >> shift)

    def steps(d, f):
        return ((min(d, 2**40) >> shift) * inverse) >> (22 - f)

    def cut(x):
        return clamp(x, -(2**30), 2**30)

    d = (n - 1) // 2 if is_coarse else n
    limit = 2**31 // d + 1
    n_rows, n_cols = len(base), len(base[0])
    errors, mus, signs = (zeros(n_rows, n_cols) for _ in range(3))
    for r in range(n_rows):
        for c in range(n_cols):
            terms = []
            for i, j in CURVES:
                places = {(a, b) for a in (-i, i) for b in (-j, j)}
                around = sum(wide[r + 2 + a][c + 2 + b] for a, b in places)
                terms.append(cut(around - len(places) * base[r][c]))
            terms += [at_or_zero(errors, r + a, c + b) for a, b in EARLIER]
            phase = 2 * (r % 2) + c % 2
            p = sum(w * t for w, t in zip(weights[phase], terms, strict=True))
            p = clamp((256 * base[r][c] + p) >> 8, -64 * M, 64 * M)
            h = (p + 32) >> 6
            phi = p - 64 * h
            i, j = core.row + r, core.col + c
            if is_coded(r, c):
                near = [
                    at_or_zero(mus, r + a, c + b)
                    for a, b in ((0, -1), (0, -2), (-1, 0), (-1, -1), (-1, 1), (-2, 0))
                ]
                total = sum(w * m for w, m in zip(E_WEIGHTS_97, near, strict=False))
                e_n, e_nw, e_ne = terms[9], terms[10], terms[11]
                slope = abs(e_n - e_nw) + abs(e_ne - e_n)
                total += E_WEIGHTS_97[7] + steps(E_WEIGHTS_97[6] * slope, -1)
                eta = clamp(((lg(min(total >> 4, 2**28 - 1)) - 24) >> 2) + 1, 0, 43)
                change = 0
                if decoder.bit(models, 4 * (44 * phase + eta) + min(steps(abs(phi), -3), 3)):
                    s_w, s_n, s_nw, s_ne, *_ = (
                        at_or_zero(signs, r + di, c + dj) for di, dj in NEIGHBOURS
                    )
                    west = 2 * s_w + s_nw
                    x = 0 if west < 0 else 1 if west == 0 else 2
                    y = clamp(2 * s_n + s_ne, -2, 2) + 2
                    side = min((steps(6 * abs(phi), -5) + 1) >> 1, 3)
                    sigma = 3 + side if phi > 0 else 3 - side
                    sign = -1 if decoder.bit(models, 704 + 7 * (5 * x + y) + sigma) else 1
                    eta = min(eta + 2, 43) if is_coarse else eta
                    kappa = max(0, ((20 + 4 * eta) >> 3) - 9)
                    value = 1 + decoder.magnitude(models, 879 + 14 * eta, 1495, kappa)
                    change = sign * (min(value, limit) * d + (d // 2 if is_coarse else 0))
                    signs[r][c] = sign
                heights[i][j] = clamp(h + change, -M, M)
            elif not known[i][j]:
                heights[i][j] = h
            if is_coded(r, c) or known[i][j]:
                mus[r][c] = min(steps(abs(64 * heights[i][j] - p), -1), 32767)
            errors[r][c] = cut(64 * heights[i][j] - base[r][c])


def decode_cdf97(file, unit, payload, valid, parent_unit, parent_heights):
    h = file.header
    n, rows, cols = h.step, unit.rows, unit.cols
    # §7.1
    require(len(payload) >= 1, "payload of cdf97 is empty")
    flags, at = payload[0], 1
    require(flags in (0, 1, 2, 3, 4), "flags of cdf97")
    with_coefficients, with_residuals, is_raw = flags & 1, flags & 2, flags & 4
    if is_raw:
        require(at < len(payload), "payload is cut off")
        width = payload[at]
        require(width <= 32, "width of raw heights")
        z, at = read_varint(payload, at + 1)
        base = -(z + 1) // 2 if z % 2 else z // 2
        require(abs(base) <= M, "base of raw heights")
    if with_coefficients:
        step_code, at = read_varint(payload, at)
        require(1 <= step_code <= 2**32, "step code")
        require(at < len(payload), "payload is cut off")
        byte, at = payload[at], at + 1
        require(byte < 64, "byte after the step code")
        rho, along = byte & 15, (byte >> 4 & 1, byte >> 5 & 1)
    if with_residuals:
        require(at < len(payload), "payload is cut off")
        weight_set, at = payload[at], at + 1
        require(weight_set < len(TERM_WEIGHTS_97), "set of weights")
    decoder = range_coder.RangeDecoder(payload[at:])

    heights = predict_region(unit, parent_unit, parent_heights)
    predicted = [list(row) for row in heights]
    border = BorderDecoder(h, unit, decoder, valid, parent_unit, parent_heights, heights)
    border.run()

    def is_coded(r, c):
        """Place in the core; the caller's r and c are inside it."""
        return (
            valid[rows.core + r][cols.core + c] and not border.known[rows.core + r][cols.core + c]
        )

    limit = 2**31 // n + 1
    if is_raw:
        # §7.4
        for r in range(rows.n_core):
            for c in range(cols.n_core):
                if is_coded(r, c):
                    z = base + min(decoder.raw(width), limit) * n
                    heights[rows.core + r][cols.core + c] = min(z, M)
        decoder.end()
        return heights

    sizes = node_sizes(rows.n_core, cols.n_core)
    rough = roughness(n, unit, parent_unit, parent_heights, sizes[1])
    x = zeros(rows.n_core, cols.n_core)
    if with_coefficients:
        ll, coefficients, _ = decode_coefficients(decoder, sizes, rough, along)

        def dequantised(t, band, q):
            if q == 0:
                return 0
            delta = clamp(step_code * n * 64 * GAIN[band][t] // 131072, 1, 2**40)
            size = min(abs(q), 2**40 // delta + 1) * 64 - (0 if band == "LL" else rho)
            value = (size * delta) >> 6
            return value if q > 0 else -value

        details = [
            {
                band: [[dequantised(t, band, q) for q in row] for row in grids[band]]
                for band in BANDS
            }
            for t, grids in enumerate(coefficients)
        ]
        x = inverse_transform(dequantised(len(sizes) - 2, "LL", ll), details, sizes)

    # §7.6
    base = [
        [
            clamp(64 * predicted[rows.core + r][cols.core + c] + x[r][c], -64 * M, 64 * M)
            for c in range(cols.n_core)
        ]
        for r in range(rows.n_core)
    ]
    core = SimpleNamespace(row=rows.core, col=cols.core)
    if with_residuals:
        weights = TERM_WEIGHTS_97[weight_set]
        is_coarse = h.features & 4 and unit.level < file.grid.k_max and n > 1
        decode_residuals(
            decoder, n, is_coarse, base, weights, core, heights, border.known, is_coded
        )
    else:
        for r in range(rows.n_core):
            for c in range(cols.n_core):
                if not border.known[core.row + r][core.col + c]:
                    heights[core.row + r][core.col + c] = (base[r][c] + 32) >> 6
    decoder.end()
    return heights
