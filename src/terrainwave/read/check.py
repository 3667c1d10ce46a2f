"""Check of a file: checksums, decoding of every unit, agreement of neighbours, digests."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import ANY
from terrainwave.codec.refiner import ALL_VALID, Decoded
from terrainwave.container.digests import (
    FAN,
    TILE,
    DigestTree,
    Place,
    TileDigests,
    tile_digests,
)
from terrainwave.container.header import Header
from terrainwave.container.reader import Container
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid, Region
from terrainwave.read.coded import Content, EvenBlocks
from terrainwave.read.decoder import TreeDecoder, unit_name, units_of
from terrainwave.read.window_reader import WindowReader, exact_heights


def check_units(
    container: Container, decoder: TreeDecoder, root: str | None = None
) -> Iterator[str]:
    """Check all checksums and decode every unit; yield problems, in plain words.

    Digests are compared with the heights, and their root with `root`. The last lines give the lost
    share of each level, if any.
    """
    yield from container.check()
    walk = _Walk(container, decoder, root)
    for key in container.grid.root_keys():
        yield from walk.problems_below(key)
    if walk.digests is not None and not walk.lost:
        yield from walk.digests.problems(root)
    yield from _shares(container.grid, walk.lost)


def check_window(
    container: Container, decoder: TreeDecoder, window: Region, root: str | None = None
) -> Iterator[str]:
    """Compare a window of the full grid with the file's digests; yield problems.

    Leaves of 4096 x 4096 samples that the window touches are decoded, and nothing else. `root` is
    compared with that of the digests.
    """
    try:
        yield from _window_problems(container, decoder, window, root)
    except CorruptStreamError as error:
        yield str(error)


def _window_problems(
    container: Container, decoder: TreeDecoder, window: Region, root: str | None
) -> Iterator[str]:
    header, grid = container.header, container.grid
    stored = container.digests()
    if stored is None:
        yield "the file has no digests, which a check of a window needs"
        return
    yield from _other_root(stored, header, root)
    windows = WindowReader("", header, 1, lambda: decoder)
    whole, side = Region(0, 0, grid.n_rows, grid.n_cols), TILE * FAN
    rows = range(window.row // side, (window.row + window.n_rows - 1) // side + 1)
    cols = range(window.col // side, (window.col + window.n_cols - 1) // side + 1)
    tiles = TileDigests(stored.shape)
    for row, col, i in product(rows, cols, range(FAN)):
        strip = Region(row * side + i * TILE, col * side, TILE, side).intersect(whole)
        if strip.n_rows:
            tiles.add(tile_digests(strip, *_valid_heights(windows, grid.k_max, strip)))
    found = tiles.tree().leaves
    for place in product(rows, cols):
        if found.get(place) != stored.leaves.get(place):
            yield _false_digest(Region(place[0] * side, place[1] * side, side, side), whole)


def _valid_heights(
    windows: WindowReader, level: int, region: Region
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    raw, void = windows.read(level, region, voids=ANY)
    return raw, np.ones(region.shape, dtype=np.bool_) if void is None else ~void


def _false_digest(leaf: Region, whole: Region) -> str:
    leaf = leaf.intersect(whole)
    return (
        f"heights of {leaf.n_rows} x {leaf.n_cols} samples from row {leaf.row}, column {leaf.col}"
        " are not those of their digest"
    )


def _other_root(tree: DigestTree, header: Header, root: str | None) -> Iterator[str]:
    found = tree.root(header)
    if root is not None and found != root:
        yield f"the root of the heights is {found}, expected {root}"


def _shares(grid: Grid, lost: list[Block]) -> Iterator[str]:
    """Yield the share of each level in or below unreadable units."""
    for level in range(grid.k_max + 1):
        n_rows, n_cols = grid.level_shape(level)
        regions = [
            grid.descendant_region(Block(max(key.level, 0), key.row, key.col), level)
            for key in lost
            if key.level < level
        ]
        # Neighbours share samples: each counts the ones before its end.
        n_lost = sum(max(one.n_rows - 1, 1) * max(one.n_cols - 1, 1) for one in regions)
        if n_lost:
            share = 100 * min(n_lost / (max(n_rows - 1, 1) * max(n_cols - 1, 1)), 1)
            yield f"level {level}: {share:.3g} % of the samples cannot be read"


class _Walk:
    """Walk over the units of a file, those above first."""

    def __init__(self, container: Container, decoder: TreeDecoder, root: str | None) -> None:
        self._container, self._decoder = container, decoder
        self._even = EvenBlocks(container, decoder)
        self._seams = _Seams(decoder, self._even)
        self._sound: set[Content] = set()  # segments without problems
        self.lost: list[Block] = []
        has_digests = root is not None or container.header.has_digests
        self.digests = _Digests(container, decoder, self._even) if has_digests else None

    def problems_below(self, key: Block) -> Iterator[str]:
        """Check a unit and all below it."""
        even, digests, grid = self._even, self.digests, self._container.grid
        try:
            content = None if key.is_root_key else even.content(key)
            if content in self._sound and self._is_beside_sound(key):
                if digests is not None and content is not None:
                    digests.repeat(key, content)
                return
            if even.of_unit(key) is None:
                unit = self._decoder.unit(key)
                if unit.remainders is not None:  # heights that are not finite (FORMAT.md §5.3)
                    exact_heights(self._container.header.quantizer, unit)
        except CorruptStreamError as exc:
            self.lost.append(key)
            yield str(exc)
            return  # nothing below can be decoded either
        if digests is not None and content is not None:
            digests.begin()
        problems = list(self._seams.differences(key))
        for block in grid.key_blocks(key):
            if block.level == grid.k_max:
                continue
            if _is_absent(self._container, self._decoder, block):
                problems += self._seams.differences_of_absent(self._container, block)
            else:
                problems += self.problems_below(block)
        if digests is not None:
            digests.take(key)
        if content is not None:
            if digests is not None:
                digests.learn(key, content)
            if not problems:
                self._sound.add(content)
        yield from problems

    def _is_beside_sound(self, head: Block) -> bool:
        """Return whether the segments before one, with which it shares samples, are sound."""
        before = (head._replace(row=head.row - 1), head._replace(col=head.col - 1))
        return all(self._even.content(one) in self._sound for one in before)


class _Digests:
    """Digests of tiles of the full grid, made once the last unit of a tile is checked."""

    def __init__(self, container: Container, decoder: TreeDecoder, even: EvenBlocks) -> None:
        self._container = container
        self._decoder = decoder
        self._even = even
        header, self._grid = container.header, container.grid
        self._tiles = TileDigests((header.n_rows, header.n_cols))
        self._windows = WindowReader("", header, 1, lambda: decoder)
        # Tiles of the current segment, and of segments by their content.
        self._recent: dict[Place, bytes] | None = None
        self._known: dict[Content, dict[Place, bytes]] = {}

    def take(self, key: Block) -> None:
        """Digest the tiles whose last samples are in a unit of the full grid."""
        grid = self._grid
        if key.level + 1 != grid.k_max:
            return
        n_units = (1, 1) if key.is_root_key else grid.level_blocks(key.level)
        rows = _tiles_ending_in(key.row, grid.n_rows, 2 * grid.block, n_units[0])
        cols = _tiles_ending_in(key.col, grid.n_cols, 2 * grid.block, n_units[1])
        for row, col in product(rows, cols):
            whole = Region(0, 0, grid.n_rows, grid.n_cols)
            region = Region(row * TILE, col * TILE, TILE, TILE).intersect(whole)
            tiles = tile_digests(region, *self._heights(key, region))
            self._tiles.add(tiles)
            if self._recent is not None:
                self._recent |= tiles

    def _heights(self, key: Block, region: Region) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return raw heights and validity of a tile that ends in a unit."""
        level = self._grid.k_max
        height = self._even.of_unit(key)
        if height is not None:
            units = units_of(self._grid, level, region)
            if all(self._even.of_unit(unit) == height for unit in units):
                raw = self._container.header.quantizer.dequantize(np.array([[height]], np.int32))
                return np.broadcast_to(raw, region.shape), np.ones(region.shape, np.bool_)
        return _valid_heights(self._windows, level, region)

    def begin(self) -> None:
        """Begin a finest segment that others may equal."""
        self._recent = {}

    def learn(self, head: Block, content: Content) -> None:
        """Store the tiles of the current segment for others with its content."""
        self._known[content] = self._moved(self._recent or {}, head, -1)
        self._recent = None

    def repeat(self, head: Block, content: Content) -> None:
        """Add the tiles of a segment that decodes like another one."""
        self._tiles.add(self._moved(self._known[content], head, 1))

    def _moved(self, tiles: dict[Place, bytes], head: Block, sign: int) -> dict[Place, bytes]:
        """Return tiles with positions relative to a segment's corner (-1), or to the raster's."""
        n_tiles = sign * (self._grid.block << SEGMENT_LEVELS) // TILE
        down, right = head.row * n_tiles, head.col * n_tiles
        return {(row + down, col + right): digest for (row, col), digest in tiles.items()}

    def problems(self, root: str | None) -> Iterator[str]:
        """Compare with the file's digests, and with a root."""
        tree = self._tiles.tree()
        try:
            stored = self._container.digests()
        except CorruptStreamError as error:
            yield str(error)
            stored = None
        if stored is not None:
            for leaf in tree.differences(stored):
                yield _false_digest(leaf, leaf)
        yield from _other_root(tree, self._container.header, root)


def _tiles_ending_in(index: int, n_samples: int, side: int, n_units: int) -> Iterator[int]:
    """Yield the tiles along one axis whose last sample belongs to a unit of `side` cells."""
    first = 0 if n_units == 1 else index * side // TILE
    last = n_samples - 1 if index + 1 == n_units else (index + 1) * side
    for tile in range(first, last // TILE + 1):
        end = min((tile + 1) * TILE, n_samples) - 1
        if min(end // side, n_units - 1) == index:
            yield tile


class _Seams:
    """Comparison of the samples that units share (FORMAT.md §2.4).

    Units of a level come in Morton order: the ones above and to the left come first, and store
    their shared samples. Memory: a line of samples along the pending units.
    """

    def __init__(self, decoder: TreeDecoder, even: EvenBlocks) -> None:
        self._decoder = decoder
        self._even = even
        self._lines: dict[tuple[Block, Block], Decoded] = {}

    def differences(self, key: Block) -> Iterator[str]:
        """Compare a decodable unit with earlier ones."""
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
        """Compare the units of an absent segment, and all below it, with earlier ones.

        All of them are void. Earlier segments that are absent, too, have no unit to compare.
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
        """Return the samples of a unit that another one holds as well."""
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
                return True  # already reported
        other = self._shared(key, before)
        rests = [0 if part.remainders is None else part.remainders for part in (one, other)]
        is_other = (one.heights != other.heights) | (rests[0] != rests[1])
        is_valid_alike = np.array_equal(one.mask, other.mask)
        is_valid_alike &= np.array_equal(one.own_mask, other.own_mask)
        return is_valid_alike and not bool(is_other[one.mask].any())


def _difference(key: Block, other: Block) -> str:
    return f"{unit_name(key)} and {unit_name(other)} differ in samples that they share"


def _is_absent(container: Container, decoder: TreeDecoder, block: Block) -> bool:
    """Return whether `block` heads a segment that is left out, with all below it void.

    Units of a tile can be in such a segment: the tile holds their samples. A file of a few hundred
    bytes may claim 2^50 void samples.
    """
    if container.grid.segment_head(block) != block:
        return False
    try:
        if not container.segment(block).page.is_empty:
            return False
        return decoder.are_apart or not decoder.unit(block).mask.any()
    except CorruptStreamError:
        return False  # its units will report it
