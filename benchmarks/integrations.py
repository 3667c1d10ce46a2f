"""Time xarray and Zarr beside the library itself: ``python -m benchmarks.integrations dem.tif``.

Both sides of a ratio take turns in one process on the same heights; a first round is discarded and
medians are compared. Processor time of the process, all threads. Files and stores are opened before
the clock starts, anew each time, so that nothing decoded is at hand.

Exit status: 0 good; 1 a bound was broken; 2 wrong usage.
"""

from collections import namedtuple
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
import zarr

import terrainwave
from benchmarks import common
from benchmarks.rasters import load_raster
from terrainwave.ext.zarr_codec import TerrainwaveCodec

_SEED = 20261121
_CHUNK = 512

# One line of the CSV.
Row = namedtuple(
    "Row",
    "raster n_rows n_cols max_error what n_rounds direct_ms through_ms ratio direct_bytes "
    "through_bytes",
    defaults=("", ""),
)


def compare(head: tuple, n_rounds: int, pairs) -> tuple[Row, list]:
    """Return a row without bytes, and what both functions of the last pair gave."""
    common.take_turns(pairs, 1)  # compiles
    times = common.take_turns(pairs, n_rounds)
    direct, through = (timed.seconds for timed in times)
    ratio = round(through / direct, 3)
    row = Row(*head, n_rounds, round(1e3 * direct, 1), round(1e3 * through, 1), ratio)
    return row, [timed.result for timed in times]


def measure(
    name: str, heights: np.ndarray, path: Path, max_error: float, n_rounds: int
) -> Iterator[Row]:
    """Yield the rows of a raster at a bound."""
    head = (name, *heights.shape, max_error)

    def compress() -> int:
        terrainwave.compress(heights, path, max_error=max_error, mesh="none", overwrite=True)
        return path.stat().st_size

    def write(store, array) -> int:
        array[...] = heights
        return sum(len(part) for key, part in store._store_dict.items() if key.startswith("c/"))

    for chunks in (heights.shape, (_CHUNK, _CHUNK)):

        def fresh(chunks=chunks):
            store = zarr.storage.MemoryStore()
            return store, zarr.create_array(
                store, shape=heights.shape, dtype=heights.dtype, chunks=chunks, compressors=None,
                serializer=TerrainwaveCodec(max_error=max_error), fill_value=0,
            )  # fmt: skip

        words = "chunks " + "x".join(map(str, chunks))
        pairs = lambda fresh=fresh: (compress, partial(write, *fresh()))  # noqa: E731
        row, n_bytes = compare((*head, f"zarr write, {words}"), n_rounds, pairs)
        yield row._replace(direct_bytes=n_bytes[0], through_bytes=n_bytes[1])
        store, array = fresh()
        write(store, array)
        pairs = lambda array=array: (terrainwave.open(path).read, lambda: array[...])  # noqa: E731
        row, (_, found) = compare((*head, f"zarr read, {words}"), n_rounds, pairs)
        if np.abs(found.astype(np.float64) - heights).max() > max_error:
            raise SystemExit(1)
        yield row._replace(direct_bytes=n_bytes[0], through_bytes=n_bytes[1])
    for side in [side for side in (512, 1024) if side <= min(heights.shape)]:
        places = np.random.default_rng(_SEED)

        def readers(side=side, places=places):
            terrain, dataset = terrainwave.open(path), xr.open_dataset(path)
            row, col = (int(places.integers(0, size - side + 1)) for size in terrain.shape)
            window = slice(row, row + side), slice(col, col + side)
            return (
                lambda: terrain.read((row, col, side, side)),
                lambda: dataset.heights[window].values,
            )

        yield compare((*head, f"xarray window {side}"), 3 * n_rounds, readers)[0]


@common.command("integrations.csv")
@common.rasters_argument
@common.option(
    "--size", type=common.COUNT, default=2048, help="Rows and columns taken, in chunks of 512."
)
@common.bounds_option(0.0, 1.0, 10.0)
@common.option("--rounds", "n_rounds", type=common.COUNT, default=5)
def main(paths, size, bounds, n_rounds, folder, out) -> None:
    """Write processor times through xarray and zarr beside the library's own to a CSV."""

    def rows() -> Iterator[Row]:
        for path in paths:
            heights = load_raster(path, size).heights
            # Chunks of 512 that reach past the edge would count for more than they hold.
            n_rows, n_cols = (length // _CHUNK * _CHUNK for length in heights.shape)
            heights = np.ascontiguousarray(heights[:n_rows, :n_cols])
            for max_error in bounds:
                yield from measure(path.stem, heights, folder / "a.twz", max_error, n_rounds)

    common.write_rows(out, rows())


if __name__ == "__main__":
    main()
