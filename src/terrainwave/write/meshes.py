"""Add meshes to a finished file without coding its heights again."""

import logging
import os
import warnings
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from terrainwave.arguments import TWZ_ENDINGS, check_ending, checked_error, checked_threads
from terrainwave.codec.refiner import Heights, Mask
from terrainwave.container.metadata import without_origin
from terrainwave.container.page import page_layout
from terrainwave.container.targets.publication import (
    only_writer,
    publish,
    refuse_own_source,
    scratch_directory,
)
from terrainwave.container.writer import SpoolSink, append_digests, assemble
from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.file import TerrainFile
from terrainwave.grid.crew import Crew
from terrainwave.grid.quadtree import Region
from terrainwave.grid.quantum import as_fraction
from terrainwave.mesh.blocks import Originals, measure_meshes
from terrainwave.mesh.codes import mesh_tolerance
from terrainwave.mesh.sections import make_meshes
from terrainwave.names import METHODS
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.raster_io.dataset import refuse_raster
from terrainwave.tri.mesh_options import MeshOptions, check_mesh, stored_mesh
from terrainwave.write.job import default_mesh_error, scale_of
from terrainwave.write.patching.merged import check_units, original_source

_log = logging.getLogger(__name__)


def store_meshes(
    src: str | os.PathLike[str],
    dst: str | os.PathLike[str],
    *,
    mesh: str | MeshOptions = "auto",
    mesh_error: float | None = None,
    original: Any = None,
    threads: int | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> str:
    """Write a .twz file with meshes of all its blocks; return its path.

    Parameters
    ----------
    src : path or URL
        A .twz file, with or without meshes.
    dst : path
        Output file, whose name ends in ``.twz``. It appears complete or not at all.
    mesh : str, Zerotree or Rqt
        As in `compress`, but not ``"none"``.
    mesh_error : float, optional
        As in `compress`.
    original : path, dataset or array, optional
        The raster that the file was made from. Errors of meshes are then measured against it.
        Without it they are measured against the decoded heights, plus the file's bound, which is a
        little larger and holds as well.
    threads : int, optional
        All processors by default; the bytes don't depend on it.
    overwrite : bool
        Replace an existing `dst`.

    Raises
    ------
    InvalidHeightsError
        If an option cannot be used, or `original` is not the raster that the file was made from.
    CorruptStreamError
        If the file is damaged; `dst` is untouched.
    StorageError
        If something cannot be read or written, `dst` is `src`, or another run is writing it; `dst`
        is untouched.
    """
    check_mesh(mesh, or_none=False)
    error = checked_error("mesh_error", mesh_error)
    n_threads = checked_threads(threads)
    check_ending(dst, TWZ_ENDINGS)
    refuse_own_source(src, dst)
    refuse_raster(dst)
    reporter = Reporter(progress)
    final = Path(os.path.realpath(dst))
    with (
        publish(dst, overwrite=overwrite) as part,
        only_writer(final, final.parent, os.fspath(dst)),
        TerrainFile(src, threads=1) as terrain,
        scratch_directory(Path(dst).absolute().parent, Path(dst).name) as directory,
        Crew(n_threads) as executor,
    ):
        container = terrain.container
        method, is_faithful = METHODS[container.header.method], container.header.is_faithful
        header = replace(
            container.header,
            metadata=without_origin(container.header.metadata),
            mesh=stored_mesh(mesh, method, is_faithful=is_faithful),
            mesh_tolerance=_tolerance(terrain, error),
        )
        grid = header.grid
        size = grid.n_rows * grid.n_cols, terrain.dtype.itemsize
        mesher, sections = make_meshes(
            grid,
            terrain.decoder,
            lambda block: container.codes(block)[2],
            header.mesh_tolerance,
            has_voids=header.has_voids,
            kind=header.mesh,
            executor=executor,
            on_samples=reporter.counter("making meshes", *size),
        )
        originals, lost = _originals(terrain, original)
        count = reporter.counter("measuring meshes", *size)
        errors = measure_meshes(grid, mesher, originals, executor, count, lost)
        codes = mesher.error_codes(errors, lost, by_recursion=header.is_faithful)
        sink = SpoolSink(grid, directory, "; free space there")
        for key in (key for head in grid.segment_heads() for key in page_layout(grid, head).keys):
            sink(key, container.payload(key))
        sink.set_meshes(sections)
        for spool in sink.present():
            for key in spool.payloads:
                blocks = grid.key_blocks(key)
                own = ([*container.codes(one)[:3], codes.get(one, 0)] for one in blocks)
                spool.codes[key] = b"".join(map(bytes, own))
        extents = assemble(part.file, header, sink.spools)
        digests = container.digests()
        if digests is not None:  # digests of heights, which do not change
            append_digests(part.file, header, extents, digests)
        sink.close()
        _log.info("%s: stored meshes of kind %s", dst, header.mesh)
    return os.fspath(dst)


def _tolerance(terrain: TerrainFile, mesh_error: float | None) -> int:
    """Return the tolerance of the finest meshes in 1/16 quanta, rounded down."""
    header, info = terrain.header, terrain.raster_info
    if mesh_error is None:
        error = default_mesh_error(terrain.quantizer, header.effective_bound, info)
    else:
        error = as_fraction(mesh_error) / scale_of(info)
    return mesh_tolerance(error, header.quantum)


def _originals(terrain: TerrainFile, original: Any) -> tuple[Originals, Fraction]:
    """Return the heights to measure meshes against, and the quanta to add to errors."""
    header, level = terrain.header, terrain.n_levels - 1
    rho = Fraction(header.rho) / header.quantum
    if original is None:
        decoder = terrain.decoder
        return lambda region: decoder.window(level, region), header.coded_error + rho
    source, quantizer = original_source(terrain, original), terrain.quantizer
    if (source.info.n_rows, source.info.n_cols) != terrain.shape:
        raise InvalidHeightsError(
            f"found an original of {source.info.n_rows} x {source.info.n_cols} samples, expected"
            f" {terrain.shape[0]} x {terrain.shape[1]}"
        )
    note = check_units(terrain, source)
    if note:
        warnings.warn(note, TerrainwaveWarning, stacklevel=3)

    def read(region: Region) -> tuple[Heights, Mask]:
        raw, valid = source.read(*region)
        heights = quantizer.quantize(raw, valid)
        decoded, mask = terrain.decoder.window(level, region)
        apart = np.abs(heights.astype(np.int64) - decoded)[valid & mask].max(initial=0)
        if not np.array_equal(valid, mask) or apart > header.coded_error:
            raise InvalidHeightsError(
                f"the original does not fit the file in the window {tuple(region)}: expected the"
                " raster that it was made of"
            )
        return heights, valid

    return read, rho
