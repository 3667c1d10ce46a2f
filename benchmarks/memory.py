"""Measure peak memory on a large raster: ``python -m benchmarks.memory dem.tif``.

The raster is made by mirroring a small one. Making and compressing each run in a process of
their own; this one imports nothing large, because Linux counts the memory of a process at
the moment it starts another towards the *other's* peak. What follows ``--`` goes to
``terrainwave compress``. Rows are added to the CSV.

Exit status: 0 good; 1 the command failed; 2 wrong usage.
"""

import os
import subprocess
import sys
from collections import namedtuple

import click

from benchmarks import common

_MAKE = """
import sys
from pathlib import Path
from benchmarks.rasters import make_mirrored
make_mirrored(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
"""
_COMPRESS = "from terrainwave.cli import main; main()"

# One line of the CSV.
Row = namedtuple(
    "Row", "raster size layout max_error method threads raw_mib n_bytes peak_mib seconds msamples_s"
)


@common.command("memory.csv")
@common.dem_argument
@click.argument("extra", nargs=-1, type=click.UNPROCESSED)
@common.option("--size", type=common.COUNT, default=16384, help="Rows and columns.")
@common.option("--layout", type=click.Choice(("tiled", "striped")), default="tiled")
@common.option("--max-error", default=1.0)
@common.option("--method", default="auto")
@common.option("--threads", type=common.COUNT, default=2)
def main(dem, extra, size, layout, max_error, method, threads, folder, out) -> None:
    """Run the measurement."""
    if not hasattr(os, "wait4"):
        raise click.UsageError("needs os.wait4: Linux or macOS")
    source, target = folder / f"mirrored-{size}-{layout}.tif", folder / "mirrored.twz"
    if not source.exists():
        maker = [sys.executable, "-c", _MAKE, str(dem), str(source), str(size), layout]
        subprocess.run(maker, check=True)
    target.unlink(missing_ok=True)
    compress = [sys.executable, "-c", _COMPRESS, "compress", str(source), str(target)]
    compress += ["--max-error", str(max_error), "--method", method, "--threads", str(threads)]
    used = common.run_and_measure([*compress, *extra])
    row = Row(
        dem.stem, size, layout, max_error, method, threads,
        round(source.stat().st_size / 2**20, 1), target.stat().st_size, round(used.peak_mib, 1),
        round(used.seconds, 2), round(size**2 / used.seconds / 1e6, 2),
    )  # fmt: skip
    common.write_rows(out, [row], append=True)  # last, for it imports a lot


if __name__ == "__main__":
    main()
