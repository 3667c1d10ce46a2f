"""What voids cost: ``python -m benchmarks.voids dem.tif``.

VRTs of more and more samples, each with the same three tiles of `dem.tif`, of 1201 x 1201 samples
or what it has, are compressed (--max-error 1, one thread, with proof). `rate` is of the void
samples that a raster has more than the first one, by the processor time that it takes more.

Exit status: 0 good; 1 a command failed; 2 wrong usage.
"""

import sys
from collections import namedtuple
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from benchmarks import common

SIDES = (4096, 32768, 262144)
TILE = 1201

# One line of the CSV.
Row = namedtuple("Row", "side void_million seconds cpu_seconds rate peak_mib n_bytes")


def write_vrt(dem: Path, target: Path, side: int) -> int:
    """Write a VRT of three windows of `dem`; return how many samples they have."""
    import rasterio

    from benchmarks.rasters import vrt_source

    with rasterio.open(dem) as dataset:
        n_rows, n_cols = min(dataset.height, TILE), min(dataset.width, TILE)
        nodata, dtype = dataset.nodata, dataset.dtypes[0]
    nodata = -32768 if nodata is None else nodata
    places = ((100, 200), (side // 2, side // 3), (side - n_rows - 99, side - n_cols))
    sources = "".join(
        vrt_source(dem, (0, 0, n_rows, n_cols), row, col, nodata) for row, col in places
    )
    names = {"int16": "Int16", "float32": "Float32", "uint16": "UInt16"}
    target.write_text(
        f'<VRTDataset rasterXSize="{side}" rasterYSize="{side}"><VRTRasterBand band="1"'
        f' dataType="{names[dtype]}"><NoDataValue>{nodata}</NoDataValue>{sources}'
        "</VRTRasterBand></VRTDataset>"
    )
    return 3 * n_rows * n_cols


def measured(dem: Path, sides: Sequence[int], folder: Path) -> Iterator[Row]:
    """Yield a row for each side."""
    first: tuple[float, float] | None = None
    for side in sides:
        source, target = folder / f"{side}.vrt", folder / f"{side}.twz"
        void = (side**2 - write_vrt(dem, source, side)) / 1e6
        options = ["--max-error", "1", "--threads", "1", "--overwrite", "--quiet"]
        command = [sys.executable, "-c", common.CLI, "compress", str(source), str(target), *options]
        used = common.run_and_measure(command)
        first = first or (void, used.cpu_seconds)
        more = used.cpu_seconds - first[1]
        yield Row(
            side, round(void, 1), round(used.seconds, 2), round(used.cpu_seconds, 2),
            round((void - first[0]) / more, 1) if more > 0 else "", round(used.peak_mib, 1),
            target.stat().st_size,
        )  # fmt: skip


@common.command("scale_voids.csv")
@common.dem_argument
@common.option("--sides", cls=common.ListOption, type=click.IntRange(min=4096), default=SIDES)
def main(dem: Path, sides: list[int], folder: Path, out: Path) -> None:
    """Run the measurement."""
    common.write_rows(out, measured(dem.absolute(), sides, folder))


if __name__ == "__main__":
    main()
