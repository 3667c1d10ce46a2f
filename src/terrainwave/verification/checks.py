"""Check of any mesh against a raster, independent of how meshes are made.

A mesh covers its area once, without folds, cracks and T-junctions, if all its triangles have the
same orientation and the edges with only one triangle are exactly the area's boundary, each once.
Both are checked; in addition the cover around each sample is counted.

Positions are in half samples; heights and errors in 1/16 quanta (`surface`).
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrainwave.verification.checked_mesh import FLOAT_TOLERANCE, CheckedMesh
from terrainwave.verification.pieces import (
    ABC,
    ABD,
    ACD,
    BCD,
    NOTHING,
    WHOLE,
    boundary_of_pieces,
    coverage,
)

_MAX_LISTED = 5


def problems_of(
    surface: CheckedMesh,
    shape: tuple[int, int],
    expected: NDArray[np.uint8] | None = None,
    *,
    at_least: NDArray[np.uint8] | None = None,
) -> Iterator[str]:
    """Check that a surface is a height field over `shape` samples; yield problems.

    `expected` is the exact cover of each quad, `at_least` the least.
    """
    rows, cols, triangles = surface.rows, surface.cols, surface.triangles
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(rows)):
        yield "a triangle names a vertex that does not exist"
        return
    yield from _vertex_problems(surface, shape)
    r, c = rows[triangles], cols[triangles]
    area = (c[:, 1] - c[:, 0]) * (r[:, 2] - r[:, 0]) - (c[:, 2] - c[:, 0]) * (r[:, 1] - r[:, 0])
    n_bad = int(np.count_nonzero(area <= 0))
    if n_bad:
        t = int(np.argmin(area))
        yield (
            f"{n_bad} triangles have no area or are turned over, one near row"
            f" {r[t, 0] / 2:g}, column {c[t, 0] / 2:g}"
        )
    pieces, n_twice, place = coverage(surface, shape)
    if n_twice:
        yield f"{n_twice} places are covered twice, one next to sample {place}"
    whole = np.isin(pieces, (NOTHING, WHOLE, ABC, ACD, ABD, BCD))
    if not whole.all():
        yield f"{np.count_nonzero(~whole)} quads are covered in part, one at {_first(~whole)}"
    more = np.zeros(pieces.shape, bool) if expected is None else (pieces & ~expected) != 0
    if more.any():
        yield f"{np.count_nonzero(more)} quads are covered over a void, one at {_first(more)}"
    least = at_least if expected is None else expected
    less = np.zeros(pieces.shape, bool) if least is None else (least & ~pieces) != 0
    if less.any():
        yield f"{np.count_nonzero(less)} quads are not covered, one at {_first(less)}"
    yield from _edge_problems(surface, pieces)


def _first(where: NDArray[np.bool_]) -> tuple[int, int]:
    row, col = np.argwhere(where)[0].tolist()
    return row, col


def _vertex_problems(surface: CheckedMesh, shape: tuple[int, int]) -> Iterator[str]:
    rows, cols = surface.rows, surface.cols
    if not len(rows):
        return
    is_used = np.zeros(len(rows), dtype=np.bool_)
    is_used[surface.triangles] = True
    if not is_used.all():
        yield f"{np.count_nonzero(~is_used)} vertices are in no triangle"
    if not np.isfinite(surface.heights.astype(np.float64)).all():
        yield "heights are not finite"
    if (
        rows.min() < 0
        or cols.min() < 0
        or rows.max() > 2 * (shape[0] - 1)
        or cols.max() > 2 * (shape[1] - 1)
    ):
        yield "vertices lie outside the area"
    order = np.lexsort((cols, rows))
    near = (np.abs(np.diff(rows[order])) <= FLOAT_TOLERANCE) & (
        np.abs(np.diff(cols[order])) <= FLOAT_TOLERANCE
    )
    if near.any():
        at = order[int(np.argmax(near))]
        yield (
            f"{np.count_nonzero(near)} vertices lie on another one, one at row"
            f" {rows[at] / 2:g}, column {cols[at] / 2:g}"
        )


def boundary_edges(triangles: NDArray[np.integer], n_vertices: int) -> NDArray[np.int64]:
    """Return the directed edges without a triangle in the other direction, shape (n_edges, 2)."""
    edges = _directed_edges(triangles, n_vertices)
    there, back = edges // max(n_vertices, 1), edges % max(n_vertices, 1)
    turned = np.sort(back * n_vertices + there)
    alone = np.searchsorted(turned, edges, "right") == np.searchsorted(turned, edges)
    return np.stack([there[alone], back[alone]], axis=1)


def _directed_edges(triangles: NDArray[np.integer], n_vertices: int) -> NDArray[np.int64]:
    first = triangles.astype(np.int64).ravel()
    second = np.roll(triangles, -1, axis=1).astype(np.int64).ravel()
    return first * n_vertices + second


def _edge_problems(surface: CheckedMesh, pieces: NDArray[np.uint8]) -> Iterator[str]:
    n_vertices = len(surface.rows)
    edges = np.sort(_directed_edges(surface.triangles, n_vertices))
    n_again = int(np.count_nonzero(edges[1:] == edges[:-1]))
    if n_again:
        yield f"{n_again} edges are used twice in the same direction"
    alone = boundary_edges(surface.triangles, n_vertices)
    rows, cols = surface.rows.astype(np.float64), surface.cols.astype(np.float64)
    runs, n_slanted, place = _runs(rows[alone], cols[alone])
    if n_slanted:
        yield (
            f"{n_slanted} edges with a triangle on one side only lie inside the area, one at row"
            f" {place[0] / 2:g}, column {place[1] / 2:g}"
        )
        return
    wanted, _, _ = _runs(*boundary_of_pieces(pieces))
    if len(runs) != len(wanted) or not np.allclose(runs, wanted, rtol=0, atol=FLOAT_TOLERANCE):
        yield (
            "the edges with a triangle on one side only are not the area's boundary:"
            f" {_difference(runs, wanted)}"
        )


def _difference(runs: NDArray[np.float64], wanted: NDArray[np.float64]) -> str:
    only_found = {tuple(run) for run in runs.round(3).tolist()}
    only_wanted = {tuple(run) for run in wanted.round(3).tolist()}
    more = sorted(only_found - only_wanted)[:_MAX_LISTED]
    less = sorted(only_wanted - only_found)[:_MAX_LISTED]
    return f"cracks along (row step, column step, line, from, to) {more} instead of {less}"


def _runs(
    rows: NDArray[np.float64], cols: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int, tuple[float, float]]:
    """Join directed edges that continue each other on a line; both ends in columns 0 and 1.

    Returns the runs, sorted (row step, column step, line, from, to), the number of edges neither
    along the grid nor along its diagonals, and row and column of one of these.
    """
    down, right = rows[:, 1] - rows[:, 0], cols[:, 1] - cols[:, 0]
    longest = np.maximum(np.abs(down), np.abs(right))
    if not len(longest):
        return np.empty((0, 5)), 0, (0.0, 0.0)
    step_row, step_col = down / longest, right / longest
    slanted = np.zeros(len(longest), dtype=np.bool_)
    for part in (step_row, step_col):
        slanted |= np.abs(part - np.rint(part)) * longest > FLOAT_TOLERANCE
    step_row, step_col = np.rint(step_row), np.rint(step_col)
    line = np.where(step_row == 0, rows[:, 0], step_row * cols[:, 0] - step_col * rows[:, 0])
    line = np.rint(line * 1e6) / 1e6
    along = np.where((step_row == 0)[:, None], cols, rows)
    start, stop = along.min(axis=1), along.max(axis=1)
    order = np.lexsort((start, line, step_col, step_row))
    parts = np.stack([step_row, step_col, line, start, stop], axis=1)[order]
    goes_on = np.abs(parts[1:, 3] - parts[:-1, 4]) <= FLOAT_TOLERANCE
    goes_on &= (parts[1:, :3] == parts[:-1, :3]).all(axis=1)
    first = np.concatenate([[True], ~goes_on])
    last = np.concatenate([~goes_on, [True]])
    runs = np.concatenate([parts[first, :4], parts[last, 4:]], axis=1)
    at = int(np.argmax(slanted))
    return runs, int(np.count_nonzero(slanted)), (float(rows[at, 0]), float(cols[at, 0]))
