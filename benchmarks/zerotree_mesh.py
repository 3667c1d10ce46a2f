"""The paper's triangulations beside greedy Delaunay: ``python -m benchmarks.zerotree_mesh DIR``.

Crops of 513 x 513 samples, voids set to the lowest height. First as blocks of the full grid, 256
cells, lossless heights, borders agreed: triangles of `zerotree` (Yusov & Turlapov 2010, Algorithm I
without zero trees) with the bits of its labels, of the restricted quadtree by true errors and by
details, and of pydelatin on the whole crop. Then as a group coded by each method at the same error:
the block it refines, 257 x 257 samples, has zero trees; its non-guaranteed mesh and that one's true
error, its guaranteed mesh within twice the error, and the bits of its labels with and without the
trees.

Exit status: 0 good; 2 wrong usage.
"""

import dataclasses
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from benchmarks.report import CsvSink
from terrainwave.codec.group import encode_unit
from terrainwave.codec.registry import PYRAMIDS, refiner_by_name
from terrainwave.codec.units import CodecParameters, unit_spec
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.tri import agreement, rqt
from terrainwave.tri.connect import loose_mesh, mesh_error, mesh_of_cut
from terrainwave.tri.guarantee import guaranteed_cut
from terrainwave.tri.refinement import encode_refinement

# Where the crops begin: those of the study of triangulations, on land and away from voids.
CROPS = {
    "srtm1_bigtujunga": (60, 300),
    "usgs_san_joaquin_30m": (40, 40),
    "srtm3_aconcagua_S33W071": (80, 80),
    "srtm1_olympic_peninsula": (700, 1400),
    "moon_gld100_apennines_256ppd": (1500, 600),
}
SIDE, BLOCK = 513, 256
ERRORS = (3, 10, 30)


@dataclass(frozen=True)
class Row:
    """One line of the CSV; bits per sample, metres, Msamples/s of one thread."""

    raster: str
    error: int
    delatin: int
    zerotree: int
    zerotree_ratio: float
    zerotree_bits: float
    zerotree_rounds: int
    zerotree_speed: float
    rqt: int
    rqt_ratio: float
    rqt_rounds: int
    rqt_speed: float
    rqt_by_detail: int
    rqt_by_detail_error: float


@dataclass(frozen=True)
class GroupRow:
    """One line of the CSV of groups; the block they refine has `block_samples`."""

    raster: str
    method: str
    error: int
    block_samples: int
    tolerance: int
    significant: float
    loose: int
    loose_error: float
    loose_folded: int
    guaranteed: int
    guaranteed_free: int
    bits_with_trees: float
    bits_without_trees: float
    bits_free: float


def read_crop(path: Path) -> np.ndarray:
    """Return the crop of a raster in whole units, voids as the lowest height."""
    import rasterio

    with rasterio.open(path) as dataset:
        heights = dataset.read(1, masked=True)
    heights = np.rint(heights.filled(heights.min())).astype(np.int32)
    row, col = (min(a, n - SIDE) for a, n in zip(CROPS[path.stem], heights.shape, strict=True))
    return np.ascontiguousarray(heights[row : row + SIDE, col : col + SIDE])


class Blocks:
    """The blocks of a crop, triangulated so that borders agree."""

    def __init__(self, heights: np.ndarray, error: int) -> None:
        """Cut `heights` into blocks."""
        self.tolerance = 16 * error
        self.parts = {
            (i, j): np.ascontiguousarray(
                heights[i * BLOCK :, j * BLOCK :][: BLOCK + 1, : BLOCK + 1]
            )
            for i in range((SIDE - 1) // BLOCK)
            for j in range((SIDE - 1) // BLOCK)
        }
        self.mask = np.ones((BLOCK + 1, BLOCK + 1), dtype=bool)

    def agree(self, triangulate, border):
        """Return results by position, rounds, and CPU seconds."""
        start = time.process_time()
        found, n_rounds = agreement.agree(
            list(self.parts),
            lambda at, keep: triangulate(
                self.parts[at], self.mask, None if keep is None else keep.keep(self.mask.shape)
            ),
            border,
        )
        return found, n_rounds, time.process_time() - start


def measure(name: str, heights: np.ndarray, error: int) -> Row:
    """Measure blocks of the full grid."""
    from pydelatin import Delatin

    blocks = Blocks(heights, error)
    tolerance, mask = blocks.tolerance, blocks.mask

    def rqt_border(selection):
        return agreement.border_of(rqt.vertices_of(selection, mask.shape))

    def select(rule):
        return lambda h, m, keep: rqt.select_vertices(h, m, tolerance, rule=rule, keep=keep)

    cuts, rounds, seconds = blocks.agree(
        lambda h, m, keep: guaranteed_cut(h, m, tolerance, keep=keep), agreement.border_of_cut
    )
    n_bytes = n_zerotree = 0
    for at, cut in cuts.items():
        mesh = mesh_of_cut(blocks.parts[at], mask, cut)
        assert mesh_error(blocks.parts[at], mesh) <= tolerance
        n_zerotree += len(mesh.triangles)
        n_bytes += len(encode_refinement(cut, blocks.parts[at], mask, tolerance))
    chosen, rqt_rounds, rqt_seconds = blocks.agree(select("by_error"), rqt_border)
    meshes = [rqt.rqt_mesh(blocks.parts[at], mask, found) for at, found in chosen.items()]
    errors = [mesh_error(blocks.parts[at], m) for at, m in zip(chosen, meshes, strict=True)]
    assert max(errors) <= tolerance
    n_rqt = sum(len(mesh.triangles) for mesh in meshes)
    chosen, _, _ = blocks.agree(select("by_detail"), rqt_border)
    meshes = [rqt.rqt_mesh(blocks.parts[at], mask, found) for at, found in chosen.items()]
    errors = [mesh_error(blocks.parts[at], m) for at, m in zip(chosen, meshes, strict=True)]
    n_delatin = len(Delatin(heights.astype(np.float32), max_error=error).triangles)
    return Row(
        name, error, n_delatin, n_zerotree, round(n_zerotree / n_delatin, 3),
        round(8 * n_bytes / heights.size, 4), rounds, round(heights.size / seconds / 1e6, 1),
        n_rqt, round(n_rqt / n_delatin, 3), rqt_rounds, round(heights.size / rqt_seconds / 1e6, 1),
        sum(len(mesh.triangles) for mesh in meshes), max(errors) / 16,
    )  # fmt: skip


def measure_group(name: str, heights: np.ndarray, method: str, error: int) -> GroupRow:
    """Measure the block that a group refines."""
    grid = Grid(SIDE, SIDE, BLOCK)
    parameters = CodecParameters(2 * error + 1, -(1 << 29), 1 << 29, (1, 0), 1, 1)
    refiner = refiner_by_name(method)
    mask = np.ones(heights.shape, dtype=bool)
    if PYRAMIDS[method] == "lowpass":
        shape = grid.level_shape(0)
        above = lowpass_analysis(heights, (0, 0), heights.shape, (0, 0), shape)
    else:
        above = np.ascontiguousarray(heights[::2, ::2])
    root, group = (unit_spec(grid, parameters, Block(level, 0, 0)) for level in (-1, 0))
    _, block = encode_unit(refiner, root, None, above, np.ascontiguousarray(mask[::2, ::2]))
    group = dataclasses.replace(group, wants_labels=True)
    _, fine = encode_unit(refiner, group, block, heights, mask)
    trees, valid = fine.labels, block.mask
    assert trees is not None
    tolerance = 2 * 16 * error
    loose = loose_mesh(block.heights, valid, trees)
    cut = guaranteed_cut(block.heights, valid, tolerance, trees)
    free = guaranteed_cut(block.heights, valid, tolerance)
    n_bytes = [
        len(encode_refinement(found, block.heights, valid, tolerance, known))
        for found, known in ((cut, trees), (cut, None), (free, None))
    ]
    bits = [round(8 * n / valid.size, 4) for n in n_bytes]
    return GroupRow(
        name, method, error, valid.size, 2 * error, round(float((trees == 0).mean()), 4),
        len(loose.mesh.triangles), loose.error / 16, loose.n_folded,
        len(mesh_of_cut(block.heights, valid, cut).triangles),
        len(mesh_of_cut(block.heights, valid, free).triangles), *bits,
    )  # fmt: skip


@click.command(help=__doc__)
@click.argument("directory", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), default="benchmarks/results/zerotree_mesh.csv"
)
def main(directory: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    groups = out.with_name(f"{out.stem}_groups.csv")
    measure("compiles", np.random.default_rng(0).integers(0, 9, (SIDE, SIDE), np.int32), 3)
    with CsvSink(out, Row) as sink, CsvSink(groups, GroupRow) as group_sink:
        for name in CROPS:
            heights = read_crop(directory / f"{name}.tif")
            for error in ERRORS:
                row = measure(name, heights, error)
                sink.write(row)
                print(row, flush=True)
                for method in ("predictive", "cdf97"):
                    group_row = measure_group(name, heights, method, error)
                    group_sink.write(group_row)
                    print(group_row, flush=True)


if __name__ == "__main__":
    sys.exit(main())
