"""Mesh sections: the bytes of meshes, stored with payloads (FORMAT.md §4.5)."""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from functools import lru_cache

from terrainwave.codec.varint import decode_varint, encode_varint
from terrainwave.errors import CorruptStreamError, TruncatedStreamError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.mesh.blocks import BlockMesher, LevelSamples
from terrainwave.mesh.trees import ZeroTrees, coefficient_source, tree_source
from terrainwave.read.decoder import TreeDecoder, unit_key
from terrainwave.tri.stored_kinds import STORED_KINDS, Draft
from terrainwave.tri.zerotree.agreement import BorderVertices, Position, agree

_CACHED_SECTIONS = 64


def pack_section(parts: list[bytes]) -> bytes:
    """Return the section of a key: the parts of its blocks, each after its length.

    A section with only empty parts is empty, so that void areas take no bytes.
    """
    if not any(parts):
        return b""
    return b"".join(encode_varint(len(part)) + part for part in parts)


def unpack_section(data: bytes, n_parts: int) -> list[bytes]:
    """Undo `pack_section`; raise `CorruptStreamError` for bytes that it does not write."""
    if not data:
        return [b""] * n_parts
    parts, byte_pos = [], 0
    for _ in range(n_parts):
        length, byte_pos = decode_varint(data, byte_pos)
        if length > len(data) - byte_pos:
            raise TruncatedStreamError(
                f"a mesh of {length} bytes begins {len(data) - byte_pos} bytes before the end of"
                " its section"
            )
        parts.append(data[byte_pos : byte_pos + length])
        byte_pos += length
    if byte_pos != len(data):
        raise CorruptStreamError(f"{len(data) - byte_pos} bytes left over after the last mesh")
    if not any(parts):
        raise CorruptStreamError("a mesh section has bytes, but no meshes")
    return parts


def parts_of_blocks(grid: Grid, section: Callable[[Block], bytes]) -> Callable[[Block], bytes]:
    """Turn a reader of sections by key into a reader of the bytes of a block's mesh."""

    @lru_cache(_CACHED_SECTIONS)
    def parts(key: Block) -> dict[Block, bytes]:
        blocks = grid.key_blocks(key)
        return dict(zip(blocks, unpack_section(section(key), len(blocks)), strict=True))

    return lambda block: parts(unit_key(block))[block]


def make_sections(
    grid: Grid,
    mesher: BlockMesher,  # for samples, tolerances and the kind of meshes
    executor: Executor,
    # called now and then with the number of full-grid samples that have a mesh
    on_samples: Callable[[int], None],
    levels: Iterable[int] | None = None,  # levels of blocks to mesh; all by default
) -> dict[Block, bytes]:
    """Return the mesh sections of all keys that have one.

    Blocks of a level agree on their borders in rounds (`tri.zerotree.agreement`), so that one
    level's drafts are held at a time, packed: for rasters of up to some hundred million samples.
    The sections themselves are held as well. The bytes don't depend on the executor.
    """
    if mesher.kind not in STORED_KINDS:
        return {}
    parts: dict[Block, bytes] = {}
    for level in range(grid.k_max + 1) if levels is None else levels:
        parts |= _level_parts(grid, mesher, level, executor, on_samples)
    return sections_of_parts(grid, parts)


def make_meshes(
    grid: Grid,
    decoder: TreeDecoder,
    error_code: Callable[[Block], int],
    tolerance: int,
    *,
    has_voids: bool,
    kind: str,
    executor: Executor,
    on_samples: Callable[[int], None],
    levels: Iterable[int] | None = None,
) -> tuple[BlockMesher, dict[Block, bytes]]:
    """Return the mesher of a file that has no meshes yet, and the sections it will have.

    The arguments are those of `BlockMesher` and `make_sections`.
    """
    sections: dict[Block, bytes] = {}
    mesher = BlockMesher(
        grid,
        decoder,
        error_code,
        tolerance,
        has_voids=has_voids,
        kind=kind,
        part=parts_of_blocks(grid, lambda key: sections.get(key, b"")),
        trees=tree_source(kind, decoder),
        coefficients=coefficient_source(kind, decoder),
    )
    sections.update(make_sections(grid, mesher, executor, on_samples, levels))
    return mesher, sections


def sections_of_parts(grid: Grid, parts: Mapping[Block, bytes]) -> dict[Block, bytes]:
    """Return the sections, by key, that hold the parts of blocks; empty ones are left out."""
    sections: dict[Block, list[bytes]] = {}
    for block, part in parts.items():
        key = unit_key(block)
        blocks = grid.key_blocks(key)
        sections.setdefault(key, [b""] * len(blocks))[blocks.index(block)] = part
    packed = {key: pack_section(meshes) for key, meshes in sections.items()}
    return {key: section for key, section in packed.items() if section}


def _level_parts(
    grid: Grid,
    mesher: BlockMesher,
    level: int,
    executor: Executor,
    on_samples: Callable[[int], None],
) -> dict[Block, bytes]:

    def draft(position: Position, demanded: BorderVertices | None) -> Draft:
        return mesher.draft(Block(level, *position), demanded)

    blocks = grid.blocks(level)
    is_meshed = executor.map(mesher.has_mesh, blocks)
    positions = [
        (block.row, block.col)
        for block, has_mesh in zip(blocks, is_meshed, strict=True)
        if has_mesh
    ]
    drafts, _ = agree(positions, draft, lambda drafted: drafted.border, executor.map)
    meshed = [Block(level, *position) for position in drafts]
    parts = {}
    for block, part in zip(
        meshed, executor.map(mesher.encode, meshed, drafts.values()), strict=True
    ):
        parts[block] = part
        if level == grid.k_max:
            region = grid.block_region(block)
            on_samples(region.n_rows * region.n_cols)
    return parts


def mesher_of(
    file: TerrainFile, samples: LevelSamples | None = None, trees: ZeroTrees | None = None
) -> BlockMesher:
    """Return the mesher of an open file, for the stored mesh of any block.

    `samples` and `trees` replace the file's own, for new meshes.
    """
    header = file.header
    return BlockMesher(
        file.grid,
        samples or file.decoder,
        lambda block: file.container.codes(block)[2],
        header.mesh_tolerance,
        has_voids=header.has_voids,
        kind=header.mesh,
        part=parts_of_blocks(file.grid, file.container.mesh),
        trees=trees or tree_source(header.mesh, file.decoder),
        coefficients=coefficient_source(header.mesh, file.decoder),
    )
