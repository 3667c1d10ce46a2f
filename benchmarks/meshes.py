"""Count triangles beside greedy Delaunay: ``python -m benchmarks.meshes DIR``.

Heights are lossless, so that no codec's error is in either mesh; both keep every sample within the
error. pydelatin sees the whole raster at once; ours is `Terrain.mesh` over blocks of 256 cells.
Rasters of more than 2049 samples a side are cropped to their middle, voids set to the lowest height
for both. Writes two CSVs: triangles, and seconds on 4096 x 4096 samples.

Exit status: 0 good; 2 wrong usage.
"""

import math
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import click
import numpy as np

import terrainwave
from benchmarks.memory import make_mirrored
from benchmarks.report import CsvSink

RASTERS = (
    "srtm1_bigtujunga",
    "usgs_san_joaquin_30m",
    "srtm3_aconcagua_S33W071",
    "srtm1_olympic_peninsula",
    "moon_gld100_apennines_256ppd",
)
LARGE = "moon_gld100_apennines_256ppd"
ERRORS = (3.0, 10.0, 30.0)
MAX_SIDE = 2049
LARGE_SIDE = 4096
N_RUNS = 5


@dataclass(frozen=True)
class Row:
    """One line of the table of triangles; angles in degrees, speeds in Msamples/s of one thread."""

    raster: str
    n_rows: int
    n_cols: int
    error: float
    delatin: int
    halves: int
    optimised: int
    ratio: float
    optimised_ratio: float
    halves_speed: float
    optimised_speed: float
    halves_min_angle: float
    optimised_min_angle: float
    optimised_share_below_5: float


@dataclass(frozen=True)
class LargeRow:
    """One line of the table of seconds."""

    raster: str
    size: int
    error: float
    sweeps: int
    threads: int
    triangles: int
    seconds: float


def read_middle(path: Path) -> np.ndarray:
    """Return the middle of a raster in whole units, voids as the lowest height."""
    import rasterio

    with rasterio.open(path) as dataset:
        heights = dataset.read(1, masked=True)
    heights = np.rint(heights.filled(heights.min())).astype(np.int32)
    top, left = (max(side - MAX_SIDE, 0) // 2 for side in heights.shape)
    return np.ascontiguousarray(heights[top : top + MAX_SIDE, left : left + MAX_SIDE])


def smallest_angles(mesh: terrainwave.Mesh) -> np.ndarray:
    """Return the smallest angle of every triangle seen from above, in degrees."""
    corners = mesh.vertices[mesh.triangles][:, :, :2]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    a, b, c = np.sort(edges, axis=1).T
    return np.degrees(np.arccos(np.clip((b * b + c * c - a * a) / (2 * b * c), -1, 1)))


def timed(make: Callable[[], terrainwave.Mesh]) -> tuple[terrainwave.Mesh, float]:
    """Return a result and the CPU seconds it took, the median of some runs."""
    seconds = []
    for _ in range(N_RUNS):
        start = time.process_time()
        mesh = make()
        seconds.append(time.process_time() - start)
    return mesh, median(seconds)


def measure(name: str, heights: np.ndarray, directory: Path, sink: CsvSink) -> list[Row]:
    """Measure one raster at all errors."""
    from pydelatin import Delatin

    path = directory / f"{name}.twz"
    terrainwave.compress(heights, path, max_error=0, verify=False, overwrite=True)
    rows = []
    with terrainwave.open(path, threads=1, cache_bytes=1 << 30) as terrain:
        terrain.read()  # so that speeds are those of meshing
        for error in ERRORS:
            plain, seconds = timed(lambda error=error: terrain.mesh(max_error=error))
            swept, longer = timed(lambda error=error: terrain.mesh(max_error=error, optimise=1))
            greedy = Delatin(heights.astype(np.float32), max_error=error).triangles
            angles = smallest_angles(swept)
            row = Row(
                name,
                *heights.shape,
                error,
                len(greedy),
                plain.n_triangles,
                swept.n_triangles,
                round(plain.n_triangles / len(greedy), 4),
                round(swept.n_triangles / len(greedy), 4),
                round(heights.size / seconds / 1e6, 2),
                round(heights.size / longer / 1e6, 2),
                round(float(smallest_angles(plain).min()), 2),
                round(float(angles.min()), 2),
                round(float((angles < 5).mean()), 5),
            )
            sink.write(row)
            print(row, flush=True)
            rows.append(row)
    return rows


def measure_large(source: Path, directory: Path, sink: CsvSink) -> None:
    """Measure `Terrain.mesh` of 4096 x 4096 samples, decoding included."""
    raster, path = directory / "large.tif", directory / "large.twz"
    make_mirrored(source, raster, LARGE_SIDE, "tiled")
    terrainwave.compress(raster, path, max_error=1, verify=False, overwrite=True)
    for sweeps in (0, 1):
        found, seconds = [], []
        for _ in range(3):
            with terrainwave.open(path, threads=2) as terrain:
                start = time.perf_counter()
                found.append(terrain.mesh(max_error=10, optimise=sweeps).n_triangles)
                seconds.append(time.perf_counter() - start)
        row = LargeRow(
            source.stem, LARGE_SIDE, 10.0, sweeps, 2, found[0], round(median(seconds), 2)
        )
        sink.write(row)
        print(row, flush=True)


@click.command(help=__doc__)
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), default="benchmarks/results/meshes.csv")
def main(directory: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name, CsvSink(out, Row) as sink:
        scratch = Path(name)
        terrainwave.compress(np.zeros((300, 300), np.int16), scratch / "w.twz", max_error=0)
        terrainwave.open(scratch / "w.twz").mesh(max_error=1, optimise=1)  # compiles
        for raster in RASTERS:
            rows += measure(raster, read_middle(directory / f"{raster}.tif"), scratch, sink)
        for field in ("ratio", "optimised_ratio"):
            values = [getattr(row, field) for row in rows]
            mean = math.exp(math.fsum(map(math.log, values)) / len(values))
            print(f"{field}: geometric mean {mean:.4f}, largest {max(values):.4f}")
        with CsvSink(out.with_name("meshes_large.csv"), LargeRow) as large:
            measure_large(directory / f"{LARGE}.tif", scratch, large)


if __name__ == "__main__":
    sys.exit(main())
