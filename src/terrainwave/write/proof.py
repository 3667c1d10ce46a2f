"""Pass C: a finished file, decoded from disk, against the raster it was made of."""

import numpy as np

from terrainwave.errors import BoundViolationError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.write.pyramid import SourceWindows

OUR_FAULT = (
    "unless the raster changed while it was read, this is a fault of terrainwave: please report it"
    " with the raster. Nothing was written"
)
# Samples per side of the windows that are compared, where groups are smaller than that.
_PROOF_SIDE = 512


def proof_windows(grid: Grid, within: Region | None = None) -> list[Region]:
    """Return windows that cover the full grid, or the region `within`, once."""
    side = max(2 * grid.block, _PROOF_SIDE)
    return list((within or Region(0, 0, grid.n_rows, grid.n_cols)).tiles(side, side))


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
    errors = np.abs(decoded[valid].astype(np.float64) - raw[valid].astype(np.float64))
    largest = float(errors.max())
    if not largest <= allowed:  # a NaN is no height within the bound
        at = np.argwhere(valid)[int(errors.argmax())] + (region.row, region.col)
        raise BoundViolationError(
            f"the decoded height at row {at[0]}, column {at[1]} is {largest:g} off, more than"
            f" {allowed:g}; {OUR_FAULT}"
        )
    return largest


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
