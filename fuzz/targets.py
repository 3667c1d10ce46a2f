"""What is fuzzed: each target takes any bytes, and no error but one of ours may leave it.

A target returns None where the bytes are accepted and what came of them is as it must be; it lets
`TerrainwaveError` pass, which says that they are refused. Anything else is a find, an
`AssertionError` of the target itself among them. Targets don't know who calls them.
"""

import json
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from fuzz import IS_COMPILED
from fuzz.units import N_PARENTS, SMALL_SISTERS, SPECS, corrected, parent_of
from terrainwave.annexes import read_annex
from terrainwave.codec import registry
from terrainwave.codec.cdf53 import refiner as cdf53
from terrainwave.codec.cdf53.tile_layout import TileLayout
from terrainwave.codec.corrections import decode_corrections
from terrainwave.codec.group import decode_unit
from terrainwave.codec.masks import Above, decode_validity
from terrainwave.codec.refiner import Rows, Validity, as_array
from terrainwave.codec.remainder_planes import decode_remainders
from terrainwave.coding.deflate import deflate
from terrainwave.container.header import (
    HEADER_SIZE,
    MAX_METADATA,
    check_optional_sections,
    pack_header,
    unpack_header,
)
from terrainwave.container.metadata import unpack_metadata
from terrainwave.container.page import N_CODES, page_layout, payload_starts, unpack_page
from terrainwave.container.sources.byte_source import BufferSource
from terrainwave.container.sources.ranges import (
    MAX_REQUEST,
    Budget,
    ByteRange,
    RoundReader,
    merge_ranges,
)
from terrainwave.errors import CorruptStreamError, TerrainwaveError, TruncatedStreamError
from terrainwave.export.virtual_geotiff import VirtualGeoTIFF
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.mesh.blocks import StoredSamples
from terrainwave.mesh.sections import unpack_section
from terrainwave.names import METHODS
from terrainwave.raster_io.geotiff.sparse import GeoTIFFStream
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.terrain import Terrain
from terrainwave.tri.halves.borders import beside_void
from terrainwave.tri.stored_kinds import STORED_KINDS

GOLDEN = Path(__file__).parents[1] / "tests" / "golden" / "v2"
CORPUS = Path(__file__).parent / "corpus"
# A read of more is refused: what a file claims must not decide how much memory is taken.
_MOST_SAMPLES = 1 << 16
_SIDE = 200

Target = Callable[[bytes], None]
# In the byte that chooses a parent: the file has corrections.
CORRECTED = 128
CORRECTED_SPECS = (0, 1, 3, 4)
REFINERS = {name: method for name, method in METHODS.items() if method.refiner}


def pick(number: int, choices):
    """Return one of a sequence by any byte."""
    return choices[number % len(choices)]


# Files


def opening(data: bytes) -> None:
    """Open, read a window of each of few levels, ask for all a file says, mesh a block."""
    data = data[:16] + len(data).to_bytes(8, "little") + data[24:]  # its header's file size
    with Terrain(data, threads=1, cache_bytes=1 << 22) as terrain:
        repr(terrain)
        json.dumps(terrain.info().to_dict())
        for level in sorted({0, *range(max(0, terrain.n_levels - 3), terrain.n_levels)}):
            n_rows, n_cols = terrain.level_shape(level)
            window = (max(0, n_rows - _SIDE), max(0, n_cols - _SIDE), _SIDE, _SIDE)
            heights, valid = terrain.read_with_mask(window, level=level)
            assert heights.shape == valid.shape == (min(n_rows, _SIDE), min(n_cols, _SIDE))
            assert heights.dtype == terrain.dtype
        if terrain.mesh_kind != "none":
            for block in (Block(0, 0, 0), Block(terrain.n_levels - 1, 0, 0)):
                check_mesh(terrain.block_mesh(block))


def header(data: bytes) -> None:
    """Unpack a header; pack it again."""
    found, extents = unpack_header(data)
    check_optional_sections(data[HEADER_SIZE : extents.header_size])
    assert pack_header(found, extents)[:-4] == data[: HEADER_SIZE - 4]
    found.grid.level_shape(0)
    assert found.codec_parameters.z_min == found.z_min


_LAYOUTS = (
    page_layout(Grid(131, 6, 32), None),
    page_layout(Grid(1030, 2, 32), None),
    page_layout(Grid(40000, 39000, 32), Block(3, 1, 1)),
)


def pages(data: bytes) -> None:
    """Unpack an index page, of the bytes as they are or of columns made of them."""
    if not data:
        return
    layout = pick(data[0] >> 1, _LAYOUTS)
    page = data[1:]
    if data[0] & 1:
        n_keys, n_blocks, n_children = map(len, layout)
        n_bytes = 17 * n_keys + N_CODES * n_blocks + 12 * n_children
        page = page[:12].ljust(12, b"\0") + deflate(page[12:].ljust(n_bytes, b"\0")[:n_bytes])
    found = unpack_page(page, layout, "a page")
    starts = payload_starts(found, layout, 1000)
    assert min(starts) >= 1000
    assert max(starts) <= 1000 + found.body_length
    assert found.children_end >= found.first_child


def metadata(data: bytes) -> None:
    """Unpack metadata, of JSON or of deflated bytes; make them a raster's."""
    if not data:
        return
    packed = data[1:] if data[0] & 1 else deflate(data[1:], read_annex("dictionary.txt"))
    found = unpack_metadata(packed)
    assert len(json.dumps(found)) <= 8 * MAX_METADATA
    known = {name: value for name, value in found.items() if value is not None}
    dtype = ("int16", "uint8", "float32", "float64")[data[0] >> 1 & 3]
    info = RasterInfo.from_metadata(known | {"n_rows": 3, "n_cols": 5, "dtype": dtype})
    again = RasterInfo.from_metadata(json.loads(json.dumps(info.to_metadata())))
    assert repr(again) == repr(info)


# Units


@cache
def _refiner(name: str, parameters: bytes):
    return registry.refiner_by_name(name, parameters)


@cache
def _known_parameters(name: str) -> tuple[bytes, ...]:
    """Return the parameters of golden files of a method, and none."""
    found = {b""}
    for path in sorted(GOLDEN.glob(f"{name}-*.twz")):
        with Terrain(path.read_bytes(), threads=1) as terrain:
            found.add(terrain.header.file_tables)
    return tuple(sorted(found))


def unit_target(name: str) -> Target:
    """Return the target of a method's payloads.

    The first bytes choose the spec, the parent and the file's parameters.
    """

    def decode(data: bytes) -> None:
        if len(data) < 3:
            return
        number, kind = data[0] % len(SPECS), (data[1] & ~CORRECTED) % N_PARENTS
        if not IS_COMPILED:
            number = SMALL_SISTERS.get(number, number)
        refiner = _refiner(name, pick(data[2], _known_parameters(name)))
        spec, parent = SPECS[number], parent_of(number, kind)
        if data[1] & CORRECTED and METHODS[name].is_patchable:
            spec = corrected(spec)
        payload = data[3:]
        part, n_rows = None, spec.region.n_rows
        first = data[1] % n_rows
        with suppress(CorruptStreamError):
            rows = Rows(first, first + 1 + data[0] % (n_rows - first))
            part = decode_unit(refiner, spec, parent, payload, rows)
        found = decode_unit(refiner, spec, parent, payload)
        # Whoever decodes some rows alone has those of the whole.
        assert part is not None
        at = slice(part.rows.first, part.rows.end)
        assert np.array_equal(part.heights[at], found.heights[at])
        assert found.heights.shape == found.mask.shape == spec.region.shape
        assert found.heights.dtype == np.int32
        heights = found.heights[found.mask]
        assert heights.min(initial=spec.z_max) >= spec.z_min
        assert heights.max(initial=spec.z_min) <= spec.z_max

    decode.__doc__ = f"Decode a payload of {name} with a true or a false parent."
    return decode


def parameters(data: bytes) -> None:
    """Read the tables that a file brings along for its method."""
    if data:
        names = [name for name, method in REFINERS.items() if method.has_file_tables]
        registry.refiner_by_name(pick(data[0], names), data[1:])


_TILES = TileLayout(Grid(33, 30, 32)), TileLayout(Grid(70, 67, 32)), TileLayout(Grid(36, 5, 32))


@cache
def _outer(kind: int, region) -> cdf53.LevelHeights:
    rng = np.random.default_rng(kind)
    heights = rng.integers(-(1 << 30), 1 << 30, region.shape, np.int32)
    if kind == 0:
        heights[:] = 5
    mask = rng.random(region.shape) < (0.8 if kind == 2 else 2)
    return cdf53.LevelHeights(region, heights, Validity.of(mask))


def tiles(data: bytes) -> None:
    """Decode a tile of cdf53, the root one or one with a head, whole or a prefix."""
    if len(data) < 2:
        return
    layout = pick(data[0] >> 1, _TILES) if IS_COMPILED else _TILES[-1]
    spec = layout.spec(Block(-1, 0, 0))
    outer = None
    if data[1] % 4 and layout.grid.k_max:
        # A head above it, as if the tile were not the root.
        head = Block(0, 0, 0)
        region = layout.grid.block_region(head)
        spec = replace(
            spec, key=head, first=1, last=1, outer=region, n_transforms=1, n_below=0,
            regions=(layout.grid.descendant_region(head, 1),), held=data[1] >> 2 & 15,
        )  # fmt: skip
        outer = _outer(data[1] % 4 - 1, region)
    levels = cdf53.decode_tile(spec, outer, data[2:], is_prefix=bool(data[0] & 1))
    assert len(levels) == len(spec.regions)
    for level, region in zip(levels, spec.regions):
        assert level.heights.shape == as_array(level.validity.mask, region.shape).shape
        assert level.heights.shape == region.shape


def masks(data: bytes) -> None:
    """Decode the validity of a unit below another, or of a root block."""
    if len(data) < 2:
        return
    region, above = place_of_mask(data[0] % 16)
    found = decode_validity(data[1:], region, above, is_finest=bool(data[0] & 16))
    mask, own = (as_array(part, region.shape) for part in (found.mask, found.own_mask))
    assert mask.shape == own.shape == region.shape
    assert not (own & ~mask).any()


@cache
def place_of_mask(kind: int) -> tuple[Region, Above | None]:
    """Return the region of a unit, and what is above."""
    rng = np.random.default_rng(kind)
    shape = ((9, 11), (1, 40), (33, 71) if IS_COMPILED else (5, 6), (2, 2))[kind % 4]
    if kind & 4:
        return Region(0, 0, *shape), None
    region, outer = Region(1, 6, *shape), Region(0, 3, shape[0] // 2 + 3, shape[1] // 2 + 2)
    mask = rng.random(outer.shape) < (0.8 if kind & 8 else 2)
    return region, Above(outer, Validity.of(mask, mask & (rng.random(outer.shape) < 0.7)))


def corrections(data: bytes) -> None:
    """Decode corrections of a root block or of a group."""
    if not data:
        return
    spec = SPECS[CORRECTED_SPECS[data[0] % len(CORRECTED_SPECS)]]
    found = decode_corrections(data[1:], spec).added
    assert found.shape == spec.region.shape
    assert found.any()
    assert found.min() > -(1 << 31)
    if spec.parent_region is not None:
        assert not found[spec.region.row & 1 :: 2, spec.region.col & 1 :: 2].any()


def remainders(data: bytes) -> None:
    """Decode remainders: as they are, of bytes deflated here, or of as many as they claim."""
    if len(data) < 2:
        return
    width = 8 if data[0] & 1 else 4
    section, planes = data[1:], data[2:]
    if data[0] & 4:
        # No change hits upon the length that fits: without it nothing behind that check is reached.
        planes = planes.ljust(35 * data[1], b"\1")[: 35 * data[1]]
    if data[0] & 6:
        section = data[1:2] + deflate(planes)
    found = decode_remainders(section, (5, 7), width)
    assert found.shape == (5, 7)
    assert found.dtype.itemsize == width
    assert 1 <= section[0] <= width


# Meshes


@cache
def _mesh_samples(kind: int) -> StoredSamples:
    shape = ((17, 17), (9, 13), (33, 33) if IS_COMPILED else (5, 9), (2, 2))[kind % 4]
    rng = np.random.default_rng(kind)
    heights = rng.integers(-300, 300, shape).astype(np.int32)
    if kind & 8:
        heights = rng.integers(-(1 << 30), 1 << 30, shape, np.int32)
    beyond = np.ones((shape[0] + 2, shape[1] + 2), dtype=np.bool_)
    if kind & 4:
        beyond[1:-1, 1:-1] = rng.random(shape) < 0.95
    mask = np.ascontiguousarray(beyond[1:-1, 1:-1])
    coefficients = rng.integers(0, 100, shape) if kind & 16 else None
    return StoredSamples(heights, mask, beside_void(beyond), None, coefficients)


def check_mesh(mesh) -> None:
    """Check that triangles are of vertices that are there."""
    assert mesh.rows.shape == mesh.cols.shape == mesh.heights.shape
    assert mesh.triangles.min(initial=0) >= 0
    assert mesh.triangles.max(initial=-1) < mesh.rows.size


def meshes(data: bytes) -> None:
    """Unpack a mesh section; make the meshes of its parts."""
    if len(data) < 3:
        return
    kind = STORED_KINDS[("zerotree-plain", "rqt")[data[0] & 1]]
    n_parts = (1, 4)[data[0] >> 1 & 1]
    for part in unpack_section(data[3:], n_parts):
        check_mesh(kind.mesh(_mesh_samples(data[1] % 32), data[2] << 6, part))


# Requests


def planner(data: bytes) -> None:
    """Merge ranges to requests: each covers what is in it, none is longer than allowed."""
    if len(data) < 4:
        return
    budget = None if data[0] & 1 else Budget(data[1], data[2] << 12, data[3] << 13)
    count, longest = len(data) // 10, 1 << (data[0] >> 1 & 31)
    ranges = [
        ByteRange(place >> 8, length % longest)
        for place, length in struct.iter_unpack("<QH", data[4 : 4 + 10 * ((len(data) - 4) // 10)])
    ]
    merged = merge_ranges(ranges, budget)
    longest_there = max((wanted.length for wanted in ranges), default=0)
    assert len(merged) <= count
    for span, after in pairwise(merged):
        assert span.offset <= after.offset
    for wanted in ranges:
        assert not wanted.length or any(
            span.offset <= wanted.offset and wanted.end <= span.end for span in merged
        )
    assert all(span.length <= max(MAX_REQUEST, longest_there) for span in merged)


# A round takes as long as all ranges so far: more would say no more, in the square of the time.
_MOST_RANGES = 12
_BYTES = np.random.default_rng(1).bytes(1 << 20)


def rounds(data: bytes) -> None:
    """Fetch ranges in rounds: what comes is what the source has there."""
    if not data:
        return
    reader = RoundReader(BufferSource(_BYTES), _BYTES[: data[0] << 6])
    wanted: list[ByteRange] = []
    count = min((len(data) - 1) // 5, _MOST_RANGES)
    for place, length, ends in struct.iter_unpack("<HHB", data[1 : 1 + 5 * count]):
        wanted.append(ByteRange(place << 4, length))
        if ends & 3 == 0:
            _fetch(reader, wanted)
    _fetch(reader, wanted)


def _fetch(reader: RoundReader, wanted: list[ByteRange]) -> None:
    is_inside = all(place.end <= len(_BYTES) for place in wanted)
    try:
        reader.fetch(wanted)
    except TruncatedStreamError:
        assert not is_inside
        raise
    for place in wanted:
        assert reader.take(place) == _BYTES[place.offset : place.end]


# The virtual TIFF


@cache
def _golden_paths() -> tuple[Path, ...]:
    return tuple(sorted(GOLDEN.glob("*.twz")))


# Each makes whole tiles anew, of a million bytes.
_MOST_READS = 8
# Of two methods, which have all kinds of heights: no other kernels are compiled for the TIFF.
VIRTUAL = tuple(path for path in _golden_paths() if path.name.startswith(("rapid", "store")))


@cache
def _virtual(number: int) -> tuple[VirtualGeoTIFF, bytes]:
    file = VirtualGeoTIFF(Terrain(VIRTUAL[number].read_bytes(), threads=1))
    return file, file.read_at(0, file.size)


def virtual(data: bytes) -> None:
    """Read and seek in a virtual TIFF of a golden file; or make the head of hostile metadata."""
    if len(data) < 2:
        return
    number = data[1] % len(VIRTUAL)
    if data[0] == 0:
        _virtual_of_metadata(number, data[2:])
        return
    file, expected = _virtual(number)
    stream, place = GeoTIFFStream(file), 0
    try:
        count = min((len(data) - 2) // 7, _MOST_READS)
        for at, n, whence in struct.iter_unpack("<iHB", data[2 : 2 + 7 * count]):
            base = (0, place, len(expected))[whence % 3]
            if base + at < 0:
                continue
            place = stream.seek(at, whence % 3)
            assert place == base + at == stream.tell()
            assert stream.read(n) == expected[place : place + n]
            place += min(n, max(0, len(expected) - place))
    finally:
        stream.close()


def _virtual_of_metadata(number: int, text: bytes) -> None:
    with Terrain(VIRTUAL[number].read_bytes(), threads=1) as terrain:
        known = unpack_metadata(deflate(text, read_annex("dictionary.txt")))
        known = {name: value for name, value in known.items() if value is not None}
        size = {"n_rows": terrain.shape[0], "n_cols": terrain.shape[1], "dtype": terrain.dtype.name}
        terrain._raster = RasterInfo.from_metadata(known | size)
        file = VirtualGeoTIFF(terrain)
        assert len(file.read_at(0, file.size)) == file.size


TARGETS: dict[str, Target] = {
    "opening": opening,
    "header": header,
    "pages": pages,
    "metadata": metadata,
    **{name: unit_target(name) for name in REFINERS},
    "cdf53": tiles,
    "parameters": parameters,
    "masks": masks,
    "corrections": corrections,
    "remainders": remainders,
    "meshes": meshes,
    "planner": planner,
    "rounds": rounds,
    "virtual": virtual,
}


def call(name: str, data: bytes) -> bool:
    """Run a target over some bytes; return whether they were accepted.

    Raises
    ------
    Exception
        A find: anything but a `TerrainwaveError`.
    """
    try:
        TARGETS[name](data)
    except TerrainwaveError:
        return False
    return True


def seeds(name: str) -> list[Path]:
    """Return the files of a target's corpus; for opening golden files are among them."""
    found = sorted((CORPUS / name).glob("*"))
    return found + list(_golden_paths()) if name == "opening" else found
