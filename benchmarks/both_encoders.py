"""Random rasters, encoded by numba and in C: ``python -m benchmarks.both_encoders``.

Each raster is drawn by its number: any type, voids, steps, offsets, NaN, infinities and subnormal
numbers, limits of types, from 1 x 1 to ``--most``. Both files must have the same bytes; the one of
the library has been proved by decoding it. Exit status 1: some differ. `date` is that of the run.
"""

import datetime
import hashlib
import sys
import warnings
from collections import namedtuple
from pathlib import Path
from typing import Any
from unittest.mock import patch

import click
import numpy as np

import terrainwave
from benchmarks import common
from terrainwave.coding import native_library

DTYPES = ("uint8", "int16", "uint16", "int32", "float32", "float64")
Drawn = namedtuple("Drawn", "heights options")
Row = namedtuple(
    "Row", "date number n_rows n_cols dtype max_error void_share n_bytes sha256 is_same outcome"
)


def side_of(rng: np.random.Generator, most: int) -> int:
    """Return a number of rows or columns; small ones as often as large ones."""
    return max(int(np.exp(rng.uniform(0, np.log(most + 0.99)))), 1)


def drawn_raster(number: int, most: tuple[int, int]) -> Drawn:
    """Return a raster of at most so many rows and columns, and options of `compress`."""
    rng = np.random.default_rng([5454, number])
    shape = tuple(side_of(rng, n) for n in most)
    dtype = np.dtype(rng.choice(DTYPES))
    limits: Any = np.iinfo(dtype) if dtype.kind in "iu" else np.finfo(dtype)
    relief = float(10 ** rng.uniform(0, min(np.log10(float(limits.max)), 5.0)))
    heights = relief * _shape_of_ground(rng, shape)
    heights += float(rng.choice([0.0, 0.0, relief, -relief, 100_000.0]))
    options: dict[str, Any] = {"max_error": float(rng.choice([0, 1, 1, 2.5, 10, relief / 50]))}
    if dtype.kind == "f" and rng.random() < 0.5:
        heights = np.rint(heights * 100) / 100
        options["max_error"] = float(rng.choice([0.01, 0.5, relief / 100]))
    options["max_error"] = max(options["max_error"], 0 if dtype.kind in "iu" else relief / 1e6)
    with np.errstate(all="ignore"):
        heights = np.clip(heights, float(limits.min), float(limits.max)).astype(dtype)
    if rng.random() < 0.5:
        _make_voids(rng, heights, options)
    if rng.random() < 0.1 and dtype.kind in "iu" and dtype.itemsize < 4:
        heights[rng.random(shape) < 0.01] = limits.min
        heights[rng.random(shape) < 0.01] = limits.max
    if rng.random() < 0.2 and dtype.kind == "f":
        heights[rng.random(shape) < 0.1] = rng.choice([limits.smallest_subnormal, -0.0])
    return Drawn(heights, options | {"block": int(rng.choice([64, 128, 256, 256]))})


def _shape_of_ground(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return heights of about 1: hills, noise, steps, or one height."""
    kind = rng.integers(0, 5)
    if kind == 0:
        return np.full(shape, rng.normal())
    noise = rng.normal(size=shape)
    if kind == 1:
        return noise
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    waves = rng.uniform(4, 60, 2)
    hills = np.sin(rows / waves[0]) * np.cos(cols / waves[1]) + 10 ** rng.uniform(-4, -1) * noise
    return np.round(hills, 1) if kind == 2 else hills


def _make_voids(rng: np.random.Generator, heights: np.ndarray, options: dict[str, Any]) -> None:
    """Make samples void: scattered ones, or areas; by NaN, infinities, or a number."""
    is_void = rng.random(heights.shape) < rng.choice([0.001, 0.1, 0.9])
    if rng.random() < 0.7:
        rows, cols = np.mgrid[: heights.shape[0], : heights.shape[1]]
        wave = rng.uniform(5, 80)
        is_void = np.sin(rows / wave) + np.cos(cols / wave) > rng.uniform(-1.5, 1.5)
    if heights.dtype.kind == "f":
        heights[is_void] = np.nan
        if rng.random() < 0.3:
            options["nodata"] = float(rng.choice([np.inf, -np.inf]))
            heights[is_void & (rng.random(heights.shape) < 0.5)] = options["nodata"]
        return
    options["nodata"] = int(np.iinfo(heights.dtype).min)
    heights[is_void] = options["nodata"]


def compressed(drawn: Drawn, *, in_c: bool) -> bytes | str:
    """Return a file's bytes, proved by the same kernels, or why there is none."""
    try:
        with patch.object(native_library, "is_used", lambda: in_c), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return terrainwave.compress_to_bytes(drawn.heights, threads=1, **drawn.options)
    except terrainwave.TerrainwaveError as error:
        return f"{type(error).__name__}: {error}"


def compare(number: int, most: tuple[int, int]) -> Row:
    """Compress a raster by both."""
    drawn = drawn_raster(number, most)
    in_c = compressed(drawn, in_c=True)
    by_numba = compressed(drawn, in_c=False)
    data = in_c if isinstance(in_c, bytes) else b""
    n_rows, n_cols = drawn.heights.shape
    void = ~np.isfinite(drawn.heights) | (drawn.heights == drawn.options.get("nodata", np.nan))
    return Row(
        datetime.datetime.now(datetime.UTC).date().isoformat(), number, n_rows, n_cols,
        drawn.heights.dtype.name, drawn.options["max_error"], round(float(void.mean()), 4),
        len(data), hashlib.sha256(data).hexdigest()[:16], in_c == by_numba,
        "" if data else in_c,
    )  # fmt: skip


@common.command("both_encoders.csv")
@common.option("--count", type=common.COUNT, default=500)
@common.option("--most", default="3000x2000", help="Rows and columns of the largest raster.")
def main(count: int, most: str, folder: Path, out: Path) -> None:
    """Compare, print, and write the CSV."""
    if native_library.loaded() is None:
        raise click.UsageError("found no native library: terrainwave doctor says why")
    n_rows, n_cols = (int(part) for part in most.split("x"))
    rows = (compare(number, (n_rows, n_cols)) for number in range(count))
    differing = [row.number for row in common.write_rows(out, rows) if not row.is_same]
    if differing:
        print(f"{len(differing)} files differ: rasters {differing}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
