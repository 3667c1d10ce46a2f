"""Meshes beside pydelatin's and pymartini's: ``python -m benchmarks.meshes DIR``.

Triangles, into ``meshes.csv``: `Terrain.mesh` over blocks of 256 cells beside pydelatin (greedy
Delaunay), which sees the whole raster at once, on lossless heights. Rasters of more than 2049
samples a side are cropped to their middle, voids set to the lowest height for both.

Times, into ``mesh_times.csv``: the middle 513 or 1025 samples squared of the same rasters, as
pymartini (right-angled triangulated networks) needs 2^k + 1; one thread on one core, in turns, from
an array in memory to vertices and triangles in memory. Peers get float32, ours whole numbers.
"array" is `compress_to_bytes` without loss, with its proof, `open` and `Terrain.mesh`; "file"
`Terrain.mesh` alone, of a file just opened, which it decodes; "swept" the same with a sweep of
collapses. What pymartini prepares once for tiles of a size is not timed. The true error of each
mesh is measured by one function, at all samples. ``--times``: these alone.

``--papers``: into ``zerotree_mesh.csv``, of crops of 513 x 513 samples as blocks of 256 cells that
agree on borders: triangles of `zerotree` (Yusov & Turlapov 2010, Algorithm I without zero trees)
with the bits of its labels, of the restricted quadtree by true errors and by coefficients of cdf53.
"""

import math
from collections import namedtuple
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import click
import numpy as np
from pydelatin import Delatin
from pymartini import Martini

import terrainwave
from benchmarks import common
from benchmarks.rasters import coefficients_of, whole_units
from terrainwave.tri.block_mesh import BlockMesh
from terrainwave.tri.mesh_distance import largest_deviation
from terrainwave.tri.rqt import stored as rqt
from terrainwave.tri.zerotree import agreement
from terrainwave.tri.zerotree.connect import mesh_error, mesh_of_cut
from terrainwave.tri.zerotree.guarantee import guaranteed_cut
from terrainwave.tri.zerotree.refinement import encode_refinement

# The rasters, and where the crops of `--papers` begin: on land and away from voids.
CROPS = {
    "srtm1_bigtujunga": (60, 300),
    "usgs_san_joaquin_30m": (40, 40),
    "srtm3_aconcagua_S33W071": (80, 80),
    "srtm1_olympic_peninsula": (700, 1400),
    "moon_gld100_apennines_256ppd": (1500, 600),
}
CROP_SIDE, BLOCK = 513, 256
ERRORS = (3, 10, 30)
MAX_SIDE, TIMED_SIDES = 2049, (1025, 513)
N_RUNS = 5

# One line of the table of triangles; angles in degrees.
Row = namedtuple(
    "Row",
    "raster n_rows n_cols error delatin halves optimised ratio optimised_ratio halves_min_angle "
    "optimised_min_angle optimised_share_below_5",
)

# One line of the table of times: milliseconds of processor time, the median and the most.
TimeRow = namedtuple("TimeRow", "raster side error mesher triangles true_error ms most_ms n_runs")

# One line about the papers' meshes; bits per sample, metres.
PaperRow = namedtuple(
    "PaperRow",
    "raster error delatin zerotree zerotree_ratio zerotree_bits rqt rqt_ratio rqt_by_coefficient "
    "coefficient_error rqt_at_its_error",
)  # fmt: skip


def n_delatin(heights: np.ndarray, error: float) -> int:
    """Return the triangles of greedy Delaunay."""
    return len(Delatin(heights.astype(np.float32), max_error=error).triangles)


def smallest_angles(mesh: terrainwave.Mesh) -> np.ndarray:
    """Return the smallest angle of every triangle seen from above, in degrees."""
    corners = mesh.vertices[mesh.triangles][:, :, :2]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    a, b, c = np.sort(edges, axis=1).T
    return np.degrees(np.arccos(np.clip((b * b + c * c - a * a) / (2 * b * c), -1, 1)))


def measure(name: str, heights: np.ndarray) -> Iterator[Row]:
    """Yield the rows of one raster."""
    terrain = terrainwave.open(terrainwave.compress_to_bytes(heights, max_error=0, verify=False))
    for error in ERRORS:
        plain, swept = (terrain.mesh(max_error=error, optimise=sweeps) for sweeps in (0, 1))
        counts = [mesh.n_triangles for mesh in (plain, swept)]
        greedy, angles = n_delatin(heights, error), smallest_angles(swept)
        yield Row(
            name, *heights.shape, float(error), greedy, *counts,
            *(round(count / greedy, 4) for count in counts),
            round(float(smallest_angles(plain).min()), 2),
            round(float(angles.min()), 2), round(float((angles < 5).mean()), 5),
        )  # fmt: skip


# What each mesher's user calls; all give vertices and triangles.
def by_delatin(floats: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of greedy Delaunay."""
    tin = Delatin(floats, max_error=error)
    return tin.vertices, tin.triangles


def by_martini(martini: Martini, floats: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of a right-angled network."""
    return martini.create_tile(floats).get_mesh(error)


def by_file(terrain: terrainwave.Terrain, error: float, sweeps: int) -> terrainwave.Mesh:
    """Return the mesh of an opened file."""
    return terrain.mesh(max_error=error, optimise=sweeps)


def by_array(heights: np.ndarray, error: float) -> terrainwave.Mesh:
    """Return the mesh of an array, by way of a file in memory."""
    data = terrainwave.compress_to_bytes(heights, max_error=0, threads=1)
    with terrainwave.open(data, threads=1) as terrain:
        return by_file(terrain, error, 0)


def true_error(heights: np.ndarray, rows, cols, z, triangles: np.ndarray) -> float:
    """Return the largest distance of whole heights from a mesh of all samples, to 1/16.

    Vertices lie on samples or halfway between two.
    """
    rows, cols = (np.rint(2 * np.asarray(places)).astype(np.int32) for places in (rows, cols))
    corners = np.stack([cols, rows], axis=1)[triangles].astype(np.int64)
    (dx, dy), (ex, ey) = ((corners[:, k] - corners[:, 0]).T for k in (1, 2))
    areas = dx * ey - ex * dy
    if np.abs(areas).sum() != 8 * np.prod(np.subtract(heights.shape, 1), dtype=np.int64):
        raise click.ClickException("a mesh does not cover all cells once")
    triangles = np.where((areas < 0)[:, None], triangles[:, ::-1], triangles).astype(np.int32)
    mesh = BlockMesh(rows, cols, np.rint(16 * np.asarray(z)).astype(np.int64), triangles)
    return largest_deviation(mesh, 1, heights, np.ones(heights.shape, bool), 0, 0) / 16


def places_of(mesher: str, heights: np.ndarray, found) -> tuple:
    """Return rows, columns, heights and triangles of a mesh as `mesher` gives it."""
    if isinstance(found, terrainwave.Mesh):
        x, y, z = found.points.T
        return y - 0.5, x - 0.5, z, found.triangles  # arrays have rows downwards
    vertices, triangles = found
    if mesher == "delatin":  # y upwards
        cols, rows, z = vertices.T
        return heights.shape[0] - 1 - rows, cols, z, triangles
    cols, rows = vertices.T.astype(np.int64)
    return rows, cols, heights[rows, cols], triangles


def time_rows(name: str, heights: np.ndarray) -> Iterator[TimeRow]:
    """Yield the rows of a square raster."""
    side, floats = len(heights), heights.astype(np.float32)
    data = terrainwave.compress_to_bytes(heights, max_error=0)
    martini = Martini(side)
    for error in ERRORS:

        def tasks(error=error):
            files = [terrainwave.open(data, threads=1) for _ in range(2)]
            return {
                "delatin": partial(by_delatin, floats, error),
                "martini": partial(by_martini, martini, floats, error),
                "array": partial(by_array, heights, error),
                "file": partial(by_file, files[0], error, 0),
                "swept": partial(by_file, files[1], error, 1),
            }

        times = common.take_turns(lambda t=tasks: [*t().values()], N_RUNS)
        for mesher, timed in zip(tasks(), times, strict=True):
            rows, cols, z, triangles = places_of(mesher, heights, timed.result)
            yield TimeRow(
                name, side, error, mesher, len(triangles),
                true_error(heights, rows, cols, z, triangles),
                round(1000 * timed.seconds, 1), round(1000 * timed.most, 1), N_RUNS,
            )  # fmt: skip


def measure_papers(name: str, heights, coefficients, error: int) -> PaperRow:
    """Return the row of a crop at one error; `coefficients` are of its samples."""
    tolerance = 16 * error
    mask = np.ones((BLOCK + 1, BLOCK + 1), dtype=bool)
    places = list(np.ndindex(CROP_SIDE // BLOCK, CROP_SIDE // BLOCK))

    def parts(samples):
        """Return samples by block."""
        starts = {(i, j): samples[i * BLOCK :, j * BLOCK :] for i, j in places}
        return {at: np.ascontiguousarray(s[: BLOCK + 1, : BLOCK + 1]) for at, s in starts.items()}

    blocks = parts(heights)

    def agreed(triangulate, border, make_mesh):
        """Return results by block, triangles, largest error in sixteenths."""

        def one(at, keep):
            return triangulate(at, None if keep is None else keep.keep(mask.shape))

        found, _ = agreement.agree(places, one, border)
        meshes = {at: make_mesh(blocks[at], mask, result) for at, result in found.items()}
        largest = max(mesh_error(blocks[at], mesh) for at, mesh in meshes.items())
        return found, sum(len(mesh.triangles) for mesh in meshes.values()), largest

    def selected(tolerance: int, details=None):
        def select(at, keep):
            own = None if details is None else details[at]
            return rqt.select_vertices(blocks[at], mask, tolerance, keep=keep, coefficients=own)

        def border(selection):
            return agreement.border_of(rqt.vertices_of(selection, mask.shape))

        return agreed(select, border, rqt.rqt_mesh)

    def cut(at, keep):
        return guaranteed_cut(blocks[at], mask, tolerance, keep=keep)

    cuts, n_zerotree, largest = agreed(cut, agreement.border_of_cut, mesh_of_cut)
    labels = [encode_refinement(cut, blocks[at], mask, tolerance) for at, cut in cuts.items()]
    _, n_rqt, largest_of_rqt = selected(tolerance)
    assert max(largest, largest_of_rqt) <= tolerance
    _, n_by_coefficient, its_error = selected(tolerance, parts(coefficients))
    greedy, n_at_its_error = n_delatin(heights, error), selected(math.ceil(its_error))[1]
    bits = 8 * sum(map(len, labels)) / heights.size
    return PaperRow(
        name, error, greedy, n_zerotree, round(n_zerotree / greedy, 3), round(bits, 4), n_rqt,
        round(n_rqt / greedy, 3), n_by_coefficient, its_error / 16, n_at_its_error,
    )  # fmt: skip


def paper_rows(directory: Path) -> Iterator[PaperRow]:
    """Yield the rows of all crops."""
    noise = np.random.default_rng(0).integers(0, 9, (CROP_SIDE, CROP_SIDE), np.int32)
    measure_papers("compiles", noise, noise.astype(np.int64), 3)
    for name, corner in CROPS.items():
        heights = whole_units(directory / f"{name}.tif")
        row, col = (min(at, n - CROP_SIDE) for at, n in zip(corner, heights.shape))
        crop = np.ascontiguousarray(heights[row : row + CROP_SIDE, col : col + CROP_SIDE])
        coefficients = coefficients_of(crop)
        for error in ERRORS:
            yield measure_papers(name, crop, coefficients, error)


def crops(directory: Path, sides: Sequence[int]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield names and middles of the rasters, of the first of `sides` that fits, or all of them."""
    for name in CROPS:
        heights = whole_units(directory / f"{name}.tif")
        side = next((side for side in sides if side <= min(heights.shape)), sides[-1])
        middle = tuple(slice(max(n - side, 0) // 2, (n + side) // 2) for n in heights.shape)
        yield name, np.ascontiguousarray(heights[middle])


@common.command("meshes.csv")
@common.directory_argument
@click.option("--papers", is_flag=True, help="The papers' meshes, into zerotree_mesh.csv.")
@click.option("--times", is_flag=True, help="Times alone, into mesh_times.csv.")
def main(directory: Path, papers: bool, times: bool, folder: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    common.pin_to_cores()
    if papers:
        common.write_rows(out.with_name("zerotree_mesh.csv"), paper_rows(directory))
        return
    noise = np.random.default_rng(0).integers(0, 99, (513, 513), np.int32)
    list(time_rows("compiles", noise))
    rows = (row for found in crops(directory, TIMED_SIDES) for row in time_rows(*found))
    common.write_rows(out.with_name("mesh_times.csv"), rows)
    if not times:
        rows = (row for found in crops(directory, (MAX_SIDE,)) for row in measure(*found))
        common.write_rows(out, rows)


if __name__ == "__main__":
    main()
