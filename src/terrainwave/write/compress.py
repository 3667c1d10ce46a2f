"""The encoder: raster in, .twz file out. Start reading at `compress`.

Three passes read the source in windows. Pass A scans it and makes the pyramid of target heights.
Pass B codes the quadtree top down in a closed loop. Pass C decodes the finished file from disk with
the ordinary decoder and compares every sample. No pass needs memory that grows with the raster.
"""

import io
import logging
import math
import os
import tempfile
import warnings
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from terrainwave.arguments import (
    TWZ_ENDINGS,
    check_ending,
    check_flags,
    checked_path,
    checked_whole,
)
from terrainwave.codec.method_options import MethodOptions
from terrainwave.container.sources.addresses import display_name
from terrainwave.container.targets.publication import (
    only_writer,
    publish,
    refuse_own_source,
    system_scratch,
)
from terrainwave.container.writer import append_digests, assemble
from terrainwave.errors import InvalidArgumentError, TerrainwaveWarning
from terrainwave.grid.crew import Crew
from terrainwave.place.units import height_unit
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.raster_io.dataset import refuse_raster, stamps_of
from terrainwave.raster_io.temporary import MEMORY_LIMIT
from terrainwave.raster_io.undeclared_voids import note_on_marks, note_on_undeclared
from terrainwave.tri.mesh_options import MeshOptions
from terrainwave.write.compress_options import Options
from terrainwave.write.earlier import earlier_of, for_heights_of
from terrainwave.write.job import fixed_steps, settled
from terrainwave.write.local import LocalPasses, smaller
from terrainwave.write.passes.bench import AskedRaster, Bench
from terrainwave.write.passes.resuming import run_directory, taken_up
from terrainwave.write.passes.windows import changed

if TYPE_CHECKING:
    from terrainwave.write.cluster import Cluster, DistributedPasses

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CompressResult:
    """Result of `compress`; errors in physical units.

    `measured_error`, from the given raster, is None if the proof was skipped. The file states the
    other two errors. They include the bound of a .twz file that the raster came from. `notes` are
    remarks for the user.
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
    bound: str = "both",
    method: str | MethodOptions = "auto",
    block: int = 256,
    effort: str = "default",
    nodata: float | str | None = None,
    band: int = 1,
    georeference: bool = True,
    heights_are: str | None = None,
    mesh: str | MeshOptions = "auto",
    mesh_error: float | None = None,
    measure_meshes: bool = False,
    height_range: tuple[float, float] | None = None,
    strict: bool = False,
    stable: bool = False,
    keep_origin: bool = False,
    digest: bool | None = None,
    temp_dir: str | os.PathLike[str] | None = None,
    verify: bool = True,
    threads: int | None = None,
    overwrite: bool = False,
    fresh: bool = False,
    client: Any = None,
    task_samples: int | None = None,
    progress: ProgressCallback | None = None,
) -> CompressResult:
    """Compress a raster to a .twz file; every valid sample stays within `max_error`.

    Parameters
    ----------
    src : path, rasterio dataset, Terrain, list of these, ndarray, xarray DataArray or Dataset
        One band of heights: uint8, int16, uint16, int32, float32 or float64. A list of rasters with
        the same CRS and grid makes a mosaic. Where they overlap, the last counts; where none lies,
        the mosaic is void. For a .twz file `max_error` is the bound from its original, and by
        default its heights are kept unchanged. A Dataset has one variable of heights
        (docs/integrations.md lists what is read from labels).
    dst : path
        Output file, whose name ends in ``.twz``. It appears complete or not at all, and never
        replaces a raster. It may be a URL that fsspec can write to, such as ``s3://`` (extra
        ``remote``): the file is made and proved on this machine, then uploaded.
    max_error : float, optional
        Largest allowed error (<=) in physical units, after scale and offset; >= 0. 0 keeps every
        bit. By default lossless if the heights are in whole steps (metres, centimetres, feet),
        otherwise 0.01 m, or less: `notes` of the result give the rule that was used
        (docs/choosing-a-bound.md).
    bound : {"both", "above", "below"}
        Side of the original on which decoded heights may lie, within `max_error`: ``"above"`` means
        that none is below its original, ``"below"`` that none is above. Up is physical, after scale
        and offset, and depths go down: with ``"above"`` no depth is deeper than measured. The full
        grid alone is one-sided; coarse levels, averages and meshes state errors to both sides. Such
        a file is about as large as one of half the bound. Not with `strict`, `stable`, method cdf53
        or ``Cdf97(faithful=True)``.
    method : str, Rapid, Predictive, Cdf97, Cdf53 or Store
        ``"rapid"``, ``"predictive"``, ``"cdf97"``, ``"cdf53"``, ``"store"`` or ``"auto"``, which
        means rapid; or a method with its options, such as ``tw.Cdf97(faithful=True)``. Files of
        predictive are smaller, and several times slower to read.
    block : int
        Cells per side of a block: 32, 64, … 1024.
    effort : str
        ``"fast"``, ``"default"`` or ``"best"``: number of variants that predictive and cdf97 try.
        Without a method, best selects predictive. Other methods ignore it.
    nodata : float or str, optional
        A value that marks voids, besides the raster's own. ``"only:V"`` takes the number V instead
        of the raster's own, ``"none"`` none at all; a note counts the samples that become heights.
    band : int, optional
        Band to compress; the first is 1.
    georeference : bool
        False drops georeference and CRS. Heights on a curvilinear grid can be compressed only so.
    heights_are : {"height", "depth", "radius"}, optional
        Meaning of the numbers, which the file records. Depths count downwards, radii from the
        centre of the body; both are stored unchanged and converted to heights on the globe, in
        meshes and in views. By default derived from ``positive``, CF names, the format and the
        CRS's vertical axis; radii are recognised by their size (docs/where-things-are.md).
    mesh : str, Zerotree or Rqt
        Triangulation of every block. ``"halves"`` (``"auto"``) is computed by readers, as is its
        error (see `measure_meshes`). ``"zerotree"`` is the guaranteed triangulation of Yusov &
        Turlapov 2010, stored as labels; with method cdf97 it follows zero trees. ``"rqt"`` is a
        restricted quadtree; it stores some border vertices. ``"none"`` makes no meshes. zerotree
        and rqt have options, such as ``tw.Zerotree(labels="layer")``, and making them takes memory
        that grows with the raster (`mesh.sections.make_sections`).
    mesh_error : float, optional
        Largest vertical distance of the finest meshes from the decoded heights, in physical units.
        By default the guaranteed error, or the vertical quantum if that is larger (for lossless
        heights without a quantum, their default bound).
    measure_meshes : bool
        Make all meshes and store their distances from the original. By default a file of `halves`
        stores no mesh errors above the finest level: readers compute a bound with the mesh, on
        average 1.7 times the true error. Measuring takes about as long as all the rest. The other
        kinds of meshes are always measured, as are files of ``Cdf97(faithful=True)``;
        `store_meshes` measures the meshes of a file later.
    height_range : tuple of two floats, optional
        Range of heights, in physical units, that a later `patch` may need. By default a file holds
        the range of the raster, and `patch` refuses heights outside it. A wider range costs few
        bytes, unless floats at its ends are too coarse for the bound: then the file is exact, and
        larger, and a note says so. Not for streams that are cut; without effect, but with a note,
        if the raster has only voids.
    strict : bool
        For floats on a decimal grid (0.1, 0.01 …), apply the bound to the stored floats:
        ``abs(decoded - original) <= max_error``, exactly and as numpy computes it in their type. By
        default the bound holds for the decimal numbers, and floats may differ by one float spacing
        more. With `strict`, decoded heights may be off the grid, and files become larger
        (docs/reliability.md). Files of other rasters change at most in the last digit of a bound.
    stable : bool
        Round heights to fixed steps, which depend only on `max_error`, type, scale and nodata
        value, and store these exactly. If you decompress the file and compress the heights again,
        whole or in parts, with the same bound, they do not change. The bound holds as with
        `strict`. Files become larger (docs/integrations.md). Not with method cdf53, nor with
        ``Cdf97(faithful=True)``.
    keep_origin : bool
        Store a digest of the heights and these options in the metadata, which ``compress
        --skip-existing`` compares. ``compress --to`` always stores it.
    digest : bool, optional
        Store digests (SHA-256) of the decoded heights: `Terrain.digest` returns the one for all
        heights and their position, `verify` checks it. They take 40 bytes, and 32 more for each
        4096 x 4096 samples. The default is that of `verify`, because the proof computes them.
    temp_dir : path, optional
        Directory for large temporary data; by default that of `dst`. With `client`, a path or URL
        that all workers can write to.
    verify : bool
        Decode the file and compare every sample before it replaces `dst`. A file made without says
        so (`Terrain.info`).
    threads : int, optional
        Threads that encode; the number of processors by default. The bytes don't depend on it.
    overwrite : bool
        Replace an existing `dst`.
    fresh : bool
        Discard unfinished work of an earlier run instead of continuing it.
    client : dask.distributed.Client or concurrent.futures.Executor, optional
        Compress on the workers of a cluster, which need access to `src` and `dst`. The bytes are
        the same. Not with method cdf53.
    task_samples : int, optional
        With `client`: the smallest number of samples of a task, by default 4096 x 4096.
    progress : callable, optional
        Called with a `Progress` at most ten times a second, from one thread at a time.

    Raises
    ------
    InvalidArgumentError
        If an option cannot be used.
    InvalidHeightsError
        If the heights cannot be used, or the bound cannot be kept.
    BoundViolationError
        If the proof fails; `dst` is untouched.
    StorageError
        If something cannot be read or written, `dst` is `src`, or `src` changes while it is read;
        `dst` is untouched.
    ClusterError
        If workers were lost more often than the cluster allows; `dst` is untouched.

    Notes
    -----
    O(n_rows * n_cols) time; memory O(threads * block^2 * levels), whatever the size of the raster.

    A run that fails, is interrupted or killed leaves its finished work in `temp_dir`, or next to
    `dst`. The same call continues it (docs/how-to/resume.md). This needs 2^26 samples or more, and
    no `client`.
    """
    given = locals()
    options, raster = Options(**_own(Options, given)), AskedRaster(**_own(AskedRaster, given))
    check_flags(overwrite=overwrite, fresh=fresh)
    if task_samples is not None:
        task_samples = checked_whole("task_samples", task_samples, least=1)
    if temp_dir is not None:
        temp_dir = checked_path(temp_dir, "temp_dir")
    reporter = Reporter(progress)
    if client is None and task_samples is not None:
        raise InvalidArgumentError(
            f"found `task_samples` {task_samples} without a client, expected both or none of them"
        )
    cluster = None if client is None else _cluster(client, options, raster, temp_dir, task_samples)
    if cluster is not None and cluster.url is not None:
        temp_dir = None
    check_ending(dst, TWZ_ENDINGS, or_url=True)
    refuse_own_source(src, dst)
    refuse_raster(dst)
    name = os.fspath(dst)
    is_url = "://" in name
    if is_url and cluster is not None:
        raise InvalidArgumentError(
            f"found a client and {display_name(name)} as `dst`, expected a path that all workers"
            " can use"
        )
    final = Path(name) if is_url else Path(os.path.realpath(name))
    beside = Path(tempfile.gettempdir()) if is_url else final.parent
    asked = {**_own(AskedRaster, given), "nodata": repr(nodata)}
    del asked["src"]  # by its files or heights
    depends_on = {"command": "compress", **asked, "options": [options.to_metadata(), keep_origin]}
    if is_url:
        from terrainwave.container.targets.upload import uploaded  # files need none of it

        target = uploaded(name, overwrite=overwrite, temp_dir=temp_dir)
    else:
        target = publish(name, overwrite=overwrite)
    with (
        target as part,
        raster.open(warn=True) as source,
        only_writer(final, beside, display_name(name)),
        run_directory(
            temp_dir or beside, final, src, source.info.shape, depends_on,
            fresh=fresh, is_kept=cluster is None, by_heights=True,
        ) as (directory, kept),
        Crew(options.n_threads) as crew,
    ):  # fmt: skip
        bench = Bench(source, directory, crew, reporter, kept)
        # Small ones are read once.
        stamps = stamps_of(src) if source.info.n_bytes > MEMORY_LIMIT else None
        shared = None if cluster is None else cluster.passes(bench, options)
        with closing(shared or LocalPasses(bench, keep_origin)) as passes:
            result, marks = _write(part.file, part.path, name, options, passes)
        if stamps is not None and stamps_of(src) != stamps:
            raise changed(source.name)
    _warn_of(marks)
    return result


def _cluster(
    client: Any, options: Options, raster: AskedRaster, temp_dir: str | None, samples: int | None
) -> "Cluster":
    """Return the cluster of a client; `temp_dir` may be the URL of a store that workers share."""
    # Imported here: a run without a client needs none of it.
    from terrainwave.write.cluster import TASK_SAMPLES, Cluster
    from terrainwave.write.tasks.workers import Workers

    if not options.named_method.is_clusterable:
        raise InvalidArgumentError(
            f"found `method` {options.named_method.name} and a client, expected another method:"
            f" only one machine codes the tiles of {options.named_method.name}"
        )
    url = None if temp_dir is None or "://" not in temp_dir else temp_dir
    return Cluster(Workers(client), raster.shared(), url, samples or TASK_SAMPLES)


def compress_to_bytes(
    src: Any,
    *,
    max_error: float | None = None,
    bound: str = "both",
    method: str | MethodOptions = "auto",
    block: int = 256,
    effort: str = "default",
    nodata: float | str | None = None,
    georeference: bool = True,
    heights_are: str | None = None,
    mesh: str | MeshOptions = "none",
    strict: bool = False,
    stable: bool = False,
    digest: bool = False,
    verify: bool = True,
    threads: int | None = None,
) -> bytes:
    """Compress to bytes, which `Terrain` opens like a file.

    For arrays that fit into memory: chunks of a store, cells of a database. Options, bound and
    errors are those of `compress`, except that `mesh` is ``"none"`` and `digest` False by default.
    """
    given = locals()
    options, raster = Options(**_own(Options, given)), AskedRaster(**_own(AskedRaster, given))
    file = io.BytesIO()
    with (
        raster.open(warn=True) as source,
        system_scratch() as directory,
        Crew(options.n_threads) as crew,
        closing(LocalPasses(Bench(source, directory, crew))) as passes,
    ):
        _, marks = _write(file, None, "", options, passes)
    _warn_of(marks)
    return file.getvalue()


def _own(kind: Any, given: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of a function that are a kind's own, a dataclass or named tuple."""
    return {name: given[name] for name in kind.__annotations__.keys() & given.keys()}


def _warn_of(notes: list[str]) -> None:
    for note in notes:
        warnings.warn(note, TerrainwaveWarning, stacklevel=3)


def _write(
    file: BinaryIO,
    path: Path | None,
    name: str,
    options: Options,
    passes: "LocalPasses | DistributedPasses",
) -> tuple[CompressResult, list[str]]:
    """Write the .twz of a raster to `file`, whose path is `path` (None in memory), and prove it.

    Return the result and what to warn of. The file will be called `name`.
    """
    source = passes.bench.source
    left = for_heights_of(source, options)
    scan = passes.scan(fixed_steps(left, source.info))
    info, marks = source.with_meaning(scan.minimum, scan.maximum)
    marks += note_on_undeclared(source, scan.minimum, scan.maximum)
    marks += note_on_marks(source, scan.minimum, scan.maximum)
    job, notes = settled(left, scan, info, earlier_of(source, options, scan.steps))
    coded, (own, _, reason, other) = passes.encode(job), options.choice
    if other is not None and coded.n_bytes > source.info.n_bytes:
        reason = f"{own.name}, {reason}, takes {coded.n_bytes:,} bytes of {source.info.n_bytes:,}"
        coded = smaller(coded, passes.encode(job.with_method(other)))
    job = coded.job
    _log.info("method %s: %s", job.options.named_method.name, reason)
    if job.options.named_method != options.named_method:
        notes.append("the heights do not compress: stored raw")
    header = job.header(coded.file_tables)
    extents = assemble(file, header, coded.sink.spools)
    measured = None
    if options.verify:
        finished = path or cast(io.BytesIO, file).getvalue()
        measured, tiles = passes.prove(finished, job)
        if options.makes_digests:
            append_digests(file, header, extents, tiles.tree())
    coded.sink.close()
    info = source.info
    scale, n_bytes, n_samples = abs(info.scale), file.tell(), math.prod(info.shape)
    moved = job.moved_error * scale
    kept = passes.bench.kept
    result = CompressResult(
        path=display_name(name) if "://" in name else name,
        n_bytes=n_bytes,
        n_samples=n_samples,
        bits_per_sample=8 * n_bytes / n_samples,
        ratio=info.n_bytes / n_bytes,
        max_error=float(job.bound) + moved,
        effective_error=min(job.effective_error * scale, float(job.bound)) + moved,
        measured_error=None if measured is None else measured * scale,
        units=height_unit(info.units, info.crs).name,
        method=job.options.named_method.name,
        notes=[*options.notes, *source.notes, *marks, *notes, *taken_up(kept)],
    )
    return result, marks
