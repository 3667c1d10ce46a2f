"""Subtrees of one height: each distinct unit is coded once, and its bytes are reused.

A unit's payload follows from its targets, the decoded block above it, and which sides have
neighbours. So below a block whose samples have one height and which decodes to one height, all
groups of a level have the same payload; so have all such blocks of a level that do not touch the
raster's edge. Whole segments are copied from the first one.
"""

import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from terrainwave.codec.refiner import ALL_VALID, Decoded, GroupSpec, Heights, Mask
from terrainwave.codec.unit_specs import unit_spec
from terrainwave.grid.block_stats import BlockStats
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid
from terrainwave.write.passes.found import Found, Start

CodeUnit = Callable[[Start, GroupSpec, Heights, Mask], tuple[bytes, Decoded]]


class _Below(NamedTuple):
    """Payload and decoded height of the units below a block, by level."""

    payloads: tuple[bytes, ...]
    heights: tuple[int, ...]


class Repeats:
    """Codes subtrees of one height; thread-safe.

    Parameters
    ----------
    code_unit : callable
        Codes a unit below a decoded block.
    """

    def __init__(self, grid: Grid, parameters: CodecParameters, code_unit: CodeUnit) -> None:
        self._grid = grid
        self._parameters = parameters
        self._code_unit = code_unit
        self._below: dict[tuple[int, int, int], _Below | None] = {}
        self._first_heads: dict[tuple[int, int, int], Block] = {}
        self._lock = threading.Lock()

    def code(self, start: Start, target: int) -> dict[Block, BlockStats] | None:
        """Pass on all units below a block; return the statistics of the blocks below.

        Repeated segments are represented by one block. None if the block is at the raster's edge,
        or something below it does not have one height. `target` is the height of all samples under
        the block and around it.
        """
        block, parent = start.key, start.parent
        if parent is None or not self._is_even(parent, height := int(parent.heights[0, 0])):
            return None
        if not self._grid.is_inside(block) or not self._is_whole(block):
            return None
        known = block.level, target, height
        with self._lock:
            if known not in self._below:
                self._below[known] = self._coded(start, target)
            below = self._below[known]
        if below is None:
            return None
        stats: dict[Block, BlockStats] = {}
        self._put(block, below, target, height, block.level, stats, start.found)
        return stats

    def _is_even(self, decoded: Decoded, height: int) -> bool:
        """Return whether all samples are valid and have one height."""
        if decoded.validity.own_mask is not None or decoded.remainders is not None:
            return False
        return bool((decoded.heights == height).all())

    def _is_whole(self, block: Block) -> bool:
        """Return whether the raster's edge cuts neither a unit below a block nor its apron."""
        shape = (2 * self._grid.block + 1 + 2 * self._parameters.apron,) * 2
        row, col = block.row, block.col
        for level in range(block.level, self._grid.k_max):
            spec = unit_spec(self._grid, self._parameters, Block(level, row, col))
            if spec.region.shape != shape:
                return False
            row, col = 2 * row + 1, 2 * col + 1  # the last one; others lie further inside
        return True

    def _coded(self, start: Start, target: int) -> _Below | None:
        """Code the first unit of each level below a block; None unless each has one height."""
        block, parent = start.key, start.parent
        payloads, heights = [], []
        for level in range(block.level, self._grid.k_max):
            depth = level - block.level
            key = Block(level, block.row << depth, block.col << depth)
            spec = unit_spec(self._grid, self._parameters, key)
            shape = spec.region.shape
            targets = np.full(shape, target, dtype=np.int32)
            mask = np.ones(shape, dtype=np.bool_)
            start = Start(key, parent, [], start.found)
            payload, decoded = self._code_unit(start, spec, targets, mask)
            height = int(decoded.heights[0, 0])
            if not self._is_even(decoded, height):
                return None
            payloads.append(payload)
            heights.append(height)
            n = self._grid.block_region(Block(level + 1, key.row * 2, key.col * 2)).n_rows
            apron = shape[0] - spec.core.n_rows
            parent = Decoded(np.full((n + apron,) * 2, height, dtype=np.int32), ALL_VALID)
        return _Below(tuple(payloads), tuple(heights))

    def _put(
        self,
        block: Block,
        below: _Below,
        target: int,
        height: int,
        top: int,
        stats: dict[Block, BlockStats],
        found: Found,
    ) -> None:
        """Pass on the payloads below a block that decodes to a height."""
        grid, depth = self._grid, block.level - top
        own = below.heights[depth]
        children = grid.children(block)
        if grid.segment_head(block) == block and self._is_repeated(block, target, height, found):
            error = max(abs(target - one) for one in below.heights[depth:])
            stats[children[0]] = BlockStats(target, target, error)
            if block.level + SEGMENT_LEVELS < grid.k_max:
                at = below.heights[depth + SEGMENT_LEVELS - 1]
                for head in grid.segment_children(block):
                    self._put(head, below, target, at, top, stats, found)
            return
        found.add(block, below.payloads[depth])
        for child in children:
            stats[child] = BlockStats(target, target, abs(target - own), has_mesh=True)
            if child.level < grid.k_max:
                self._put(child, below, target, own, top, stats, found)

    def _is_repeated(self, head: Block, target: int, height: int, found: Found) -> bool:
        """Return whether a segment equals an earlier one, and record that, if `found` can."""
        if found.repeat is None:
            return False
        known = head.level, target, height
        with self._lock:
            first = self._first_heads.setdefault(known, head)
        if first == head:
            return False
        found.repeat(head, first)
        return True
