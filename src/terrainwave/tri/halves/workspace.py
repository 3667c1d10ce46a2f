"""Memory in which `halves` makes a mesh: one int32 array with named offsets, one per thread.

Kernels take it whole, with unsigned offsets: every array argument and every slice in an inner loop
would cost reference counts. Sample (row, col) is number ``row * pitch + col`` of each plane.
"""

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.tri.block_mesh import BlockMesh, used_only

# The table of triangles (`star`): pairs of a key and a program, the number of entries of programs,
# and the samples of the entries.
N_SLOTS_LOG2, N_ENTRIES = 15, 1 << 16
TABLE = 0
N_USED = TABLE + (2 << N_SLOTS_LOG2)
OFFSETS = N_USED + 8
PLANES = OFFSETS + N_ENTRIES
# Offsets in `floats`: the interval found by a test, and three ratios per entry.
LOW, HIGH, RATIOS = 0, 1, 2

# Planes, by sample: its height; the position of its vertex and the vertex's height; its cell's
# level; the sweep in which its cell last grew. At a cell's first sample: the test that refused it
# last, and the samples that this rests on (`certificates`); finally numbers of vertices use this
# plane. The last one is not a plane of samples, but a list of the triangles of one star, two
# numbers each: every star fits into a plane. Plane k begins at ``PLANES + k * plane``, which
# kernels write out, because each small kernel for it would take a tenth of a second to compile.
HEIGHT, VERTEX, LEVEL, SWEEP, REFUSAL, OTHERS = 0, 1, 3, 4, 5, 8
_N_PLANES = 9

# A vertex's position, in half samples: its row, and in the low bits its column.
ROW_BITS, COL_MASK = 16, (1 << 16) - 1

# Levels of single samples that have not moved, of those that never do, and of samples of border
# lines that are not vertices. Up to FREE a sample has not moved.
FREE, LOCKED, MERGED = 0, -1, 127
VOID = -1

# Distance from the first to the last column of a cell whose inner samples are undefined.
WIDE = 7

# Rows of the workspace have 8 samples more than a power of two, so that neighbours in a column
# don't share a cache line.
_MIN_CELLS, _PADDING = 256, 8
# Largest mesh, in samples, whose memory a thread keeps for the next one.
_MAX_KEPT = 1 << 19


class MeshArrays(NamedTuple):
    """A thread's arrays for rectangles of up to `plane` samples, `pitch` from row to row.

    `work` and `floats` have named offsets; the others hold a mesh before it is copied.
    """

    pitch: int
    plane: int
    work: NDArray[np.int32]
    floats: NDArray[np.float64]
    rows: NDArray[np.int32]
    cols: NDArray[np.int32]
    heights: NDArray[np.int64]
    triangles: NDArray[np.int32]


class _Memory(threading.local):
    """Workspace of a thread, which keeps the table of triangles from mesh to mesh."""

    def __init__(self) -> None:
        self._kept: MeshArrays | None = None

    def workspace(self, n_rows: int, n_cols: int) -> MeshArrays:
        """Return a workspace for a rectangle; its planes are uninitialised."""
        pitch = max(_MIN_CELLS, 1 << (n_cols - 2).bit_length()) + _PADDING
        plane = n_rows * pitch
        kept = self._kept
        if kept is not None and kept.pitch == pitch and kept.plane >= plane:
            return kept
        found = _new_workspace(pitch, max(plane, pitch * pitch))
        if found.plane <= _MAX_KEPT:
            self._kept = found
        return found


def _new_workspace(pitch: int, plane: int) -> MeshArrays:
    work = np.empty(PLANES + _N_PLANES * plane, dtype=np.int32)
    work[:OFFSETS] = 0
    return MeshArrays(
        pitch,
        plane,
        work,
        floats=np.empty(RATIOS + 3 * N_ENTRIES, dtype=np.float64),
        rows=np.empty(plane, dtype=np.int32),
        cols=np.empty(plane, dtype=np.int32),
        heights=np.empty(plane, dtype=np.int64),
        triangles=np.empty((2 * plane, 3), dtype=np.int32),
    )


MEMORY = _Memory()


@kernel
def fill_workspace(heights, mask, locked, lines, base, bits, work, plane, pitch):
    """Make every valid sample a vertex; those of border lines share the vertex before them.

    `lines` mark the vertices of the borders: top, bottom, left and right one by one.
    """
    n_rows, n_cols = heights.shape
    own, vertices = PLANES + HEIGHT * plane, PLANES + VERTEX * plane
    levels, sweeps = PLANES + LEVEL * plane, PLANES + SWEEP * plane
    refusals = PLANES + REFUSAL * plane
    for row in range(n_rows):
        is_line = row == 0 or row == n_rows - 1
        first = row * pitch
        # One or two loops for each plane, so that they vectorise.
        for col in range(n_cols):
            height = np.int32((np.int64(heights[row, col]) - base) << bits)
            work[np.uint64(own + first + col)] = height if mask[row, col] else 0
        for col in range(n_cols):
            at = first + col
            place = np.int32(2 * row << ROW_BITS | 2 * col) if mask[row, col] else VOID
            work[np.uint64(vertices + 2 * at)] = place
            work[np.uint64(vertices + 2 * at + 1)] = work[np.uint64(own + at)]
        for col in range(n_cols):
            is_locked = is_line | locked[row, col]
            work[np.uint64(levels + first + col)] = LOCKED if is_locked else FREE
        for col in range(n_cols):
            work[np.uint64(sweeps + first + col)] = 0
        for col in range(n_cols):
            work[np.uint64(refusals + first + col)] = 0
        work[np.uint64(levels + first)] = LOCKED
        work[np.uint64(levels + first + n_cols - 1)] = LOCKED
    first = 0
    for line in range(4):
        count, stride, start = n_cols, 1, 0
        if line == 1:
            start = (n_rows - 1) * pitch
        elif line >= 2:
            count, stride = n_rows, pitch
            start = 0 if line == 2 else n_cols - 1
        last = start
        for k in range(count):
            at = start + k * stride
            if lines[first + k]:
                last = at
            else:
                work[np.uint64(vertices + 2 * at)] = work[np.uint64(vertices + 2 * last)]
                work[np.uint64(vertices + 2 * at + 1)] = work[np.uint64(vertices + 2 * last + 1)]
                work[np.uint64(levels + at)] = MERGED
        first += count


@kernel
def read_mesh(work, plane, pitch, shape, base, shift, mesh):
    """Write the mesh of a workspace; return the numbers of vertices and triangles.

    Vertices in the order of their first samples, triangles in that of their quads. A sample's
    vertex has its number from the sample to the left or above, or is new: cells are rectangles,
    and border lines share the vertex before them. Vertices' heights in 1/16 quanta:
    ``(height << shift) + base``.
    """
    (n_rows, n_cols), (rows, cols, heights, triangles) = shape, mesh
    vertices, numbers = PLANES + VERTEX * plane, PLANES + REFUSAL * plane
    n_vertices = 0
    n_triangles = 0
    for row in range(n_rows):
        first = row * pitch
        last = np.int64(VOID)
        number = np.int64(VOID)
        # Of the quad with this lower right corner: a, b in the upper row; d, c below.
        a = d = np.int64(VOID)
        next_col = 0
        for col in range(n_cols):
            if col < next_col:
                continue
            at = first + col
            place = np.int64(work[np.uint64(vertices + 2 * at)])
            if place == VOID:
                number = np.int64(VOID)
            elif col == 0 or place != last:
                if row and place == work[np.uint64(vertices + 2 * (at - pitch))]:
                    number = np.int64(work[np.uint64(numbers + at - pitch)])
                    right = (place & COL_MASK) - col
                    if right - col >= WIDE:
                        # Skip to the last column of the cell: there are no triangles in between.
                        next_col = right
                        if place != work[np.uint64(vertices + 2 * (at + pitch))]:
                            for k in range(at + 1, first + right):
                                work[np.uint64(numbers + k)] = number  # for the row below
                else:
                    number = np.int64(n_vertices)
                    rows[n_vertices] = place >> ROW_BITS
                    cols[n_vertices] = place & COL_MASK
                    vertex = np.int64(work[np.uint64(vertices + 2 * at + 1)])
                    heights[n_vertices] = (vertex << shift) + base
                    n_vertices += 1
            work[np.uint64(numbers + at)] = number
            last = place
            if row == 0:
                continue
            b, c = np.int64(work[np.uint64(numbers + at - pitch)]), number
            if col == 0:
                a, d = b, c
                continue
            if (a | b | c | d) >= 0:
                if a != c:
                    if a != b and b != c:
                        n_triangles = _write_triangle(triangles, n_triangles, a, b, c)
                    if c != d and d != a:
                        n_triangles = _write_triangle(triangles, n_triangles, a, c, d)
            else:
                p, q, s = _valid_corners(a, b, c, d)
                if p >= 0 and p != q and q != s and p != s:
                    n_triangles = _write_triangle(triangles, n_triangles, p, q, s)
            a, d = b, c
    return n_vertices, n_triangles


@inlined_kernel
def _write_triangle(triangles, n, a, b, c):
    triangles[n, 0], triangles[n, 1], triangles[n, 2] = a, b, c
    return n + 1


@inlined_kernel
def _valid_corners(a, b, c, d):
    """Return the three corners of a quad with one void, -1 if there are more voids."""
    n_voids = (1 if a < 0 else 0) + (1 if b < 0 else 0) + (1 if c < 0 else 0) + (1 if d < 0 else 0)
    if n_voids > 1:
        a = b = c = np.int64(VOID)
    elif a < 0:
        a, b, c = b, c, d
    elif b < 0:
        b, c = c, d
    elif c < 0:
        c = d
    return a, b, c


def finished_mesh(
    space: MeshArrays, shape: tuple[int, int], base: int, shift: int, *, has_voids: bool
) -> BlockMesh:
    """Return the mesh of a workspace, copied; `base` and `shift` as for `read_mesh`.

    Voids leave vertices without triangles behind.
    """
    arrays = space.rows, space.cols, space.heights, space.triangles
    n_vertices, n_triangles = read_mesh(
        space.work, space.plane, space.pitch, shape, base, shift, arrays
    )
    rows, cols = space.rows[:n_vertices], space.cols[:n_vertices]
    heights, triangles = space.heights[:n_vertices], space.triangles[:n_triangles]
    if has_voids:
        return used_only(rows, cols, heights, triangles)
    return BlockMesh(rows.copy(), cols.copy(), heights.copy(), triangles.copy())
