"""Tasks of one machine: each works on the subtree below one block.

A task reads a part of the raster and the results of other tasks in the depot, stores its own
results there and returns a few numbers; the client (`cluster`) loads payloads, but sees no heights.
A task can be repeated and gives the same bytes. It runs in one thread. In memory are its payloads,
with meshes also its neighbours', and of each level of the subtree a spool of 20 MiB; the rest lies
on the machine's disk.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import NamedTuple

from terrainwave.codec.refiner import Heights, Refiner
from terrainwave.codec.registry import refiner_by_name
from terrainwave.container.depot import Depot
from terrainwave.container.targets.publication import scratch_directory
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
from terrainwave.write.boxes import Codes
from terrainwave.write.encoder import TreeEncoder
from terrainwave.write.job import Job
from terrainwave.write.passes.bench import AskedRaster, Bench
from terrainwave.write.passes.found import Found, packed
from terrainwave.write.passes.proof import Proved, comparison_of, together
from terrainwave.write.passes.windows import new_scan
from terrainwave.write.pyramid import Pyramid, SubtreeRegion
from terrainwave.write.tasks.task import workplace

_CACHE_BYTES = 64 << 20
_SCAN_SIDE = 2048
ABOVE, CODED, TOP, MESHED = "above", "coded", "top", "meshed"
# Heights given to voids, and the row and column of the first.
Fills = tuple[Sequence[int], Heights]
# Positions in the depot, by key: an entry, offset and length in it.
Places = Mapping[Block, tuple[str, int, int]]


class Above(NamedTuple):
    """Units above a task and near those: payloads, codes of errors; meshes above the task."""

    payloads: Places
    errors: Mapping[Block, int]
    meshes: Places


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
        return Depot(self.root)

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

    def coded(self, head: Block) -> Found:
        """Return the results of `encode_subtree`."""
        return Found.from_bytes(self.depot.get(self.name(CODED, head)))

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


class CodedUnits:
    """Payloads and error codes of the units of a run, read from the depot when needed."""

    def __init__(self, site: Site, above: Above) -> None:
        self._site, self._above = site, above
        self._found = cache(site.coded)
        self._codes = cache(self._codes_of)

    def decoder(self) -> TreeDecoder:
        job = self._site.job
        return TreeDecoder(
            job.grid, job.parameters, self._site.refiner(), self._payloads, _CACHE_BYTES
        )

    def error_code(self, block: Block) -> int:
        if block.level > self._site.level:
            return self._codes(self._head(block)).errors.get(block, 0)
        return self._above.errors[block]

    def _payloads(self, keys: Sequence[Block]) -> list[bytes]:
        return [
            self._site.depot.part(*self._above.payloads[key])
            if key.level < self._site.level
            else self._found(self._head(key)).payloads.get(key, b"")
            for key in keys
        ]

    def _head(self, block: Block) -> Block:
        depth = block.level - self._site.level
        return Block(self._site.level, block.row >> depth, block.col >> depth)

    def _codes_of(self, head: Block) -> Codes:
        stats = self._found(head).stats.items()
        return Codes(
            self._site.job, {block: own for block, own in stats if block.level > head.level}
        )


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


def encode_subtree(site: Site, head: Block, above: Above) -> None:
    """Code all groups of a subtree and store the results in the depot."""
    with _built_pyramid(site, head) as (pyramid, _):
        encoder = TreeEncoder(
            site.grid,
            site.job.parameters,
            pyramid,
            refiner=site.refiner(),
            may_repeat=site.job.may_repeat,
        )
        found = encoder.run_subtree(head, CodedUnits(site, above).decoder().block)
    site.depot.put(site.name(CODED, head), found.to_bytes())


# Meshes


def _mesher(site: Site, above: Above, sections: Mapping[Block, bytes]) -> BlockMesher:
    job, units = site.job, CodedUnits(site, above)
    decoder = units.decoder()
    return BlockMesher(
        site.grid,
        decoder,
        units.error_code,
        job.mesh_tolerance,
        has_voids=job.has_voids,
        kind=job.options.mesh_kind,
        part=parts_of_blocks(site.grid, lambda key: sections.get(key, b"")),
        trees=tree_source(job.options.mesh_kind, decoder),
    )


def draft_subtree(
    site: Site, head: Block, above: Above, rounds: dict[Block, int], number: int
) -> bool:
    """Make a round of drafts of a subtree's meshes; return whether any changed.

    See `tri.zerotree.agreement`. `rounds` are the numbers of the last rounds that changed this
    subtree and its neighbours; empty in the first round. Changes are stored in the depot.
    """
    states = {
        start: BorderState.from_arrays(site.depot.load(_state_name(site, start, last)))
        for start, last in rounds.items()
    }
    if not states:
        blocks = [
            block
            for level in range(head.level + 1, site.grid.k_max + 1)
            for block in site.grid.descendants(head, level)
        ]
        own = draft_blocks(_mesher(site, above, {}), dict.fromkeys(blocks))
    else:
        own = states.pop(head)
        late = own.late_blocks(states.values())
        if not late:
            return False
        own = own.updated(draft_blocks(_mesher(site, above, {}), dict(late)))
    site.depot.save(_state_name(site, head, number), **own.to_arrays())
    return True


def _state_name(site: Site, head: Block, number: int) -> str:
    return site.name(f"borders{number}", head)


def mesh_subtree(site: Site, head: Block, above: Above, last_round: int | None) -> None:
    """Make and measure the meshes of a subtree; store sections and errors in the depot.

    `last_round` is the round of `draft_subtree` that last changed something here; None for meshes
    without stored bytes. Errors, also those of ancestors, are in 1/16 quanta.
    """
    grid, job, own = site.grid, site.job, dict[Block, bytes]()
    sections = {key: site.depot.part(*place) for key, place in above.meshes.items()}
    mesher = _mesher(site, above, sections)
    if last_round is not None:
        state = BorderState.from_arrays(site.depot.load(_state_name(site, head, last_round)))
        own = sections_of_parts(grid, encode_parts(mesher, state))
        sections |= own
    part = SubtreeRegion(grid.full_region(head), site.shift)
    with _bench(site.raster) as bench:
        originals = bench.pyramid(job, part=part).originals
        finest = grid.descendants(head, grid.k_max)
        lost = Fraction(job.lost)
        found = measure_meshes(
            grid, mesher, originals, bench.executor, lambda _: None, lost, finest
        )
    errors = [(*block, error) for block, error in found.items()]
    site.depot.put(site.name(MESHED, head), packed({"errors": errors}, own))


# Pass C


def prove_region(site: Site, path: str | os.PathLike[str], region: Region) -> Proved:
    """Return the largest difference of a finished file from the raster, and digests of tiles."""
    with site.raster.open() as source, comparison_of(path, site.job, source) as comparison:
        return together(map(comparison.all, comparison.shares(source, region)))
