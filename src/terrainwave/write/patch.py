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
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from terrainwave.arguments import check_flags, check_local, checked_path, checked_threads
from terrainwave.container.digests import DigestTree, tile_digests
from terrainwave.container.header import HAS_CORRECTIONS, HAS_VOIDS, Header
from terrainwave.container.metadata import EARLIER, without_origin
from terrainwave.container.spool_sink import SpoolSink
from terrainwave.container.targets.publication import publish, refuse_own_source
from terrainwave.container.targets.unfinished import only_writer
from terrainwave.container.writer import append_digests, assemble
from terrainwave.errors import (
    BoundViolationError,
    CorruptStreamError,
    InvalidHeightsError,
    TerrainwaveWarning,
)
from terrainwave.file import TerrainFile
from terrainwave.grid.crew import Crew
from terrainwave.grid.quadtree import Region
from terrainwave.names import METHODS, methods_that
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.raster_io.geotiff.sidecar import forget_measured
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.undeclared_voids import note_on_undeclared
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.proof import (
    NOTHING,
    OUR_FAULT,
    Proof,
    Proved,
    allowed_error,
    compare_window,
    measured_error,
    proof_shares,
    together,
)
from terrainwave.write.passes.resuming import KeptUnits, run_directory, taken_up
from terrainwave.write.patching.index import PatchedIndex
from terrainwave.write.patching.merged import Merged, original_source
from terrainwave.write.patching.patch_encoder import PatchEncoder
from terrainwave.write.pyramid import Pyramid

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
        patcher = _Patcher(terrain, merged, Bench(merged, directory, executor, reporter, kept))
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
    """Raise `InvalidHeightsError` for a file that cannot be patched."""
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


# Metadata on earlier losses, which are known again if a patch covers everything.
_OF_BEFORE = ("moved", EARLIER)


class _Patcher:
    """Passes over a file that is patched."""

    def __init__(self, terrain: TerrainFile, merged: Merged, bench: Bench) -> None:
        self._terrain = terrain
        self._grid = terrain.grid
        self._merged = merged
        self._bench = bench
        quantizer = terrain.quantizer
        self.sink = SpoolSink(self._grid, bench.directory)
        self._pyramid = Pyramid(
            merged,
            quantizer,
            self._grid,
            kind=terrain.pyramid,
            has_voids=merged.has_voids,
            directory=bench.directory,
            executor=bench.executor,
        )
        self._pyramid.kept = bench.kept
        self.header = terrain.header
        self.is_changed = False
        # Largest stated error of finest blocks without originals, in raw units.
        self.stated_error = 0.0

    def code(self) -> tuple[int, int]:
        """Fill the sink; return the numbers of units coded again and copied."""
        self._pyramid.build(lambda *_: None)
        encoder = PatchEncoder(
            self._terrain, self._merged, self._pyramid, self.sink,
            self._bench.counter("patching"),
            kept=KeptUnits(self._bench.kept, self._grid, "patch"),
        )  # fmt: skip
        encoder.run(self._bench.executor)
        found = encoder.found
        self.header = self._bounded_header()
        features = self.header.features & ~HAS_CORRECTIONS
        features |= HAS_VOIDS if self._merged.has_voids else 0
        features |= HAS_CORRECTIONS if found.has_corrections else 0
        self.header = replace(self.header, features=features)
        index = PatchedIndex(
            self._terrain, self.header, self._merged, self._pyramid, self.sink, self._bench
        )
        is_any_new, self.stated_error = index.update(found)
        self.is_changed = bool(found.recoded) or is_any_new
        self.is_changed |= self.header != self._terrain.header
        return len(found.recoded), self._grid.n_units() - len(found.recoded)

    def _bounded_header(self) -> Header:
        """Return the file's header with the bounds that hold after the patch."""
        old = self._terrain.header
        old = replace(old, metadata=without_origin(old.metadata))
        if not old.moved or not self._merged.covers(Region(0, 0, *self._terrain.shape)):
            return old
        # Earlier losses are known again.
        metadata = {key: value for key, value in old.metadata.items() if key not in _OF_BEFORE}
        bound = old.quantizer.effective_error
        return replace(
            old, metadata=metadata, max_error=max(self._asked_bound(), bound), effective_bound=bound
        )

    def _asked_bound(self) -> float:
        """Return the bound that the file was made with, in raw units."""
        header = self._terrain.header
        if not header.moved:
            return header.max_error
        asked = header.max_error - float(header.moved * header.quantum)
        return max(asked, header.quantizer.effective_error)

    def prove(self, path: str | os.PathLike[str]) -> tuple[float, DigestTree | None]:
        """Decode the result.

        Returns
        -------
        error : float
            Largest error where the new raster lies, in raw units.
        digests : DigestTree or None
            The digests of all heights, if the file has digests.

        Raises
        ------
        CorruptStreamError
            If the file's digests did not match its heights before the patch.
        BoundViolationError
            If a sample is further than the bound from the new raster, or one elsewhere has changed.
        """
        quantizer, bound = self._terrain.quantizer, self._asked_bound()
        allowed = allowed_error(quantizer, bound, quantizer.effective_error)
        count, proof = self._bench.counter("proving"), Proof(self._terrain.shape)
        with TerrainFile(path, threads=1, native=False) as result:

            def compare(region: Region) -> Proved:
                part = region.intersect(self._merged.place)
                found = NOTHING
                if part.n_rows and part.n_cols:
                    found = compare_window(result, self._merged, part, allowed, False)
                if part != region:
                    self._compare_rest(result, region)
                if self.header.has_digests:
                    tiles = tile_digests(region, *result.read_with_mask(region))
                    found = found._replace(tiles=tiles)
                count(region.n_rows * region.n_cols)
                return found

            def compare_all(share: Sequence[Region]) -> Proved:
                return together(map(compare, share))

            proof.compare(path, proof_shares(self._grid), compare_all, self._bench)
        error = measured_error(proof.largest, quantizer)
        return error, self._new_digests(proof.tiles.tree())

    def _new_digests(self, found: DigestTree) -> DigestTree | None:
        """Return the new digests, if the file has any: beyond the new raster they stay."""
        before = self._terrain.container.digests()
        if before is None:
            return None
        place = self._merged.place
        for leaf in found.differences(before):
            if not all(leaf.intersect(place).shape):
                raise CorruptStreamError(
                    f"the digest of {leaf.n_rows} x {leaf.n_cols} samples from row {leaf.row},"
                    f" column {leaf.col} is not that of their heights, which the new raster does"
                    " not cover: check the file (terrainwave verify)"
                )
        return found

    def _compare_rest(self, result: TerrainFile, region: Region) -> None:
        """Raise if samples that the new raster does not cover have changed."""
        level = self._grid.k_max
        (before, was_valid), (after, is_valid) = (
            terrain.decoder.window(level, region) for terrain in (self._terrain, result)
        )
        is_good = was_valid & is_valid & (after == before) | ~was_valid & ~is_valid
        if self._terrain.quantizer.remainder_bytes:
            stored, new = (terrain.read_with_mask(region)[0] for terrain in (self._terrain, result))
            is_good &= (stored == new) | ~is_valid
        is_good |= self._merged.known(region, np.ones(region.shape, dtype=np.bool_))
        if not is_good.all():
            row, col = np.argwhere(~is_good)[0] + (region.row, region.col)
            raise BoundViolationError(
                f"the height at row {row}, column {col}, which the new raster does not cover, has"
                f" moved; {OUR_FAULT}"
            )

    def close(self) -> None:
        """Delete temporary data."""
        self._pyramid.close()
        for spool in self.sink.present():
            spool.close()
