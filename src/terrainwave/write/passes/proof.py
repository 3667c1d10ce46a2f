"""Pass C: comparison of a finished file, decoded from disk, with its raster."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.container.digests import TILE, Place, TileDigests, tile_digests
from terrainwave.container.targets.kept import digest_of_file
from terrainwave.errors import BoundViolationError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.grid.shares import shares_of
from terrainwave.raster_io.even import even_parts
from terrainwave.read.coded import Content, EvenBlocks
from terrainwave.write.job import Job
from terrainwave.write.passes.bench import Bench
from terrainwave.write.pyramid import IndexedWindows, SourceWindows

OUR_FAULT = (
    "unless the raster changed while it was read, this is a fault of terrainwave: please report it"
    " with the raster. Nothing was written"
)
# Side of the compared windows, in samples, where groups are smaller.
_PROOF_SIDE = TILE
_CACHE_BYTES = 64 << 20
# With so few windows, shares are too few to keep threads busy.
_FEW = 16
# Number of windows that are divided at a time, and of shares handed to threads.
_BATCH, _SHARES = 4096, 1024
ShareT = TypeVar("ShareT", bound=Region | Block)


class Proved(NamedTuple):
    """Largest error found, in raw units, and the digests of tiles."""

    error: float
    tiles: dict[Place, bytes]


NOTHING = Proved(0.0, {})


def together(found: Iterable[Proved]) -> Proved:
    largest, tiles = 0.0, dict[Place, bytes]()
    for one in found:
        largest = max(largest, one.error)
        tiles |= one.tiles
    return Proved(largest, tiles)


def proof_shares(grid: Grid, windows: list[Region] | None = None) -> list[list[Region]]:
    """Return windows in shares for threads; each thread decodes the levels above its share.

    By default windows that cover the full grid. A few windows become one share each, the largest
    first.
    """
    side = _side_of(grid)
    if windows is None:
        windows = list(Region(0, 0, grid.n_rows, grid.n_cols).tiles(side, side))
    if len(windows) <= _FEW:
        return [[one] for one in sorted(windows, key=lambda one: -one.n_rows * one.n_cols)]
    return shares_of(windows, lambda window: (window.row // side, window.col // side))


def unproved(
    terrain: TerrainFile, source: IndexedWindows, grid: Grid, within: Region | None = None
) -> Iterator[Region | Block]:
    """Yield windows and blocks to compare: all except where source and file are both void.

    A block is yielded if the source has one height on all of its samples: a head of a finest
    segment, or a block as large as a window. The file's index proves most of the voids that the
    source knows; windows in which the file has heights there are compared. Of voids known from the
    source's index some samples are read again, of those known only from the scan all.
    """
    side = _side_of(grid)
    whole = within or Region(0, 0, grid.n_rows, grid.n_cols)
    for part, even in even_parts(whole, side, source.even):
        if even is not None and not source.holds(part, even):
            raise BoundViolationError(
                f"heights within {part.n_rows} x {part.n_cols} samples from row {part.row}, column"
                f" {part.col} are not what the source's index or the scan say; {OUR_FAULT}"
            )
        if even is None:
            yield part
        elif even.is_valid:
            yield from _even_blocks(source, grid, part, grid.block << SEGMENT_LEVELS)
        else:
            yield from terrain.coded_parts(part)


def _even_blocks(
    source: IndexedWindows, grid: Grid, part: Region, side: int
) -> Iterator[Region | Block]:
    """Yield the blocks of `side` samples in a part of one height, and windows for the rest."""
    smallest = _side_of(grid)
    side = max(side, smallest)
    level = grid.k_max - (side // grid.block).bit_length() + 1
    for window in part.tiles(side, side):
        block = Block(level, window.row // side, window.col // side)
        is_whole = grid.is_inside(block) and window == _own_samples(grid, block)
        if is_whole and source.even(_around(grid, block)):
            yield block
        elif side > smallest:
            yield from _even_blocks(source, grid, window, smallest)
        else:
            yield window


def _n_samples(grid: Grid, one: Region | Block) -> int:
    n_rows, n_cols = (_own_samples(grid, one) if isinstance(one, Block) else one).shape
    return n_rows * n_cols


def _own_samples(grid: Grid, block: Block) -> Region:
    """Return the samples that only this block holds; it lies inside the raster."""
    row, col, n_rows, n_cols = grid.full_region(block)
    return Region(row, col, n_rows - 1, n_cols - 1)


def _around(grid: Grid, block: Block) -> Region:
    """Return the samples under a block and its aprons on all finer levels."""
    row, col, n_rows, n_cols = grid.full_region(block)
    margin = 2 * grid.stride(block.level)
    return Region(row - margin, col - margin, n_rows + 2 * margin, n_cols + 2 * margin).intersect(
        Region(0, 0, grid.n_rows, grid.n_cols)
    )


@dataclass
class Comparison:
    """Compares a finished, decoded file with its raster; thread-safe.

    Below a block of one height, units and finest segments with neighbours on all sides decode alike
    if their bytes are equal (`EvenBlocks`): the first is decoded, the bytes of the others are
    compared with it. Tiles are digested if `has_digests`. `count` is called with the numbers of
    compared samples.
    """

    terrain: TerrainFile
    source: SourceWindows
    allowed: float
    has_digests: bool
    count: Callable[[int], None] = lambda _: None
    # Of stored numbers: 1, none may be below its original; -1, none above; 0, both.
    side: int = 0

    def __post_init__(self) -> None:
        self._even = EvenBlocks(self.terrain.container, self.terrain.decoder)
        # Places of tiles are those of the first block.
        self._known: dict[tuple[Content, bytes], tuple[Block, Proved]] = {}

    def all(self, whole: Iterable[Region | Block]) -> Proved:
        """Compare windows and blocks, as `unproved` yields them."""
        all_found = []
        for one in whole:
            all_found.append(self._block(one) if isinstance(one, Block) else self.window(one))
            self.count(_n_samples(self.terrain.grid, one))
        return together(all_found)

    def window(self, region: Region) -> Proved:
        """Return the largest error in a window, and the digests of its tiles if wanted."""
        raw, valid = self.source.read(*region)
        decoded, decoded_valid = self.terrain.read_with_mask(region)
        if not np.array_equal(valid, decoded_valid):
            row, col = np.argwhere(valid != decoded_valid)[0] + (region.row, region.col)
            raise BoundViolationError(
                f"the decoded mask differs from the source's at row {row}, column {col};"
                f" {OUR_FAULT}"
            )
        if not valid.any():
            return NOTHING
        if self.terrain.quantizer.remainder_bytes:
            _compare_bits(raw, decoded, valid, region)
        largest = _largest_error(raw, decoded, valid)
        if not largest <= self.allowed:  # a NaN is not within the bound
            errors = np.abs(decoded[valid].astype(np.float64) - raw[valid].astype(np.float64))
            at = np.argwhere(valid)[int(errors.argmax())] + (region.row, region.col)
            raise BoundViolationError(
                f"the decoded height at row {at[0]}, column {at[1]} is {largest:g} off, more than"
                f" {self.allowed:g}; {OUR_FAULT}"
            )
        if self.side and (wrong := valid & _is_beyond(raw, decoded, self.side)).any():
            row, col = np.argwhere(wrong)[0] + (region.row, region.col)
            wrong_side = "below" if self.side > 0 else "above"
            raise BoundViolationError(
                f"the decoded number at row {row}, column {col} is {wrong_side} its original,"
                f" against the one-sided bound; {OUR_FAULT}"
            )
        return Proved(largest, tile_digests(region, decoded, valid) if self.has_digests else {})

    def shares(
        self, source: IndexedWindows, within: Region | None = None
    ) -> Iterator[Sequence[Region | Block]]:
        """Yield the shares of `unproved` in portions, as there may be millions."""
        grid = self.terrain.grid
        whole = unproved(self.terrain, source, grid, within)
        while batch := list(islice(whole, _BATCH)):
            yield from ([one] for one in batch if isinstance(one, Block))
            windows = [one for one in batch if isinstance(one, Region)]
            yield from proof_shares(grid, windows)

    def _block(self, block: Block) -> Proved:
        """Compare all below a block on which the source has one height."""
        region = _own_samples(self.terrain.grid, block)
        raw = self.source.read(region.row, region.col, 1, 1)[0]
        content = self._even.content(block)
        if content is None:
            return self._below(block, raw)
        known = content, raw.tobytes()
        if known not in self._known:
            self._known[known] = block, self._below(block, raw)
        first, found = self._known[known]
        n_tiles = region.n_rows // TILE
        down, right = (block.row - first.row) * n_tiles, (block.col - first.col) * n_tiles
        tiles = {(row + down, col + right): digest for (row, col), digest in found.tiles.items()}
        return found._replace(tiles=tiles)

    def _below(self, block: Block, raw: NDArray[np.generic]) -> Proved:
        """Compare all below a block on which all originals equal the one of `raw`."""
        grid, quantizer = self.terrain.grid, self.terrain.quantizer
        heights = None if quantizer.remainder_bytes else self._even.below(block)
        if heights is not None:
            decoded = quantizer.dequantize(np.array([[*heights]], dtype=np.int32))
            errors = np.abs(decoded.astype(np.float64) - raw.astype(np.float64))
            is_good = errors.max() <= self.allowed
            is_good &= not self.side or not _is_beyond(raw, decoded, self.side).any()
            if is_good and not self.has_digests:
                return Proved(float(errors.max()), {})
            if is_good and len(heights) == 1:
                shape, places = (TILE, TILE), _own_samples(grid, block).tiles(TILE, TILE)
                even = np.broadcast_to(decoded, shape), np.ones(shape, dtype=np.bool_)
                digest = tile_digests(Region(0, 0, *shape), *even)[0, 0]
                at = [(place.row // TILE, place.col // TILE) for place in places]
                return Proved(float(errors.max()), dict.fromkeys(at, digest))
        side = _side_of(grid)
        return together(map(self.window, _own_samples(grid, block).tiles(side, side)))


def _side_of(grid: Grid) -> int:
    return max(2 * grid.block, _PROOF_SIDE)


def _is_beyond(
    raw: NDArray[np.generic], decoded: NDArray[np.generic], side: int
) -> NDArray[np.bool_]:
    """Return which stored numbers lie on the wrong side of their originals."""
    return np.less(decoded, raw) if side > 0 else np.greater(decoded, raw)


def _compare_bits(
    raw: NDArray[np.generic], decoded: NDArray[np.generic], valid: NDArray[np.bool_], region: Region
) -> None:
    """Raise `BoundViolationError` unless valid heights are equal bit for bit, -0.0 too."""
    bits = f"u{raw.itemsize}"
    differ = valid & (np.ascontiguousarray(raw).view(bits) != decoded.view(bits))
    if differ.any():
        row, col = np.argwhere(differ)[0] + (region.row, region.col)
        raise BoundViolationError(
            f"the decoded height at row {row}, column {col} has other bits than the source's;"
            f" {OUR_FAULT}"
        )


def _largest_error(
    raw: NDArray[np.generic], decoded: NDArray[np.generic], valid: NDArray[np.bool_]
) -> float:
    is_whole = bool(valid.all())
    if raw.dtype.kind in "iu" and raw.dtype.itemsize <= 2:
        # Unsigned differences of their own width are exact; masking them is faster than selecting.
        apart = np.maximum(decoded, raw)
        apart -= np.minimum(decoded, raw)
        apart = apart.view(f"u{raw.itemsize}")
        if not is_whole:
            apart *= valid
        return float(apart.max())
    if not is_whole:
        raw, decoded = raw[valid], decoded[valid]
    errors = decoded.astype(np.float64)
    errors -= raw.astype(np.float64)
    return float(np.abs(errors, out=errors).max())


def allowed_error(quantizer: Quantizer, raw_bound: float, error: float) -> float:
    """Return the largest difference of stored values that keeps the bound.

    On a true grid the bound holds for the numbers k * p. The floats nearest to two of them may
    differ by one spacing more, unless the bound leaves room for that beyond `error`, the effective
    one.
    """
    return raw_bound + (0 if quantizer.is_strict(raw_bound, error) else quantizer.float_error)


def collected(
    found: Iterable[Proved], shape: tuple[int, int], quantizer: Quantizer
) -> tuple[float, TileDigests]:
    """Return the largest error of all parts of a raster, and the digests of its tiles."""
    largest, tiles = 0.0, TileDigests(shape)
    for one in found:
        largest = max(largest, one.error)
        tiles.add(one.tiles)
    if quantizer.float_error:
        # On a decimal grid heights are multiples of p, and floats are off by a spacing.
        largest = round(largest / quantizer.quantum) * quantizer.quantum
    return largest, tiles


def compared(
    path: str | os.PathLike[str] | bytes,
    shares: Iterable[Sequence[ShareT]],
    compare: Callable[[Sequence[ShareT]], Proved],
    bench: Bench,
) -> Iterator[Proved]:
    """Compare shares of a file in threads; yield results that cover it.

    What an earlier run has compared of a file with the same bytes is not compared again.
    """
    shares, kept, waiting, n_records, done = iter(shares), bench.kept, NOTHING, 0, 0
    name = ""
    if kept.is_on and not isinstance(path, bytes):
        name = f"proof/{digest_of_file(path)}"
        while (record := kept.get(f"{name}/{n_records}")) is not None:
            data, places = kept.data(f"{name}/{n_records}"), enumerate(record["places"])
            tiles = {(row, col): data[32 * n : 32 * (n + 1)] for n, (row, col) in places}
            yield Proved(record["largest"], tiles)
            done, n_records = record["done"], n_records + 1
        for _ in islice(shares, done):
            pass

    while batch := list(islice(shares, _SHARES)):
        for found in bench.executor.map(compare, batch):
            yield found
            waiting, done = together([waiting, found]), done + 1
            if name and kept.is_due(name):
                error, tiles = waiting
                values = {"done": done, "largest": error, "places": list(tiles)}
                kept.put(f"{name}/{n_records}", values, b"".join(tiles.values()))
                waiting, n_records = NOTHING, n_records + 1


@contextmanager
def comparison_of(
    path: str | os.PathLike[str] | bytes,
    job: Job,
    source: SourceWindows,
    count: Callable[[int], None] = lambda _: None,
) -> Iterator[Comparison]:
    """Open a finished file, and yield what compares it with its raster."""
    allowed = allowed_error(job.quantizer, job.raw_bound, job.effective_error)
    with TerrainFile(path, threads=1, cache_bytes=_CACHE_BYTES, native=False) as terrain:
        side = job.info.stored_side(job.options.bound)
        yield Comparison(terrain, source, allowed, job.options.makes_digests, count, side)
