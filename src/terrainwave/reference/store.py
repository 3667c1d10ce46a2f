"""Method store (docs/FORMAT.md §8)."""

import struct

from terrainwave.reference.basics import ceil_div, clamp, require


def decode_store(file, unit, payload, valid, parent_unit, parent_heights):
    h = file.header
    n_rows, n_cols = unit.rows.n, unit.cols.n
    heights = [[0] * n_cols for _ in range(n_rows)]
    require(len(payload) >= 5, "payload of store is cut off")
    low, n_bits = struct.unpack("<iB", payload[:5])
    require(n_bits <= 31, "n_bits")
    stored = []
    for r in range(n_rows):
        for c in range(n_cols):
            row, col = unit.rows.first + r, unit.cols.first + c
            if parent_unit is not None and row % 2 == 0 and col % 2 == 0:
                heights[r][c] = parent_heights[row // 2 - parent_unit.rows.first][
                    col // 2 - parent_unit.cols.first
                ]
            elif valid[r][c]:
                stored.append((r, c))
    require(len(payload) == 5 + ceil_div(n_bits * len(stored), 8), "length of a payload of store")
    bits = int.from_bytes(payload[5:], "big")
    n_left = 8 * (len(payload) - 5)
    for r, c in stored:
        n_left -= n_bits
        index = low + (bits >> n_left & ((1 << n_bits) - 1))
        z = h.z_min + index * h.step + (h.step - 1) // 2
        heights[r][c] = clamp(z, h.z_min, h.z_max)
    return heights
