"""Partial reading of cdf53 files: choice of bytes per tile (format-cdf53.md, C.7)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from terrainwave.codec.cdf53.refiner import (
    TileHead,
    finest_position,
    packed_length,
    plane_cut,
    prefix_length,
    unpack_head,
)
from terrainwave.codec.cdf53.tile_layout import TileLayout
from terrainwave.container.reader import Container
from terrainwave.errors import CorruptStreamError, TruncatedStreamError
from terrainwave.grid.quadtree import Block, Region
from terrainwave.read.decoder import TreeDecoder, unit_name, units_of
from terrainwave.read.window_reader import make_decoder

# Bytes read first of each payload, for its head; longer heads need more.
_FIRST_READ = 512


@dataclass(frozen=True)
class _Begun:
    """A tile whose head has been read."""

    start: bytes
    head: TileHead
    n_head: int
    n_below: int

    def n_bytes(self, position: float) -> int:
        """Return the bytes to read of the payload for a position (`plane_cut`)."""
        kept = plane_cut(self.head.ends, self.head.n_stream, position - self.n_below)
        return max(len(self.start), self.n_head + prefix_length(kept, self.head.n_stream))


def early_decoder(
    container: Container, level: int, region: Region, quality: float, *, cache_bytes: int
) -> tuple[TreeDecoder, "EarlyPayloads"]:
    """Return the decoder of a region at a number of bits per sample, and its payloads."""
    max_bytes = int(quality * region.n_rows * region.n_cols / 8)
    payloads = EarlyPayloads(container, units_of(container.grid, level, region), max_bytes)
    return make_decoder(container.header, payloads, cache_bytes, are_prefixes=True), payloads


class EarlyPayloads:
    """Beginnings of payloads that give the best surface for a number of bytes.

    Parameters
    ----------
    keys : iterable of Block
        Keys of the wanted units.
    max_bytes : int
        Bytes to read of payloads; the heads of all tiles are read in any case.

    Notes
    -----
    `n_bytes` counts the bytes read of payloads, which stay in memory.
    """

    def __init__(self, container: Container, keys: Iterable[Block], max_bytes: int) -> None:
        self._container = container
        self._layout = TileLayout(container.grid, container.header.has_voids)
        self.n_bytes = 0
        parts = self._read_heads(self._tiles_above(keys))
        coarsest = max((one.head.n_planes + one.n_below for one in parts.values()), default=0)
        position = finest_position(
            lambda position: sum(one.n_bytes(position) for one in parts.values()),
            float(coarsest),
            max_bytes,
        )
        self._payloads = {key: part.start for key, part in parts.items()}
        self._read_on(self._payloads, {key: part.n_bytes(position) for key, part in parts.items()})

    def __call__(self, keys: Sequence[Block]) -> list[bytes]:
        """Return the bytes read of the payloads of `keys`; empty if none were read."""
        return [self._payloads.get(key, b"") for key in keys]

    def _tiles_above(self, keys: Iterable[Block]) -> list[Block]:
        """Return the tiles that hold units, and their ancestors, once each."""
        tiles: dict[Block, None] = {}
        for unit in keys:
            key: Block | None = self._layout.key_of(unit)
            while key is not None and key not in tiles:
                tiles[key] = None
                key = self._layout.above(key)
        return list(tiles)

    def _read_heads(self, keys: list[Block]) -> dict[Block, _Begun]:
        lengths = dict(zip(keys, self._container.payload_lengths(keys), strict=True))
        keys = [key for key in keys if lengths[key]]
        starts = dict.fromkeys(keys, b"")
        parts: dict[Block, _Begun] = {}
        n_first = _FIRST_READ
        while len(parts) < len(keys):
            missing = [key for key in keys if key not in parts]
            ends = {key: min(n_first, lengths[key]) for key in missing}
            self._read_on(starts, ends)
            for key in missing:
                spec = self._layout.spec(key)
                try:
                    head, n_head = unpack_head(spec, starts[key])
                except TruncatedStreamError:
                    if ends[key] == lengths[key]:
                        raise
                    continue
                if n_head + packed_length(head.n_stream) != lengths[key]:
                    raise CorruptStreamError(
                        f"the tile of {unit_name(key)} is damaged: it takes {lengths[key]} bytes,"
                        f" not {n_head + packed_length(head.n_stream)}"
                    )
                parts[key] = _Begun(starts[key], head, n_head, spec.n_below)
            n_first *= 4
        return parts

    def _read_on(self, payloads: dict[Block, bytes], ends: dict[Block, int]) -> None:
        """Extend the beginnings of payloads to `ends`, near ones in one request."""
        keys = [key for key, end in ends.items() if end > len(payloads[key])]
        parts = [(key, len(payloads[key]), ends[key]) for key in keys]
        for key, data in zip(keys, self._container.payload_parts(parts), strict=True):
            payloads[key] += data
            self.n_bytes += len(data)
