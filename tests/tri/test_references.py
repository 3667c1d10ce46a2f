"""Do the kernels of `tri` give what the slow, obvious versions give?"""

from fractions import Fraction
from math import ceil

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from terrainwave.tri.block_mesh import BlockMesh
from terrainwave.tri.halves.borders import line_vertices
from terrainwave.tri.halves.height_fit import fit_triangle
from terrainwave.tri.mesh_distance import deviation_from_bilinear, largest_deviation

SIXTEENTHS = 16


def reference_line(heights, forced, offset, side, tolerance):
    """The rule of the docstring, by recursion from the largest interval down."""
    n, last = len(heights), offset + len(heights) - 1

    def is_vertex(middle, spacing):
        if offset <= middle <= last and forced[middle - offset]:
            return True
        half = spacing // 2
        if half and (is_vertex(middle - half, half) or is_vertex(middle + half, half)):
            return True
        if not offset < middle < last:
            return False
        start, stop = max(middle - spacing, offset), min(middle + spacing, last)
        first, rise = int(heights[start - offset]), int(heights[stop - offset])
        rise -= first
        return any(
            abs(int(heights[at - offset]) - first - Fraction(rise * (at - start), stop - start))
            > Fraction(7 * tolerance, 10)
            for at in range(start + 1, stop)
        )

    found = []
    for at in range(offset, last + 1):
        spacing = at & -at
        inner = 0 < at < side and is_vertex(at, spacing)
        found.append(inner or at in (offset, last) or bool(forced[at - offset]))
    assert len(found) == n
    return found


@given(st.data())
def test_line_vertices(data):
    side = data.draw(st.sampled_from([2, 4, 8, 32, 64]))
    offset = data.draw(st.integers(0, side - 1))
    n = data.draw(st.integers(2, side - offset + 1))
    reach = data.draw(st.sampled_from([3, 100, 1 << 30]))
    heights = np.array(data.draw(st.lists(st.integers(-reach, reach), min_size=n, max_size=n)))
    chance = data.draw(st.sampled_from([0, 0, 5, 60]))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    forced = rng.integers(0, 100, n) < chance
    tolerance = data.draw(st.integers(0, 2 * reach))
    found = line_vertices(heights.astype(np.int64), forced, offset, side, tolerance)
    assert found.tolist() == reference_line(heights, forced, offset, side, tolerance)


@given(st.integers(0, 9999), st.sampled_from([0, 3, 40]))
def test_vertices_of_a_tolerance_are_vertices_of_smaller_ones(seed, tolerance):
    heights = np.random.default_rng(seed).integers(-50, 50, 33)
    forced = np.zeros(33, bool)
    coarse = line_vertices(heights, forced, 0, 32, 2 * tolerance + 1)
    fine = line_vertices(heights, forced, 0, 32, tolerance)
    assert (fine | ~coarse).all()


def weights(triangle, row, col):
    """Twice the areas that a place makes with the edges, doubled places; None outside."""
    (r0, c0), (r1, c1), (r2, c2) = triangle
    found = (
        (c1 - col) * (r2 - row) - (c2 - col) * (r1 - row),
        (c2 - col) * (r0 - row) - (c0 - col) * (r2 - row),
        (c0 - col) * (r1 - row) - (c1 - col) * (r0 - row),
    )
    return found if min(found) >= 0 else None


@st.composite
def triangles(draw):
    rng = np.random.default_rng(draw(st.integers(0, 1 << 20)))
    reach = draw(st.integers(2, 15))
    while True:
        found = [tuple(place) for place in rng.integers(0, reach, (3, 2)).tolist()]
        (r0, c0), (r1, c1), (r2, c2) = found
        area = (c1 - c0) * (r2 - r0) - (c2 - c0) * (r1 - r0)
        if area:
            return found if area > 0 else found[::-1]


@given(triangles(), st.integers(0, 9999), st.integers(0, 30), st.sampled_from([0, 20, 1 << 30]))
def test_fit_triangle(triangle, seed, tolerance, base):
    rng = np.random.default_rng(seed)
    side = max(max(place) for place in triangle) // 2 + 2
    reach = rng.choice([2, 20, 60])
    heights = rng.integers(-reach, reach + 1, (side, side)).astype(np.int32)
    heights += np.int32(base - reach if base else 0)
    z_1, z_2 = (int(rng.integers(-reach, reach + 1)) + base for _ in range(2))
    low, high = base - 3 * reach - 40, base + 3 * reach + 40
    (r0, c0), (r1, c1), (r2, c2) = triangle
    found = fit_triangle(
        heights.ravel(), 0, side, (r0, c0), (r1, c1, float(z_1)), (r2, c2, float(z_2)),
        float(tolerance), float(low), float(high),
    )  # fmt: skip
    area = sum(weights(triangle, r0, c0))
    first, last = Fraction(low), Fraction(high)
    for row in range(side):
        for col in range(side):
            w = weights(triangle, 2 * row, 2 * col)
            if w is None or w[0] == 0:
                continue
            middle = Fraction(int(heights[row, col]) * area - w[1] * z_1 - w[2] * z_2, w[0])
            slack = Fraction(tolerance * area, w[0])
            first, last = max(first, middle - slack), min(last, middle + slack)
    first, last = ceil(first), last.__floor__()
    if first > last:
        assert found[0] > found[1]
    else:
        assert found == (first, last)


@st.composite
def meshes(draw):
    """A triangle or two that share an edge, over a window, with random heights."""
    triangle = draw(triangles())
    reach = draw(st.sampled_from([5, 3000, 1 << 32]))
    heights = draw(st.lists(st.integers(-reach, reach), min_size=3, max_size=3))
    rows, cols = np.array(triangle, dtype=np.int32).T
    return BlockMesh(
        rows.copy(), cols.copy(), np.array(heights, np.int64), np.array([[0, 1, 2]], np.int32)
    )


def surface_at(mesh, row, col, stride):
    """The height over a full-grid sample in 1/16 quanta, exactly; None outside."""
    triangle = [
        (int(r) * stride, int(c) * stride) for r, c in zip(mesh.rows, mesh.cols, strict=True)
    ]
    w = weights(triangle, 2 * row, 2 * col)
    if w is None:
        return None
    return Fraction(sum(a * int(z) for a, z in zip(w, mesh.heights, strict=True)), sum(w))


@given(meshes(), st.sampled_from([1, 2, 4, 64]), st.integers(0, 9999), st.booleans())
@settings(max_examples=80)
def test_largest_deviation(mesh, stride, seed, has_voids):
    rng = np.random.default_rng(seed)
    first = int(rng.integers(0, 4 * stride)), int(rng.integers(0, 4 * stride))
    samples = rng.integers(-900, 900, (9, 11)).astype(np.int32)
    mask = rng.random((9, 11)) < (0.7 if has_voids else 2)
    found = largest_deviation(mesh, stride, samples, mask, *first)
    apart = [Fraction(0)]
    for row, col in np.argwhere(mask).tolist():
        surface = surface_at(mesh, first[0] + row, first[1] + col, stride)
        if surface is not None:
            apart.append(abs(surface - SIXTEENTHS * int(samples[row, col])))
    assert ceil(max(apart)) <= found <= ceil(max(apart)) + (stride > 16)


def cut(polygon, axis, limit, sign):
    """The part of a convex polygon where ``sign * (place on the axis - limit) >= 0``, exactly."""
    part = []
    for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        inside_p, inside_q = sign * (p[axis] - limit), sign * (q[axis] - limit)
        if inside_p >= 0:
            part.append(p)
        if (inside_p > 0 > inside_q) or (inside_p < 0 < inside_q):
            share = Fraction(inside_p, inside_p - inside_q)
            part.append(tuple(a + share * (b - a) for a, b in zip(p, q, strict=True)))
    return part


def largest_in_cell(triangle, row, col, corners):
    """The largest distance of a triangle's part in a cell from the cell's bilinear surface.

    On every edge of that part it is a parabola: at its ends, or where that turns.
    """
    a, b, d, e = (SIXTEENTHS * int(v) for v in corners.ravel())

    def apart(place):
        y, x, z = place[0] - row, place[1] - col, place[2]
        return z - ((a * (1 - x) + b * x) * (1 - y) + (d * (1 - x) + e * x) * y)

    part = triangle
    for axis, first in ((0, row), (1, col)):
        part = cut(cut(part, axis, first, 1), axis, first + 1, -1)
    largest = Fraction(0)
    for p, q in zip(part, part[1:] + part[:1], strict=True):
        middle = tuple((u + v) / 2 for u, v in zip(p, q, strict=True))
        first, half, last = apart(p), apart(middle), apart(q)
        bend, slope = 2 * (first + last - 2 * half), 4 * half - 3 * first - last
        values = [first, last]
        if bend and 0 < -slope / (2 * bend) < 1:
            values.append(first - slope * slope / (4 * bend))
        largest = max(largest, *map(abs, values))
    return largest


@given(meshes(), st.integers(0, 9999), st.booleans())
@settings(max_examples=60)
def test_deviation_from_bilinear(mesh, seed, has_voids):
    """Exactly, by cutting the triangle at the lines of the grid: nothing between places is missed.

    Lines between cells belong to both; samples count in cells with voids, too.
    """
    rng = np.random.default_rng(seed)
    side = int(max(mesh.rows.max(), mesh.cols.max()) + 1) // 2 + 1
    samples = rng.integers(-900, 900, (side, side)).astype(np.int32)
    mask = rng.random((side, side)) < (0.9 if has_voids else 2)
    found = deviation_from_bilinear(mesh, samples, mask)
    triangle = [
        (Fraction(int(row), 2), Fraction(int(col), 2), Fraction(int(z)))
        for row, col, z in zip(mesh.rows, mesh.cols, mesh.heights, strict=True)
    ]
    apart = Fraction(0)
    for row, col in np.argwhere(mask).tolist():
        surface = surface_at(mesh, row, col, 1)
        if surface is not None:
            apart = max(apart, abs(surface - SIXTEENTHS * int(samples[row, col])))
    for row in range(side - 1):
        for col in range(side - 1):
            corners, valid = (part[row : row + 2, col : col + 2] for part in (samples, mask))
            if valid.all():
                apart = max(apart, largest_in_cell(triangle, row, col, corners))
    assert ceil(apart) <= found <= ceil(apart) + 1
