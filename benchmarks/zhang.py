"""Levels and prediction of Zhang et al. 2012 beside ours: ``python -m benchmarks.zhang DEM.tif …``.

``--only levels``: the pyramid of their equation (1), made from the finest level of a lossless file
up, and the levels of mode batched: how far originals are from the triangles of each level.
Originals beyond the outermost samples of their level, which lie half a cell inside, count for
neither.

``--only triangles``: what both draw at the same τ: mode batched's choice of blocks with the largest
errors measured in each block, and with the bounds that the viewer has instead. Means over nine
cameras. Their blocks lie where their samples do: half a cell beside ours.
"""

import math
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np

import terrainwave
from benchmarks import common
from benchmarks.render import KEYS, camera_at_key
from terrainwave.grid.quadtree import Block
from terrainwave.render.modes.batched import Batched, n_grid_triangles
from terrainwave.render.modes.mode import ModeNeeds
from terrainwave.render.scene.camera import Viewport, home
from terrainwave.render.scene.frame import frame_of
from terrainwave.render.scene.selection import NodeTable, View

BLOCK, ORDERS, TAUS = 64, (4, 2), (1.0, 2.0, 4.0)
VIEWPORT = Viewport(1280, 720)
# The inner four of the 4 x 4 samples and the eight beside them (their fig. 2); corners are 0.
WEIGHTS = {2: (1 / 4, 0.0), 4: (10 / 32, -1 / 32)}
# `above`: levels above the finest. Metres.
LevelRow = namedtuple("LevelRow", "raster block above samples pyramid order largest rms")
# `errors`: what blocks are chosen by, "measured" or the viewer's "bound".
TriangleRow = namedtuple("TriangleRow", "raster block tau pyramid order errors blocks triangles")


def paper_level(fine: np.ndarray, order: int) -> np.ndarray:
    """Return the next coarser level by equation (1): of 4 x 4 samples, in their middle.

    Past the edge the outermost samples are repeated. Levels of odd sides end half a sample outside.
    """
    inner, beside = WEIGHTS[order]
    n_rows, n_cols = (side + 1 >> 1 for side in fine.shape)
    around = np.pad(fine, ((1, 2), (1, 2)), mode="edge")
    coarse = np.zeros((n_rows, n_cols))
    for row in range(4):
        for col in range(4):
            n_inside = (row in (1, 2)) + (col in (1, 2))
            weight = (0.0, beside, inner)[n_inside]
            coarse += weight * around[row : row + 2 * n_rows : 2, col : col + 2 * n_cols : 2]
    return coarse


def our_level(mode: Batched, level: int) -> np.ndarray:
    """Return the vertices of all blocks of a level, with those past the raster's edge."""
    terrain, side = mode.terrain, mode.terrain.grid.block
    stride = terrain.grid.stride(level)
    vertices = np.full([-(-(n - 1) // stride) + 1 for n in terrain.shape], np.nan)
    for block in terrain.grid.blocks(level):
        heights, _ = mode.grid(block)
        row, col = block.row * side, block.col * side
        vertices[row : row + heights.shape[0], col : col + heights.shape[1]] = heights
    return vertices + mode._middle


def surface(vertices: np.ndarray, first: float, stride: int, shape: tuple[int, int]) -> np.ndarray:
    """Return the heights of a level's triangles at all samples of the finest level.

    Vertices lie at `first` + k `stride` of these; cells are cut from their first corner to their
    last. Beyond the outermost vertices the border is repeated.
    """
    places = [
        np.clip((np.arange(n) - first) / stride, 0, side - 1)
        for n, side in zip(shape, vertices.shape, strict=True)
    ]
    (row, col) = (
        np.minimum(place.astype(np.int64), side - 2)
        for place, side in zip(places, vertices.shape, strict=True)
    )
    down, right = (places[0] - row)[:, None], (places[1] - col)[None, :]
    corner, last = vertices[np.ix_(row, col)], vertices[np.ix_(row + 1, col + 1)]
    beside, below = vertices[np.ix_(row, col + 1)], vertices[np.ix_(row + 1, col)]
    upper = corner + right * (beside - corner) + down * (last - beside)
    lower = corner + down * (below - corner) + right * (last - below)
    return np.where(right >= down, upper, lower)


class Levels:
    """A terrain's levels, the paper's and ours: how far originals are from each.

    Parameters
    ----------
    path : Path
        terrain : Terrain
        Of a lossless file without voids.
    """

    def __init__(self, terrain: terrainwave.Terrain) -> None:
        self.terrain = terrain
        self.frame = frame_of(self.terrain)
        heights = self.terrain.read(masked=True)
        if np.ma.getmaskarray(heights).any():
            raise click.UsageError("found a raster with voids, expected one without")
        self.originals = heights.filled().astype(np.float64) * self.frame.metres[2]
        self.modes = {
            order: Batched(ModeNeeds(self.terrain, self.frame), order=order) for order in ORDERS
        }
        self._papers = {order: [self.originals] for order in ORDERS}

    def first(self, pyramid: str, above: int) -> float:
        """Return where a level's first sample is, in samples of the finest level."""
        return ((1 << above) - 1) / 2 if pyramid == "paper" else 0.0

    def apart(self, pyramid: str, order: int, above: int) -> np.ndarray:
        """Return how far originals are from a level's triangles, metres, signed."""
        if pyramid == "paper":
            made = self._papers[order]
            while len(made) <= above:
                made.append(paper_level(made[-1], order))
            vertices = made[above]
        else:
            vertices = our_level(self.modes[order], self.terrain.grid.k_max - above)
        shape = self.originals.shape
        return self.originals - surface(vertices, self.first(pyramid, above), 1 << above, shape)

    def block_errors(self, pyramid: str, order: int) -> dict[Block, float]:
        """Return the largest error in each block, metres."""
        grid, errors = self.terrain.grid, {}
        for above in range(grid.k_max + 1):
            apart = np.abs(self.apart(pyramid, order, above)) if above else None
            first = self.first(pyramid, above)
            for block in grid.blocks(grid.k_max - above):
                errors[block] = 0.0
                if apart is not None:
                    rows, cols = (
                        slice(
                            (number * grid.block << above) + (math.floor(first) if number else 0),
                            ((number + 1) * grid.block << above) + math.ceil(first) + 1,
                        )
                        for number in (block.row, block.col)
                    )
                    errors[block] = float(apart[rows, cols].max(initial=0.0))
        return errors


def level_rows(raster: str, levels: Levels) -> Iterator[LevelRow]:
    """Yield the errors of a terrain's levels."""
    shape = levels.originals.shape
    for above in range(1, levels.terrain.grid.k_max + 1):
        if min(shape) >> above < 16:
            break
        # What lies inside of the paper's outermost samples.
        first, n_cells = math.ceil(levels.first("paper", above)), [(n >> above) - 1 for n in shape]
        rows, cols = (slice(first, first + (n << above)) for n in n_cells)
        for order in ORDERS:
            for pyramid in ("paper", "ours"):
                apart = levels.apart(pyramid, order, above)[rows, cols]
                yield LevelRow(
                    raster, BLOCK, above, (n_cells[0] + 1) * (n_cells[1] + 1), pyramid, order,
                    round(float(np.abs(apart).max()), 3),
                    round(float(np.sqrt(np.square(apart).mean())), 4),
                )  # fmt: skip


def table_of(mode: Batched, errors: dict[Block, float]) -> NodeTable:
    """Return all blocks, as if they were here, with these errors."""
    table = NodeTable()

    def infos(found):
        return [info._replace(error=errors[info.piece.block]) for info in found]

    for info in infos(mode.roots()):
        table.add(info)
    node = 0
    while node < len(table):
        table.add_children(node, infos(mode.children(table.pieces[node])))
        node += 1
    table.is_resident[:] = True
    table.n_triangles[:] = n_grid_triangles(mode.terrain.grid.block)
    return table


def triangle_rows(raster: str, levels: Levels) -> Iterator[TriangleRow]:
    """Yield what is drawn of a terrain."""
    cameras = [home(levels.frame.box, VIEWPORT)]
    cameras += [camera_at_key(levels.frame, key) for key in KEYS]
    grid = levels.terrain.grid
    blocks = [block for level in range(grid.k_max + 1) for block in grid.blocks(level)]
    for order in ORDERS:
        mode = levels.modes[order]
        for pyramid, errors, found in (
            ("paper", "measured", levels.block_errors("paper", order)),
            ("ours", "measured", levels.block_errors("ours", order)),
            ("ours", "bound", {block: mode.grid(block).error for block in blocks}),
        ):
            table = table_of(mode, found)
            for tau in TAUS:
                views = [
                    View(camera, VIEWPORT, tau, mode.gamma, is_exact=mode.is_exact)
                    for camera in cameras
                ]
                drawn = [table.select(view, mode.split_error(tau)) for view in views]
                yield TriangleRow(
                    raster, BLOCK, tau, pyramid, order, errors,
                    round(float(np.mean([len(selection.nodes) for selection in drawn])), 1),
                    round(float(np.mean([selection.n_triangles for selection in drawn]))),
                )  # fmt: skip


# Parts: what yields their rows.
PARTS = {"levels": level_rows, "triangles": triangle_rows}


@common.command()
@common.rasters_argument
@common.choices_option("--only", of=PARTS)
def main(paths: list[Path], only: tuple[str, ...], folder: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""

    def rows(part: str) -> Iterator[LevelRow | TriangleRow]:
        for dem in paths:
            file = folder / f"{dem.stem}-lossless.twz"
            if not file.exists():
                terrainwave.compress(dem, file, max_error=0, block=BLOCK, mesh="none", verify=False)
            with terrainwave.open(file) as terrain:
                yield from PARTS[part](dem.stem, Levels(terrain))

    for part in only:
        common.write_rows(out / f"zhang_{part}.csv", rows(part))


if __name__ == "__main__":
    main()
