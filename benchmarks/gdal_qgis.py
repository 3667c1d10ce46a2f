"""What a large file costs QGIS by the driver: ``python -m benchmarks.gdal_qgis DEM --plugin DIR``.

The raster is mirrored to 16384 x 16384 samples and compressed by `rapid`, once. QGIS's Python,
without a window, opens it as a layer, draws all of it, and then maps of 1200 x 800 pixels at full
resolution, each a third of its width further. Seconds on the wall, from the file's name to the
picture; each run is a process of its own.
"""

import json
import subprocess
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click

from benchmarks import common
from benchmarks.gdal_driver import SYSTEM_PYTHON, environment_of
from benchmarks.rasters import mirrored_file

SESSION = common.ROOT / "tests" / "gdal_driver" / "qgis_session.py"
Row = namedtuple("Row", "raster size qgis run opened_s first_picture_s first_pan_s median_pan_s")


def measure(path: Path, size: int, plugin: Path, n_runs: int, folder: Path) -> Iterator[Row]:
    """Yield a row of each run."""
    file = mirrored_file(path, size, folder, max_error=1, method="rapid", mesh="none")
    home = folder / "home"
    home.mkdir(mode=0o700, exist_ok=True)
    environment = environment_of(plugin) | {
        "HOME": str(home),
        "XDG_RUNTIME_DIR": str(home),
        "QT_QPA_PLATFORM": "offscreen",
        "PLACE": "[0, 0]",
    }
    for run in range(n_runs):
        command = [SYSTEM_PYTHON, SESSION, "", file, folder]
        ended = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False
        )
        if ended.returncode:
            raise click.ClickException(ended.stderr.strip()[-500:])
        found = json.loads(ended.stdout.splitlines()[-1])
        first, *others = found["pans"]
        times = found["opened"], found["first picture"], first, sorted(others)[len(others) // 2]
        yield Row(path.stem, size, found["version"], run, *(round(one, 3) for one in times))


@common.command("gdal_qgis.csv")
@click.argument("dem", type=common.FILE)
@click.option("--plugin", type=common.FILE, required=True, help="The folder with gdal_TWZ.so.")
@common.option("--size", type=common.COUNT, default=16384)
@common.option("--runs", type=common.COUNT, default=5)
def main(dem, plugin, size, runs, folder, out) -> None:
    """Measure QGIS."""
    common.write_rows(out, measure(dem, size, plugin, runs, folder))


if __name__ == "__main__":
    main()
