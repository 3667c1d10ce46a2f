"""Whether every checksum of a file holds and every unit decodes."""

from collections.abc import Iterator

from terrainwave.container.reader import Container
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Block
from terrainwave.read.decoder import TreeDecoder


def check_units(container: Container, decoder: TreeDecoder) -> Iterator[str]:
    """Check all checksums and decode every unit; yield what is wrong, in plain words."""
    yield from container.check()
    for key in container.grid.root_keys():
        yield from _check_below(container, decoder, key)


def _check_below(container: Container, decoder: TreeDecoder, key: Block) -> Iterator[str]:
    try:
        decoder.unit(key)
    except CorruptStreamError as exc:
        yield str(exc)
        return  # what lies below cannot be decoded either
    for block in container.grid.key_blocks(key):
        if block.level < container.grid.k_max and not _is_absent(container, block):
            yield from _check_below(container, decoder, block)


def _is_absent(container: Container, block: Block) -> bool:
    """Say whether `block` heads a segment that is left out: all below it is void.

    A file of a few hundred bytes may claim 2^50 void samples.
    """
    if container.grid.segment_head(block) != block:
        return False
    try:
        return container.segment(block).page.is_empty
    except CorruptStreamError:
        return False  # its units will say so
