"""The three passes of `compress` over a raster, in threads of this process."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np

from terrainwave.codec.refiner import Decoded, Refiner
from terrainwave.codec.registry import refiner_by_name
from terrainwave.container.depot import StoredSegment
from terrainwave.container.digests import TileDigests
from terrainwave.container.spool import LikeSegment, SegmentSpool
from terrainwave.container.spool_sink import SpoolSink
from terrainwave.container.targets.kept import Kept
from terrainwave.grid.quadtree import Block
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.mesh.blocks import measure_meshes
from terrainwave.mesh.sections import make_meshes
from terrainwave.read.decoder import TreeDecoder
from terrainwave.read.tile_decoder import make_decoder
from terrainwave.write.boxes import Box, Codes
from terrainwave.write.encoder import TreeEncoder, fitted_refiner
from terrainwave.write.job import Job
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.found import Stats
from terrainwave.write.passes.proof import Proof, comparison_of, measured_error
from terrainwave.write.passes.resuming import KeptUnits, is_by_heights, same_heights
from terrainwave.write.passes.windows import Windows, check_free_space
from terrainwave.write.pyramid import Pyramid

_MESH_CACHE_BYTES = 64 << 20


@dataclass
class Coded:
    """Coded raster: tables, segments, bytes of payloads and tables.

    `job` is the coded job; that of an embedded file includes its measured error.
    """

    file_tables: bytes
    segments: dict[Block | None, SegmentSpool | LikeSegment | StoredSegment | None]
    n_bytes: int
    job: Job

    def close(self) -> None:
        for segment in self.segments.values():
            if isinstance(segment, SegmentSpool):
                segment.close()


def smaller(first: Coded, second: Coded) -> Coded:
    """Return the smaller one and close the other."""
    kept, dropped = (first, second) if first.n_bytes <= second.n_bytes else (second, first)
    dropped.close()
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
        bench = self.bench
        directory, executor = bench.directory, bench.executor
        pyramid = bench.pyramid(job, self.windows)
        pyramid.kept = bench.kept
        try:
            itemsize = np.dtype(job.info.dtype).itemsize
            pyramid.build(
                lambda done, total: bench.reporter.report(
                    "making levels", done, total, done * itemsize
                )
            )
            sink = SpoolSink(job.grid, directory)
            sizes = {"n_units_total": job.grid.n_units(), "n_levels": job.grid.k_max + 1}

            def more() -> dict[str, int]:
                return {"n_bytes_out": sink.n_bytes, "n_units": sink.n_units, **sizes}

            on_samples = bench.counter("encoding", more)
            refiner, file_tables = None, b""
            units: dict[Block, Decoded] = {}
            below: dict[Block, Box] = {}
            if job.options.named_method.is_tiled:
                # Imported here: its compilation takes seconds that other methods do not need.
                from terrainwave.write.tile_encoder import encode_tiles

                stats = encode_tiles(job, pyramid, sink, directory, on_samples, executor)
            else:
                refiner, file_tables = _fitted(job, pyramid, bench)
                stats, units = _encode_units(job, refiner, pyramid, sink, on_samples, bench, below)
            if job.options.is_embedded:
                job = job.with_measured(_finest_error(job, stats))
            codes = Codes(job, stats, below)
            mesh_errors = None
            if job.options.measures_meshes:
                header = job.header(file_tables)
                decoder = make_decoder(header, sink.payloads, _MESH_CACHE_BYTES, refiner=refiner)
                while units:  # not decoded again
                    decoder.put(*units.popitem())
                mesh_errors = _mesh_errors(job, decoder, pyramid, sink, codes.errors, bench)
        finally:
            pyramid.close()
        codes.set(sink.present(), mesh_errors)
        return Coded(file_tables, {**sink.spools}, sink.n_bytes + len(file_tables), job)

    def prove(self, path: str | os.PathLike[str] | bytes, job: Job) -> tuple[float, TileDigests]:
        """Decode the file from disk and compare every sample and the mask.

        Return the largest error, and the digests of tiles if the file is to have them.

        Raises
        ------
        BoundViolationError
            If a sample is further than the bound from the original, or valid where that is void.
        StorageError
            If that is because the raster has changed.
        """
        grid, count = job.grid, self.bench.counter("proving")
        proof = Proof((grid.n_rows, grid.n_cols))
        with (
            self.windows.unchanged(),
            comparison_of(path, job, self.windows, count) as comparison,
        ):
            proof.compare(path, comparison.shares(self.windows), comparison.all, self.bench)
        count(grid.n_rows * grid.n_cols)  # voids, and what an earlier run has compared
        return measured_error(proof.largest, job.quantizer), proof.tiles

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


def _encode_units(
    job: Job,
    refiner: Refiner,
    pyramid: Pyramid,
    sink: SpoolSink,
    on_samples: Callable[[int], None],
    bench: Bench,
    below: dict[Block, Box],
) -> tuple[Stats, dict[Block, Decoded]]:
    """Code every unit; return statistics and decoded units.

    `below` collects the boxes of finished segments. Decoded units are returned only if meshes need
    them and all of them fit in memory.
    """
    units: dict[Block, Decoded] = {}
    # Heights and masks of all levels: four thirds of five bytes for each sample.
    is_kept = 20 * job.grid.n_rows * job.grid.n_cols <= 3 * _MESH_CACHE_BYTES
    name = job.options.named_method.name
    encoder = TreeEncoder(
        job.grid, refiner, job.parameters, pyramid, sink, on_samples,
        kept=KeptUnits(bench.kept, job.grid, name),
        on_unit=units.__setitem__ if is_kept and job.options.measures_meshes else None,
        may_repeat=job.may_repeat,
    )  # fmt: skip
    if job.may_repeat:
        encoder.on_segment = partial(_finish_segment, job, sink, below)
    return encoder.run(bench.executor), units


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


def _finest_error(job: Job, stats: Stats) -> int:
    """Return the largest error of the finest blocks, in quanta."""
    k_max = job.grid.k_max
    return max((own.error for block, own in stats.items() if block.level == k_max), default=0)


def _mesh_errors(
    job: Job,
    decoder: TreeDecoder,
    pyramid: Pyramid,
    sink: SpoolSink,
    errors: dict[Block, int],
    bench: Bench,
) -> dict[Block, int]:
    """Make the meshes; return the code of each mesh's error against the originals."""
    grid = job.grid
    mesher, sections = make_meshes(
        grid,
        decoder,
        lambda block: errors.get(block, 0),
        job.mesh_tolerance,
        has_voids=job.has_voids,
        kind=job.options.mesh_kind,
        executor=bench.executor,
        on_samples=bench.counter("making meshes"),
    )
    sink.set_meshes(sections)
    count = bench.counter("measuring meshes")
    lost = Fraction(job.lost)
    found = measure_meshes(grid, mesher, pyramid.originals, bench.executor, count, lost)
    return mesher.error_codes(found, lost, by_recursion=job.options.faithful)
