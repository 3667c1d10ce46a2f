"""Bring a file up to date with a newer raster of all or part of its area. Start at `patch`.

A file does not hold its originals. So a group's source counts as changed if the decoded heights are
not within the bound of the new raster, or voids differ. Such groups, and groups whose parent's
decoded heights have changed, are coded again with the file's own parameters. A sample with an
unchanged prediction gets its old height again, as only one multiple of the step is within the
bound. All other payloads are copied.

Beyond the new raster the target is the original, if given, else the stored height, which must come
back exactly: where predictions have changed, corrections restore it (FORMAT.md §5.4,
docs/decisions/0023).
"""

import logging
import os
import warnings
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrainwave.arguments import check_flags, check_local, checked_path, checked_threads
from terrainwave.container.header import Header
from terrainwave.container.targets.publication import only_writer, publish, refuse_own_source
from terrainwave.container.writer import append_digests, assemble
from terrainwave.errors import (
    InvalidHeightsError,
    TerrainwaveWarning,
)
from terrainwave.file import TerrainFile
from terrainwave.grid.crew import Crew
from terrainwave.names import METHODS, methods_that
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.raster_io.geotiff.sink import forget_measured
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.undeclared_voids import note_on_undeclared
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.resuming import run_directory, taken_up
from terrainwave.write.patching.merged import Merged, original_source
from terrainwave.write.patching.patcher import Patcher

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PatchResult:
    """Result of `patch`; errors in physical units, of the whole file.

    `effective_error` is the bound that the file now states. No height is further than
    `measured_error` from its original. It is measured where originals are known (the new raster,
    and `original`); for other blocks it is the error that the file states. `notes` are remarks for
    the user.
    """

    path: str
    n_bytes: int
    n_recoded: int
    n_copied: int
    effective_error: float
    measured_error: float
    units: str | None
    notes: list[str] = field(default_factory=list)


def patch(
    path: str | os.PathLike[str],
    src: Any,
    *,
    band: int = 1,
    nodata: float | str | None = None,
    heights_are: str | None = None,
    original: Any = None,
    temp_dir: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    fresh: bool = False,
    progress: ProgressCallback | None = None,
) -> PatchResult:
    """Update a .twz file from a newer raster of all or part of its area.

    Groups whose heights differ in `src` are coded again; all others are copied.

    Parameters
    ----------
    path : path
        A file of method rapid or predictive. It is replaced at the end; programs that have it open
        keep the old contents. If nothing differs, it is not touched. Old statistics are removed
        from the .aux.xml next to it, if any.
    src : path, rasterio dataset, ndarray or xarray DataArray
        The new heights: all or part of the file's area, on its grid and in its CRS and type. An
        array without a georeference covers the whole file. Its voids become voids of the file.
    band, nodata, temp_dir, threads, fresh, progress
        As in `compress`.
    heights_are : {"height", "depth", "radius"}, optional
        Meaning of the numbers of `src`; overrides its metadata. A file of depths takes
        only depths, one of radii only radii.
    original : path, rasterio dataset, ndarray or xarray DataArray, optional
        The raster that the file was made from, with all earlier patches (band 1). Heights that
        `src` does not cover then stay within the bound of it. Without it they do not change.

    Returns
    -------
    PatchResult
        Its `n_recoded` and `n_copied` count units: groups and the root block.

    Raises
    ------
    InvalidArgumentError
        If `path` is a URL.
    InvalidHeightsError
        If `src` or `original` does not fit the file: heights in another unit, two of heights,
        depths and radii, heights beyond the file's range, voids in a file that cannot mark them, a
        valid height that equals the file's nodata value, heights between its vertical steps; or if
        `original` is not the raster that the file was made from.
    BoundViolationError
        If the proof fails. The file is untouched.

    Notes
    -----
    The proof decodes the whole result. Where `src` lies, every sample is within the bound of it.
    Elsewhere heights do not change at all, in lossy files and on coarse levels too; with
    `original`, every sample is within the bound of it, after any number of patches. A patch takes
    the time to decode and measure the whole file and to code the changes.
    """
    n_threads = checked_threads(threads)
    check_flags(fresh=fresh)
    check_local(path)
    refuse_own_source(src, path, problem="is the file to be patched; expected the newer raster")
    if original is not None:
        problem = "is the file to be patched; as original expected the raster that it was made of"
        refuse_own_source(original, path, problem=problem)
    if temp_dir is not None:
        temp_dir = checked_path(temp_dir, "temp_dir")
    reporter = Reporter(progress)
    final = Path(os.path.realpath(path))
    read = [path, *(src if isinstance(src, list | tuple) else [src])]
    read += [] if original is None else [original]
    depends_on = {"command": "patch", "band": band, "nodata": repr(nodata)}
    depends_on["has_original"] = original is not None
    with (
        only_writer(final, final.parent, os.fspath(path)),
        TerrainFile(final, threads=1, native=False) as terrain,
        RasterSource(src, band=band, nodata=nodata, heights_are=heights_are) as source,
        nullcontext() if original is None else original_source(terrain, original) as whole,
        run_directory(
            temp_dir or final.parent, final, read, terrain.shape, depends_on, fresh=fresh
        ) as (directory, kept),
        Crew(n_threads) as executor,
    ):
        _refuse_unfit(path, terrain.header)
        notes = note_on_undeclared(source)
        for note in notes:
            warnings.warn(note, TerrainwaveWarning, stacklevel=2)
        merged = Merged(terrain, source, whole)
        for note in merged.notes:
            warnings.warn(note, TerrainwaveWarning, stacklevel=2)
        patcher = Patcher(terrain, merged, Bench(merged, directory, executor, reporter, kept))
        n_recoded, n_copied = patcher.code()
        if patcher.is_changed:
            with publish(final, overwrite=True, is_update=True) as part:
                extents = assemble(part.file, patcher.header, patcher.sink.spools)
                error, digests = patcher.prove(part.path)
                if digests is not None:
                    append_digests(part.file, patcher.header, extents, digests)
            notes += forget_measured(path)
        else:
            error, _ = patcher.prove(final)
        patcher.close()
        _log.info("%s: coded %d units, kept %d", path, n_recoded, n_copied)
        scale = abs(terrain.raster_info.scale)
    return PatchResult(
        path=os.fspath(path),
        n_bytes=os.path.getsize(final),
        n_recoded=n_recoded,
        n_copied=n_copied,
        effective_error=patcher.header.effective_bound * scale,
        measured_error=max(error, patcher.stated_error) * scale,
        units=terrain.units,
        notes=[*merged.notes, *notes, *taken_up(kept)],
    )


def _refuse_unfit(path: str | os.PathLike[str], header: Header) -> None:
    method = METHODS[header.method]
    if not method.is_patchable:
        fit = methods_that(lambda method: method.is_patchable)
        raise InvalidHeightsError(
            f"{path} has method {method.name}; only files of method {fit} can be patched:"
            " compress the whole raster again"
        )
    if header.bound_side != "both":
        raise InvalidHeightsError(
            f"{path} has heights {header.bound_side} the originals only, which a patch would not"
            " keep: compress the whole raster again"
        )
