"""Count triangles beside greedy Delaunay: ``python -m benchmarks.meshes DIR``.

`Terrain.mesh` over blocks of 256 cells beside pydelatin, which sees the whole raster at once, on
lossless heights. Rasters of more than 2049 samples a side are cropped to their middle, voids set to
the lowest height for both.

``--papers``: into ``zerotree_mesh.csv``, of crops of 513 x 513 samples as blocks of 256 cells that
agree on borders: triangles of `zerotree` (Yusov & Turlapov 2010, Algorithm I without zero trees)
with the bits of its labels, of the restricted quadtree by true errors and by coefficients of cdf53.
"""

import math
from collections import namedtuple
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import click
import numpy as np
from pydelatin import Delatin

import terrainwave
from benchmarks import common
from benchmarks.rasters import middle, whole_units
from terrainwave.grid.quadtree import Region
from terrainwave.tri import agreement, rqt
from terrainwave.tri.connect import mesh_error, mesh_of_cut
from terrainwave.tri.guarantee import guaranteed_cut
from terrainwave.tri.refinement import encode_refinement

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
MAX_SIDE = 2049
N_RUNS = 5

# One line of the table of triangles; angles in degrees, speeds in Msamples/s of one thread.
Row = namedtuple(
    "Row",
    "raster n_rows n_cols error delatin halves optimised ratio optimised_ratio blocks_speed "
    "halves_speed optimised_speed halves_min_angle optimised_min_angle optimised_share_below_5",
)  # fmt: skip

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


def measure(name: str, heights: np.ndarray, folder: Path) -> Iterator[Row]:
    """Yield the rows of one raster."""
    path = folder / f"{name}.twz"
    for error in ERRORS:
        terrainwave.compress(
            heights, path, max_error=0, mesh_error=error, verify=False, overwrite=True
        )
        with terrainwave.open(path, threads=1, cache_bytes=1 << 30) as terrain:
            # So that speeds are those of meshing.
            terrain.decoder.window(terrain.n_levels - 1, Region(0, 0, *heights.shape))
            tasks = [partial(terrain.mesh, max_error=error, optimise=n) for n in (0, 1)]
            tasks.append(partial(derive_blocks, terrain))
            plain, swept, blocks = common.take_turns(lambda tasks=tasks: tasks, N_RUNS)
            counts = [found.result.n_triangles for found in (plain, swept)]
            greedy = n_delatin(heights, error)
            angles = smallest_angles(swept.result)
            yield Row(
                name, *heights.shape, float(error), greedy, *counts,
                *(round(count / greedy, 4) for count in counts),
                *(round(heights.size / found.seconds / 1e6, 2) for found in (blocks, plain, swept)),
                round(float(smallest_angles(plain.result).min()), 2),
                round(float(angles.min()), 2), round(float((angles < 5).mean()), 5),
            )  # fmt: skip


def derive_blocks(terrain: terrainwave.Terrain) -> None:
    """Derive the meshes of all blocks of the full grid, which the viewer draws."""
    for block in terrain.grid.blocks(terrain.n_levels - 1):
        terrain.block_mesh(block)


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


def paper_rows(directory: Path, folder: Path) -> Iterator[PaperRow]:
    """Yield the rows of all crops."""
    noise = np.random.default_rng(0).integers(0, 9, (CROP_SIDE, CROP_SIDE), np.int32)
    measure_papers("compiles", noise, noise.astype(np.int64), 3)
    for name, corner in CROPS.items():
        heights = whole_units(directory / f"{name}.tif")
        row, col = (min(at, n - CROP_SIDE) for at, n in zip(corner, heights.shape))
        crop = np.ascontiguousarray(heights[row : row + CROP_SIDE, col : col + CROP_SIDE])
        file = folder / "crop.twz"
        terrainwave.compress(crop, file, max_error=0, method="cdf53", mesh="none", overwrite=True)
        with terrainwave.open(file) as terrain:
            whole = Region(0, 0, *crop.shape)
            coefficients = terrain.decoder.coefficients(terrain.n_levels - 1, whole)
        for error in ERRORS:
            yield measure_papers(name, crop, coefficients, error)


def mesh_rows(directory: Path, folder: Path) -> Iterator[Row]:
    """Yield the rows of all rasters."""
    terrainwave.compress(np.zeros((300, 300), np.int16), folder / "w.twz", max_error=0)
    terrainwave.open(folder / "w.twz").mesh(max_error=1, optimise=1)  # compiles
    for name in CROPS:
        heights = whole_units(directory / f"{name}.tif")
        window = middle(heights.shape, MAX_SIDE).toslices()
        yield from measure(name, np.ascontiguousarray(heights[window]), folder)


@common.command("meshes.csv")
@common.directory_argument
@click.option("--papers", is_flag=True, help="The papers' meshes, into zerotree_mesh.csv.")
def main(directory: Path, papers: bool, folder: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    if papers:
        common.write_rows(out.with_name("zerotree_mesh.csv"), paper_rows(directory, folder))
        return
    common.write_rows(out, mesh_rows(directory, folder))


if __name__ == "__main__":
    main()
