"""Pass C: a finished file, decoded from disk, against the raster it was made of."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from terrainwave.container.targets.kept import Kept, digest_of_file
from terrainwave.errors import BoundViolationError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.grid.shares import shares_of
from terrainwave.progress import Reporter
from terrainwave.write.job import Job
from terrainwave.write.pyramid import SourceWindows

OUR_FAULT = (
    "unless the raster changed while it was read, this is a fault of terrainwave: please report it"
    " with the raster. Nothing was written"
)
# Samples per side of the windows that are compared, where groups are smaller than that.
_PROOF_SIDE = 512
_CACHE_BYTES = 64 << 20


def proof_windows(grid: Grid, within: Region | None = None) -> list[Region]:
    """Return windows that cover the full grid, or the region `within`, once."""
    side = _side_of(grid)
    return list((within or Region(0, 0, grid.n_rows, grid.n_cols)).tiles(side, side))


def proof_shares(grid: Grid) -> list[list[Region]]:
    """Return `proof_windows` in shares for threads, which decode the levels above them."""
    side = _side_of(grid)
    return shares_of(proof_windows(grid), lambda window: (window.row // side, window.col // side))


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


def proven_shares(
    path: str | os.PathLike[str] | bytes,
    shares: list[list[Region]],
    compare: Callable[[list[list[Region]]], Iterable[float]],
    kept: Kept,
) -> Iterator[float]:
    """Yield the errors of shares of a file, those that are kept for its bytes first.

    `compare` makes the others, in order.
    """
    if not kept.is_on or isinstance(path, bytes):
        yield from compare(shares)
        return
    name = f"proof/{digest_of_file(path)}"
    errors: list[float] = (kept.get(name) or {}).get("errors", [])
    yield from list(errors)
    for error in compare(shares[len(errors) :]):
        errors.append(error)
        yield error
        kept.tick(name, lambda: {"errors": errors})


def prove(
    path: str | os.PathLike[str] | bytes,
    job: Job,
    source: SourceWindows,
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
    shares = proof_shares(grid)
    allowed = allowed_error(job.quantizer, job.raw_bound, job.effective_error)
    largest = 0.0
    with TerrainFile(path, threads=1, cache_bytes=_CACHE_BYTES, native=False) as terrain:

        def compare(share: list[Region]) -> float:
            return max(compare_window(terrain, source, region, allowed) for region in share)

        done = 0
        errors = proven_shares(path, shares, partial(executor.map, compare), kept)
        for share, error in zip(shares, errors, strict=True):
            largest = max(largest, error)
            done += sum(region.n_rows * region.n_cols for region in share)
            n_bytes = done * np.dtype(job.info.dtype).itemsize
            reporter.report("proving", done, grid.n_rows * grid.n_cols, n_bytes)
    return measured_error(largest, job.quantizer)
