"""Blocks that have meshes, and the codes of their errors, without making any mesh."""

import math
from collections.abc import Iterable, Mapping
from fractions import Fraction

import numpy as np

from terrainwave.codec.refiner import Mask
from terrainwave.container.header import MAX_MESH_TOLERANCE
from terrainwave.container.page import UNMEASURED, decode_error, encode_error
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.tri.block_mesh import FRACTION_BITS


def has_triangles(mask: Mask) -> bool:
    """Return whether some quad of samples has at least three valid corners."""
    if np.count_nonzero(mask[:2, :2]) >= 3:  # nearly everywhere
        return True
    corners = mask.astype(np.uint8)
    counts = corners[:-1, :-1] + corners[:-1, 1:] + corners[1:, :-1] + corners[1:, 1:]
    return bool((counts >= 3).any())


def full_shape(grid: Grid, block: Block) -> tuple[int, int]:
    """Return a block's numbers of rows and columns, including those past the raster's edge."""
    stride = grid.stride(block.level)
    n_rows = min(grid.block, -(-(grid.n_rows - 1) // stride) - block.row * grid.block) + 1
    n_cols = min(grid.block, -(-(grid.n_cols - 1) // stride) - block.col * grid.block) + 1
    return n_rows, n_cols


def has_mesh(grid: Grid, block: Block, mask: Mask) -> bool:
    """Return whether a block has a mesh, by the validity of its samples inside the raster."""
    if has_triangles(mask):
        return True
    outside = [(0, n - own) for n, own in zip(full_shape(grid, block), mask.shape, strict=True)]
    return has_triangles(np.pad(mask, outside, mode="edge"))


def mesh_tolerance(error: Fraction, quantum: Fraction) -> int:
    """Return an error as the tolerance in a header: in 1/16 quanta, rounded down."""
    return min(int(error / quantum * (1 << FRACTION_BITS)), MAX_MESH_TOLERANCE)


def sum_code(error_code: int, tolerance: int) -> int:
    """Return the code of Err_Appr + Err_Tri, rounded up."""
    own = decode_error(error_code) << FRACTION_BITS
    return encode_error(-(-(own + tolerance) // (1 << FRACTION_BITS)))


def unmeasured_codes(
    grid: Grid, meshed: Iterable[Block], errors: Mapping[Block, int], tolerance: int
) -> dict[Block, int]:
    """Return the error codes of unmeasured meshes, for the blocks that have one.

    On the finest level own error plus `tolerance`, in 1/16 quanta, is a bound. On coarse ones it is
    not: codes leave the bound to `BlockMesher.derived_error`.
    """
    return {
        block: sum_code(errors[block], tolerance) if block.level == grid.k_max else UNMEASURED
        for block in meshed
    }


def mesh_codes(errors: dict[Block, int], lost: Fraction) -> dict[Block, int]:
    """Return the codes of errors, in 1/16 quanta, each with `lost` quanta added."""
    return {
        block: encode_error(math.ceil(Fraction(error, 1 << FRACTION_BITS) + lost))
        for block, error in errors.items()
    }
