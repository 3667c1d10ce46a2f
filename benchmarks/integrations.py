"""Time xarray and Zarr beside the library itself: ``python -m benchmarks.integrations dem.tif``.

Both sides of a ratio take turns in one process on the same heights, so that they see the same
machine; the first round is discarded and medians are compared. Processor time of the process, all
threads. Files and stores are opened before the clock starts, anew each time, so that nothing
decoded is at hand.

Exit status: 0 good; 1 a bound was broken; 2 wrong usage.
"""

import csv
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np

from benchmarks.lists import ListCommand, ListOption
from benchmarks.machine import describe_machine

FIELDS = (
    "raster", "n_rows", "n_cols", "max_error", "what", "n_rounds", "direct_ms", "through_ms",
    "ratio", "direct_bytes", "through_bytes",
)  # fmt: skip
_SEED = 20261121
_CHUNK = 512


def take_turns(pairs: Callable[[], tuple[Callable, Callable]], n_rounds: int) -> tuple:
    """Return the median seconds of both functions of fresh pairs, and what they gave last."""
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(n_rounds + 1):
        results = []
        for times, run in zip(seconds, pairs()):
            start = time.process_time()
            results.append(run())
            times.append(time.process_time() - start)
    return (*(statistics.median(times[1:]) for times in seconds), *results)


def window_pairs(path: Path, side: int):
    """Return a function that gives two reads of one random window."""
    import xarray as xr

    import terrainwave

    places = np.random.default_rng(_SEED)

    def pair():
        terrain, dataset = terrainwave.open(path), xr.open_dataset(path)
        row, col = (int(places.integers(0, size - side + 1)) for size in terrain.shape)
        return (
            lambda: terrain.read((row, col, side, side)),
            lambda: dataset.heights[row : row + side, col : col + side].values,
        )

    return pair


def write_pairs(heights: np.ndarray, path: Path, chunks: tuple[int, int], max_error: float):
    """Return a function that gives `compress` to a file and a write to a new Zarr array."""
    import terrainwave

    def compress():
        terrainwave.compress(heights, path, max_error=max_error, mesh="none", overwrite=True)
        return path.stat().st_size

    def pair():
        array, store = zarr_array(heights, chunks, max_error)
        return compress, lambda: write(array, store, heights)

    return pair


def read_pairs(path: Path, array):
    """Return a function that gives reads of all heights of a file and of a Zarr array."""
    import terrainwave

    def pair():
        terrain = terrainwave.open(path)
        return terrain.read, lambda: array[...]

    return pair


def zarr_array(heights: np.ndarray, chunks: tuple[int, int], max_error: float):
    """Return an empty Zarr array in memory and its store."""
    import zarr

    from terrainwave.ext.zarr_codec import TerrainwaveCodec

    store = zarr.storage.MemoryStore()
    array = zarr.create_array(
        store, shape=heights.shape, dtype=heights.dtype, chunks=chunks, compressors=None,
        serializer=TerrainwaveCodec(max_error=max_error), fill_value=0,
    )  # fmt: skip
    return array, store


def write(array, store, heights: np.ndarray) -> int:
    """Write a Zarr array; return the bytes of its chunks."""
    array[...] = heights
    return sum(len(value) for name, value in store._store_dict.items() if name.startswith("c/"))


def measure(heights: np.ndarray, path: Path, max_error: float, n_rounds: int):
    """Yield (what, rounds, direct seconds, seconds through the library, bytes, bytes)."""
    for chunks in (heights.shape, (_CHUNK, _CHUNK)):
        name = "x".join(map(str, chunks))
        *seconds, n_direct, n_through = take_turns(
            write_pairs(heights, path, chunks, max_error), n_rounds
        )
        yield f"zarr write, chunks {name}", n_rounds, *seconds, n_direct, n_through
        array, store = zarr_array(heights, chunks, max_error)
        write(array, store, heights)
        *seconds, _, found = take_turns(read_pairs(path, array), n_rounds)
        if np.abs(found.astype(np.float64) - heights).max() > max_error:
            raise SystemExit(1)
        yield f"zarr read, chunks {name}", n_rounds, *seconds, n_direct, n_through
    for side in (512, 1024):
        *seconds, _, _ = take_turns(window_pairs(path, side), 3 * n_rounds)
        yield f"xarray window {side}", 3 * n_rounds, *seconds, "", ""


@click.command(cls=ListCommand)
@click.argument("rasters", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--size", type=int, default=2048, show_default=True, help="Rows and columns taken.")
@click.option("--max-error", "max_errors", cls=ListOption, type=float, default=(0.0, 1.0, 10.0))
@click.option("--rounds", "n_rounds", type=int, default=5, show_default=True)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/integrations.csv"),
    show_default=True,
)
def main(rasters, size, max_errors, n_rounds, out) -> None:
    """Write processor times through xarray and zarr beside the library's own to a CSV."""
    import rasterio

    with tempfile.TemporaryDirectory() as folder, out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FIELDS)
        for raster in rasters:
            with rasterio.open(raster) as dataset:
                heights = dataset.read(1)[:size, :size]
            # Chunks of 512 that reach past the edge would count for more than they hold.
            n_rows, n_cols = (length // _CHUNK * _CHUNK for length in heights.shape)
            heights = np.ascontiguousarray(heights[:n_rows, :n_cols])
            for max_error in max_errors:
                path = Path(folder) / "a.twz"
                for what, n, direct, through, *n_bytes in measure(
                    heights, path, max_error, n_rounds
                ):
                    row = (
                        raster.stem, *heights.shape, max_error, what, n, round(1e3 * direct, 1),
                        round(1e3 * through, 1), round(through / direct, 3), *n_bytes,
                    )  # fmt: skip
                    writer.writerow(row)
                    file.flush()
                    click.echo(",".join(map(str, row)))
    text = json.dumps(describe_machine(), indent=2) + "\n"
    out.with_suffix(".json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
