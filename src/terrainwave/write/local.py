"""The three passes of `compress` over a raster, in threads of this process."""

import os
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import count_of, size_of
from terrainwave.codec.refiner import Decoded
from terrainwave.container.depot import StoredSegment
from terrainwave.container.sink import SpoolSink
from terrainwave.container.spool import SegmentSpool
from terrainwave.errors import StorageError
from terrainwave.file import TerrainFile
from terrainwave.grid.digest import HeightDigest
from terrainwave.grid.quadtree import Block, Region
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.mesh.blocks import measure_meshes
from terrainwave.mesh.sections import make_meshes
from terrainwave.progress import Reporter
from terrainwave.raster_io.info import RasterInfo
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.temporary import MEMORY_LIMIT, Spool
from terrainwave.read.tiles import make_decoder
from terrainwave.write.boxes import enclosing_boxes, error_codes, set_codes
from terrainwave.write.encoder import Stats, TreeEncoder, fitted_refiner
from terrainwave.write.job import Job
from terrainwave.write.proof import allowed_error, compare_window, measured_error, proof_shares
from terrainwave.write.pyramid import Pyramid, SourceWindows

_MESH_CACHE_BYTES = _PROOF_CACHE_BYTES = 64 << 20


@dataclass
class LocalPasses:
    """The passes over `source`, in the threads of `executor`; large data in `directory`."""

    source: RasterSource
    directory: Path
    executor: Executor
    reporter: Reporter
    has_digest: bool = False
    _windows: "Windows | None" = None

    @property
    def windows(self) -> "Windows":
        """Return the raster's windows; there are some once it has been scanned."""
        assert self._windows is not None
        return self._windows

    def scan(self, steps: FixedSteps | None = None) -> HeightScan:
        """Return range, validity and vertical quantum of every sample, and a digest if wanted."""
        _check_free_space(self.source.info, self.directory, self.source.is_striped)
        self._windows = Windows(self.source, self.directory)
        return scan_windows(
            self.source.info,
            self._windows.scan(),
            self.reporter,
            has_digest=self.has_digest,
            steps=steps,
        )

    def encode(self, job: Job) -> "Coded":
        """Code all units into one spool per segment."""
        return encode(job, self.windows, self.directory, self.executor, self.reporter)

    def prove(self, path: str | os.PathLike[str] | bytes, job: Job) -> float:
        """Decode the file from disk and compare every sample; return the largest error."""
        return prove(path, job, self.windows, self.executor, self.reporter)

    def close(self) -> None:
        """Delete temporary data."""
        if self._windows is not None:
            self._windows.close()


# Pass A


# Heights, validity, row and column of the first sample.
Window = tuple[NDArray[Any], NDArray[np.bool_], int, int]


class Windows(SourceWindows):
    """The source's windows, spooled during the scan where its own are slow to read.

    A narrow window of a striped raster decodes whole strips, once for every window beside it. And a
    small raster is kept in memory: each sample is read two or three times.
    """

    def __init__(self, source: RasterSource, directory: Path) -> None:
        self._source = source
        self._shape = source.info.n_rows, source.info.n_cols
        self._directory = directory
        self._heights: Spool | None = None
        self._voids: Spool | None = None
        if source.is_striped or (source.is_file and source.info.n_bytes <= MEMORY_LIMIT):
            self._heights = Spool(self._shape, source.info.dtype, directory)

    def scan(self) -> Iterator[Window]:
        """Yield (heights, validity, row, column), once over the raster in the source's order."""
        for region in self._source.blocks():
            heights, valid = self._source.read(*region)
            if self._heights is not None:
                self._heights.write(region, heights)
                if self._voids is None and not valid.all():
                    self._voids = Spool(self._shape, np.bool_, self._directory)
                if self._voids is not None:
                    self._voids.write(region, ~valid)
            yield heights, valid, region.row, region.col

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return raw heights and validity of a window."""
        if self._heights is None:
            return self._source.read(row, col, n_rows, n_cols)
        region = Region(row, col, n_rows, n_cols)
        if self._voids is None:
            return self._heights.read(region), np.ones(region.shape, dtype=np.bool_)
        return self._heights.read(region), ~self._voids.read(region)

    def close(self) -> None:
        """Delete the spools."""
        for spool in (self._heights, self._voids):
            if spool is not None:
                spool.close()


def scan_windows(
    info: RasterInfo,
    windows: Iterable[Window],
    reporter: Reporter,
    *,
    has_digest: bool,
    steps: FixedSteps | None = None,
) -> HeightScan:
    """Return range, validity, vertical quantum and, if wanted, a digest of a raster's windows."""
    scan = HeightScan(info.dtype, steps, HeightDigest(info.n_cols) if has_digest else None)
    total = info.n_rows * info.n_cols
    for window in windows:
        scan.update(*window)
        n_bytes = scan.n_samples * np.dtype(info.dtype).itemsize
        reporter.report("scanning", scan.n_samples, total, n_bytes)
    return scan


def _check_free_space(info: RasterInfo, directory: Path, is_striped: bool) -> None:
    """Refuse to begin what the temporary directory cannot hold."""
    n_samples = info.n_rows * info.n_cols
    needed = n_samples * 4 // 3 + (info.n_bytes if is_striped else 0)
    free = shutil.disk_usage(directory).free
    if needed > free:
        sizes = size_of(needed), size_of(free)
        if sizes[0] == sizes[1]:
            sizes = count_of(needed, "byte"), count_of(free, "byte")
        raise StorageError(
            f"temporary data need about {sizes[0]}, {directory.parent} has {sizes[1]} free:"
            " name another directory with `temp_dir`"
        )


# Pass B


@dataclass
class Coded:
    """What coding a raster has made: tables, segments, bytes of payloads and tables.

    `job` is the one that was coded; that of an embedded file has got its measured error.
    """

    parameters: bytes
    segments: dict[Block | None, SegmentSpool | StoredSegment]
    n_bytes: int
    job: Job

    def close(self) -> None:
        """Delete the spools."""
        for segment in self.segments.values():
            if isinstance(segment, SegmentSpool):
                segment.close()


def smaller(first: Coded, second: Coded) -> Coded:
    """Return the smaller one; the other is closed."""
    kept, dropped = (first, second) if first.n_bytes <= second.n_bytes else (second, first)
    dropped.close()
    return kept


def encode(
    job: Job,
    source: SourceWindows,
    directory: Path,
    executor: Executor,
    reporter: Reporter,
) -> Coded:
    """Code all units into one spool per segment."""
    pyramid = Pyramid(
        source,
        job.quantizer,
        job.grid,
        kind=job.options.coding.pyramid,
        has_voids=job.has_voids,
        directory=directory,
        executor=executor,
    )
    try:
        itemsize = np.dtype(job.info.dtype).itemsize
        pyramid.build(
            lambda done, total: reporter.report("making levels", done, total, done * itemsize)
        )
        sink = SpoolSink(job.grid, job.grid.segment_heads(), directory)
        total = job.grid.n_rows * job.grid.n_cols
        n_units = job.grid.n_units()
        done = 0
        lock = threading.Lock()

        def on_samples(n_samples: int) -> None:
            nonlocal done
            with lock:
                done = min(done + n_samples, total)
                reporter.report(
                    "encoding",
                    done,
                    total,
                    done * itemsize,
                    n_bytes_out=sink.n_bytes,
                    n_units=sink.n_units,
                    n_units_total=n_units,
                    n_levels=job.grid.k_max + 1,
                )

        section = b""
        units: dict[Block, Decoded] = {}
        if job.options.coding.is_tiled:
            # Imported here: compiling costs seconds that other methods need not pay.
            from terrainwave.write.tiles import encode_tiles

            stats = encode_tiles(job, pyramid, sink, directory, on_samples, executor)
        else:
            section, stats, units = _encode_units(job, pyramid, sink, on_samples, executor)
        if job.options.is_embedded:
            job = job.with_measured(_finest_error(job, stats))
        errors = error_codes(stats, job.lost, job.recursion_bound)
        mesh_errors = _mesh_errors(job, section, pyramid, sink, units, errors, executor, reporter)
    finally:
        pyramid.close()
    whole = job.quantizer.z_min, job.quantizer.z_max
    boxes = enclosing_boxes(stats, errors, whole, {})
    set_codes(job.grid, sink.spools, whole, boxes, errors, mesh_errors)
    return Coded(section, {**sink.spools}, sink.n_bytes + len(section), job)


def _encode_units(
    job: Job,
    pyramid: Pyramid,
    sink: SpoolSink,
    on_samples: Callable[[int], None],
    executor: Executor,
) -> tuple[bytes, Stats, dict[Block, Decoded]]:
    """Code every unit; return the tables of the file and what was measured.

    And what the units decode to, where meshes are to be made of it and all of it fits in memory.
    """
    refiner, section = fitted_refiner(job, pyramid.heights, pyramid.mask)
    units: dict[Block, Decoded] = {}
    # Heights and masks of all levels: four thirds of five bytes for each sample.
    is_kept = 20 * job.grid.n_rows * job.grid.n_cols <= 3 * _MESH_CACHE_BYTES
    encoder = TreeEncoder(
        job.grid, refiner, job.parameters, pyramid, sink, on_samples,
        on_unit=units.__setitem__ if is_kept and job.options.mesh != "none" else None,
    )  # fmt: skip
    return section, encoder.run(executor), units


def _finest_error(job: Job, stats: Stats) -> int:
    """Return the largest error of the finest blocks, in quanta."""
    k_max = job.grid.k_max
    return max(
        (own.error for block, own in stats.items() if block.level == k_max),
        default=0,
    )


def _mesh_errors(
    job: Job,
    section: bytes,
    pyramid: Pyramid,
    sink: SpoolSink,
    units: dict[Block, Decoded],
    errors: dict[Block, int],
    executor: Executor,
    reporter: Reporter,
) -> dict[Block, int]:
    """Return the error code of every block's mesh against the originals.

    `units` are not decoded again, and taken out.
    """
    if job.options.mesh == "none":
        return {}
    grid = job.grid
    decoder = make_decoder(job.header(section), sink.payloads, _MESH_CACHE_BYTES)
    while units:
        decoder.put(*units.popitem())
    size = grid.n_rows * grid.n_cols, np.dtype(job.info.dtype).itemsize
    mesher, sections = make_meshes(
        grid,
        decoder,
        lambda block: errors.get(block, 0),
        job.mesh_tolerance,
        has_voids=job.has_voids,
        kind=job.options.mesh_kind,
        executor=executor,
        on_samples=reporter.counter("making meshes", *size),
    )
    sink.set_meshes(sections)
    count = reporter.counter("measuring meshes", *size)
    lost = Fraction(job.lost)
    found = measure_meshes(grid, mesher, pyramid.originals, executor, count, lost)
    return mesher.error_codes(found, lost, by_recursion=job.options.faithful)


# Pass C


def prove(
    path: str | os.PathLike[str] | bytes,
    job: Job,
    source: SourceWindows,
    executor: Executor,
    reporter: Reporter,
) -> float:
    """Decode the file from disk and compare every sample and the mask; return the largest error.

    Raises
    ------
    BoundViolationError
        If a sample is further than the bound from the original, or valid where that is void.
    """
    grid = job.grid
    shares = proof_shares(grid)
    allowed = allowed_error(job.quantizer, job.raw_bound, job.effective_error)
    largest = 0.0
    with TerrainFile(path, threads=1, cache_bytes=_PROOF_CACHE_BYTES, native=False) as terrain:

        def compare(share: list[Region]) -> float:
            return max(compare_window(terrain, source, region, allowed) for region in share)

        done = 0
        for share, error in zip(shares, executor.map(compare, shares), strict=True):
            largest = max(largest, error)
            done += sum(region.n_rows * region.n_cols for region in share)
            n_bytes = done * np.dtype(job.info.dtype).itemsize
            reporter.report("proving", done, grid.n_rows * grid.n_cols, n_bytes)
    return measured_error(largest, job.quantizer)
