"""Index of a patched file: errors, boxes, meshes and their errors.

Where originals are known these are measured; elsewhere the old values hold as well.
"""

from collections.abc import Mapping
from fractions import Fraction

from terrainwave.codec.refiner import Heights, Mask
from terrainwave.container.codes import decode_error, decode_range, encode_error, encode_range
from terrainwave.container.header import Header
from terrainwave.container.spool_sink import SpoolSink
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block, Region
from terrainwave.mesh.blocks import measure_meshes, mesh_codes, unmeasured_codes
from terrainwave.mesh.sections import make_meshes
from terrainwave.mesh.trees import tree_source
from terrainwave.read.decoder import unit_key
from terrainwave.read.tile_decoder import make_decoder
from terrainwave.write.boxes import Box, enclosing_boxes
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.found import Found
from terrainwave.write.patching.merged import Merged
from terrainwave.write.pyramid import Pyramid

_CACHE_BYTES = 128 << 20
# Beyond the raster's edge two rows or columns are continued, in both directions: 3 x 3 times the
# reach of a sample.
_CONTINUED = 9


class PatchedIndex:
    """Codes of a patched file's blocks; `sink` holds its payloads, and receives new ones.

    Parameters
    ----------
    header : Header
        Of the patched file.
    """

    def __init__(
        self,
        terrain: TerrainFile,
        header: Header,
        merged: Merged,
        pyramid: Pyramid,
        sink: SpoolSink,
        bench: Bench,
    ) -> None:
        self._terrain, self._container, self._grid = terrain, terrain.container, terrain.grid
        self._header, self._merged, self._pyramid, self._sink = header, merged, pyramid, sink
        self._bench = bench
        quantizer = terrain.quantizer
        self._whole = quantizer.z_min, quantizer.z_max
        self._lost = quantizer.lost

    def update(self, found: Found) -> tuple[bool, float]:
        """Set all codes; return whether any changed, and the stated error of unknown originals."""
        errors, boxes = self._codes(found)
        mesh_errors = self._mesh(found, errors)
        return self._set_codes(errors, boxes, mesh_errors), self._stated_error(errors)

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

    def _stated_error(self, errors: Mapping[Block, int]) -> float:
        """Return the largest stated error of blocks with unknown originals, in raw units."""
        grid = self._grid
        codes = (
            code
            for block, code in errors.items()
            if block.level == grid.k_max and not self._merged.covers(grid.full_region(block))
        )
        stated = decode_error(max(codes, default=0)) * self._terrain.quantizer.quantum
        return min(float(stated), self._header.effective_bound)

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
        header, grid = self._header, self._grid
        if header.mesh == "none":
            return {}
        if not self._terrain.has_measured_meshes:
            meshed = [block for block, own in found.stats.items() if own.has_mesh]
            return unmeasured_codes(grid, meshed, errors, header.mesh_tolerance)
        decoder = make_decoder(header, self._sink.payloads, _CACHE_BYTES)
        mesher, sections = make_meshes(
            grid,
            decoder,
            lambda block: errors.get(block, 0),
            header.mesh_tolerance,
            has_voids=self._header.has_voids,
            kind=header.mesh,
            executor=self._bench.executor,
            on_samples=self._bench.counter("making meshes"),
        )
        self._sink.set_meshes(sections)

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

    def _set_codes(
        self,
        errors: Mapping[Block, int],
        boxes: Mapping[Block, Box],
        mesh_errors: Mapping[Block, int],
    ) -> bool:
        """Set every block's codes, the old ones if equal; return whether any changed."""
        is_any_new = False
        for spool in self._sink.present():
            before: dict[Block, Box] = {}
            after: dict[Block, Box] = {}
            for key in sorted(spool.keys()):
                was_outer, outer = before.get(key, self._whole), after.get(key, self._whole)
                codes = bytearray()
                for block in self._grid.key_blocks(key):
                    old = self._container.codes(block)
                    before[block] = decode_range(old[0], old[1], *was_outer)
                    box = boxes.get(block)
                    # Coding a decoded box again may widen it.
                    is_same = outer == was_outer and box == before[block]
                    ends = old[:2] if is_same else encode_range(*(box or outer), *outer)
                    after[block] = decode_range(*ends, *outer)
                    new = (*ends, errors.get(block, 0), mesh_errors.get(block, 0))
                    is_any_new |= new != old
                    codes += bytes(new)
                spool.set_codes(key, bytes(codes))
        return is_any_new
