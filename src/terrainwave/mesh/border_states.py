"""Meshes of a subtree's blocks while they agree with their neighbours on border vertices.

Rounds are those of `tri.zerotree.agreement`: a block's draft is a function of its samples and of
the vertices demanded of it, so a state holds the demands and the resulting border vertices, but no
draft.
"""

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Block
from terrainwave.mesh.blocks import BlockMesher
from terrainwave.mesh.codes import has_triangles
from terrainwave.tri.zerotree import agreement
from terrainwave.tri.zerotree.agreement import BorderVertices

Demands = Mapping[Block, BorderVertices | None]


class BorderState(NamedTuple):
    """Border vertices of blocks, and the demands of each block's last triangulation."""

    borders: dict[Block, BorderVertices]
    demanded: dict[Block, BorderVertices]

    def late_blocks(self, beside: Iterable["BorderState"]) -> dict[Block, BorderVertices]:
        """Return the blocks that lack vertices of blocks here or in the states `beside`."""
        levels: dict[int, dict[agreement.Position, BorderVertices]] = {}
        for state in (*beside, self):
            for block, border in state.borders.items():
                levels.setdefault(block.level, {})[block.row, block.col] = border
        positions: dict[int, list[agreement.Position]] = {}
        for block in self.borders:
            positions.setdefault(block.level, []).append((block.row, block.col))
        return {
            Block(level, *position): demanded
            for level in positions
            for position, demanded in agreement.late_blocks(positions[level], levels[level]).items()
        }

    def updated(self, newer: "BorderState") -> "BorderState":
        return BorderState(self.borders | newer.borders, self.demanded | newer.demanded)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the state as arrays, one bit per position on a border."""
        arrays: dict[str, NDArray[Any]] = {}
        for name, borders in (("border", self.borders), ("demanded", self.demanded)):
            sizes = [(border.top.size, border.left.size) for border in borders.values()]
            flags = [side for border in borders.values() for side in border]
            arrays[f"{name}_blocks"] = np.array(list(borders), dtype=np.int64).reshape(-1, 3)
            arrays[f"{name}_sizes"] = np.array(sizes, dtype=np.int64).reshape(-1, 2)
            arrays[f"{name}_flags"] = np.packbits(np.concatenate([*flags, np.zeros(0, np.bool_)]))
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        return cls(*(_borders(arrays, name) for name in ("border", "demanded")))


def _borders(arrays: Mapping[str, NDArray[Any]], name: str) -> dict[Block, BorderVertices]:
    flags = np.unpackbits(arrays[f"{name}_flags"]).astype(np.bool_)
    borders, place = {}, 0
    for block, (n_cols, n_rows) in zip(
        arrays[f"{name}_blocks"].tolist(), arrays[f"{name}_sizes"].tolist(), strict=True
    ):
        ends = np.cumsum([0, n_cols, n_rows, n_cols, n_rows]) + place
        sides = [flags[first:end] for first, end in pairwise(ends)]
        borders[Block(*block)] = BorderVertices(*sides)
        place = int(ends[-1])
    return borders


def draft_blocks(mesher: BlockMesher, demands: Demands) -> BorderState:
    """Triangulate blocks, each with at least the demanded border vertices; void ones are left out.

    `mesher` is of a kind of `tri.stored_kinds`.
    """
    state = BorderState({}, {})
    for block, demanded in demands.items():
        if has_triangles(mesher.samples(block).mask):
            state.borders[block] = mesher.draft(block, demanded).border
            if demanded is not None:
                state.demanded[block] = demanded
    return state


def encode_parts(mesher: BlockMesher, state: BorderState) -> dict[Block, bytes]:
    """Return the bytes of the meshes of a state's blocks, once all agree."""
    return {
        block: mesher.encode(block, mesher.draft(block, state.demanded.get(block)))
        for block in state.borders
    }
