"""Passes of `patch` over a file, from the new heights to the proof."""

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from fractions import Fraction

import numpy as np

from terrainwave.codec.group import HAS_CORRECTIONS as UNIT_HAS_CORRECTIONS
from terrainwave.codec.refiner import FREE, Decoded, GroupSpec, Heights, Mask
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.shared_lines import shared_samples
from terrainwave.codec.unit_specs import block_of_unit
from terrainwave.container.digests import DigestTree, tile_digests
from terrainwave.container.header import HAS_CORRECTIONS, HAS_VOIDS, Header
from terrainwave.container.metadata import EARLIER, without_origin
from terrainwave.container.page import decode_error, encode_error
from terrainwave.container.writer import SpoolSink
from terrainwave.errors import BoundViolationError, CorruptStreamError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block, Region
from terrainwave.grid.remainders import Remainders
from terrainwave.mesh.blocks import measure_meshes
from terrainwave.mesh.codes import mesh_codes, unmeasured_codes
from terrainwave.mesh.trees import tree_source
from terrainwave.read.decoder import unit_key
from terrainwave.read.window_reader import make_decoder
from terrainwave.write.boxes import Box, enclosing_boxes, set_codes
from terrainwave.write.encoder import TreeEncoder, distance_of
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.found import Found, Start
from terrainwave.write.passes.proof import (
    NOTHING,
    OUR_FAULT,
    Comparison,
    Proved,
    allowed_error,
    collected,
    compared,
    proof_shares,
)
from terrainwave.write.passes.resuming import KeptUnits
from terrainwave.write.patching.merged import Merged
from terrainwave.write.pyramid import Pyramid

_CACHE_BYTES = 128 << 20
# Beyond the raster's edge two rows or columns are continued, in both directions: 3 x 3 times the
# reach of a sample.
_CONTINUED = 9
# Metadata on earlier losses, which are known again if a patch covers everything.
_OF_BEFORE = ("moved", EARLIER)


class Patcher:
    """Passes over a file that is patched.

    Errors, boxes, meshes and their errors are measured where originals are known; elsewhere the old
    values hold as well.

    Attributes
    ----------
    sink : SpoolSink
        The payloads and codes of the patched file.
    header : Header
        Its header.
    stated_error : float
        Largest stated error of finest blocks without originals, in raw units.
    """

    def __init__(self, terrain: TerrainFile, merged: Merged, bench: Bench) -> None:
        self._terrain, self._container, self._grid = terrain, terrain.container, terrain.grid
        self._merged, self._bench = merged, bench
        self._whole = terrain.quantizer.z_min, terrain.quantizer.z_max
        self._lost = terrain.quantizer.lost
        self.sink = SpoolSink(self._grid, bench.directory)
        self._pyramid = Pyramid(
            merged,
            terrain.quantizer,
            self._grid,
            kind=terrain.pyramid,
            has_voids=merged.has_voids,
            directory=bench.directory,
            executor=bench.executor,
        )
        self._pyramid.kept = bench.kept
        self.header = terrain.header
        self.is_changed = False
        self.stated_error = 0.0

    def code(self) -> tuple[int, int]:
        """Fill the sink; return the numbers of units coded again and copied."""
        grid, header = self._grid, self._bounded_header()
        self._pyramid.build(lambda *_: None)
        encoder = PatchEncoder(
            self._terrain, self._merged, self._pyramid, self.sink, self._bench.counter("patching"),
            kept=KeptUnits(self._bench.kept, grid, "patch"),
        )  # fmt: skip
        encoder.run(self._bench.executor)
        found = encoder.found
        features = header.features & ~HAS_CORRECTIONS
        features |= HAS_VOIDS if self._merged.has_voids else 0
        features |= HAS_CORRECTIONS if found.has_corrections else 0
        self.header = replace(header, features=features)
        errors, boxes = self._codes(found)
        mesh_errors = self._mesh(found, errors)
        spools, old = self.sink.present(), self._container.codes
        is_any_new = set_codes(grid, spools, self._whole, boxes, errors, mesh_errors, old)
        known_from_file = (
            code
            for block, code in errors.items()
            if block.level == grid.k_max and not self._merged.covers(grid.full_region(block))
        )
        stated = decode_error(max(known_from_file, default=0)) * self._terrain.quantizer.quantum
        self.stated_error = min(float(stated), self.header.effective_bound)
        self.is_changed = bool(found.recoded) or is_any_new
        self.is_changed |= self.header != self._terrain.header
        return len(found.recoded), grid.n_units() - len(found.recoded)

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

    def _codes(self, found: Found) -> tuple[dict[Block, int], dict[Block, Box]]:
        """Return error codes and boxes; where originals are unknown, the old ones hold as well.

        A surface is no further from originals than before plus the distance that it moved, and no
        further than its distance from the stored heights plus theirs from the originals.
        """
        between = self._terrain.header.coded_error + self._lost
        errors: dict[Block, int] = {}
        below: dict[Block, Box] = {}
        for block, own in found.stats.items():
            old = self._container.codes(block)
            errors[block] = 0 if own.is_empty else encode_error(own.error + self._lost)
            if self._merged.covers(self._grid.full_region(block)):
                continue
            moved = self._moved_surface(block, found.changes)
            stated = decode_error(old[2]) + moved
            if moved and block in found.apart_from:
                stated = min(stated, found.apart_from[block] + between)
            errors[block] = max(errors[block], encode_error(stated))
            if any(old[:3]) or moved or not own.is_empty:
                # The box holds every original plus its error, so it grows with the error.
                low, high = self._terrain.box_quanta(block)
                grown = max(decode_error(errors[block]) - decode_error(old[2]), 0)
                low, high = max(low - grown, self._whole[0]), min(high + grown, self._whole[1])
                below[block] = low, high
        return errors, enclosing_boxes(found.stats, errors, self._whole, below)

    def _moved_surface(self, block: Block, changes: Mapping[Block, int]) -> int:
        """Return how far a block's surface has moved at unknown originals, in quanta."""
        grid = self._grid
        if block.level == grid.k_max:
            return 0
        reach = grid.stride(block.level) * grid.block
        ends = (block.row + 1) * reach < grid.n_rows and (block.col + 1) * reach < grid.n_cols
        return changes.get(block, 0) * (1 if ends else _CONTINUED)

    def _mesh(self, found: Found, errors: Mapping[Block, int]) -> dict[Block, int]:
        """Make and measure all meshes again; return the codes of their errors.

        If the file had no measured errors, it gets none.
        """
        header, grid = self.header, self._grid
        if header.mesh == "none":
            return {}
        if not self._terrain.has_measured_meshes:
            meshed = [block for block, own in found.stats.items() if own.has_mesh]
            return unmeasured_codes(grid, meshed, errors, header.mesh_tolerance)
        decoder = make_decoder(header, self.sink.payloads, _CACHE_BYTES)
        mesher, sections = self._bench.meshes(header, decoder, errors)
        self.sink.set_meshes(sections)

        def known(region: Region) -> tuple[Heights, Mask]:
            heights, mask = self._pyramid.originals(region)
            return heights, self._merged.known(region, mask)

        count = self._bench.counter("measuring meshes")
        lost = Fraction(self._lost)
        executor = self._bench.executor
        codes = mesh_codes(measure_meshes(grid, mesher, known, executor, count, lost), lost)
        moved = self._moved_meshes(found.changes, errors, sections)
        open_blocks = {
            block for block in errors if not self._merged.covers(grid.full_region(block))
        }
        for block in open_blocks - moved:
            codes[block] = max(codes.get(block, 0), self._container.codes(block)[3])
        if moved & open_blocks:
            # Decoded heights stand in for unknown originals.
            lost += header.coded_error
            measured = measure_meshes(
                grid, mesher, self._pyramid.originals, self._bench.executor, lambda _: None, lost
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
        """Return the blocks whose mesh may have changed."""
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

    def prove(self, path: str | os.PathLike[str]) -> tuple[float, DigestTree | None]:
        """Decode the result.

        Return the largest error where the new raster lies, in raw units, and the digests of all
        heights, if the file has digests.
        """
        quantizer, bound = self._terrain.quantizer, self._asked_bound()
        allowed = allowed_error(quantizer, bound, quantizer.effective_error)
        count = self._bench.counter("proving")
        with TerrainFile(path, threads=1, native=False) as result:
            comparison = _PatchComparison(result, self._merged, allowed, False, count)
            comparison.before, comparison.is_digested = self._terrain, self.header.has_digests
            found = compared(path, proof_shares(self._grid), comparison.all, self._bench)
            largest, tiles = collected(found, self._terrain.shape, quantizer)
        return largest, self._new_digests(tiles.tree())

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

    def close(self) -> None:
        """Delete temporary data."""
        self._pyramid.close()
        self.sink.close()


class _PatchComparison(Comparison):
    """Compares a patched file with the new raster where that lies, elsewhere with `before`."""

    source: Merged
    before: TerrainFile
    is_digested: bool

    def window(self, region: Region) -> Proved:
        """Return the largest error where the new raster lies; digests of all decoded heights."""
        part, found = region.intersect(self.source.place), NOTHING
        if part.n_rows and part.n_cols:
            found = super().window(part)
        if part != region:
            self._compare_rest(region)
        if self.is_digested:
            tiles = tile_digests(region, *self.terrain.read_with_mask(region))
            found = found._replace(tiles=tiles)
        return found

    def _compare_rest(self, region: Region) -> None:
        """Raise if samples that the new raster does not cover have changed."""
        result = self.terrain
        level = result.grid.k_max
        (before, was_valid), (after, is_valid) = (
            terrain.decoder.window(level, region) for terrain in (self.before, result)
        )
        is_good = was_valid & is_valid & (after == before) | ~was_valid & ~is_valid
        if self.before.quantizer.remainder_bytes:
            stored, new = (terrain.read_with_mask(region)[0] for terrain in (self.before, result))
            is_good &= (stored == new) | ~is_valid
        is_good |= self.source.known(region, np.ones(region.shape, dtype=np.bool_))
        if not is_good.all():
            row, col = np.argwhere(~is_good)[0] + (region.row, region.col)
            raise BoundViolationError(
                f"the height at row {row}, column {col}, which the new raster does not cover, has"
                f" moved; {OUR_FAULT}"
            )


class PatchEncoder(TreeEncoder):
    """Walks a file's units and codes those again that no longer hold."""

    def __init__(
        self,
        terrain: TerrainFile,
        merged: Merged,
        pyramid: Pyramid,
        sink: SpoolSink,
        on_samples: Callable[[int], None],
        kept: KeptUnits,
    ) -> None:
        self._terrain, self._merged = terrain, merged
        header = terrain.header
        refiner = refiner_by_name(header.method, header.file_tables)
        # With the original all heights are known, and none needs restoring. Corrections of
        # earlier patches remain: neighbours have the same heights.
        self._corrects = header.step > 1 and (header.has_corrections or merged.is_open)
        parameters = replace(
            header.codec_parameters, has_voids=merged.has_voids, has_corrections=self._corrects
        )
        super().__init__(terrain.grid, parameters, pyramid, sink, on_samples, refiner, kept=kept)

    def code_unit(
        self, start: Start, spec: GroupSpec, target: Heights, mask: Mask
    ) -> tuple[bytes, Decoded]:
        """Return the unit's old payload, or a new one if that no longer holds."""
        key, found = start.key, start.found
        old = self._terrain.decoder.unit(key)
        stored = self._terrain.container.payload(key)
        payload, decoded = stored, old
        is_moved = self._has_changed(key, found)
        if is_moved or not self._holds(spec, old, target, mask):
            payload, decoded = super().code_unit(start, spec, target, mask)
        found.has_corrections |= bool(payload and payload[0] & UNIT_HAS_CORRECTIONS)
        if payload == stored and not is_moved:
            return stored, old
        found.recoded.add(key)
        for block in self.grid.key_blocks(key):
            before, after = (block_of_unit(self.grid, spec, unit, block) for unit in (old, decoded))
            changes = np.abs(after.heights.astype(np.int64) - before.heights)
            change = int(changes.max())
            if change or not _are_alike(before, after):
                found.changes[block] = change
        return payload, decoded

    def _has_changed(self, block: Block, found: Found) -> bool:
        """Return whether a decoded block has changed; `found` may begin below it."""
        return block in found.changes or block in self.found.changes

    def restored(self, key: Block, spec: GroupSpec, target: Heights, mask: Mask) -> Heights | None:
        """Return the heights of a unit that must come back exactly, `FREE` elsewhere.

        These are heights that the new raster does not cover, and void ones that changed. Of samples
        shared with neighbours, which may be copied, all that hold are included: every unit must
        find the same heights. Shared voids get the prediction, as a neighbour without a valid
        sample knows nothing else.
        """
        if not self._corrects:
            return None
        old = self._terrain.decoder.unit(key)
        stays = self._merged.beyond(spec.region, self.grid.stride(spec.level))
        shared = shared_samples(spec)
        holds = np.abs(target.astype(np.int64) - old.heights) <= spec.half
        stays |= shared & (holds | ~self.pyramid.own(spec.level, spec.region))
        stays &= old.mask == mask
        stays &= mask | ~shared
        if not old.mask.any():
            stays &= mask
        return np.where(stays, old.heights, FREE)

    def _holds(self, spec: GroupSpec, old: Decoded, target: Heights, mask: Mask) -> bool:
        """Return whether a unit decodes to within the bound of the targets."""
        if not np.array_equal(old.mask, mask):
            return False
        own = self.pyramid.own(spec.level, spec.region)
        if spec.has_voids and not np.array_equal(old.own_mask, own):
            return False
        if spec.remainder_bytes:
            rest = self.pyramid.remainders(spec.region, old.heights)
            if not _are_same(rest, old.remainders):
                return False
        own = own & mask
        if (np.abs(target.astype(np.int64) - old.heights) > spec.half)[own].any():
            return False
        # The old multiple of the step is unknown if the height was clipped.
        clipped = (old.heights == spec.z_min) | (old.heights == spec.z_max)
        return spec.step == 1 or not (clipped & own & (target != old.heights)).any()

    def _measure(
        self, start: Start, spec: GroupSpec, originals: Heights, mask: Mask, decoded: Decoded
    ) -> None:
        known = self._merged.known(spec.core, mask)
        super()._measure(start, spec, originals, known, decoded)
        valid = decoded.mask[spec.core.slices_in(spec.region)]
        if np.array_equal(known, valid):
            return
        for ancestor in start.chain:
            if self._has_changed(ancestor.block, start.found):
                stride = self.grid.stride(ancestor.block.level)
                apart = distance_of(ancestor, spec.core, originals, valid, stride)
                start.found.note_apart(ancestor.block, apart)


def _are_alike(before: Decoded, after: Decoded) -> bool:
    """Return whether two units have the same valid and own samples."""
    return np.array_equal(before.mask, after.mask) and np.array_equal(
        before.own_mask, after.own_mask
    )


def _are_same(rest: Remainders, stored: Remainders | None) -> bool:
    return bool((rest == (0 if stored is None else stored)).all())
