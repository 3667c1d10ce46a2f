"""COGs by other releases of GDAL: ``python -m benchmarks.gdals DEM --python COMMAND …``.

Each COMMAND is a Python with rasterio of another GDAL: ``/usr/bin/python3``, or, in a folder of
another system, ``chroot FOLDER python3``, where the files of ``--work`` are at the same place. They
make a COG (LERC_ZSTD) and read it in turns with the rasterio of this Python; each process warms up
once.
"""

import json
import shlex
import statistics
import subprocess
import sys
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks import common
from benchmarks.rasters import largest_error, load_raster, write_geotiff

# Times are medians of processor time; the error is the largest of all valid heights.
Row = namedtuple("Row", "gdal raster max_error n_bytes error write_ms read_ms n_runs")
# For a Python with nothing but rasterio: versions, then what each call took.
SCRIPT = """
import json, sys, time
import rasterio, rasterio.shutil
source, target, bound, dump = sys.argv[1:]
took = []
for _ in range(2):
    start = time.process_time()
    rasterio.shutil.copy(source, target, driver="COG", COMPRESS="LERC_ZSTD", MAX_Z_ERROR=bound,
                         MAX_Z_ERROR_OVERVIEW=bound, BLOCKSIZE="512", OVERVIEWS="AUTO")
    middle = time.process_time()
    with rasterio.open(target) as dataset:
        heights = dataset.read(1)
    took = [1000 * (middle - start), 1000 * (time.process_time() - middle)]
heights.tofile(dump)
print(json.dumps([rasterio.__gdal_version__, *took]))
"""


def measure(
    paths: list[Path],
    bounds: tuple[float, ...],
    pythons: list[list[str]],
    n_runs: int,
    folder: Path,
) -> Iterator[Row]:
    """Yield the row of each raster, bound and GDAL."""
    source, target, dump = (folder / name for name in ("gdals.tif", "gdals-cog.tif", "gdals.raw"))
    for path in paths:
        raster = load_raster(path)
        write_geotiff(raster, source)
        for bound in bounds:
            found: dict[str, list] = {}
            for _ in range(n_runs):
                for python in pythons:
                    given = map(str, (source, target, bound, dump))
                    command = [*python, "-c", SCRIPT, *given]
                    gdal, *took = json.loads(subprocess.check_output(command, text=True))
                    decoded = np.fromfile(dump, raster.heights.dtype).reshape(raster.heights.shape)
                    error = largest_error(raster.heights, decoded, raster.mask)
                    found.setdefault(gdal, []).append((target.stat().st_size, error, *took))
            for gdal, runs in found.items():
                n_bytes, error, *took = map(statistics.median, zip(*runs, strict=True))
                times = (round(one, 1) for one in took)
                yield Row(gdal, path.stem, bound, int(n_bytes), round(error, 4), *times, n_runs)


@common.command("gdals.csv")
@common.rasters_argument
@common.bounds_option(1.0)
@common.option("--python", "commands", cls=common.ListOption, help="Of another GDAL.")
@common.option("--runs", type=common.COUNT, default=5)
def main(paths, bounds, commands, runs, folder, out) -> None:
    """Measure, print and write the CSV."""
    common.pin_to_cores()
    pythons = [[sys.executable], *map(shlex.split, commands)]
    common.write_rows(out, measure(paths, bounds, pythons, runs, folder))


if __name__ == "__main__":
    main()
