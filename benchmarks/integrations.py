"""Zarr and xarray beside what their users have: ``python -m benchmarks.integrations dem.tif …``.

Into ``zarr_codecs.csv``: an array in chunks of 512 x 512 written to a store in memory and read
back, by our codec and by what numcodecs has within the same bound: heights in steps of
2 * max_error + 1 (`FixedScaleOffset`) by PCodec, or by Blosc's zstd with shuffling, and ZFPY with a
fixed accuracy, of float32. Rasters are of whole numbers without voids, which the others have no
mark for. Bounds are checked off the clock.

Into ``xarray_windows.csv``: windows of a file just opened, by `xr.open_dataset` of ours and by
`rioxarray.open_rasterio` of a COG (LERC_ZSTD, blocks of 512, overviews, the same bound) that GDAL
makes of the same raster.

Processor time by one thread on one core, in turns, a first round discarded.
"""

import warnings
from collections import namedtuple
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np
import rasterio
import rioxarray
import xarray as xr
from zarr.codecs.numcodecs import ZFPY, FixedScaleOffset, PCodec

import zarr
from benchmarks import common
from benchmarks.rasters import load_raster, write_geotiff, write_pair
from benchmarks.windows import corners, times_of
from terrainwave.ext.zarr_codec import TerrainwaveCodec
from zarr.codecs import BloscCodec

_CHUNK, SIDE = 512, 512

# Lines of the CSVs; milliseconds: medians, and the most.
ZarrRow = namedtuple(
    "ZarrRow",
    "raster n_rows n_cols max_error codec n_bytes error n_rounds write_ms write_most_ms read_ms "
    "read_most_ms",
)
WindowRow = namedtuple("WindowRow", "raster max_error window n_windows reader ms most_ms")


def zarr_codecs(dtype: np.dtype, max_error: float) -> dict[str, dict[str, Any]]:
    """Return what `zarr.create_array` is given for each codec."""
    # A little less than one over the step: numcodecs cuts off what it decodes.
    scale = float(np.nextafter(1 / (2 * max_error + 1), 0))
    steps = FixedScaleOffset(offset=0, scale=scale, dtype=dtype.str, astype=dtype.str)
    filters = {"filters": [steps]} if max_error else {}
    blosc = BloscCodec(cname="zstd", clevel=5, shuffle="shuffle", typesize=dtype.itemsize)
    codecs: dict[str, dict[str, Any]] = {
        "terrainwave": {"serializer": TerrainwaveCodec(max_error=max_error), "compressors": None},
        "steps, pcodec": filters | {"serializer": PCodec(), "compressors": None},
        "steps, blosc zstd": filters | {"compressors": [blosc]},
    }
    if max_error:
        zfp = ZFPY(mode=4, tolerance=max_error)  # 4: fixed accuracy
        codecs["zfpy"] = {"serializer": zfp, "compressors": None, "dtype": np.dtype("float32")}
    return codecs


def fresh_array(options: dict[str, Any], heights: np.ndarray) -> zarr.Array:
    """Return an empty array in memory."""
    given = {"dtype": heights.dtype, "fill_value": 0, "chunks": (_CHUNK, _CHUNK)} | options
    return zarr.create_array(zarr.storage.MemoryStore(), shape=heights.shape, **given)


def write(array: zarr.Array, heights: np.ndarray) -> None:
    """Write a whole array."""
    array[...] = heights


def zarr_rows(name: str, heights: np.ndarray, max_error: float, n_rounds: int) -> Iterator[ZarrRow]:
    """Yield the rows of a raster at a bound."""
    codecs = zarr_codecs(heights.dtype, max_error)
    given = {codec: heights.astype(of.get("dtype", heights.dtype)) for codec, of in codecs.items()}
    arrays: dict[str, zarr.Array] = {}

    def tasks() -> list[Callable[[], Any]]:
        arrays.update({codec: fresh_array(of, heights) for codec, of in codecs.items()})
        writers = [partial(write, arrays[codec], given[codec]) for codec in codecs]
        return writers + [partial(arrays[codec].__getitem__, ...) for codec in codecs]

    common.take_turns(tasks, 1)
    times = common.take_turns(tasks, n_rounds)
    for codec, written, read in zip(codecs, times[: len(codecs)], times[len(codecs) :]):
        error = float(np.abs(read.result.astype(np.float64) - heights).max())
        if error > max_error:
            raise click.ClickException(f"{name}: {codec} is off by {error}, not {max_error}")
        yield ZarrRow(
            name, *heights.shape, max_error, codec, arrays[codec].nbytes_stored(), error, n_rounds,
            *(round(1000 * ms, 1) for of in (written, read) for ms in (of.seconds, of.most)),
        )  # fmt: skip


def whole_chunks(heights: np.ndarray) -> np.ndarray:
    """Cut off chunks that reach past the edge: they would count for more than they hold."""
    n_rows, n_cols = (length // _CHUNK * _CHUNK for length in heights.shape)
    return np.ascontiguousarray(heights[:n_rows, :n_cols])


def window_of_ours(path: Path, place: tuple[slice, slice]) -> np.ndarray:
    """Open a file of ours as xarray, load a window, close it."""
    with xr.open_dataset(path) as dataset:
        return dataset.heights[place].values


def window_of_cog(path: Path, place: tuple[slice, slice]) -> np.ndarray:
    """Open a COG as xarray, load a window, close it."""
    with rioxarray.open_rasterio(path) as array:
        return array[0][place].values


READERS = {"terrainwave": window_of_ours, "cog": window_of_cog}


def window_rows(
    source: Path, name: str, max_error: float, n_windows: int, folder: Path
) -> Iterator[WindowRow]:
    """Yield a row of each reader."""
    files = write_pair(source, folder / "xarray", max_error)
    with rasterio.open(source) as dataset:
        heights = dataset.read(1).astype(np.float64)
    places = [
        (slice(row, row + SIDE), slice(col, col + SIDE))
        for row, col in corners(heights.shape, SIDE, "any", n_windows)
    ]
    for reader, found in times_of(READERS, files, places).items():
        last = READERS[reader](files[reader], places[-1])
        if np.abs(last - heights[places[-1]]).max() > max_error:
            raise click.ClickException(f"{name}: {reader} broke the bound of {max_error}")
        numbers = round(median(found), 2), round(found[-1], 2)
        yield WindowRow(name, max_error, SIDE, n_windows, reader, *numbers)


@common.command("zarr_codecs.csv")
@common.rasters_argument
@common.option("--size", type=common.COUNT, default=2048, help="Rows and columns taken, at most.")
@common.bounds_option(0.0, 1.0, 10.0)
@common.option("--rounds", "n_rounds", type=common.COUNT, default=5)
@common.option("--windows", "n_windows", type=common.COUNT, default=20)
def main(paths, size, bounds, n_rounds, n_windows, folder, out) -> None:
    """Write the CSVs."""
    warnings.filterwarnings("ignore", message="Numcodecs codecs are not in the Zarr version 3")
    common.pin_to_cores()
    zarr.config.set({"threading.max_workers": 1, "async.concurrency": 1})
    sources = {}
    for path in paths:
        raster = load_raster(path, size)
        if not raster.is_integer or not raster.mask.all():
            raise click.UsageError(f"{path.name} has fractions or voids: name others")
        sources[path.stem] = folder / path.name
        write_geotiff(raster, sources[path.stem])

    cases = [(name, source, bound) for name, source in sources.items() for bound in bounds]
    arrays = (
        row
        for name, source, bound in cases
        for row in zarr_rows(name, whole_chunks(load_raster(source).heights), bound, n_rounds)
    )
    common.write_rows(out, arrays)
    with rasterio.Env():  # made once, as rasterio advises, not for each file
        windows = (
            row
            for name, source, bound in cases
            for row in window_rows(source, name, bound, n_windows, folder)
        )
        common.write_rows(out.with_name("xarray_windows.csv"), windows)


if __name__ == "__main__":
    main()
