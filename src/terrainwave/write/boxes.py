"""Codes of blocks in the index: boxes and errors, rounded outward (FORMAT.md §4.4)."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping

from terrainwave.container.page import decode_error, decode_range, encode_error, encode_range
from terrainwave.container.spool import SegmentSpool
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.mesh.codes import unmeasured_codes
from terrainwave.write.job import Job
from terrainwave.write.passes.found import Stats

Box = tuple[int, int]

_NONE: Mapping[Block, Box] = {}


class Codes:
    """Boxes and errors of blocks, by their statistics.

    Parameters
    ----------
    below : mapping
        Ranges below blocks whose children `stats` lacks.

    Attributes
    ----------
    errors : dict
        Codes of errors: measured ones plus what is lost by rounding, or `_recursive_errors`.
    boxes : dict
        Ranges in quanta (`enclosing_boxes`).
    """

    def __init__(
        self,
        job: Job,
        stats: Stats,
        below: Mapping[Block, Box] = _NONE,
    ) -> None:
        self._job, self._stats = job, stats
        self._whole = job.quantizer.z_min, job.quantizer.z_max
        if job.recursion_bound is None:
            found = {block: own.error + job.lost for block, own in stats.items()}
        else:
            quarters = _recursive_errors(stats, job.lost, job.recursion_bound)
            found = {block: -(-error // 4) for block, error in quarters.items()}
        self.errors = {block: encode_error(error) for block, error in found.items()}
        self.boxes = enclosing_boxes(stats, self.errors, self._whole, below, job.moved)

    def set(
        self, spools: Iterable[SegmentSpool], mesh_errors: Mapping[Block, int] | None = None
    ) -> None:
        """Set the codes of all blocks; `mesh_errors` of meshes that are measured.

        Of others readers compute them.
        """
        job, options = self._job, self._job.options
        if mesh_errors is None:
            mesh_errors = {}
            if options.mesh_kind != "none" and not options.measures_meshes:
                meshed = [block for block, own in self._stats.items() if own.has_mesh]
                mesh_errors = unmeasured_codes(job.grid, meshed, self.errors, job.mesh_tolerance)
        set_codes(job.grid, spools, self._whole, self.boxes, self.errors, mesh_errors)


def _recursive_errors(stats: Stats, lost: int, bound: int) -> dict[Block, int]:
    """Return Err_Appr of every block, by equation (2) of Yusov & Turlapov 2010, in 1/4 quanta.

    On the finest level it is the bound; above, the largest of a block's children plus their
    distance from it plus the bound. The measured error counts if it is larger: the equation does
    not see originals past the last samples of a coarse level. `lost`, the addend of measured
    errors, and the bound are in quanta.
    """
    errors: dict[Block, int] = {}
    children: dict[Block, int] = {}
    for block in sorted(stats, reverse=True):  # finest level first
        own = stats[block]
        if own.is_empty:
            continue
        error = children.get(block, 0) + own.apart + 4 * bound
        errors[block] = max(error, 4 * (own.error + lost))
        if block.level > 0:
            children[block.parent] = max(children.get(block.parent, 0), errors[block])
    return errors


def set_codes(
    grid: Grid,
    spools: Iterable[SegmentSpool],
    whole: Box,
    boxes: Mapping[Block, Box],
    errors: Mapping[Block, int],
    mesh_errors: Mapping[Block, int],
    old: Callable[[Block], tuple[int, ...]] | None = None,
) -> bool:
    """Set box and errors of every block, each box relative to its parent's in the segment.

    `whole` is the range of the raster; blocks without a box have no valid sample. Codes of `old`
    that decode to the same boxes stay, as coding a decoded box again may widen it. Return whether
    any code differs from the old one.
    """
    is_any_new = False
    for spool in spools:
        before: dict[Block, Box] = defaultdict(lambda: whole)
        after: dict[Block, Box] = defaultdict(lambda: whole)
        for key in sorted(spool.payloads):
            was_outer, outer = before[key], after[key]
            codes = bytearray()
            for block in grid.key_blocks(key):
                known = None if old is None else old(block)
                ends, box = (0, 0), boxes.get(block)
                if known is not None:
                    before[block] = decode_range(known[0], known[1], *was_outer)
                if known is not None and outer == was_outer and box == before[block]:
                    ends = known[0], known[1]
                elif box is not None:
                    ends = encode_range(*box, *outer)
                after[block] = decode_range(*ends, *outer)
                new = (*ends, errors.get(block, 0), mesh_errors.get(block, 0))
                is_any_new |= new != known
                codes += bytes(4 if box is None and old is None else new)
            spool.codes[key] = bytes(codes)
    return is_any_new


def enclosing_boxes(
    stats: Stats,
    errors: Mapping[Block, int],
    whole: Box,
    below: Mapping[Block, Box],
    moved: int = 0,
) -> dict[Block, Box]:
    """Return the range of originals and surfaces of each block and of all blocks below it.

    `below` are the ranges below blocks of `stats` that `stats` itself lacks, `moved` the largest
    distance of originals from the heights of `stats`, in quanta.
    """
    boxes = dict(below)
    for block in sorted(stats, reverse=True):  # finest level first
        own = stats[block]
        if own.is_empty:
            continue
        # Decoded heights are clamped to the originals' range, and so are boxes.
        error = decode_error(errors[block]) + moved
        low, high = (
            max(own.z_low - error, whole[0]),
            min(own.z_high + error, whole[1]),
        )
        if block in boxes:
            low, high = min(low, boxes[block][0]), max(high, boxes[block][1])
        boxes[block] = low, high
        if block.level > 0:
            above = boxes.get(block.parent, (low, high))
            boxes[block.parent] = min(low, above[0]), max(high, above[1])
    return boxes
