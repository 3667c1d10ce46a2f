"""Which samples of the full grid are valid, of payloads whose heights nobody decodes.

For files that do not tell which samples of coarse levels are fills (FORMAT.md §5.4): the finest
payloads are read for the masks that stand before their heights.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.cdf53.refiner import LevelHeights, decode_masks, unpack_head
from terrainwave.codec.cdf53.tile_layout import TileSpec
from terrainwave.codec.group import read_head
from terrainwave.codec.refiner import Decoded, GroupSpec, Heights, Mask, Rows, all_void
from terrainwave.container.header import Header
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Region
from terrainwave.names import METHODS
from terrainwave.read.decoder import Groups, TreeDecoder, UnitSource
from terrainwave.read.fetched import Payloads
from terrainwave.read.lost import LostUnits
from terrainwave.read.tile_decoder import Tile, Tiles

# Payloads fetched ahead of decoding, in one coalesced request.
_BATCH = 64
_CACHE_BYTES = 32 << 20


def _unit_mask(
    spec: GroupSpec,
    parent: Decoded | None,
    payload: bytes,
    rows: Rows,  # noqa: ARG001
) -> Decoded:
    """Decode the mask of a unit; heights are all 0."""
    heights = _no_heights(spec.region)
    if not payload:
        return Decoded(heights, all_void(spec.region.shape))
    return Decoded(heights, read_head(spec, parent, payload).validity)


def _tile_masks(spec: TileSpec, outer: LevelHeights | None, payload: bytes) -> Tile:
    """Do the same for a tile."""
    if payload:
        head, _ = unpack_head(spec, payload)
        levels = decode_masks(spec, head, None if outer is None else outer.validity)
    else:
        levels = [all_void(region.shape) for region in spec.regions]
    return [
        LevelHeights(region, _no_heights(region), validity)
        for region, validity in zip(spec.regions, levels, strict=True)
    ]


class FinestMasks:
    """The validity of the full grid where samples of a level lie.

    Notes
    -----
    For levels above the full grid alone.
    """

    def __init__(self, header: Header, payloads: Payloads, lost: LostUnits) -> None:
        self._lost = lost
        grid, parameters = header.grid, header.codec_parameters
        self._grid = grid
        source: UnitSource = Groups(payloads, _unit_mask)
        if METHODS[header.method].is_tiled:
            source = Tiles(grid, parameters, payloads, _CACHE_BYTES // 2, _tile_masks)
        self._decoder = TreeDecoder(grid, parameters, source, _CACHE_BYTES // 2)

    def own(self, level: int, region: Region, mask: Mask, on_error: str = "raise") -> Mask:
        """Return which samples of a region of a level are valid by themselves.

        Parameters
        ----------
        mask : ndarray of bool, shape ``region.shape``
            Which are valid; where none is, nothing is read.
        on_error : str
            With ``"mask"`` samples in damaged units are void.
        """
        grid, stride = self._grid, self._grid.stride(level)
        n_rows, n_cols = region.shape
        full = Region(
            region.row * stride,
            region.col * stride,
            (n_rows - 1) * stride + 1,
            (n_cols - 1) * stride + 1,
        )
        own = np.zeros(region.shape, dtype=np.bool_)
        keys = []
        for key in self._decoder.keys(grid.k_max, full):
            here, at = _samples_in(grid.group_region(key), region, stride)
            if mask[at].any():
                keys.append((key, here, at))
        for first in range(0, len(keys), _BATCH):
            batch = keys[first : first + _BATCH]
            self._decoder.prefetch([key for key, _, _ in batch])
            for key, here, at in batch:
                try:
                    _, unit = self._decoder.part(key, here)
                except CorruptStreamError as error:
                    if on_error == "raise":
                        raise
                    self._lost.note(key, error)
                    continue
                own[at] = unit.mask[::stride, ::stride]
        own &= mask
        return own

    def samples(self, level: int, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> Mask:
        """Return which single samples of a level are valid by themselves."""
        stride = self._grid.stride(level)
        return self._decoder.samples(self._grid.k_max, rows * stride, cols * stride).mask[0]


def _samples_in(core: Region, region: Region, stride: int) -> tuple[Region, tuple[slice, slice]]:
    """Return the full grid's samples of a unit from the first to the last one of a level's region.

    And where these lie in that region.
    """
    on_level = Region(
        -(-core.row // stride),
        -(-core.col // stride),
        (core.row + core.n_rows - 1) // stride - -(-core.row // stride) + 1,
        (core.col + core.n_cols - 1) // stride - -(-core.col // stride) + 1,
    )
    part = on_level.intersect(region)
    here = Region(
        part.row * stride,
        part.col * stride,
        max((part.n_rows - 1) * stride + 1, 0),
        max((part.n_cols - 1) * stride + 1, 0),
    )
    return here, part.slices_in(region)


def _no_heights(region: Region) -> Heights:
    """Return heights that take no memory."""
    return np.broadcast_to(np.int32(0), region.shape)
