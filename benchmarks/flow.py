"""What keeping flow directions costs: ``python -m benchmarks.flow dem.tif ...``.

D8 without filling: water goes to the neighbour with the steepest drop, the first clockwise from
north of equal ones; a sample without a drop is flat if a neighbour is as high, else a pit. A lossy
file changes some directions. Two ways bring all of them back, and all pits, within the bound:

* ``repaired``: where a direction differs, the sample and its neighbours get their original heights;
  again, until none differs.
* ``ahead``: samples whose direction a bound of this size could change get their original heights,
  and so do their neighbours, as a coder with finer steps there would do it.

The differences that this takes are coded by LZMA beside the file. ``pysheds``, if installed,
computes the directions of the result by its own code.
"""

import lzma
from collections import namedtuple
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray

import terrainwave
from benchmarks import common

# Clockwise from north.
STEPS = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
FLAT, PIT = -1, -2
Row = namedtuple(
    "Row", "raster max_error lossless_bytes lossy_bytes flow_changed pits_before pits_after"
    " repaired_bytes n_repaired rounds ahead_bytes n_ahead agrees",
)  # fmt: skip
Heights = NDArray[np.float64]


def drops(heights: Heights, cell: tuple[float, float]) -> Heights:
    """Return the slopes to the eight neighbours: shape (8, n_rows, n_cols); -inf beyond edges."""
    height, width = cell
    around = np.pad(heights, 1, constant_values=np.nan)
    found = np.full((8, *heights.shape), -np.inf)
    for k, (down, right) in enumerate(STEPS):
        n_rows, n_cols = heights.shape
        other = around[1 + down : 1 + down + n_rows, 1 + right : 1 + right + n_cols]
        slope = (heights - other) / np.hypot(down * height, right * width)
        found[k] = np.where(np.isnan(slope), -np.inf, slope)
    return found


def directions(heights: Heights, cell: tuple[float, float]) -> NDArray[np.int8]:
    """Return the number of the steepest neighbour, `FLAT` or `PIT`."""
    slopes = drops(heights, cell)
    most = slopes.max(0)
    found = slopes.argmax(0).astype(np.int8)
    found[most == 0] = FLAT
    found[most < 0] = PIT
    return found


def near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return samples of a mask and their neighbours."""
    around, found = np.pad(mask, 1), mask.copy()
    n_rows, n_cols = mask.shape
    for down, right in STEPS:
        found |= around[1 + down : 1 + down + n_rows, 1 + right : 1 + right + n_cols]
    return found


def repaired(
    original: Heights, decoded: Heights, cell: tuple[float, float]
) -> tuple[NDArray[np.bool_], int]:
    """Return which samples get their original heights, and after how many rounds."""
    wanted, exact = directions(original, cell), np.zeros(original.shape, bool)
    for n_rounds in range(1000):
        differ = directions(np.where(exact, original, decoded), cell) != wanted
        if not differ.any():
            return exact, n_rounds
        exact |= near(differ)
    raise AssertionError("directions still differ after 1000 rounds")


def uncertain(original: Heights, bound: float, cell: tuple[float, float]) -> NDArray[np.bool_]:
    """Return samples whose direction may change if all heights move by up to a bound."""
    slopes, (height, width) = drops(original, cell), cell
    reach = [2 * bound / np.hypot(down * height, right * width) for down, right in STEPS]
    least = np.max([slope - far for slope, far in zip(slopes, reach, strict=True)], axis=0)
    n_rivals = sum(
        (slope + far >= least).astype(int) for slope, far in zip(slopes, reach, strict=True)
    )
    return near((n_rivals > 1) | (least <= 0))


def coded(original: Heights, decoded: Heights, exact: NDArray[np.bool_]) -> int:
    """Return the bytes of the differences of some samples."""
    apart = np.where(exact, original - decoded, 0).astype(np.int16)
    return len(lzma.compress(apart.tobytes(), preset=6))


def agrees(original: Heights, result: Heights, cell: tuple[float, float]) -> str:
    """Say whether an independent program finds the same directions; "" if it is missing."""
    try:
        from pysheds._sgrid import _d8_flowdir_numba
    except ImportError:
        return ""
    valid = ~np.isnan(original)
    found = [
        _d8_flowdir_numba(
            np.nan_to_num(heights), cell[1], cell[0], (1, 2, 3, 4, 5, 6, 7, 8), ~valid, 0, FLAT, PIT
        )
        for heights in (original, result)
    ]
    return str(bool(np.array_equal(*found)))


def row_of(dem: Path, bound: float) -> Row:
    """Return the costs of a raster and a bound."""
    with rasterio.open(dem) as dataset:
        heights = dataset.read(1, masked=True).astype(np.float64).filled(np.nan)
        width, height = dataset.res
        if dataset.crs is None or dataset.crs.is_geographic:
            middle = np.deg2rad((dataset.bounds.top + dataset.bounds.bottom) / 2)
            height, width = 111_320 * height, 111_320 * width * np.cos(middle)
    cell = float(height), float(width)
    lossless = len(terrainwave.compress_to_bytes(dem, max_error=0, threads=1))
    data = terrainwave.compress_to_bytes(dem, max_error=bound, threads=1)
    with terrainwave.open(data) as terrain:
        decoded = terrain.read(masked=True).astype(np.float64).filled(np.nan)
    before, after = directions(heights, cell), directions(decoded, cell)
    valid = ~np.isnan(heights)
    exact, n_rounds = repaired(heights, decoded, cell)
    ahead = uncertain(heights, bound, cell) & valid
    result = np.where(exact, heights, decoded)
    assert np.array_equal(directions(np.where(ahead, heights, decoded), cell), before)
    return Row(
        dem.stem, bound, lossless, len(data),
        round(100 * float((before != after)[valid].mean()), 2),
        int((before == PIT)[valid].sum()), int((after == PIT)[valid].sum()),
        len(data) + coded(heights, decoded, exact & valid), int((exact & valid).sum()), n_rounds,
        len(data) + coded(heights, decoded, ahead), int(ahead.sum()),
        agrees(heights, result, cell),
    )  # fmt: skip


@common.command("flow.csv")
@common.rasters_argument
@common.bounds_option(1.0, 3.0, 10.0)
def main(paths: list[Path], bounds: tuple[float, ...], folder: Path, out: Path) -> None:
    """Measure, print and write the CSV."""
    common.write_rows(out, [row_of(dem, bound) for dem in paths for bound in bounds])


if __name__ == "__main__":
    main()
