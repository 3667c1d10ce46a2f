"""The three passes of `compress` over a raster, in threads of this process."""

import os
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np

from terrainwave.codec.refiner import Decoded, Refiner
from terrainwave.codec.registry import refiner_by_name
from terrainwave.container.digests import TileDigests
from terrainwave.container.spool import SegmentSpool
from terrainwave.container.targets.kept import Kept
from terrainwave.container.writer import SpoolSink
from terrainwave.grid.quadtree import Block
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.read.window_reader import make_decoder
from terrainwave.write.boxes import Box, Codes
from terrainwave.write.encoder import TreeEncoder, fitted_refiner
from terrainwave.write.job import Job
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.found import Stats
from terrainwave.write.passes.proof import collected, compared, comparison_of
from terrainwave.write.passes.resuming import KeptUnits, is_by_heights, same_heights
from terrainwave.write.passes.windows import Windows, check_free_space
from terrainwave.write.pyramid import Pyramid

MESH_CACHE_BYTES = 64 << 20
OnSegment = Callable[[Block, Stats], None]
# Statistics, the method's tables, and what makes and measures meshes: it returns their error codes.
Walked = tuple[Stats, bytes, Callable[[Job, Codes], dict[Block, int]]]


@dataclass
class Coded:
    """Coded raster: its tables and segments.

    `job` is the coded job; that of an embedded file includes its measured error.
    """

    file_tables: bytes
    sink: SpoolSink
    job: Job

    @property
    def n_bytes(self) -> int:
        """Return the size of payloads and tables."""
        return self.sink.n_bytes + len(self.file_tables)


def smaller(first: Coded, second: Coded) -> Coded:
    kept, dropped = (first, second) if first.n_bytes <= second.n_bytes else (second, first)
    dropped.sink.close()
    return kept


@dataclass
class LocalPasses:
    """Passes over a raster that do not repeat the work of an earlier run."""

    bench: Bench
    has_digest: bool = False
    _windows: Windows | None = None

    @property
    def windows(self) -> Windows:
        """Return the raster's windows, once it has been scanned."""
        assert self._windows is not None
        return self._windows

    def scan(self, steps: FixedSteps | None = None) -> HeightScan:
        """Return range, validity and vertical quantum of every sample, and a digest if wanted."""
        source, kept = self.bench.source, self.bench.kept
        check_free_space(source, self.bench.directory, kept.n_bytes)
        by_heights = is_by_heights(kept)
        # Records that may be of other heights are not used.
        self._windows = Windows(source, self.bench.directory, Kept() if by_heights else kept)
        scan = self._windows.scan(
            self.bench.executor, self.bench.reporter, self.has_digest or by_heights, steps
        )
        if by_heights and scan.digest is not None:
            same_heights(kept, scan.digest.text)
        return scan

    def encode(self, job: Job) -> Coded:
        """Code all units into one spool per segment; not those that an earlier run kept."""
        sink, below = SpoolSink(job.grid, self.bench.directory), dict[Block, Box]()
        finish = partial(_finish_segment, job, sink, below) if job.may_repeat else None
        with self._walked(job, sink, finish) as (stats, file_tables, mesh_errors_of):
            if job.options.is_embedded:
                finest = (
                    own.error for block, own in stats.items() if block.level == job.grid.k_max
                )
                job = job.with_measured(max(finest, default=0))
            codes = Codes(job, stats, below)
            mesh_errors = mesh_errors_of(job, codes) if job.options.measures_meshes else None
        codes.set(sink.present(), mesh_errors)
        return Coded(file_tables, sink, job)

    @contextmanager
    def _walked(self, job: Job, sink: SpoolSink, on_segment: OnSegment | None) -> Iterator[Walked]:
        """Fill a sink with the payloads of all units; `on_segment` is that of a `TreeEncoder`."""
        bench, grid, method = self.bench, job.grid, job.options.named_method
        pyramid = bench.pyramid(job, self.windows)
        pyramid.kept = bench.kept
        with closing(pyramid):
            itemsize = np.dtype(job.info.dtype).itemsize
            pyramid.build(
                lambda done, total: bench.reporter.report(
                    "making levels", done, total, done * itemsize
                )
            )
            sizes = {"n_units_total": grid.n_units(), "n_levels": grid.k_max + 1}
            on_samples = bench.counter(
                "encoding", lambda: {"n_bytes_out": sink.n_bytes, "n_units": sink.n_units, **sizes}
            )
            refiner, file_tables = None, b""
            units: dict[Block, Decoded] = {}
            walked = grid, job.parameters, pyramid, sink, on_samples
            if method.is_tiled:
                # Imported here: its compilation takes seconds that other methods do not need.
                from terrainwave.write.tile_encoder import encode_tiles

                stats = encode_tiles(job, walked, bench)
            else:
                refiner, file_tables = _fitted(job, pyramid, bench)
                # Heights and masks of all levels: four thirds of five bytes for each sample.
                is_small = 20 * grid.n_rows * grid.n_cols <= 3 * MESH_CACHE_BYTES
                stats = TreeEncoder(
                    *walked, refiner,
                    kept=KeptUnits(bench.kept, grid, method.name),
                    on_unit=units.__setitem__ if is_small and job.options.measures_meshes else None,
                    may_repeat=job.may_repeat,
                    on_segment=on_segment,
                ).run(bench.executor)  # fmt: skip

            def mesh_errors(job: Job, codes: Codes) -> dict[Block, int]:
                from terrainwave.mesh.blocks import measure_meshes  # most runs make none

                header = job.header(file_tables)
                decoder = make_decoder(header, sink.payloads, MESH_CACHE_BYTES, refiner=refiner)
                while units:  # not decoded again
                    decoder.put(*units.popitem())
                mesher, sections = bench.meshes(header, decoder, codes.errors)
                sink.set_meshes(sections)
                count, lost = bench.counter("measuring meshes"), Fraction(job.lost)
                originals = pyramid.originals
                found = measure_meshes(grid, mesher, originals, bench.executor, count, lost)
                return mesher.error_codes(found, lost, by_recursion=job.options.faithful)

            yield stats, file_tables, mesh_errors

    def prove(self, path: str | os.PathLike[str] | bytes, job: Job) -> tuple[float, TileDigests]:
        """Decode the file from disk and compare every sample and the mask.

        Return the largest error, and the digests of tiles if the file is to have them.
        """
        grid, count = job.grid, self.bench.counter("proving")
        with (
            self.windows.unchanged(),
            comparison_of(path, job, self.windows, count) as comparison,
        ):
            found = compared(path, comparison.shares(self.windows), comparison.all, self.bench)
            proved = collected(found, (grid.n_rows, grid.n_cols), job.quantizer)
        count(grid.n_rows * grid.n_cols)  # voids, and what an earlier run has compared
        return proved

    def close(self) -> None:
        if self._windows is not None:
            self._windows.close()


def _fitted(job: Job, pyramid: Pyramid, bench: Bench) -> tuple[Refiner, bytes]:
    """Return the refiner of a job's method, and its tables, which are kept."""
    method, kept = job.options.named_method.name, bench.kept
    name = f"{method}/tables"
    if kept.get(name) is None:
        refiner, file_tables = fitted_refiner(job, pyramid.heights, pyramid.mask, bench.executor)
        kept.put(name, {}, file_tables)
        return refiner, file_tables
    file_tables = kept.data(name)
    return refiner_by_name(method, file_tables), file_tables


def _finish_segment(
    job: Job, sink: SpoolSink, below: dict[Block, Box], head: Block, stats: Stats
) -> None:
    """Set the codes of a finest segment and move it to disk; only its box stays in memory."""
    spool = sink.spools.get(head)
    if not isinstance(spool, SegmentSpool):
        return
    codes = Codes(job, stats)
    if head in codes.boxes:
        below[head] = codes.boxes.pop(head)
    codes.set([spool])
    sink.store(head)
