"""Decode units on demand, each from its ancestors alone, through a bounded cache."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.cache import Cache
from terrainwave.codec.refiner import (
    ALL_ROWS,
    Decoded,
    GroupSpec,
    Heights,
    Mask,
    Raw,
    Refiner,
    Rows,
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
# Of which units some rows are enough; of others, all are wanted.
RowsOf = Mapping[Block, Rows]
WHOLE: RowsOf = {}


class TreeDecoder:
    """Decoded units of a file, by key, kept as far as a cache has room.

    Each unit has a payload, and is decoded with the block above it. `are_apart` says that one unit
    can be decoded, and forgotten, without work for others.
    """

    are_apart = True

    def __init__(
        self,
        grid: Grid,
        parameters: CodecParameters,
        refiner: Refiner | None,
        payloads: Payloads,
        cache_bytes: int,
    ) -> None:
        self.grid = grid
        self._parameters = parameters
        self._refiner: Any = refiner
        # Whether rows of a unit can be decoded without the others.
        self._has_parts = refiner is not None and as_direct(refiner) is not None
        self._fetched = FetchedPayloads(payloads)
        self._cache: Cache[Block, Decoded] = Cache(cache_bytes, size_of=_n_bytes)
        self._specs: Cache[Block, GroupSpec] = Cache(_MAX_SPECS)

    def prefetch(self, keys: Sequence[Block], rows: RowsOf = WHOLE) -> list[Block]:
        """Fetch the payloads that decoding `keys`, or some rows of them, will need, in one call.

        Returns the units that are not at hand, of the keys and all above them, each after those
        above it. A damaged payload is left for `unit` to report, so that it costs no other unit.
        """
        missing: dict[Block, None] = {}
        for key in keys:
            chain = []
            # Neither here nor being decoded by another thread.
            while not (
                key in missing
                or self._is_here(key, rows.get(key, ALL_ROWS))
                or self._cache.is_coming(key)
            ):
                chain.append(key)
                if key.is_root_key:
                    break
                key = unit_key(key)
            missing.update(dict.fromkeys(reversed(chain)))
        self._fetched.fetch(list(missing))
        return list(missing)

    def _decode(self, key: Block, rows: RowsOf = WHOLE, raw: Raw | None = None) -> Decoded:
        """Decode a unit, or some rows of it. See `codec.group.decode_unit`."""
        from terrainwave.codec.group import decode_unit  # numba, which not every reader needs

        parent = None if key.is_root_key else self.block(key, rows)
        spec, payload = self.spec(key), self._fetched.take(key)
        try:
            return decode_unit(self._refiner, spec, parent, payload, rows.get(key, ALL_ROWS), raw)
        except CorruptStreamError as exc:
            raise type(exc)(f"{unit_name(key)} is damaged: {exc}") from exc

    def _rows_above(self, key: Block, rows: Rows) -> Rows:
        """Return which rows of its parent heights a unit needs; all if its payload is not here."""
        payload = self._fetched.peek(key)
        if payload is None or rows == ALL_ROWS:
            return ALL_ROWS
        from terrainwave.codec.group import rows_above

        try:
            return rows_above(self._refiner, self.spec(key), payload, rows)
        except CorruptStreamError:  # which `_decode` reports
            return ALL_ROWS

    def prefetch_for(self, keys: Sequence[Block], region: Region) -> tuple[list[Block], RowsOf]:
        """Do as `prefetch` for a region of their level; also return which rows of units are enough.

        No unit is cut if the region takes nearly all of it: such a reader reads the next region,
        too. A unit with most rows wanted is decoded to its end, which is checked there.
        """
        wanted: dict[Block, Rows] = {}
        if self._has_parts:
            wanted = {key: self._rows_in(key, region) for key in keys}
            if all(rows == ALL_ROWS for rows in wanted.values()):
                wanted = {}
        needed = self.prefetch(keys, wanted)
        # Those of a level before those above it; also of units that are at hand, because what
        # other threads read may take their place in the cache.
        for level in range(max((key.level for key in wanted), default=-2), -2, -1):
            for key in [key for key in wanted if key.level == level]:
                self._want_above(key, wanted)
        return needed, wanted

    def _want_above(self, key: Block, wanted: dict[Block, Rows]) -> None:
        """Add the rows of its parent that a unit needs to those that are wanted."""
        rows = wanted[key] = self._whole_if_most(key, wanted[key])
        outer = self.spec(key).parent_region
        if outer is None:
            return
        above = self._rows_above(key, rows)
        parent = unit_key(key)
        first = outer.row - self.spec(parent).region.row
        other = wanted.get(parent, Rows(ALL_ROWS.end, 0))
        wanted[parent] = Rows(
            min(first + above.first, other.first),
            max(first + min(above.end, outer.n_rows), other.end),
        )

    def _rows_in(self, key: Block, region: Region) -> Rows:
        """Return which rows of a unit lie in a region of its level."""
        here = self.spec(key).region
        first = max(region.row - here.row, 0)
        return self._whole_if_most(key, Rows(first, region.row + region.n_rows - here.row))

    def _whole_if_most(self, key: Block, rows: Rows) -> Rows:
        n_rows = self.spec(key).region.n_rows
        is_most = 4 * (min(rows.end, n_rows) - rows.first) > 3 * n_rows
        # No unit is decoded a third time.
        is_again = self._cache.get(key) is not None and not self._is_here(key, rows)
        return ALL_ROWS if key.is_root_key or is_most or is_again else rows

    def _is_here(self, key: Block, rows: Rows) -> bool:
        found = self._cache.get(key)
        return found is not None and self._has_rows(key, found, rows)

    def _has_rows(self, key: Block, unit: Decoded, rows: Rows) -> bool:
        end = min(rows.end, self.spec(key).region.n_rows)
        return unit.rows.first <= rows.first and end <= unit.rows.end

    def unit(self, key: Block, rows: RowsOf = WHOLE) -> Decoded:
        """Return the decoded unit `key`, or some rows of it; what is above is decoded as needed.

        Raises `CorruptStreamError` if its payload or one above it is damaged; the message names the
        unit.
        """
        own = rows.get(key, ALL_ROWS)
        found = self._cache.get(key)
        if found is not None:
            if self._has_rows(key, found, own):
                return found
            # No unit is decoded a third time. Whole, it needs all that is above.
            own, rows = ALL_ROWS, WHOLE
        # Ancestors never wait for descendants.
        return self._cache.get_or_make(
            key,
            lambda: self._decode(key, rows),
            lambda unit: self._has_rows(key, unit, own),
        )

    def put(self, key: Block, unit: Decoded) -> None:
        """Keep what a unit decodes to, known before, as if it had been decoded."""
        self._cache.put(key, unit)

    def spec(self, key: Block) -> GroupSpec:
        return self._specs.get_or_make(key, lambda: unit_spec(self.grid, self._parameters, key))

    def part(
        self, key: Block, region: Region, rows: RowsOf = WHOLE
    ) -> tuple[tuple[slice, slice], Decoded]:
        """Return the part of a unit inside a region of its level, and where it lies in the region.

        The arrays are views.
        """
        spec = self.spec(key)
        common = spec.core.intersect(region)
        here = common.slices_in(spec.region)
        return common.slices_in(region), self.unit(key, rows).part(here)

    def shared(self, key: Block, other: Block) -> Decoded:
        """Return a copy of what a unit holds of the samples that another one holds as well."""
        here = self.spec(key).region
        common = here.intersect(self.spec(other).region)
        found = self.unit(key).part(common.slices_in(here))
        rest = None if found.remainders is None else found.remainders.copy()
        return Decoded(found.heights.copy(), found.validity.copy(), None, rest)

    def part_once(
        self, key: Block, region: Region, rows: RowsOf = WHOLE, out: Raw | None = None
    ) -> tuple[tuple[slice, slice], Decoded]:
        """Return `part`, for a reader of a whole region.

        A unit of the full grid that is not at hand and lies in the region as a whole is not kept.
        Its last row and column may be missing: a reader of the next region needs the next unit's.
        Its heights may go to the region's raw heights `out` (`Decoded.is_raw`).
        """
        spec = self.spec(key)
        here = spec.core.intersect(region)
        n_rows, n_cols = spec.core.shape
        is_all = here.n_rows >= n_rows - 1 and here.n_cols >= n_cols - 1 and spec.is_finest
        if not is_all or not self.are_apart or self._cache.get(key) is not None:
            return self.part(key, region, rows)
        there, raw = here.slices_in(region), None
        if out is not None and (here.row, here.col) == (spec.region.row, spec.region.col):
            raw = Raw(out.heights[there], out.base)
        unit, part = self._decode(key, rows, raw), here.slices_in(spec.region)
        if unit.is_raw:
            return there, unit._replace(validity=unit.validity.part(part))
        return there, unit.part(part)

    def window(self, level: int, region: Region) -> tuple[Heights, Mask]:
        """Return decoded heights and validity of any region inside a level."""
        heights = np.zeros(region.shape, dtype=np.int32)
        mask = np.zeros(region.shape, dtype=np.bool_)
        keys = units_of(self.grid, level, region)
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
        numbers = unit_rows * n_cols + unit_cols
        order = np.argsort(numbers, kind="stable")
        members = np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1)
        keys = [
            Block(level - 1, int(unit_rows[here[0]]), int(unit_cols[here[0]])) for here in members
        ]
        for number, (key, here) in enumerate(zip(keys, members, strict=True)):
            if number % _AT_A_TIME == 0:
                self.prefetch(keys[number : number + _AT_A_TIME])
            spec, unit = self.spec(key), self.unit(key)
            at = rows[here] - spec.region.row, cols[here] - spec.region.col
            heights[0, here], mask[0, here] = unit.heights[at], unit.mask[at]
            own[0, here] = unit.own_mask[at]
            if unit.remainders is not None:
                rest = np.zeros(shape, unit.remainders.dtype) if rest is None else rest
                rest[0, here] = unit.remainders[at]
        return Decoded(heights, Validity.of(mask, own), None, rest)

    def block(self, block: Block, rows: RowsOf = WHOLE) -> Decoded:
        """Return the decoded heights of a block, with its apron if the file has one."""
        key = unit_key(block)
        spec = self.spec(key)
        return block_of_unit(self.grid, spec, self.unit(key, rows), block)


def _n_bytes(unit: Decoded) -> int:
    """Return the memory that a unit keeps, rows that it has no heights of included."""
    owner = unit.heights.base
    n_bytes = owner.nbytes if isinstance(owner, np.ndarray) else 0
    return unit.nbytes + max(n_bytes - unit.heights.nbytes, 0)


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
    return Block(-1, block.row, block.col) if block.level == 0 else block.parent


def unit_name(key: Block) -> str:
    if key.is_root_key:
        return f"root block (row {key.row}, column {key.col})"
    return f"the group below block (level {key.level}, row {key.row}, column {key.col})"
