"""Checks a BlockMesh by brute force; knows nothing of how it was made.

Plain Python integers and fractions: slow, and meant to be.
"""

from collections import Counter
from fractions import Fraction


def twice_area(p, q, r):
    """Points as (row, col)."""
    return (q[1] - p[1]) * (r[0] - p[0]) - (r[1] - p[1]) * (q[0] - p[0])


def grid_triangles(mask):
    """Return the triangles (of samples) that the full grid has, per quad; area 1 each."""
    found = []
    n_rows, n_cols = mask.shape
    for row in range(n_rows - 1):
        for col in range(n_cols - 1):
            corners = [(row, col), (row, col + 1), (row + 1, col + 1), (row + 1, col)]
            valid = [p for p in corners if mask[p]]
            if len(valid) == 4:
                found += [tuple(corners[:3]), (corners[0], corners[2], corners[3])]
            elif len(valid) == 3:
                found.append(tuple(valid))
    return found


def check_mesh(mesh, heights, mask, tolerance=None):
    """Assert that `mesh` is a height field over the valid grid; return its error in 1/16 quanta.

    `tolerance` in 1/16 quanta, or None for no bound. Positions of the mesh are in half samples.
    """
    points = [(int(r), int(c)) for r, c in zip(mesh.rows, mesh.cols, strict=True)]
    assert len(set(points)) == len(points), "two vertices at one place"
    n_rows, n_cols = mask.shape
    assert all(0 <= r <= 2 * (n_rows - 1) and 0 <= c <= 2 * (n_cols - 1) for r, c in points)
    triangles = [tuple(int(v) for v in t) for t in mesh.triangles]
    assert {v for t in triangles for v in t} == set(range(len(points))), "a vertex without triangle"
    wanted = grid_triangles(mask)
    worst = Fraction(0)
    seen = Counter()
    interior = Counter()
    total = 0
    for t in triangles:
        p = [points[v] for v in t]
        area = twice_area(*p)
        assert area > 0, f"triangle {p} has area {area}"
        total += area
        z = [int(mesh.heights[v]) for v in t]
        low_row, high_row = min(q[0] for q in p), max(q[0] for q in p)
        low_col, high_col = min(q[1] for q in p), max(q[1] for q in p)
        for row in range((low_row + 1) // 2, high_row // 2 + 1):
            for col in range((low_col + 1) // 2, high_col // 2 + 1):
                at = (2 * row, 2 * col)
                w = [twice_area(at, p[1], p[2]), twice_area(p[0], at, p[2])]
                w.append(area - w[0] - w[1])
                if min(w) < 0:
                    continue
                assert mask[row, col], f"void sample {(row, col)} is covered"
                plane = Fraction(sum(a * b for a, b in zip(w, z, strict=True)), area)
                worst = max(worst, abs(plane - 16 * int(heights[row, col])))
                seen[row, col] += 1
                interior[row, col] += min(w) > 0
    assert total == 4 * len(wanted), "the area is not that of the grid's triangles"
    assert max(interior.values(), default=0) <= 1, "two triangles over one sample"
    for sample in {p for t in wanted for p in t}:
        assert seen[sample] > 0, f"sample {sample} is not covered"
    _check_points_between(points, triangles, wanted)
    _check_edges(points, triangles, mask)
    if tolerance is not None:
        assert worst <= tolerance, f"error {float(worst)} above {tolerance}"
    return worst


def _check_points_between(points, triangles, wanted):
    """Assert that inner points of the grid's triangles lie in exactly one triangle, others in none.

    With total areas equal, one point per grid triangle leaves no room for overlap: points of the
    grid's own triangles are tested at (1/3 + small, …), off all lines between samples.
    """
    by_cell = {}
    for index, t in enumerate(triangles):
        p = [points[v] for v in t]
        for row in range(min(q[0] for q in p) // 2, (max(q[0] for q in p) + 1) // 2 + 1):
            for col in range(min(q[1] for q in p) // 2, (max(q[1] for q in p) + 1) // 2 + 1):
                by_cell.setdefault((row, col), []).append(index)
    scale = 3000007
    for t in wanted:
        cell = min(p[0] for p in t), min(p[1] for p in t)
        weights = (1000003, 1000033, scale - 1000003 - 1000033)
        at = tuple(sum(w * 2 * p[k] for w, p in zip(weights, t, strict=True)) for k in (0, 1))
        n_inside = 0
        for index in set(by_cell.get(cell, [])):
            p = [tuple(scale * x for x in points[v]) for v in triangles[index]]
            n_inside += (
                twice_area(at, p[1], p[2]) >= 0
                and twice_area(p[0], at, p[2]) >= 0
                and twice_area(p[0], p[1], at) >= 0
            )
        assert n_inside == 1, f"{n_inside} triangles over a point of {t}"


def _check_edges(points, triangles, mask):
    used = Counter()
    for t in triangles:
        used.update(((t[0], t[1]), (t[1], t[2]), (t[2], t[0])))
    assert max(used.values(), default=0) <= 1, "an edge is used twice in one direction"
    lone = {(a, b) for a, b in used if (b, a) not in used}
    n_rows, n_cols = mask.shape
    last_row, last_col = 2 * (n_rows - 1), 2 * (n_cols - 1)
    grid_lone = Counter()
    for t in grid_triangles(mask):
        p = [(2 * r, 2 * c) for r, c in t]
        if twice_area(*p) < 0:
            p = [p[0], p[2], p[1]]
        grid_lone.update(((p[0], p[1]), (p[1], p[2]), (p[2], p[0])))
    grid_lone = {e for e in grid_lone if (e[1], e[0]) not in grid_lone}
    for a, b in lone:
        p, q = points[a], points[b]
        on_side = (
            (p[0] == q[0] and p[0] in (0, last_row)) or (p[1] == q[1] and p[1] in (0, last_col))
        )  # fmt: skip
        assert on_side or (p, q) in grid_lone, f"edge {p} {q} is open inside the grid"
    # Euler: vertices - edges + faces, component by component over shared edges, equals that of the
    # grid's own triangles: nothing was closed or torn.
    n_edges = len({tuple(sorted(e)) for e in used})
    euler = len(points) - n_edges + len(triangles)
    grid = grid_triangles(mask)
    grid_points = {p for t in grid for p in t}
    grid_edges = {tuple(sorted((t[i], t[(i + 1) % 3]))) for t in grid for i in range(3)}
    assert euler == len(grid_points) - len(grid_edges) + len(grid), "Euler characteristic"
