"""Whether every checksum of a file holds, every unit decodes, and neighbours agree."""

from collections.abc import Iterator

import numpy as np

from terrainwave.codec.refiner import ALL_VALID, Decoded
from terrainwave.container.reader import Container
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.read.coded import Content, EvenBlocks
from terrainwave.read.decoder import TreeDecoder, unit_name
from terrainwave.read.window_reader import exact_heights


def check_units(container: Container, decoder: TreeDecoder) -> Iterator[str]:
    """Check all checksums and decode every unit; yield what is wrong, in plain words.

    At the end, how much of each level is lost, if anything is.
    """
    yield from container.check()
    even, lost, sound = EvenBlocks(container, decoder), list[Block](), set[Content]()
    seams = _Seams(decoder, even)
    for key in container.grid.root_keys():
        yield from _check_below(container, decoder, seams, even, key, lost, sound)
    yield from _shares(container.grid, lost)


def _shares(grid: Grid, lost: list[Block]) -> Iterator[str]:
    """Yield how much of each level lies in or below units that cannot be read."""
    for level in range(grid.k_max + 1):
        n_rows, n_cols = grid.level_shape(level)
        regions = [
            grid.descendant_region(Block(max(key.level, 0), key.row, key.col), level)
            for key in lost
            if key.level < level
        ]
        # Neighbours share samples: each counts those before its end.
        n_lost = sum(max(one.n_rows - 1, 1) * max(one.n_cols - 1, 1) for one in regions)
        if n_lost:
            share = 100 * min(n_lost / (max(n_rows - 1, 1) * max(n_cols - 1, 1)), 1)
            yield f"level {level}: {share:.3g} % of the samples cannot be read"


def _check_below(
    container: Container,
    decoder: TreeDecoder,
    seams: "_Seams",
    even: EvenBlocks,
    key: Block,
    lost: list[Block],
    sound: set[Content],
) -> Iterator[str]:
    """Check a unit and all below it; `sound` are segments in which there was nothing to tell."""
    try:
        content = None if key.is_root_key else even.content(key)
        if content in sound and _is_beside(even, key, sound):
            return
        if even.of_unit(key) is None:
            _check_heights(container, decoder.unit(key))
    except CorruptStreamError as exc:
        lost.append(key)
        yield str(exc)
        return  # what lies below cannot be decoded either
    problems = list(seams.differences(key))
    for block in container.grid.key_blocks(key):
        if block.level == container.grid.k_max:
            continue
        if _is_absent(container, decoder, block):
            problems += seams.differences_of_absent(container, block)
        else:
            problems += _check_below(container, decoder, seams, even, block, lost, sound)
    if content is not None and not problems:
        sound.add(content)
    yield from problems


def _check_heights(container: Container, unit: Decoded) -> None:
    """Raise if remainders make a height that is not finite (FORMAT.md §5.3)."""
    if unit.remainders is not None:
        exact_heights(container.header.quantizer, unit)


def _is_beside(even: EvenBlocks, head: Block, sound: set[Content]) -> bool:
    """Say whether the segments before one, which it shares samples with, are such as itself."""
    before = (head._replace(row=head.row - 1), head._replace(col=head.col - 1))
    return all(even.content(one) in sound for one in before)


class _Seams:
    """Whether units hold the same of the samples that they share (FORMAT.md §2.4).

    Units of a level come in Morton order: those above and to the left have come before, and left
    what they share with the next. Memory: a line of samples along the units still to come.
    """

    def __init__(self, decoder: TreeDecoder, even: EvenBlocks) -> None:
        self._decoder = decoder
        self._even = even
        self._lines: dict[tuple[Block, Block], Decoded] = {}

    def differences(self, key: Block) -> Iterator[str]:
        """Compare a unit, which can be decoded, with those before it."""
        if key.is_root_key:
            return
        for row, col in ((-1, 0), (0, -1)):
            other = Block(key.level, key.row + row, key.col + col)
            if self._decoder.grid.contains(other) and not self._agree(other, key):
                yield _difference(key, other)
        for row, col in ((1, 0), (0, 1)):
            other = Block(key.level, key.row + row, key.col + col)
            if self._decoder.grid.contains(other):
                self._lines[key, other] = self._shared(key, other)

    def differences_of_absent(self, container: Container, head: Block) -> Iterator[str]:
        """Compare the units of an absent segment, and all below it, with those before them.

        All of them are void. Segments before it that are absent, too, hold no unit to compare.
        """
        grid = self._decoder.grid
        for row, col in ((-1, 0), (0, -1)):
            units = [head]
            while units:
                unit = units.pop()
                before = Block(unit.level, unit.row + row, unit.col + col)
                if not grid.contains(before):
                    continue
                head_before = grid.segment_head(before)
                if head_before is None or _is_absent(container, self._decoder, head_before):
                    continue
                if not self._agree(before, unit):
                    yield _difference(unit, before)
                if unit.level + 1 < grid.k_max:
                    units += [
                        child
                        for child in grid.children(unit)
                        if (child.row == 2 * unit.row if row else child.col == 2 * unit.col)
                    ]

    def _shared(self, key: Block, other: Block) -> Decoded:
        """Return what a unit holds of the samples that another one holds as well."""
        height = self._even.of_unit(key)
        if height is None:
            return self._decoder.shared(key, other)
        common = self._decoder.spec(key).region.intersect(self._decoder.spec(other).region)
        return Decoded(np.broadcast_to(np.int32(height), common.shape), ALL_VALID)

    def _agree(self, before: Block, key: Block) -> bool:
        one = self._lines.pop((before, key), None)
        if one is None:  # damaged, or void and left out of the file
            try:
                one = self._shared(before, key)
            except CorruptStreamError:
                return True  # has been told
        other = self._shared(key, before)
        rests = [0 if part.remainders is None else part.remainders for part in (one, other)]
        is_other = (one.heights != other.heights) | (rests[0] != rests[1])
        is_valid_alike = np.array_equal(one.mask, other.mask)
        is_valid_alike &= np.array_equal(one.own_mask, other.own_mask)
        return is_valid_alike and not bool(is_other[one.mask].any())


def _difference(key: Block, other: Block) -> str:
    return f"{unit_name(key)} and {unit_name(other)} differ in samples that they share"


def _is_absent(container: Container, decoder: TreeDecoder, block: Block) -> bool:
    """Say whether `block` heads a segment that is left out, and all below it is void.

    Units of a tile can be in such a segment: the tile holds their samples.

    A file of a few hundred bytes may claim 2^50 void samples.
    """
    if container.grid.segment_head(block) != block:
        return False
    try:
        if not container.segment(block).page.is_empty:
            return False
        return decoder.source.are_apart or not decoder.unit(block).mask.any()
    except CorruptStreamError:
        return False  # its units will say so
