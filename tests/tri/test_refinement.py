"""Algorithm II: which bits there are, that they come back, their rate, damage."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tri import slow

from terrainwave.errors import CorruptStreamError, TerrainwaveError, TruncatedStreamError
from terrainwave.tri.zerotree.guarantee import guaranteed_cut
from terrainwave.tri.zerotree.refinement import (
    decode_refinement,
    encode_refinement,
)


@given(terrain=slow.terrains(max_side=24), data=st.data())
def test_labels_come_back(terrain, data):
    heights, mask, tolerance = terrain
    trees = data.draw(slow.zero_trees(mask.shape))
    cut = guaranteed_cut(heights, mask, tolerance, trees)
    payload = encode_refinement(cut, heights, mask, tolerance, trees)
    back = decode_refinement(payload, heights, mask, tolerance, trees)
    np.testing.assert_array_equal(back, cut)


@given(terrain=slow.terrains(max_side=12), data=st.data())
def test_only_the_bits_of_algorithm_2_are_coded(terrain, data):
    heights, mask, tolerance = terrain
    trees = data.draw(slow.zero_trees(mask.shape))
    cut = guaranteed_cut(heights, mask, tolerance, trees)
    bits = slow.algorithm_2(cut, mask, trees)
    payload = encode_refinement(cut, heights, mask, tolerance, trees)
    # An adaptive model costs at most about half its log2 count, and there is one per height.
    heights_used = {h for h, *_ in bits}
    cost = 0.0
    for height in heights_used:
        ones = sum(bit for h, _, _, bit in bits if h == height)
        n = sum(1 for h, *_ in bits if h == height)
        for k in {ones, n - ones} - {0}:
            cost -= k * np.log2(k / n)
        cost += 0.5 * np.log2(n) + 2
    assert len(payload) <= 1 + cost / 8 + 2
    if not bits:
        assert len(payload) <= 2


def test_a_hand_worked_block_has_these_bits():
    # 5 x 5, nothing known from a zero tree; a single vertex (1, 1) more than the four corners.
    cut = np.full((5, 5), 2, dtype=np.uint8)
    cut[:4, :4] = 1
    cut[:2, :2] = 0
    assert slow.algorithm_2(cut, np.ones((5, 5), bool)) == {
        (2, 0, 0, 1), (2, 0, 4, 0), (2, 4, 0, 0),
        (1, 0, 0, 1), (1, 0, 2, 0), (1, 2, 0, 0), (1, 2, 2, 0),
    }  # fmt: skip
    heights = np.zeros((5, 5), dtype=np.int32)
    payload = encode_refinement(cut, heights, np.ones((5, 5), bool), 16)
    # 7 bits of which 2 are ones: at most a byte, and the byte that names the contexts.
    assert len(payload) <= 3


def test_the_example_of_the_annex():
    text = (Path(__file__).parents[2] / "docs" / "format-mesh-zerotree.md").read_text("utf-8")
    payload = bytes.fromhex(text.split("```")[1])
    heights = np.zeros((5, 5), dtype=np.int32)
    mask = np.ones((5, 5), dtype=bool)
    expected = [[0, 0, 1, 1, 2]] * 2 + [[1, 1, 1, 1, 2]] * 2 + [[2] * 5]
    assert decode_refinement(payload, heights, mask, 16).tolist() == expected
    cut = np.array(expected, dtype=np.uint8)
    assert encode_refinement(cut, heights, mask, 16) == payload


@pytest.mark.full
def test_rough_terrain_is_told_from_smooth_by_its_heights():
    rng = np.random.default_rng(3)
    rows, cols = np.mgrid[:129, :129]
    heights = np.rint(300 * np.sin(rows / 30) + rng.normal(0, 1, rows.shape) * (cols % 64 > 40) * 9)
    heights = heights.astype(np.int32)
    mask = np.ones(heights.shape, dtype=bool)
    cut = guaranteed_cut(heights, mask, 80)
    payload = encode_refinement(cut, heights, mask, 80)
    assert payload[0] == 1
    bits = slow.algorithm_2(cut, mask)
    cost = 0.0
    for height in {h for h, *_ in bits}:
        found = [bit for h, _, _, bit in bits if h == height]
        for k in {sum(found), len(found) - sum(found)} - {0}:
            cost -= k * np.log2(k / len(found))
    assert 8 * len(payload) < 0.8 * cost


@given(data=st.binary(max_size=60), terrain=slow.terrains(max_side=12), more=st.data())
def test_any_bytes_give_a_cut_or_our_own_error(data, terrain, more):
    heights, mask, tolerance = terrain
    trees = more.draw(slow.zero_trees(mask.shape))
    try:
        cut = decode_refinement(data, heights, mask, tolerance, trees)
    except TerrainwaveError:
        return
    assert cut.shape == mask.shape
    assert cut.max() <= slow.top_height(mask.shape)
    for height in range(1, cut.max() + 1):
        for row, col, samples in slow.nodes(mask.shape, height):
            if cut[row, col] == height:
                assert all(cut[p] == height for p in samples)


def test_damage_is_named():
    heights = np.zeros((3, 3), dtype=np.int32)
    mask = np.ones((3, 3), dtype=bool)
    payload = encode_refinement(guaranteed_cut(heights, mask, 0), heights, mask, 0)
    with pytest.raises(TruncatedStreamError, match="empty"):
        decode_refinement(b"", heights, mask, 0)
    with pytest.raises(CorruptStreamError, match="contexts 2"):
        decode_refinement(b"\2" + payload[1:], heights, mask, 0)
    with pytest.raises(CorruptStreamError, match="left over"):
        decode_refinement(payload + b"\0", heights, mask, 0)
