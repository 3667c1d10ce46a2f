"""Measure files at 1, 2 and 4 root blocks per side: ``python -m benchmarks.roots DEM.tif …``.

The format has one root block (docs/decisions/0007-one-root-block.md); the other numbers are tried
by changing the constant that every part of this checkout reads. Each file is decoded and held to
its bound before it counts.
"""

import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import click
from rasterio.errors import NotGeoreferencedWarning

import terrainwave
from benchmarks.lists import ListCommand, ListOption
from benchmarks.rasters import find_rasters
from benchmarks.report import CsvSink
from terrainwave.grid import quadtree

ROOTS = (1, 2, 4)


@dataclass(frozen=True)
class Row:
    """One line of the CSV; `change_percent` is against one root block."""

    raster: str
    max_error: float
    roots_per_side: int
    n_levels: int
    n_bytes: int
    bits_per_sample: float
    change_percent: float


def measure(path: Path, max_error: float, roots: int, method: str, folder: Path) -> Row:
    """Compress with at most `roots` root blocks per side and the proof at the end."""
    target = folder / "roots.twz"
    with mock.patch.object(quadtree, "MAX_ROOTS_PER_SIDE", roots):
        result = terrainwave.compress(
            path, target, max_error=max_error, method=method, verify=True, overwrite=True
        )
        with terrainwave.open(target) as terrain:
            n_levels = terrain.n_levels
    bits = round(result.bits_per_sample, 5)
    return Row(path.stem, max_error, roots, n_levels, result.n_bytes, bits, 0.0)


@click.command(cls=ListCommand)
@click.argument("places", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--max-error", "max_errors", cls=ListOption, type=float, default=(1.0, 3.0, 10.0))
@click.option("--method", default="predictive", show_default=True)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/roots.csv"),
    show_default=True,
)
def main(places, max_errors, method, out) -> None:
    """Compare numbers of root blocks on the GeoTIFFs in PLACES (files or directories)."""
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    paths = find_rasters(list(places))
    if not paths:
        raise click.UsageError("no GeoTIFFs there")
    with tempfile.TemporaryDirectory() as name, CsvSink(out, Row) as sink:
        for path in paths:
            for max_error in max_errors:
                rows = [measure(path, max_error, n, method, Path(name)) for n in ROOTS]
                for row in rows:
                    change = 100 * (row.n_bytes / rows[0].n_bytes - 1)
                    row = Row(**{**vars(row), "change_percent": round(change, 2)})
                    sink.write(row)
                    click.echo(
                        f"{row.raster:32} bound {max_error:<4g} {row.roots_per_side} per side:"
                        f" {row.bits_per_sample:.4f} bit/sample, {change:+.2f} %"
                    )


if __name__ == "__main__":
    main()
