"""Digests of heights, and their root (docs/FORMAT.md §4.9)."""

import hashlib
import math
import struct
import zlib

import numpy as np

from terrainwave.reference.basics import require

NONE = bytes(32)
DTYPE_CODES = {"uint8": 1, "uint16": 3, "int16": 4, "int32": 6, "float32": 7, "float64": 8}


def sha(data):
    return hashlib.sha256(data).digest()


def n_nodes(n_samples, height):
    """Return how many nodes of a height lie along an axis."""
    return math.ceil(n_samples / (512 * 8**height))


def children(shape, height, i, j):
    """Return the places of the children of a node, in raster order."""
    rows, cols = (n_nodes(n, height - 1) for n in shape)
    return [
        (8 * i + a, 8 * j + b)
        for a in range(8)
        for b in range(8)
        if 8 * i + a < rows and 8 * j + b < cols
    ]


def top_height(shape):
    height = 1
    while n_nodes(max(shape), height) > 1:
        height += 1
    return height


def tile_digest(heights, valid):
    if not valid.any():
        return NONE
    data = b"\0"
    for height, is_valid in zip(heights.ravel(), valid.ravel(), strict=True):
        stored = height if is_valid else heights.dtype.type(0)
        data += np.array(stored, heights.dtype.newbyteorder("<")).tobytes()
    bits = "".join("01"[int(one)] for one in valid.ravel())
    bits += "0" * (-len(bits) % 8)
    return sha(data + bytes(int(bits[n : n + 8], 2) for n in range(0, len(bits), 8)))


def digests_of(heights, valid):
    """Return the digests of all nodes by height and place."""
    shape, found = heights.shape, {}
    for i in range(n_nodes(shape[0], 0)):
        for j in range(n_nodes(shape[1], 0)):
            part = np.s_[512 * i : 512 * i + 512, 512 * j : 512 * j + 512]
            found[0, i, j] = tile_digest(heights[part], valid[part])
    for height in range(1, top_height(shape) + 1):
        for i in range(n_nodes(shape[0], height)):
            for j in range(n_nodes(shape[1], height)):
                below = [found[height - 1, *place] for place in children(shape, height, i, j)]
                is_void = all(one == NONE for one in below)
                found[height, i, j] = NONE if is_void else sha(b"\1" + b"".join(below))
    return found


def section_of(heights, valid):
    """Return the section of the digests."""
    shape, found = heights.shape, digests_of(heights, valid)
    top = top_height(shape)
    listed = [found[top, 0, 0]]
    for height in range(top, 1, -1):
        for (h, i, j), digest in sorted(found.items()):
            if h == height and digest != NONE:
                listed += [found[h - 1, *place] for place in children(shape, h, i, j)]
    body = b"".join(listed)
    return body + struct.pack("<II", zlib.crc32(body), len(listed))


def section_before(data, segments_end):
    """Return the section of a file; its bytes are checked, not what they are of."""
    crc, n = struct.unpack("<II", data[-8:])
    require(n >= 1 and segments_end == len(data) - 8 - 32 * n, "place of the digests")
    require(zlib.crc32(data[segments_end:-8]) == crc, "crc of the digests")
    return data[segments_end:]


def root_of(header, metadata, dtype, top):
    """Return the root in hexadecimal."""
    known = {key: value for key, value in metadata.items() if value is not None}
    epoch = known.get("coordinate_epoch")
    is_number = isinstance(epoch, int | float) and not isinstance(epoch, bool)
    kind = known.get("heights_are")
    data = b"\2" + struct.pack("<IIB", header.n_rows, header.n_cols, DTYPE_CODES[dtype])
    for number in (
        *known.get("transform", [1, 0, 0, 0, 1, 0]),
        known.get("scale", 1),
        known.get("offset", 0),
    ):
        data += struct.pack("<d", abs(float(number)) if number == 0 else float(number))
    data += struct.pack("<d", float(epoch)) if is_number else bytes.fromhex("000000000000f87f")
    is_word = isinstance(kind, str) and kind in ("height", "depth", "radius")
    for text in (
        known.get("crs"),
        known.get("units"),
        known.get("area_or_point"),
        kind if is_word else None,
    ):
        text = None if text is None else text.encode()
        data += struct.pack("<I", 2**32 - 1 if text is None else len(text)) + (text or b"")
    return hashlib.sha256(data + top).hexdigest()
