"""Check meshes of many rasters by independent code: ``python -m benchmarks.mesh_matrix DIR``.

Every raster, mesh error and block size: heights within a quarter of the mesh error, stored meshes
of all levels and meshes of the area (stored, and at several errors, one of them optimised) held
against the original by `terrainwave.verification.meshes`, which knows nothing of the builder.
Rasters of more than 513 samples a side are cropped to their middle. Writes a CSV.

Exit status: 0 nothing wrong; 1 something is; 2 wrong usage.
"""

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import rasterio
from rasterio.windows import Window

import terrainwave
from benchmarks.rasters import find_rasters
from benchmarks.report import CsvSink
from terrainwave.verification.meshes import verify_meshes

ERRORS = (1.0, 3.0, 10.0)
BLOCKS = (64, 128, 256)
MAX_SIDE = 513


@dataclass(frozen=True)
class Row:
    """One case: what was found wrong, 0 expected, and how large the meshes are.

    `violations` are samples' bounds broken, `folds` triangles turned over or areas covered twice,
    `cracks` all else. `stored_triangles` of the finest level, `area_triangles` of
    ``Terrain.mesh(max_error=error)``, which took `seconds` of processor time; `worst_share` is the
    largest measured over stated error.
    """

    raster: str
    n_rows: int
    n_cols: int
    void_share: float
    error: float
    block: int
    violations: int
    cracks: int
    folds: int
    stored_triangles: int
    area_triangles: int
    worst_share: float
    seconds: float
    check_seconds: float


def make_crop(source: Path, target: Path) -> None:
    """Write the middle of a raster with all that belongs to it."""
    with rasterio.open(source) as dataset:
        n_rows, n_cols = (min(size, MAX_SIDE) for size in dataset.shape)
        window = Window(
            (dataset.width - n_cols) // 2, (dataset.height - n_rows) // 2, n_cols, n_rows
        )
        profile = {
            "driver": "GTiff", "count": 1, "height": n_rows, "width": n_cols,
            "dtype": dataset.dtypes[0], "nodata": dataset.nodata, "crs": dataset.crs,
            "transform": dataset.window_transform(window),
        }  # fmt: skip
        with rasterio.open(target, "w", **profile) as sink:
            sink.write(dataset.read(1, window=window), 1)


def read_crop(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return raw heights and validity, by rasterio alone."""
    with rasterio.open(path) as dataset:
        heights, valid = dataset.read(1), dataset.read_masks(1) > 0
    if heights.dtype.kind == "f":
        valid &= np.isfinite(heights)
    return heights, valid


def measure(name: str, crop: Path, error: float, block: int, scratch: Path) -> tuple[Row, list]:
    """Compress, mesh and check one case; return its row and all problems."""
    path = scratch / "mesh.twz"
    heights, valid = read_crop(crop)
    terrainwave.compress(
        crop, path, max_error=error / 4, mesh_error=error, block=block, verify=False,
        overwrite=True,
    )  # fmt: skip
    with terrainwave.open(path, threads=1) as terrain:
        start = time.process_time()
        report, problems = verify_meshes(
            terrain,
            lambda region: (
                heights[region.row :, region.col :][: region.n_rows, : region.n_cols],
                valid[region.row :, region.col :][: region.n_rows, : region.n_cols],
            ),
        )
        checked = time.process_time()
        area = terrain.mesh(max_error=error)
        seconds = time.process_time() - checked
    shares = [level.measured_error / level.stored_error for level in report.levels
              if level.stored_error]  # fmt: skip
    shares += [one.measured_error / one.stated_error for one in report.areas if one.stated_error]
    violations = sum("further from it" in problem for problem in problems)
    folds = sum("turned over" in problem or "twice" in problem for problem in problems)
    row = Row(
        name, *heights.shape, round(float((~valid).mean()), 4), error, block, violations,
        len(problems) - violations - folds, folds, report.levels[-1].n_triangles,
        area.n_triangles, round(max(shares, default=0.0), 4), round(seconds, 3),
        round(checked - start, 1),
    )  # fmt: skip
    return row, problems


@click.command(help=__doc__)
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), default="benchmarks/results/mesh_matrix.csv"
)
def main(directory: Path, out: Path) -> None:
    """Check, print and write the CSV."""
    n_bad = 0
    with tempfile.TemporaryDirectory() as name, CsvSink(out, Row) as sink:
        scratch = Path(name)
        for source in find_rasters([directory]):
            crop = scratch / "crop.tif"
            make_crop(source, crop)
            for error in ERRORS:
                for block in BLOCKS:
                    row, problems = measure(source.stem, crop, error, block, scratch)
                    sink.write(row)
                    print(row, *problems, sep="\n  ", flush=True)
                    n_bad += bool(problems)
    print(f"{n_bad} cases with problems")
    sys.exit(n_bad > 0)


if __name__ == "__main__":
    sys.exit(main())
