"""Decode units on demand, each from its ancestors alone, through a bounded cache."""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.cache import Cache
from terrainwave.codec.refiner import (
    ALL_ROWS,
    Decoded,
    GroupSpec,
    Heights,
    Mask,
    Refiner,
    Validity,
    as_direct,
)
from terrainwave.codec.unit_specs import block_of_unit, unit_spec
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid, Region, morton
from terrainwave.grid.remainders import Remainders
from terrainwave.read.fetched import FetchedPayloads, Payloads

_MAX_SPECS = 1024
# Units of scattered samples whose payloads are fetched in one call.
_AT_A_TIME = 64
# Of which units so many first rows are enough; of others, all are wanted.
Beginnings = Mapping[Block, int]
NONE_BEGUN: Beginnings = {}


class UnitSource(Protocol):
    """Where a `TreeDecoder` has units from.

    `are_apart` says that one unit can be decoded, and forgotten, without work for others;
    `ends_early` that the first rows of one can be decoded alone.
    """

    are_apart: bool
    ends_early: bool

    def prefetch(
        self, units: "TreeDecoder", keys: Sequence[Block], begun: Beginnings = NONE_BEGUN
    ) -> list[Block]:
        """Do as `TreeDecoder.prefetch`."""
        ...

    def decode(self, units: "TreeDecoder", key: Block, begun: Beginnings = NONE_BEGUN) -> Decoded:
        """Decode a unit, or so many rows of it; `units` has those above it."""
        ...


class Groups:
    """Units that have a payload each, to be decoded with the block above them.

    Parameters
    ----------
    decode : callable
        Decodes a payload: of the unit of a spec, below a block, None for a root block. Its last
        argument is how many rows are enough, if the source `ends_early`.
    """

    are_apart = True

    def __init__(
        self,
        payloads: Payloads,
        decode: Callable[[GroupSpec, Decoded | None, bytes, int], Decoded],
        *,
        ends_early: bool = False,
    ) -> None:
        self._fetched = FetchedPayloads(payloads)
        self._decode = decode
        self.ends_early = ends_early

    def prefetch(
        self, units: "TreeDecoder", keys: Sequence[Block], begun: Beginnings = NONE_BEGUN
    ) -> list[Block]:
        """Fetch the payloads of units that are not at hand (`TreeDecoder.prefetch`)."""
        missing: dict[Block, None] = {}
        for key in keys:
            chain = []
            while key not in missing and units.is_wanting(key, begun.get(key, ALL_ROWS)):
                chain.append(key)
                if key.is_root_key:
                    break
                key = unit_key(key)
            missing.update(dict.fromkeys(reversed(chain)))
        self._fetched.fetch(list(missing))
        return list(missing)

    def decode(self, units: "TreeDecoder", key: Block, begun: Beginnings = NONE_BEGUN) -> Decoded:
        """Decode a unit, or so many rows of it."""
        parent = None if key.is_root_key else units.block(key, begun)
        spec = units.spec(key)
        payload = self._fetched.take(key)
        try:
            return self._decode(spec, parent, payload, begun.get(key, ALL_ROWS))
        except CorruptStreamError as exc:
            raise type(exc)(f"{unit_name(key)} is damaged: {exc}") from exc


def groups_by(refiner: Refiner, payloads: Payloads) -> Groups:
    """Return the units that a refiner decodes."""

    def decode(spec: GroupSpec, parent: Decoded | None, payload: bytes, n_rows: int) -> Decoded:
        from terrainwave.codec.group import decode_unit  # numba, which not every reader needs

        return decode_unit(refiner, spec, parent, payload, n_rows)

    return Groups(payloads, decode, ends_early=as_direct(refiner) is not None)


class TreeDecoder:
    """Decoded units of a file, by key, kept as far as a cache has room."""

    def __init__(
        self, grid: Grid, parameters: CodecParameters, source: UnitSource, cache_bytes: int
    ) -> None:
        self.grid = grid
        self.source = source
        self._parameters = parameters
        self._cache: Cache[Block, Decoded] = Cache(cache_bytes, size_of=_n_bytes)
        self._specs: Cache[Block, GroupSpec] = Cache(_MAX_SPECS)

    def prefetch(self, keys: Sequence[Block], begun: Beginnings = NONE_BEGUN) -> list[Block]:
        """Fetch the payloads that decoding `keys` will need, in one call.

        Returns the units that are not at hand, of the keys and all above them, each after those
        above it. A damaged payload is left for `unit` to report, so that it costs no other unit.
        """
        return self.source.prefetch(self, keys, begun)

    def beginnings(self, level: int, region: Region) -> Beginnings:
        """Return of which units the first rows are enough to read a region of a level.

        None are where the region takes whole units, or nearly: such a reader goes on below it. And
        a unit of which most rows are wanted is decoded to its end, which is checked there.
        """
        keys = units_of(self.grid, level, region)
        last = region.row + region.n_rows - 1
        found: dict[Block, int] = {}
        if not self.source.ends_early or not keys:
            return found
        if self._rows_up_to(keys[-1], last) == ALL_ROWS:
            return found
        wanted = {key: self._rows_up_to(key, last) for key in keys}
        while wanted:
            found.update(wanted)
            above: dict[Block, int] = {}
            for key in wanted:
                outer = self.spec(key).parent_region
                if outer is not None:
                    parent = unit_key(key)
                    n_rows = self._rows_up_to(parent, outer.row + outer.n_rows - 1)
                    above[parent] = max(above.get(parent, 0), n_rows)
            wanted = above
        return found

    def _rows_up_to(self, key: Block, last: int) -> int:
        """Return how many rows of a unit it takes to have row `last` of its level."""
        region = self.spec(key).region
        n_rows = last - region.row + 1
        return ALL_ROWS if key.is_root_key or 4 * n_rows > 3 * region.n_rows else n_rows

    def _has_rows(self, key: Block, unit: Decoded, n_rows: int) -> bool:
        return unit.heights.shape[0] >= min(n_rows, self.spec(key).region.n_rows)

    def is_wanting(self, key: Block, n_rows: int = ALL_ROWS) -> bool:
        """Say whether rows of a unit are neither here nor being decoded by another thread."""
        found = self._cache.get(key)
        is_here = found is not None and self._has_rows(key, found, n_rows)
        return not is_here and not self._cache.is_coming(key)

    def unit(self, key: Block, begun: Beginnings = NONE_BEGUN) -> Decoded:
        """Return the decoded unit `key`; its ancestors are decoded as needed.

        Raises
        ------
        CorruptStreamError
            If its payload or one above it is damaged; the message names the unit.
        """
        n_rows = begun.get(key, ALL_ROWS)
        found = self._cache.get(key)
        if found is not None:
            if self._has_rows(key, found, n_rows):
                return found
            # No unit is decoded a third time.
            n_rows, begun = ALL_ROWS, {**begun, key: ALL_ROWS}
        # Ancestors never wait for descendants.
        return self._cache.get_or_make(
            key,
            lambda: self.source.decode(self, key, begun),
            lambda unit: self._has_rows(key, unit, n_rows),
        )

    def put(self, key: Block, unit: Decoded) -> None:
        """Keep what a unit decodes to, known before, as if it had been decoded."""
        self._cache.put(key, unit)

    def spec(self, key: Block) -> GroupSpec:
        """Return the spec of a unit."""
        return self._specs.get_or_make(key, lambda: unit_spec(self.grid, self._parameters, key))

    def keys(self, level: int, region: Region) -> list[Block]:
        """Return the keys of the units that hold a region of a level, in Morton order."""
        return units_of(self.grid, level, region)

    def part(
        self, key: Block, region: Region, begun: Beginnings = NONE_BEGUN
    ) -> tuple[tuple[slice, slice], Decoded]:
        """Return the part of a unit inside a region of its level, and where it lies in the region.

        The arrays are views.
        """
        spec = self.spec(key)
        return _part(self.unit(key, begun), spec, spec.core.intersect(region), region)

    def shared(self, key: Block, other: Block) -> Decoded:
        """Return a copy of what a unit holds of the samples that another one holds as well."""
        here = self.spec(key).region
        common = here.intersect(self.spec(other).region)
        heights, validity, _, rest = self.unit(key).part(common.slices_in(here))
        rest = None if rest is None else rest.copy()
        return Decoded(heights.copy(), validity.copy(), None, rest)

    def part_once(
        self, key: Block, region: Region, begun: Beginnings = NONE_BEGUN
    ) -> tuple[tuple[slice, slice], Decoded]:
        """Return `part`, for a reader of a whole region.

        A unit of the full grid that is not at hand and lies in the region as a whole is not kept.
        Its last row and column may be missing: whoever reads on beside it needs the next unit's.
        """
        spec = self.spec(key)
        here = spec.core.intersect(region)
        n_rows, n_cols = spec.core.shape
        is_all = here.n_rows >= n_rows - 1 and here.n_cols >= n_cols - 1 and spec.is_finest
        if not is_all or not self.source.are_apart or self._cache.get(key) is not None:
            return self.part(key, region, begun)
        return _part(self.source.decode(self, key, begun), spec, here, region)

    def window(self, level: int, region: Region) -> tuple[Heights, Mask]:
        """Return decoded heights and validity of any region inside a level."""
        heights = np.zeros(region.shape, dtype=np.int32)
        mask = np.zeros(region.shape, dtype=np.bool_)
        keys = self.keys(level, region)
        self.prefetch(keys)
        for key in keys:
            there, unit = self.part(key, region)
            heights[there] = unit.heights
            mask[there] = True if unit.validity.mask is None else unit.validity.mask
        return heights, mask

    def samples(self, level: int, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> Decoded:
        """Return the decoded heights at single samples of a level, which must lie inside it.

        Arrays of one row.
        """
        side = self.grid.block if level == 0 else 2 * self.grid.block
        n_rows, n_cols = self.grid.level_blocks(max(level - 1, 0))
        unit_rows = np.minimum(rows // side, n_rows - 1)
        unit_cols = np.minimum(cols // side, n_cols - 1)
        shape = 1, rows.size
        heights, mask = np.zeros(shape, dtype=np.int32), np.zeros(shape, dtype=np.bool_)
        own = np.zeros(shape, dtype=np.bool_)
        rest: Remainders | None = None
        places = sorted(set(zip(unit_rows.tolist(), unit_cols.tolist(), strict=True)))
        for number, (row, col) in enumerate(places):
            if number % _AT_A_TIME == 0:
                near = places[number : number + _AT_A_TIME]
                self.prefetch([Block(level - 1, *place) for place in near])
            key = Block(level - 1, row, col)
            spec, unit = self.spec(key), self.unit(key)
            here = (unit_rows == row) & (unit_cols == col)
            at = rows[here] - spec.region.row, cols[here] - spec.region.col
            heights[0, here], mask[0, here] = unit.heights[at], unit.mask[at]
            own[0, here] = unit.own_mask[at]
            if unit.remainders is not None:
                rest = np.zeros(shape, unit.remainders.dtype) if rest is None else rest
                rest[0, here] = unit.remainders[at]
        return Decoded(heights, Validity.of(mask, own), None, rest)

    def block(self, block: Block, begun: Beginnings = NONE_BEGUN) -> Decoded:
        """Return the decoded heights of a block, with its apron if the file has one."""
        key = unit_key(block)
        spec = self.spec(key)
        return block_of_unit(self.grid, spec, self.unit(key, begun), block)


def _n_bytes(unit: Decoded) -> int:
    """Return the memory that a unit keeps, rows that it has no heights of included."""
    owner = unit.heights.base
    n_bytes = owner.nbytes if isinstance(owner, np.ndarray) else 0
    return unit.nbytes + max(n_bytes - unit.heights.nbytes, 0)


def _part(
    unit: Decoded, spec: GroupSpec, common: Region, region: Region
) -> tuple[tuple[slice, slice], Decoded]:
    """Return where the part `common` of a unit lies in a region, and views of it."""
    return common.slices_in(region), unit.part(common.slices_in(spec.region))


def units_of(grid: Grid, level: int, region: Region) -> list[Block]:
    """Return the keys of the units that hold a region of a level, in Morton order."""
    side = grid.block if level == 0 else 2 * grid.block
    n_rows, n_cols = grid.level_blocks(max(level - 1, 0))
    # The last sample of the last unit lies on a border without a unit beyond it.
    rows = range(
        min(region.row // side, n_rows - 1),
        min((region.row + region.n_rows - 1) // side, n_rows - 1) + 1,
    )
    cols = range(
        min(region.col // side, n_cols - 1),
        min((region.col + region.n_cols - 1) // side, n_cols - 1) + 1,
    )
    keys = [Block(level - 1, row, col) for row in rows for col in cols]
    return sorted(keys, key=lambda key: morton(key.row, key.col))


def unit_key(block: Block) -> Block:
    """Return the key of the unit that holds `block`."""
    return Block(-1, block.row, block.col) if block.level == 0 else block.parent


def unit_name(key: Block) -> str:
    """Name the unit for messages."""
    if key.is_root_key:
        return f"root block (row {key.row}, column {key.col})"
    return f"the group below block (level {key.level}, row {key.row}, column {key.col})"
