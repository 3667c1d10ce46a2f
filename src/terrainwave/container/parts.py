"""Sizes of a file's parts (FORMAT.md §3)."""

from dataclasses import dataclass

from terrainwave.container.reader import Container


@dataclass(frozen=True)
class Parts:
    """Bytes of each part of a file; their sum is the file.

    `heights`: payloads of each level, the coarsest first; one number if a payload spans several.
    """

    metadata: int
    tables: int
    index: int
    heights: tuple[int, ...]
    meshes: int
    digests: int


def parts_of(container: Container) -> Parts:
    extents = container.extents
    index, meshes = extents.top_page_length, 0
    heights = [0] * (container.grid.k_max + 1)
    for segment in container.present_segments():
        page = segment.page
        index += int(page.child_page_lengths.sum(dtype="int64"))
        meshes += int(page.mesh_lengths.sum(dtype="int64"))
        for key, length in zip(segment.layout.keys, page.payload_lengths.tolist(), strict=True):
            # The key of a group is the block above it; that of a root lies on level -1.
            heights[key.level + 1] += length
    return Parts(
        extents.parameters_start,
        extents.parameters_length,
        index,
        tuple(heights),
        meshes,
        container.digests_place().length,
    )
