"""Cover of each quad of a grid: by a mesh, and by the valid samples."""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.verification.checked_mesh import FLOAT_TOLERANCE, CheckedMesh

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
