"""SPIHT as docs/format-cdf53.md C.5 tells it: lists of Python, sets by recursion, no kernels.

`Spiht.run` walks through the planes; where a decision is due it asks `decide(model, truth)`, where
`truth` is what an encoder would say (None without a field). So one text is encoder and decoder.
"""

THRESHOLDS = (1, 2, 3, 4, 5, 6, 7, 9, 11, 14, 18, 24, 32, 40, 48)
HL, LH, HH = 0, 1, 2


class Stop(Exception):
    """A cut stream has no more decisions."""


class Spiht:
    """The coefficients of one field; a coefficient is (transform, band, row, column)."""

    def __init__(self, shape, n_transforms):
        self.sizes = [((shape[0] - 1 >> t) + 1, (shape[1] - 1 >> t) + 1) for t in range(99)]
        self.n_transforms = n_transforms
        self.places = {}
        for t in range(n_transforms - 1, -1, -1):
            for band in (HL, LH, HH):
                top, left, n_rows, n_cols = self.extent(t, band)
                for i in range(n_rows):
                    for j in range(n_cols):
                        self.places[t, band, i, j] = top + i, left + j
        self.at = {place: p for p, place in self.places.items()}
        self.known = dict.fromkeys(self.places, 0)
        self.sign = dict.fromkeys(self.places, 0)
        self.known_sets = set()

    def extent(self, t, band):
        (n_rows, n_cols), (low_rows, low_cols) = self.sizes[t], self.sizes[t + 1]
        top = low_rows if band in (LH, HH) else 0
        left = low_cols if band in (HL, HH) else 0
        return (
            top,
            left,
            (n_rows if top else low_rows) - top,
            (n_cols if left else low_cols) - left,
        )

    def parent(self, p):
        t, band, i, j = p
        above = (t + 1, band, i >> 1, j >> 1)
        return above if t + 1 < self.n_transforms and above in self.places else None

    def children(self, p):
        t, band, i, j = p
        return [
            q
            for q in ((t - 1, band, 2 * i + a, 2 * j + b) for a in (0, 1) for b in (0, 1))
            if q in self.places
        ]

    def descendants(self, p):
        for q in self.children(p):
            yield q
            yield from self.descendants(q)

    def members(self, kind, p):
        found = set(self.descendants(p))
        return found if kind == "D" else found - set(self.children(p))

    @staticmethod
    def shift(p):
        return max(p[0] - 1, 0) if p[1] == HH else p[0]

    @staticmethod
    def kappa(p):
        return 3 * min(p[0], 3) + p[1]

    def neighbour(self, p, down, across):
        row, col = self.places[p]
        return self.at.get((row + down, col + across))

    def units(self, p, b):
        return 0 if p is None else min(self.known[p] >> b, 6)

    def around(self, p, b):
        near = [self.neighbour(p, *d) for d in ((0, -1), (0, 1), (-1, 0), (1, 0))]
        far = [self.neighbour(p, *d) for d in ((-1, -1), (-1, 1), (1, -1), (1, 1))]
        total = 2 * sum(self.units(q, b) for q in [*near, self.parent(p)])
        total += sum(self.units(q, b) for q in far)
        return sum(threshold <= total for threshold in THRESHOLDS)

    def sign_at(self, p, down, across):
        q = self.neighbour(p, down, across)
        return 0 if q is None else self.sign[q]

    def pixel(self, p, b, first):
        value = self.values and self.values[p]
        truth = None if value is None else abs(value) >> b > 0
        if not self.decide(first + self.around(p, b), truth):
            return False
        x = min(max(self.sign_at(p, 0, -1) + self.sign_at(p, 0, 1), -1), 1)
        y = min(max(self.sign_at(p, -1, 0) + self.sign_at(p, 1, 0), -1), 1)
        truth = None if value is None else value < 0
        is_negative = self.decide(1440 + 9 * p[1] + 3 * (x + 1) + y + 1, truth)
        self.known[p] = 2**b
        self.sign[p] = -1 if is_negative else 1
        self.significant.append(p)
        return True

    def set_model(self, kind, p, b):
        k = 0
        for down in (-1, 0, 1):
            for across in (-1, 0, 1):
                k += (kind, self.neighbour(p, down, across)) in self.known_sets
        k = min(k, 7)
        if kind == "D":
            return 576 + 8 * (4 * self.kappa(p) + min(self.known[p] >> b, 3)) + k
        s = sum(self.known[q] > 0 for q in self.children(p))
        return 960 + 8 * (5 * self.kappa(p) + s) + k

    def run(self, n_planes, decide, field=None):
        """Walk through the planes; return the plane and how many lacked its bit at the end."""
        self.decide = decide
        self.values = None
        if field is not None:
            self.values = {
                p: int(field[place]) * 2 ** self.shift(p) for p, place in self.places.items()
            }
        roots = [p for p in self.places if self.parent(p) is None]
        self.pixels = list(roots)
        self.sets = [("D", p) for p in roots if self.children(p)]
        self.significant = []
        self.n_refined = self.n_old = 0
        for b in range(n_planes - 1, -1, -1):
            self.plane = b
            self.n_old, self.n_refined = len(self.significant), 0
            try:
                self.sort_pixels(b)
                self.sort_sets(b)
                self.refine(b)
            except Stop:
                return
        self.plane = 0

    def sort_pixels(self, b):
        pixels, self.pixels = self.pixels, []
        for p in pixels:
            if self.shift(p) > b:
                continue
            if not self.pixel(p, b, 16 * self.kappa(p)):
                self.pixels.append(p)

    def sort_sets(self, b):
        kept, at = [], 0
        while at < len(self.sets):
            kind, p = self.sets[at]
            at += 1
            truth = None
            if self.values:
                truth = any(abs(self.values[q]) >> b for q in self.members(kind, p))
            if not self.decide(self.set_model(kind, p, b), truth):
                kept.append((kind, p))
                continue
            self.known_sets.add((kind, p))
            if kind == "L":
                self.sets += [("D", q) for q in self.children(p) if self.children(q)]
                continue
            is_after = 0
            for q in self.children(p):
                first = 192 + 16 * (2 * self.kappa(q) + is_after)
                if self.shift(q) <= b and self.pixel(q, b, first):
                    is_after = 1
                else:
                    self.pixels.append(q)
            if self.members("L", p):
                self.sets.append(("L", p))
        self.sets = kept

    def refine(self, b):
        for at in range(self.n_old):
            p = self.significant[at]
            if self.shift(p) <= b:
                so_far = self.known[p] >> b + 1
                a = 0 if so_far == 1 else 1 if so_far < 4 else 2
                truth = self.values and abs(self.values[p]) >> b & 1
                if self.decide(1467 + 16 * a + self.around(p, b), truth):
                    self.known[p] += 2**b
            self.n_refined = at + 1

    def guesses(self):
        """Return the value of each significant coefficient by its place."""
        found = {}
        for at, p in enumerate(self.significant):
            e = self.plane + 1 if self.n_refined <= at < self.n_old else self.plane
            rest = 3 * 2**e >> 3 if e > self.shift(p) else 0
            found[self.places[p]] = self.sign[p] * (self.known[p] + rest >> self.shift(p))
        return found
