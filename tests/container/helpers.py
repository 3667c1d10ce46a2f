"""Toy files: every payload says whose it is, so that a mix-up shows."""

import io
import tempfile
from fractions import Fraction

from terrainwave.container.header import Header
from terrainwave.container.page import key_blocks, page_layout
from terrainwave.container.spool import SegmentSpool
from terrainwave.container.writer import assemble
from terrainwave.quadtree import Block, Grid


def toy_header(n_rows=5, n_cols=5, block=32, **changes):
    fields = dict(
        n_rows=n_rows,
        n_cols=n_cols,
        block=block,
        border_rings=1,
        method="store",
        dtype="int16",
        effort=5,
        quantum=Fraction(1, 10),
        base=-7,
        step=3,
        z_min=-5,
        z_max=1000,
        max_error=0.1,
        effective_bound=0.1,
        rho=0.0,
        metadata={"transform": [1, 0, 0, 0, -1, 0], "crs": "EPSG:4326", "own": {"a": [1]}},
        parameters=b"par",
    )
    fields.update(changes)
    return Header(**fields)


def toy_payload(key: Block) -> bytes:
    if (key.row + key.col) % 3 == 2:
        return b""
    return f"payload {key.level} {key.row} {key.col};".encode() * (1 + key.row % 3)


def toy_mesh(key: Block) -> bytes:
    return f"mesh {key.level} {key.row} {key.col}".encode() if key.col % 4 == 3 else b""


def toy_flags(key: Block) -> int:
    return (key.row * 5 + key.col + 1) % 256


def toy_codes(block: Block) -> tuple[int, int, int, int]:
    return (block.level, block.row % 256, block.col % 256, (block.row + block.col) % 7)


def toy_spools(grid: Grid, directory, order=lambda keys: keys) -> dict:
    spools = {}
    for head in grid.segment_heads():
        spools[head] = SegmentSpool(directory)
        for key in order(page_layout(grid, head).keys):
            codes = bytes(code for b in key_blocks(grid, key) for code in toy_codes(b))
            spools[head].add(key, toy_payload(key), toy_flags(key), codes, toy_mesh(key))
        spools[head].finish()
    return spools


def toy_file(header=None, order=lambda keys: keys) -> bytes:
    header = header or toy_header()
    with tempfile.TemporaryDirectory() as directory:
        out = io.BytesIO()
        assemble(out, header, toy_spools(header.grid, directory, order))
    return out.getvalue()
