"""Coding of the units that no longer hold; all others are copied."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from terrainwave.codec.group import HAS_CORRECTIONS
from terrainwave.codec.refiner import FREE, Decoded, GroupSpec, Heights, Mask
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.shared_lines import shared_samples
from terrainwave.codec.unit_specs import block_of_unit
from terrainwave.container.spool_sink import SpoolSink
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block
from terrainwave.grid.remainders import Remainders
from terrainwave.write.encoder import TreeEncoder, distance_of
from terrainwave.write.passes.found import Found, Start
from terrainwave.write.passes.resuming import KeptUnits
from terrainwave.write.patching.merged import Merged
from terrainwave.write.pyramid import Pyramid


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
        found.has_corrections |= bool(payload and payload[0] & HAS_CORRECTIONS)
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
