"""Files of lidar at bounds of millimetres: ``python -m benchmarks.lidar DIR/*lidar*.tif``.

`lidar.csv` has the bytes of files and of the same heights in a COG (LERC_ZSTD, overviews with the
same bound).
"""

from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import rasterio

from benchmarks import common
from benchmarks.rasters import write_pair

Row = namedtuple("Row", "raster max_error n_bytes bits_per_sample cog_bytes ratio")


def measure(paths: list[Path], bounds: tuple[float, ...], folder: Path) -> Iterator[Row]:
    """Yield the sizes of each raster within each bound."""
    for dem in paths:
        with rasterio.open(dem) as dataset:
            n_samples = dataset.width * dataset.height
        for bound in bounds:
            files = write_pair(dem, folder / "lidar", bound)
            n_bytes, n_cog = (path.stat().st_size for path in files.values())
            bits = round(8 * n_bytes / n_samples, 3)
            yield Row(dem.stem, bound, n_bytes, bits, n_cog, round(n_bytes / n_cog, 3))


@common.command("lidar.csv")
@common.rasters_argument
@common.bounds_option(0.001, 0.01)
def main(paths: list[Path], bounds: tuple[float, ...], folder: Path, out: Path) -> None:
    """Measure, print and write the CSV."""
    common.write_rows(out, measure(paths, bounds, folder))


if __name__ == "__main__":
    main()
