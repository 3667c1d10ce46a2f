"""Pass B: code the units top down in a closed loop, depth first.

A unit needs only its parent's decoded block. The walk holds one chain of decoded ancestors in
memory, and subtrees run in parallel, in threads or on many machines. The result does not depend on
their order.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from terrainwave.codec.group import encode_unit
from terrainwave.codec.refiner import (
    ALL_VALID,
    Decoded,
    FittingRefiner,
    GroupSpec,
    Heights,
    Mask,
    Refiner,
)
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.unit_specs import block_of_unit, unit_spec
from terrainwave.container.writer import SpoolSink
from terrainwave.grid.block_stats import (
    BlockStats,
    distance_of_children,
    measure_block,
    measure_samples,
)
from terrainwave.grid.crew import Crew
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid, Region
from terrainwave.grid.sample_windows import HeightsOf, MaskOf
from terrainwave.mesh.codes import has_mesh
from terrainwave.write.job import Job
from terrainwave.write.passes.found import Ancestor, Found, Start, Stats
from terrainwave.write.passes.resuming import KeptUnits
from terrainwave.write.pyramid import Pyramid

# On levels with fewer blocks, threads share units instead of subtrees.
_MIN_SUBTREES = 8
_CodeUnit = Callable[[Start, GroupSpec, Heights, Mask], tuple[bytes, Decoded]]


def fitted_refiner(job: Job, heights: HeightsOf, mask: MaskOf, crew: Crew) -> tuple[Refiner, bytes]:
    """Return the refiner of a job's method, and the tables that are fitted to the raster.

    `heights` and `mask` return targets and validity of a region of a level. The tables are empty if
    the method has none, or no sample is valid. The threads of `crew` fit them.
    """
    refiner = refiner_by_name(job.options.named_method.name)
    if not isinstance(refiner, FittingRefiner) or not job.n_valid:
        return refiner, b""
    fitted = refiner.fitted(job.grid, job.parameters.step, heights, mask, each=crew.map)
    return fitted, fitted.file_tables


def distance_of(
    ancestor: Ancestor,
    core: Region,
    originals: Heights,
    mask: Mask,
    stride: int,
    limits: tuple[int, int] | None = None,
) -> int:
    """Return the largest distance of a core's valid originals from a surface (`measure_block`)."""
    row = core.row - ancestor.region.row * stride
    col = core.col - ancestor.region.col * stride
    return measure_block(ancestor.heights, stride, originals, mask, row, col, limits)


@dataclass
class TreeEncoder:
    """Encoder of all units of a raster, or those above a level, or those of a subtree.

    Parameters
    ----------
    sink : SpoolSink, optional
        Takes payloads; without one they stay in `found`.
    on_samples : callable
        Called with the number of full-grid samples whose unit is finished, from any thread.
    refiner : Refiner, optional
        Codes units; None if a subclass does.
    last_level : int, optional
        The finest level to code; by default all levels.
    on_unit : callable, optional
        Called with the key of each unit and what it decodes to, from any thread.
    kept : KeptUnits, optional
        Store of coded subtrees, for a later run.
    may_repeat : bool
        Like segments have the same codes: those of one height are coded once.
    on_segment : callable, optional
        Called, from any thread, with the head of a finest segment whose units are all coded, and
        the statistics of the blocks below it, which are then dropped.
    """

    grid: Grid
    parameters: CodecParameters
    pyramid: Pyramid
    sink: SpoolSink | None = None
    on_samples: Callable[[int], None] = lambda _: None
    refiner: Refiner | None = None
    last_level: int | None = None
    on_unit: Callable[[Block, Decoded], None] | None = None
    kept: KeptUnits | None = None
    may_repeat: bool = False
    on_segment: Callable[[Block, Stats], None] | None = None

    def __post_init__(self) -> None:
        self.found = Found(self.sink)
        self._stopped = threading.Event()
        self._kept_level = -1 if self.kept is None else self.kept.level
        # The level of subtrees after which finest segments are passed on: all are kept then.
        finest = self.grid.k_max - SEGMENT_LEVELS
        self._finished_level = min(finest, self._kept_level) if self._kept_level >= 0 else finest
        self._repeats = None
        if self.may_repeat and self.last_level is None:
            self._repeats = Repeats(self.grid, self.parameters, self.code_unit)

    def run(self, crew: Crew) -> Stats:
        """Encode down to the last level; return range and measured error of every block.

        Without the finest level, nothing is measured.
        """
        starts = [Start(key, None, [], self.found) for key in self.grid.root_keys()]
        crew.grow(self._encode_part, starts)
        return self.found.stats

    def _encode_part(self, start: Start) -> list[Start]:
        """Encode a subtree, or the first unit of a large one; return the rest below it."""
        key = start.key
        try:
            if key.is_root_key or math.prod(self.grid.level_blocks(key.level)) < _MIN_SUBTREES:
                return self._encode_unit(start)
            self._encode_subtree(start)
        except BaseException:
            # After Ctrl-C or on a full disk, subtrees in other threads end at their next unit.
            self._stopped.set()
            raise
        return []

    def run_subtree(self, head: Block, decoded: Callable[[Block], Decoded]) -> Found:
        """Encode the groups of `head` and of all blocks below it, in this thread.

        `decoded` returns the decoded `head` and its ancestors. The statistics of ancestors cover
        only originals below `head`.
        """
        chain = []
        for level in range(head.level + 1):
            block = Block(level, head.row >> head.level - level, head.col >> head.level - level)
            chain.append(self._ancestor(block, decoded(block)))
        self._encode_subtree(Start(head, decoded(head), chain, self.found))
        return self.found

    def take(self, head: Block, found: Found) -> None:
        """Add the results of a subtree that another machine has coded."""
        self.found.take(found)
        self._finish_segments(head)

    def _encode_subtree(self, start: Start) -> None:
        key, is_whole = start.key, start.found is self.found
        if self._is_known(start):
            return
        if is_whole and self.kept is not None and key.level == self._kept_level:
            self._encode_kept(start, self.kept)
        else:
            for below in self._encode_unit(start):
                if not self._stopped.is_set():
                    self._encode_subtree(below)
        if is_whole and key.level == self._finished_level:
            self._finish_segments(key)

    def _encode_kept(self, start: Start, kept: KeptUnits) -> None:
        """Take a subtree from an earlier run's work, or encode and store it."""
        found = kept.load(start.key)
        if found is None:
            found = Found()
            self._encode_subtree(start._replace(found=found))
            if self._stopped.is_set():
                return
            kept.save(start.key, found)
        else:
            self._count(start.key)
        start.found.take(found)

    def _finish_segments(self, key: Block) -> None:
        """Pass on the finest segments of a subtree whose units are all coded."""
        grid, heads = self.grid, [key]
        while heads[0].level < grid.k_max - SEGMENT_LEVELS:
            heads = grid.all_children(heads)
        for head in heads:
            if self.on_segment is None or self._stopped.is_set():
                return
            if grid.segment_head(head) == head:
                groups = grid.segment_groups(head)
                blocks = [block for group in groups for block in grid.children(group)]
                self.on_segment(head, self.found.taken(blocks))

    def _is_known(self, start: Start) -> bool:
        """Return whether the source knows that all below a block is void, or of one height.

        Voids are then left out, and units of one height passed on.
        """
        key = start.key
        if start.parent is None:
            return False
        even = self.pyramid.even(key.level, self.grid.block_region(key))
        if even is None:
            return False
        if not even.is_valid:
            start.found.leave_out(key)
        elif not self._repeat(start, int(even.value)):
            return False
        self._count(key)
        return True

    def _repeat(self, start: Start, target: int) -> bool:
        """Pass on all units below a block of one height if they have one height as well."""
        below = None if self._repeats is None else self._repeats.code(start, target)
        if below is None:
            return False
        # The samples of this level suffice to measure the distance from coarser blocks, whose
        # surfaces are linear between them.
        stride = self.grid.stride(start.key.level)
        region = self.grid.block_region(start.key)
        heights = np.full(region.shape, target, dtype=np.int32)
        mask = np.ones(region.shape, dtype=np.bool_)
        for above in start.chain:
            at = self.grid.stride(above.block.level) // stride
            error = distance_of(above, region, heights, mask, at, (target, target))
            below[above.block] = BlockStats(target, target, error)
        start.found.note(below)
        return True

    def _count(self, block: Block) -> None:
        region = self.grid.full_region(block)
        self.on_samples(region.n_rows * region.n_cols)

    def _encode_unit(self, start: Start) -> list[Start]:
        """Encode one unit; return the units below it."""
        grid, key, chain = self.grid, start.key, start.chain
        spec = unit_spec(grid, self.parameters, key)
        target, mask = self.pyramid.targets(spec.level, spec.region)
        payload, decoded = self.code_unit(start, spec, target, mask)
        start.found.add(key, payload)
        if self.on_unit is not None:
            self.on_unit(key, decoded)
        blocks = grid.key_blocks(key)
        parts = [block_of_unit(grid, spec, decoded, block) for block in blocks]
        for block, part in zip(blocks, parts, strict=True):
            inside = grid.block_region(block).slices_in(
                grid.block_region(block, self.parameters.apron)
            )
            is_meshed = has_mesh(grid, block, part.mask[inside])
            start.found.note({block: BlockStats(has_mesh=is_meshed)})
        if self.parameters.is_faithful and chain:
            core = spec.core.slices_in(spec.region)
            above = chain[-1]
            apart = distance_of_children(above.heights, decoded.heights[core], decoded.mask[core])
            start.found.note({above.block: BlockStats(apart=apart)})
        if spec.level == grid.k_max:
            core = spec.core.slices_in(spec.region)
            self._measure(start, spec, target[core], mask[core], decoded)
            self.on_samples(spec.core.n_rows * spec.core.n_cols)
            return []
        if spec.level == self.last_level:
            return []
        return [
            Start(block, part, [*chain, self._ancestor(block, part)], start.found)
            for block, part in zip(blocks, parts, strict=True)
        ]

    def code_unit(
        self, start: Start, spec: GroupSpec, target: Heights, mask: Mask
    ) -> tuple[bytes, Decoded]:
        assert self.refiner is not None
        rest = partial(self.pyramid.remainders, spec.region) if spec.remainder_bytes else None
        own = None
        if spec.has_voids and not spec.is_finest:
            own = self.pyramid.own(spec.level, spec.region)
        restored = self.restored(start.key, spec, target, mask)
        return encode_unit(self.refiner, spec, start.parent, target, mask, rest, own, restored)

    def restored(self, key: Block, spec: GroupSpec, target: Heights, mask: Mask) -> Heights | None:
        """Return the heights of a unit that must come back exactly (`encode_unit`)."""
        return None

    def _ancestor(self, block: Block, decoded: Decoded) -> Ancestor:
        """Return the samples of a decoded block, without its apron."""
        region = self.grid.block_region(block)
        framed = self.grid.block_region(block, self.parameters.apron)
        heights = decoded.heights[region.slices_in(framed)]
        return Ancestor(block, region, np.ascontiguousarray(heights))

    def _measure(
        self, start: Start, spec: GroupSpec, originals: Heights, mask: Mask, decoded: Decoded
    ) -> None:
        """Update the statistics of the finest blocks of a unit and of all their ancestors."""
        grid = self.grid
        # Kernels take contiguous arrays: copied once.
        originals, mask = np.ascontiguousarray(originals), np.ascontiguousarray(mask)
        heights = np.ascontiguousarray(decoded.heights[spec.core.slices_in(spec.region)])
        by_block: Stats = {}
        whole = BlockStats()
        for block in grid.key_blocks(start.key):
            region = grid.block_region(block)
            at = region._replace(row=region.row - spec.core.row, col=region.col - spec.core.col)
            by_block[block] = measure_samples(originals, mask, heights, at)
            # Neighbouring blocks share a row or column of samples.
            whole.merge(by_block[block])
        for ancestor in start.chain:
            error = 0
            if not whole.is_empty:
                limits = whole.z_low, whole.z_high
                stride = grid.stride(ancestor.block.level)
                error = distance_of(ancestor, spec.core, originals, mask, stride, limits)
            by_block[ancestor.block] = BlockStats(whole.z_low, whole.z_high, error)
        start.found.note(by_block)


class _Below(NamedTuple):
    """Payload and decoded height of the units below a block, by level."""

    payloads: tuple[bytes, ...]
    heights: tuple[int, ...]


class Repeats:
    """Codes subtrees of one height, each distinct unit once; thread-safe.

    A unit's payload follows from its targets, the decoded block above it, and which sides have
    neighbours. So below a block whose samples have one height and which decodes to one height, all
    groups of a level have the same payload; so have all such blocks of a level that do not touch
    the raster's edge. Whole segments are copied from the first one.
    """

    def __init__(self, grid: Grid, parameters: CodecParameters, code_unit: _CodeUnit) -> None:
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
