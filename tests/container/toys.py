"""Toy files: every payload says whose it is, so that a mix-up shows."""

import io
import tempfile
import zlib
from dataclasses import replace
from fractions import Fraction

from containers import open_container

from terrainwave.container.header import Extents, Header, pack_header
from terrainwave.container.metadata import pack_metadata
from terrainwave.container.page import (
    pack_columns,
    pack_page,
    page_layout,
    page_length,
)
from terrainwave.container.spool import SectionFile, SegmentSpool
from terrainwave.container.writer import assemble
from terrainwave.grid.quadtree import Block, Grid


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
        file_tables=b"par",
    )
    fields.update(changes)
    return Header(**fields)


def toy_payload(key: Block) -> bytes:
    if (key.row + key.col) % 3 == 2:
        return b""
    return f"payload {key.level} {key.row} {key.col};".encode() * (1 + key.row % 3)


def toy_mesh(key: Block) -> bytes:
    return f"mesh {key.level} {key.row} {key.col}".encode() if key.col % 4 == 3 else b""


def toy_codes(block: Block) -> tuple[int, int, int, int]:
    return (block.level, block.row % 256, block.col % 256, (block.row + block.col) % 7)


def toy_spools(grid: Grid, directory, order=lambda keys: keys) -> dict:
    spools = {}
    for head in grid.segment_heads():
        spools[head] = SegmentSpool(SectionFile(directory))
        for key in order(page_layout(grid, head).keys):
            codes = bytes(code for b in grid.key_blocks(key) for code in toy_codes(b))
            spools[head].add(key, toy_payload(key))
            spools[head].set_mesh(key, toy_mesh(key))
            spools[head].codes[key] = codes
    return spools


def toy_file(header=None, order=lambda keys: keys) -> bytes:
    header = header or toy_header()
    with tempfile.TemporaryDirectory() as directory:
        out = io.BytesIO()
        assemble(out, header, toy_spools(header.grid, directory, order))
    return out.getvalue()


def forge(header, page, body=b"", rest=b"", first_child=None, metadata=None, pages=None):
    """Return a file whose checksums are right, whatever else is wrong with it.

    `pages` are those of the top segment's children, by default zeros, `body` is what follows them,
    `metadata` are the bytes of the deflated JSON, `first_child` is relative to its true place.
    """
    body = (bytes(page.child_page_lengths.sum()) if pages is None else pages) + body
    metadata = pack_metadata(header.metadata) if metadata is None else metadata
    columns = pack_columns(page)
    extents = Extents(
        file_size=0,
        metadata_length=len(metadata),
        metadata_crc=zlib.crc32(metadata),
        parameters_length=len(header.file_tables),
        parameters_crc=zlib.crc32(header.file_tables),
        top_page_length=page_length(columns),
    )
    end = extents.top_start + extents.top_page_length + len(body)
    has_children = len(page.child_lengths) > 0
    start = (end if has_children else 0) + (first_child or 0)
    extents = replace(extents, file_size=end + len(rest))
    parts = pack_header(header, extents), metadata, header.file_tables, pack_page(columns, start)
    return b"".join((*parts, body, rest))


def read_everything(data: bytes) -> dict:
    """Return all payloads, meshes and codes of a file."""
    found = {}
    with open_container(data) as container:
        for head in container.grid.segment_heads():
            layout = page_layout(container.grid, head)
            for key, payload in zip(layout.keys, container.payloads(layout.keys)):
                found[key] = payload, container.mesh(key)
            for block in layout.blocks:
                found["codes", block] = container.codes(block)
    return found


def everything_expected(grid: Grid) -> dict:
    """Return what `read_everything` finds in a toy file."""
    found = {}
    for head in grid.segment_heads():
        layout = page_layout(grid, head)
        for key in layout.keys:
            found[key] = toy_payload(key), toy_mesh(key)
        for block in layout.blocks:
            found["codes", block] = toy_codes(block)
    return found


def paths_to_corner(grid, row, col):
    """Return the keys of the four groups of the finest level that meet there, and all above."""
    keys = {Block(grid.k_max - 1, r, c) for r in (row - 1, row) for c in (col - 1, col)}
    for key in list(keys):
        while key.level:
            key = key.parent
            keys.add(key)
    return [Block(-1, 0, 0), *sorted(keys)]
