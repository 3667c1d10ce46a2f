"""A slow, obvious decoder of .twz files, written from docs/FORMAT.md alone.

Plain Python on lists of integers; numpy only for the arrays that come out. Nothing of it is
shared with `terrainwave` but the tables that are an annex (§7.8), and `src` never imports it:
where the two disagree, one of them or the document is wrong. Sections of docs/FORMAT.md are cited
as §n.
"""

import json
import re
import struct
import zlib
from math import gcd, isfinite
from pathlib import Path
from types import SimpleNamespace

import numpy as np

# The annex of §7.8: numbers alone.
from terrainwave.codec.tables97 import E_WEIGHTS, STARTS, TERM_WEIGHTS

TERM_WEIGHTS_97, E_WEIGHTS_97 = TERM_WEIGHTS.tolist(), E_WEIGHTS.tolist()
STARTS_97 = {
    name: part.tolist() for name, part in zip(("residual", "tree", "border"), STARTS, strict=True)
}
DOCUMENT = (Path(__file__).parents[1] / "docs" / "FORMAT.md").read_text(encoding="utf-8")


def block(name):
    """Return the text of a fenced block of the document."""
    return re.search(rf"^```{name}\n(.*?)^```", DOCUMENT, re.M | re.S)[1]


DICTIONARY = block("dictionary").replace("\n", "").encode("ascii")  # §4.6
MASK_STARTS = [int(number) for number in block("starts").split()]  # §5.2


class CorruptError(Exception):
    """The bytes contradict the document (§1.2)."""


class UnsupportedError(CorruptError):
    """The bytes follow rules of a later version (§1.2)."""


def require(condition, message, error=CorruptError):
    if not condition:
        raise error(message)


def clamp(x, low, high):
    return min(max(x, low), high)


# §1.3, §1.4: deflate and varints ---------------------------------------------------------------


def inflate(data, limit, dictionary=None):
    """Inflate one zlib stream that fills `data` exactly; a raw one with a preset dictionary."""
    stream = zlib.decompressobj(-15, dictionary) if dictionary else zlib.decompressobj()
    try:
        content = stream.decompress(data, limit + 1)
    except zlib.error as error:
        raise CorruptError(str(error)) from None
    require(len(content) <= limit, "inflates to more than its limit")
    require(stream.eof, "deflated section ends early")
    require(not stream.unused_data, "bytes after a deflated section")
    return content


def read_varint(data, at):
    """Return a varint and the place after it."""
    value = 0
    for i in range(5):
        require(at + i < len(data), "varint is cut off")
        byte = data[at + i]
        value |= (byte & 127) << (7 * i)
        if byte < 128:
            require(byte > 0 or i == 0, "varint is longer than it must be")
            return value, at + i + 1
    raise CorruptError("varint has a sixth byte")


# §2: grid, blocks, keys ------------------------------------------------------------------------


def ceil_div(a, b):
    return -(-a // b)


class Grid:
    """Levels and blocks; a block and a key are tuples (k, m, n)."""

    def __init__(self, n_rows, n_cols, n_cells, border_rings):
        self.size = (n_rows, n_cols)
        self.n_cells = n_cells
        self.rings = (border_rings - 1) // 2  # rings of apron: 0 or 1
        self.k_max = 0
        while ceil_div(max(n_rows, n_cols) - 1, 2**self.k_max) > n_cells:
            self.k_max += 1

    def samples(self, k):
        """Rows and columns of level k (§2.1)."""
        step = 2 ** (self.k_max - k)
        return tuple((n - 1) // step + 1 for n in self.size)

    def n_blocks(self, k):
        """Rows and columns of blocks of level k (§2.2)."""
        step = 2 ** (self.k_max - k)
        return tuple(max(1, ceil_div(ceil_div(n - 1, step), self.n_cells)) for n in self.size)

    def blocks(self, k):
        """Blocks of level k in Morton order (§2.2)."""
        n_m, n_n = self.n_blocks(k)
        return sorted(((k, m, n) for m in range(n_m) for n in range(n_n)), key=morton)

    def root_keys(self):
        """Keys of the roots, in Morton order (§2.4)."""
        return [(-1, m, n) for _, m, n in self.blocks(0)]

    def children(self, block):
        """Children of a block, in Morton order."""
        k, m, n = block
        n_m, n_n = self.n_blocks(k + 1)
        found = [(k + 1, 2 * m + a, 2 * n + b) for a in (0, 1) for b in (0, 1)]
        return [child for child in found if child[1] < n_m and child[2] < n_n]

    def blocks_of_key(self, key):
        """Blocks that a key's unit consists of (§2.4)."""
        return [(0, *key[1:])] if key[0] < 0 else self.children(key)

    def unit(self, key):
        """Level, core, region and shared sides of the unit of a key (§2.4)."""
        k, *place = key
        unit = SimpleNamespace(key=key, level=k + 1)
        n_sides = 1 if k < 0 else 2  # blocks per side
        axes = []
        for i, n_samples, n_blocks in zip(
            place, self.samples(k + 1), self.n_blocks(k + 1), strict=True
        ):
            core_first = n_sides * i * self.n_cells
            core_last = min(n_sides * (i + 1) * self.n_cells, n_samples - 1)
            axes.append(
                SimpleNamespace(
                    core_first=core_first,
                    n_core=core_last - core_first + 1,
                    first=max(core_first - self.rings, 0),
                    last=min(core_last + self.rings, n_samples - 1),
                    shared=(i > 0, n_sides * (i + 1) < n_blocks),
                )
            )
        for axis in axes:
            axis.n = axis.last - axis.first + 1
            axis.core = axis.core_first - axis.first  # the core's first line, in the region
        unit.rows, unit.cols = axes
        return unit


def morton(block):
    _, m, n = block
    return sum(((m >> i & 1) << (2 * i + 1)) | ((n >> i & 1) << (2 * i)) for i in range(40))


# §4.1, §4.2: header and metadata ---------------------------------------------------------------

HEADER = struct.Struct("<8sBBHIQIIBBBBBB2sQQqIiiIdddIIIIII")
NAMES = (
    "magic version reserved header_size features file_size n_rows n_cols block_log2 border_rings "
    "method dtype effort mesh padding quantum_num quantum_den base step z_min z_max "
    "metadata_length "
    "max_error effective_bound rho metadata_crc parameters_length parameters_crc "
    "top_page_length mesh_tolerance header_crc"
).split()
METHODS = {0: "store", 1: "cdf97", 2: "predictive", 3: "cdf53"}
DTYPES = {1: "uint8", 3: "uint16", 4: "int16", 6: "int32", 7: "float32", 8: "float64"}


def read_header(data):
    require(data[:8] == b"\x89TWZ\r\n\x1a\n", "magic")
    require(len(data) > 8 and data[8] == 1, "format version", UnsupportedError)
    require(len(data) >= 128, "file ends within the header")
    h = SimpleNamespace(**dict(zip(NAMES, HEADER.unpack(data[:128]), strict=True)))
    require(h.header_size == 128, "header_size")
    require(h.header_crc == zlib.crc32(data[:124]), "header_crc")
    for name in ("reserved", "features"):
        require(getattr(h, name) == 0, name, UnsupportedError)
    require(h.padding == b"\0\0", "padding", UnsupportedError)
    require(h.mesh in (0, 1), "mesh", UnsupportedError)
    require(h.mesh or h.mesh_tolerance == 0, "mesh_tolerance")
    require(h.file_size < 2**63, "file_size")
    require(1 <= h.n_rows <= 2**31 and 1 <= h.n_cols <= 2**31, "n_rows, n_cols")
    require(h.n_rows * h.n_cols <= 2**50, "n_rows * n_cols")
    require(5 <= h.block_log2 <= 10, "block_log2")
    require(h.border_rings in (1, 3), "border_rings")
    require(METHODS.get(h.method) in ("store", "cdf97"), "method", UnsupportedError)
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
    for name in ("effective_bound", "rho"):
        require(0 <= getattr(h, name) <= h.max_error, name)
    require(h.parameters_length <= 2**16, "parameters_length")
    require(1 <= h.top_page_length <= 2**15, "top_page_length")
    before = 128 + h.metadata_length + h.parameters_length + h.top_page_length
    require(before <= h.file_size, "file_size")
    require(len(data) == h.file_size, "size of the file")
    return h


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


KINDS = {
    "transform": is_transform,
    "scale": lambda value: is_number(value) and value != 0,
    "offset": is_number,
    "mask_kind": lambda value: value in ("none", "nodata", "nan", "mask"),
    "area_or_point": lambda value: value in ("Area", "Point"),
    **dict.fromkeys(
        ("crs", "units", "description", "software"), lambda value: isinstance(value, str)
    ),
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

    try:
        text = inflate(section, 2**20, DICTIONARY).decode("utf-8")
        metadata = json.loads(text, object_pairs_hook=unique, parse_constant=refuse)
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


# §3: segments ----------------------------------------------------------------------------------


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
    at = 128
    metadata = read_metadata(data[at : at + h.metadata_length], h.metadata_crc, DTYPES[h.dtype])
    at += h.metadata_length
    parameters = data[at : at + h.parameters_length]
    require(zlib.crc32(parameters) == h.parameters_crc, "parameters_crc")
    require(not parameters, "store and cdf97 have no parameters", UnsupportedError)
    at += h.parameters_length

    grid = Grid(h.n_rows, h.n_cols, 2**h.block_log2, h.border_rings)
    payloads, codes, segment_of_key, segment_of_block = {}, {}, {}, {}
    # The segments of one level in file order: head, length of page, length (None: not known).
    row = [(None, h.top_page_length, None)]
    while row:
        next_row, first_children = [], []
        for head, page_length, length in row:
            layout = segment_layout(grid, head)
            keys, blocks, heads = layout
            segment_of_key |= dict.fromkeys(keys, head)
            segment_of_block |= dict.fromkeys(blocks, head)
            if page_length == 0:  # absent (§3.4)
                payloads |= dict.fromkeys(keys, b"")
                codes |= dict.fromkeys(blocks, (0, 0, 0, 0))
                next_row += [(child, 0, 0) for child in heads]
                continue
            start = at
            first_child, page = read_page(data[at : at + page_length], layout)
            require((first_child > 0) == bool(heads), "first_child")
            if heads:
                first_children.append((first_child, len(next_row)))
            at += page_length
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
            require(length is None or at - start == length, "length of a segment")
            for child, n_page, n in zip(
                heads, page.child_page_length, page.child_length, strict=True
            ):
                require(n_page == 0 or 13 <= n_page <= 2**15, "child_page_length")
                require((n_page == 0) == (n == 0) and n >= n_page, "child_length")
                next_row.append((child, n_page, n))
        # §3.2: the next level of segments begins here and has no gaps.
        for first_child, i in first_children:
            require(first_child == at + sum(n for *_, n in next_row[:i]), "first_child")
        row = next_row
    require(at == h.file_size, "bytes after the last section")
    return SimpleNamespace(
        header=h,
        metadata=metadata,
        grid=grid,
        payloads=payloads,
        codes=codes,
        segment_of_key=segment_of_key,
        segment_of_block=segment_of_block,
    )


# §4.4: codes of blocks -------------------------------------------------------------------------


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
                error = (8 + c % 8) * 2 ** (c // 8) // 8 if c else 0
                size = high - low
                found[block] = low + z_min * size // 255, high - z_max * size // 255, error
    return found


# §6: range coder -------------------------------------------------------------------------------


class Models:
    """Adaptive models (P, c) (§6.1)."""

    def __init__(self, n, starts=None):
        self.probability = [2**21] * n
        self.count = [0] * n
        if starts is not None:  # §7.8
            assert len(starts) == n
            self.probability = [(v >> 4) << 10 for v in starts]
            self.count = [2 * (v & 15) for v in starts]

    def update(self, i, bit):
        rate = 131072 // (2 * self.count[i] + 3)
        p = self.probability[i]
        self.probability[i] += ((2**22 - p) * rate) >> 16 if bit else -((p * rate) >> 16)
        self.count[i] = min(self.count[i] + 1, 254)


class RangeDecoder:
    """§6.2."""

    def __init__(self, data):
        self.data = data
        self.range = 2**32 - 1
        self.code = int.from_bytes(data[:4].ljust(4, b"\0"), "big")
        self.position = 4

    def _renormalise(self):
        while self.range < 2**24:
            byte = self.data[self.position] if self.position < len(self.data) else 0
            self.code = ((self.code << 8) | byte) & (2**32 - 1)
            self.range <<= 8
            self.position += 1

    def bit(self, models, i):
        bound = (self.range >> 16) * ((models.probability[i] >> 6) | 1)
        bit = int(self.code < bound)
        if bit:
            self.range = bound
        else:
            self.code -= bound
            self.range -= bound
        models.update(i, bit)
        self._renormalise()
        return bit

    def raw(self, k):
        value = 0
        for _ in range(k):
            self.range >>= 1
            bit = int(self.code >= self.range)
            if bit:
                self.code -= self.range
            value = 2 * value + bit
            self._renormalise()
        return value

    def end(self):
        require(self.position - 3 == len(self.data), "range coder stream has another length")

    def unary(self, models, first, limit):
        """Count the ones before the first zero, `limit` of them at most."""
        n = 0
        while n < limit and self.bit(models, first + n):
            n += 1
        return n

    def magnitude(self, models, first, prefix, k):
        """§6.5."""
        u = self.unary(models, first, 14)
        if u < 14:
            return (u << k) | self.raw(k)
        e = self.unary(models, prefix, 31)
        r = self.raw(e + k)
        return (14 << k) + ((1 << (e + k)) | r) - (1 << k)


class RangeEncoder:
    """§6.3."""

    def __init__(self):
        self.low = 0
        self.range = 2**32 - 1
        self.cache = 0
        self.pending = 1
        self.out = bytearray()

    def _shift(self):
        if self.low < 0xFF000000 or self.low >= 2**32:
            carry = self.low >> 32
            if self.pending:
                self.out.append((self.cache + carry) % 256)
            self.out += bytes([(255 + carry) % 256]) * (self.pending - 1)
            self.pending = 0
            self.cache = (self.low >> 24) & 255
        self.pending += 1
        self.low = (self.low & 0xFFFFFF) << 8

    def _renormalise(self):
        while self.range < 2**24:
            self.range <<= 8
            self._shift()

    def bit(self, models, i, bit):
        bound = (self.range >> 16) * ((models.probability[i] >> 6) | 1)
        if bit:
            self.range = bound
        else:
            self.low += bound
            self.range -= bound
        models.update(i, bit)
        self._renormalise()

    def raw(self, value, k):
        for i in reversed(range(k)):
            self.range >>= 1
            if value >> i & 1:
                self.low += self.range
            self._renormalise()

    def end(self):
        self.low = ceil_div(self.low, 2**24) * 2**24
        self._shift()
        self._shift()
        return bytes(self.out[1:])


# §5: masks and the payload wrapper -------------------------------------------------------------


def implied_void(unit, parent_unit, parent_valid):
    """Samples of the region that a void parent sample touches (§5.1)."""
    n_rows, n_cols = unit.rows.n, unit.cols.n
    if parent_unit is None:
        return [[False] * n_cols for _ in range(n_rows)]

    def touching(axis, parent_axis, i):
        place = axis.first + i
        return [
            clamp(p, parent_axis.first, parent_axis.last) - parent_axis.first
            for p in (place // 2, (place + 1) // 2)
        ]

    return [
        [
            not all(
                parent_valid[i][j]
                for i in touching(unit.rows, parent_unit.rows, r)
                for j in touching(unit.cols, parent_unit.cols, c)
            )
            for c in range(n_cols)
        ]
        for r in range(n_rows)
    ]


def decode_mask(section, implied):
    """§5.2."""
    n_rows, n_cols = len(implied), len(implied[0])
    valid = [[0] * n_cols for _ in range(n_rows)]

    def at(grid, i, j):
        return int(0 <= i < n_rows and 0 <= j < n_cols and bool(grid[i][j]))

    decoder, models = RangeDecoder(section), Models(576)
    for i in range(576):
        models.probability[i], models.count[i] = MASK_STARTS[i] << 14, 2
    for i in range(n_rows):
        for j in range(n_cols):
            if implied[i][j]:
                continue
            c = 0
            for di, dj in ((0, -1), (-1, 0), (-1, -1), (-1, 1), (0, -2), (-2, 0)):
                c = 2 * c + at(valid, i + di, j + dj)
            a = at(implied, i + 1, j) + at(implied, i, j + 1)
            far = ((0, 2), (1, -1), (1, 1), (2, 0))
            b = min(sum(at(implied, i + di, j + dj) for di, dj in far), 2)
            valid[i][j] = decoder.bit(models, (c * 3 + a) * 3 + b)
    decoder.end()
    return valid


def decode_payload(file, unit, payload, parent_unit, parent_heights, parent_valid):
    """Return the final heights and the mask of a unit's region (§5.1)."""
    h = file.header
    n_rows, n_cols = unit.rows.n, unit.cols.n
    if not payload:
        return [[0] * n_cols for _ in range(n_rows)], [[0] * n_cols for _ in range(n_rows)]
    implied = implied_void(unit, parent_unit, parent_valid)
    flags, at = payload[0], 1
    require(flags < 4, "flags of a payload")
    sections = [None, None]
    for bit in (0, 1):
        if flags >> bit & 1:
            n, at = read_varint(payload, at)
            require(1 <= n <= len(payload) - at, "length of a mask or exception section")
            sections[bit] = payload[at : at + n]
            at += n
    mask, exceptions = sections
    valid = decode_mask(mask, implied) if mask else [[int(not x) for x in row] for row in implied]
    require(any(map(any, valid)), "payload of a unit without valid samples")
    decode_method = {"store": decode_store, "cdf97": decode_cdf97}[METHODS[h.method]]
    heights = decode_method(h, unit, payload[at:], valid, parent_unit, parent_heights)
    # 1.
    heights = [[clamp(z, h.z_min, h.z_max) for z in row] for row in heights]
    # 2.
    taken = quanta_of_nodata(file)
    n_met = 0
    if taken:
        a, b = taken
        for r in range(n_rows):
            for c in range(n_cols):
                if valid[r][c] and a <= heights[r][c] <= b:
                    is_down = False
                    if exceptions is not None:
                        require(n_met // 8 < len(exceptions), "length of the exception section")
                        is_down = exceptions[n_met // 8] >> (7 - n_met % 8) & 1
                    heights[r][c] = a - 1 if is_down else b + 1
                    n_met += 1
    if exceptions is not None:
        require(len(exceptions) == ceil_div(n_met, 8), "length of the exception section")
        last = int.from_bytes(exceptions, "big") & ((1 << (-n_met % 8)) - 1)
        require(last == 0, "filling of the exception section")
    return heights, valid


# §2.3: quanta and raw heights ------------------------------------------------------------------


def raw_height(h, k):
    """Return the raw height of quantum number k, in the dtype of the file."""
    dtype = np.dtype(DTYPES[h.dtype])
    p = (h.base + k) * h.quantum_num
    if dtype.kind == "f":
        return dtype.type(float(p) / float(h.quantum_den))
    nearest = p if h.quantum_den == 1 else round(float(p) / float(h.quantum_den))
    limits = np.iinfo(dtype)
    return dtype.type(clamp(nearest, int(limits.min), int(limits.max)))


def nodata_in_dtype(file):
    """Return the nodata value as a number of the file's dtype; None if there is none."""
    nodata = file.metadata.get("nodata")
    if nodata is None:
        return None
    with np.errstate(under="ignore"):
        return np.dtype(DTYPES[file.header.dtype]).type(float(nodata))


def quanta_of_nodata(file):
    """Return the first and last quantum number in [z_min, z_max] that becomes nodata, or None."""
    h, nodata = file.header, nodata_in_dtype(file)
    if nodata is None or nodata != nodata:
        return None

    def first(is_reached):  # by bisection: raw heights never fall
        low, high = h.z_min, h.z_max + 1
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if is_reached(raw_height(h, middle)) else (middle + 1, high)
        return low

    a, b = first(lambda z: z >= nodata), first(lambda z: z > nodata) - 1
    return (a, b) if a <= b else None


# §8: method store ------------------------------------------------------------------------------


def decode_store(h, unit, payload, valid, parent_unit, parent_heights):
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


# §7: method cdf97 ------------------------------------------------------------------------------

M = 2**30
THRESHOLDS = [1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32, 40, 51, 64, 81, 102, 128, 162, 204, 256]
THRESHOLDS += [324, 408, 512, 648, 816, 1024, 1296, 1632, 2048, 2592, 3264]


def bin_of(s):
    """§6.6."""
    return sum(threshold <= s for threshold in THRESHOLDS)


def extend(x):
    """Extend a line by two samples at both ends: sample i is at i + 2 (§7.2)."""
    n = len(x)
    if n == 1:
        return [x[0]] * 5
    at = dict(enumerate(x))
    at[-1] = 2 * at[0] - at[1]
    at[n] = 2 * at[n - 1] - at[n - 2]
    at[-2] = 2 * at[0] - at[2]
    at[n + 1] = 2 * at[n - 1] - at[n - 3]
    return [at[i] for i in range(-2, n + 2)]


def synthesise(extended, q2):
    """Return 2^14 times the sample at position q2 / 2 of an extended line (§7.2)."""
    i = q2 // 2 + 2
    x = extended
    if q2 % 2 == 0:
        return 18270 * x[i] - 943 * (x[i - 1] + x[i + 1])
    return 9687 * (x[i] + x[i + 1]) - 1495 * (x[i - 1] + x[i + 2])


def predict_region(unit, parent_unit, parent_heights):
    """§7.2, prediction of the region."""
    n_rows, n_cols = unit.rows.n, unit.cols.n
    if parent_unit is None:
        return [[0] * n_cols for _ in range(n_rows)]
    r_off = unit.rows.first - 2 * parent_unit.rows.first
    c_off = unit.cols.first - 2 * parent_unit.cols.first
    wide = []
    for row in parent_heights:
        x = extend(row)
        for i in (0, 1, -2, -1):
            x[i] = clamp(x[i], -(2**31), 2**31)
        wide.append([synthesise(x, c + c_off) for c in range(n_cols)])
    columns = [extend([row[c] for row in wide]) for c in range(n_cols)]
    return [
        [clamp((synthesise(columns[c], r + r_off) + 2**27) >> 28, -M, M) for c in range(n_cols)]
        for r in range(n_rows)
    ]


class BorderDecoder:
    """§7.3."""

    def __init__(self, h, unit, decoder, valid, parent_unit, parent_heights, heights):
        self.n = h.step
        self.m = 2**32 // self.n + 1
        self.reach = (h.border_rings - 1) // 2  # R
        self.unit = unit
        self.decoder = decoder
        self.models = Models(2860, STARTS_97["border"])
        self.valid = valid
        self.parent = parent_heights
        self.heights = heights
        self.known = [[False] * unit.cols.n for _ in range(unit.rows.n)]
        if parent_unit is not None:
            self.offset = (
                unit.rows.first - 2 * parent_unit.rows.first,
                unit.cols.first - 2 * parent_unit.cols.first,
            )

    def rebuild(self, h, q):
        return clamp(h + clamp(q, -self.m, self.m) * self.n, -M, M)

    def symbol(self, place, phase, s):
        if not self.valid[place[0]][place[1]]:
            return 0
        b = bin_of(min(s, 4095))
        if not self.decoder.bit(self.models, 36 * phase + b):
            return 0
        value = 1 + self.decoder.magnitude(
            self.models, 180 + 14 * (36 * phase + b), 2700 + 32 * phase, 0
        )
        return -value if self.decoder.raw(1) else value

    def put(self, place, z):
        self.heights[place[0]][place[1]] = z
        self.known[place[0]][place[1]] = True

    def near_sides(self, axis):
        """Lines within R of each shared side, side by side; those inside the region."""
        sides = (axis.core, axis.core + axis.n_core - 1)
        return [
            [p for p in range(side - self.reach, side + self.reach + 1) if 0 <= p < axis.n]
            for side, is_shared in zip(sides, axis.shared, strict=True)
            if is_shared
        ]

    def run(self):
        rows, cols = self.unit.rows, self.unit.cols
        # Corners.
        for near_rows in self.near_sides(rows):
            for near_cols in self.near_sides(cols):
                for place in ((r, c) for r in near_rows for c in near_cols):
                    if not self.known[place[0]][place[1]]:
                        self.corner(place)
        # Lines: rows, then columns.
        done = set()
        for near_rows in self.near_sides(rows):
            for r in near_rows:
                if r not in done:
                    done.add(r)
                    self.line([(r, cols.core + i) for i in range(cols.n_core)], cols.shared, False)
        done = set()
        for near_cols in self.near_sides(cols):
            for c in near_cols:
                if c not in done:
                    done.add(c)
                    self.line([(rows.core + i, c) for i in range(rows.n_core)], rows.shared, True)

    def corner(self, place):
        p = self.parent
        a, b = place[0] + self.offset[0], place[1] + self.offset[1]  # doubled
        i, j = a // 2, b // 2
        i1, j1 = min((a + 1) // 2, len(p) - 1), min((b + 1) // 2, len(p[0]) - 1)
        h = (p[i][j] + p[i][j1] + p[i1][j] + p[i1][j1] + 2) >> 2
        self.put(place, self.rebuild(h, self.symbol(place, 0, 16)))

    def d(self, place):
        return self.heights[place[0]][place[1]]

    def line(self, places, shared, is_column):
        length = len(places)
        f = self.reach + 1 if shared[0] else 0
        g = length - self.reach - 1 if shared[1] else length
        if f >= g:
            return
        r, c = places[0]
        n_parents = (length + 1) // 2
        if is_column:
            a, start = c + self.offset[1], (r + self.offset[0]) // 2
            lines = list(zip(*self.parent, strict=True))
        else:
            a, start = r + self.offset[0], (c + self.offset[1]) // 2
            lines = self.parent
        first, second = lines[a // 2], lines[min((a + 1) // 2, len(lines) - 1)]
        x = [first[start + i] + second[start + i] for i in range(n_parents)]
        extended = extend(x)
        p = [(synthesise(extended, i) + 2**14) >> 15 for i in range(length)]
        n = self.n
        for phase in (0, 1):
            last = before_last = 0  # l and l'
            for i in range(f, g):
                if i % 2 != phase:
                    continue
                if phase == 0:
                    kappa, t = 0, last + before_last
                else:
                    j = i + 1 if i + 1 < length else i - 1
                    a = self.d(places[i - 1]) - p[i - 1]
                    b = self.d(places[j]) - p[j]
                    kappa = (a + b) >> 1
                    t = (2 * abs(a - kappa) + 2 * abs(b - kappa)) // n + last
                beta = abs(p[i - 1] - 2 * p[i] + p[i + 1]) if 0 < i < length - 1 else 0
                s = 4 * t + min(8 * beta // n, 1024)
                v = self.symbol(places[i], phase, s)
                self.put(places[i], self.rebuild(p[i] + kappa, v))
                before_last, last = last, min(abs(v), 255)


JS, JZTR, JZTC = "JS", "JZTR", "JZTC"  # labels of nodes

GAIN = {
    "LL": [3153, 2275, 1687, 1269, 958, 725, 548, 415, 314, 238, 180, 136],
    "HL": [4050, 3104, 2242, 1663, 1251, 945, 715, 541, 409, 310, 234, 177],
    "HH": [5203, 4235, 2981, 2181, 1634, 1233, 933, 706, 534, 404, 305, 230],
}
GAIN["LH"] = GAIN["HL"]
BANDS = ("HL", "LH", "HH")

# Weights of the neighbours W, N, NW, NE, WW, NN (§7.5).
WEIGHTS = {"HL": (6, 6, 0, 2, 1, 1), "LH": (6, 6, 0, 2, 1, 1), "HH": (6, 5, 1, 2, 1, 1)}
HL_ALONG = (1, 13, 0, 0, 0, 2)
LH_ALONG = (13, 1, 0, 0, 2, 0)
NEIGHBOURS = ((0, -1), (-1, 0), (-1, -1), (-1, 1), (0, -2), (-2, 0))


def at_or_zero(grid, i, j):
    return grid[i][j] if 0 <= i < len(grid) and 0 <= j < len(grid[0]) else 0


def zeros(n_rows, n_cols):
    return [[0] * n_cols for _ in range(n_rows)]


def node_sizes(n_core_rows, n_core_cols):
    """Return R_t and C_t for t = 0 … T (§7.5)."""
    sizes = [(n_core_rows, n_core_cols)]
    while True:
        t = len(sizes)
        sizes.append((((n_core_rows - 1) >> t) + 1, ((n_core_cols - 1) >> t) + 1))
        if sizes[-1] == (1, 1):
            return sizes


def roughness(n, unit, parent_unit, parent_heights, size):
    """ϱ of the finest nodes (§7.5)."""
    found = zeros(*size)
    if parent_unit is None:
        return found
    p = parent_heights
    first_row = unit.rows.core_first // 2 - parent_unit.rows.first
    first_col = unit.cols.core_first // 2 - parent_unit.cols.first

    def at(i, j):
        return p[clamp(i, 0, len(p) - 1)][clamp(j, 0, len(p[0]) - 1)]

    for i in range(size[0]):
        for j in range(size[1]):
            r, c = first_row + i, first_col + j
            b = abs(at(r - 1, c) + at(r + 1, c) - 2 * at(r, c))
            b += abs(at(r, c - 1) + at(r, c + 1) - 2 * at(r, c))
            found[i][j] = min(4 * b // n, 1024)
    return found


def decode_coefficients(decoder, sizes, rough, along):
    """Return LL and, for each t and band, the coefficients as grids of nodes (§7.5)."""
    models = Models(4124, STARTS_97["tree"])
    n_transforms = len(sizes) - 1
    coefficients = [{band: zeros(*sizes[t + 1]) for band in BANDS} for t in range(n_transforms)]
    magnitudes = [{band: zeros(*sizes[t + 1]) for band in BANDS} for t in range(n_transforms)]
    labels = [
        [[None] * sizes[t + 1][1] for _ in range(sizes[t + 1][0])] for t in range(n_transforms)
    ]

    e = decoder.unary(models, 4092, 31)
    ll = (1 << e | decoder.raw(e)) - 1
    if ll and decoder.raw(1):
        ll = -ll

    for t in reversed(range(n_transforms)):
        n_rows, n_cols = sizes[t]
        for i in range(sizes[t + 1][0]):
            for j in range(sizes[t + 1][1]):
                is_root = t == n_transforms - 1
                if not is_root and labels[t + 1][i >> 1][j >> 1] != JS:
                    labels[t][i][j] = JZTC
                    continue
                exists = {"HL": j < n_cols >> 1, "LH": i < n_rows >> 1}
                exists["HH"] = exists["HL"] and exists["LH"]
                s = {}
                for band in BANDS:
                    s[band] = 0
                    if not is_root:
                        grid = magnitudes[t + 1][band]
                        i1, j1 = i >> 1, j >> 1
                        around = sum(
                            at_or_zero(grid, i1 + di, j1 + dj)
                            for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1))
                        )
                        s[band] = (2 * grid[i1][j1] + around) >> 2
                    weights = WEIGHTS[band]
                    if t == 0 and band == "HL" and along[0]:
                        weights = HL_ALONG
                    if t == 0 and band == "LH" and along[1]:
                        weights = LH_ALONG
                    for weight, (di, dj) in zip(weights, NEIGHBOURS, strict=True):
                        s[band] += weight * at_or_zero(magnitudes[t][band], i + di, j + dj)
                if t == 0:
                    s["HL"] += rough[i][j]
                    s["LH"] += rough[i][j]
                    s["HH"] += rough[i][j] >> 1
                n_js = (at_or_zero(labels[t], i, j - 1) == JS) + (
                    at_or_zero(labels[t], i - 1, j) == JS
                )
                b = bin_of(min(sum(s.values()) >> 1, 4095))
                if not decoder.bit(models, (3 * min(t, 4) + n_js) * 36 + b):
                    labels[t][i][j] = JZTR
                    continue
                labels[t][i][j] = JS

                def coefficient(number, s, is_not_zero, t=t):
                    b = bin_of(min(s >> 1, 4095))
                    zero_flag = 540 + (3 * min(t, 3) + number) * 36 + b
                    if not is_not_zero and not decoder.bit(models, zero_flag):
                        return 0
                    value = 1 + decoder.magnitude(
                        models,
                        972 + ((3 * min(t, 1) + number) * 36 + b) * 14,
                        3996 + 32 * number,
                        max(0, b // 3 - 6),
                    )
                    return -value if decoder.raw(1) else value

                size = 0  # what is added to S: the magnitudes read before
                for number, band in enumerate(BANDS):
                    if not exists[band]:
                        continue
                    must = band == "HH" and t == 0 and size == 0
                    value = coefficient(number, s[band] + size, must)
                    coefficients[t][band][i][j] = value
                    magnitudes[t][band][i][j] = min(abs(value), 255)
                    size += min(abs(value), 255)
    return ll, coefficients, magnitudes


def inverse_line(x):
    """§7.6, one line."""
    n = len(x)
    if n == 1:
        return x
    x = list(x)
    for first, w in ((0, 1817), (1, 3616), (0, -217), (1, -6497)):
        for i in range(first, n, 2):
            left = x[i - 1] if i > 0 else x[1]
            right = x[i + 1] if i + 1 < n else x[n - 2]
            x[i] -= (w * (left + right) + 2048) >> 12
    return x


def inverse_transform(ll, details, sizes):
    """Return the core's details, 64 to the quantum (§7.6)."""
    low = [[ll]]
    for t in reversed(range(len(details))):
        n_rows, n_cols = sizes[t]
        x = zeros(n_rows, n_cols)
        for grid, high_row, high_col in (
            (low, 0, 0),
            (details[t]["HL"], 0, 1),
            (details[t]["LH"], 1, 0),
            (details[t]["HH"], 1, 1),
        ):
            for r in range(high_row, n_rows, 2):
                for c in range(high_col, n_cols, 2):
                    x[r][c] = grid[r // 2][c // 2]
        columns = [inverse_line(column) for column in zip(*x, strict=True)]
        low = [inverse_line(row) for row in zip(*columns, strict=True)]
    return low


CURVES = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (1, 2), (2, 1))
EARLIER = (
    (0, -1), (0, -2), (-1, 0), (-1, -1), (-1, 1), (-1, -2), (-1, 2),
    (-2, 0), (-2, -1), (-2, 1), (-2, -2), (-2, 2),
)  # fmt: skip


def lg(v):
    """§7.7: eighths of octaves."""
    for limit, shift in ((4096, 0), (2**20, 8), (2**28, 16)):
        if v < limit:
            v >>= shift
            return (v**8).bit_length() - 1 + 8 * shift if v else 0
    raise AssertionError("E is below 2^28")


def extended(line):
    """§7.7: two samples more at both ends."""
    last = len(line) - 1
    before = [2 * line[0] - line[min(k, last)] for k in (2, 1)]
    after = [2 * line[last] - line[max(last - k, 0)] for k in (1, 2)]
    return before + list(line) + after


def decode_residuals(decoder, n, base, weights, core, heights, known, is_coded):
    """§7.7; `heights` and `known` are those of the region, `core` its place in them."""
    models = Models(1527, STARTS_97["residual"])
    wide = [extended(row) for row in base]
    wide = list(zip(*(extended(column) for column in zip(*wide, strict=True)), strict=True))
    shift = 0
    while n >> shift >= 4096:
        shift += 1
    inverse = 2**22 // (n >> shift)

    def steps(d, f):
        return ((min(d, 2**40) >> shift) * inverse) >> (22 - f)

    def cut(x):
        return clamp(x, -(2**30), 2**30)

    limit = 2**31 // n + 1
    n_rows, n_cols = len(base), len(base[0])
    errors, mus, signs = (zeros(n_rows, n_cols) for _ in range(3))
    for r in range(n_rows):
        for c in range(n_cols):
            terms = []
            for i, j in CURVES:
                places = {(a, b) for a in (-i, i) for b in (-j, j)}
                around = sum(wide[r + 2 + a][c + 2 + b] for a, b in places)
                terms.append(cut(around - len(places) * base[r][c]))
            terms += [at_or_zero(errors, r + a, c + b) for a, b in EARLIER]
            phase = 2 * (r % 2) + c % 2
            p = sum(w * t for w, t in zip(weights[phase], terms, strict=True))
            p = clamp((256 * base[r][c] + p) >> 8, -64 * M, 64 * M)
            h = (p + 32) >> 6
            phi = p - 64 * h
            i, j = core.row + r, core.col + c
            if is_coded(r, c):
                near = [
                    at_or_zero(mus, r + a, c + b)
                    for a, b in ((0, -1), (0, -2), (-1, 0), (-1, -1), (-1, 1), (-2, 0))
                ]
                total = sum(w * m for w, m in zip(E_WEIGHTS_97, near, strict=False))
                e_n, e_nw, e_ne = terms[9], terms[10], terms[11]
                slope = abs(e_n - e_nw) + abs(e_ne - e_n)
                total += E_WEIGHTS_97[7] + steps(E_WEIGHTS_97[6] * slope, -1)
                eta = clamp(((lg(min(total >> 4, 2**28 - 1)) - 24) >> 2) + 1, 0, 43)
                value = 0
                if decoder.bit(models, 4 * (44 * phase + eta) + min(steps(abs(phi), -3), 3)):
                    s_w, s_n, s_nw, s_ne, *_ = (
                        at_or_zero(signs, r + di, c + dj) for di, dj in NEIGHBOURS
                    )
                    west = 2 * s_w + s_nw
                    x = 0 if west < 0 else 1 if west == 0 else 2
                    y = clamp(2 * s_n + s_ne, -2, 2) + 2
                    side = min((steps(6 * abs(phi), -5) + 1) >> 1, 3)
                    sigma = 3 + side if phi > 0 else 3 - side
                    sign = -1 if decoder.bit(models, 704 + 7 * (5 * x + y) + sigma) else 1
                    kappa = max(0, ((20 + 4 * eta) >> 3) - 9)
                    value = 1 + decoder.magnitude(models, 879 + 14 * eta, 1495, kappa)
                    value = sign * min(value, limit)
                    signs[r][c] = sign
                heights[i][j] = clamp(h + value * n, -M, M)
            elif not known[i][j]:
                heights[i][j] = h
            if is_coded(r, c) or known[i][j]:
                mus[r][c] = min(steps(abs(64 * heights[i][j] - p), -1), 32767)
            errors[r][c] = cut(64 * heights[i][j] - base[r][c])


def decode_cdf97(h, unit, payload, valid, parent_unit, parent_heights):
    n, rows, cols = h.step, unit.rows, unit.cols
    # §7.1
    require(len(payload) >= 1, "payload of cdf97 is empty")
    flags, at = payload[0], 1
    require(flags in (0, 1, 2, 3, 4), "flags of cdf97")
    with_coefficients, with_residuals, is_raw = flags & 1, flags & 2, flags & 4
    if is_raw:
        require(at < len(payload), "payload is cut off")
        width = payload[at]
        require(width <= 32, "width of raw heights")
        z, at = read_varint(payload, at + 1)
        base = -(z + 1) // 2 if z % 2 else z // 2
        require(abs(base) <= M, "base of raw heights")
    if with_coefficients:
        step_code, at = read_varint(payload, at)
        require(1 <= step_code <= 2**32, "step code")
        require(at < len(payload), "payload is cut off")
        byte, at = payload[at], at + 1
        require(byte < 64, "byte after the step code")
        rho, along = byte & 15, (byte >> 4 & 1, byte >> 5 & 1)
    if with_residuals:
        require(at < len(payload), "payload is cut off")
        weight_set, at = payload[at], at + 1
        require(weight_set < len(TERM_WEIGHTS_97), "set of weights")
    decoder = RangeDecoder(payload[at:])

    heights = predict_region(unit, parent_unit, parent_heights)
    predicted = [list(row) for row in heights]
    border = BorderDecoder(h, unit, decoder, valid, parent_unit, parent_heights, heights)
    border.run()

    def is_coded(r, c):
        """Place in the core; the caller's r and c are inside it."""
        return (
            valid[rows.core + r][cols.core + c] and not border.known[rows.core + r][cols.core + c]
        )

    limit = 2**31 // n + 1
    if is_raw:
        # §7.4
        for r in range(rows.n_core):
            for c in range(cols.n_core):
                if is_coded(r, c):
                    z = base + min(decoder.raw(width), limit) * n
                    heights[rows.core + r][cols.core + c] = min(z, M)
        decoder.end()
        return heights

    sizes = node_sizes(rows.n_core, cols.n_core)
    rough = roughness(n, unit, parent_unit, parent_heights, sizes[1])
    x = zeros(rows.n_core, cols.n_core)
    if with_coefficients:
        ll, coefficients, _ = decode_coefficients(decoder, sizes, rough, along)

        def dequantised(t, band, q):
            if q == 0:
                return 0
            delta = clamp(step_code * n * 64 * GAIN[band][t] // 131072, 1, 2**40)
            size = min(abs(q), 2**40 // delta + 1) * 64 - (0 if band == "LL" else rho)
            value = (size * delta) >> 6
            return value if q > 0 else -value

        details = [
            {
                band: [[dequantised(t, band, q) for q in row] for row in grids[band]]
                for band in BANDS
            }
            for t, grids in enumerate(coefficients)
        ]
        x = inverse_transform(dequantised(len(sizes) - 2, "LL", ll), details, sizes)

    # §7.6
    base = [
        [
            clamp(64 * predicted[rows.core + r][cols.core + c] + x[r][c], -64 * M, 64 * M)
            for c in range(cols.n_core)
        ]
        for r in range(rows.n_core)
    ]
    core = SimpleNamespace(row=rows.core, col=cols.core)
    if with_residuals:
        weights = TERM_WEIGHTS_97[weight_set]
        decode_residuals(decoder, n, base, weights, core, heights, border.known, is_coded)
    else:
        for r in range(rows.n_core):
            for c in range(cols.n_core):
                if not border.known[core.row + r][core.col + c]:
                    heights[core.row + r][core.col + c] = (base[r][c] + 32) >> 6
    decoder.end()
    return heights


# The whole file --------------------------------------------------------------------------------


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
    """Decode all units down to a level; return those of the level: unit, heights, mask."""
    grid = file.grid
    holders = {}  # block -> the unit that holds it, decoded
    for k in range(-1, level):
        decoded = []
        for key in grid.root_keys() if k < 0 else grid.blocks(k):
            unit = grid.unit(key)
            if k < 0:
                parent = None, None, None
            else:
                holder, heights, valid = holders[key]
                place = block_with_apron(grid, key, holder)
                parent = place, cut(heights, holder, place), cut(valid, holder, place)
            decoded.append((unit, *decode_payload(file, unit, file.payloads[key], *parent)))
        holders = {block: one for one in decoded for block in grid.blocks_of_key(one[0].key)}
    return decoded


def decode_quanta(file, level):
    """Return quantum numbers and mask of a level, as lists of lists; None where not seen."""
    n_rows, n_cols = file.grid.samples(level)
    heights = [[None] * n_cols for _ in range(n_rows)]
    mask = [[None] * n_cols for _ in range(n_rows)]
    for unit, unit_heights, valid in decode_units(file, level):
        for i in range(unit.rows.n):
            for j in range(unit.cols.n):
                r, c = unit.rows.first + i, unit.cols.first + j
                # §2.4: units that share a sample agree about it.
                if mask[r][c] is not None:
                    require(mask[r][c] == valid[i][j], "masks of neighbours")
                    same = heights[r][c] == unit_heights[i][j]
                    require(same or not valid[i][j], "heights of neighbours")
                heights[r][c], mask[r][c] = unit_heights[i][j], valid[i][j]
    return heights, mask


def decode(data, level=-1):
    """Return the raw heights and the mask of one level; level 0 is the coarsest, -1 the last."""
    file = read_file(data)
    quanta, mask = decode_quanta(file, level if level >= 0 else level + file.grid.k_max + 1)
    dtype = np.dtype(DTYPES[file.header.dtype])
    void = nodata_in_dtype(file)
    if void is None:
        void = np.nan if dtype.kind == "f" else 0
    valid = np.array(mask, bool)
    heights = np.full(valid.shape, void, dtype)
    for r, c in np.argwhere(valid).tolist():
        heights[r, c] = raw_height(file.header, quanta[r][c])
    return heights, valid
