"""Bring a file up to date with a newer raster of all or part of its area. Start at `patch`.

A file does not hold its originals, so that a group's source counts as changed where the decoded
heights are no longer within the bound of the new raster, or voids differ. Such groups, and those
whose parent's decoded heights have changed, are coded again with the file's own parameters; a
sample whose prediction is as it was gets its old height again, as only one multiple of the step is
within the bound. All other payloads are copied.

Beyond the new raster the target is the original, if it is given, else the stored height, which must
come back as it is: where predictions have changed, corrections put it back (FORMAT.md §5.5,
docs/decisions/0023).
"""

import os
from collections.abc import Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import check_local, checked_path, checked_threads
from terrainwave.codec.group import HAS_CORRECTIONS
from terrainwave.codec.refiner import FREE, Decoded, GroupSpec, Heights, Mask
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.shared_lines import shared_samples
from terrainwave.codec.units import block_of_unit
from terrainwave.container.codes import decode_error, decode_range, encode_error, encode_range
from terrainwave.container.header import HAS_CORRECTIONS as CORRECTIONS_FEATURE
from terrainwave.container.header import Header
from terrainwave.container.metadata import without_origin
from terrainwave.container.publish import publish, refuse_own_source, scratch_directory
from terrainwave.container.sink import SpoolSink
from terrainwave.container.writer import assemble
from terrainwave.errors import BoundViolationError, InvalidHeightsError
from terrainwave.file import TerrainFile, format_of
from terrainwave.grid.affine import places_to_pixels
from terrainwave.grid.quadtree import Block, Region
from terrainwave.grid.remainders import Remainders
from terrainwave.mesh.blocks import measure_meshes, mesh_codes
from terrainwave.mesh.sections import make_meshes
from terrainwave.mesh.trees import tree_source
from terrainwave.names import METHODS, methods_that
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.raster_io.info import RasterInfo
from terrainwave.raster_io.source import RasterSource
from terrainwave.read.decoder import unit_key
from terrainwave.read.tiles import make_decoder
from terrainwave.write.boxes import Box, enclosing_boxes
from terrainwave.write.encoder import Ancestor, Stats, TreeEncoder, distance_of
from terrainwave.write.proof import (
    OUR_FAULT,
    allowed_error,
    compare_window,
    measured_error,
    proof_shares,
)
from terrainwave.write.pyramid import Pyramid

_CACHE_BYTES = 128 << 20
_WINDOW = 512
# Beyond the raster's edge two rows or columns are continued, in both directions: 3 x 3 times what a
# sample changes.
_CONTINUED = 9
# Of a pixel: how far from the file's samples those of a raster may lie.
_MISALIGNED = 1e-3


@dataclass(frozen=True)
class PatchResult:
    """What `patch` did; errors in physical units, of the whole file.

    `effective_error` is the bound that the file now states. No height is further than
    `measured_error` from its original: it is the largest error measured where originals are known
    (the new raster, and `original`), and of what the file states of its other blocks.
    `moved_error`, how far heights that the new raster does not cover have moved, is 0: patches of
    format 1.0 moved them. `format` is the first version of the format whose readers know all that
    the file uses now. `notes` say what a user should know.
    """

    path: str
    n_bytes: int
    n_recoded: int
    n_copied: int
    effective_error: float
    measured_error: float
    moved_error: float
    units: str | None
    format: str
    notes: list[str] = field(default_factory=list)


def patch(
    path: str | os.PathLike[str],
    src: Any,
    *,
    band: int = 1,
    nodata: float | None = None,
    original: Any = None,
    temp_dir: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> PatchResult:
    """Code the groups of a .twz file again whose heights differ in `src`; copy all others.

    Parameters
    ----------
    path : path
        A file of method rapid or predictive. It is replaced at the end; whoever has it open keeps
        the old one. It stays as it is if nothing differs.
    src : path, rasterio dataset, ndarray or xarray DataArray
        The new heights: all or part of the file's area, on its grid and in its CRS and type. An
        array without a place covers all. Its voids become voids of the file.
    band, nodata, temp_dir, threads, progress
        As in `compress`.
    original : path, rasterio dataset, ndarray or xarray DataArray, optional
        The raster that the file was made of, with all earlier patches, band 1: heights that `src`
        does not cover.

    Returns
    -------
    PatchResult
        With the numbers of coded units (groups and the root block) coded again and copied.

    Raises
    ------
    InvalidArgumentError
        If `path` is a URL.
    InvalidHeightsError
        If `src` or `original` does not fit the file: heights beyond the file's range, voids in a
        file that cannot mark them, a valid height that equals the file's nodata value, heights
        between its vertical steps; or if `original` is not what the file was made of.
    BoundViolationError
        If the proof fails. The file is untouched.

    Notes
    -----
    The proof decodes the whole result. Where `src` is, every sample is within the bound of it.
    Elsewhere it has exactly the height it had, in a lossy file too, and on coarse levels as well;
    with `original`, every sample is within the bound, whatever the patches before. Takes about the
    time of decoding and measuring the whole file, and that of coding what differs.
    """
    n_threads = checked_threads(threads)
    check_local(path)
    refuse_own_source(src, path, problem="is the file to be patched; expected the newer raster")
    if original is not None:
        problem = "is the file to be patched; as original expected the raster that it was made of"
        refuse_own_source(original, path, problem=problem)
    if temp_dir is not None:
        temp_dir = checked_path(temp_dir, "temp_dir")
    reporter = Reporter(progress)
    final = Path(os.path.realpath(path))
    with (
        TerrainFile(final, threads=1, native=False) as terrain,
        RasterSource(src, band=band, nodata=nodata) as source,
        nullcontext() if original is None else RasterSource(original) as whole,
        scratch_directory(temp_dir or final.parent, final.name) as directory,
        ThreadPoolExecutor(n_threads, thread_name_prefix="terrainwave") as executor,
    ):
        method = METHODS[terrain.header.method]
        if not method.is_patchable:
            fit = methods_that(lambda method: method.is_patchable)
            raise InvalidHeightsError(
                f"{path} has method {method.name}; only files of method {fit} can be patched:"
                " compress the whole raster again"
            )
        place = _place(terrain.raster_info, source.info)
        merged = _Merged(terrain, source, place, _checked_original(terrain, whole))
        merged.check()
        patcher = _Patcher(terrain, merged, directory, executor, reporter)
        n_recoded, n_copied = patcher.code()
        if patcher.is_changed:
            with publish(final, overwrite=True) as part:
                assemble(part.file, patcher.header, patcher.sink.spools)
                error = patcher.prove(part.path)
        else:
            error = patcher.prove(final)
        patcher.close()
        scale = abs(terrain.raster_info.scale)
        before, after = (format_of(header) for header in (terrain.header, patcher.header))
    return PatchResult(
        path=os.fspath(path),
        n_bytes=os.path.getsize(final),
        n_recoded=n_recoded,
        n_copied=n_copied,
        effective_error=patcher.header.effective_bound * scale,
        measured_error=max(error, patcher.stated_error) * scale,
        moved_error=0.0,
        units=terrain.units,
        format=after,
        notes=[] if after == before else [_note_on_format(before, after)],
    )


def _note_on_format(before: str, after: str) -> str:
    return (
        f"the file is of format {after} now, and was of {before}, whose readers refuse it; patched"
        " with the original it keeps its format (docs/patching.md)"
    )


def _place(info: RasterInfo, new: RasterInfo) -> Region:
    """Return the samples of a file that a raster covers.

    Raises
    ------
    InvalidHeightsError
        If it does not lie on the file's grid, or is of another kind.
    """
    for name in ("dtype", "scale", "offset"):
        expected, found = getattr(info, name), getattr(new, name)
        if found != expected:
            raise InvalidHeightsError(f"the new raster's {name} is {found}, expected {expected}")
    if new.crs != info.crs and new.rasterio_crs() != info.rasterio_crs():
        raise InvalidHeightsError(
            f"the new raster's CRS is {new.crs}, expected that of the file, {info.crs}"
        )
    a, b, _, d, e, _ = info.transform
    pixel = max(abs(a), abs(b), abs(d), abs(e))
    sizes = zip(new.transform, info.transform, strict=True)
    linear = [abs(one - other) for i, (one, other) in enumerate(sizes) if i not in (2, 5)]
    row, col = places_to_pixels(info.transform, new.transform[2], new.transform[5])
    n_longest = max(new.n_rows, new.n_cols)
    is_aligned = max(linear) * n_longest < _MISALIGNED * pixel
    is_aligned &= max(abs(col - round(col)), abs(row - round(row))) < _MISALIGNED
    if not is_aligned:
        raise InvalidHeightsError(
            "the new raster does not lie on the file's grid: found the transform"
            f" {new.transform}, expected {info.transform} moved by whole pixels"
        )
    place = Region(round(row), round(col), new.n_rows, new.n_cols)
    if place.intersect(Region(0, 0, info.n_rows, info.n_cols)) != place:
        raise InvalidHeightsError(
            f"the new raster reaches beyond the file: it begins at row {place.row}, column"
            f" {place.col} and has {new.n_rows} x {new.n_cols} samples of"
            f" {info.n_rows} x {info.n_cols}; cut it"
        )
    return place


def _checked_original(terrain: TerrainFile, original: RasterSource | None) -> RasterSource | None:
    """Return the original, if it covers the file.

    Raises
    ------
    InvalidHeightsError
        If it does not.
    """
    if original is not None:
        place = _place(terrain.raster_info, original.info)
        if place.shape != terrain.shape:
            raise InvalidHeightsError(
                f"the original has {place.n_rows} x {place.n_cols} samples, expected the raster"
                f" that the file was made of, {terrain.shape[0]} x {terrain.shape[1]}"
            )
    return original


class _Merged:
    """The new raster where it is; elsewhere the original, or the file's decoded heights.

    `place` is where heights are known by more than the file: everywhere, with an original.
    """

    def __init__(
        self,
        terrain: TerrainFile,
        source: RasterSource,
        new_place: Region,
        original: RasterSource | None = None,
    ) -> None:
        self._terrain = terrain
        self._source = source
        self._new_place = new_place
        self._original = original
        self.place = new_place if original is None else Region(0, 0, *terrain.shape)

    @property
    def is_open(self) -> bool:
        """Say whether heights beyond the new raster are known by the file alone."""
        return self.place.shape != self._terrain.shape

    def beyond(self, region: Region, stride: int) -> Mask:
        """Return which samples of a region, `stride` apart, are known by the file alone."""
        rows, cols = (
            (stride * np.arange(first, first + n) - start).astype(np.uint64) >= size
            for first, n, start, size in (
                (region.row, region.n_rows, self.place.row, self.place.n_rows),
                (region.col, region.n_cols, self.place.col, self.place.n_cols),
            )
        )
        return rows[:, None] | cols

    def covers(self, region: Region) -> bool:
        """Say whether the new raster covers a region of the full grid."""
        return region.intersect(self.place) == region

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return raw heights and validity of a window."""
        region = Region(row, col, n_rows, n_cols)
        part = region.intersect(self._new_place)
        if part == region:
            return self._new(region)
        if self._original is None:
            heights, valid = self._terrain.read_with_mask(region)
        else:
            heights, valid = self._original.read(*region)
        heights, valid = heights.copy(), valid.copy()
        if part.n_rows and part.n_cols:
            at = part.slices_in(region)
            heights[at], valid[at] = self._new(part)
        return heights, valid

    def _new(self, region: Region) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        row, col = region.row - self._new_place.row, region.col - self._new_place.col
        return self._source.read(row, col, *region.shape)

    def check(self) -> None:
        """Raise `InvalidHeightsError` unless the file can hold all new heights."""
        quantizer, header = self._terrain.quantizer, self._terrain.header
        ranges: dict[str, tuple[float, float]] = {}
        for window in self.place.tiles(_WINDOW, _WINDOW):
            raw, valid = self.read(*window)
            self._check_original(window, raw, valid)
            is_new = np.zeros(window.shape, dtype=np.bool_)
            part = window.intersect(self._new_place)
            if part.n_rows and part.n_cols:
                is_new[part.slices_in(window)] = True
            for name, which in (("the new raster", is_new), ("the original", ~is_new)):
                if not which.any():
                    continue
                heights = self._checked_heights(name, raw, valid, which)
                if heights.size:
                    lowest, highest = ranges.get(name, (np.inf, -np.inf))
                    ends = min(lowest, heights.min()), max(highest, heights.max())
                    ranges[name] = ends
        low, high = (quantizer.height_of(number) for number in (header.z_min, header.z_max))
        slack = quantizer.quantum / 2 if quantizer.rho else 0.0
        for name, (lowest, highest) in ranges.items():
            if lowest < low - slack or highest > high + slack:
                raise InvalidHeightsError(
                    f"{name} has heights from {lowest:.10g} to {highest:.10g}, the file can hold"
                    f" {low:.10g} to {high:.10g} (stored units): compress the whole raster again"
                )

    def _checked_heights(
        self, name: str, raw: NDArray[Any], valid: NDArray[np.bool_], which: Mask
    ) -> NDArray[np.float64]:
        """Return the valid heights of a raster's samples; raise unless the file can tell them."""
        quantizer, info = self._terrain.quantizer, self._terrain.raster_info
        taken = valid & which
        if info.mask_kind == "none" and not valid[which].all():
            raise InvalidHeightsError(
                f"{name} has voids, and the file has no way to mark them: compress the whole raster"
                " again"
            )
        heights = raw[taken].astype(np.float64)
        if heights.size == 0:
            return heights
        if info.nodata is not None and (heights == info.nodata).any():
            raise InvalidHeightsError(
                f"{name} has valid heights of {info.nodata:g}, the file's nodata value: they would"
                " be read as voids. If they are voids, say so with `nodata`; else compress the"
                " whole raster again"
            )
        if self._terrain.header.z_min > self._terrain.header.z_max:
            raise InvalidHeightsError(
                f"{name} has heights, and the file has voids alone, so that it has no range of"
                " heights: compress the whole raster again"
            )
        decoded = quantizer.dequantize(quantizer.quantize(raw, taken))
        if not quantizer.rho and not np.array_equal(decoded[taken], raw[taken]):
            raise InvalidHeightsError(
                f"{name} has heights that are no multiples of the file's vertical step"
                f" {quantizer.quantum:g} (stored units): round them, or compress the whole raster"
                " again"
            )
        return heights

    def _check_original(self, region: Region, raw: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Raise `InvalidHeightsError` if the file was made of another original than is given.

        Most often an earlier patch is missing in it, which would be undone without a word.
        """
        if self._original is None:
            return
        stored, was_valid = self._terrain.read_with_mask(region)
        quantizer, bound = self._terrain.quantizer, self._terrain.header.effective_bound
        allowed = bound + quantizer.float_error + quantizer.quantum / 2
        both = valid & was_valid
        apart = np.zeros(region.shape)
        np.subtract(raw, stored, out=apart, where=both, dtype=np.float64)
        is_other = (valid != was_valid) | (np.abs(apart) > allowed)
        part = region.intersect(self._new_place)
        if part.n_rows and part.n_cols:
            is_other[part.slices_in(region)] = False
        if is_other.any():
            row, col = np.argwhere(is_other)[0]
            found = raw[row, col] if valid[row, col] else "void"
            held = stored[row, col] if was_valid[row, col] else "void"
            raise InvalidHeightsError(
                f"the original is {found} at row {row + region.row}, column {col + region.col},"
                f" where the file has {held} (stored units): expected the raster that the file was"
                f" made of, within {bound:g} of it; bring it up to date with all earlier patches"
            )


class _PatchEncoder(TreeEncoder):
    """Walks a file's units, and codes those again that no longer hold."""

    def __init__(self, terrain: TerrainFile, merged: _Merged, *rest: Any) -> None:
        self._terrain = terrain
        self._merged = merged
        # Largest change of each block's decoded heights, in quanta, where anything changed.
        self.changes: dict[Block, int] = {}
        self.recoded: set[Block] = set()
        # Of changed coarse blocks, how far finest heights, decoded where nothing else is known, are
        # from their surfaces, in quanta.
        self.apart: dict[Block, int] = {}
        header = terrain.header
        refiner = refiner_by_name(header.method, header.file_tables)
        # With the original all heights are known, and none needs to be put back; but corrections of
        # earlier patches are heights that neighbours have as well.
        self._corrects = header.step > 1 and (header.has_corrections or merged.is_open)
        # Whether any unit has corrections.
        self.has_corrections = False
        parameters = replace(header.codec_parameters, has_corrections=self._corrects)
        super().__init__(terrain.grid, refiner, parameters, *rest)

    def code_unit(
        self, key: Block, spec: GroupSpec, parent: Decoded | None, target: Heights, mask: Mask
    ) -> tuple[bytes, Decoded]:
        """Return the unit's old payload, or a new one where that no longer holds."""
        old = self._terrain.decoder.unit(key)
        stored = self._terrain.container.payload(key)
        payload, decoded = stored, old
        if key in self.changes or not self._holds(spec, old, target, mask):
            payload, decoded = super().code_unit(key, spec, parent, target, mask)
        self.has_corrections |= bool(payload and payload[0] & HAS_CORRECTIONS)
        if payload == stored and key not in self.changes:
            return stored, old
        self.recoded.add(key)
        for block in self._grid.key_blocks(key):
            before, after = (
                block_of_unit(self._grid, spec, unit, block) for unit in (old, decoded)
            )
            changes = np.abs(after.heights.astype(np.int64) - before.heights)
            change = int(changes.max())
            if change or not _are_alike(before, after):
                self.changes[block] = change
        return payload, decoded

    def kept(self, key: Block, spec: GroupSpec, target: Heights, mask: Mask) -> Heights | None:
        """Return the heights of a unit that must come back, `FREE` elsewhere.

        Those that the new raster does not cover, void or not as before. Of samples that neighbours
        share, which may be copied, all that hold: each of them must find the same heights. There
        voids have what is predicted, as a neighbour without a valid sample knows no other.
        """
        if not self._corrects:
            return None
        old = self._terrain.decoder.unit(key)
        stays = self._merged.beyond(spec.region, self._grid.stride(spec.level))
        shared = shared_samples(spec)
        holds = np.abs(target.astype(np.int64) - old.heights) <= spec.half
        stays |= shared & (holds | ~self._pyramid.own(spec.level, spec.region))
        stays &= old.mask == mask
        stays &= mask | ~shared
        if not old.mask.any():
            stays &= mask
        return np.where(stays, old.heights, FREE)

    def _holds(self, spec: GroupSpec, old: Decoded, target: Heights, mask: Mask) -> bool:
        """Say whether a unit decodes to within the bound of the targets."""
        if not np.array_equal(old.mask, mask):
            return False
        own = self._pyramid.own(spec.level, spec.region)
        if spec.has_fills and not np.array_equal(old.own_mask, own):
            return False
        if spec.remainder_bytes:
            rest = self._pyramid.remainders(spec.region, old.heights)
            if not _are_same(rest, old.remainders):
                return False
        own = own & mask
        if (np.abs(target.astype(np.int64) - old.heights) > spec.half)[own].any():
            return False
        # Of a height that was clipped the old multiple of the step is not known.
        clipped = (old.heights == spec.z_min) | (old.heights == spec.z_max)
        return spec.step == 1 or not (clipped & own & (target != old.heights)).any()

    def _measure(
        self,
        spec: GroupSpec,
        blocks: list[Block],
        chain: list[Ancestor],
        originals: Heights,
        mask: Mask,
        decoded: Decoded,
    ) -> None:
        super()._measure(spec, blocks, chain, originals, mask, decoded)
        valid = decoded.mask[spec.core.slices_in(spec.region)]
        if np.array_equal(mask, valid):
            return
        for ancestor in chain:
            if ancestor.block in self.changes:
                apart = distance_of(ancestor, spec.core, originals, valid, self._grid)
                with self._lock:
                    self.apart[ancestor.block] = max(apart, self.apart.get(ancestor.block, 0))

    def measured(self, region: Region, mask: Mask) -> Mask:
        """Return which samples of a region are known originals."""
        return _inside(self._merged, region, mask)


def _are_alike(before: Decoded, after: Decoded) -> bool:
    """Say whether two units have the same valid samples, by themselves too."""
    return np.array_equal(before.mask, after.mask) and np.array_equal(
        before.own_mask, after.own_mask
    )


def _are_same(rest: Remainders, stored: Remainders | None) -> bool:
    return bool((rest == (0 if stored is None else stored)).all())


def _inside(merged: _Merged, region: Region, mask: Mask) -> Mask:
    if merged.covers(region):
        return mask
    known = np.zeros_like(mask)
    part = region.intersect(merged.place)
    if part.n_rows and part.n_cols:
        at = part.slices_in(region)
        known[at] = mask[at]
    return known


class _Patcher:
    """The passes over a file that is patched."""

    def __init__(
        self,
        terrain: TerrainFile,
        merged: _Merged,
        directory: Path,
        executor: Executor,
        reporter: Reporter,
    ) -> None:
        self._terrain = terrain
        self._container = terrain.container
        self._grid = terrain.grid
        self._merged = merged
        self._executor = executor
        self._reporter = reporter
        self._has_voids = terrain.raster_info.mask_kind != "none"
        quantizer = terrain.quantizer
        self._whole = quantizer.z_min, quantizer.z_max
        self._lost = quantizer.lost
        self.sink = SpoolSink(self._grid, self._grid.segment_heads(), directory)
        self._pyramid = Pyramid(
            merged,
            quantizer,
            self._grid,
            kind=terrain.pyramid,
            has_voids=self._has_voids,
            directory=directory,
            executor=executor,
        )
        self.header = terrain.header
        self.is_changed = False
        # What blocks of the full grid state that is not known by originals, in raw units.
        self.stated_error = 0.0

    def code(self) -> tuple[int, int]:
        """Fill the sink; return how many units were coded again, and how many copied."""
        self._pyramid.build(lambda *_: None)
        encoder = _PatchEncoder(
            self._terrain, self._merged, self._pyramid, self.sink, self._count("patching")
        )
        stats = encoder.run(self._executor)
        self.header = self._bounded_header()
        features = self.header.features & ~CORRECTIONS_FEATURE
        if encoder.has_corrections:
            features |= CORRECTIONS_FEATURE
        self.header = replace(self.header, features=features)
        errors, boxes = self._codes(stats, encoder)
        self.stated_error = self._stated_error(errors)
        mesh_errors = self._mesh(encoder.changes, errors)
        is_any_new = self._set_codes(errors, boxes, mesh_errors)
        self.is_changed = bool(encoder.recoded) or is_any_new
        self.is_changed |= self.header != self._terrain.header
        return len(encoder.recoded), self._grid.n_units() - len(encoder.recoded)

    def _bounded_header(self) -> Header:
        """Return the file's header with the bounds that hold after the patch."""
        old = self._terrain.header
        old = replace(old, metadata=without_origin(old.metadata))
        if not old.moved or not self._merged.covers(Region(0, 0, *self._terrain.shape)):
            return old
        # What earlier patches have moved is known again.
        metadata = {key: value for key, value in old.metadata.items() if key != "moved"}
        bound = old.quantizer.effective_error
        return replace(
            old,
            metadata=metadata,
            max_error=max(self._asked_bound(), bound),
            effective_bound=bound,
        )

    def _asked_bound(self) -> float:
        """Return the bound that was asked for when the file was made, in raw units."""
        header = self._terrain.header
        if not header.moved:
            return header.max_error
        asked = header.max_error - float(header.moved * header.quantum)
        return max(asked, header.quantizer.effective_error)

    def _count(self, stage: str) -> Any:
        shape = self._grid.n_rows * self._grid.n_cols
        return self._reporter.counter(stage, shape, self._terrain.dtype.itemsize)

    def _codes(
        self, stats: Stats, encoder: _PatchEncoder
    ) -> tuple[dict[Block, int], dict[Block, Box]]:
        """Return error codes and boxes; where originals are not known, the old ones hold as well.

        A surface is nowhere further from originals than it was, and by how much it has moved; nor
        than it is from the stored heights, and these are from originals.
        """
        between = self._terrain.header.coded_error + self._lost
        errors: dict[Block, int] = {}
        below: dict[Block, Box] = {}
        for block, own in stats.items():
            old = self._container.codes(block)
            errors[block] = 0 if own.is_empty else encode_error(own.error + self._lost)
            if self._merged.covers(self._grid.full_region(block)):
                continue
            moved = self._moved_surface(block, encoder.changes)
            stated = decode_error(old[2]) + moved
            if moved and block in encoder.apart:
                stated = min(stated, encoder.apart[block] + between)
            errors[block] = max(errors[block], encode_error(stated))
            if any(old[:3]) or moved or not own.is_empty:
                # Every original and its error lie in the box: it grows as the error does.
                low, high = self._terrain.box_quanta(block)
                grown = max(decode_error(errors[block]) - decode_error(old[2]), 0)
                low, high = max(low - grown, self._whole[0]), min(high + grown, self._whole[1])
                below[block] = low, high
        return errors, enclosing_boxes(stats, errors, self._whole, below)

    def _stated_error(self, errors: Mapping[Block, int]) -> float:
        """Return the largest error stated of a block that holds an unknown original, raw units."""
        grid = self._grid
        codes = (
            code
            for block, code in errors.items()
            if block.level == grid.k_max and not self._merged.covers(grid.full_region(block))
        )
        stated = decode_error(max(codes, default=0)) * self._terrain.quantizer.quantum
        return min(float(stated), self.header.effective_bound)

    def _moved_surface(self, block: Block, changes: Mapping[Block, int]) -> int:
        """Return how far a block's surface has moved at unknown originals, in quanta."""
        grid = self._grid
        if block.level == grid.k_max:
            return 0
        reach = grid.stride(block.level) * grid.block
        ends = (block.row + 1) * reach < grid.n_rows and (block.col + 1) * reach < grid.n_cols
        return changes.get(block, 0) * (1 if ends else _CONTINUED)

    def _mesh(self, changes: Mapping[Block, int], errors: Mapping[Block, int]) -> dict[Block, int]:
        """Make all meshes again and measure them; return the codes of their errors."""
        header, grid = self.header, self._grid
        if header.mesh == "none":
            return {}
        decoder = make_decoder(header, self.sink.payloads, _CACHE_BYTES)
        mesher, sections = make_meshes(
            grid,
            decoder,
            lambda block: errors.get(block, 0),
            header.mesh_tolerance,
            has_voids=self._has_voids,
            kind=header.mesh,
            executor=self._executor,
            on_samples=self._count("making meshes"),
        )
        self.sink.set_meshes(sections)

        def known(region: Region) -> tuple[Heights, Mask]:
            heights, mask = self._pyramid.originals(region)
            return heights, _inside(self._merged, region, mask)

        count = self._count("measuring meshes")
        lost = Fraction(self._lost)
        codes = mesh_codes(measure_meshes(grid, mesher, known, self._executor, count, lost), lost)
        moved = self._moved_meshes(changes, errors, sections)
        open_blocks = {
            block for block in errors if not self._merged.covers(grid.full_region(block))
        }
        for block in open_blocks - moved:
            codes[block] = max(codes.get(block, 0), self._container.codes(block)[3])
        if moved & open_blocks:
            # Decoded heights stand in for originals that are not known.
            lost += header.coded_error
            measured = measure_meshes(
                grid, mesher, self._pyramid.originals, self._executor, lambda _: None, lost
            )
            away = mesh_codes(measured, lost)
            for block in moved & open_blocks & set(away):
                codes[block] = max(codes.get(block, 0), away[block])
        return codes

    def _moved_meshes(
        self,
        changes: Mapping[Block, int],
        errors: Mapping[Block, int],
        sections: Mapping[Block, bytes],
    ) -> set[Block]:
        """Return the blocks whose mesh may be another one than it was."""
        grid = self._grid
        causes = set(changes)
        causes |= {block for block in errors if errors[block] != self._container.codes(block)[2]}
        if tree_source(self._container.header.mesh, self._terrain.decoder) is not None:
            # The group below a block changes its zero trees.
            causes |= {block.parent for block in changes if block.level > 0}
        moved = {
            Block(level, row + down, col + right)
            for level, row, col in causes
            for down in (-1, 0, 1)
            for right in (-1, 0, 1)
        }
        for block in errors:
            key = unit_key(block)
            if sections.get(key, b"") != self._container.mesh(key):
                moved.add(block)
        return {block for block in moved if grid.contains(block)}

    def _set_codes(
        self,
        errors: Mapping[Block, int],
        boxes: Mapping[Block, Box],
        mesh_errors: Mapping[Block, int],
    ) -> bool:
        """Give every block its codes, the old ones where they say the same; tell of any new one."""
        is_any_new = False
        for spool in self.sink.spools.values():
            before: dict[Block, Box] = {}
            after: dict[Block, Box] = {}
            for key in sorted(spool.keys()):
                was_outer, outer = before.get(key, self._whole), after.get(key, self._whole)
                codes = bytearray()
                for block in self._grid.key_blocks(key):
                    old = self._container.codes(block)
                    before[block] = decode_range(old[0], old[1], *was_outer)
                    box = boxes.get(block)
                    # Coding a box that has been coded may widen it.
                    is_same = outer == was_outer and box == before[block]
                    ends = old[:2] if is_same else encode_range(*(box or outer), *outer)
                    after[block] = decode_range(*ends, *outer)
                    new = (*ends, errors.get(block, 0), mesh_errors.get(block, 0))
                    is_any_new |= new != old
                    codes += bytes(new)
                spool.set_codes(key, bytes(codes))
        return is_any_new

    def prove(self, path: str | os.PathLike[str]) -> float:
        """Decode the result; return the largest error where the new raster is, in raw units.

        Raises
        ------
        BoundViolationError
            If a sample is further than the bound from the new raster, or one elsewhere is not what
            it was.
        """
        quantizer, bound = self._terrain.quantizer, self._asked_bound()
        allowed = allowed_error(quantizer, bound, quantizer.effective_error)
        count = self._count("proving")
        with TerrainFile(path, threads=1, native=False) as result:

            def compare(region: Region) -> float:
                part = region.intersect(self._merged.place)
                largest = 0.0
                if part.n_rows and part.n_cols:
                    largest = compare_window(result, self._merged, part, allowed)
                if part != region:
                    self._compare_rest(result, region)
                count(region.n_rows * region.n_cols)
                return largest

            def compare_all(share: list[Region]) -> float:
                return max(map(compare, share))

            largest = max(self._executor.map(compare_all, proof_shares(self._grid)))
        return measured_error(largest, quantizer)

    def _compare_rest(self, result: TerrainFile, region: Region) -> None:
        """Raise unless samples that the new raster does not cover are what they were."""
        level = self._grid.k_max
        (before, was_valid), (after, is_valid) = (
            terrain.decoder.window(level, region) for terrain in (self._terrain, result)
        )
        is_good = was_valid & is_valid & (after == before) | ~was_valid & ~is_valid
        if self._terrain.quantizer.remainder_bytes:
            stored, new = (terrain.read_with_mask(region)[0] for terrain in (self._terrain, result))
            is_good &= (stored == new) | ~is_valid
        is_good |= _inside(self._merged, region, np.ones(region.shape, dtype=np.bool_))
        if not is_good.all():
            row, col = np.argwhere(~is_good)[0] + (region.row, region.col)
            raise BoundViolationError(
                f"the height at row {row}, column {col}, which the new raster does not cover, has"
                f" moved; {OUR_FAULT}"
            )

    def close(self) -> None:
        """Delete temporary data."""
        self._pyramid.close()
        for spool in self.sink.spools.values():
            spool.close()
