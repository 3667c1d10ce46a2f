"""Pass C: a finished file, decoded from disk, against the raster it was made of."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.container.targets.kept import Kept, digest_of_file
from terrainwave.errors import BoundViolationError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.grid.shares import shares_of
from terrainwave.progress import Reporter
from terrainwave.raster_io.even import even_parts
from terrainwave.read.coded import Content, EvenBlocks
from terrainwave.write.job import Job
from terrainwave.write.pyramid import IndexedWindows, SourceWindows

OUR_FAULT = (
    "unless the raster changed while it was read, this is a fault of terrainwave: please report it"
    " with the raster. Nothing was written"
)
# Samples per side of the windows that are compared, where groups are smaller than that.
_PROOF_SIDE = 512
_CACHE_BYTES = 64 << 20
# So many windows give too few shares to keep threads busy.
_FEW = 16
# How many windows are shared out at a time, and shares handed to threads.
_BATCH, _SHARES = 4096, 1024
Share = Sequence[Region | Block]
ShareT = TypeVar("ShareT", bound=Share)


def proof_windows(grid: Grid, within: Region | None = None) -> list[Region]:
    """Return windows that cover the full grid, or the region `within`, once."""
    side = _side_of(grid)
    return list((within or Region(0, 0, grid.n_rows, grid.n_cols)).tiles(side, side))


def proof_shares(grid: Grid, windows: list[Region] | None = None) -> list[list[Region]]:
    """Return windows in shares for threads, which decode the levels above them.

    By default those of `proof_windows`. A few are shared out one by one, the largest first.
    """
    side = _side_of(grid)
    if windows is None:
        windows = proof_windows(grid)
    if len(windows) <= _FEW:
        return [[one] for one in sorted(windows, key=lambda one: -one.n_rows * one.n_cols)]
    return shares_of(windows, lambda window: (window.row // side, window.col // side))


def unproved(
    terrain: TerrainFile, source: IndexedWindows, grid: Grid, within: Region | None = None
) -> Iterator[Region | Block]:
    """Yield what has to be compared: all but where source and file are both void.

    Windows, and blocks on whose every sample the source has one height: heads of finest segments,
    and blocks as large as a window. Of voids that the source knows, the file's index proves the
    most; windows in which the file has heights there are compared. Some samples of what an index
    tells are read all the same, and all of what only the scan has told.

    Raises
    ------
    BoundViolationError
        If one of these is not what the source knows.
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
    """Yield the blocks of so many samples a side that a part of one height has; windows else."""
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
    """Return all that a block inside the raster has for itself."""
    row, col, n_rows, n_cols = grid.full_region(block)
    return Region(row, col, n_rows - 1, n_cols - 1)


def _around(grid: Grid, block: Block) -> Region:
    """Return the samples under a block and its aprons on all levels below it."""
    row, col, n_rows, n_cols = grid.full_region(block)
    margin = 2 * grid.stride(block.level)
    return Region(row - margin, col - margin, n_rows + 2 * margin, n_cols + 2 * margin).intersect(
        Region(0, 0, grid.n_rows, grid.n_cols)
    )


class Comparison:
    """Compares a finished file, decoded, with the raster it was made of; thread-safe.

    Below a block of one height, units and finest segments with neighbours on all sides decode to
    what others of the same bytes do (`EvenBlocks`): the first of them is decoded, the others are
    compared with its bytes.
    """

    def __init__(self, terrain: TerrainFile, source: SourceWindows, allowed: float) -> None:
        self._terrain = terrain
        self._source = source
        self._allowed = allowed
        self._even = EvenBlocks(terrain.container, terrain.decoder)
        self._known: dict[tuple[Content, bytes], float] = {}

    def windows(self, windows: Iterable[Region]) -> float:
        """Return the largest error in windows, in raw units (`compare_window`)."""
        return max(
            (compare_window(self._terrain, self._source, one, self._allowed) for one in windows),
            default=0.0,
        )

    def all(self, whole: Iterable[Region | Block]) -> float:
        """Return the largest error in windows and blocks, as `unproved` yields them."""
        errors = (
            self.block(one) if isinstance(one, Block) else self.windows([one]) for one in whole
        )
        return max(errors, default=0.0)

    def block(self, block: Block) -> float:
        """Return the largest error below a block of whose every sample the source has one height.

        Raises
        ------
        BoundViolationError
            As `compare_window` does.
        """
        region = _own_samples(self._terrain.grid, block)
        raw = self._source.read(region.row, region.col, 1, 1)[0]
        content = self._even.content(block)
        if content is None:
            return self._below(block, raw)
        known = content, raw.tobytes()
        if known not in self._known:
            self._known[known] = self._below(block, raw)
        return self._known[known]

    def _below(self, block: Block, raw: NDArray[np.generic]) -> float:
        """Return the largest error below a block on which all originals are as the one of `raw`."""
        grid, quantizer = self._terrain.grid, self._terrain.quantizer
        heights = None if quantizer.remainder_bytes else self._even.below(block)
        if heights is not None:
            decoded = quantizer.dequantize(np.array([[*heights]], dtype=np.int32))
            errors = np.abs(decoded.astype(np.float64) - raw.astype(np.float64))
            if errors.max() <= self._allowed:
                return float(errors.max())
        side = _side_of(grid)
        return self.windows(_own_samples(grid, block).tiles(side, side))


def _side_of(grid: Grid) -> int:
    return max(2 * grid.block, _PROOF_SIDE)


def compare_window(
    terrain: TerrainFile, source: SourceWindows, region: Region, allowed: float
) -> float:
    """Return the largest error in a window, in raw units.

    Raises
    ------
    BoundViolationError
        If a sample is further than `allowed` from the original, or valid where that is void.
    """
    raw, valid = source.read(*region)
    decoded, decoded_valid = terrain.read_with_mask(region)
    if not np.array_equal(valid, decoded_valid):
        row, col = np.argwhere(valid != decoded_valid)[0] + (region.row, region.col)
        raise BoundViolationError(
            f"the decoded mask differs from the source's at row {row}, column {col}; {OUR_FAULT}"
        )
    if not valid.any():
        return 0.0
    if terrain.quantizer.remainder_bytes:
        _compare_bits(raw, decoded, valid, region)
    largest = _largest_error(raw, decoded, valid)
    if not largest <= allowed:  # a NaN is no height within the bound
        errors = np.abs(decoded[valid].astype(np.float64) - raw[valid].astype(np.float64))
        at = np.argwhere(valid)[int(errors.argmax())] + (region.row, region.col)
        raise BoundViolationError(
            f"the decoded height at row {at[0]}, column {at[1]} is {largest:g} off, more than"
            f" {allowed:g}; {OUR_FAULT}"
        )
    return largest


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
    """Return the largest difference of valid heights, of which there are some."""
    is_whole = bool(valid.all())
    if raw.dtype.kind in "iu" and raw.dtype.itemsize <= 2:
        # Differences have 17 bits; a mask of what is left is faster than picking what is not.
        apart = np.subtract(decoded, raw, dtype=np.int32)
        if not is_whole:
            np.copyto(apart, 0, where=~valid)
        return float(max(int(apart.max()), -int(apart.min())))
    if not is_whole:
        raw, decoded = raw[valid], decoded[valid]
    errors = decoded.astype(np.float64)
    errors -= raw.astype(np.float64)
    return float(np.abs(errors, out=errors).max())


def allowed_error(quantizer: Quantizer, raw_bound: float, error: float) -> float:
    """Return the largest difference of stored values that keeps the bound.

    On a true grid the bound holds for the numbers k * p; the floats nearest to two of them may
    differ by one spacing more than the numbers do, unless the bound leaves room for that beyond
    `error`, the one that holds.
    """
    return raw_bound + (0 if quantizer.is_strict(raw_bound, error) else quantizer.float_error)


def measured_error(largest: float, quantizer: Quantizer) -> float:
    """Return the largest difference of stored values as the error of the heights they name."""
    if quantizer.float_error:
        # On a decimal grid the heights are multiples of p; floats name them with a spacing's error.
        return round(largest / quantizer.quantum) * quantizer.quantum
    return largest


def shares_in_turns(grid: Grid, whole: Iterator[Region | Block]) -> Iterator[Share]:
    """Yield shares of what `unproved` yields: not all at once, for they are millions."""
    while batch := list(islice(whole, _BATCH)):
        yield from ([one] for one in batch if isinstance(one, Block))
        yield from proof_shares(grid, [one for one in batch if isinstance(one, Region)])


def proven_shares(
    path: str | os.PathLike[str] | bytes,
    shares: Iterable[ShareT],
    compare: Callable[[list[ShareT]], Iterable[float]],
    kept: Kept,
) -> Iterator[tuple[ShareT, float]]:
    """Yield shares of a file with their errors, those that an earlier run has compared first.

    These have the largest error of them all. `compare` makes those of the others, in order.
    """
    shares, name, done, largest = iter(shares), None, 0, 0.0
    if kept.is_on and not isinstance(path, bytes):
        name = f"proof/{digest_of_file(path)}"
        found = kept.get(name) or {"done": 0, "largest": 0.0}
        done, largest = found["done"], found["largest"]
    for share in islice(shares, done):
        yield share, largest
    while batch := list(islice(shares, _SHARES)):
        for share, error in zip(batch, compare(batch), strict=True):
            yield share, error
            done, largest = done + 1, max(largest, error)
            if name is not None:
                kept.tick(name, lambda: {"done": done, "largest": largest})  # noqa: B023


def prove(
    path: str | os.PathLike[str] | bytes,
    job: Job,
    source: IndexedWindows,
    executor: Executor,
    reporter: Reporter,
    kept: Kept,
) -> float:
    """Decode the file from disk and compare every sample and the mask; return the largest error.

    Shares that an earlier run has compared in a file of the same bytes are not compared again.

    Raises
    ------
    BoundViolationError
        If a sample is further than the bound from the original, or valid where that is void.
    """
    grid = job.grid
    allowed = allowed_error(job.quantizer, job.raw_bound, job.effective_error)
    largest = 0.0
    with TerrainFile(path, threads=1, cache_bytes=_CACHE_BYTES, native=False) as terrain:
        comparison = Comparison(terrain, source, allowed)
        whole = unproved(terrain, source, grid)
        total = grid.n_rows * grid.n_cols
        count = reporter.counter("proving", total, np.dtype(job.info.dtype).itemsize)
        compare = partial(executor.map, comparison.all)
        shares = shares_in_turns(grid, whole)
        for share, error in proven_shares(path, shares, compare, kept):
            largest = max(largest, error)
            count(sum(_n_samples(grid, one) for one in share))
        count(total)  # what is void
    return measured_error(largest, job.quantizer)
