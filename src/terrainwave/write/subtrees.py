"""Tasks of one machine: each works on the subtree below one block.

A task reads a part of the raster and the results of other tasks in the depot, stores its own
results there and returns a few numbers: the client (`cluster`) sees neither heights nor payloads. A
task can be repeated and gives the same bytes. It runs in one thread. Its memory is bounded: each
level of the subtree has a spool of 20 MiB, the rest lies on the machine's disk.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import NamedTuple

from terrainwave.codec.refiner import Heights, Refiner
from terrainwave.codec.registry import refiner_by_name
from terrainwave.container.depot import Depot, StoredSegments, store_segments, stored_places
from terrainwave.container.spool import StoredSegment
from terrainwave.container.spool_sink import SpoolSink, copied_segments
from terrainwave.container.targets.publication import scratch_directory
from terrainwave.grid.block_stats import BlockStats
from terrainwave.grid.crew import Crew
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.mesh.blocks import BlockMesher, measure_meshes
from terrainwave.mesh.border_states import BorderState, draft_blocks, encode_parts
from terrainwave.mesh.sections import parts_of_blocks, sections_of_parts
from terrainwave.mesh.trees import tree_source
from terrainwave.raster_io.temporary import Spool
from terrainwave.read.decoder import TreeDecoder
from terrainwave.tri.stored_kinds import STORED_KINDS
from terrainwave.write.boxes import Box, Codes, recursive_errors
from terrainwave.write.encoder import TreeEncoder
from terrainwave.write.job import Job
from terrainwave.write.passes.bench import AskedRaster, Bench
from terrainwave.write.passes.found import Stats
from terrainwave.write.passes.proof import Proved, comparison_of, together
from terrainwave.write.passes.windows import new_scan
from terrainwave.write.pyramid import Pyramid, SubtreeRegion
from terrainwave.write.tasks.task import workplace

_CACHE_BYTES = 64 << 20
_SCAN_SIDE = 2048
ABOVE, CODED, TOP, FINISHED = "above", "coded", "top", "finished"
# Heights given to voids, and the row and column of the first.
Fills = tuple[Sequence[int], Heights]


@dataclass(frozen=True)
class Site:
    """State shared by the tasks of a run.

    `root` is that of the depot, `level` that of the blocks whose subtrees are tasks; `file_tables`
    are empty until they are known.
    """

    raster: AskedRaster
    root: str
    job: Job
    level: int
    file_tables: bytes = b""

    @property
    def depot(self) -> Depot:
        return Depot(self.root, workplace().folder)

    @property
    def grid(self) -> Grid:
        return self.job.grid

    @property
    def shift(self) -> int:
        """Return the number of levels below the blocks that tasks begin at."""
        return self.grid.k_max - self.level

    def refiner(self) -> Refiner:
        return refiner_by_name(self.job.options.named_method.name, self.file_tables)

    def name(self, stage: str, head: Block | None = None) -> str:
        """Return the name in the depot of a task's result, or of the segments above all tasks."""
        # With the method's: a plain one may be tried as well.
        place = "" if head is None else f"-{head.level}-{head.row}-{head.col}"
        return f"{self.job.options.named_method.name}-{stage}{place}"

    def top_heads(self) -> list[Block | None]:
        """Return the heads of the segments above all tasks, parents first."""
        heads = list(self.grid.segment_heads())
        return [head for head in heads if head is None or head.level < self.level]

    def segments(self, stage: str, top_stage: str) -> StoredSegments:
        """Return the segments of a stage that are in the depot, with those above them."""

        @cache
        def stored(start: Block | None) -> dict[Block | None, StoredSegment]:
            if start is None:
                return stored_places(self.depot, self.name(top_stage), self.top_heads())
            heads: list[Block | None] = [*self.grid.segment_heads_below(start)]
            return stored_places(self.depot, self.name(stage, start), heads)

        def place(head: Block | None) -> StoredSegment:
            if head is None or head.level < self.level:
                return stored(None)[head]
            depth = head.level - self.level
            return stored(Block(self.level, head.row >> depth, head.col >> depth))[head]

        return StoredSegments(self.grid, place)

    @contextmanager
    def decoded(self, stage: str, top_stage: str) -> Iterator[tuple[TreeDecoder, StoredSegments]]:
        """Yield a decoder of the `segments` of a stage, and these."""
        with self.segments(stage, top_stage) as stored:
            decoder = TreeDecoder(
                self.grid, self.job.parameters, self.refiner(), stored.payloads, _CACHE_BYTES
            )
            yield decoder, stored

    @contextmanager
    def levels(self, bench: Bench, region: Region, fills: Fills | None) -> Iterator[Pyramid]:
        """Yield the levels of a part of the raster; `fills` are the coarsest, if it has voids."""
        pyramid = bench.pyramid(self.job, part=SubtreeRegion(region, self.shift))
        with closing(pyramid):
            if fills is not None:
                (row, col, *_), heights = fills
                n_rows, n_cols = heights.shape
                spool = Spool((n_rows, n_cols), heights.dtype, bench.directory, (row, col))
                spool.write(spool.region, heights)
                pyramid.push()
                pyramid.pull(spool)
            pyramid.make_heights(lambda *_: None)
            yield pyramid


def own_region(grid: Grid, head: Block) -> Region:
    """Return the full grid's samples under a block, without the next block's border."""
    row, col, n_rows, n_cols = grid.full_region(head)
    if grid.contains(Block(head.level, head.row + 1, head.col)):
        n_rows -= 1
    if grid.contains(Block(head.level, head.row, head.col + 1)):
        n_cols -= 1
    return Region(row, col, n_rows, n_cols)


@contextmanager
def _bench(raster: AskedRaster) -> Iterator[Bench]:
    with (
        raster.open() as source,
        scratch_directory(workplace().folder, "terrainwave") as directory,
        Crew(1) as executor,
    ):
        yield Bench(source, directory, executor)


# Pass A


def scan_region(
    raster: AskedRaster, region: Region, has_digest: bool, steps: FixedSteps | None = None
) -> HeightScan:
    """Return range, validity and vertical quantum of a region; optionally a digest."""
    with raster.open() as source:
        scan = new_scan(source.info, has_digest, steps)
        for window in region.tiles(_SCAN_SIDE, _SCAN_SIDE):
            scan.update(*source.read(*window), window.row, window.col)
    return scan


def push_levels(site: Site, head: Block) -> None:
    """Store the mask of a subtree's coarsest level and the averages of its valid samples."""
    part = SubtreeRegion(site.grid.full_region(head), site.shift)
    with _bench(site.raster) as bench, closing(bench.pyramid(site.job, part=part)) as pyramid:
        pyramid.push()
        region = site.grid.block_region(head)
        averages, known = pyramid.pushed(site.shift, region)
        mask, own = pyramid.mask(site.level, region), pyramid.own(site.level, region)
    site.depot.save(site.name("pushed", head), mask=mask, own=own, averages=averages, known=known)


def make_levels(site: Site, head: Block) -> None:
    """Store the target heights of a subtree's coarsest level."""
    with _built_pyramid(site, head) as (pyramid, _):
        heights = pyramid.heights(site.level, site.grid.block_region(head))
    site.depot.save(site.name("heights", head), heights=heights)


@contextmanager
def _built_pyramid(site: Site, head: Block) -> Iterator[tuple[Pyramid, Bench]]:
    fills: Fills | None = None
    if site.job.has_voids:
        stored = site.depot.load(site.name("fills", head))
        fills = stored["origin"].tolist(), stored["heights"]
    region = site.grid.full_region(head)
    with _bench(site.raster) as bench, site.levels(bench, region, fills) as pyramid:
        yield pyramid, bench


# Pass B


class EncodedSubtree(NamedTuple):
    """Result of coding a subtree.

    `ancestors` are the statistics of the subtree's head and the blocks above it, from originals
    below the head. The head's box must enclose `box` (None if all is void); `error` is the head's
    in a faithful file (`boxes.recursive_errors`).
    """

    places: tuple[StoredSegment, ...]
    ancestors: Stats
    box: Box | None
    n_bytes: int
    error: int


def encode_subtree(site: Site, head: Block) -> EncodedSubtree:
    """Code all groups of a subtree and store their segments in the depot."""
    job, grid = site.job, site.grid
    heads: list[Block | None] = [*grid.segment_heads_below(head)]
    with (
        _built_pyramid(site, head) as (pyramid, bench),
        site.decoded(CODED, ABOVE) as (decoder, _),
    ):
        sink = SpoolSink(grid, bench.directory)
        encoder = TreeEncoder(
            grid, job.parameters, pyramid, sink, refiner=site.refiner(), may_repeat=job.may_repeat
        )
        stats = encoder.run_subtree(head, decoder.block)
        own = {block: of_block for block, of_block in stats.items() if block.level > head.level}
        ancestors = {block: of_block for block, of_block in stats.items() if block not in own}
        error = 0
        if job.recursion_bound is not None:
            whole_tree = own | {head: ancestors.get(head, BlockStats())}
            error = recursive_errors(whole_tree, job.lost, job.recursion_bound).get(head, 0)
        codes = Codes(job, own)
        box = codes.boxes.pop(head, None)
        codes.set(sink.present())
        places = store_segments(site.depot, site.name(CODED, head), grid, heads, sink.spools)
    return EncodedSubtree(tuple(places.values()), ancestors, box, sink.n_bytes, error)


# Meshes


def mesher_of(
    site: Site,
    decoder: TreeDecoder,
    error_code: Callable[[Block], int],
    part: Callable[[Block], bytes] | None = None,
) -> BlockMesher:
    job = site.job
    return BlockMesher(
        site.grid,
        decoder,
        error_code,
        job.mesh_tolerance,
        has_voids=job.has_voids,
        kind=job.options.mesh_kind,
        part=part,
        trees=tree_source(job.options.mesh_kind, decoder),
    )


def draft_subtree(site: Site, head: Block, rounds: dict[Block, int], number: int) -> bool:
    """Make a round of drafts of a subtree's meshes; return whether any changed.

    See `tri.zerotree.agreement`. `rounds` are the numbers of the last rounds that changed this
    subtree and its neighbours; empty in the first round. Changes are stored in the depot.
    """
    states = {
        start: BorderState.from_arrays(site.depot.load(_state_name(site, start, last)))
        for start, last in rounds.items()
    }
    with site.decoded(CODED, TOP) as (decoder, stored):
        mesher = mesher_of(site, decoder, lambda block: stored.codes(block)[2])
        if not states:
            blocks = [
                block
                for level in range(head.level + 1, site.grid.k_max + 1)
                for block in site.grid.descendants(head, level)
            ]
            own = draft_blocks(mesher, dict.fromkeys(blocks))
        else:
            own = states.pop(head)
            late = own.late_blocks(states.values())
            if not late:
                return False
            own = own.updated(draft_blocks(mesher, dict(late)))
    site.depot.save(_state_name(site, head, number), **own.to_arrays())
    return True


def _state_name(site: Site, head: Block, number: int) -> str:
    return site.name(f"borders{number}", head)


def finish_subtree(
    site: Site, head: Block, last_round: int | None
) -> tuple[tuple[StoredSegment, ...], dict[Block, int]]:
    """Make and measure the meshes of a subtree; store its finished segments in the depot.

    `last_round` is the round of `draft_subtree` that last changed something here; None for meshes
    without stored bytes. Return the segments, and the errors of ancestors in 1/16 quanta.
    """
    grid, job, lost = site.grid, site.job, Fraction(site.job.lost)
    sections: dict[Block, bytes] = {}
    with _bench(site.raster) as bench, site.decoded(CODED, TOP) as (decoder, stored):

        def section(key: Block) -> bytes:
            return stored.mesh(key) if key.level < head.level else sections.get(key, b"")

        parts = parts_of_blocks(grid, section)
        mesher = mesher_of(site, decoder, lambda block: stored.codes(block)[2], parts)
        if job.options.mesh_kind in STORED_KINDS:
            state = BorderState.from_arrays(
                site.depot.load(_state_name(site, head, last_round or 0))
            )
            sections.update(sections_of_parts(grid, encode_parts(mesher, state)))
        part = SubtreeRegion(grid.full_region(head), site.shift)
        originals = bench.pyramid(job, part=part).originals
        finest = grid.descendants(head, grid.k_max)
        found = measure_meshes(
            grid, mesher, originals, bench.executor, lambda _: None, lost, finest
        )
        own = {block: error for block, error in found.items() if block.level > head.level}
        codes = mesher.error_codes(own, lost, by_recursion=job.options.faithful)
        heads: list[Block | None] = [*grid.segment_heads_below(head)]
        spools = copied_segments(grid, heads, stored, codes, bench.directory, sections)
        places = store_segments(site.depot, site.name(FINISHED, head), grid, heads, spools)
    return tuple(places.values()), {block: found[block] for block in found.keys() - own.keys()}


# Pass C


def prove_region(site: Site, path: str | os.PathLike[str], region: Region) -> Proved:
    """Return the largest difference of a finished file from the raster, and digests of tiles."""
    with site.raster.open() as source, comparison_of(path, site.job, source) as comparison:
        return together(map(comparison.all, comparison.shares(source, region)))
