"""Passes of `patch` over a file, from the new heights to the proof."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from terrainwave.codec.refiner import Heights, Mask
from terrainwave.container.codes import decode_error, encode_error
from terrainwave.container.digests import DigestTree, tile_digests
from terrainwave.container.header import HAS_CORRECTIONS, HAS_VOIDS, Header
from terrainwave.container.metadata import EARLIER, without_origin
from terrainwave.container.spool_sink import SpoolSink
from terrainwave.errors import BoundViolationError, CorruptStreamError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block, Region
from terrainwave.mesh.blocks import measure_meshes, mesh_codes, unmeasured_codes
from terrainwave.mesh.trees import tree_source
from terrainwave.read.decoder import unit_key
from terrainwave.read.tile_decoder import make_decoder
from terrainwave.write.boxes import Box, enclosing_boxes, set_codes
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.found import Found
from terrainwave.write.passes.proof import (
    NOTHING,
    OUR_FAULT,
    Proved,
    allowed_error,
    collected,
    compare_window,
    compared,
    measured_error,
    proof_shares,
    together,
)
from terrainwave.write.passes.resuming import KeptUnits
from terrainwave.write.patching.merged import Merged
from terrainwave.write.patching.patch_encoder import PatchEncoder
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
        count = self._bench.counter("proving")
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

            found = compared(path, proof_shares(self._grid), compare_all, self._bench)
            largest, tiles = collected(found, self._terrain.shape)
        return measured_error(largest, quantizer), self._new_digests(tiles.tree())

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
