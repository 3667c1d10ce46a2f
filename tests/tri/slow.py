"""The slow, obvious versions: trees as dictionaries, errors as fractions. Never imported by src."""

from fractions import Fraction

import numpy as np
from hypothesis import strategies as st


def axis_starts(n, height):
    """First samples of the nodes of that height along an axis; the last sample is a node itself."""
    return [*range(0, n - 1, 1 << height), n - 1]


def nodes(shape, height):
    """Yield (row, col, samples) of all nodes of a height, row by row."""
    n_rows, n_cols = shape
    for row in axis_starts(n_rows, height):
        rows = [row] if row == n_rows - 1 else range(row, min(row + (1 << height), n_rows - 1))
        for col in axis_starts(n_cols, height):
            cols = [col] if col == n_cols - 1 else range(col, min(col + (1 << height), n_cols - 1))
            yield row, col, [(r, c) for r in rows for c in cols]


def top_height(shape):
    height = 0
    while len(axis_starts(shape[0], height)) > 2 or len(axis_starts(shape[1], height)) > 2:
        height += 1
    return height


def full_grid(mask):
    """Triangles of the full grid, the right way round, as tuples of samples."""
    found = []
    for r in range(mask.shape[0] - 1):
        for c in range(mask.shape[1] - 1):
            ring = [(r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c)]
            valid = [p for p in ring if mask[p]]
            if len(valid) == 4:
                found += [(ring[0], ring[1], ring[2]), (ring[0], ring[2], ring[3])]
            elif len(valid) == 3:
                found.append(tuple(valid))
    return found


def at_void(mask):
    """Void samples and those of a quad with a void corner."""
    found = {(int(r), int(c)) for r, c in np.argwhere(~mask)}
    for r in range(mask.shape[0] - 1):
        for c in range(mask.shape[1] - 1):
            ring = {(r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c)}
            if not all(mask[p] for p in ring):
                found |= ring
    return found


def area(t):
    (r0, c0), (r1, c1), (r2, c2) = t
    return (c1 - c0) * (r2 - r0) - (c2 - c0) * (r1 - r0)


def error(heights, t):
    """Largest vertical deviation in quanta of the samples a triangle covers."""
    whole, worst = area(t), Fraction(0)
    for r in range(min(p[0] for p in t), max(p[0] for p in t) + 1):
        for c in range(min(p[1] for p in t), max(p[1] for p in t) + 1):
            w = [area(((r, c), t[1], t[2])), area((t[0], (r, c), t[2])), area((t[0], t[1], (r, c)))]
            if min(w) >= 0:
                z = sum(k * int(heights[p]) for k, p in zip(w, t, strict=True))
                worst = max(worst, abs(Fraction(z, whole) - int(heights[r, c])))
    return worst


def collapsed(triangles, root):
    """Pereberin's rule: corners move to their roots, triangles with two equal ones are dropped."""
    moved = [tuple(root[p] for p in t) for t in triangles]
    return [t for t in moved if len(set(t)) == 3]


def is_significant(trees, row, col, height):
    """Whether the node is JS: its sample lies in no zero tree of that height or more."""
    return trees[row, col] <= height


def algorithm_1(heights, mask, tolerance, trees=None, keep=None):
    """Y10 Algorithm I, checking the whole triangulation after each step; return the cut."""
    shape = mask.shape
    stay = at_void(mask)
    if keep is not None:
        stay |= {(int(r), int(c)) for r, c in np.argwhere(keep)}
    grid = full_grid(mask)
    root = {(r, c): (r, c) for r in range(shape[0]) for c in range(shape[1])}
    cut = dict.fromkeys(root, 0)
    for height in range(1, top_height(shape) + 1):
        for row, col, samples in nodes(shape, height):
            inside = set(samples)
            kids = [(r, c) for r, c, _ in nodes(shape, height - 1) if (r, c) in inside]
            if any(cut[p] != height - 1 for p in samples):
                continue
            if len(kids) > 1:
                if trees is not None and is_significant(trees, row, col, height):
                    continue
                if stay & (inside - {(row, col)}):
                    continue
                trial = root | dict.fromkeys(samples, (row, col))
                now = collapsed(grid, trial)
                if any(area(t) <= 0 for t in now):
                    continue
                new = set(now) - set(collapsed(grid, root))
                if any(16 * error(heights, t) > tolerance for t in new):
                    continue
                root = trial
            cut |= dict.fromkeys(samples, height)
    found = np.zeros(shape, dtype=np.uint8)
    for p, height in cut.items():
        found[p] = height
    return found


def algorithm_2(cut, mask, trees=None):
    """Y10 Algorithm II: the bits, by recursion, as a set of (height, row, col, bit)."""
    shape = mask.shape
    stay = at_void(mask)
    everything = {h: list(nodes(shape, h)) for h in range(top_height(shape) + 1)}
    bits = set()

    def visit(height, row, col, samples):
        if height == 0:
            return
        inside = set(samples)
        kids = [node for node in everything[height - 1] if (node[0], node[1]) in inside]
        forbidden = any(q in stay for q in inside - {(row, col)})
        if len(kids) > 1 and not forbidden and not (
            trees is not None and has_significant(trees, shape, height, samples)
        ):  # fmt: skip
            bit = int(cut[row, col] < height)
            bits.add((height, row, col, bit))
            if not bit:
                return
        for kid in kids:
            visit(height - 1, *kid)

    for node in everything[top_height(shape)]:
        visit(top_height(shape), *node)
    return bits


def has_significant(trees, shape, height, samples):
    """Whether a node or one below it, of more than one child, is JS."""
    inside = set(samples)
    for h in range(1, height + 1):
        for row, col, below in nodes(shape, h):
            if (row, col) not in inside:
                continue
            kids = [1 for r, c, _ in nodes(shape, h - 1) if (r, c) in set(below)]
            if len(kids) > 1 and is_significant(trees, row, col, h):
                return True
    return False


@st.composite
def terrains(draw, max_side=20, min_side=1):
    """Draw heights (int32, any values in voids), mask and a tolerance in 1/16 quanta."""
    shape = draw(st.integers(min_side, max_side)), draw(st.integers(min_side, max_side))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["smooth", "rough", "noise", "plane", "spikes", "extremes"]))
    rows, cols = np.indices(shape)
    if kind == "smooth":
        heights = 40 * np.sin(rows / 4 + rng.uniform(0, 6)) * np.cos(cols / 5 + rng.uniform(0, 6))
    elif kind == "rough":
        heights = np.cumsum(np.cumsum(rng.normal(0, 1, shape), 0), 1)
    elif kind == "noise":
        heights = rng.normal(0, 8, shape)
    elif kind == "plane":
        heights = 3 * rows - 5 * cols
    elif kind == "spikes":
        heights = 500 * (rng.random(shape) < 0.03)
    else:
        heights = rng.choice([-(1 << 30), 1 << 30], shape)
    heights = np.rint(heights).astype(np.int32)
    mask = rng.random(shape) >= draw(st.sampled_from([0, 0, 0, 0.02, 0.2, 0.6, 1]))
    if draw(st.booleans()) and min(shape) > 4:
        mask[: shape[0] // 3, shape[1] // 2 :] = False
    heights[~mask] = rng.integers(-(1 << 30), 1 << 30, int((~mask).sum()))
    tolerance = draw(st.sampled_from([0, 1, 7, 16, 40, 160, 1600, 1 << 40]))
    return heights, mask, tolerance


@st.composite
def zero_trees(draw, shape):
    """Draw zero trees over `shape`, built by the definition; None sometimes."""
    if draw(st.integers(0, 4)) == 0:
        return None
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    significant = rng.random(shape) < draw(st.sampled_from([0, 0.01, 0.1, 0.5]))
    trees = np.zeros(shape, dtype=np.uint8)
    for height in range(max(shape).bit_length(), -1, -1):
        size = 1 << height
        if height and max(shape) <= size >> 1:
            continue
        for row in range(0, shape[0], size):
            for col in range(0, shape[1], size):
                at = np.s_[row : row + size, col : col + size]
                # Some inner nodes are significant by coefficients of their own.
                if rng.random() < 0.1 and height:
                    continue
                if trees[row, col] == 0 and not significant[at].any():
                    trees[at] = height + 1
    return trees


def halves(heights, mask, locked, lines, tolerance, offset=(0, 0)):
    """The mesh of `tri.halves` as sets of samples, trying every cell in both passes.

    Returns (rows, cols, heights, triangles) as lists; intervals are of whole numbers of a unit, a
    sixteenth of a quantum or, for more than 2^30 of these, a quantum.
    """
    n_rows, n_cols = heights.shape
    h = {(r, c): int(heights[r, c]) for r in range(n_rows) for c in range(n_cols) if mask[r, c]}
    if min(heights.shape) < 2 or not h:
        return [], [], [], []
    low, high = min(h.values()), max(h.values())
    base, unit = (low + high) >> 1, 16 if (high - low) * 16 < 1 << 30 else 1
    slack = min(tolerance * unit // 16, 1 << 30)
    h = {p: (value - base) * unit for p, value in h.items()}
    limits = (low - base) * unit - slack, (high - base) * unit + slack
    # Of each sample, the first of its cell; of a cell, its vertex's doubled place and its height.
    cell = {p: p for p in h}
    place, z = {(r, c): (2 * r, 2 * c) for r, c in h}, dict(h)
    free = {p for p in h if not locked[p] and 0 < p[0] < n_rows - 1 and 0 < p[1] < n_cols - 1}
    sides = [[(0, c) for c in range(n_cols)], [(n_rows - 1, c) for c in range(n_cols)]]
    sides += [[(r, 0) for r in range(n_rows)], [(r, n_cols - 1) for r in range(n_rows)]]
    for side, is_vertex in zip(sides, lines, strict=True):
        for before, p, stays in zip(side, side[1:], is_vertex[1:], strict=False):
            if not stays:
                cell[p] = cell[before]
    grid = full_grid(mask)

    def interval(samples, centre):
        """Return the whole heights for the vertex of these samples, empty if an area is not > 0."""
        least, most = limits
        for t in grid:
            if sum(p in samples for p in t) != 1:
                continue
            while t[0] not in samples:
                t = (*t[1:], t[0])
            p_1, p_2 = cell[t[1]], cell[t[2]]
            if p_1 == p_2:
                continue
            corners = centre, place[p_1], place[p_2]
            whole = area(corners)
            if whole <= 0:
                return 1, 0
            for r in range(min(p[0] for p in corners) // 2, max(p[0] for p in corners) // 2 + 1):
                for c in range(
                    min(p[1] for p in corners) // 2, max(p[1] for p in corners) // 2 + 1
                ):
                    at = 2 * r, 2 * c
                    w_0, w_1 = area((at, *corners[1:])), area((corners[0], at, corners[2]))
                    w_2 = whole - w_0 - w_1
                    if w_0 > 0 and w_1 >= 0 and w_2 >= 0:
                        rest = h[r, c] * whole - w_1 * z[p_1] - w_2 * z[p_2]
                        least = max(least, -((slack * whole - rest) // w_0))
                        most = min(most, (rest + slack * whole) // w_0)
        return least, most

    def cells(height, width):
        for row in range(-offset[0] % height - height, n_rows, height):
            for col in range(-offset[1] % width - width, n_cols, width):
                rows = range(max(row, 1), min(row + height, n_rows - 1))
                cols = range(max(col, 1), min(col + width, n_cols - 1))
                if rows and cols:
                    yield row, col, [(r, c) for r in rows for c in cols]

    def merge(samples):
        (top, left), (bottom, right) = samples[0], samples[-1]
        centre = top + bottom, left + right
        least, most = interval(set(samples), centre)
        if least <= most:
            place[samples[0]], z[samples[0]] = centre, (least + most) // 2
            cell.update(dict.fromkeys(samples, samples[0]))
        return least <= most

    whole = {p: 0 for p in free}  # levels by sample
    for level in (6, 4, 2):
        for _, _, samples in cells(1 << level // 2, 1 << level // 2):
            if any(whole.get(p) != 0 for p in samples):
                continue
            (top, left), (bottom, right) = samples[0], samples[-1]
            a, b, c, d = h[top, left], h[top, right], h[bottom, right], h[bottom, left]
            middle = h[(top + bottom) // 2, (left + right) // 2]
            is_near = abs(a + c - b - d) <= 4 * slack
            is_near = is_near and abs(4 * middle - a - b - c - d) <= 8 * slack
            if (level == 2 or is_near) and merge(samples):
                whole.update(dict.fromkeys(samples, level))
    n_levels = (max(n_rows + offset[0], n_cols + offset[1]) - 2).bit_length()
    for level in [*range(1, 2 * n_levels + 1)] * 2:
        height, width = 1 << level // 2, 1 << (level + 1) // 2
        for row, col, samples in cells(height, width):
            middle = (row, col + width // 2) if level % 2 else (row + height // 2, col)
            first = [p for p in samples if p[0] < middle[0] or p[1] < middle[1]]
            second = [p for p in samples if p not in first]
            halves = [half for half in (first, second) if half]
            if any(whole.get(p) != level - 1 for half in halves for p in half):
                continue
            if len(halves) == 1 or merge(samples):
                whole.update(dict.fromkeys(samples, level))
    found = collapsed(grid, cell)
    used = sorted({p for t in found for p in t})
    number = {p: k for k, p in enumerate(used)}
    return (
        [place[p][0] for p in used],
        [place[p][1] for p in used],
        [z[p] * (16 // unit) + 16 * base for p in used],
        [[number[p] for p in t] for t in found],
    )
