"""Files opened without a `TerrainFile`: their bytes, and no heights; their segments, copied."""

from itertools import chain

from terrainwave.container.page import page_layout
from terrainwave.container.reader import Container
from terrainwave.container.sources.opening import open_source
from terrainwave.container.spool import SectionFile, SegmentSpool


def open_container(source):
    """Return a `Container` of a path, URL, bytes or binary file object."""
    opened = open_source(source)
    try:
        return Container(opened)
    except BaseException:
        opened.close()
        raise


def copied_segments(terrain, mesh_codes, folder):
    """Return the segments of a file with other codes of mesh errors, by their heads."""
    stored, grid, file = terrain.container, terrain.grid, SectionFile(folder)
    spools = {}
    for head in grid.segment_heads():
        spool = spools[head] = SegmentSpool(file)
        for key in page_layout(grid, head).keys:
            codes = [
                [*stored.codes(block)[:3], mesh_codes[block]] for block in grid.key_blocks(key)
            ]
            payload = stored.payloads([key])[0]
            spool.add(key, payload)
            spool.codes[key] = bytes(chain(*codes))
            spool.set_mesh(key, stored.mesh(key))
    return spools
