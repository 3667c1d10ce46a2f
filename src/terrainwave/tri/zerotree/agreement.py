"""Border vertices of the blocks of one level: the same on both sides (Y10 §2.7).

E. Yusov, V. Turlapov 2010: a vertex on a border in one block's selection must be in the other's as
well; levels of the tree are swept from the finest, and where a vertex is missing, detail is added.

Here a block's triangulation is a function of its own samples and of a set of vertices it must keep,
and it always has at least these. Agreement is the fixed point of rounds:

1. every block is triangulated, keeping nothing;
2. every block whose neighbours have border vertices that it lacks is triangulated again, keeping
   its own border vertices and theirs; and so on until no block lacks any.

Sets on the borders only grow, so this ends. A round reads only the border sets of the round before:
the result is a function of only the blocks, whatever the order or number of threads inside a round,
and wherever subtrees, files or machines divide the level: they exchange border bits.

For the restricted quadtree (`rqt`) adding vertices is a closure, monotone and idempotent: the
result is the least fixed point, with or without rounds. For Algorithm I the agreement of trees by
itself is monotone too (a cut refined to have a vertex, `labels.refine`), but its mesh may then
break the bound: triangles next to a node that is split again were never checked. Repairing them by
further splits is not monotone, and its result would depend on who came first. So the block is built
anew around the vertices to keep, always within the bound, and the rounds make that independent of
order.

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
            theirs = getattr(neighbour, other)
            if theirs.shape != flags.shape:
                raise ValueError(
                    f"blocks {position} and {(row + down, col + right)} share a side of"
                    f" {flags.size} and {theirs.size} samples"
                )
            flags = flags | theirs
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
