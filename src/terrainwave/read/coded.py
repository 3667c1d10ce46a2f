"""Which parts of a level have a payload: all else is void, as the index tells without reading."""

from collections.abc import Iterable, Iterator

from terrainwave.container.reader import Container
from terrainwave.grid.quadtree import Block, Region


def coded_parts(container: Container, level: int, region: Region) -> Iterator[Region]:
    """Yield the parts of a region of a level in which units have a payload, for methods of units.

    A unit without one is void, as is all below it: so few are looked at where much is.
    """
    yield from _coded(container, level, region, container.grid.root_keys())


def _coded(
    container: Container, level: int, region: Region, keys: Iterable[Block]
) -> Iterator[Region]:
    grid = container.grid
    near = []
    for key in keys:
        block = Block(0, key.row, key.col) if key.is_root_key else key
        part = grid.descendant_region(block, level).intersect(region)
        if part.n_rows and part.n_cols:
            near.append((key, part))
    lengths = container.payload_lengths([key for key, _ in near])
    for (key, part), length in zip(near, lengths, strict=True):
        if not length:
            continue
        if key.level + 1 == level:
            yield part
        else:
            yield from _coded(container, level, region, grid.key_blocks(key))
