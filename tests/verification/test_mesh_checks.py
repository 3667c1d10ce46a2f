"""Does the checker of meshes find what is wrong, and nothing where nothing is?"""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.verification.checks import (
    ABC,
    ABD,
    ACD,
    BCD,
    WHOLE,
    CheckedMesh,
    coverage,
    deviation,
    pieces_of_mask,
    problems_of,
    refined_pieces,
)
from terrainwave.verification.on_grid import border_line, line_problems

CORNERS = {ABC: "abc", ACD: "acd", ABD: "abd", BCD: "bcd"}


def grid_surface(mask, heights=None):
    """Return the mesh of all samples: what a builder that merges nothing makes."""
    n_rows, n_cols = mask.shape
    rows, cols = np.indices(mask.shape)
    triangles = []
    for row in range(n_rows - 1):
        for col in range(n_cols - 1):
            a = row * n_cols + col
            at = {"a": a, "b": a + 1, "c": a + n_cols + 1, "d": a + n_cols}
            piece = int(pieces_of_mask(mask)[row, col])
            names = ["abc", "acd"] if piece == WHOLE else [CORNERS.get(piece, "")]
            triangles += [[at[name] for name in three] for three in names if three]
    triangles = np.array(triangles, dtype=np.int32).reshape(-1, 3)
    used, number = np.unique(triangles, return_inverse=True)
    z = np.zeros(mask.shape, np.int64) if heights is None else heights
    return CheckedMesh(
        2 * rows.ravel()[used], 2 * cols.ravel()[used], z.ravel()[used],
        number.reshape(-1, 3).astype(np.int32),
    )  # fmt: skip


def check(surface, mask):
    return list(problems_of(surface, mask.shape, pieces_of_mask(mask)))


masks = st.builds(
    lambda seed, n_rows, n_cols, share: np.random.default_rng(seed).random((n_rows, n_cols))
    < share,
    st.integers(0, 9999), st.integers(2, 8), st.integers(2, 8), st.sampled_from([0.4, 0.8, 2]),
)  # fmt: skip


@given(masks)
def test_the_full_grid_is_fine(mask):
    assert check(grid_surface(mask), mask) == []


@given(masks, st.sampled_from([1, 2, 3, 8]))
def test_refined_pieces_are_what_the_coarse_mesh_covers(mask, stride):
    coarse = grid_surface(mask)
    shape = (mask.shape[0] - 1) * stride + 1, (mask.shape[1] - 1) * stride + 1
    pieces, n_twice, _ = coverage(coarse.on_grid(stride), shape)
    assert n_twice == 0
    assert np.array_equal(pieces, refined_pieces(pieces_of_mask(mask), stride))


@given(masks, st.integers(0, 9999))
def test_deviation_is_exact(mask, seed):
    """Beside rationals; the mesh of every second sample, samples of all."""
    rng = np.random.default_rng(seed)
    coarse = grid_surface(mask, rng.integers(-900, 900, mask.shape)).on_grid(2)
    shape = 2 * mask.shape[0] - 1, 2 * mask.shape[1] - 1
    samples, valid = rng.integers(-900, 900, shape), rng.random(shape) < 0.8
    worst, covered = Fraction(0), np.zeros(shape, bool)
    for three in coarse.triangles:
        (r0, r1, r2), (c0, c1, c2) = coarse.rows[three].tolist(), coarse.cols[three].tolist()
        for row, col in np.argwhere(valid).tolist():
            r, c = 2 * row, 2 * col
            w = (
                (c1 - c) * (r2 - r) - (c2 - c) * (r1 - r),
                (c2 - c) * (r0 - r) - (c0 - c) * (r2 - r),
                (c0 - c) * (r1 - r) - (c1 - c) * (r0 - r),
            )
            if min(w) < 0:
                continue
            covered[row, col] = True
            height = sum(a * int(z) for a, z in zip(w, coarse.heights[three], strict=True))
            worst = max(worst, abs(Fraction(height, sum(w)) - int(samples[row, col])))
    for surface in (coarse, coarse._replace(heights=coarse.heights.astype(float))):
        found = deviation(surface, samples, valid, 10**6)
        assert found.worst - (surface is coarse) < worst + 1
        assert found.worst >= worst - Fraction(1, 256)
        assert np.array_equal(found.is_covered, covered)
    found = deviation(coarse, samples, valid, float(int(worst)))
    assert (found.n_beyond > 0) == (worst > int(worst))


MASK = np.ones((5, 6), dtype=bool)
HOLED = MASK.copy()
HOLED[2, 2] = False


def test_a_triangle_missing_twice_or_turned_over():
    surface = grid_surface(MASK)
    triangles = surface.triangles
    assert check(surface, MASK) == []
    assert "not covered" in " ".join(check(surface._replace(triangles=triangles[1:]), MASK))
    twice = np.concatenate([triangles, triangles[7:8]])
    found = " ".join(check(surface._replace(triangles=twice), MASK))
    assert "covered twice" in found
    assert "same direction" in found
    turned = triangles.copy()
    turned[5] = turned[5, ::-1]
    assert "turned over" in " ".join(check(surface._replace(triangles=turned), MASK))


def test_a_hole_that_is_covered_and_one_that_should_not_be():
    over = check(grid_surface(MASK), HOLED)
    assert any("over a void" in problem for problem in over)
    assert any("not covered" in problem for problem in check(grid_surface(HOLED), MASK))
    assert check(grid_surface(HOLED), HOLED) == []


def test_a_fold():
    surface = grid_surface(MASK)
    rows = surface.rows.copy()
    rows[2 * 6 + 2] += 3  # past the vertex below
    assert "turned over" in " ".join(check(surface._replace(rows=rows), MASK))


def test_a_t_junction():
    """One of two triangles is split on the edge they share, the other not."""
    surface = CheckedMesh(
        np.array([0, 0, 4, 4, 2]), np.array([0, 4, 4, 0, 2]), np.zeros(5, np.int64),
        np.array([[0, 1, 2], [0, 4, 3], [4, 2, 3]], np.int32),
    )  # fmt: skip
    mask = np.ones((3, 3), dtype=bool)
    found = " ".join(check(surface, mask))
    assert "boundary" in found
    whole = [[0, 1, 4], [4, 1, 2], [0, 4, 3], [4, 2, 3]]
    assert check(surface._replace(triangles=np.array(whole, np.int32)), mask) == []


def test_a_crack_between_equal_places():
    """Two vertices in one place: no gap in the plane, but two heights are possible."""
    surface = grid_surface(MASK)
    triangles = surface.triangles.copy()
    n = len(surface.rows)
    inner = 2 * 6 + 2
    t = np.flatnonzero((triangles == inner).any(axis=1))[0]
    triangles[t][triangles[t] == inner] = n
    split = CheckedMesh(
        np.append(surface.rows, surface.rows[inner]), np.append(surface.cols, surface.cols[inner]),
        np.append(surface.heights, 5), triangles,
    )  # fmt: skip
    found = " ".join(check(split, MASK))
    assert "lie on another one" in found
    assert "one side only" in found


@pytest.mark.parametrize("change", [-1, 1])
def test_borders_that_differ(change):
    rng = np.random.default_rng(0)
    heights = rng.integers(0, 99, (5, 11))
    left = grid_surface(np.ones((5, 6), bool), heights[:, :6])
    right = grid_surface(np.ones((5, 6), bool), heights[:, 5:])
    one, other = border_line(left, 1, 10), border_line(right, 1, 0)
    assert list(line_problems(one, other)) == []
    moved = other.heights.copy()
    moved[2] += change
    assert "two heights" in " ".join(line_problems(one, other._replace(heights=moved)))
    without = np.delete(other.edges, [1, 2], axis=0)
    without = np.concatenate([without, [[2, 6]]])
    bare = other._replace(
        places=np.delete(other.places, 2), heights=np.delete(other.heights, 2), edges=without
    )
    assert "inside an edge" in " ".join(line_problems(one, bare))
    assert "inside an edge" in " ".join(line_problems(bare, one))
