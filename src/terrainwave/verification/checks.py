"""Check of any mesh against a raster, independent of how meshes are made.

A mesh covers its area once, without folds, cracks and T-junctions, if all its triangles have the
same orientation and the edges with only one triangle are exactly the area's boundary, each once.
Both are checked; in addition the cover around each sample is counted.

Positions are in half samples; heights and errors in 1/16 quanta. With integers all of it is exact;
with floats (meshes cut along a window), points within 1e-6 of an edge count as on it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel

FLOAT_TOLERANCE = 1e-6
# Bound on float64's error for heights below 2^40 sixteenths, in 1/16 quanta.
_FLOAT_LOSS = 2.0**-8
_MAX_PRODUCT = 1 << 61


class CheckedMesh(NamedTuple):
    """A mesh to check; integers or floats.

    `rows`, `cols` are in half samples of the grid used for the check, `heights` in 1/16 quanta.
    `triangles` are clockwise with columns to the right and rows downwards.
    """

    rows: NDArray[Any]
    cols: NDArray[Any]
    heights: NDArray[Any]
    triangles: NDArray[np.integer]

    def on_grid(self, stride: int) -> "CheckedMesh":
        return self._replace(rows=self.rows * stride, cols=self.cols * stride)

    @property
    def is_exact(self) -> bool:
        """Return whether positions and heights are integers, small enough for exact products."""
        if any(v.dtype.kind == "f" for v in (self.rows, self.cols, self.heights)):
            return False
        if not len(self.rows):
            return True
        corners = self.rows[self.triangles], self.cols[self.triangles]
        longest = [int((c.max(axis=1) - c.min(axis=1)).max(initial=0)) for c in corners]
        reach = int(np.abs(self.heights).max()) + (1 << 36)
        return 2 * (longest[0] + 1) * (longest[1] + 1) * reach < _MAX_PRODUCT


@dataclass(frozen=True)
class Deviation:
    """Distance of samples from a mesh; `worst` in 1/16 quanta, rounded up, at (`row`, `col`)."""

    worst: int
    row: int
    col: int
    n_beyond: int
    is_covered: NDArray[np.bool_]


def deviation(
    surface: CheckedMesh,
    samples: NDArray[np.int64],
    valid: NDArray[np.bool_],
    limit: float,
    place: tuple[int, int] = (0, 0),
) -> Deviation:
    """Return the largest vertical distance of valid samples from a surface, in 1/16 quanta.

    Exact, rounded up, if `CheckedMesh.is_exact`; otherwise it may be up to 2^-8 too small. Samples
    further away than `limit` are counted; the first sample lies at `place`.
    """
    kind = np.int64 if surface.is_exact else np.float64
    loss = 0 if surface.is_exact else _FLOAT_LOSS
    covered = np.zeros(samples.shape, dtype=np.bool_)
    beyond = np.zeros(samples.shape, dtype=np.bool_)
    typed = CheckedMesh(
        surface.rows.astype(kind), surface.cols.astype(kind), surface.heights.astype(kind),
        np.ascontiguousarray(surface.triangles),
    )  # fmt: skip
    worst, row, col = _deviation(
        typed, samples, np.ascontiguousarray(valid), float(limit), (kind(place[0]), kind(place[1])),
        kind(0) if surface.is_exact else FLOAT_TOLERANCE, kind(loss), covered, beyond,
    )  # fmt: skip
    return Deviation(int(worst), int(row), int(col), int(np.count_nonzero(beyond)), covered)


@kernel
def _deviation(surface, samples, valid, limit, place, tolerance, loss, covered, beyond):
    rows, cols, heights, triangles = surface
    first_row, first_col = place
    n_rows, n_cols = samples.shape
    worst, worst_row, worst_col = np.float64(0), -1, -1
    for t in range(triangles.shape[0]):
        p, q, s = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        r_0, r_1, r_2 = rows[p] - 2 * first_row, rows[q] - 2 * first_row, rows[s] - 2 * first_row
        top = max(int(np.ceil(min(r_0, r_1, r_2) / 2)), 0)
        bottom = min(int(np.floor(max(r_0, r_1, r_2) / 2)), n_rows - 1)
        if top > bottom:
            continue
        c_0, c_1, c_2 = cols[p] - 2 * first_col, cols[q] - 2 * first_col, cols[s] - 2 * first_col
        left = max(int(np.ceil(min(c_0, c_1, c_2) / 2)), 0)
        right = min(int(np.floor(max(c_0, c_1, c_2) / 2)), n_cols - 1)
        area = (c_1 - c_0) * (r_2 - r_0) - (c_2 - c_0) * (r_1 - r_0)
        if area <= 0:
            continue
        for row in range(top, bottom + 1):
            for col in range(left, right + 1):
                # Twice the areas of the triangles of the sample with each edge.
                w_0 = (c_1 - 2 * col) * (r_2 - 2 * row) - (c_2 - 2 * col) * (r_1 - 2 * row)
                w_1 = (c_2 - 2 * col) * (r_0 - 2 * row) - (c_0 - 2 * col) * (r_2 - 2 * row)
                w_2 = area - w_0 - w_1
                if w_0 < -tolerance or w_1 < -tolerance or w_2 < -tolerance:
                    continue
                if not valid[row, col]:
                    continue
                covered[row, col] = True
                sample = samples[row, col]
                apart = abs(
                    w_0 * (heights[p] - sample) + w_1 * (heights[q] - sample)
                    + w_2 * (heights[s] - sample)
                ) - loss * area  # fmt: skip
                # Integers: exact, as limit is one; floats: less their possible error.
                up = -(-apart // area)
                if up > worst:
                    worst, worst_row, worst_col = np.float64(up), row, col
                if up > limit:
                    beyond[row, col] = True
    return worst, worst_row, worst_col


# Cover of a quad a b (upper), d c (lower) by a mesh, seen from a downwards and to the right, and
# from c upwards and to the left: all of it, or one of four triangles.
_A_DOWN, _A_RIGHT, _C_UP, _C_LEFT = 1, 2, 4, 8
NOTHING, WHOLE = 0, 15
ABC, ACD, ABD, BCD = _A_RIGHT | _C_UP, _A_DOWN | _C_LEFT, _A_DOWN | _A_RIGHT, _C_UP | _C_LEFT


def coverage(
    surface: CheckedMesh, shape: tuple[int, int]
) -> tuple[NDArray[np.uint8], int, tuple[int, int] | None]:
    """Measure the cover of each quad by a surface over `shape` samples.

    Returns the pieces (`WHOLE`, `NOTHING`, `ABC` …, or another number if the cover is impossible),
    the number of positions covered twice, and the sample next to one of these.
    """
    is_exact = all(v.dtype.kind != "f" for v in (surface.rows, surface.cols))
    kind = np.int64 if is_exact else np.float64
    pieces = np.zeros((shape[0] - 1, shape[1] - 1), dtype=np.uint8)
    n_twice, row, col = _coverage(
        surface.rows.astype(kind), surface.cols.astype(kind),
        np.ascontiguousarray(surface.triangles), kind(0) if is_exact else FLOAT_TOLERANCE, pieces,
    )  # fmt: skip
    return pieces, int(n_twice), (int(row), int(col)) if n_twice else None


@kernel
def _sign(value, first, second, tolerance):
    """Return the sign of value + e * first + e^2 * second for a tiny e > 0."""
    if abs(value) > tolerance:
        return 1 if value > 0 else -1
    if abs(first) > tolerance:
        return 1 if first > 0 else -1
    return 1 if second > 0 else -1


@kernel
def _coverage(rows, cols, triangles, tolerance, pieces):
    n_rows, n_cols = pieces.shape
    n_twice, twice_row, twice_col = 0, -1, -1
    for t in range(triangles.shape[0]):
        p, q, s = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        r_0, r_1, r_2 = rows[p], rows[q], rows[s]
        c_0, c_1, c_2 = cols[p], cols[q], cols[s]
        if (c_1 - c_0) * (r_2 - r_0) - (c_2 - c_0) * (r_1 - r_0) <= 0:
            continue
        top = max(int(np.ceil((min(r_0, r_1, r_2) - tolerance) / 2)), 0)
        bottom = min(int(np.floor((max(r_0, r_1, r_2) + tolerance) / 2)), n_rows)
        left = max(int(np.ceil((min(c_0, c_1, c_2) - tolerance) / 2)), 0)
        right = min(int(np.floor((max(c_0, c_1, c_2) + tolerance) / 2)), n_cols)
        for row in range(top, bottom + 1):
            for col in range(left, right + 1):
                w_0 = (c_1 - 2 * col) * (r_2 - 2 * row) - (c_2 - 2 * col) * (r_1 - 2 * row)
                w_1 = (c_2 - 2 * col) * (r_0 - 2 * row) - (c_0 - 2 * col) * (r_2 - 2 * row)
                w_2 = (c_0 - 2 * col) * (r_1 - 2 * row) - (c_1 - 2 * col) * (r_0 - 2 * row)
                if w_0 < -tolerance or w_1 < -tolerance or w_2 < -tolerance:
                    continue
                for k in range(4):
                    # From the quad's corner a down, right; from its corner c up, left.
                    at_row, at_col = (row, col) if k < 2 else (row - 1, col - 1)
                    if not (0 <= at_row < n_rows and 0 <= at_col < n_cols):
                        continue
                    way = 1 if k < 2 else -1
                    inside = True
                    for edge in range(3):
                        if edge == 0:
                            w, g_r, g_c = w_0, c_2 - c_1, r_1 - r_2
                        elif edge == 1:
                            w, g_r, g_c = w_1, c_0 - c_2, r_2 - r_0
                        else:
                            w, g_r, g_c = w_2, c_1 - c_0, r_0 - r_1
                        if k == 0 or k == 2:
                            inside &= _sign(w, way * g_r, way * g_c, tolerance) > 0
                        else:
                            inside &= _sign(w, way * g_c, way * g_r, tolerance) > 0
                    if not inside:
                        continue
                    if pieces[at_row, at_col] & (1 << k):
                        n_twice += 1
                        twice_row, twice_col = row, col
                    pieces[at_row, at_col] |= np.uint8(1 << k)
    return n_twice, twice_row, twice_col


def pieces_of_mask(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the cover of a mesh of all samples: quads of four valid ones, else triangles."""
    a, b, d, c = mask[:-1, :-1], mask[:-1, 1:], mask[1:, :-1], mask[1:, 1:]
    pieces = np.zeros(a.shape, dtype=np.uint8)
    pieces[a & b & c & d] = WHOLE
    for piece, out, others in (
        (BCD, a, (b, c, d)), (ACD, b, (a, c, d)), (ABD, c, (a, b, d)), (ABC, d, (a, b, c)),
    ):  # fmt: skip
        pieces[~out & others[0] & others[1] & others[2]] = piece
    return pieces


def refined_pieces(pieces: NDArray[np.uint8], stride: int) -> NDArray[np.uint8]:
    """Spread areas covered over the quads of a grid `stride` times finer."""
    row, col = np.indices((stride, stride))
    table = np.zeros((16, stride, stride), dtype=np.uint8)
    table[WHOLE] = WHOLE
    for piece, depth, on in (
        (ABC, col - row, ABC), (ACD, row - col, ACD),
        (ABD, stride - 1 - row - col, ABD), (BCD, row + col - stride + 1, BCD),
    ):  # fmt: skip
        table[piece] = np.where(depth > 0, WHOLE, np.where(depth == 0, on, NOTHING))
    n_rows, n_cols = pieces.shape
    fine = table[pieces].transpose(0, 2, 1, 3)
    return fine.reshape(n_rows * stride, n_cols * stride)


def _unit_edges(pieces: NDArray[np.uint8]) -> list[tuple[NDArray[np.bool_], tuple[int, ...]]]:
    """Return, for each kind of edge of a quad, the pieces that have it, and its two corners."""
    corners = {"a": (0, 0), "b": (0, 1), "c": (1, 1), "d": (1, 0)}
    kinds = (
        ("ab", (WHOLE, ABC, ABD)), ("bc", (WHOLE, ABC, BCD)), ("cd", (WHOLE, ACD, BCD)),
        ("da", (WHOLE, ACD, ABD)), ("ca", (ABC,)), ("ac", (ACD,)), ("bd", (ABD,)), ("db", (BCD,)),
    )  # fmt: skip
    return [
        (np.isin(pieces, having), corners[ends[0]] + corners[ends[1]]) for ends, having in kinds
    ]


def boundary_of_pieces(
    pieces: NDArray[np.uint8],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (rows, cols) of both ends of the boundary's edges, in half samples, clockwise."""
    edges = []
    has = _unit_edges(pieces)
    (above, _), (right, _), (below, _), (left, _) = has[:4]
    lonely = [above.copy(), right.copy(), below.copy(), left.copy()]
    lonely[0][1:] &= ~below[:-1]
    lonely[2][:-1] &= ~above[1:]
    lonely[3][:, 1:] &= ~right[:, :-1]
    lonely[1][:, :-1] &= ~left[:, 1:]
    for k, (where, (r_0, c_0, r_1, c_1)) in enumerate(has):
        at = np.argwhere(lonely[k] if k < 4 else where)
        edges.append(at[:, [0, 1, 0, 1]] + np.array([r_0, c_0, r_1, c_1]))
    both = 2.0 * np.concatenate(edges)
    return both[:, [0, 2]], both[:, [1, 3]]


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
