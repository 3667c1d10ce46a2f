"""Do the blocks of a level agree on their borders, in any order?"""

import random
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tri import slow
from tri.rasterise import check_mesh

from terrainwave.tri.block_mesh import BlockMesh
from terrainwave.tri.rqt import stored as rqt
from terrainwave.tri.zerotree import agreement
from terrainwave.tri.zerotree.connect import mesh_of_cut
from terrainwave.tri.zerotree.guarantee import guaranteed_cut
from terrainwave.tri.zerotree.labels import root_along


class Level:
    """A raster cut into blocks of `block` cells, clipped at its edge."""

    def __init__(self, heights, mask, tolerance, block, kind):
        self.heights, self.mask, self.tolerance = heights, mask, tolerance
        self.block, self.kind = block, kind
        rows, cols = (max(1, -(-(n - 1) // block)) for n in mask.shape)
        self.positions = [(i, j) for i in range(rows) for j in range(cols)]

    def part(self, position):
        row, col = (k * self.block for k in position)
        at = np.s_[row : row + self.block + 1, col : col + self.block + 1]
        return np.ascontiguousarray(self.heights[at]), np.ascontiguousarray(self.mask[at])

    def triangulate(self, position, demanded):
        heights, mask = self.part(position)
        keep = None if demanded is None else demanded.keep(mask.shape)
        if self.kind == "zerotree":
            return guaranteed_cut(heights, mask, self.tolerance, None, keep)
        coefficients = None
        if self.kind == "rqt by coefficients":  # alike in all blocks that share a sample
            coefficients = np.abs(heights.astype(np.int64)) % 97
        return rqt.select_vertices(
            heights, mask, self.tolerance, keep=keep, coefficients=coefficients
        )

    def border(self, position, result):
        if self.kind == "zerotree":
            return agreement.border_of_cut(result)
        return agreement.border_of(rqt.vertices_of(result, self.part(position)[1].shape))

    def agree(self, positions):
        def triangulate(position, demanded):
            return position, self.triangulate(position, demanded)

        found, n_rounds = agreement.agree(positions, triangulate, lambda pair: self.border(*pair))
        return {position: result for position, (_, result) in found.items()}, n_rounds

    def mesh(self, position, result):
        heights, mask = self.part(position)
        if self.kind == "zerotree":
            return mesh_of_cut(heights, mask, result)
        return rqt.rqt_mesh(heights, mask, result)

    def joined(self, results):
        """One mesh of all blocks: vertices at the same sample become one."""
        vertices, triangles = {}, []
        for position, result in results.items():
            mesh = self.mesh(position, result)
            rows = mesh.rows + 2 * self.block * position[0]
            cols = mesh.cols + 2 * self.block * position[1]
            places = list(zip(rows.tolist(), cols.tolist(), strict=True))
            for place, height in zip(places, mesh.heights.tolist(), strict=True):
                assert vertices.setdefault(place, (len(vertices), height))[1] == height
            triangles += [[vertices[places[v]][0] for v in t] for t in mesh.triangles.tolist()]
        places = np.array(list(vertices), dtype=np.int32).reshape(-1, 2)
        heights = np.array([h for _, h in vertices.values()], dtype=np.int64)
        return BlockMesh(
            places[:, 0],
            places[:, 1],
            heights,
            np.array(triangles, dtype=np.int32).reshape(-1, 3),
        )


KINDS = ["zerotree", "rqt", "rqt by coefficients"]


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", KINDS)
@given(terrain=slow.terrains(max_side=42, min_side=2), block=st.sampled_from([4, 8, 16]))
def test_blocks_of_a_level_join_without_a_crack(kind, terrain, block):
    heights, mask, tolerance = terrain
    level = Level(heights, mask, tolerance, block, kind)
    results, _ = level.agree(level.positions)
    bound = None if kind == "rqt by coefficients" else tolerance
    # Edges used twice, area once, Euler characteristic: of the whole raster at once.
    check_mesh(level.joined(results), heights, mask, bound)


@pytest.mark.parametrize("kind", KINDS)
@given(terrain=slow.terrains(max_side=42, min_side=9), seed=st.integers(0, 1000))
def test_order_does_not_matter(kind, terrain, seed):
    level = Level(*terrain, 8, kind)
    expected, n_rounds = level.agree(level.positions)
    shuffled = level.positions.copy()
    random.Random(seed).shuffle(shuffled)
    found, other_rounds = level.agree(shuffled)
    assert n_rounds == other_rounds
    for position in level.positions:
        np.testing.assert_array_equal(found[position], expected[position])


@given(terrain=slow.terrains(max_side=42, min_side=9), seed=st.integers(0, 1000))
def test_restricted_quadtree_needs_no_rounds(terrain, seed):
    # Its agreement is a least fixed point: any order of single updates reaches it.
    level = Level(*terrain, 8, "rqt")
    expected, _ = level.agree(level.positions)
    chance = random.Random(seed)
    results = {p: level.triangulate(p, None) for p in level.positions}
    borders = {p: level.border(p, results[p]) for p in level.positions}
    while True:
        late = [
            p
            for p in level.positions
            if agreement.lacks(borders[p], agreement.demands_on(p, borders))
        ]
        if not late:
            break
        p = chance.choice(late)
        results[p] = level.triangulate(p, agreement.demands_on(p, borders))
        borders[p] = level.border(p, results[p])
    for position in level.positions:
        np.testing.assert_array_equal(results[position], expected[position])


@given(terrain=slow.terrains(max_side=42, min_side=20), seed=st.integers(0, 1000))
def test_subtrees_that_exchange_border_bits_agree_as_one(terrain, seed):
    # Two workers, each with the blocks of its subtree, exchange borders between rounds.
    level = Level(*terrain, 8, "zerotree")
    expected, _ = level.agree(level.positions)
    parts = [[p for p in level.positions if (p[0] // 2 + p[1] // 2) % 2 == k] for k in (0, 1)]
    results, borders = {}, {}

    def work(part, known):
        done = {}
        for p in part:
            demanded = agreement.demands_on(p, known) if known else None
            if demanded is None or agreement.lacks(known[p], demanded):
                done[p] = level.triangulate(p, demanded)
        return done

    with ThreadPoolExecutor(2) as pool:
        while True:
            rounds = list(pool.map(work, parts, [dict(borders), dict(borders)]))
            fresh = rounds[0] | rounds[1]
            if not fresh:
                break
            results |= fresh
            borders |= {p: level.border(p, result) for p, result in fresh.items()}
    for position in level.positions:
        np.testing.assert_array_equal(results[position], expected[position])


def test_border_vertices_of_a_hand_worked_cut():
    # 5 x 5: one node of height 2 less the quarter at the top left, split to samples.
    cut = np.full((5, 5), 2, dtype=np.uint8)
    cut[:4, :4] = 1
    cut[:2, :2] = 0
    borders = agreement.border_of_cut(cut)
    assert borders.top.tolist() == [True, True, True, False, True]
    assert borders.left.tolist() == [True, True, True, False, True]
    assert borders.bottom.tolist() == borders.right.tolist() == [True, False, False, False, True]
    assert root_along(3, 5, 1) == 2
    keep = borders.keep((5, 5))
    assert np.argwhere(keep).tolist() == [
        [0, 0], [0, 1], [0, 2], [0, 4], [1, 0], [2, 0], [4, 0], [4, 4],
    ]  # fmt: skip


def test_demands_are_the_neighbours_vertices_and_its_own():
    # A block that gave up its own would lack them in the next round, and so on without end.
    nothing = np.zeros((5, 5), dtype=bool)
    one, other = nothing.copy(), nothing.copy()
    one[1, 4] = one[2, 0] = True
    other[3, 0] = other[2, 4] = True
    borders = {(0, 0): agreement.border_of(one), (0, 1): agreement.border_of(other)}
    demanded = agreement.demands_on((0, 0), borders)
    assert np.flatnonzero(demanded.right).tolist() == [1, 3]
    assert np.flatnonzero(demanded.left).tolist() == [2]
    assert agreement.lacks(borders[0, 0], demanded)
    assert not agreement.lacks(demanded, borders[0, 0])
