"""Points put into a triangulation: it stays one, is near enough, and what is closed stays."""

import numpy as np
import pytest

from terrainwave.tri.insertion import insert_points

SIDE = 1 << 15
SQUARE = np.array([[0, 0], [SIDE, 0], [SIDE, SIDE], [0, SIDE]])
TWO = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def areas(places, triangles):
    a, b, c = (places[triangles[:, k]] for k in range(3))
    (x_1, y_1), (x_2, y_2) = (b - a).T, (c - a).T
    return x_1 * y_2 - x_2 * y_1


def edges(triangles):
    """Return how often each edge is there, in its direction."""
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    found, counts = np.unique(pairs, axis=0, return_counts=True)
    return {tuple(pair): n for pair, n in zip(found.tolist(), counts.tolist(), strict=True)}


def assert_covers_square(places, triangles, n_corners=4):
    twice = areas(places, triangles)
    assert (twice > 0).all()
    assert twice.sum() == 2 * SIDE**2
    found = edges(triangles)
    assert set(found.values()) == {1}
    border = {(a, b) for a, b in found if (b, a) not in found}
    assert len(border) == n_corners


def distances(places, heights, triangles, points, point_heights):
    """Return how far points are from the surface, by all triangles' barycentrics; slow."""
    apart = np.full(len(points), np.nan)
    for t, twice in zip(triangles, areas(places, triangles), strict=True):
        (a, b, c), (z_a, z_b, z_c) = places[t], heights[t]
        to = points - a
        w_c = ((b - a)[0] * to[:, 1] - (b - a)[1] * to[:, 0]) / twice
        w_b = (to[:, 0] * (c - a)[1] - to[:, 1] * (c - a)[0]) / twice
        inside = (w_b >= -1e-12) & (w_c >= -1e-12) & (w_b + w_c <= 1 + 1e-12)
        found = z_a + w_b * (z_b - z_a) + w_c * (z_c - z_a)
        apart[inside] = np.abs(found - point_heights)[inside]
    return apart


def hills(points):
    x, y = points.T / SIDE
    return 90 * np.sin(7 * x) * np.cos(5 * y) + 40 * x


@pytest.mark.parametrize("kind", ["random", "lattice", "diagonal"])
@pytest.mark.parametrize("tolerance", [0.0, 2.0, 40.0])
def test_every_point_within_is_near_enough(kind, tolerance):
    if kind == "random":
        points = np.random.default_rng(5).integers(1, SIDE, (400, 2))
    else:
        # Places on edges, most of all on the diagonal; some of them on the border and at corners.
        steps = np.arange(0, SIDE + 1, SIDE // 16)
        points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        if kind == "diagonal":
            points = points[points[:, 0] == points[:, 1]]
    heights, known = hills(points), hills(SQUARE)
    inserted, triangles = insert_points(
        SQUARE, known, TWO, np.ones(2, dtype=bool), points, heights, tolerance
    )
    places = np.concatenate([SQUARE, points[inserted]])
    assert len(set(inserted.tolist())) == len(inserted)
    assert len(triangles) == 2 + 2 * len(inserted)
    assert_covers_square(places, triangles)
    surface = np.concatenate([known, heights[inserted]])
    inner = ((points > 0) & (points < SIDE)).all(axis=1)
    apart = distances(places, surface, triangles, points[inner], heights[inner])
    assert apart.max() <= tolerance + 1e-9
    if tolerance:
        assert len(inserted) < inner.sum()


def test_triangles_become_no_slivers():
    """Of points in a row, without flips, all triangles would meet in the same two corners."""
    points = np.stack([np.arange(1, 64) * 512, np.full(63, SIDE // 2 + 8)], axis=1)
    heights = np.where(np.arange(63) % 2, 50.0, -50.0)
    inserted, triangles = insert_points(
        SQUARE, np.zeros(4), TWO, np.ones(2, dtype=bool), points, heights, 1.0
    )
    assert len(inserted) == 63
    found = edges(triangles)
    at = {int(number): 4 + k for k, number in enumerate(inserted)}
    assert all(
        (at[k], at[k + 1]) in found or (at[k + 1], at[k]) in found for k in range(len(points) - 1)
    )


def test_closed_triangles_keep_their_surface():
    is_open = np.array([True, False])
    points = np.random.default_rng(6).integers(1, SIDE, (300, 2))
    # Some on the edge between both, which both then have.
    points[:40, 1] = points[:40, 0]
    heights = hills(points) + 500
    inserted, triangles = insert_points(SQUARE, np.zeros(4), TWO, is_open, points, heights, 1.0)
    places = np.concatenate([SQUARE, points[inserted]])
    assert_covers_square(places, triangles)
    # None lies beyond the diagonal.
    assert (places[4:, 0] >= places[4:, 1]).all()
    assert (places[4:, 0] == places[4:, 1]).any()
    beyond = (places[triangles].mean(axis=1) @ (1, -1)) < 0
    assert (triangles[beyond] == 3).any(axis=1).all()


def test_vertices_keep_their_heights():
    inserted, triangles = insert_points(
        SQUARE, np.zeros(4), TWO, np.ones(2, dtype=bool), SQUARE, np.full(4, 9.0), 1.0
    )
    assert not len(inserted)
    assert (triangles == TWO).all()
