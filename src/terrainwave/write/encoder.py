"""Pass B: code the units top down in a closed loop, depth first.

A unit needs only its parent's decoded block. The walk holds one chain of decoded ancestors in
memory, and subtrees run in parallel, in threads or on many machines. The result does not depend on
their order.
"""

import copy
import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from terrainwave.codec.group import encode_unit
from terrainwave.codec.refiner import Decoded, FittingRefiner, GroupSpec, Heights, Mask, Refiner
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.unit_specs import block_of_unit, unit_spec
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
from terrainwave.mesh.blocks import has_mesh
from terrainwave.write.job import Job
from terrainwave.write.passes.repeats import RepeatingSink, Repeats
from terrainwave.write.passes.resuming import KeptUnits
from terrainwave.write.pyramid import Pyramid

# On levels with fewer blocks, threads share units instead of subtrees.
_MIN_SUBTREES = 8

Stats = dict[Block, BlockStats]


class PayloadSink(RepeatingSink, Protocol):
    """Destination of finished payloads; called from several threads, in any order."""

    def leave_out(self, block: Block) -> None:
        """Record that all units below a block are void."""
        ...


class _Taken:
    """Keeps the payloads of a subtree, including those of repeated segments."""

    takes_repeats = False

    def __init__(self) -> None:
        self.payloads: dict[Block, bytes] = {}
        self.left_out: list[Block] = []

    def __call__(self, key: Block, payload: bytes) -> None:
        self.payloads[key] = payload

    def leave_out(self, block: Block) -> None:
        self.left_out.append(block)

    def repeat(self, head: Block, like: Block) -> None:
        raise AssertionError(f"{head} is coded by itself")


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


class Ancestor(NamedTuple):
    """A decoded block above a unit, without its apron."""

    block: Block
    region: Region
    heights: Heights


def distance_of(
    ancestor: Ancestor,
    core: Region,
    originals: Heights,
    mask: Mask,
    grid: Grid,
    limits: tuple[int, int] | None = None,
) -> int:
    """Return the largest distance of a core's valid originals from a surface (`measure_block`)."""
    stride = grid.stride(ancestor.block.level)
    row = core.row - ancestor.region.row * stride
    col = core.col - ancestor.region.col * stride
    return measure_block(ancestor.heights, stride, originals, mask, row, col, limits)


# Key of a unit, the decoded block above it, and that block's ancestors including itself.
Start = tuple[Block, Decoded | None, list[Ancestor]]


class UnitEncoder(ABC):
    """Encode all units of a raster, or those above a level, or those of a subtree.

    Parameters
    ----------
    on_samples : callable
        Called with the number of full-grid samples whose unit is finished, from any thread.
    last_level : int, optional
        The finest level to code; by default all levels.
    on_unit : callable, optional
        Called with the key of each unit and what it decodes to, from any thread.
    kept : KeptUnits, optional
        Store of coded subtrees, for a later run.
    """

    def __init__(
        self,
        grid: Grid,
        parameters: CodecParameters,
        pyramid: Pyramid,
        sink: PayloadSink,
        on_samples: Callable[[int], None],
        last_level: int | None = None,
        on_unit: Callable[[Block, Decoded], None] | None = None,
        kept: KeptUnits | None = None,
    ) -> None:
        self._grid = grid
        self._parameters = parameters
        self._pyramid = pyramid
        self._sink = sink
        self._on_samples = on_samples
        self._on_unit = on_unit
        self._last_level = grid.k_max if last_level is None else last_level
        # Called, from any thread, with the head of a finest segment whose units are all coded, and
        # the statistics of the blocks below it, which are then dropped.
        self.on_segment: Callable[[Block, Stats], None] | None = None
        self._stats: Stats = {}
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._kept_units = kept

    def run(self, crew: Crew) -> Stats:
        """Encode down to the last level; return range and measured error of every block.

        Without the finest level, nothing is measured.
        """
        crew.grow(lambda start: self._encode_part(*start), self._starts())
        return self._stats

    def _starts(self) -> list[Start]:
        return [(key, None, []) for key in self._grid.root_keys()]

    def _encode_part(
        self, key: Block, parent: Decoded | None, chain: list[Ancestor]
    ) -> list[Start]:
        """Encode a subtree, or the first unit of a large one; return the rest below it."""
        try:
            if key.is_root_key or math.prod(self._grid.level_blocks(key.level)) < _MIN_SUBTREES:
                return self._encode_unit(key, parent, chain)
            self._encode_subtree(key, parent, chain)
        except BaseException:
            # After Ctrl-C or on a full disk, subtrees in other threads end at their next unit.
            self._stopped.set()
            raise
        return []

    def run_subtree(self, head: Block, decoded: Callable[[Block], Decoded]) -> Stats:
        """Encode the groups of `head` and of all blocks below it, in this thread.

        `decoded` returns the decoded `head` and its ancestors. The statistics of ancestors cover
        only originals below `head`.
        """
        chain = []
        for level in range(head.level + 1):
            block = Block(level, head.row >> head.level - level, head.col >> head.level - level)
            chain.append(self._ancestor(block, decoded(block)))
        self._encode_subtree(head, decoded(head), chain)
        return self._stats

    def _encode_subtree(self, key: Block, parent: Decoded | None, chain: list[Ancestor]) -> None:
        if self._is_known(key, parent, chain):
            return
        if (
            self._kept_units is not None
            and key.level == self._kept_units.level
            and not key.is_root_key
        ):
            self._encode_kept(self._kept_units, key, parent, chain)
            self._finish_segments(self._finest_heads(key))
            return
        for start in self._encode_unit(key, parent, chain):
            if not self._stopped.is_set():
                self._encode_subtree(*start)
        if key.level == self._grid.k_max - SEGMENT_LEVELS:
            self._finish_segments([key])

    def _finest_heads(self, key: Block) -> list[Block]:
        """Return the blocks that begin the finest segments of a subtree."""
        heads, level = [key], self._grid.k_max - SEGMENT_LEVELS
        while heads[0].level < level:
            heads = self._grid.all_children(heads)
        return heads if heads[0].level == level else []

    def _finish_segments(self, heads: list[Block]) -> None:
        """Pass on finest segments whose units are all coded."""
        for head in heads:
            if self.on_segment is None or self._stopped.is_set():
                return
            if self._grid.segment_head(head) == head:
                self.on_segment(head, self._taken_below(head))

    def _taken_below(self, head: Block) -> Stats:
        """Remove and return the statistics of a finished segment's blocks."""
        blocks = [
            block for key in self._grid.segment_groups(head) for block in self._grid.children(key)
        ]
        with self._lock:
            return {block: self._stats.pop(block) for block in blocks if block in self._stats}

    def _is_known(self, key: Block, parent: Decoded | None, chain: list[Ancestor]) -> bool:
        """Return whether the source knows that all below a block is void, or of one height.

        Voids are then left out, and units of one height passed on.
        """
        grid = self._grid
        if key.is_root_key or parent is None:
            return False
        even = self._pyramid.even(key.level, grid.block_region(key))
        if even is None:
            return False
        if not even.is_valid:
            self._sink.leave_out(key)
        elif not self.repeats(key, parent, chain, int(even.value)):
            return False
        region = grid.full_region(key)
        self._on_samples(region.n_rows * region.n_cols)
        return True

    def repeats(self, key: Block, parent: Decoded, chain: list[Ancestor], target: int) -> bool:
        """Pass on all units below a block of one height if possible; not in this class."""
        return False

    def _encode_kept(
        self, kept: KeptUnits, key: Block, parent: Decoded | None, chain: list[Ancestor]
    ) -> None:
        """Take a subtree from an earlier run's work, or encode and store it."""
        found = kept.load(key)
        if found is None:
            part = self.apart(chain)
            part._sink = taken = _Taken()
            part._encode_subtree(key, parent, chain)
            if self._stopped.is_set():
                return
            more = part.found(chain) | {"left_out": [list(block) for block in taken.left_out]}
            found = taken.payloads, part._stats, more
            kept.save(key, *found)
        else:
            region = self._grid.full_region(key)
            self._on_samples(region.n_rows * region.n_cols)
        payloads, stats, more = found
        for unit, payload in payloads.items():
            self._sink(unit, payload)
        for block in more["left_out"]:
            self._sink.leave_out(Block(*block))
        with self._lock:
            self.take(more)
        self._note(stats)

    def apart(self, chain: list[Ancestor]) -> Self:
        """Return an encoder of a subtree below `chain` with separate results."""
        part = copy.copy(self)
        part._stats, part._kept_units, part.on_segment = {}, None, None
        return part

    def found(self, chain: list[Ancestor]) -> dict[str, Any]:
        """Return the results of `apart` other than statistics, as plain values for JSON."""
        return {}

    def take(self, more: dict[str, Any]) -> None:  # noqa: B027  most find nothing more
        """Merge the `found` of another encoder; the caller holds the lock."""

    def _encode_unit(
        self, key: Block, parent: Decoded | None, chain: list[Ancestor]
    ) -> list[Start]:
        """Encode one unit; return the units below it."""
        grid = self._grid
        spec = unit_spec(grid, self._parameters, key)
        target, mask = self._pyramid.targets(spec.level, spec.region)
        payload, decoded = self.code_unit(key, spec, parent, target, mask)
        self._sink(key, payload)
        if self._on_unit is not None:
            self._on_unit(key, decoded)
        blocks = grid.key_blocks(key)
        parts = [block_of_unit(grid, spec, decoded, block) for block in blocks]
        self._note_meshes(blocks, parts)
        if self._parameters.is_faithful and not key.is_root_key:
            self._measure_children(spec, chain[-1], decoded)
        if spec.level == grid.k_max:
            core = spec.core.slices_in(spec.region)
            is_measured = self.measured(spec.core, mask[core])
            self._measure(spec, blocks, chain, target[core], is_measured, decoded)
            self._on_samples(spec.core.n_rows * spec.core.n_cols)
            return []
        if spec.level == self._last_level:
            return []
        return [
            (block, part, [*chain, self._ancestor(block, part)])
            for block, part in zip(blocks, parts, strict=True)
        ]

    @abstractmethod
    def code_unit(
        self, key: Block, spec: GroupSpec, parent: Decoded | None, target: Heights, mask: Mask
    ) -> tuple[bytes, Decoded]:
        """Return the payload and the decoded form of a unit."""

    def measured(self, region: Region, mask: Mask) -> Mask:
        """Return which samples of a region of the full grid are originals: all valid ones."""
        return mask

    def _ancestor(self, block: Block, decoded: Decoded) -> Ancestor:
        """Return the samples of a decoded block, without its apron."""
        region = self._grid.block_region(block)
        framed = self._grid.block_region(block, self._parameters.apron)
        return Ancestor(block, region, decoded.heights[region.slices_in(framed)])

    def _note_meshes(self, blocks: list[Block], parts: list[Decoded]) -> None:
        """Update which blocks have meshes."""
        grid, apron = self._grid, self._parameters.apron
        for block, part in zip(blocks, parts, strict=True):
            inside = grid.block_region(block).slices_in(grid.block_region(block, apron))
            self._note({block: BlockStats(has_mesh=has_mesh(grid, block, part.mask[inside]))})

    def _measure_children(self, spec: GroupSpec, above: Ancestor, decoded: Decoded) -> None:
        """Update the statistics of the block that a group refines."""
        core = spec.core.slices_in(spec.region)
        apart = distance_of_children(above.heights, decoded.heights[core], decoded.mask[core])
        self._note({above.block: BlockStats(apart=apart)})

    def _measure(
        self,
        spec: GroupSpec,
        blocks: list[Block],
        chain: list[Ancestor],
        originals: Heights,
        mask: Mask,
        decoded: Decoded,
    ) -> None:
        """Update the statistics of the finest blocks of a unit and of all their ancestors."""
        grid = self._grid
        heights = decoded.heights[spec.core.slices_in(spec.region)]
        by_block: Stats = {}
        whole = BlockStats()
        for block in blocks:
            region = grid.block_region(block)
            at = region._replace(row=region.row - spec.core.row, col=region.col - spec.core.col)
            by_block[block] = measure_samples(originals, mask, heights, at)
            # Neighbouring blocks share a row or column of samples.
            whole.merge(by_block[block])
        for ancestor in chain:
            error = 0
            if not whole.is_empty:
                limits = whole.z_low, whole.z_high
                error = distance_of(ancestor, spec.core, originals, mask, grid, limits)
            by_block[ancestor.block] = BlockStats(whole.z_low, whole.z_high, error)
        self._note(by_block)

    def _note(self, found: Stats) -> None:
        """Merge results for blocks."""
        with self._lock:
            for block, stats in found.items():
                self._stats.setdefault(block, BlockStats()).merge(stats)


class TreeEncoder(UnitEncoder):
    """Encode units by a refiner; the other arguments are those of `UnitEncoder`."""

    def __init__(
        self,
        grid: Grid,
        refiner: Refiner,
        parameters: CodecParameters,
        *rest: Any,
        may_repeat: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(grid, parameters, *rest, **options)
        self._refiner = refiner
        self._repeats: Repeats | None = None
        if may_repeat and self._last_level == grid.k_max:
            self._repeats = Repeats(grid, parameters, self.code_unit)

    def repeats(self, key: Block, parent: Decoded, chain: list[Ancestor], target: int) -> bool:
        """Pass on all units below a block of one height if they have one height as well."""
        if self._repeats is None:
            return False
        below = self._repeats.code(key, parent, target, self._sink)
        if below is None:
            return False
        # The samples of this level suffice to measure the distance from coarser blocks, whose
        # surfaces are linear between them.
        region = self._grid.block_region(key)
        heights = np.full(region.shape, target, dtype=np.int32)
        mask = np.ones(region.shape, dtype=np.bool_)
        for above in chain:
            at = self._grid.stride(above.block.level) // self._grid.stride(key.level)
            row, col = (
                first - one * at for first, one in zip(region[:2], above.region[:2], strict=True)
            )
            error = measure_block(above.heights, at, heights, mask, row, col, (target, target))
            below[above.block] = BlockStats(target, target, error)
        self._note(below)
        return True

    def code_unit(
        self, key: Block, spec: GroupSpec, parent: Decoded | None, target: Heights, mask: Mask
    ) -> tuple[bytes, Decoded]:
        rest = partial(self._pyramid.remainders, spec.region) if spec.remainder_bytes else None
        own = None
        if spec.has_voids and not spec.is_finest:
            own = self._pyramid.own(spec.level, spec.region)
        kept = self.kept(key, spec, target, mask)
        return encode_unit(self._refiner, spec, parent, target, mask, rest, own, kept)

    def kept(self, key: Block, spec: GroupSpec, target: Heights, mask: Mask) -> Heights | None:
        """Return the heights of a unit that must come back exactly (`encode_unit`)."""
        return None
