"""`compress` on many machines: shares out the tasks of `subtrees` and puts their results together.

The cluster (`tasks.workers`) sees tasks of a few kB and results of a few kB; heights and payloads
go through a depot that all machines see. The levels above the tasks, 1 / 256 of the samples with
the default size, are coded here. Bytes are those of `local_passes`.
"""

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from terrainwave.codec.refiner import Heights, Mask, Refiner
from terrainwave.container.depot import Depot, StoredSegment
from terrainwave.container.digests import TILE, TileDigests
from terrainwave.container.page import N_CODES
from terrainwave.container.spool_sink import SpoolSink
from terrainwave.container.writer import store_segments
from terrainwave.errors import InvalidHeightsError, StorageError, TerrainwaveWarning
from terrainwave.grid.block_stats import BlockStats
from terrainwave.grid.crew import Crew
from terrainwave.grid.digest import HeightDigest
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.mesh.sections import make_sections
from terrainwave.progress import Reporter
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.temporary import Spool
from terrainwave.read.decoder import TreeDecoder, groups_by
from terrainwave.tri.stored_kinds import STORED_KINDS
from terrainwave.write.boxes import (
    Box,
    enclosing_boxes,
    error_codes,
    set_codes,
    unmeasured_mesh_codes,
)
from terrainwave.write.encoder import TreeEncoder, fitted_refiner
from terrainwave.write.job import Job
from terrainwave.write.passes.coding import Coded
from terrainwave.write.passes.found import Stats
from terrainwave.write.passes.proof import measured_error
from terrainwave.write.pyramid import Base, Pyramid, SubtreeRegion
from terrainwave.write.subtrees import (
    ABOVE,
    CODED,
    TOP,
    EncodedSubtree,
    RasterPlace,
    Site,
    draft_subtree,
    encode_subtree,
    finish_subtree,
    make_levels,
    mesher_of,
    own_region,
    prove_region,
    push_levels,
    scan_region,
    spool_of,
)
from terrainwave.write.tasks.workers import Workers

# Samples under a task's block, at least: 4096 x 4096.
TASK_SAMPLES = 1 << 24

Item = TypeVar("Item", Block, Region)


def task_level(grid: Grid, task_samples: int) -> int | None:
    """Return the level of the blocks whose subtrees are tasks: the finest with enough samples.

    None if all of the raster is in the top segment.
    """
    levels = grid.segment_levels()
    for level in reversed(levels):
        if (grid.block * grid.stride(level)) ** 2 >= task_samples:
            return level
    return levels[0] if levels else None


def shared_raster(
    src: Any, band: int, nodata: float | str | None, heights_are: str | None = None
) -> RasterPlace:
    """Return the raster as other machines open it.

    Raises
    ------
    InvalidHeightsError
        If it is no path or URL, and no list of them.
    """
    sources = src if isinstance(src, list | tuple) else (src,)
    if not all(isinstance(source, str | os.PathLike) for source in sources):
        raise InvalidHeightsError(
            f"found a {type(src).__name__}; expected the path or URL of a raster that every worker"
            " of the cluster can read"
        )
    paths = [os.fspath(source) for source in sources]
    shared = tuple(os.path.abspath(path) if os.path.exists(path) else path for path in paths)
    return RasterPlace(shared, band, nodata, heights_are)


@dataclass
class DistributedPasses:
    """The passes of `compress`, shared out over a cluster.

    Parameters
    ----------
    executor : Crew
        Threads here, for the levels above the tasks.
    directory : Path
        For temporary files here.
    """

    workers: Workers
    raster: RasterPlace
    source: RasterSource
    grid: Grid
    level: int
    depot: Depot
    directory: Path
    executor: Crew
    reporter: Reporter
    has_digest: bool = False

    def scan(self, steps: FixedSteps | None = None) -> HeightScan:
        """Return range, validity and vertical quantum of every sample."""
        info = self.source.info
        digest = HeightDigest(info.n_cols) if self.has_digest else None
        whole = HeightScan(info.dtype, steps, digest)
        # Not after hours, if nothing can be written there.
        self.depot.save("begun")
        tasks = {
            region: (self.raster, region, self.has_digest, steps) for region in self._own_regions()
        }
        for _, part in self._run("scanning", scan_region, tasks):
            whole.merge(part)
        return whole

    def encode(self, job: Job) -> Coded:
        """Code all units; segments below the tasks' blocks are stored in the depot."""
        site = Site(self.raster, self.depot, job, self.level, job.options.named_method.name)
        top = self._top_pyramid(site)
        try:
            refiner, file_tables = fitted_refiner(job, *self._targets(site, top), self.executor)
            site = replace(site, file_tables=file_tables)
            sink = SpoolSink(job.grid, self.directory)
            encoder = TreeEncoder(
                job.grid, refiner, job.parameters, top, sink, lambda _: None, self.level
            )
            stats = encoder.run(self.executor)
        finally:
            top.close()
        below = self._encode_below(site, sink, stats)
        codes = _TopCodes(site, sink, below)
        codes.set(unmeasured_mesh_codes(job, below.stats, codes.errors))
        segments = below.segments
        if job.options.measures_meshes:
            segments = self._mesh(site, refiner, codes)
        n_bytes = sink.n_bytes + below.n_bytes + len(site.file_tables)
        return Coded(site.file_tables, {**sink.spools, **segments}, n_bytes, job)

    def prove(self, path: str | os.PathLike[str] | bytes, job: Job) -> tuple[float, TileDigests]:
        """Decode the file, compare every sample; return the largest error and digests of tiles."""
        assert not isinstance(path, bytes)  # what has a client is written to disk
        site = Site(self.raster, self.depot, job, self.level, job.options.named_method.name)
        tasks = {region: (site, os.path.abspath(path), region) for region in self._proof_regions()}
        largest, tiles = 0.0, TileDigests((self.grid.n_rows, self.grid.n_cols))
        for _, result in self._run("proving", prove_region, tasks):
            largest = max(largest, result.error)
            tiles.add(result.tiles)
        return measured_error(largest, job.quantizer), tiles

    def close(self) -> None:
        """Delete what tasks have left in the depot."""
        try:
            self.depot.remove([*self.workers.names, *self.depot.meter.names])
        except StorageError as error:  # not a reason to lose the file
            warnings.warn(f"{error}; remove it yourself", TerrainwaveWarning, stacklevel=2)

    def _run(
        self, stage: str, function: Callable[..., Any], tasks: Mapping[Item, tuple[Any, ...]]
    ) -> Iterator[tuple[Item, Any]]:
        """Yield (item, result) of every task of a pass as it is done, and report it."""
        itemsize = np.dtype(self.source.info.dtype).itemsize
        total = sum(_n_samples(self._region(item)) for item in tasks)
        done = 0

        def report(n_tasks: int) -> None:
            n_bytes = done * itemsize
            self.reporter.report(
                stage, done, total, n_bytes, n_tasks=n_tasks, n_tasks_total=len(tasks)
            )

        report(0)
        finished = self.workers.run(stage, function, tasks)
        for n_tasks, (item, result) in enumerate(finished, 1):
            yield item, result
            done += _n_samples(self._region(item))
            report(n_tasks)

    def _region(self, item: Block | Region) -> Region:
        """Return the samples that a task stands for."""
        return own_region(self.grid, item) if isinstance(item, Block) else item

    def _own_regions(self) -> list[Region]:
        return [own_region(self.grid, head) for head in self.grid.blocks(self.level)]

    def _proof_regions(self) -> list[Region]:
        """Return regions of whole tiles of digests, none smaller than those of other tasks."""
        level = self.level
        while level and self.grid.block * self.grid.stride(level) < TILE:
            level -= 1
        return [own_region(self.grid, head) for head in self.grid.blocks(level)]

    # Levels

    def _top_pyramid(self, site: Site) -> Pyramid:
        """Return the levels from that of the tasks' blocks up."""
        shape = site.grid.level_shape(site.level)
        heights = Spool(shape, np.int32, self.directory)
        base = Base(site.shift, heights)
        if site.job.has_voids:
            base = self._pushed_base(site, heights)
        top = Pyramid(
            self.source,
            site.job.quantizer,
            site.grid,
            kind=site.job.options.named_method.pyramid,
            has_voids=site.job.has_voids,
            directory=self.directory,
            executor=self.executor,
            base=base,
        )
        if site.job.has_voids:
            top.push()
            top.pull()
            for head in site.grid.blocks(site.level):
                region, fills = self._fills(site, top, site.grid.full_region(head))
                site.depot.save(
                    site.name("fills", head), heights=fills, origin=np.array(region[:2])
                )
        made = self._run("making levels", make_levels, self._each(site))
        self._load(site, "heights", made, {"heights": heights})
        top.make_heights(lambda *_: None)
        return top

    def _pushed_base(self, site: Site, heights: Spool) -> Base:
        """Return the base of the top levels, its heights still missing."""
        names = ("mask", "pushed", "known", "own")
        spools = [
            Spool(heights.shape, dtype, self.directory)
            for dtype in (np.bool_, np.int32, np.bool_, np.bool_)
        ]
        pushed = self._run("averaging", push_levels, self._each(site))
        self._load(site, "pushed", pushed, dict(zip(names, spools, strict=True)))
        return Base(site.shift, heights, *spools)

    def _load(
        self,
        site: Site,
        stage: str,
        finished: Iterable[tuple[Block, Any]],
        spools: Mapping[str, Spool],
    ) -> None:
        """Load into spools what finished tasks have left, of some at a time: a store takes time."""

        def load(head: Block) -> None:
            arrays = site.depot.load(site.name(stage, head))
            for name, spool in spools.items():
                spool.write(site.grid.block_region(head), arrays[name])

        with ThreadPoolExecutor(AT_A_TIME) as pool:
            for loaded in [pool.submit(load, head) for head, _ in finished]:
                loaded.result()

    def _fills(self, site: Site, top: Pyramid, region: Region) -> tuple[Region, Heights]:
        """Return the fills that a part over a region of the full grid needs, and their place."""
        level_shape = site.grid.level_shape(site.level)
        wanted = SubtreeRegion(region, site.shift).fill_region(site.shift)
        wanted = wanted.intersect(Region(0, 0, *level_shape))
        return wanted, top.fills(site.shift, wanted)

    def _targets(
        self, site: Site, top: Pyramid
    ) -> tuple[Callable[[int, Region], Heights], Callable[[int, Region], Mask]]:
        """Return a reader of targets and validity, for small regions of any level."""

        @lru_cache(1)
        def below(level: int, region: Region) -> tuple[Heights, Mask]:
            shift = site.grid.k_max - level
            row, col, n_rows, n_cols = region
            full = Region(
                row << shift, col << shift, (n_rows - 1 << shift) + 1, (n_cols - 1 << shift) + 1
            )
            part = site.pyramid(self.source, full, self.directory, self.executor)
            try:
                if site.job.has_voids:
                    at, fills = self._fills(site, top, full)
                    part.push()
                    part.pull(spool_of(fills, (at.row, at.col), self.directory))
                part.make_heights(lambda *_: None)
                return part.heights(level, region), part.mask(level, region)
            finally:
                part.close()

        def heights(level: int, region: Region) -> Heights:
            return top.heights(level, region) if level <= site.level else below(level, region)[0]

        def mask(level: int, region: Region) -> Mask:
            return top.mask(level, region) if level <= site.level else below(level, region)[1]

        return heights, mask

    # Payloads

    def _encode_below(self, site: Site, sink: SpoolSink, stats: Stats) -> "_Below":
        """Have the groups below the tasks' blocks coded; `stats` are of the blocks above."""
        _set_no_codes(site.grid, sink)
        self._store_top(site, ABOVE, sink)
        below = _Below(stats=stats)
        is_last = not site.job.options.measures_meshes
        with _Copies(site.depot, self.directory) as copies:
            for head, encoded in self._run("encoding", encode_subtree, self._each(site)):
                below.take(encoded)
                if is_last:
                    heads = site.grid.segment_heads_below(head)
                    below.segments |= zip(heads, copies.places(encoded.places), strict=True)
        return below

    def _store_top(self, site: Site, stage: str, sink: SpoolSink) -> None:
        store_segments(site.depot, site.top_name(stage), site.grid, site.top_heads(), sink.spools)

    # Meshes

    def _mesh(
        self, site: Site, refiner: Refiner, codes: "_TopCodes"
    ) -> dict[Block | None, StoredSegment]:
        """Have meshes made and measured; return where the finished segments lie."""
        job, grid, sink = site.job, site.grid, codes.sink
        # Meshes of the tasks' own blocks may follow the groups that tasks have coded.
        with site.segments(CODED, ABOVE) as stored:
            source = groups_by(refiner, stored.payloads)
            decoder = TreeDecoder(grid, job.parameters, source, _CACHE_BYTES)
            mesher = mesher_of(site, decoder, lambda block: codes.errors.get(block, 0))
            sections = make_sections(
                grid, mesher, self.executor, lambda _: None, range(site.level + 1)
            )
        sink.set_meshes(sections)
        self._store_top(site, TOP, sink)
        rounds = self._agree(site) if job.options.mesh_kind in STORED_KINDS else {}
        tasks = {head: (site, head, rounds.get(head)) for head in grid.blocks(site.level)}
        segments: dict[Block | None, StoredSegment] = {}
        errors: dict[Block, int] = {}
        with _Copies(site.depot, self.directory) as copies:
            for head, finished in self._run("measuring meshes", finish_subtree, tasks):
                places = copies.places(finished.places)
                segments |= zip(grid.segment_heads_below(head), places, strict=True)
                for block, error in finished.ancestors.items():
                    errors[block] = max(errors.get(block, 0), error)
        lost = Fraction(job.lost)
        codes.set(mesher.error_codes(errors, lost, by_recursion=job.options.faithful))
        return segments

    def _agree(self, site: Site) -> dict[Block, int]:
        """Let subtrees agree on border vertices; return each one's last round that changed it."""
        heads = site.grid.blocks(site.level)
        last: dict[Block, int] = {}
        late = heads
        number = 0
        while late:
            tasks = {
                head: (site, head, {near: last[near] for near in _cross(head, last)}, number)
                for head in late
            }
            stage = f"making meshes, round {number + 1}"
            changed = [head for head, has in self._run(stage, draft_subtree, tasks) if has]
            last |= dict.fromkeys(changed, number)
            late = sorted({near for head in changed for near in _cross(head, last)})
            number += 1
        return last

    def _each(self, site: Site) -> dict[Block, tuple[Site, Block]]:
        return {head: (site, head) for head in site.grid.blocks(site.level)}


_CACHE_BYTES = 128 << 20
AT_A_TIME = 16  # requests to the depot


class _Copies:
    """Copies segments from a URL to this machine while tasks are running; others stay there.

    A file is put together from segments one by one: of a store, each would be waited for.
    """

    def __init__(self, depot: Depot, directory: Path) -> None:
        self._depot = depot
        self._directory = directory
        self._copied: list[Future[None]] = []
        self._pool = ThreadPoolExecutor(AT_A_TIME) if "://" in depot.root else None

    def places(self, places: Sequence[StoredSegment]) -> list[StoredSegment]:
        """Return where the segments of one entry will lie."""
        if self._pool is None or not any(place.length for place in places):
            return list(places)
        path = self._directory / f"copied-{len(self._copied)}.twz-spool"
        self._copied.append(self._pool.submit(self._depot.fetch, places[0].path, path))
        return [place._replace(path=str(path)) for place in places]

    def __enter__(self) -> "_Copies":
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=kind is not None)
        if kind is None:
            for copied in self._copied:
                copied.result()


@dataclass
class _Below:
    """Joined reports of tasks on the groups that they coded."""

    segments: dict[Block | None, StoredSegment] = field(default_factory=dict)
    stats: Stats = field(default_factory=dict)
    boxes: dict[Block, Box] = field(default_factory=dict)
    errors: dict[Block, int] = field(default_factory=dict)
    n_bytes: int = 0

    def take(self, encoded: EncodedSubtree) -> None:
        for block, stats in encoded.ancestors.items():
            self.stats.setdefault(block, BlockStats()).merge(stats)
        if encoded.box is not None:
            self.boxes[encoded.head] = encoded.box
            self.errors[encoded.head] = encoded.error
        self.n_bytes += encoded.n_bytes


class _TopCodes:
    """The codes of the blocks above and at the beginning of the tasks."""

    def __init__(self, site: Site, sink: SpoolSink, below: _Below) -> None:
        quantizer = site.job.quantizer
        self.sink = sink
        job = site.job
        self.errors = error_codes(below.stats, job.lost, job.recursion_bound, below.errors)
        self._grid = site.grid
        self._whole = quantizer.z_min, quantizer.z_max
        self._boxes = enclosing_boxes(below.stats, self.errors, self._whole, below.boxes, job.moved)

    def set(self, mesh_errors: Mapping[Block, int]) -> None:
        """Give every block its box and errors."""
        set_codes(
            self._grid, self.sink.present(), self._whole, self._boxes, self.errors, mesh_errors
        )


def _set_no_codes(grid: Grid, sink: SpoolSink) -> None:
    for spool in sink.present():
        for key in spool.keys():
            spool.set_codes(key, bytes(N_CODES * len(grid.key_blocks(key))))


def _n_samples(region: Region) -> int:
    return region.n_rows * region.n_cols


def _cross(head: Block, known: Mapping[Block, int]) -> list[Block]:
    """Return those of a block and its four neighbours that are in `known`."""
    level, row, col = head
    places = ((row, col), (row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1))
    return [Block(level, *place) for place in places if Block(level, *place) in known]
