"""Check every raster at many bounds by independent code: ``python -m benchmarks.matrix DIR``.

Files: each is compressed with the proof, read back and compared with rasterio and numpy alone:
every valid sample and the mask; decompressed to a GeoTIFF dtype, shape, transform and CRS, too.

Meshes, with ``--meshes KIND ...``: heights within a quarter of the mesh error, stored meshes of all
levels and meshes of the area (stored, and at several errors, one of them optimised) held against
the original by `terrainwave.verification.meshes`, which knows nothing of the builder. Rasters of
more than 513 samples a side are cropped to their middle.

Exit status: 0 nothing wrong; 1 something is; 2 wrong usage.
"""

import time
from collections import namedtuple
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import click
import numpy as np
import rasterio

import terrainwave
from benchmarks import common
from benchmarks.codecs import compare
from benchmarks.rasters import Raster, load_raster, middle, write_geotiff
from terrainwave.names import MESH_CHOICES
from terrainwave.verification.meshes import verify_meshes

BOUNDS = (0.5, 1.0, 3.0, 10.0)
BOUNDS_OF_FLOATS = (0.1, 0.5)
MESH_ERRORS = (1.0, 3.0, 10.0)
MESH_BLOCKS = (64, 128, 256)
TREES = ("zerotree-layer", "zerotree-coded")
MESH_SIDE = 513

# One file; `problem` is empty where all is well.
Row = namedtuple(
    "Row",
    "raster n_rows n_cols dtype max_error block method n_bytes bits_per_sample measured_error "
    "compress_s read_s problem",
    defaults=(None,) * 5 + ("",),
)
# One file's meshes: what was found wrong, 0 expected, and how large they are. `violations` are
# samples' bounds broken, `folds` triangles turned over or areas covered twice, `cracks` all else.
# `stored_triangles` of the finest level, `area_triangles` of ``Terrain.mesh(max_error=error)``,
# which took `seconds` of processor time; `worst_share` is the largest measured over stated error.
MeshRow = namedtuple(
    "MeshRow",
    "raster n_rows n_cols void_share mesh error block violations cracks folds stored_triangles "
    "area_triangles worst_share seconds check_seconds",
)
WRONG, WRONG_MESHES = slice(12, 13), slice(7, 10)  # columns that tell what is wrong


def bounds_for(raster: Raster) -> list[float]:
    """Return the bounds to try: 0 only where the heights lie on a grid."""
    bounds = {*BOUNDS, *([0.0] if raster.quantum else [])}
    return sorted(bounds if raster.is_integer else bounds.union(BOUNDS_OF_FLOATS))


def check_file(
    raster: Raster, source: Path, target: Path, max_error: float, block: int, method: str
) -> Row:
    """Compress, read and compare; whatever is raised becomes a row."""
    head = Row(
        raster.name, *raster.heights.shape, raster.heights.dtype.name, max_error, block, method
    )

    def compress() -> None:
        terrainwave.compress(
            source, target, max_error=max_error, method=method, block=block, overwrite=True
        )

    def read() -> np.ndarray:
        with terrainwave.open(target) as terrain:
            return terrain.read()

    try:
        written, found = common.take_turns(lambda: (compress, read), 1, clock=time.perf_counter)
        errors = compare(raster, found.result, max_error, check_voids=True)
        problems = [errors.problem, _compare_geotiff(raster, source, target, max_error)]
    except Exception as error:  # noqa: BLE001 - the other cases must run
        return head._replace(problem=f"FAILED: {type(error).__name__}: {error}")
    n_bytes = target.stat().st_size
    return Row(
        *head[:7], n_bytes, round(8 * n_bytes / raster.heights.size, 5), errors.measured_error,
        round(written.seconds, 3), round(found.seconds, 3), "; ".join(filter(None, problems)),
    )  # fmt: skip


def _compare_geotiff(raster: Raster, source: Path, target: Path, max_error: float) -> str:
    """Decompress to a GeoTIFF; return how it differs from the source, or ""."""
    back = target.with_suffix(".tif")
    terrainwave.decompress(target, back, overwrite=True)
    with rasterio.open(back) as found, rasterio.open(source) as original:
        for name in ("transform", "crs", "dtypes", "shape"):
            if getattr(found, name) != getattr(original, name):
                return f"GeoTIFF: {name} is {getattr(found, name)!r}"
        if not np.array_equal(found.dataset_mask() > 0, raster.mask):
            return "GeoTIFF: mask differs"
        problem = compare(raster, found.read(1), max_error, check_voids=False).problem
    return f"GeoTIFF: {problem}" if problem else ""


def check_meshes(
    raster: Raster, source: Path, path: Path, mesh: str, error: float, block: int
) -> MeshRow:
    """Compress, mesh and check one case; print all problems."""
    terrainwave.compress(
        source, path, max_error=error / 4, mesh_error=error, block=block, mesh=mesh,
        method="cdf97" if mesh in TREES else "auto", faithful=mesh == "zerotree-coded",
        verify=False, overwrite=True,
    )  # fmt: skip

    def original(region) -> tuple[np.ndarray, np.ndarray]:
        rows = slice(region.row, region.row + region.n_rows)
        cols = slice(region.col, region.col + region.n_cols)
        return raster.heights[rows, cols], raster.mask[rows, cols]

    with terrainwave.open(path, threads=1) as terrain:
        tasks = partial(verify_meshes, terrain, original), partial(terrain.mesh, max_error=error)
        checked, meshed = common.take_turns(lambda: tasks, 1)
    report, problems = checked.result
    stated = [(level.measured_error, level.stored_error) for level in report.levels]
    stated += [(area.measured_error, area.stated_error) for area in report.areas]
    violations = sum("further from it" in problem for problem in problems)
    folds = sum("turned over" in problem or "twice" in problem for problem in problems)
    for problem in problems:
        click.echo(f"  {problem}")
    return MeshRow(
        raster.name, *raster.heights.shape, round(float((~raster.mask).mean()), 4), mesh, error,
        block,
        violations, len(problems) - violations - folds, folds, report.levels[-1].n_triangles,
        meshed.result.n_triangles,
        round(max((measured / bound for measured, bound in stated if bound), default=0.0), 4),
        round(meshed.seconds, 3), round(checked.seconds, 1),
    )  # fmt: skip


def cases(
    paths: Sequence[Path], meshes: tuple[str, ...], blocks, methods, folder: Path
) -> Iterator[Row | MeshRow]:
    """Yield the rows of all rasters or, for meshes, of their middle."""
    middle_file, target = folder / "middle.tif", folder / "a.twz"
    for path in paths:
        with rasterio.open(path) as dataset:
            raster = load_raster(path, window=middle(dataset.shape, MESH_SIDE) if meshes else None)
        if meshes:
            write_geotiff(raster, middle_file)
            for mesh, error, block in product(meshes, MESH_ERRORS, blocks or MESH_BLOCKS):
                yield check_meshes(raster, middle_file, target, mesh, error, block)
            continue
        for method in methods:
            for max_error in bounds_for(raster):
                for block in blocks or (64, 256):
                    yield check_file(raster, path, target, max_error, block, method)


@common.command("matrix.csv")
@common.rasters_argument
@click.option(
    "--meshes",
    cls=common.ListOption,
    type=click.Choice(MESH_CHOICES),
    help="Check meshes of these kinds, into mesh_matrix.csv.",
)
@click.option("--block", "blocks", cls=common.ListOption, type=int)
@common.option("--method", "methods", cls=common.ListOption, default=("auto",))
def main(paths, meshes, blocks, methods, folder, out) -> None:
    """Check the bounds."""
    found = cases(paths, meshes, blocks, methods, folder)
    rows = common.write_rows(out.with_name(f"mesh_{out.name}") if meshes else out, found)
    wrong = WRONG_MESHES if meshes else WRONG
    n_failed = sum(any(row[wrong]) for row in rows)
    click.echo(f"{len(rows)} cases, {n_failed} failed")
    raise SystemExit(n_failed > 0)


if __name__ == "__main__":
    main()
