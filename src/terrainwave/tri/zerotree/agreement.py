"""Border vertices of the blocks of one level: the same on both sides (Y10 §2.7).

E. Yusov, V. Turlapov 2010: a vertex on a border in one block's selection must be in the other's as
well; levels of the tree are swept from the finest, and where a vertex is missing, detail is added.

Here a block's triangulation is a function of its own samples and of vertices it must keep, and it
has at least these. Agreement is the fixed point of rounds: every block is triangulated, keeping
nothing; then, again and again, every block whose neighbours have border vertices that it lacks,
keeping its own border vertices and theirs. Sets on the borders only grow, so this ends. A round
reads only the border sets of the round before: the result is a function of only the blocks,
whatever the order, or the threads, files or machines that divide the level and exchange border
bits.

Blocks are built anew because a cut that is refined to have a vertex may break the bound: triangles
next to a node that is split again were never checked, and repairs would depend on who came first.

Corners are vertices of every block and samples on a shared side are the same samples, so that two
sides are compared by position.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.tri.quads import Keep
from terrainwave.tri.zerotree.labels import Cut, root_along

Flags = NDArray[np.bool_]
Result = TypeVar("Result")
Position = tuple[int, int]


class BorderVertices(NamedTuple):
    """Samples on a block's four sides that are vertices, corners included."""

    top: Flags
    left: Flags
    bottom: Flags
    right: Flags

    def keep(self, shape: tuple[int, int]) -> Keep:
        keep = np.zeros(shape, dtype=np.bool_)
        keep[0] |= self.top
        keep[-1] |= self.bottom
        keep[:, 0] |= self.left
        keep[:, -1] |= self.right
        return keep


def border_of(vertices: Keep) -> BorderVertices:
    return BorderVertices(
        vertices[0].copy(), vertices[:, 0].copy(), vertices[-1].copy(), vertices[:, -1].copy()
    )


def border_of_cut(cut: Cut) -> BorderVertices:
    n_rows, n_cols = cut.shape
    sides = []
    for line, n in ((cut[0], n_cols), (cut[:, 0], n_rows), (cut[-1], n_cols), (cut[:, -1], n_rows)):
        sides.append(
            np.array([root_along(k, n, int(line[k])) == k for k in range(n)], dtype=np.bool_)
        )
    return BorderVertices(*sides)


def demands_on(position: Position, borders: Mapping[Position, BorderVertices]) -> BorderVertices:
    """Return the border vertices of a block (row, col) together with its neighbours'.

    `borders` by block position; blocks outside of it demand nothing. A corner is shared by four
    blocks, but it is a vertex of all of them.
    """
    row, col = position
    own = borders[position]
    demands = []
    for side, other, (down, right) in (
        ("top", "bottom", (-1, 0)), ("left", "right", (0, -1)),
        ("bottom", "top", (1, 0)), ("right", "left", (0, 1)),
    ):  # fmt: skip
        flags = getattr(own, side)
        neighbour = borders.get((row + down, col + right))
        if neighbour is not None:
            flags = flags | getattr(neighbour, other)
        demands.append(flags)
    return BorderVertices(*demands)


def lacks(own: BorderVertices, demanded: BorderVertices) -> bool:
    return any(bool((more & ~has).any()) for has, more in zip(own, demanded, strict=True))


def late_blocks(
    positions: Iterable[Position], borders: Mapping[Position, BorderVertices]
) -> dict[Position, BorderVertices]:
    """Return the blocks that lack border vertices of their neighbours, with all demands."""
    demands = {position: demands_on(position, borders) for position in positions}
    return {
        position: demanded
        for position, demanded in demands.items()
        if lacks(borders[position], demanded)
    }


def agree(
    positions: list[Position],
    triangulate: Callable[[Position, BorderVertices | None], Result],
    border: Callable[[Result], BorderVertices],
    run: Callable[..., Iterable[Result]] = map,
) -> tuple[dict[Position, Result], int]:
    """Return the triangulations of blocks of one level with equal borders, and the rounds it took.

    `positions` are (row, col) in blocks of their level, in any order. `triangulate` returns the
    triangulation of a block with at least the given border vertices (None: any), `border` its
    border vertices. `run`, as `map`, triangulates the blocks of one round, perhaps in threads. All
    results are held; to work out of core, keep only `border_of` results and use `late_blocks` in
    the same rounds.
    """
    nothing = [None] * len(positions)
    results = dict(zip(positions, run(triangulate, positions, nothing), strict=True))
    borders = {position: border(results[position]) for position in positions}
    n_rounds = 1
    while True:
        late = late_blocks(positions, borders)
        if not late:
            return results, n_rounds
        for position, result in zip(late, run(triangulate, late, late.values()), strict=True):
            results[position] = result
            borders[position] = border(result)
        n_rounds += 1
