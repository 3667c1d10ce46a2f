"""What threads of the proof take in turns: every window once."""

from terrainwave.grid.quadtree import Grid, Region
from terrainwave.write.passes.proof import proof_shares


def flat(shares):
    return sorted(window for share in shares for window in share)


def test_a_few_windows_are_shared_out_one_by_one_the_largest_first():
    n = 1201
    grid = Grid(n, n, 256)
    shares = proof_shares(grid)
    assert flat(shares) == sorted(Region(0, 0, n, n).tiles(512, 512))
    assert {len(share) for share in shares} == {1}
    sizes = [share[0].n_rows * share[0].n_cols for share in shares]
    assert sizes == sorted(sizes, reverse=True)


def test_many_windows_are_shared_out_with_those_below_the_same_block():
    n = 4096
    grid = Grid(n, n, 256)
    shares = proof_shares(grid)
    assert flat(shares) == sorted(Region(0, 0, n, n).tiles(512, 512))
    assert [len(share) for share in shares] == [4] * 16
