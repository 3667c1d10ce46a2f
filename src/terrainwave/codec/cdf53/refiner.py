"""Method ``cdf53``: integer 5/3 wavelet and SPIHT in tiles, an embedded stream (format-cdf53.md).

X. Zheng, Y. Wang, X. Wang: integer 5/3 wavelet of the whole raster, coefficients cut into tiles,
each coded with SPIHT. Departures: tiles hold the lines on their borders instead, so that each can
be decoded from the tiles above it, and code these lines first.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from terrainwave.codec.cdf53.spiht import MAX_PLANES, decode_field, encode_field
from terrainwave.codec.cdf53.tile_border import decode_borders, encode_borders
from terrainwave.codec.cdf53.tile_layout import TileSpec
from terrainwave.codec.masks import Above, decode_validity, encode_validity
from terrainwave.codec.refiner import Heights, Validity, all_void
from terrainwave.codec.varint import decode_varint, encode_varint
from terrainwave.coding.lifting53 import forward_transform, inverse_transform
from terrainwave.errors import CorruptStreamError, TruncatedStreamError
from terrainwave.grid.quadtree import Region

HAS_MASKS = 1
PIECE = 4096
_CRC_BYTES = 4
# Heights of coarse levels may overshoot those of the raster; valid ones are far below this.
_MAX_HEIGHT = (1 << 31) - 1
# Steps of the bisection for the position of a cut.
_SEARCH_STEPS = 40


class LevelHeights(NamedTuple):
    """Heights (int32 quanta, unclipped from the wavelet) and validity of a region."""

    region: Region
    heights: Heights
    validity: Validity

    def part(self, region: Region) -> "LevelHeights":
        """Return a part of it; views."""
        at = region.slices_in(self.region)
        return LevelHeights(region, self.heights[at], self.validity.part(at))

    def copy(self) -> "LevelHeights":
        return LevelHeights(self.region, self.heights.copy(), self.validity.copy())


@dataclass(frozen=True)
class TileHead:
    """Head of a tile before its stream: enough to plan how much of the stream to read.

    `masks` are the coded masks of the levels, coarsest first, empty if implied. ``ends[i]`` bytes
    of the stream decode its first i + 1 planes; the last entry is the whole length;
    `n_stream` bytes are present. `low` is the LL sample of the root tile.
    """

    masks: tuple[bytes, ...]
    borders: bytes
    low: int
    ends: tuple[int, ...]
    n_stream: int

    @property
    def n_planes(self) -> int:
        """Return the number of bit planes."""
        return len(self.ends)


@dataclass(frozen=True)
class CodedTile:
    """A tile's whole stream and its head; `payload` returns the bytes for the file."""

    spec: TileSpec
    head: TileHead
    stream: bytes

    def payload(self, n_bytes: int | None = None) -> bytes:
        """Return the payload with the first `n_bytes` of the stream; all of it by default."""
        stream = self.stream if n_bytes is None else self.stream[:n_bytes]
        head = replace(self.head, n_stream=len(stream))
        return pack_head(head) + _pack_pieces(stream)


# Encoding


def encode_tile(
    spec: TileSpec, target: Heights, levels: Sequence[Validity], outer: Validity | None
) -> CodedTile | None:
    """Code a tile without loss.

    Parameters
    ----------
    target : ndarray of int32, shape ``spec.region.shape``
        Heights of the finest level, in quanta; voids hold their fill.
    levels : sequence of Validity
        Validity of each level, the coarsest first.
    outer : Validity or None
        Validity of the head's block; None for the root tile.

    Returns
    -------
    CodedTile or None
        None if nothing is valid.
    """
    if _is_void(levels[0]):
        return None
    sections = [
        _encode_masks(spec, index, level, outer if index == 0 else levels[index - 1])
        for index, level in enumerate(levels)
    ]
    field = target.astype(np.int64)
    forward_transform(field, spec.n_transforms, spec.held)
    low = int(field[0, 0]) if spec.is_root else 0
    borders = encode_borders(field, spec.n_transforms, spec.held) if spec.held else b""
    coded = encode_field(field, spec.n_transforms)
    stream = coded.stream if coded.n_planes else b""
    head = TileHead(
        masks=tuple(sections),
        borders=borders,
        low=low,
        ends=tuple(int(end) for end in coded.ends[::-1]),
        n_stream=len(stream),
    )
    return CodedTile(spec, head, stream)


def _encode_masks(spec: TileSpec, index: int, level: Validity, above: Validity | None) -> bytes:
    """Return the section of a level's validity; `above` is the next coarser level's."""
    is_finest = spec.is_finest(index)
    return encode_validity(
        level, spec.regions[index], _above(spec, index, above), is_finest=is_finest
    )


def _above(spec: TileSpec, index: int, above: Validity | None) -> Above | None:
    """Return the validity of the next coarser level, with its region."""
    outer = spec.outer if index == 0 else spec.regions[index - 1]
    return None if above is None or outer is None else Above(outer, above)


def _is_void(level: Validity) -> bool:
    return level.mask is not None and not level.mask.any()


# Bytes


def pack_head(head: TileHead) -> bytes:
    has_masks = any(head.masks)
    out = bytes([HAS_MASKS if has_masks else 0])
    for mask in head.masks if has_masks else ():
        out += encode_varint(len(mask)) + mask
    out += encode_varint(len(head.borders)) + head.borders
    out += encode_varint(2 * head.low if head.low >= 0 else -2 * head.low - 1)
    out += encode_varint(head.n_planes)
    starts = (0, *head.ends)[: head.n_planes]
    out += b"".join(
        encode_varint(end - start) for start, end in zip(starts, head.ends, strict=True)
    )
    out += encode_varint(head.n_stream)
    return out + zlib.crc32(out).to_bytes(_CRC_BYTES, "little")


def unpack_head(spec: TileSpec, payload: bytes) -> tuple[TileHead, int]:
    """Return the head and the position of the stream after it.

    `TruncatedStreamError`: the bytes end inside the head, and reading more may help.
    """
    if not payload:
        raise TruncatedStreamError("a tile has no head")
    flags = payload[0]
    if flags & ~(HAS_MASKS if spec.has_voids else 0):
        raise CorruptStreamError(f"a tile's flags are {flags:#04x}; reserved bits must be 0")
    pos = 1
    masks = []
    for _ in spec.regions:
        mask = b""
        if flags & HAS_MASKS:
            mask, pos = _take(payload, pos)
        masks.append(mask)
    borders, pos = _take(payload, pos)
    if bool(borders) != bool(spec.held):
        raise CorruptStreamError(f"a tile has {len(borders)} bytes of borders")
    folded, pos = decode_varint(payload, pos)
    low = folded >> 1 if folded & 1 == 0 else -((folded + 1) >> 1)
    if abs(low) > (_MAX_HEIGHT if spec.is_root else 0):
        raise CorruptStreamError(f"the LL sample of a tile is {low}")
    n_planes, pos = decode_varint(payload, pos)
    if n_planes > MAX_PLANES:
        raise CorruptStreamError(
            f"a tile has {n_planes} bit planes, at most {MAX_PLANES} are legal"
        )
    ends = []
    end = 0
    for _ in range(n_planes):
        length, pos = decode_varint(payload, pos)
        end += length
        ends.append(end)
    n_stream, pos = decode_varint(payload, pos)
    if n_stream > end:
        raise CorruptStreamError(f"a tile has {n_stream} of the {end} bytes of its stream")
    if pos + _CRC_BYTES > len(payload):
        raise TruncatedStreamError("a tile's head is cut short")
    if zlib.crc32(payload[:pos]) != int.from_bytes(payload[pos : pos + _CRC_BYTES], "little"):
        raise CorruptStreamError("the checksum of a tile's head is wrong")
    head = TileHead(tuple(masks), borders, low, tuple(ends), n_stream)
    return head, pos + _CRC_BYTES


def _take(payload: bytes, pos: int) -> tuple[bytes, int]:
    length, pos = decode_varint(payload, pos)
    if pos + length > len(payload):
        raise TruncatedStreamError(f"a section of {length} bytes is cut short (byte {pos})")
    return payload[pos : pos + length], pos + length


def _pack_pieces(stream: bytes) -> bytes:
    """Return the stream in pieces, each followed by its CRC-32."""
    pieces = [stream[at : at + PIECE] for at in range(0, len(stream), PIECE)]
    return b"".join(piece + zlib.crc32(piece).to_bytes(_CRC_BYTES, "little") for piece in pieces)


def _unpack_pieces(data: bytes) -> bytes:
    """Undo `_pack_pieces`."""
    whole = PIECE + _CRC_BYTES
    pieces = []
    for at in range(0, len(data), whole):
        part = data[at : at + whole]
        piece, crc = part[:-_CRC_BYTES], part[-_CRC_BYTES:]
        if not piece:
            raise TruncatedStreamError("a piece of a tile's stream is cut short")
        if zlib.crc32(piece) != int.from_bytes(crc, "little"):
            raise CorruptStreamError("the checksum of a piece of a tile's stream is wrong")
        pieces.append(piece)
    return b"".join(pieces)


def packed_length(n_bytes: int) -> int:
    """Return the packed length of a stream of `n_bytes`."""
    return n_bytes + -(-n_bytes // PIECE) * _CRC_BYTES


def prefix_length(n_bytes: int, total: int) -> int:
    """Return the packed length of the whole pieces in the first `n_bytes` of `total`."""
    if n_bytes >= total:
        return packed_length(total)
    return packed_length(n_bytes // PIECE * PIECE)


def unpack_tile(spec: TileSpec, payload: bytes) -> CodedTile:
    """Undo `CodedTile.payload` of a whole stream."""
    head, start = unpack_head(spec, payload)
    return CodedTile(spec, head, _unpack_pieces(payload[start:]))


# Decoding


def decode_tile(
    spec: TileSpec, outer: LevelHeights | None, payload: bytes, *, is_prefix: bool = False
) -> list[LevelHeights]:
    """Rebuild all levels of a tile, the coarsest first.

    Parameters
    ----------
    outer : LevelHeights or None
        The head's block; None for the root tile.
    is_prefix : bool
        `payload` may end anywhere after the head.
    """
    if not payload:
        if not spec.has_voids:
            raise CorruptStreamError("a tile without a payload in a file without voids")
        return [
            LevelHeights(region, np.zeros(region.shape, dtype=np.int32), all_void(region.shape))
            for region in spec.regions
        ]
    head, start = unpack_head(spec, payload)
    valid = decode_masks(spec, head, None if outer is None else outer.validity)
    packed, expected = payload[start:], packed_length(head.n_stream)
    if len(packed) < expected and is_prefix:
        packed = packed[: len(packed) // (PIECE + _CRC_BYTES) * (PIECE + _CRC_BYTES)]
    elif len(packed) != expected:
        raise CorruptStreamError(f"a tile's stream takes {len(packed)} bytes, not {expected}")
    stream = _unpack_pieces(packed)
    if head.n_planes:
        n_transforms, shape = spec.n_transforms, spec.region.shape
        is_cut = len(stream) < head.ends[-1]
        field = decode_field(stream, head.n_planes, shape, n_transforms, is_cut=is_cut)
    else:
        field = np.zeros(spec.region.shape, dtype=np.int64)
    if spec.held:
        decode_borders(head.borders, field, spec.n_transforms, spec.held)
    if outer is None:
        field[0, 0] = head.low
    else:
        n_rows, n_cols = outer.heights.shape
        field[:n_rows, :n_cols] = outer.heights
    levels = inverse_transform(field, spec.n_transforms, spec.held)[-len(spec.regions) :]
    return [
        LevelHeights(region, np.clip(heights, -_MAX_HEIGHT, _MAX_HEIGHT).astype(np.int32), validity)
        for region, heights, validity in zip(spec.regions, levels, valid, strict=True)
    ]


def decode_masks(spec: TileSpec, head: TileHead, outer: Validity | None) -> list[Validity]:
    """Return which samples of each level of a tile are valid, the coarsest first."""
    levels: list[Validity] = []
    above = outer
    for index, section in enumerate(head.masks):
        around, is_finest = _above(spec, index, above), spec.is_finest(index)
        above = decode_validity(section, spec.regions[index], around, is_finest=is_finest)
        levels.append(above)
    if _is_void(levels[0]):
        raise CorruptStreamError("a tile without a valid sample has a payload")
    return levels


# Cutting


def plane_cut(ends: Sequence[int], total: int, position: float) -> int:
    """Return the number of bytes to keep of a stream so that all tiles have equal quality.

    `position` counts bit planes of coefficients as the tile shifts them, down from the top: all
    planes from ⌈position⌉ up, and a share of the next.
    """
    missing = min(max(position, 0.0), float(len(ends)))
    n_whole = len(ends) - int(np.ceil(missing))
    done = ends[n_whole - 1] if n_whole else 0
    if n_whole == len(ends):
        return total
    return min(done + int((ends[n_whole] - done) * (np.ceil(missing) - missing)), total)


def finest_position(n_bytes: Callable[[float], int], coarsest: float, max_bytes: int) -> float:
    """Return the finest position (`plane_cut`) at which streams take at most `max_bytes`.

    `n_bytes` returns their size at a position. If all finer positions take too much, the result is
    `coarsest`, untested.
    """
    low, high = 0.0, coarsest
    if n_bytes(low) <= max_bytes:
        return low
    for _ in range(_SEARCH_STEPS):
        middle = (low + high) / 2
        if n_bytes(middle) <= max_bytes:
            high = middle
        else:
            low = middle
    return high
