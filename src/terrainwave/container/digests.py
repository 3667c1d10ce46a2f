"""Digests of heights: a tree of SHA-256 whose root identifies a raster (FORMAT.md §4.9).

The tree depends only on the samples of the full grid, not on blocks or methods, so the same heights
have the same root however they are coded.
"""

import hashlib
import struct
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.container.header import DTYPE_CODES, SMALLEST_DIGESTS, Header
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Region

# Samples per side of a tile; nodes per side below one node. A leaf is a node of tiles.
TILE, FAN = 512, 8
VOID = bytes(32)
_TILE, _NODE, _ROOT = b"\0", b"\1", b"\2"
_TAIL = struct.Struct("<II")
TAIL_LENGTH = _TAIL.size
_PLACE = struct.Struct("<IIB9d")
_MISSING = (1 << 32) - 1
_NAN = float("nan")
_KINDS = ("height", "depth", "radius")

Place = tuple[int, int]
Nodes = Mapping[Place, bytes]


def tile_digests(
    region: Region, raw: NDArray[np.generic], valid: NDArray[np.bool_]
) -> dict[Place, bytes]:
    """Return the digests of the tiles of a window that have valid samples.

    The window begins at a tile and ends with one, or at the raster's edge. Voids may hold anything.
    """
    found = {}
    for row in range(0, region.n_rows, TILE):
        for col in range(0, region.n_cols, TILE):
            part = np.s_[row : row + TILE, col : col + TILE]
            digest = _tile_digest(raw[part], valid[part])
            if digest != VOID:
                found[(region.row + row) // TILE, (region.col + col) // TILE] = digest
    return found


def _tile_digest(raw: NDArray[np.generic], valid: NDArray[np.bool_]) -> bytes:
    if not valid.all():
        if not valid.any():
            return VOID
        raw = np.where(valid, raw, raw.dtype.type(0))
    digest = hashlib.sha256(_TILE)
    digest.update(np.ascontiguousarray(raw, dtype=raw.dtype.newbyteorder("<")).data)
    digest.update(np.packbits(valid).data)
    return digest.digest()


class TileDigests:
    """Digests of the tiles added so far; a complete leaf is stored as one digest."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._tiles: dict[Place, dict[Place, bytes]] = {}
        self._leaves: dict[Place, bytes] = {}

    def add(self, tiles: Nodes) -> None:
        for (row, col), digest in tiles.items():
            leaf = row // FAN, col // FAN
            of_leaf = self._tiles.setdefault(leaf, {})
            of_leaf[row, col] = digest
            if len(of_leaf) == FAN * FAN:
                self._leaves[leaf] = _node(self._tiles.pop(leaf), leaf, _counts(self._shape, 0))

    def tree(self) -> "DigestTree":
        counts = _counts(self._shape, 0)
        rest = {leaf: _node(tiles, leaf, counts) for leaf, tiles in self._tiles.items()}
        return DigestTree(self._shape, self._leaves | rest)


class DigestTree:
    """The tree above the leaves of a raster: the nodes of 4096 x 4096 samples with valid ones."""

    def __init__(self, shape: tuple[int, int], leaves: Nodes) -> None:
        self.shape = shape
        self.leaves = leaves
        # By height, the leaves first and the top last.
        self._levels: list[Nodes] = [leaves]
        while (counts := _counts(shape, len(self._levels))) != (1, 1):
            below = self._levels[-1]
            parents = dict.fromkeys((row // FAN, col // FAN) for row, col in sorted(below))
            self._levels.append({place: _node(below, place, counts) for place in parents})

    @property
    def top(self) -> bytes:
        return self._levels[-1].get((0, 0), VOID)

    def root(self, header: Header) -> str:
        return hashlib.sha256(_ROOT + _description(header) + self.top).hexdigest()

    def differences(self, other: "DigestTree") -> Iterator[Region]:
        """Yield the samples of each leaf that differs in another tree of the same raster."""
        side = TILE * FAN
        whole = Region(0, 0, *self.shape)
        for row, col in sorted({place for place, _ in self.leaves.items() ^ other.leaves.items()}):
            yield Region(row * side, col * side, side, side).intersect(whole)

    def pack(self) -> bytes:
        digests = [self.top]
        for height in range(len(self._levels) - 1, 0, -1):
            counts, below = _counts(self.shape, height), self._levels[height - 1]
            for place in sorted(self._levels[height]):
                digests += [below.get(child, VOID) for child in _children(place, counts)]
        body = b"".join(digests)
        return body + _TAIL.pack(zlib.crc32(body), len(digests))


def section_length(tail: bytes) -> int:
    return len(VOID) * int(_TAIL.unpack(tail)[1]) + TAIL_LENGTH


def unpack_digests(section: bytes, shape: tuple[int, int]) -> DigestTree:
    crc, n_digests = _TAIL.unpack(section[-TAIL_LENGTH:])
    body = section[:-TAIL_LENGTH]
    if zlib.crc32(body) != crc or len(body) != len(VOID) * n_digests:
        raise CorruptStreamError("checksum of the digests does not match")
    digests = iter([body[at : at + len(VOID)] for at in range(0, len(body), len(VOID))])
    height = 1
    while _counts(shape, height) != (1, 1):
        height += 1
    top = next(digests)
    level = {} if top == VOID else {(0, 0): top}
    while height := height - 1:
        counts, below = _counts(shape, height), dict[Place, bytes]()
        for place in sorted(level):
            for child in _children(place, counts):
                found = next(digests, None)
                if found is None:
                    raise CorruptStreamError(f"found {n_digests} digests, expected more")
                if found != VOID:
                    below[child] = found
        level = below
    if next(digests, None) is not None:
        raise CorruptStreamError(f"found {n_digests} digests, expected fewer")
    tree = DigestTree(shape, level)
    if tree.pack() != section:
        raise CorruptStreamError("a digest is not that of the digests below it")
    return tree


assert SMALLEST_DIGESTS == len(VOID) + TAIL_LENGTH


def _counts(shape: tuple[int, int], height: int) -> tuple[int, int]:
    """Return rows and columns of the children of nodes of `height` + 1 (1: leaves; 0: tiles)."""
    side = TILE * FAN**height
    return -(-shape[0] // side), -(-shape[1] // side)


def _children(place: Place, counts: tuple[int, int]) -> Iterator[Place]:
    for row in range(FAN * place[0], min(FAN * (place[0] + 1), counts[0])):
        for col in range(FAN * place[1], min(FAN * (place[1] + 1), counts[1])):
            yield row, col


def _node(below: Nodes, place: Place, counts: tuple[int, int]) -> bytes:
    digests = [below.get(child, VOID) for child in _children(place, counts)]
    if all(digest == VOID for digest in digests):
        return VOID
    return hashlib.sha256(_NODE + b"".join(digests)).digest()


def _description(header: Header) -> bytes:
    """Return meaning and position of the heights in the canonical form of FORMAT.md §4.9."""
    metadata = header.metadata
    numbers = [
        *(metadata.get("transform") or (1, 0, 0, 0, 1, 0)),  # type: ignore[misc]
        _or(metadata.get("scale"), 1),
        _or(metadata.get("offset"), 0),
    ]
    epoch = metadata.get("coordinate_epoch")
    is_number = isinstance(epoch, int | float) and not isinstance(epoch, bool)
    numbers.append(epoch if is_number else _NAN)
    kind = metadata.get("heights_are")
    texts = [metadata.get(key) for key in ("crs", "units", "area_or_point")]
    texts.append(kind if kind in _KINDS else None)
    return _PLACE.pack(
        header.n_rows,
        header.n_cols,
        DTYPE_CODES[header.dtype],
        *(float(number) + 0.0 for number in numbers),  # -0.0 counts as 0.0
    ) + b"".join(map(_text, texts))


def _or(value: Any, default: float) -> Any:
    return default if value is None else value


def _text(text: Any) -> bytes:
    if text is None:
        return _MISSING.to_bytes(4, "little")
    data = text.encode("utf-8")
    return len(data).to_bytes(4, "little") + bytes(data)
