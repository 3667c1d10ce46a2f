"""Compress, verify and read every raster at many bounds: ``python -m benchmarks.matrix DIR``.

Each result is read back and compared with rasterio and numpy alone: every valid sample, the
mask, dtype, shape, transform and CRS. Exit status: 0 good; 1 any violation; 2 wrong usage.
"""

import math
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

import terrainwave
from benchmarks.lists import ListCommand, ListOption
from benchmarks.measure import compare
from benchmarks.rasters import Raster, find_rasters, load_raster, write_geotiff
from benchmarks.report import CsvSink

BOUNDS = (0.5, 1.0, 3.0, 10.0)
BOUNDS_OF_FLOATS = (0.1, 0.5)


@dataclass(frozen=True)
class Case:
    """What is tried."""

    raster: Raster
    source: Path
    max_error: float
    block: int
    method: str


@dataclass(frozen=True)
class Row:
    """One line of the CSV; `problem` is empty where all is well."""

    raster: str
    n_rows: int
    n_cols: int
    dtype: str
    max_error: float
    block: int
    method: str
    n_bytes: int | None = None
    bits_per_sample: float | None = None
    measured_error: float | None = None
    compress_s: float | None = None
    read_s: float | None = None
    problem: str = ""


def bounds_for(raster: Raster) -> list[float]:
    """Return the bounds to try: 0 only where the heights lie on a grid."""
    bounds = set(BOUNDS)
    if raster.quantum:
        bounds.add(0.0)
    if not raster.is_integer:
        bounds.update(BOUNDS_OF_FLOATS)
    return sorted(bounds)


def make_cases(
    paths: list[Path], blocks: list[int], methods: list[str], crop: int | None, folder: Path
) -> Iterator[Case]:
    """Yield all cases, raster by raster; a cropped raster is written to `folder`."""
    for path in paths:
        raster = load_raster(path, crop)
        source = path
        if crop:
            source = folder / path.name
            write_geotiff(raster, source)
        for method in methods:
            for max_error in bounds_for(raster):
                for block in blocks:
                    yield Case(raster, source, max_error, block, method)


def run_case(case: Case, folder: Path, *, with_geotiff: bool, strict: bool) -> Row:
    """Compress, read and compare one case; whatever is raised becomes a row."""
    n_rows, n_cols = case.raster.heights.shape
    head = {
        "raster": case.raster.name,
        "n_rows": n_rows,
        "n_cols": n_cols,
        "dtype": case.raster.heights.dtype.name,
        "max_error": case.max_error,
        "block": case.block,
        "method": case.method,
    }
    target = folder / "matrix.twz"
    try:
        compress_s = _seconds(_compress, case, target)
        start = time.perf_counter()
        with terrainwave.open(target) as terrain:
            decoded = terrain.read()
        read_s = time.perf_counter() - start
        errors = compare(case.raster, decoded, case.max_error, check_voids=True)
        problems = [errors.problem]
        if strict and errors.measured_error > case.max_error:
            problems.append(f"above the bound by {errors.measured_error - case.max_error:.3g}")
        if with_geotiff:
            problems.append(_compare_geotiff(case, target, folder / "matrix.tif"))
    except Exception as error:  # noqa: BLE001 - the other cases must run
        return Row(**head, problem=f"FAILED: {type(error).__name__}: {error}")
    n_bytes = target.stat().st_size
    return Row(
        **head,
        n_bytes=n_bytes,
        bits_per_sample=round(8 * n_bytes / decoded.size, 5),
        measured_error=errors.measured_error,
        compress_s=round(compress_s, 3),
        read_s=round(read_s, 3),
        problem="; ".join(filter(None, problems)),
    )


def _seconds(function, *args) -> float:
    start = time.perf_counter()
    function(*args)
    return time.perf_counter() - start


def _compress(case: Case, target: Path) -> None:
    terrainwave.compress(
        case.source,
        target,
        max_error=case.max_error,
        method=case.method,
        block=case.block,
        verify=True,
        overwrite=True,
    )


def _compare_geotiff(case: Case, target: Path, back: Path) -> str:
    """Decompress to a GeoTIFF; return how it differs from the source, or ""."""
    back.unlink(missing_ok=True)
    terrainwave.decompress(target, back)
    with rasterio.open(back) as found, rasterio.open(case.source) as source:
        for name in ("transform", "crs", "dtypes", "shape"):
            if getattr(found, name) != getattr(source, name):
                return f"GeoTIFF: {name} is {getattr(found, name)!r}"
        if not np.array_equal(found.dataset_mask() > 0, case.raster.mask):
            return "GeoTIFF: mask differs"
        heights = found.read(1)
    errors = compare(case.raster, heights, case.max_error, check_voids=False)
    return f"GeoTIFF: {errors.problem}" if errors.problem else ""


def format_row(row: Row) -> str:
    """Return the line that is printed for a case."""
    case = f"{row.raster:38} {row.method:10} block {row.block:4} bound {row.max_error:<5g}"
    if row.n_bytes is None or row.measured_error is None:
        return f"{case} {row.problem}"
    figures = f"{row.bits_per_sample:8.4f} bit/sample  measured {row.measured_error:<10.7g}"
    times = f"{row.compress_s:7.2f} s  {row.read_s:6.2f} s"
    return f"{case} {figures} {times}  {row.problem or 'ok'}"


@click.command(cls=ListCommand)
@click.argument("places", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--block", "blocks", cls=ListOption, type=int, default=(64, 256))
@click.option("--method", "methods", cls=ListOption, default=("auto",))
@click.option("--crop", type=click.IntRange(min=1), help="Use the upper left N × N samples.")
@click.option("--geotiff", "with_geotiff", is_flag=True, help="Also decompress and compare.")
@click.option("--strict", is_flag=True, help="No ulp of allowance on decimal grids of floats.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/matrix.csv"),
    show_default=True,
)
def main(places, blocks, methods, crop, with_geotiff, strict, out) -> None:
    """Check the error bound on the GeoTIFFs in PLACES (files or directories)."""
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    paths = find_rasters(list(places))
    if not paths:
        raise click.UsageError("no GeoTIFFs there")
    n_cases = n_failed = 0
    worst = -math.inf
    with tempfile.TemporaryDirectory() as name, CsvSink(out, Row) as sink:
        folder = Path(name)
        for case in make_cases(paths, blocks, methods, crop, folder):
            row = run_case(case, folder, with_geotiff=with_geotiff, strict=strict)
            sink.write(row)
            click.echo(format_row(row))
            n_cases += 1
            n_failed += bool(row.problem)
            if row.measured_error is not None:
                worst = max(worst, row.measured_error - row.max_error)
    click.echo(f"{n_cases} cases, {n_failed} failed, measured - bound <= {worst:.3g}; {out}")
    raise SystemExit(1 if n_failed else 0)


if __name__ == "__main__":
    main()
