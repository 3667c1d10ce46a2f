"""Write the corpus, small inputs that targets accept: ``python -m fuzz.make_corpus``.

Of golden files and of units coded here; golden files themselves are not copied.
"""

import hashlib
import struct
from collections.abc import Iterator

import numpy as np

from fuzz.targets import (
    _LAYOUTS,
    _TILES,
    CORPUS,
    CORRECTED,
    CORRECTED_SPECS,
    GOLDEN,
    REFINERS,
    VIRTUAL,
    _mesh_samples,
    call,
    place_of_mask,
)
from fuzz.units import N_PARENTS, SPECS, corrected_payload_of, payload_of
from terrainwave.annexes import read_annex
from terrainwave.codec.cdf53.refiner import encode_tile
from terrainwave.codec.cdf53.tile_layout import TileLayout
from terrainwave.codec.corrections import encode_corrections
from terrainwave.codec.masks import decode_validity, encode_validity
from terrainwave.codec.refiner import ALL_VALID, Validity, as_array
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.remainder_planes import encode_remainders
from terrainwave.coding.deflate import inflate
from terrainwave.container.header import MAX_METADATA
from terrainwave.container.page import empty_page, pack_columns, pack_page
from terrainwave.grid.quadtree import Block
from terrainwave.mesh.sections import pack_section
from terrainwave.names import METHODS
from terrainwave.terrain import Terrain
from terrainwave.tri.stored_kinds import STORED_KINDS

_MOST_BYTES = 1500


def _of_files() -> Iterator[tuple[str, bytes]]:
    for path in sorted(GOLDEN.glob("*.twz")):
        data = path.read_bytes()
        with Terrain(data, threads=1) as terrain:
            container = terrain.container
            extents, found = container.extents, container.header
        yield "header", data[: extents.header_size]
        packed = data[extents.header_size : extents.parameters_start]
        yield "metadata", b"\1" + packed
        text = inflate(packed, MAX_METADATA, "metadata", read_annex("dictionary.txt"))
        yield "metadata", b"\0" + text
        if found.method in ("rapid", "predictive"):
            kind = [name for name in REFINERS if REFINERS[name].has_file_tables].index(found.method)
            yield "parameters", bytes([kind]) + found.file_tables
        if path in VIRTUAL:
            yield "virtual", bytes([0, VIRTUAL.index(path)]) + text
            seeks = struct.pack("<iHBiHB", 0, 300, 0, -200, 400, 2)
            yield "virtual", bytes([1, VIRTUAL.index(path)]) + seeks


def _of_units() -> Iterator[tuple[str, bytes]]:
    for name in REFINERS:
        for number in range(len(SPECS)):
            for kind in (0, N_PARENTS - 1):
                if name != "cdf97" and SPECS[number].is_faithful:
                    continue
                payload = payload_of(refiner_by_name(name), number, kind)
                yield name, bytes([number, kind, 0]) + payload
        for number in CORRECTED_SPECS if METHODS[name].is_patchable else ():
            payload = corrected_payload_of(refiner_by_name(name), number, 0)
            yield name, bytes([number, CORRECTED, 0]) + payload


def _of_corrections() -> Iterator[tuple[str, bytes]]:
    for kind, number in enumerate(CORRECTED_SPECS):
        spec = SPECS[number]
        rng = np.random.default_rng(kind)
        for share in (0.05, 0.5):
            values = rng.integers(-spec.half, spec.half, spec.region.shape, np.int32, endpoint=True)
            added = np.where(rng.random(values.shape) < share, values, np.int32(0))
            added[0, 1] = 1
            if spec.parent_region is not None:
                added[spec.region.row & 1 :: 2, spec.region.col & 1 :: 2] = 0
            yield "corrections", bytes([kind]) + encode_corrections(added, spec)


def _tile(layout: TileLayout, rng: np.random.Generator) -> bytes:
    """Return the payload of a layout's root tile."""
    spec = layout.spec(Block(-1, 0, 0))
    heights = rng.integers(0, 4, spec.region.shape).astype(np.int32)
    return encode_tile(spec, heights, [ALL_VALID] * len(spec.regions), None).payload()


def _of_parts() -> Iterator[tuple[str, bytes]]:
    for number, layout in enumerate(_LAYOUTS):
        yield "pages", bytes([2 * number]) + pack_page(pack_columns(empty_page(layout)), 0)
        yield "pages", bytes([2 * number + 1]) + bytes(40)
    rng = np.random.default_rng(2)
    for kind in range(32):
        region, above = place_of_mask(kind % 16)
        place, is_finest = np.random.default_rng(kind), bool(kind & 16)
        known = decode_validity(b"", region, above, is_finest=is_finest)
        mask, own = (as_array(part, region.shape) for part in (known.mask, known.own_mask))
        found = own & (place.random(region.shape) < 0.7)
        row, col = region.row & 1, region.col & 1
        if above is not None:
            found[row::2, col::2] = own[row::2, col::2]
        near = Validity.of(found if is_finest else mask, found)
        yield "masks", bytes([kind]) + encode_validity(near, region, above, is_finest=is_finest)
    for n_bytes in (1, 3):
        yield "remainders", bytes([4, n_bytes]) + bytes(range(35 * n_bytes))
    for width in (4, 8):
        rest = rng.integers(-100, 100, (5, 7)).astype(f"i{width}")
        yield "remainders", bytes([width >> 3]) + encode_remainders(rest)
        yield "remainders", bytes([width >> 3 | 2, 1]) + bytes(range(35))
    for number in (0, 1):
        yield "cdf53", bytes([2 * number, 0]) + _tile(_TILES[number], rng)
    # By a generator of its own: the others' seeds stay.
    yield "cdf53", bytes([4, 0]) + _tile(_TILES[2], np.random.default_rng(3))
    for code, name in enumerate(("zerotree-plain", "rqt")):
        for number in (0, 1, 4, 9, 22):
            samples = _mesh_samples(number)
            kind = STORED_KINDS[name]
            part = kind.encode(samples, 64, kind.draft(samples, 64, None))
            yield "meshes", bytes([code, number, 1]) + pack_section([part])
            yield "meshes", bytes([code | 2, number, 1]) + pack_section([part, part, b"", b""][:4])
    for count in (1, 5, 60):
        places = rng.integers(0, 1 << 20, count)
        yield (
            "planner",
            b"\x12\x05\x10\x20"
            + b"".join(struct.pack("<QH", int(place) << 8, int(place) & 255) for place in places),
        )
        yield (
            "rounds",
            b"\2"
            + b"".join(
                struct.pack("<HHB", int(place) & 65535, 99, int(place) & 3) for place in places
            ),
        )


def main() -> None:
    """Write what is not there yet; say how much there is."""
    for source in (_of_files, _of_units, _of_corrections, _of_parts):
        for name, data in source():
            if len(data) <= _MOST_BYTES:
                folder = CORPUS / name
                folder.mkdir(parents=True, exist_ok=True)
                (folder / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
    for folder in sorted(CORPUS.iterdir()):
        inputs = [path.read_bytes() for path in folder.iterdir()]
        n_good = sum(call(folder.name, data) for data in inputs)
        print(f"{folder.name}: {len(inputs)} of {sum(map(len, inputs))} bytes, {n_good} accepted")


if __name__ == "__main__":
    main()
