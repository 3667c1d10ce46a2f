"""`compress` on many machines: shares out the tasks of `subtrees` and puts their results together.

The cluster (`tasks.workers`) sees tasks of a few kB and results of a few kB; heights and payloads
go through a depot that all machines see. The levels above the tasks, 1 / 256 of the samples with
the default size, are coded here. Bytes are those of `local_passes`.
"""

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache, partial
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from terrainwave.codec.refiner import Heights, Mask
from terrainwave.container.depot import Depot
from terrainwave.container.digests import TILE, TileDigests
from terrainwave.container.page import page_layout
from terrainwave.container.writer import SpoolSink
from terrainwave.errors import StorageError, TerrainwaveWarning
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.raster_io.temporary import Spool
from terrainwave.read.decoder import unit_key
from terrainwave.read.window_reader import make_decoder
from terrainwave.tri.stored_kinds import STORED_KINDS
from terrainwave.write.boxes import Codes
from terrainwave.write.compress_options import Options
from terrainwave.write.encoder import TreeEncoder, fitted_refiner
from terrainwave.write.job import Job
from terrainwave.write.local import MESH_CACHE_BYTES, LocalPasses, OnSegment, Walked
from terrainwave.write.passes.bench import AskedRaster, Bench
from terrainwave.write.passes.found import unpacked
from terrainwave.write.passes.proof import collected
from terrainwave.write.passes.windows import new_scan
from terrainwave.write.pyramid import DTYPES, Base, Pyramid, SubtreeRegion
from terrainwave.write.subtrees import (
    ABOVE,
    CODED,
    MESHED,
    TOP,
    Above,
    Places,
    Site,
    draft_subtree,
    encode_subtree,
    make_levels,
    mesh_subtree,
    own_region,
    prove_region,
    push_levels,
    scan_region,
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


@dataclass(frozen=True)
class Cluster:
    """Workers, and the raster as they open it.

    `url` is that of the depot; None puts it into a directory that all workers see. A task has at
    least `task_samples` samples.
    """

    workers: Workers
    raster: AskedRaster
    url: str | None
    task_samples: int

    def passes(self, bench: Bench, options: Options) -> "DistributedPasses | None":
        """Return the passes of `compress` shared out; None if the raster is one small task."""
        info = bench.source.info
        grid = Grid(info.n_rows, info.n_cols, options.block)
        level = task_level(grid, self.task_samples)
        return None if level is None else DistributedPasses(bench, self, grid, level, options)


class DistributedPasses(LocalPasses):
    """The passes of `compress`, shared out over a cluster.

    Tasks begin at blocks of `level`. Threads of the bench code the levels above.
    """

    def __init__(self, bench: Bench, cluster: Cluster, grid: Grid, level: int, options: Options):
        super().__init__(bench, options.keep_origin)
        self._workers, self._raster = cluster.workers, cluster.raster
        self._grid, self._level = grid, level
        if cluster.url is None:
            root = bench.directory.absolute() / "depot"
            root.mkdir()
            self._depot = Depot(str(root))
        else:
            self._depot = Depot(f"{cluster.url.rstrip('/')}/{bench.directory.name}")
        self._names: list[str] = []  # in the depot

    def scan(self, steps: FixedSteps | None = None) -> HeightScan:
        """Return range, validity and vertical quantum of every sample."""
        whole = new_scan(self.bench.source.info, self.has_digest, steps)
        # Not after hours, if nothing can be written there.
        self._names.append("begun")
        self._depot.save("begun")
        tasks = {
            region: (self._raster, region, self.has_digest, steps) for region in self._regions()
        }
        for _, part in self._run("scanning", scan_region, tasks):
            whole.merge(part)
        return whole

    @contextmanager
    def _walked(self, job: Job, sink: SpoolSink, on_segment: OnSegment | None) -> Iterator[Walked]:
        """Fill a sink with the payloads of all units; code those above the tasks' blocks here."""
        site = Site(self._raster, self._depot.root, job, self._level)
        with closing(self._top_pyramid(site)) as top:
            refiner, file_tables = fitted_refiner(
                job, *self._targets(site, top), self.bench.executor
            )
            site = replace(site, file_tables=file_tables)
            encoder = TreeEncoder(
                job.grid, job.parameters, top, sink, refiner=refiner, last_level=self._level,
                on_segment=on_segment,
            )  # fmt: skip
            encoder.run(self.bench.executor)
        payloads = self._put_top(site, ABOVE, lambda key: sink.payloads([key])[0])
        heads = site.grid.blocks(site.level)
        tasks = {head: (site, head, Above(_above([head], payloads), {}, {})) for head in heads}
        coded = self._run("encoding", encode_subtree, tasks, CODED)
        _load(coded, lambda head: encoder.take(head, site.coded(head)))
        yield encoder.found.stats, file_tables, partial(self._mesh_errors, site, sink, payloads)

    def prove(self, path: str | os.PathLike[str] | bytes, job: Job) -> tuple[float, TileDigests]:
        """Decode the file, compare every sample; return the largest error and digests of tiles."""
        assert not isinstance(path, bytes)  # what has a client is written to disk
        site = Site(self._raster, self._depot.root, job, self._level)
        tasks = {region: (site, os.path.abspath(path), region) for region in self._regions(TILE)}
        found = (proved for _, proved in self._run("proving", prove_region, tasks))
        return collected(found, (self._grid.n_rows, self._grid.n_cols), job.quantizer)

    def close(self) -> None:
        try:
            self._depot.remove(self._names)
        except StorageError as error:  # not a reason to lose the file
            warnings.warn(f"{error}; remove it yourself", TerrainwaveWarning, stacklevel=2)

    def _run(
        self,
        stage: str,
        function: Callable[..., Any],
        tasks: Mapping[Item, tuple[Any, ...]],
        stored: str = "",
    ) -> Iterator[tuple[Item, Any]]:
        """Yield (item, result) of every task of a pass as it is done, and report it.

        `stored` is the stage under which tasks store results in the depot, if they do.
        """
        self._names += [site.name(stored, item) for item, (site, *_) in tasks.items() if stored]
        itemsize = np.dtype(self.bench.source.info.dtype).itemsize
        total = sum(_n_samples(self._region(item)) for item in tasks)
        done = 0

        def report(n_tasks: int) -> None:
            n_bytes = done * itemsize
            self.bench.reporter.report(
                stage, done, total, n_bytes, n_tasks=n_tasks, n_tasks_total=len(tasks)
            )

        report(0)
        finished = self._workers.run(stage, function, tasks)
        for n_tasks, (item, result) in enumerate(finished, 1):
            yield item, result
            done += _n_samples(self._region(item))
            report(n_tasks)

    def _region(self, item: Block | Region) -> Region:
        return own_region(self._grid, item) if isinstance(item, Block) else item

    def _regions(self, side: int = 1) -> list[Region]:
        """Return the regions of tasks, or of coarser blocks if these have fewer samples a side."""
        level = self._level
        while level and self._grid.block * self._grid.stride(level) < side:
            level -= 1
        return [own_region(self._grid, head) for head in self._grid.blocks(level)]

    # Levels

    def _top_pyramid(self, site: Site) -> Pyramid:
        """Return the levels from that of the tasks' blocks up."""
        shape = site.grid.level_shape(site.level)
        names = ["mask", "own", "averages", "known"] if site.job.has_voids else []
        arrays = {
            name: Spool(shape, DTYPES[name], self.bench.directory) for name in ["heights", *names]
        }
        if names:
            pushed = self._run("averaging", push_levels, self._each(site), "pushed")
            self._load_arrays(site, "pushed", pushed, {name: arrays[name] for name in names})
        top = self.bench.pyramid(site.job, base=Base(site.shift, arrays))
        if site.job.has_voids:
            top.push()
            top.pull()
            for head in site.grid.blocks(site.level):
                region, fills = self._fills(site, top, site.grid.full_region(head))
                self._names.append(site.name("fills", head))
                site.depot.save(self._names[-1], heights=fills, origin=np.array(region[:2]))
        made = self._run("making levels", make_levels, self._each(site), "heights")
        self._load_arrays(site, "heights", made, {"heights": arrays["heights"]})
        top.make_heights(lambda *_: None)
        return top

    def _load_arrays(
        self,
        site: Site,
        stage: str,
        finished: Iterable[tuple[Block, Any]],
        spools: Mapping[str, Spool],
    ) -> None:
        """Load into spools what finished tasks have left."""

        def load(head: Block) -> None:
            arrays = site.depot.load(site.name(stage, head))
            for name, spool in spools.items():
                spool.write(site.grid.block_region(head), arrays[name])

        _load(finished, load)

    def _fills(self, site: Site, top: Pyramid, region: Region) -> tuple[Region, Heights]:
        """Return the fills that a part over a region of the full grid needs, and their place."""
        level_shape = site.grid.level_shape(site.level)
        wanted = SubtreeRegion(region, site.shift).made("fills", site.shift)
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
            fills = self._fills(site, top, full) if site.job.has_voids else None
            with site.levels(self.bench, full, fills) as part:
                return part.heights(level, region), part.mask(level, region)

        def heights(level: int, region: Region) -> Heights:
            return top.heights(level, region) if level <= site.level else below(level, region)[0]

        def mask(level: int, region: Region) -> Mask:
            return top.mask(level, region) if level <= site.level else below(level, region)[1]

        return heights, mask

    def _put_top(self, site: Site, stage: str, section: Callable[[Block], bytes]) -> Places:
        """Store payloads or meshes of the units above the tasks' blocks; return their places."""
        places: dict[Block, tuple[str, int, int]] = {}
        for head in site.top_heads():
            name, data = site.name(stage, head or Block(-1, 0, 0)), b""
            for key in page_layout(site.grid, head).keys:
                own = section(key)
                places[key] = name, len(data), len(own)
                data += own
            self._names.append(name)
            self._depot.put(name, data)
        return places

    # Meshes

    def _mesh_errors(
        self, site: Site, sink: SpoolSink, payloads: Places, job: Job, codes: Codes
    ) -> dict[Block, int]:
        """Have meshes made and measured; return the codes of their errors."""
        header, heads = job.header(site.file_tables), site.grid.blocks(site.level)
        # Meshes of the tasks' own blocks may follow the groups that tasks have coded.
        decoder = make_decoder(header, sink.payloads, MESH_CACHE_BYTES)
        levels = range(site.level + 1)
        mesher, sections = self.bench.meshes(header, decoder, codes.errors, levels)
        meshes = self._put_top(site, TOP, lambda key: sections.get(key, b""))
        above = {}
        for head in heads:
            near = _around(head, site.grid)
            errors = {block: codes.errors.get(block, 0) for block in (*near, *_keys_above(near))}
            above[head] = Above(_above(near, payloads), errors, _above([head], meshes))
        rounds = self._agree(site, above) if header.mesh in STORED_KINDS else {}
        tasks = {head: (site, head, above[head], rounds.get(head)) for head in heads}
        found: dict[Block, int] = {}
        lock = Lock()  # tasks measure the blocks above them together

        def take(head: Block) -> None:
            values, own = unpacked(self._depot.get(site.name(MESHED, head)))
            sections.update(own)
            with lock:
                for *place, error in values["errors"]:
                    block = Block(*place)
                    found[block] = max(found.get(block, 0), error)

        _load(self._run("measuring meshes", mesh_subtree, tasks, MESHED), take)
        sink.set_meshes(sections)
        lost = Fraction(job.lost)
        return mesher.error_codes(found, lost, by_recursion=job.options.faithful)

    def _agree(self, site: Site, above: Mapping[Block, Above]) -> dict[Block, int]:
        """Let subtrees agree on border vertices; return each one's last round that changed it."""
        heads = site.grid.blocks(site.level)
        last: dict[Block, int] = {}
        late = heads
        number = 0
        while late:
            near = {head: {one: last[one] for one in _cross(head, last)} for head in late}
            tasks = {head: (site, head, above[head], near[head], number) for head in late}
            stage = f"making meshes, round {number + 1}"
            drafts = self._run(stage, draft_subtree, tasks, f"borders{number}")
            changed = [head for head, has in drafts if has]
            last |= dict.fromkeys(changed, number)
            late = sorted({near for head in changed for near in _cross(head, last)})
            number += 1
        return last

    def _each(self, site: Site) -> dict[Block, tuple[Site, Block]]:
        return {head: (site, head) for head in site.grid.blocks(site.level)}


AT_A_TIME = 16  # requests to the depot


def _load(finished: Iterable[tuple[Block, Any]], load: Callable[[Block], None]) -> None:
    """Load what finished tasks have left, of some at a time: a store takes time."""
    with ThreadPoolExecutor(AT_A_TIME) as pool:
        loading: list[Future[None]] = []
        try:
            for head, _ in finished:
                loading.append(pool.submit(load, head))
                for loaded in [one for one in loading if one.done()]:
                    loading.remove(loaded)
                    loaded.result()
            for loaded in loading:
                loaded.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _above(heads: Iterable[Block], places: Places) -> Places:
    return {key: places[key] for key in _keys_above(heads)}


def _keys_above(heads: Iterable[Block]) -> set[Block]:
    """Return the keys of the units that have some blocks, and of all units above them."""
    keys: set[Block] = set()
    for head in heads:
        key = unit_key(head)
        while key not in keys:
            keys.add(key)
            key = key if key.is_root_key else unit_key(key)
    return keys


def _around(head: Block, grid: Grid) -> list[Block]:
    """Return a block and its eight neighbours, and those of all blocks above it.

    Meshes of these, which a task measures, have borders with their own neighbours.
    """
    near = [
        Block(
            level, (head.row >> head.level - level) + down, (head.col >> head.level - level) + right
        )
        for level in range(head.level + 1)
        for down in (-1, 0, 1)
        for right in (-1, 0, 1)
    ]
    return [block for block in near if grid.contains(block)]


def _n_samples(region: Region) -> int:
    return region.n_rows * region.n_cols


def _cross(head: Block, known: Mapping[Block, int]) -> list[Block]:
    """Return those of a block and its four neighbours that are in `known`."""
    level, row, col = head
    places = ((row, col), (row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1))
    return [Block(level, *place) for place in places if Block(level, *place) in known]
