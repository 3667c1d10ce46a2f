"""The encoder: raster in, .twz file out. Start reading at `compress`.

Three passes over the source, windows at a time (DESIGN §3.10): A scans it and makes the pyramid of
target heights, B codes the quadtree top down in a closed loop, C decodes the finished file from
disk with the ordinary decoder and compares every sample. Memory stays flat in all of them.
"""

import math
import os
import shutil
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave._version import __version__
from terrainwave.arguments import check_threads, checked_error, checked_mesh
from terrainwave.codec.refiner import FittingRefiner
from terrainwave.codec.registry import PYRAMIDS, check_method, refiner_by_name
from terrainwave.codec.units import CodecParameters
from terrainwave.codes import decode_error, decode_range, encode_error, encode_range
from terrainwave.container.header import Header
from terrainwave.container.page import page_layout
from terrainwave.container.publish import publish, refuse_own_source, scratch_directory
from terrainwave.container.spool import SegmentSpool
from terrainwave.container.writer import assemble
from terrainwave.encoder import Stats, TreeEncoder
from terrainwave.errors import BoundViolationError, InvalidHeightsError, StorageError
from terrainwave.mesh_sections import make_sections, parts_of_blocks
from terrainwave.meshing import BlockMesher, measure_meshes, mesh_codes, mesh_tolerance
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.pyramid import Pyramid, SourceWindows
from terrainwave.quadtree import Block, Grid, Region
from terrainwave.quantum import HeightScan, Quantizer, as_fraction
from terrainwave.raster_io.info import RasterInfo
from terrainwave.raster_io.source import RasterSource
from terrainwave.spool import Spool
from terrainwave.terrain import EFFORTS, Terrain
from terrainwave.tile_decoder import make_decoder

DEFAULT_MAX_ERROR = 0.01
BLOCKS = (32, 64, 128, 256, 512, 1024)
# Meshes that `compress` makes; "auto" is the first.
_OUR_FAULT = (
    "unless the raster changed while it was read, this is a fault of terrainwave: please report it"
    " with the raster. Nothing was written"
)
# Samples per side of the windows the proof compares, where groups are smaller than that.
_PROOF_SIDE = 512
# Heights on no grid are rounded to their range / 2^18 or so before a stream of them is cut.
_FINE_BITS = 18
# What a file is thought to take beside its payloads, in bytes: for itself and for each unit.
_FILE_BYTES, _UNIT_BYTES = 600, 24
_MESH_CACHE_BYTES = 128 << 20


@dataclass(frozen=True)
class Options:
    """Checked options of `compress`; errors are raised where they are made."""

    max_error: float | None
    rate: float | None
    psnr: float | None
    method: str
    block: int
    effort: int
    border_rings: int
    mesh: str
    mesh_error: float | None
    verify: bool
    n_threads: int

    @property
    def is_embedded(self) -> bool:
        """Say whether streams are cut by size or mean error, not by a bound."""
        return self.rate is not None or self.psnr is not None

    @classmethod
    def checked(
        cls,
        max_error: float | None,
        rate: float | None,
        psnr: float | None,
        method: str,
        block: int,
        effort: str,
        border_rings: int,
        mesh: str,
        mesh_error: float | None,
        verify: bool,
        threads: int | None,
    ) -> "Options":
        """Return the options, or raise `InvalidHeightsError` naming what was found and expected."""
        bound = checked_error("max_error", max_error)
        method = check_method(method)
        _check_embedded(max_error, rate, psnr, method)
        if block not in BLOCKS:
            raise InvalidHeightsError(
                f"found block {block}, expected one of {', '.join(map(str, BLOCKS))}"
            )
        if effort not in EFFORTS:
            raise InvalidHeightsError(
                f"found effort {effort!r}, expected one of {', '.join(EFFORTS)}"
            )
        if border_rings not in (1, 3):
            raise InvalidHeightsError(f"found border_rings {border_rings}, expected 1 or 3")
        if border_rings != 1 and method == "cdf53":
            raise InvalidHeightsError(
                f"found border_rings {border_rings} and method cdf53, expected border_rings 1"
            )
        kind = checked_mesh(mesh, or_none=True)
        check_threads(threads)
        return cls(
            max_error=bound,
            rate=rate,
            psnr=psnr,
            method=method,
            block=block,
            effort=EFFORTS.index(effort),
            border_rings=border_rings,
            mesh=kind,
            mesh_error=checked_error("mesh_error", mesh_error),
            verify=verify,
            n_threads=threads or os.cpu_count() or 1,
        )


def _check_embedded(
    max_error: float | None, rate: float | None, psnr: float | None, method: str
) -> None:
    """Raise `InvalidHeightsError` unless at most one of three goals is given, and fits."""
    goals = {"max_error": max_error, "rate": rate, "psnr": psnr}
    given = [name for name, goal in goals.items() if goal is not None]
    if len(given) > 1:
        raise InvalidHeightsError(
            f"found {' and '.join(given)}, expected one of them: a stream is cut in one place"
        )
    for name in ("rate", "psnr"):
        goal = checked_error(name, goals[name])
        if goal is None:
            continue
        if goal == 0:
            raise InvalidHeightsError(f"found {name} 0, expected a number > 0")
        if method != "cdf53":
            raise InvalidHeightsError(
                f"found {name} and method {method}, expected method cdf53: the others keep a bound"
                " (max_error) instead"
            )


@dataclass(frozen=True)
class CompressResult:
    """What `compress` made; errors in physical units.

    `measured_error` is None where the proof was skipped; `notes` say what a user should know.
    """

    path: str
    n_bytes: int
    n_samples: int
    bits_per_sample: float
    ratio: float
    max_error: float
    effective_error: float
    measured_error: float | None
    units: str | None
    method: str
    notes: list[str] = field(default_factory=list)


def compress(
    src: Any,
    dst: str | os.PathLike[str],
    *,
    max_error: float | None = None,
    rate: float | None = None,
    psnr: float | None = None,
    method: str = "auto",
    block: int = 256,
    effort: str = "default",
    nodata: float | None = None,
    band: int = 1,
    border_rings: int = 1,
    mesh: str = "auto",
    mesh_error: float | None = None,
    temp_dir: str | os.PathLike[str] | None = None,
    verify: bool = True,
    threads: int | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> CompressResult:
    """Compress a raster to a .twz file in which every valid sample is within `max_error`.

    Parameters
    ----------
    src : path, rasterio dataset, ndarray or xarray DataArray
        One band of heights: uint8, int16, uint16, int32, float32 or float64.
    dst : path
        The file to make. It appears complete or not at all.
    max_error : float, optional
        Largest allowed error in physical units (after scale and offset); >= 0, closed. By default
        0 (lossless) where the heights have a vertical quantum and 0.01 where they don't.
    rate : float, optional
        With method cdf53, instead of `max_error`: bits per sample that the file may take. The
        file's bound is then the error that was measured.
    psnr : float, optional
        With method cdf53, instead of `max_error`: decibels of the heights' range over the root
        mean square error that the file must reach.
    method : str
        ``"predictive"``, ``"cdf97"``, ``"cdf53"``, ``"store"`` or ``"auto"`` (predictive, the
        smallest).
    block : int
        Cells per side of a block: 32, 64, … 1024.
    effort : str
        ``"fast"``, ``"default"`` or ``"best"``.
    nodata : float, optional
        Replaces the raster's own nodata value.
    band : int, optional
        Band to take, from 1.
    border_rings : int
        1, or 3 to share one more ring on both sides of every border (Yusov & Turlapov 2010, §2.3).
    mesh : str
        Triangulation of every block: ``"halves"`` or ``"auto"`` (halves), which is made again when
        it is read and stores only its measured error; ``"zerotree"``, the guaranteed triangulation
        of Yusov & Turlapov 2010, stored as labels; ``"rqt"``, a restricted quadtree, which stores
        some vertices of borders; or ``"none"``. To make the second and third takes memory that
        grows with the raster (`mesh_sections.make_sections`).
    mesh_error : float, optional
        Largest vertical distance of the finest meshes from the decoded heights, in physical units;
        by default what `max_error` guarantees, or the vertical quantum if that is more.
    temp_dir : path, optional
        Where large temporary data go; by default beside `dst`.
    verify : bool
        Decode the file and compare every sample before it replaces `dst`.
    threads : int, optional
        Threads that encode; the number of processors by default. The bytes don't depend on it.
    overwrite : bool
        Replace an existing `dst`.
    progress : callable, optional
        Called with a `Progress` now and then, from one thread at a time.

    Raises
    ------
    InvalidHeightsError
        If the heights or an option cannot be used, or the bound cannot be kept.
    BoundViolationError
        If the proof fails; `dst` is untouched.
    StorageError
        If something cannot be read or written, or `dst` is `src`; `dst` is untouched.

    Notes
    -----
    O(n_rows * n_cols) time; memory O(threads * block^2 * levels), whatever the size of the raster.
    """
    options = Options.checked(
        max_error,
        rate,
        psnr,
        method,
        block,
        effort,
        border_rings,
        mesh,
        mesh_error,
        verify,
        threads,
    )
    reporter = Reporter(progress)
    refuse_own_source(src, dst)
    with (
        publish(dst, overwrite=overwrite) as part,
        RasterSource(src, band=band, nodata=nodata) as source,
        scratch_directory(temp_dir or Path(dst).absolute().parent, Path(dst).name) as directory,
        ThreadPoolExecutor(options.n_threads, thread_name_prefix="terrainwave") as executor,
    ):
        windows, scan = _scan(source, directory, reporter)
        notes: list[str] = []
        if options.is_embedded:
            bound, quantizer = Fraction(0), _fine_quantizer(scan)
        else:
            bound, notes = _choose_bound(options.max_error, scan, source.info)
            quantizer = scan.quantizer(_raw_bound(bound, source.info))
        if options.method == "cdf53":
            quantizer = _with_room_for_nodata(quantizer, source.info)
        grid = Grid(source.info.n_rows, source.info.n_cols, options.block)
        job = _Job(source.info, windows, scan, quantizer, grid, options, bound, directory)
        coded = _encode(job, options.method, executor, reporter)
        is_large = coded.n_bytes > source.info.n_bytes and not options.is_embedded
        if is_large and options.method != "store":
            coded = _smaller(coded, _encode(job, "store", executor, reporter))
            if coded.method == "store":
                notes.append("the heights do not compress: stored as they are")
        job = coded.job
        assemble(part.file, _header(job, coded), coded.spools)
        measured = None
        if options.verify:
            measured = _prove(part.path, job, executor, reporter)
        n_bytes = os.path.getsize(part.path)
        coded.close()
        windows.close()
    n_samples = source.info.n_rows * source.info.n_cols
    scale = abs(source.info.scale)
    return CompressResult(
        path=os.fspath(dst),
        n_bytes=n_bytes,
        n_samples=n_samples,
        bits_per_sample=8 * n_bytes / n_samples,
        ratio=source.info.n_bytes / n_bytes,
        max_error=float(job.bound),
        effective_error=min(job.effective_error * scale, float(job.bound)),
        measured_error=None if measured is None else measured * scale,
        units=source.info.units,
        method=coded.method,
        notes=[*source.notes, *notes],
    )


@dataclass(frozen=True)
class _Job:
    """What all passes share."""

    info: RasterInfo
    source: "_Windows"
    scan: HeightScan
    quantizer: Quantizer
    grid: Grid
    options: Options
    bound: Fraction
    directory: Path
    # The error of a file whose streams were cut, once it is known; in raw units.
    measured: float | None = None

    @property
    def effective_error(self) -> float:
        """Return the bound that holds, in raw units."""
        return self.quantizer.effective_error if self.measured is None else self.measured

    @property
    def raw_bound(self) -> float:
        """Return the bound asked for, in raw units."""
        return float(self.bound / _scale_of(self.info))


def _raw_bound(bound: Fraction, info: RasterInfo) -> Fraction:
    """Return a bound in the units of stored values."""
    raw_bound = bound / _scale_of(info)
    if raw_bound > sys.float_info.max:
        raise InvalidHeightsError(
            f"found max_error {float(bound):g} and a raster whose scale is {info.scale:g}, expected"
            " a max_error that is a finite number of its stored units"
        )
    return raw_bound


def _with_room_for_nodata(quantizer: Quantizer, info: RasterInfo) -> Quantizer:
    """Return a quantizer whose bound still holds where a height gives way to the nodata value.

    Method cdf53 moves it past all quanta of that value, to one side (format-cdf53.md, C.6).
    """
    first, last = quantizer.quanta_of_value(info.nodata)
    room = last - first + 1
    half = quantizer.step >> 1
    return replace(quantizer, step=2 * max(half - room, 0) + 1) if room > 0 else quantizer


def _fine_quantizer(scan: HeightScan) -> Quantizer:
    """Return a quantizer for heights whose error is not chosen by a bound.

    The vertical quantum where there is one, else one far below what a cut stream tells.
    """
    if scan.true_quantum() is not None:
        try:
            return scan.quantizer(Fraction(0))
        except InvalidHeightsError:  # the range takes more than 30 bits of it
            pass
    error = (as_fraction(scan.maximum) - as_fraction(scan.minimum)) / (1 << _FINE_BITS)
    for _ in range(_FINE_BITS):
        try:
            return scan.quantizer(error)
        except InvalidHeightsError:
            error *= 2
    return scan.quantizer(error)


def _scale_of(info: RasterInfo) -> Fraction:
    if info.scale == 0 or not math.isfinite(info.scale):
        raise InvalidHeightsError(
            f"the raster's scale is {info.scale:g}, expected a finite number that is not 0: correct"
            " its metadata"
        )
    return abs(as_fraction(info.scale))


# Pass A


class _Windows(SourceWindows):
    """The source's windows; those of striped sources are spooled in tiles during the scan.

    A narrow window of a striped raster decodes whole strips, once for every window beside it.
    """

    def __init__(self, source: RasterSource, directory: Path) -> None:
        self._source = source
        self._shape = source.info.n_rows, source.info.n_cols
        self._directory = directory
        self._heights: Spool | None = None
        self._voids: Spool | None = None
        if source.is_striped:
            self._heights = Spool(self._shape, source.info.dtype, directory)

    def scan(self) -> Iterator[tuple[NDArray[Any], NDArray[np.bool_]]]:
        """Yield (heights, validity), once over the whole raster in the source's order."""
        for region in self._source.blocks():
            heights, valid = self._source.read(*region)
            if self._heights is not None:
                self._heights.write(region, heights)
                if self._voids is None and not valid.all():
                    self._voids = Spool(self._shape, np.bool_, self._directory)
                if self._voids is not None:
                    self._voids.write(region, ~valid)
            yield heights, valid

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


def _scan(source: RasterSource, directory: Path, reporter: Reporter) -> tuple[_Windows, HeightScan]:
    """Read the source once: range, validity and vertical quantum of every sample."""
    info = source.info
    _check_free_space(info, directory, source.is_striped)
    scan = HeightScan(info.dtype)
    windows = _Windows(source, directory)
    total = info.n_rows * info.n_cols
    for heights, valid in windows.scan():
        scan.update(heights, valid)
        n_bytes = scan.n_samples * np.dtype(info.dtype).itemsize
        reporter.report("scanning", scan.n_samples, total, n_bytes)
    return windows, scan


def _check_free_space(info: RasterInfo, directory: Path, is_striped: bool) -> None:
    """Refuse to begin what the temporary directory cannot hold."""
    n_samples = info.n_rows * info.n_cols
    needed = n_samples * 4 // 3 + (info.n_bytes if is_striped else 0)
    free = shutil.disk_usage(directory).free
    if needed > free:
        raise StorageError(
            f"temporary data need about {needed / 1e9:.1f} GB, {directory.parent} has"
            f" {free / 1e9:.1f} GB free: name another directory with --temp-dir"
        )


def _choose_bound(
    max_error: float | None, scan: HeightScan, info: RasterInfo
) -> tuple[Fraction, list[str]]:
    if max_error is not None:
        return as_fraction(max_error), []
    p = scan.true_quantum()
    unit = info.units or "(unit unknown)"
    if p is not None:
        physical = float(p * _scale_of(info))
        return Fraction(0), [
            f"no --max-error given: lossless, as all heights are multiples of {physical:g} {unit};"
            " --max-error E makes the file smaller"
        ]
    return as_fraction(DEFAULT_MAX_ERROR), [
        f"no --max-error given: {DEFAULT_MAX_ERROR} {unit}, as the heights lie on no vertical grid;"
        " choose with --max-error E"
    ]


# Pass B


@dataclass
class _Coded:
    """Coded heights; `n_bytes` are theirs: meshes take as many whatever the method."""

    method: str
    parameters: bytes
    spools: dict[Block | None, SegmentSpool]
    n_bytes: int
    job: _Job

    def close(self) -> None:
        for spool in self.spools.values():
            spool.close()


def _smaller(first: _Coded, second: _Coded) -> _Coded:
    kept, dropped = (first, second) if first.n_bytes <= second.n_bytes else (second, first)
    dropped.close()
    return kept


def _encode(job: _Job, method: str, executor: Executor, reporter: Reporter) -> _Coded:
    """Code all units into one spool per segment."""
    pyramid = Pyramid(
        job.source,
        job.quantizer,
        job.grid,
        kind=PYRAMIDS[method],
        has_voids=job.scan.has_voids,
        directory=job.directory,
        executor=executor,
    )
    try:
        itemsize = np.dtype(job.info.dtype).itemsize
        pyramid.build(
            lambda done, total: reporter.report("making levels", done, total, done * itemsize)
        )
        sink = _SpoolSink(job.grid, job.directory)
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
        if method == "cdf53":
            stats = _encode_tiles(job, pyramid, sink, on_samples, executor)
        else:
            section, stats = _encode_units(job, method, pyramid, sink, on_samples, executor)
        if job.options.is_embedded:
            job = _with_measured_bound(job, stats)
        errors = {block: encode_error(found.error + _lost(job)) for block, found in stats.items()}
        mesh_errors = _mesh_errors(job, method, section, pyramid, sink, errors, executor, reporter)
    finally:
        pyramid.close()
    _set_codes(job, sink.spools, stats, errors, mesh_errors)
    return _Coded(method, section, sink.spools, sink.n_bytes + len(section), job)


def _encode_units(
    job: _Job,
    method: str,
    pyramid: Pyramid,
    sink: "_SpoolSink",
    on_samples: Callable[[int], None],
    executor: Executor,
) -> tuple[bytes, Stats]:
    """Code every unit; return the method's parameters and what was measured."""
    parameters, section = _parameters(job), b""
    refiner = refiner_by_name(method)
    if isinstance(refiner, FittingRefiner) and job.scan.n_valid:
        refiner = refiner.fitted(job.grid, parameters.step, pyramid.heights, pyramid.mask)
        section = refiner.parameters
    encoder = TreeEncoder(job.grid, refiner, parameters, pyramid, sink, on_samples)
    return section, encoder.run(executor)


def _encode_tiles(
    job: _Job,
    pyramid: Pyramid,
    sink: "_SpoolSink",
    on_samples: Callable[[int], None],
    executor: Executor,
) -> Stats:
    """Code every tile of method cdf53; return what was measured."""
    # Imported here: compiling costs seconds that other methods need not pay.
    from terrainwave.tile_encoder import (
        EmbeddedSource,
        TileCoder,
        TileEncoder,
        TileSource,
    )

    parameters, options = _parameters(job), job.options
    coder = TileCoder(pyramid)
    source: TileSource = coder
    if options.is_embedded:
        embedded = source = EmbeddedSource(coder, job.grid, job.directory)
        embedded.code(executor, on_samples)
        if options.rate is not None:
            embedded.cut_to_size(_payload_bytes(job, options.rate))
        elif options.psnr is not None:
            span = parameters.z_max - parameters.z_min
            mean_square = span**2 * 10.0 ** (-options.psnr / 10)
            embedded.cut_to_error(mean_square, parameters, executor)
    try:
        encoder = TileEncoder(job.grid, parameters, pyramid, source, sink, on_samples)
        return encoder.run(executor)
    finally:
        if isinstance(source, EmbeddedSource):
            source.close()


def _payload_bytes(job: _Job, rate: float) -> int:
    """Return the bytes that a file of `rate` bits per sample has for payloads."""
    n_samples = job.grid.n_rows * job.grid.n_cols
    return int(rate * n_samples / 8) - _FILE_BYTES - _UNIT_BYTES * job.grid.n_units()


def _with_measured_bound(job: _Job, stats: Stats) -> _Job:
    """Return the job with the largest error of its finest blocks as the bound."""
    k_max = job.grid.k_max
    error = max((found.error for block, found in stats.items() if block.level == k_max), default=0)
    # That of a bounded file whose steps have this half.
    measured = replace(job.quantizer, step=2 * error + 1).effective_error
    return replace(job, measured=measured, bound=as_fraction(measured) * _scale_of(job.info))


def _lost(job: _Job) -> int:
    """Return what rounding to quanta loses of each height, in quanta, rounded up."""
    quantizer = job.quantizer
    return int(-(-Fraction(quantizer.rho) * quantizer.denominator // quantizer.numerator))


def _mesh_tolerance(job: _Job) -> int:
    """Return the tolerance of the finest meshes in 1/16 quanta, rounded down."""
    quantizer = job.quantizer
    if job.options.mesh_error is None:
        error = max(Fraction(job.effective_error), Fraction(quantizer.quantum))
    else:
        error = as_fraction(job.options.mesh_error) / _scale_of(job.info)
    return mesh_tolerance(error, Fraction(quantizer.numerator, quantizer.denominator))


def _mesh_errors(
    job: _Job,
    method: str,
    section: bytes,
    pyramid: Pyramid,
    sink: "_SpoolSink",
    errors: dict[Block, int],
    executor: Executor,
    reporter: Reporter,
) -> dict[Block, int]:
    """Return the error code of every block's mesh, measured against the originals."""
    if job.options.mesh == "none":
        return {}
    grid = job.grid
    decoder = make_decoder(
        method, section, grid, _parameters(job), sink.payloads, _MESH_CACHE_BYTES
    )
    sections: dict[Block, bytes] = {}
    mesher = BlockMesher(
        grid,
        decoder,
        lambda block: errors.get(block, 0),
        _mesh_tolerance(job),
        has_voids=job.scan.has_voids,
        kind=job.options.mesh,
        part=parts_of_blocks(grid, lambda key: sections.get(key, b"")),
    )
    size = grid.n_rows * grid.n_cols, np.dtype(job.info.dtype).itemsize
    count = reporter.counter("making meshes", *size)
    sections.update(make_sections(grid, mesher, executor, count))
    sink.set_meshes(sections)
    count = reporter.counter("measuring meshes", *size)
    found = measure_meshes(grid, mesher, pyramid.originals, executor, count)
    return mesh_codes(found, Fraction(_lost(job)))


class _SpoolSink:
    """Sorts payloads into the spools of their segments."""

    def __init__(self, grid: Grid, directory: Path) -> None:
        self._grid = grid
        self.spools = {head: SegmentSpool(directory) for head in grid.segment_heads()}
        self.n_bytes = 0
        self.n_units = 0
        self._n_missing: dict[Block | None, int] = {}
        self._lock = threading.Lock()

    def __call__(self, key: Block, payload: bytes) -> None:
        head = None if key.is_root_key else self._grid.segment_head(key)
        self.spools[head].add(key, payload)
        with self._lock:
            self.n_bytes += len(payload)
            self.n_units += 1
            if head not in self._n_missing:
                self._n_missing[head] = len(page_layout(self._grid, head).keys)
            self._n_missing[head] -= 1
            is_complete = self._n_missing[head] == 0
        if is_complete:
            self.spools[head].finish()

    def set_meshes(self, sections: Mapping[Block, bytes]) -> None:
        """Take the mesh sections of keys whose payloads have been taken."""
        for key, section in sections.items():
            head = None if key.is_root_key else self._grid.segment_head(key)
            self.spools[head].set_mesh(key, section)
        for spool in self.spools.values():
            spool.finish()

    def payloads(self, keys: Sequence[Block]) -> list[bytes]:
        """Return payloads that have been taken."""
        heads = [None if key.level < 0 else self._grid.segment_head(key) for key in keys]
        return [
            next(self.spools[head].chunks([key])) for head, key in zip(heads, keys, strict=True)
        ]


def _parameters(job: _Job) -> CodecParameters:
    quantizer = job.quantizer
    return CodecParameters(
        step=quantizer.step,
        z_min=quantizer.z_min,
        z_max=quantizer.z_max,
        forbidden=quantizer.quanta_of_value(job.info.nodata),
        rings=job.options.border_rings,
        effort=job.options.effort,
    )


def _set_codes(
    job: _Job,
    spools: dict[Block | None, SegmentSpool],
    stats: Stats,
    errors: dict[Block, int],
    mesh_errors: dict[Block, int],
) -> None:
    """Give every block its box and error, each box relative to its parent's in the segment."""
    quantizer = job.quantizer
    whole = quantizer.z_min, quantizer.z_max
    boxes = _enclosing_boxes(stats, errors, whole)
    for spool in spools.values():
        decoded: dict[Block, tuple[int, int]] = defaultdict(lambda: whole)
        for key in sorted(spool.keys()):
            codes = bytearray()
            for block in job.grid.key_blocks(key):
                if block not in boxes:  # no valid sample
                    codes += bytes(4)
                    continue
                below, above = encode_range(*boxes[block], *decoded[key])
                decoded[block] = decode_range(below, above, *decoded[key])
                codes += bytes([below, above, errors[block], mesh_errors.get(block, 0)])
            spool.set_codes(key, bytes(codes))


def _enclosing_boxes(
    stats: Stats, errors: dict[Block, int], whole: tuple[int, int]
) -> dict[Block, tuple[int, int]]:
    """Return the range of originals and surfaces of each block and of all below it."""
    boxes: dict[Block, tuple[int, int]] = {}
    for block in sorted(stats, reverse=True):  # the finest level first
        found = stats[block]
        if found.is_empty:
            continue
        # Decoded heights are clamped to the originals' range, so boxes are as well.
        error = decode_error(errors[block])
        low, high = max(found.z_low - error, whole[0]), min(found.z_high + error, whole[1])
        if block in boxes:
            low, high = min(low, boxes[block][0]), max(high, boxes[block][1])
        boxes[block] = low, high
        if block.level > 0:
            above = boxes.get(block.parent, (low, high))
            boxes[block.parent] = min(low, above[0]), max(high, above[1])
    return boxes


def _header(job: _Job, coded: _Coded) -> Header:
    quantizer, info = job.quantizer, job.info
    plain = RasterInfo(info.n_rows, info.n_cols, info.dtype).to_metadata()
    # Only what is not as it would be anyway; size and type are in the header itself.
    metadata = {name: value for name, value in info.to_metadata().items() if value != plain[name]}
    has_heights = job.scan.n_valid > 0
    return Header(
        n_rows=info.n_rows,
        n_cols=info.n_cols,
        block=job.options.block,
        border_rings=job.options.border_rings,
        method=coded.method,
        dtype=info.dtype,
        effort=job.options.effort,
        quantum=Fraction(quantizer.numerator, quantizer.denominator),
        base=quantizer.base,
        step=quantizer.step,
        z_min=quantizer.z_min if has_heights else 0,
        z_max=quantizer.z_max if has_heights else -1,
        max_error=job.raw_bound,
        effective_bound=min(job.effective_error, job.raw_bound),
        rho=quantizer.rho,
        mesh=job.options.mesh,
        mesh_tolerance=0 if job.options.mesh == "none" else _mesh_tolerance(job),
        metadata={**metadata, "software": f"terrainwave {__version__}"},
        parameters=coded.parameters,
    )


# Pass C


def _prove(
    path: str | os.PathLike[str], job: _Job, executor: Executor, reporter: Reporter
) -> float:
    """Decode the file from disk and compare every sample and the mask; return the largest error.

    Raises
    ------
    BoundViolationError
        If a sample is further than the bound from the original, or valid where that is void.
    """
    grid = job.grid
    side = max(2 * grid.block, _PROOF_SIDE)
    regions = [
        Region(row, col, min(side, grid.n_rows - row), min(side, grid.n_cols - col))
        for row in range(0, grid.n_rows, side)
        for col in range(0, grid.n_cols, side)
    ]
    allowed = allowed_error(job.quantizer, job.raw_bound)
    largest = 0.0
    with Terrain(path, threads=1) as terrain:

        def compare(region: Region) -> float:
            return _compare_window(terrain, job, region, allowed)

        done = 0
        for region, error in zip(regions, executor.map(compare, regions), strict=True):
            largest = max(largest, error)
            done += region.n_rows * region.n_cols
            n_bytes = done * np.dtype(job.info.dtype).itemsize
            reporter.report("proving", done, grid.n_rows * grid.n_cols, n_bytes)
    if allowed > job.raw_bound:
        # On a decimal grid the heights are multiples of p; floats name them with a spacing's error.
        p = job.quantizer.quantum
        largest = round(largest / p) * p
    return largest


def allowed_error(quantizer: Quantizer, raw_bound: float) -> float:
    """Return the largest difference of stored values that keeps the bound.

    On a true grid the bound holds for the numbers k * p; the floats nearest to two of them may
    differ by one spacing more than the numbers do.
    """
    if np.dtype(quantizer.dtype).kind != "f" or quantizer.rho > 0:
        return raw_bound
    extremes = quantizer.dequantize(np.array([[quantizer.z_min, quantizer.z_max]], dtype=np.int32))
    return raw_bound + float(np.spacing(np.abs(extremes)).max())


def _compare_window(terrain: Terrain, job: _Job, region: Region, allowed: float) -> float:
    raw, valid = job.source.read(*region)
    decoded, decoded_valid = terrain.read_with_mask(region)
    if not np.array_equal(valid, decoded_valid):
        row, col = np.argwhere(valid != decoded_valid)[0] + (region.row, region.col)
        raise BoundViolationError(
            f"the decoded mask differs from the source's at row {row}, column {col}; {_OUR_FAULT}"
        )
    if not valid.any():
        return 0.0
    errors = np.abs(decoded[valid].astype(np.float64) - raw[valid].astype(np.float64))
    largest = float(errors.max())
    if not largest <= allowed:  # a NaN is no height within the bound
        at = np.argwhere(valid)[int(errors.argmax())] + (region.row, region.col)
        raise BoundViolationError(
            f"the decoded height at row {at[0]}, column {at[1]} is {largest:g} off, more than"
            f" {allowed:g}; {_OUR_FAULT}"
        )
    return largest
