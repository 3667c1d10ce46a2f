"""Pass B of method cdf53: code tiles, cut their streams, measure the decoded heights."""

import threading
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from terrainwave.codec.cdf53.refiner import (
    CodedTile,
    LevelHeights,
    decode_tile,
    encode_tile,
    finest_position,
    packed_length,
    plane_cut,
    unpack_tile,
)
from terrainwave.codec.cdf53.tile_layout import TileLayout, TileSpec
from terrainwave.codec.refiner import Decoded, GroupSpec, Heights, Mask, Validity
from terrainwave.container.spool import SectionFile, SegmentSpool
from terrainwave.container.writer import SpoolSink
from terrainwave.errors import InvalidArgumentError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.read.tile_decoder import final_heights
from terrainwave.write.encoder import TreeEncoder
from terrainwave.write.job import Job
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.found import Start, Stats
from terrainwave.write.pyramid import Pyramid

# Steps of the bisection by errors; each decodes everything.
_ERROR_STEPS = 9
# Estimated overhead of a file in bytes: in total, and for each unit.
_FILE_BYTES, _UNIT_BYTES = 600, 24


# Key of a tile to decode, and its head's block.
_Start = tuple[Block, LevelHeights | None]


def encode_tiles(
    job: Job,
    walked: tuple[Grid, CodecParameters, Pyramid, SpoolSink, Callable[[int], None]],
    bench: Bench,
) -> Stats:
    """Code every tile, cut as the job requires; return the statistics.

    `walked` are the arguments of a `TreeEncoder`.
    """
    options, executor = job.options, bench.executor
    _, parameters, pyramid, _, on_samples = walked
    coder = TileCoder(pyramid)
    if not options.is_embedded:
        return TileEncoder(coder, *walked).run(executor)
    layout = TileLayout(job.grid, parameters.has_voids)
    with closing(EmbeddedSource(coder, layout, bench.directory)) as source:
        source.code(executor, on_samples)
        rate, psnr = (getattr(options.choice.own, name, None) for name in ("rate", "psnr"))
        if rate is not None:
            n_bytes = int(rate * job.grid.n_rows * job.grid.n_cols / 8)
            source.cut_to_size(n_bytes - _FILE_BYTES - _UNIT_BYTES * job.grid.n_units())
        elif psnr is not None:
            span = parameters.z_max - parameters.z_min
            source.cut_to_error(span**2 * 10.0 ** (-psnr / 10), parameters, executor)
        return TileEncoder(source, *walked).run(executor)


# Source of a tile's payload, once the tile above is decoded; empty if no sample is valid.
TileSource = Callable[[TileSpec, LevelHeights | None], bytes]


class TileEncoder(TreeEncoder):
    """Encode all tiles of a raster."""

    def __init__(self, source: TileSource, *rest: Any) -> None:
        super().__init__(*rest)
        self._layout = TileLayout(self.grid, self.parameters.has_voids)
        self._source = source
        # Decoded tiles with pending units, and their number; the heads of pending tiles.
        self._tiles: dict[Block, list[LevelHeights]] = {}
        self._n_units: dict[Block, int] = {}
        self._heads: dict[Block, LevelHeights] = {}
        self._lock = threading.Lock()

    def code_unit(
        self, start: Start, spec: GroupSpec, target: Heights, mask: Mask
    ) -> tuple[bytes, Decoded]:
        """Return a tile's payload with its first unit, and empty payloads with the others."""
        key = start.key
        tile_key = self._layout.key_of(key)
        payload = self._begin(key) if key == tile_key else b""
        level = self._tiles[tile_key][key.level + 1 - max(tile_key.level + 1, 0)]
        decoded = final_heights(level.part(spec.region), self.parameters)
        with self._lock:
            self._n_units[tile_key] -= 1
            if not self._n_units[tile_key]:
                del self._tiles[tile_key], self._n_units[tile_key]
        return payload, decoded

    def _begin(self, key: Block) -> bytes:
        spec = self._layout.spec(key)
        outer = None if spec.is_root else self._heads[key]
        payload = self._source(spec, outer)
        levels = decode_tile(spec, outer, payload)
        with self._lock:
            self._heads.pop(key, None)
            self._tiles[key] = levels
            self._n_units[key] = self._layout.n_units(key)
            for head in self._layout.below(key):
                self._heads[head] = levels[-1].part(self.grid.block_region(head)).copy()
        return payload


class TileCoder:
    """Lossless coder of a raster's tiles."""

    def __init__(self, pyramid: Pyramid) -> None:
        self._pyramid = pyramid

    def __call__(self, spec: TileSpec, outer: LevelHeights | None) -> bytes:
        """Return the whole payload of a tile (`TileSource`)."""
        coded = self.code(spec)
        return b"" if coded is None else coded.payload()

    def code(self, spec: TileSpec) -> CodedTile | None:
        """Return a coded tile; None if no sample is valid."""
        levels = range(max(spec.first, 0), spec.last + 1)
        valid = [
            self._validity(level, region)
            for level, region in zip(levels, spec.regions, strict=True)
        ]
        outer = None if spec.outer is None else self._validity(spec.key.level, spec.outer)
        return encode_tile(spec, self._pyramid.steps(spec.last, spec.region), valid, outer)

    def _validity(self, level: int, region: Region) -> Validity:
        return Validity.of(self._pyramid.mask(level, region), self._pyramid.own(level, region))

    def target(self, spec: TileSpec) -> tuple[Heights, Mask]:
        """Return the heights, in quanta, and validity of a tile of full-grid samples."""
        return (
            self._pyramid.heights(spec.last, spec.region),
            self._pyramid.mask(spec.last, spec.region),
        )


class EmbeddedSource:
    """Streams of all tiles, coded once and cut at one quality.

    Call `code` first, then set `position` by `cut_to_size` or `cut_to_error`.
    """

    def __init__(self, coder: TileCoder, layout: TileLayout, directory: Path) -> None:
        self._coder = coder
        self._grid = layout.grid
        self._layout = layout
        self._file = SectionFile(directory)
        self._spool = SegmentSpool(self._file)
        self._streams: dict[Block, tuple[int, tuple[int, ...], int, int]] = {}
        self.position = 0.0

    def close(self) -> None:
        self._file.close()

    def code(self, executor: Executor, on_samples: Callable[[int], None]) -> None:
        lock = threading.Lock()

        def code(key: Block) -> None:
            spec = self._layout.spec(key)
            coded = self._coder.code(spec)
            if coded is not None:
                payload = coded.payload()
                total = len(coded.stream)
                n_head = len(payload) - packed_length(total)
                with lock:
                    self._spool.add(key, payload)
                    self._streams[key] = n_head, coded.head.ends, total, spec.n_below
            on_samples(0 if spec.n_below else spec.region.n_rows * spec.region.n_cols)

        for _ in executor.map(code, self._layout.keys()):
            pass

    def __call__(self, spec: TileSpec, outer: LevelHeights | None) -> bytes:
        """Return the payload cut at `position` (`TileSource`)."""
        if spec.key not in self._streams:
            return b""
        return self._whole(spec).payload(self._cut(spec.key, self.position))

    def _whole(self, spec: TileSpec) -> CodedTile:
        return unpack_tile(spec, next(self._spool.chunks([spec.key])))

    def _cut(self, key: Block, position: float) -> int:
        _, ends, total, n_below = self._streams[key]
        return plane_cut(ends, total, position - n_below)

    def n_bytes(self, position: float) -> int:
        return sum(
            n_head + packed_length(self._cut(key, position))
            for key, (n_head, *_) in self._streams.items()
        )

    @property
    def _coarsest(self) -> float:
        """Return the position at which all streams are empty."""
        return max(
            (len(ends) + n_below for _, ends, _, n_below in self._streams.values()), default=0.0
        )

    def cut_to_size(self, max_bytes: int) -> None:
        """Set `position` to the finest one at which all payloads take at most `max_bytes`."""
        coarsest = float(self._coarsest)
        if self.n_bytes(coarsest) > max_bytes:
            raise InvalidArgumentError(
                f"found a `rate` that leaves {max(max_bytes, 0):,} bytes for heights, expected at"
                f" least {self.n_bytes(coarsest):,}: give a larger one"
            )
        self.position = finest_position(self.n_bytes, coarsest, max_bytes)

    def cut_to_error(
        self, mean_square: float, parameters: CodecParameters, executor: Executor
    ) -> None:
        """Set `position` to a coarse one whose mean square error is at most `mean_square`."""
        low, high = 0.0, float(self._coarsest)
        for _ in range(_ERROR_STEPS):
            middle = (low + high) / 2
            if self.mean_square_error(middle, parameters, executor) <= mean_square:
                low = middle
            else:
                high = middle
        self.position = low

    def mean_square_error(
        self, position: float, parameters: CodecParameters, executor: Executor
    ) -> float:
        """Return the mean square error of valid samples, cut at `position`, in quanta."""
        self.position = position

        def compare(start: _Start) -> tuple[int, int, list[_Start]]:
            return self._decode_and_compare(*start, parameters)

        root = Block(-1, 0, 0)
        starts: list[_Start] = [(root, None)] if root in self._streams else []
        total = n_valid = 0
        while starts:
            following: list[_Start] = []
            for squares, count, below in executor.map(compare, starts):
                total, n_valid = total + squares, n_valid + count
                following += below
            starts = following
        return total / max(n_valid, 1)

    def _decode_and_compare(
        self, key: Block, outer: LevelHeights | None, parameters: CodecParameters
    ) -> tuple[int, int, list[_Start]]:
        """Return the sum of squares, the number of valid samples, and the tiles below."""
        spec = self._layout.spec(key)
        finest = decode_tile(spec, outer, self(spec, outer))[-1]
        if spec.n_below:
            below = [
                (head, finest.part(self._grid.block_region(head)))
                for head in self._layout.below(key)
            ]
            return 0, 0, [(head, part) for head, part in below if head in self._streams]
        target, mask = self._coder.target(spec)
        errors = final_heights(finest, parameters).heights[mask].astype(np.int64) - target[mask]
        return int(np.dot(errors, errors)), int(np.count_nonzero(mask)), []
