"""The codes of blocks in the index: boxes and errors, rounded outward (FORMAT.md §4.4)."""

from collections import defaultdict
from collections.abc import Mapping

from terrainwave.container.codes import decode_error, decode_range, encode_error, encode_range
from terrainwave.container.spool import SegmentSpool
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.write.encoder import Stats

Box = tuple[int, int]


def error_codes(stats: Stats, lost: int) -> dict[Block, int]:
    """Return the codes of measured errors; `lost` quanta are added to each."""
    return {block: encode_error(own.error + lost) for block, own in stats.items()}


def set_codes(
    grid: Grid,
    spools: Mapping[Block | None, SegmentSpool],
    whole: Box,
    boxes: Mapping[Block, Box],
    errors: Mapping[Block, int],
    mesh_errors: Mapping[Block, int],
) -> None:
    """Give every block its box and errors, each box relative to its parent's in the segment.

    `whole` is the range of the raster; blocks without a box have no valid sample.
    """
    for spool in spools.values():
        decoded: dict[Block, Box] = defaultdict(lambda: whole)
        for key in sorted(spool.keys()):
            codes = bytearray()
            for block in grid.key_blocks(key):
                if block not in boxes:
                    codes += bytes(4)
                    continue
                below, above = encode_range(*boxes[block], *decoded[key])
                decoded[block] = decode_range(below, above, *decoded[key])
                codes += bytes([below, above, errors[block], mesh_errors.get(block, 0)])
            spool.set_codes(key, bytes(codes))


def enclosing_boxes(
    stats: Stats, errors: Mapping[Block, int], whole: Box, below: Mapping[Block, Box]
) -> dict[Block, Box]:
    """Return the range of originals and surfaces of each block and of all below it.

    `below` are such ranges of what lies below blocks of `stats` and is not in `stats` itself.
    """
    boxes = dict(below)
    for block in sorted(stats, reverse=True):  # the finest level first
        own = stats[block]
        if own.is_empty:
            continue
        # Decoded heights are clamped to the originals' range, so boxes are as well.
        error = decode_error(errors[block])
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
