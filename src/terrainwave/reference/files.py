"""Header, metadata, segments and codes of blocks (docs/FORMAT.md §3, §4)."""

import json
import struct
import zlib
from math import gcd, isfinite
from types import SimpleNamespace

import numpy as np

from terrainwave.reference.basics import (
    CorruptError,
    UnsupportedError,
    annex,
    inflate,
    require,
)
from terrainwave.reference.digests import section_before
from terrainwave.reference.grid import Grid
from terrainwave.reference.rapid_tables import read_rapid_tables

DICTIONARY = annex("dictionary.txt")  # §4.6

HEADER = struct.Struct("<8sBBHIQIIBBBBBB2sQQqIiiIdddIIIIII")
NAMES = (
    "magic version reserved header_size features file_size n_rows n_cols block_log2 border_rings "
    "method dtype effort mesh padding quantum_num quantum_den base step z_min z_max "
    "metadata_length "
    "max_error effective_bound rho metadata_crc parameters_length parameters_crc "
    "top_page_length mesh_tolerance header_crc"
).split()
METHODS = {0: "store", 1: "cdf97", 2: "predictive", 3: "cdf53", 4: "rapid"}
# Readers of the parameters (§4.3), by method: of a section and the step.
PARAMETERS = {"rapid": read_rapid_tables}
DTYPES = {1: "uint8", 3: "uint16", 4: "int16", 6: "int32", 7: "float32", 8: "float64"}


def read_header(data):
    require(data[:8] == b"\x89TWZ\r\n\x1a\n", "magic")
    require(len(data) > 8 and data[8] == 2, "format version", UnsupportedError)
    require(len(data) >= 128, "file ends within the header")
    h = SimpleNamespace(**dict(zip(NAMES, HEADER.unpack(data[:128]), strict=True)))
    require(h.header_size >= 128, "header_size")
    require(h.header_crc == zlib.crc32(data[:124]), "header_crc")
    require(h.reserved == 0, "reserved", UnsupportedError)
    require(not h.features & ~(1 | 2 | 4 | 8 | 16), "features", UnsupportedError)
    require(not h.features & 4 or h.method == 1, "a faithful file of another method")
    may_be_corrected = h.method in (2, 4) and h.step > 1
    require(not h.features & 8 or may_be_corrected, "corrections", UnsupportedError)
    require(h.padding == b"\0\0", "padding", UnsupportedError)
    require(h.mesh <= 6, "mesh", UnsupportedError)
    require(h.mesh != 6 or h.method == 3, "a mesh by coefficients of another method")
    require(h.mesh or h.mesh_tolerance == 0, "mesh_tolerance")
    require(h.file_size < 2**63, "file_size")
    require(1 <= h.n_rows <= 2**31 and 1 <= h.n_cols <= 2**31, "n_rows, n_cols")
    require(h.n_rows * h.n_cols <= 2**50, "n_rows * n_cols")
    require(5 <= h.block_log2 <= 10, "block_log2")
    require(h.border_rings in (1, 3), "border_rings")
    require(h.border_rings == 1 or h.method != 3, "aprons of tiles")
    require(h.method in METHODS, "method", UnsupportedError)
    require(h.dtype in DTYPES, "dtype", UnsupportedError)
    require(h.effort <= 9, "effort", UnsupportedError)
    require(1 <= h.quantum_num < 2**63 and 1 <= h.quantum_den < 2**63, "quantum")
    require(gcd(h.quantum_num, h.quantum_den) == 1, "quantum is not in lowest terms")
    require((abs(h.base) + 2**31) * h.quantum_num < 2**63, "base")
    require(h.step % 2 == 1 and h.step < 2**31, "step")
    some = -(2**30) <= h.z_min <= h.z_max <= 2**30 and h.z_max - h.z_min < 2**30
    require(some or (h.z_min, h.z_max) == (0, -1), "z_min, z_max")
    require(1 <= h.metadata_length <= 2**20, "metadata_length")
    require(isfinite(h.max_error) and h.max_error >= 0, "max_error")
    require(0 <= h.effective_bound <= h.max_error, "effective_bound")
    require(isfinite(h.rho) and h.rho >= 0, "rho")
    require(some or h.features & 1, "no valid sample in a file without voids")
    if h.features & 2:
        require(h.dtype in (6, 7, 8) and h.method != 3, "remainders of a dtype or a method")
        require(h.step == 1 and h.effective_bound == 0, "remainders beside a bound")
    else:
        require(h.rho <= h.max_error, "rho")
    require(h.parameters_length <= 2**16, "parameters_length")
    require(1 <= h.top_page_length <= 2**15, "top_page_length")
    before = h.header_size + h.metadata_length + h.parameters_length + h.top_page_length
    before += 40 if h.features & 16 else 0
    require(before <= h.file_size, "file_size")
    require(len(data) == h.file_size, "size of the file")
    return h


def check_optional_sections(data):
    """§4.8."""
    names, at = set(), 0
    while at < len(data):
        require(len(data) - at >= 12, "an optional section")
        name, n, crc = struct.unpack("<4sII", data[at : at + 12])
        require(n <= len(data) - at - 12, "length of an optional section")
        require(name not in names, "an optional section comes twice")
        require(zlib.crc32(data[at + 12 : at + 12 + n]) == crc, "crc of an optional section")
        names.add(name)
        at += 12 + n


def is_number(value):
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return isfinite(value) and (isinstance(value, float) or abs(value) <= 2**64)


def is_nodata(value, dtype):
    """Say whether a value of `nodata` is allowed in a dtype."""
    dtype = np.dtype(dtype)
    if value in ("nan", "inf", "-inf"):
        return dtype.kind == "f"
    if not is_number(value):
        return False
    if dtype.kind == "f":
        with np.errstate(over="ignore", under="ignore"):
            return bool(np.isfinite(dtype.type(value)))
    return value == int(value) and np.iinfo(dtype).min <= value <= np.iinfo(dtype).max


def is_transform(value):
    return isinstance(value, list) and len(value) == 6 and all(map(is_number, value))


def is_texts(value):
    return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())


KINDS = {
    "transform": is_transform,
    "scale": lambda value: is_number(value) and value != 0,
    "offset": is_number,
    "moved": lambda value: is_number(value) and value == int(value) and 0 <= value <= 2**31,
    "mask_kind": lambda value: value in ("none", "nodata", "nan", "mask"),
    "area_or_point": lambda value: value in ("Area", "Point"),
    **dict.fromkeys(
        ("crs", "units", "description", "software", "color_interpretation"),
        lambda value: isinstance(value, str),
    ),
    **dict.fromkeys(("tags", "band_tags"), lambda value: is_texts(value)),
}


def depth(value):
    """Nesting of brackets; the outermost object counts as 1."""
    if not isinstance(value, dict | list):
        return 0
    inner = value.values() if isinstance(value, dict) else value
    return 1 + max(map(depth, inner), default=0)


def read_metadata(section, crc, dtype):
    require(zlib.crc32(section) == crc, "metadata_crc")

    def unique(pairs):
        require(len(dict(pairs)) == len(pairs), "a key occurs twice")
        return dict(pairs)

    def refuse(text):
        raise CorruptError(text)

    def finite(kind):
        def number(text):
            require(isfinite(float(text)), "a number without finite binary64 value")
            return kind(text)

        return number

    try:
        text = inflate(section, 2**20, DICTIONARY).decode("utf-8")
        metadata = json.loads(
            text,
            object_pairs_hook=unique,
            parse_constant=refuse,
            parse_int=finite(int),
            parse_float=finite(float),
        )
        json.dumps(metadata, ensure_ascii=False).encode()  # fails on a lone surrogate
    except (ValueError, RecursionError) as error:
        raise CorruptError(str(error)) from None
    require(isinstance(metadata, dict), "metadata is not an object")
    require(depth(metadata) <= 16, "metadata is nested too deep")
    metadata = {key: value for key, value in metadata.items() if value is not None}
    for key, is_right in KINDS.items():
        require(key not in metadata or is_right(metadata[key]), key)
    require("nodata" not in metadata or is_nodata(metadata["nodata"], dtype), "nodata")
    return metadata


def segment_layout(grid, head):
    """Return the keys, blocks and heads of the children of a segment (§3.1); top: head None."""
    if head is None:
        t = grid.k_max if grid.k_max < 4 else grid.k_max % 4
        keys = grid.root_keys()
        for k in range(t):
            keys += grid.blocks(k)
        heads = grid.blocks(t) if t < grid.k_max else []
    else:
        keys, row = [], [head]
        for _ in range(4):
            keys += row
            row = [child for block in row for child in grid.children(block)]
        heads = row if head[0] + 4 < grid.k_max else []
    blocks = [block for key in keys for block in grid.blocks_of_key(key)]
    return keys, blocks, heads


def file_order(keys):
    """Return the keys of a segment in the order of their payloads in the file (§3.2)."""
    first, second, third, fourth = (
        [key for key in keys if key[0] == keys[0][0] + depth] for depth in range(4)
    )
    for upper in second:
        first.append(upper)
        first += [key for key in third if (key[1] >> 1, key[2] >> 1) == upper[1:]]
    return first + fourth[::-1]


def read_page(page, layout):
    """Return first_child and the columns of a page, each a list of integers (§3.3)."""
    counts = dict(zip("KBS", map(len, layout), strict=True))
    require(len(page) >= 5, "page is too short")
    require(zlib.crc32(page[4:]) == int.from_bytes(page[:4], "little"), "crc of a page")
    require(len(page) >= 13, "page is too short")
    first_child = int.from_bytes(page[4:12], "little")
    size = 17 * counts["K"] + 4 * counts["B"] + 12 * counts["S"]
    content = inflate(page[12:], size)
    require(len(content) == size, "columns of a page have another size")
    columns, at = {}, 0
    for name, letter, width in (
        ("payload_length", "K", 4),
        ("mesh_length", "K", 4),
        ("flags", "K", 1),
        ("z_min", "B", 1),
        ("z_max", "B", 1),
        ("error", "B", 1),
        ("mesh_error", "B", 1),
        ("child_page_length", "S", 4),
        ("child_length", "S", 8),
        ("payload_crc", "K", 4),
        ("mesh_crc", "K", 4),
    ):
        n = counts[letter]
        # Planes: byte p of row i stands at p * n + i.
        columns[name] = [
            sum(content[at + p * n + i] << (8 * p) for p in range(width)) for i in range(n)
        ]
        at += width * n
    return first_child, SimpleNamespace(**columns)


def read_file(data):
    """Return header, metadata, grid, payloads by key, and codes and segments by block."""
    data = bytes(data)
    h = read_header(data)
    at = h.header_size
    check_optional_sections(data[128:at])
    metadata = read_metadata(data[at : at + h.metadata_length], h.metadata_crc, DTYPES[h.dtype])
    at += h.metadata_length
    parameters = data[at : at + h.parameters_length]
    require(zlib.crc32(parameters) == h.parameters_crc, "parameters_crc")
    read_parameters = PARAMETERS.get(METHODS[h.method])
    if read_parameters is None:
        require(not parameters, "the method has no parameters", UnsupportedError)
    at += h.parameters_length

    grid = Grid(h.n_rows, h.n_cols, 2**h.block_log2, h.border_rings)
    payloads, codes, segment_of_key, segment_of_block = {}, {}, {}, {}
    # The segments of one level in file order: head, page, length (None: not known).
    row = [(None, data[at : at + h.top_page_length], None)]
    at += h.top_page_length
    while row:
        next_row, first_children = [], []
        for head, its_page, length in row:
            layout = segment_layout(grid, head)
            keys, blocks, heads = layout
            segment_of_key |= dict.fromkeys(keys, head)
            segment_of_block |= dict.fromkeys(blocks, head)
            if not its_page:  # absent (§3.4)
                payloads |= dict.fromkeys(keys, b"")
                codes |= dict.fromkeys(blocks, (0, 0, 0, 0))
                next_row += [(child, b"", 0) for child in heads]
                continue
            start = at
            first_child, page = read_page(its_page, layout)
            require((first_child > 0) == bool(heads), "first_child")
            if heads:
                first_children.append((first_child, len(next_row)))
            for child, n_page, n in zip(
                heads, page.child_page_length, page.child_length, strict=True
            ):
                require(n_page == 0 or 13 <= n_page <= 2**15, "child_page_length")
                require((n_page == 0) == (n == 0) and n >= n_page, "child_length")
                require(len(data) >= at + n_page, "page is cut off")
                next_row.append((child, data[at : at + n_page], n))
                at += n_page
            require(not any(page.flags), "flags of a key", UnsupportedError)
            for key in file_order(keys):
                i = keys.index(key)
                for kind in ("payload", "mesh"):
                    n = getattr(page, kind + "_length")[i]
                    require(n < 2**31, "length of a payload or mesh")
                    section = data[at : at + n]
                    require(len(section) == n, "payload or mesh is cut off")
                    require(zlib.crc32(section) == getattr(page, kind + "_crc")[i], "crc")
                    if kind == "payload":
                        payloads[key] = section
                    at += n
            codes |= zip(
                blocks,
                zip(page.z_min, page.z_max, page.error, page.mesh_error, strict=True),
                strict=True,
            )
            require(length is None or len(its_page) + at - start == length, "length of a segment")
        # §3.2: the bodies of the next level begin here and have no gaps.
        for first_child, i in first_children:
            before = sum(n - len(page) for _, page, n in next_row[:i])
            require(first_child == at + before, "first_child")
        row = next_row
    digests = section_before(data, at) if h.features & 16 else b""
    require(at + len(digests) == h.file_size, "bytes after the last section")
    return SimpleNamespace(
        header=h,
        parameters=parameters,
        tables=read_parameters and read_parameters(parameters, h.step),
        metadata=metadata,
        grid=grid,
        payloads=payloads,
        codes=codes,
        segment_of_key=segment_of_key,
        segment_of_block=segment_of_block,
        digests=digests,
    )


def decode_error(c):
    """Return what the code of an error stands for, in quanta (§4.4)."""
    return (8 + c % 8) * 2 ** (c // 8) // 8 if c else 0


def block_codes(data):
    """Return (low, high, E) in quanta of every block, by block."""
    file = read_file(data)
    grid, found = file.grid, {}
    for level in range(grid.k_max + 1):
        for key in grid.root_keys() if level == 0 else grid.blocks(level - 1):
            low, high = file.header.z_min, file.header.z_max
            if level > 0 and file.segment_of_block[key] == file.segment_of_key[key]:
                low, high, _ = found[key]
            for block in grid.blocks_of_key(key):
                z_min, z_max, c, _ = file.codes[block]
                size = high - low
                found[block] = (
                    low + z_min * size // 255,
                    high - z_max * size // 255,
                    decode_error(c),
                )
    return found
