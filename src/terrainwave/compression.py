"""The encoder: raster in, .twz file out. Start reading at `compress`.

Three passes over the source, windows at a time (DESIGN §3.10): A scans it and makes the pyramid of
target heights, B codes the quadtree top down in a closed loop, C decodes the finished file from
disk with the ordinary decoder and compares every sample. Memory stays flat in all of them.
"""

import io
import os
import sys
import tempfile
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

from terrainwave.arguments import EFFORTS, check_effort, check_threads, checked_error, checked_mesh
from terrainwave.codec.registry import check_method
from terrainwave.container.depot import Depot
from terrainwave.container.publish import publish, refuse_own_source, scratch_directory
from terrainwave.container.writer import assemble
from terrainwave.distribution import (
    TASK_SAMPLES,
    DistributedPasses,
    executor_of,
    shared_raster,
    task_level,
)
from terrainwave.errors import InvalidHeightsError
from terrainwave.job import Job, scale_of
from terrainwave.local_passes import LocalPasses, smaller
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.quadtree import Grid
from terrainwave.quantum import HeightScan, Quantizer, as_fraction
from terrainwave.raster_io.info import RasterInfo
from terrainwave.raster_io.source import RasterSource
from terrainwave.subtrees import RasterPlace

DEFAULT_MAX_ERROR = 0.01
BLOCKS = (32, 64, 128, 256, 512, 1024)
# Heights on no grid are rounded to their range / 2^18 or so before a stream of them is cut.
_FINE_BITS = 18


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
        check_effort(effort)
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
    client: Any = None,
    task_samples: int = TASK_SAMPLES,
    progress: ProgressCallback | None = None,
) -> CompressResult:
    """Compress a raster to a .twz file in which every valid sample is within `max_error`.

    Parameters
    ----------
    src : path, rasterio dataset, list of these, ndarray or xarray DataArray
        One band of heights: uint8, int16, uint16, int32, float32 or float64. A list is a mosaic:
        rasters of one CRS and grid, void where none is; the last counts where they overlap.
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
        ``"predictive"``, ``"rapid"``, ``"cdf97"``, ``"cdf53"``, ``"store"`` or ``"auto"``
        (predictive, the smallest).
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
        Where large temporary data go; by default beside `dst`. With `client` a path or a URL that
        fsspec can write to, seen by all workers.
    verify : bool
        Decode the file and compare every sample before it replaces `dst`.
    threads : int, optional
        Threads that encode; the number of processors by default. The bytes don't depend on it.
    overwrite : bool
        Replace an existing `dst`.
    client : dask.distributed.Client or concurrent.futures.Executor, optional
        Shares the work out: to the workers of a cluster, which must be able to read the path `src`
        and `dst`. The bytes are the same. Not with method cdf53.
    task_samples : int
        With `client`: samples that a task has at least.
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
    ClusterError
        If workers were lost more often than the cluster allows; `dst` is untouched.

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
    cluster = None
    if client is not None:
        if options.method == "cdf53":
            raise InvalidHeightsError(
                "found method cdf53 and a client, expected another method: only one machine codes"
                " the tiles of cdf53"
            )
        is_remote = temp_dir is not None and "://" in os.fspath(temp_dir)
        raster = shared_raster(src, band, nodata)
        url = temp_dir if is_remote else None
        cluster = _Cluster(executor_of(client), raster, url, task_samples)
        temp_dir = None if is_remote else temp_dir
    refuse_own_source(src, dst)
    with (
        publish(dst, overwrite=overwrite) as part,
        RasterSource(src, band=band, nodata=nodata) as source,
        scratch_directory(temp_dir or Path(dst).absolute().parent, Path(dst).name) as directory,
    ):
        reporter = Reporter(progress)
        written = _write(part.file, part.path, source, options, directory, reporter, cluster)
        n_bytes = os.path.getsize(part.path)
    n_samples = source.info.n_rows * source.info.n_cols
    return CompressResult(
        path=os.fspath(dst),
        n_bytes=n_bytes,
        n_samples=n_samples,
        bits_per_sample=8 * n_bytes / n_samples,
        ratio=source.info.n_bytes / n_bytes,
        max_error=written.max_error,
        effective_error=written.effective_error,
        measured_error=written.measured_error,
        units=source.info.units,
        method=written.method,
        notes=[*source.notes, *written.notes],
    )


def compress_to_bytes(
    src: Any,
    *,
    max_error: float | None = None,
    method: str = "auto",
    block: int = 256,
    effort: str = "default",
    nodata: float | None = None,
    mesh: str = "none",
    verify: bool = True,
    threads: int | None = None,
) -> bytes:
    """Return what `compress` would write, as bytes; `Terrain` opens them as it opens a file.

    For arrays that fit memory: chunks of a store, cells of a database. The options, the bound and
    the errors are those of `compress`, but that no meshes are made unless they are asked for.
    """
    options = Options.checked(
        max_error, None, None, method, block, effort, 1, mesh, None, verify, threads
    )
    file = io.BytesIO()
    with (
        RasterSource(src, nodata=nodata) as source,
        tempfile.TemporaryDirectory(prefix="terrainwave-") as directory,
    ):
        _write(file, None, source, options, Path(directory), Reporter(None))
    return file.getvalue()


@dataclass(frozen=True)
class _Written:
    """What a finished file keeps; errors in physical units."""

    method: str
    max_error: float
    effective_error: float
    measured_error: float | None
    notes: list[str]


def _write(
    file: BinaryIO,
    path: Path | None,
    source: RasterSource,
    options: Options,
    directory: Path,
    reporter: Reporter,
    cluster: "_Cluster | None" = None,
) -> _Written:
    """Write the .twz of `source` to `file` and prove it.

    `path` is where `file` lies; None for one in memory.
    """
    grid = Grid(source.info.n_rows, source.info.n_cols, options.block)
    with ThreadPoolExecutor(options.n_threads, thread_name_prefix="terrainwave") as executor:
        with closing(_passes(source, grid, directory, executor, reporter, cluster)) as passes:
            scan = passes.scan()
            bound, quantizer, notes = _settled(options, scan, source.info)
            job = Job(
                info=source.info,
                quantizer=quantizer,
                grid=grid,
                bound=bound,
                effort=options.effort,
                border_rings=options.border_rings,
                mesh=options.mesh,
                mesh_error=options.mesh_error,
                n_valid=scan.n_valid,
                rate=options.rate,
                psnr=options.psnr,
            )
            coded = passes.encode(job, options.method)
            is_large = coded.n_bytes > source.info.n_bytes and not options.is_embedded
            if is_large and options.method != "store":
                coded = smaller(coded, passes.encode(job, "store"))
                if coded.method == "store":
                    notes.append("the heights do not compress: stored as they are")
            job = coded.job
            assemble(file, job.header(coded.method, coded.parameters), coded.segments)
            measured = None
            if options.verify:
                measured = passes.prove(path or cast(io.BytesIO, file).getvalue(), job)
            coded.close()
    scale = abs(source.info.scale)
    return _Written(
        method=coded.method,
        max_error=float(job.bound),
        effective_error=min(job.effective_error * scale, float(job.bound)),
        measured_error=None if measured is None else measured * scale,
        notes=notes,
    )


class _Cluster(NamedTuple):
    """What takes tasks, the raster as it sees it, and a URL of the depot if it is not local."""

    executor: Executor
    raster: RasterPlace
    url: str | os.PathLike[str] | None
    task_samples: int


def _passes(
    source: RasterSource,
    grid: Grid,
    directory: Path,
    executor: Executor,
    reporter: Reporter,
    cluster: _Cluster | None,
) -> LocalPasses | DistributedPasses:
    """Return the passes of this process, or of a cluster where there is enough for a task."""
    level = None if cluster is None else task_level(grid, cluster.task_samples)
    if cluster is None or level is None:
        return LocalPasses(source, directory, executor, reporter)
    return DistributedPasses(
        cluster.executor,
        cluster.raster,
        source,
        grid,
        level,
        Depot(_depot_root(cluster.url, directory)),
        directory,
        executor,
        reporter,
    )


def _depot_root(url: str | os.PathLike[str] | None, directory: Path) -> str:
    """Return where tasks leave their results: below a URL, or in a directory of this machine."""
    if url is not None:
        return f"{os.fspath(url).rstrip('/')}/{directory.name}"
    depot = directory.absolute() / "depot"
    depot.mkdir()
    return str(depot)


def _settled(
    options: Options, scan: HeightScan, info: RasterInfo
) -> tuple[Fraction, Quantizer, list[str]]:
    """Return the bound in physical units, the quantizer, and what a user should know of them."""
    bound, notes = Fraction(0), list[str]()
    if options.is_embedded:
        quantizer = _fine_quantizer(scan)
    else:
        bound, notes = _choose_bound(options.max_error, scan, info)
        quantizer = scan.quantizer(_raw_bound(bound, info))
    if options.method == "cdf53":
        quantizer = _with_room_for_nodata(quantizer, info)
    return bound, quantizer, notes


def _raw_bound(bound: Fraction, info: RasterInfo) -> Fraction:
    """Return a bound in the units of stored values."""
    raw_bound = bound / scale_of(info)
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


def _choose_bound(
    max_error: float | None, scan: HeightScan, info: RasterInfo
) -> tuple[Fraction, list[str]]:
    if max_error is not None:
        return as_fraction(max_error), []
    p = scan.true_quantum()
    unit = info.units or "(unit unknown)"
    if p is not None:
        physical = float(p * scale_of(info))
        return Fraction(0), [
            f"no --max-error given: lossless, as all heights are multiples of {physical:g} {unit};"
            " --max-error E makes the file smaller"
        ]
    return as_fraction(DEFAULT_MAX_ERROR), [
        f"no --max-error given: {DEFAULT_MAX_ERROR} {unit}, as the heights lie on no vertical grid;"
        " choose with --max-error E"
    ]
