"""Mesh of a tile: made of its heights, rounded to the steps of its file, and measured.

On the finest zoom the raster's own samples are inserted where the mesh is too far from them. Edges
do not change, so that adjacent tiles agree.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.export.curvature import GlobeWay, curvature
from terrainwave.export.quantized_mesh import STEPS, in_order_of_use, tile_bytes
from terrainwave.globe.tile_heights import UNIT, TileHeights, TileSamples
from terrainwave.globe.tile_scheme import TileScheme
from terrainwave.mesh.blocks import BlockSamples, SideTolerances, border_lines
from terrainwave.mesh.mesh_data import MeshData
from terrainwave.place.description import GEOGRAPHIC
from terrainwave.place.position import Place
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.halves.borders import beside_void
from terrainwave.tri.halves.halves import triangulate
from terrainwave.tri.insertion import insert_points
from terrainwave.tri.mesh_distance import deviation_at_points

_SMALLEST_STEP = 1.0 / (1 << FRACTION_BITS)


class TileMesh(NamedTuple):
    """A tile and its errors."""

    data: bytes  # the .terrain file
    n_vertices: int
    n_triangles: int
    # metres. No sample of the level read, and no bilinear height at the tile's cells, is further
    # from the tile's surface; on the finest zoom no sample of the full grid. It includes the
    # globe's curvature between vertices. None if no triangle has valid heights at all its corners.
    surface_error: float | None
    # the same, plus the distance of originals from the level's bilinear surface
    error: float | None


class TileMesher:
    """Meshes of the tiles of a scheme, within the tolerance of their heights."""

    def __init__(self, scheme: TileScheme, heights: TileHeights) -> None:
        self._scheme, self._heights = scheme, heights
        globe = scheme.globe
        self._way = GlobeWay(Place(GEOGRAPHIC, 1.0, globe.ellipsoid, globe.body), 1.0)

    def _mesh(self, samples: TileSamples, zoom: int) -> BlockMesh:
        """Return the mesh of a tile's heights, in half cells from its north-west corner."""
        inner = slice(1, -1)
        heights = np.ascontiguousarray(samples.heights[inner, inner])
        # Vertices stay on both sides of a void's edge, so that it is as steep as the cells allow.
        locked = _edges_of(samples.valid, samples.exists)
        spacing = self._scheme.lattice(zoom, self._heights.curvature_tolerance(zoom))
        locked[::spacing, ::spacing] = True
        if samples.holes.any():  # no triangle may connect a hole with the outside of the raster
            locked |= _edges_of(samples.holes, samples.exists)
        tolerance = math.floor(self._heights.tolerance(zoom) / UNIT * (1 << FRACTION_BITS))
        # Nothing is inserted into edges later.
        at_edges = math.floor(self._heights.edge_tolerance(zoom) / UNIT * (1 << FRACTION_BITS))
        lines = border_lines(
            BlockSamples(heights, samples.valid[inner, inner], locked),
            SideTolerances(at_edges, at_edges, at_edges, at_edges),
            self._scheme.cells,
        )
        everywhere = np.ones_like(locked)
        mesh = triangulate(heights, everywhere, locked, lines, tolerance)
        if (_areas(_rounded(mesh, self._scheme.cells)) <= 0).any():
            # Rounding has turned a sliver over: use all cells.
            mesh = triangulate(heights, everywhere, everywhere, lines, tolerance)
        return mesh

    def tile(self, zoom: int, x: int, y: int) -> TileMesh:
        samples = self._heights.samples(zoom, x, y)
        mesh = self._mesh(samples, zoom)
        # A vertex of a merged cell has only valid heights, or only voids.
        at = tuple(np.rint(values).astype(np.int64) >> 1 for values in (mesh.rows, mesh.cols))
        is_valid, is_hole = samples.valid[1:-1, 1:-1][at], samples.holes[1:-1, 1:-1][at]
        if is_hole.any():
            mesh = _without(mesh, is_hole)
        if self._scheme.is_finest(zoom) and samples.window is not None:
            found = self._heights.samples_in_tile(samples.window, zoom, x, y)
            mesh = self._with_exact_heights(mesh, samples)
            mesh = self._with_samples(mesh, is_valid, *found, self._heights.edge_tolerance(zoom))
            n_more = len(mesh.rows) - len(is_valid)
            is_valid = np.concatenate([is_valid, np.ones(n_more, dtype=np.bool_)])
        order, turned = in_order_of_use(mesh.triangles[:, ::-1])
        mesh = BlockMesh(mesh.rows[order], mesh.cols[order], mesh.heights[order], turned[:, ::-1])
        is_valid = is_valid[order]
        size = 180 / (1 << zoom)
        west, south = -180 + x * size, -90 + y * size
        low, step = self._height_steps(mesh, zoom)
        steps = np.rint((mesh.heights / (1 << FRACTION_BITS) - low) / step)
        whole = np.rint((low + steps * step) * (1 << FRACTION_BITS)).astype(np.int64)
        mesh = _rounded(mesh, self._scheme.cells)._replace(heights=whole)
        u = mesh.cols / (2 * self._scheme.cells) * STEPS
        v = STEPS - mesh.rows / (2 * self._scheme.cells) * STEPS
        quantized = np.rint(np.stack([u, v, steps], axis=1)).astype(np.int16)
        lon, lat = west + quantized[:, 0] / STEPS * size, south + quantized[:, 1] / STEPS * size
        points = np.column_stack([lon, lat, (low + steps * step) * UNIT])
        surface_error, error = self._errors(mesh, is_valid, samples, zoom, x, y)
        if surface_error is not None and error is not None:
            known = mesh.triangles[_all_of(is_valid, mesh.triangles)]
            on_globe = MeshData(points, known, (0.0, 0.0, 0.0), error)
            sag = curvature(on_globe, self._way)
            surface_error, error = surface_error + sag, error + sag
        heights = low * UNIT, (low + STEPS * step) * UNIT
        about: dict[str, Any] = {
            "bounds": [west, south, west + size, south + size],
            "geometricerror": error,
            "surfaceerror": surface_error,
        }
        if zoom == 0:
            about["available"] = self._scheme.availability(1)
        ellipsoid = self._scheme.globe.ellipsoid
        data = tile_bytes(points, quantized, turned, heights, ellipsoid, about)
        return TileMesh(data, len(points), len(turned), surface_error, error)

    def _height_steps(self, mesh: BlockMesh, zoom: int) -> tuple[int, float]:
        """Return the lowest height and the step of a tile's heights, in units.

        The step is the edges' one, halved as often as the tile's range and float32 allow.
        """
        edge_step = self._heights.edge_step(zoom)
        low = math.floor(int(mesh.heights.min()) / (edge_step << FRACTION_BITS)) * edge_step
        highest = int(mesh.heights.max()) / (1 << FRACTION_BITS)
        step = float(edge_step)
        while (
            step > _SMALLEST_STEP
            and highest - low <= STEPS * step / 2
            and np.float32((low + STEPS * step / 2) * UNIT) == (low + STEPS * step / 2) * UNIT
        ):
            step /= 2
        return low, step

    def _with_exact_heights(self, mesh: BlockMesh, samples: TileSamples) -> BlockMesh:
        """Return a mesh whose vertices inside the tile have the raster's bilinear heights.

        Vertices of merged cells have other heights, within a coarse tolerance, and inserted samples
        next to them would stand out. Vertices next to voids do not change.
        """
        last = 2 * self._scheme.cells
        rows, cols = (np.rint(values).astype(np.int64) for values in (mesh.rows, mesh.cols))
        exact, valid = samples.exact[1:-1, 1:-1], samples.valid[1:-1, 1:-1]
        is_inside = (np.minimum(rows, cols) > 0) & (np.maximum(rows, cols) < last)
        total = np.zeros(len(rows))
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            at = (rows + down) >> 1, (cols + right) >> 1
            total += exact[at]
            is_inside &= valid[at]
        heights = mesh.heights.copy()
        heights[is_inside] = np.rint(total[is_inside] / 4 / UNIT * (1 << FRACTION_BITS))
        return mesh._replace(heights=heights)

    def _with_samples(
        self,
        mesh: BlockMesh,
        is_valid: NDArray[np.bool_],
        places: tuple[NDArray[np.float64], NDArray[np.float64]],
        heights: NDArray[np.float64],
        tolerance: float,
    ) -> BlockMesh:
        """Insert the samples that are further from a mesh than the tolerance, in metres.

        `places` are rows and columns in cells; new vertices follow the mesh's own.
        """
        cells = self._scheme.cells
        scale, fine = STEPS / (2 * cells), 1 << FRACTION_BITS
        rounded = _rounded(mesh, cells)
        # The positions that a tile can represent; its v counts from the south.
        own = np.rint(np.stack([rounded.cols, rounded.rows], axis=1) * scale).astype(np.int64)
        rows, cols = places
        points = np.stack([np.rint(cols * 2 * scale), STEPS - np.rint(STEPS - rows * 2 * scale)], 1)
        inserted, triangles = insert_points(
            own, mesh.heights.astype(np.float64), mesh.triangles,
            _all_of(is_valid, mesh.triangles), points.astype(np.int64), heights / UNIT * fine,
            tolerance / UNIT * fine,
        )  # fmt: skip
        found = points[inserted] / scale
        more = np.rint(heights[inserted] / UNIT * fine).astype(mesh.heights.dtype)
        return BlockMesh(
            np.concatenate([rounded.rows, found[:, 1]]),
            np.concatenate([rounded.cols, found[:, 0]]),
            np.concatenate([mesh.heights, more]),
            triangles,
        )

    def _errors(
        self,
        mesh: BlockMesh,
        is_valid: NDArray[np.bool_],
        samples: TileSamples,
        zoom: int,
        x: int,
        y: int,
    ) -> tuple[float | None, float | None]:
        """Return `TileMesh.surface_error` and `TileMesh.error`, without the globe's curvature."""
        if samples.window is None:
            return None, None
        (rows_, cols_), there = self._heights.samples_in_tile(samples.window, zoom, x, y)
        if not (self._scheme.is_finest(zoom) and len(rows_)):
            inner = slice(1, -1)
            rows, cols = np.nonzero(samples.valid[inner, inner])
            rows_, cols_ = np.concatenate([rows, rows_]), np.concatenate([cols, cols_])
            there = np.concatenate([samples.exact[inner, inner][rows, cols], there])
        worst, n_points = deviation_at_points(
            mesh,
            _all_of(is_valid, mesh.triangles),
            rows_.astype(np.float64),
            cols_.astype(np.float64),
            there / UNIT * (1 << FRACTION_BITS),
            self._scheme.cells,
        )
        if not n_points:
            return None, None
        error = worst / (1 << FRACTION_BITS) * UNIT
        return error, error + self._scheme.globe.heights_error(samples.window)


def _edges_of(is_so: NDArray[np.bool_], exists: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the samples on both sides of an area's edge, without the ring around all."""
    outer, inner = beside_void(is_so | ~exists), beside_void(~is_so | ~exists)
    return np.where(is_so[1:-1, 1:-1], outer, inner)


def _rounded(mesh: BlockMesh, cells: int) -> BlockMesh:
    """Return a mesh rounded to positions that a tile can represent."""
    scale = STEPS / (2 * cells)
    rows = (STEPS - np.rint(STEPS - mesh.rows * scale)) / scale
    return mesh._replace(rows=rows, cols=np.rint(mesh.cols * scale) / scale)


def _areas(mesh: BlockMesh) -> NDArray[np.float64]:
    r, c = mesh.rows[mesh.triangles], mesh.cols[mesh.triangles]
    areas: NDArray[np.float64] = (c[:, 1] - c[:, 0]) * (r[:, 2] - r[:, 0])
    areas -= (c[:, 2] - c[:, 0]) * (r[:, 1] - r[:, 0])
    return areas


def _all_of(is_so: NDArray[np.bool_], triangles: NDArray[np.int32]) -> NDArray[np.bool_]:
    a, b, c = (is_so[triangles[:, corner]] for corner in range(3))
    found: NDArray[np.bool_] = a & b & c
    return found


def _without(mesh: BlockMesh, is_hole: NDArray[np.bool_]) -> BlockMesh:
    """Return a mesh without the triangles of holes; if none is left, with one of zero size."""
    kept = mesh.triangles[_all_of(~is_hole, mesh.triangles)]
    return mesh._replace(triangles=kept if len(kept) else np.zeros((1, 3), dtype=np.int32))
