"""Meshes of `halves` against the slow, obvious version of tests/tri/slow.py."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.mesh.blocks import BlockSamples, SideTolerances, border_lines
from terrainwave.tri.halves import halves, workspace
from terrainwave.tri.halves.borders import beside_void
from terrainwave.tri.halves.halves import triangulate
from tests.tri import slow


def block(heights, mask, tolerance, offset=(0, 0), side=64):
    """What `triangulate` takes; beyond the rectangle its samples go on, voids included."""
    locked = beside_void(np.pad(mask, 1, mode="edge"))
    samples = BlockSamples(heights, mask, locked)
    sides = SideTolerances(tolerance, tolerance // 2, tolerance, tolerance // 3)
    return heights, mask, locked, border_lines(samples, sides, side, offset), tolerance, offset


def as_lists(mesh):
    return tuple(array.tolist() for array in mesh)


def rough(side, seed, reach):
    """Heights within +/- reach on a surface rough on all scales."""
    rng = np.random.default_rng(seed)
    surface = np.cumsum(np.cumsum(rng.normal(0, 1, (side, side)), 0), 1)
    surface += rng.normal(0, 0.3, (side, side))
    surface -= (surface.min() + surface.max()) / 2
    return np.rint(surface * (reach / abs(surface).max())).astype(np.int32)


@st.composite
def blocks(draw):
    heights, mask, tolerance = draw(slow.terrains(max_side=22))
    factor = draw(st.sampled_from([1, 1, 1, 700, 1 << 17]))
    if factor > 1 and abs(heights[mask]).max(initial=0) < (1 << 30) // factor:
        heights, tolerance = heights * np.int32(factor), tolerance * factor
    offset = draw(st.sampled_from([(0, 0), (0, 0), (5, 2), (16, 40), (31, 33)]))
    return block(heights, mask, tolerance, offset)


@given(blocks())
def test_mesh_is_that_of_the_obvious_version(made):
    assert as_lists(triangulate(*made)) == slow.halves(*made)


# Ranges in quanta: common ones; the last with programs and the first without; halves of quanta and
# whole ones only.
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("reach", "share"),
    [(60, 9), (5000, 60), ((1 << 20) - (1 << 17), 9), (1 << 20, 60), ((1 << 25) - 1, 9),
     (1 << 29, 60)],
)  # fmt: skip
def test_larger_mesh_is_that_of_the_obvious_version(reach, share):
    heights = rough(30, reach + share, reach)
    made = block(heights, np.ones(heights.shape, dtype=np.bool_), 16 * reach // share)
    mesh = triangulate(*made)
    assert as_lists(mesh) == slow.halves(*made)
    assert len(mesh.triangles) < 2 * 29 * 29  # something has merged


@pytest.mark.parametrize("reach", [200, (1 << 20) - (1 << 17)])
def test_programs_find_what_quotients_find(monkeypatch, reach):
    made = block(rough(65, 3, reach), np.ones((65, 65), dtype=np.bool_), 16 * reach // 12)
    expected = triangulate(*made)
    monkeypatch.setattr(halves, "MAX_PROGRAM_HEIGHT", -1.0)
    found = triangulate(*made)
    assert as_lists(found) == as_lists(expected)
    assert len(found.triangles) < 64 * 64  # of twice as many


def test_full_table_changes_no_mesh(monkeypatch):
    monkeypatch.setattr(workspace, "MEMORY", workspace._Memory())
    monkeypatch.setattr(halves, "MEMORY", workspace.MEMORY)
    made = block(rough(40, 8, 300), np.ones((40, 40), dtype=np.bool_), 16 * 8)
    expected = triangulate(*made)
    work = workspace.MEMORY.workspace(40, 40).work
    n_steps = int(work[workspace.N_USED])
    assert n_steps > 100
    work[: workspace.N_USED] = 0
    work[workspace.N_USED] = workspace.N_ENTRIES - n_steps // 2
    assert as_lists(triangulate(*made)) == as_lists(expected)
    assert workspace.N_ENTRIES - 64 <= work[workspace.N_USED] <= workspace.N_ENTRIES


def test_mesh_does_not_depend_on_what_a_thread_has_made_before():
    wide = block(rough(40, 1, 90).repeat(9, axis=1), np.ones((40, 360), np.bool_), 160, side=512)
    narrow = block(rough(40, 2, 90), np.ones((40, 40), dtype=np.bool_), 160)
    first = as_lists(triangulate(*narrow))
    assert as_lists(triangulate(*wide)) != first
    assert as_lists(triangulate(*narrow)) == first == slow.halves(*narrow)


def test_meshes_share_no_memory_with_the_next():
    made = block(rough(20, 5, 90), np.ones((20, 20), dtype=np.bool_), 160)
    mesh = triangulate(*made)
    kept = as_lists(mesh)
    triangulate(*block(rough(20, 6, 90), np.ones((20, 20), dtype=np.bool_), 16))
    assert as_lists(mesh) == kept
