"""The whole file: units from the root down, quantum numbers, raw heights (docs/FORMAT.md §11)."""

from types import SimpleNamespace

import numpy as np

from terrainwave.reference.basics import UnsupportedError, require
from terrainwave.reference.files import DTYPES, METHODS, read_file
from terrainwave.reference.payloads import (
    DECODERS,
    decode_payload,
    nodata_in_dtype,
    raw_height,
    with_remainder,
)

# Methods whose units have several levels, and what decodes one of them.
LEVEL_DECODERS: dict = {}


def block_with_apron(grid, block, holder):
    """Return where the parent heights of a group lie: its block, with the apron (§2.4)."""
    place = SimpleNamespace()
    samples = grid.samples(block[0])
    for name, i, n_samples in zip(("rows", "cols"), block[1:], samples, strict=True):
        first = max(i * grid.n_cells - grid.rings, 0)
        last = min((i + 1) * grid.n_cells + grid.rings, n_samples - 1)
        axis = getattr(holder, name)
        assert axis.first <= first <= last <= axis.last
        setattr(place, name, SimpleNamespace(first=first, last=last, n=last - first + 1))
    return place


def cut(array, holder, place):
    """Cut a place out of the region of the unit that holds it."""
    r, c = place.rows.first - holder.rows.first, place.cols.first - holder.cols.first
    return [row[c : c + place.cols.n] for row in array[r : r + place.rows.n]]


def decode_units(file, level):
    """Return the units of a level: unit, heights, mask, remainders; decodes all above them."""
    grid = file.grid
    holders = {}  # block -> the unit that holds it, decoded
    for k in range(-1, level):
        decoded = []
        for key in grid.root_keys() if k < 0 else grid.blocks(k):
            unit = grid.unit(key)
            if k < 0:
                parent = None, None, None
            else:
                holder, heights, valid, _ = holders[key]
                place = block_with_apron(grid, key, holder)
                place.own = cut(holder.own, holder, place)
                parent = place, cut(heights, holder, place), cut(valid, holder, place)
            decoded.append((unit, *decode_payload(file, unit, file.payloads[key], *parent)))
        holders = {block: one for one in decoded for block in grid.blocks_of_key(one[0].key)}
    return decoded


def decode_quanta(file, level):
    """Return quantum numbers, mask, remainders and own samples; None where not seen."""
    n_rows, n_cols = file.grid.samples(level)
    heights = [[None] * n_cols for _ in range(n_rows)]
    mask, own = ([[None] * n_cols for _ in range(n_rows)] for _ in range(2))
    remainders = [[0] * n_cols for _ in range(n_rows)]
    decode_level = LEVEL_DECODERS.get(METHODS[file.header.method], decode_units)
    for unit, unit_heights, valid, *rest in decode_level(file, level):
        rest = rest[0] if rest and rest[0] else None
        for i in range(unit.rows.n):
            for j in range(unit.cols.n):
                r, c = unit.rows.first + i, unit.cols.first + j
                # §2.4: units that share a sample agree about it.
                if mask[r][c] is not None:
                    require(mask[r][c] == valid[i][j], "masks of neighbours")
                    require(own[r][c] == unit.own[i][j], "own samples of neighbours")
                    same = heights[r][c] == unit_heights[i][j]
                    require(same or not valid[i][j], "heights of neighbours")
                    number = rest[i][j] if rest else 0
                    require(
                        remainders[r][c] == number or not valid[i][j], "remainders of neighbours"
                    )
                heights[r][c], mask[r][c] = unit_heights[i][j], valid[i][j]
                remainders[r][c] = rest[i][j] if rest else 0
                own[r][c] = unit.own[i][j]
    return heights, mask, remainders, own


def decode(data, level=-1):
    """Return the raw heights and the mask of one level; level 0 is the coarsest, -1 the last."""
    return decode_with_own(data, level)[:2]


def decode_with_own(data, level=-1):
    """Return the same and own samples."""
    file = read_file(data)
    method = METHODS[file.header.method]
    is_known = method in DECODERS or method in LEVEL_DECODERS
    require(is_known, f"method {method}, which is not part of this decoder", UnsupportedError)
    quanta, mask, remainders, own = decode_quanta(
        file, level if level >= 0 else level + file.grid.k_max + 1
    )
    dtype = np.dtype(DTYPES[file.header.dtype])
    void = nodata_in_dtype(file)
    if void is None:
        void = np.nan if dtype.kind == "f" else 0
    valid = np.array(mask, bool)
    heights = np.full(valid.shape, void, dtype)
    for r, c in np.argwhere(valid).tolist():
        height = raw_height(file.header, quanta[r][c])
        heights[r, c] = with_remainder(height, remainders[r][c]) if remainders[r][c] else height
    return heights, valid, np.array(own, bool)
