"""Measure peak memory on a large raster: ``python -m benchmarks.memory dem.tif``.

The raster is made by mirroring a small one. Making and compressing each run in a process of
their own; this one imports nothing large, because Linux counts the memory of a process at
the moment it starts another towards the *other's* peak.

Exit status: 0 good; 1 the command failed or took more than ``--limit-mib``; 2 wrong usage.
"""

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

# Rows written at a time: one row of tiles, or this many strips of one row.
CHUNK = 512


@dataclass(frozen=True)
class Usage:
    """What a process took."""

    seconds: float
    peak_mib: float
    status: int


@dataclass(frozen=True)
class Row:
    """One line of the CSV."""

    raster: str
    size: int
    layout: str
    max_error: float
    method: str
    threads: int
    raw_mib: float
    n_bytes: int
    peak_mib: float
    seconds: float
    msamples_s: float


def make_mirrored(source: Path, target: Path, size: int, layout: str) -> None:
    """Write a `size` x `size` raster that repeats `source`, every second time mirrored.

    Continuous everywhere, so that it compresses like real ground. Needs memory for the
    source and for `CHUNK` rows of the target.
    """
    import numpy as np
    import rasterio
    from rasterio.windows import Window

    with rasterio.open(source) as dataset:
        heights = dataset.read(1)
        profile = {"nodata": dataset.nodata, "crs": dataset.crs}
        profile |= {"transform": dataset.transform, "dtype": dataset.dtypes[0]}
    rows = _mirrored_indices(size, heights.shape[0])
    columns = _mirrored_indices(size, heights.shape[1])
    profile |= {"driver": "GTiff", "count": 1, "height": size, "width": size, "BIGTIFF": "IF_SAFER"}
    if layout == "tiled":
        profile |= {"tiled": True, "blockxsize": CHUNK, "blockysize": CHUNK}
    else:
        profile |= {"tiled": False, "blockysize": 1}
    with rasterio.Env(GDAL_CACHEMAX=64), rasterio.open(target, "w", **profile) as sink:
        for top in range(0, size, CHUNK):
            part = heights[np.ix_(rows[top : top + CHUNK], columns)]
            sink.write(part, 1, window=Window(0, top, size, part.shape[0]))


def _mirrored_indices(n: int, period: int):
    """Return 0, 1, ... period-1, period-2, ... 1, 0, 1, ...: `n` of them."""
    import numpy as np

    turn = max(1, 2 * (period - 1))
    position = np.arange(n) % turn
    return np.minimum(position, turn - position) % period


def run_and_measure(command: Sequence[str]) -> Usage:
    """Run `command`; return its time, its own peak resident memory and its status.

    The peak includes processes that the command itself has started and waited for.
    """
    start = time.perf_counter()
    process = subprocess.Popen(command)
    _pid, wait_status, resources = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(wait_status)
    # ru_maxrss is in KiB on Linux and in bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return Usage(seconds, resources.ru_maxrss * unit / 2**20, process.returncode)


def compress_command(options: argparse.Namespace, source: Path, target: Path) -> list[str]:
    """Return the command line that is measured."""
    main = "from terrainwave.cli import main; main()"
    command = [sys.executable, "-c", main, "compress", str(source), str(target)]
    command += ["--max-error", str(options.max_error), "--method", options.method]
    command += ["--threads", str(options.threads)]
    if not options.verify:
        command.append("--no-verify")
    return command + options.extra


def measure(options: argparse.Namespace, folder: Path) -> Row:
    """Make the raster, compress it, return the row."""
    source = folder / f"mirrored-{options.size}-{options.layout}.tif"
    target = folder / "mirrored.twz"
    if not source.exists():
        maker = [sys.executable, "-m", "benchmarks.memory", str(options.raster)]
        maker += ["--size", str(options.size), "--layout", options.layout]
        subprocess.run([*maker, "--make-only", str(source)], check=True)
    target.unlink(missing_ok=True)
    usage = run_and_measure(compress_command(options, source, target))
    if usage.status:
        raise SystemExit(f"terrainwave compress ended with status {usage.status}")
    return Row(
        raster=options.raster.stem,
        size=options.size,
        layout=options.layout,
        max_error=options.max_error,
        method=options.method,
        threads=options.threads,
        raw_mib=round(source.stat().st_size / 2**20, 1),
        n_bytes=target.stat().st_size,
        peak_mib=round(usage.peak_mib, 1),
        seconds=round(usage.seconds, 2),
        msamples_s=round(options.size**2 / usage.seconds / 1e6, 2),
    )


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line; what follows ``--`` goes to ``terrainwave compress``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.memory", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("raster", type=Path, help="the GeoTIFF that is mirrored")
    parser.add_argument("--size", type=int, default=16384, help="rows and columns (16384)")
    parser.add_argument("--layout", choices=("tiled", "striped"), default="tiled")
    parser.add_argument("--max-error", type=float, default=1.0)
    parser.add_argument("--method", default="auto")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--no-verify", dest="verify", action="store_false")
    parser.add_argument("--limit-mib", type=float, help="fail above this peak")
    parser.add_argument("--work-dir", type=Path, help="keep the raster and the file here")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/memory.csv"))
    parser.add_argument("--make-only", type=Path, metavar="TIF", help="only write the raster")
    own, extra = list(sys.argv[1:] if arguments is None else arguments), []
    if "--" in own:
        own, extra = own[: own.index("--")], own[own.index("--") + 1 :]
    options = parser.parse_args(own)
    options.extra = extra
    return options


def append_row(path: Path, row: Row) -> None:
    """Add the row to the CSV, with a heading if it is new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = asdict(row)
    is_new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(values), lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(values)


def write_machine(path: Path) -> None:
    """Describe the machine in a JSON beside the CSV; last, for it imports a lot."""
    import json

    from benchmarks.machine import describe_machine

    text = json.dumps(describe_machine(), indent=2) + "\n"
    path.with_suffix(".json").write_text(text, encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the measurement; return the exit status."""
    options = parse_options(arguments)
    if options.make_only:
        make_mirrored(options.raster, options.make_only, options.size, options.layout)
        return 0
    if not hasattr(os, "wait4"):
        print("benchmarks.memory needs os.wait4: Linux or macOS", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(dir=options.work_dir) as temporary:
        row = measure(options, options.work_dir or Path(temporary))
    append_row(options.out, row)
    write_machine(options.out)
    for name, value in asdict(row).items():
        print(f"{name:12} {value}")
    if options.limit_mib and row.peak_mib > options.limit_mib:
        print(f"peak above the limit of {options.limit_mib:g} MiB", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
