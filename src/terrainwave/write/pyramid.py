"""Target heights and masks of every level, made in one pass over the source (pass A).

Levels are counted here by `shift`: 0 is the full grid, shift j has every 2^j-th sample. All values
are int32 quanta and pure functions of the raster: neither window sizes nor threads change them.

* Low-pass pyramid: Yusov & Turlapov 2010, §2.1: normalised CDF 9/7 analysis, symmetric at the
  raster's edge, rounded to quanta on every level.
* Low-pass pyramid of the reversible 5/3 wavelet, in tiles: format-cdf53.md, C.3. It counts in
  steps, and its heights may leave the raster's range.
* Nested pyramid: the full grid's own samples.
* Voids are filled by push-pull: coarse levels average what is valid, fine ones interpolate it.

Where the source knows, without reading, that all samples of a window are of one value or void, no
window is made of others: spools keep the value of whole tiles. Far from valid samples, fills that
no unit reads are not made (nested pyramids); they are 0.

The levels of a part of the raster can be made from that part alone, with a frame around it, and the
fills of one coarse level (`SubtreeRegion`); those above a level from that level alone (`Base`).
Values are the same: that is how machines share a raster.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial, reduce
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from terrainwave.codec.refiner import Heights, Mask
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.container.targets.kept import Kept
from terrainwave.grid.convert import UNKNOWN, pull, push
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.grid.remainders import Remainders, remainders
from terrainwave.raster_io.even import Even, EvenOf, even_parts
from terrainwave.raster_io.temporary import Spool, is_small

TILE = 512  # samples per side of the windows in which levels are made
_LOWPASS_HALO, _LOWPASS53_HALO = 4, 2
# Samples around a window of a level that say whether all levels below it are even there. The masks
# and averages of a level reach less than one of its samples far.
_EVEN_MARGIN = 2
# So far from valid samples nothing reads fills, in sides of blocks or parts of windows: a unit has
# two blocks a side, and a part near valid samples is made of one of twice its side on the level
# below. And so many samples more: those that masks and averages reach, and aprons. Windows that
# tables are fitted to must reach no farther.
_FILL_MARGIN, _FILL_REACH = 2, 16
# Windows that wait for a thread at a time: what waits takes more memory than a window's place.
_BATCH = 4096
# Stands for a void among heights, which are far from it.
_UNKNOWN = np.int32(UNKNOWN)
# By the shift of a level and a region: what all samples there are, if that is known; new arrays.
_EvenAt = Callable[[int, Region], Even | None]
_MakeWindow = Callable[[int, Region], Sequence[NDArray[Any]]]


class SourceWindows(Protocol):
    """Raster as the pyramid reads it."""

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[np.generic], NDArray[np.bool_]]: ...


class IndexedWindows(SourceWindows, Protocol):
    """A raster that may know windows without reading them (`raster_io.even`)."""

    def even(self, region: Region) -> Even | None: ...

    def holds(self, region: Region, even: Even) -> bool: ...


class SubtreeRegion(NamedTuple):
    """A region of the full grid whose levels down to `shift` are made, each with an apron of 1.

    The frames grow from level to level by what a window of the next coarser one reaches: 5 samples
    in a low-pass window, 2 in a mask's, 1 in a push; one more where a frame's first or last row has
    not the parity of the next level's.
    """

    region: Region
    shift: int

    def made(self, name: str, shift: int, *, is_framed: bool = True) -> Region:
        """Return where an array of a level is made; may reach past the raster."""
        scale = 1 << self.shift - shift
        reach = {"fills": 7 * scale, "averages": 9 * scale - 2, "known": 9 * scale - 2}
        margin = reach.get(name, 7 * scale - 6 if is_framed else 2 * scale - 1)
        row, col, n_rows, n_cols = self.region
        first_row, first_col = (row >> shift) - margin, (col >> shift) - margin
        last_row = -(-(row + n_rows - 1) >> shift) + margin
        last_col = -(-(col + n_cols - 1) >> shift) + margin
        return Region(first_row, first_col, last_row - first_row + 1, last_col - first_col + 1)


class Base(NamedTuple):
    """Arrays of one level, by their names in `Level`, from which the next is made."""

    shift: int
    arrays: Mapping[str, Spool]


# Arrays of a level: targets; which samples are valid, which of them by themselves; averages of
# valid samples, and where there are any; heights given to voids.
DTYPES: dict[str, DTypeLike] = {
    "heights": np.int32, "mask": np.bool_, "own": np.bool_, "averages": np.int32,
    "known": np.bool_, "fills": np.int32,
}  # fmt: skip


@dataclass
class Level:
    """Arrays of one level by name (`DTYPES`), each while it is needed; of a part, or the whole."""

    shift: int
    shape: tuple[int, int]
    kind: str
    part: SubtreeRegion | None
    is_framed: bool
    arrays: dict[str, Spool] = field(default_factory=dict)

    @property
    def whole(self) -> Region:
        return Region(0, 0, *self.shape)

    def region(self, name: str) -> Region:
        """Return where an array is made, inside the raster."""
        if self.part is None:
            return self.whole
        made = self.part.made(name, self.shift, is_framed=self.is_framed)
        return made.intersect(self.whole)

    def file(self, name: str) -> str:
        """Return the name of an array's file: heights and fills depend on the kind of pyramid."""
        named = {"heights": self.kind, "fills": f"fills-{self.kind}"}
        return f"{named.get(name, name)}-{self.shift}"

    def __getitem__(self, name: str) -> Spool:
        return self.arrays[name]

    def drop(self, *names: str, is_needed: bool = False) -> None:
        """Give up arrays, in the journal too unless a later run needs them."""
        for spool in [self.arrays.pop(name) for name in names if name in self.arrays]:
            (spool.close if is_needed else spool.drop)()


class Pyramid:
    """Targets of all levels of a raster; the finest is read from the source when asked for.

    Levels too large for memory are spooled in `directory`; those in the journal `kept` are left for
    a later run, and taken from an earlier one.

    Parameters
    ----------
    kind : str
        ``"lowpass"``, ``"lowpass53"`` or ``"nested"``.
    has_voids : bool
        Whether any sample of the raster is void; without voids no masks and fills are kept.
    part : SubtreeRegion, optional
        Make the levels of a part of the raster, of any kind but ``"lowpass53"``; where there are
        voids `pull` needs its coarsest fills.
    base : Base, optional
        Make the levels above that of `base`; below it there is nothing to ask for.
    """

    def __init__(
        self,
        source: SourceWindows,
        quantizer: Quantizer,
        grid: Grid,
        *,
        kind: str,
        has_voids: bool,
        directory: Path,
        executor: Executor,
        part: SubtreeRegion | None = None,
        base: Base | None = None,
    ) -> None:
        self._source = source
        self._quantizer = quantizer
        self._grid = grid
        self._kind = kind
        self._has_voids = has_voids
        self._directory = directory
        self._executor = executor
        self._part = part
        self._even_of: EvenOf = getattr(source, "even", _unknown)
        self.kept = Kept()
        self._levels: dict[int, Level] = {}
        self._first = 0 if base is None else base.shift
        self._last = grid.k_max if part is None else part.shift
        if base is not None:
            self._level(base.shift).arrays |= base.arrays

    def _level(self, shift: int) -> Level:
        if shift not in self._levels:
            is_framed = self._has_voids or self._kind == "lowpass"
            shape = self._shape(shift)
            self._levels[shift] = Level(shift, shape, self._kind, self._part, is_framed)
        return self._levels[shift]

    def build(self, report: Callable[[int, int], None]) -> None:
        """Make every level below the full grid; `report` gets (samples done, samples in all)."""
        if self._has_voids:
            self.push()
            self.pull()
        self.make_heights(report)

    def push(self) -> None:
        """Make the masks of all levels, and average valid heights up to one sample."""
        for shift in self._level_shifts():
            self._make(f"mask-{shift}", shift, ("mask", "own"), self._even, self._mask_window)
        shift, dropped = self._first, self._dropped_averages()
        while shift < self._last or (self._part is None and max(self._shape(shift)) > 1):
            shift += 1
            if shift not in dropped:
                names = "averages", "known"
                self._make(f"push-{shift}", shift, names, self._even, self._push_window)

    def pushed(self, shift: int, region: Region) -> tuple[Heights, Mask]:
        """Return averages of valid heights and where they are known, before `pull`."""
        level = self._levels[shift]
        return level["averages"].read(region), level["known"].read(region)

    def pull(self, coarsest: Spool | None = None) -> None:
        """Interpolate from the coarsest level down where nothing is known.

        A part needs the fills of its coarsest level, where it would not know enough by itself.
        """
        averaged = [shift for shift, level in self._levels.items() if "averages" in level.arrays]
        if not averaged:  # a raster of one sample
            return
        top = max(averaged)
        arrays = self._level(top).arrays
        arrays["fills"] = coarsest or arrays.pop("averages")
        self._drop_averages(top)
        for finer in range(top - 1, max(self._first - 1, 0), -1):
            level = self._level(finer)
            # Those of level 1 fill the full grid; of others nobody reads any more after heights.
            if finer == 1 or not self._is_kept_whole(level.file("heights")):
                self._make(level.file("fills"), finer, ("fills",), self._unread, self._pull_window)
            self._drop_averages(finer)

    def _drop_averages(self, shift: int) -> None:
        """Give up what was averaged on a level, unless a later run makes the next ones of it."""
        is_needed = is_small(self._shape(shift + 1), np.bool_)
        self._level(shift).drop("averages", "known", is_needed=is_needed)

    def _dropped_averages(self) -> set[int]:
        """Return the levels whose averages an earlier run has dropped, if no level needs them."""
        dropped, are_filled = set(), True
        for shift in self._level_shifts():
            level = self._level(shift)
            path = self.kept.path(level.file("averages"))
            if path is None or is_small(level.shape, np.bool_) or path.exists():
                continue
            dropped.add(shift)
            made = level.file("heights"), level.file("fills")
            are_filled &= any(map(self._is_kept_whole, made))
        return dropped if are_filled else set()

    def _is_kept_whole(self, name: str) -> bool:
        """Say whether an earlier run has left all heights or fills of a level."""
        path = self.kept.path(name)
        return path is not None and path.exists() and self.kept.is_whole(name)

    def fills(self, shift: int, region: Region) -> Heights:
        """Return the heights given to voids on a level, after `pull`."""
        return self._levels[shift]["fills"].read(region)

    def make_heights(self, report: Callable[[int, int], None]) -> None:
        """Make the heights of every level above the full grid, after the fills of voids."""
        levels = [self._level(shift) for shift in self._level_shifts()]
        sizes = [math.prod(level.region("heights").shape) for level in levels]
        # Only heights of nested levels are known without looking at those of the level below.
        even_of: _EvenAt = _unknown
        make: _MakeWindow = self._lowpass_window
        if self._kind == "nested":
            even_of, make = self._unread, self._nested_window
        for done, level in enumerate(levels, 1):
            self._make(level.file("heights"), level.shift, ("heights",), even_of, make)
            if level.shift > 1:
                level.drop("fills")
            report(sum(sizes[:done]), sum(sizes))

    def _make(
        self,
        name: str,
        shift: int,
        names: Sequence[str],
        even_of: _EvenAt,
        window: _MakeWindow,
    ) -> None:
        """Make arrays of a level by windows, side by side; even parts are filled.

        Windows that an earlier run has finished, by its record `name`, are left out.
        """
        level = self._level(shift)
        region = level.region(names[0])
        place = self._directory, (region.row, region.col)
        spools = [
            Spool(region.shape, DTYPES[own], *place, self.kept.path(level.file(own)))
            for own in names
        ]
        level.arrays |= dict(zip(names, spools, strict=True))

        def uneven() -> Iterator[Region]:
            for part, even in even_parts(region, TILE, partial(even_of, shift)):
                if even is None:
                    yield part
                    continue
                for spool in spools:
                    spool.fill(part, even.is_valid if spool.dtype == np.bool_ else even.value)

        def work(part: Region) -> None:
            for spool, values in zip(spools, window(shift, part), strict=True):
                spool.write(part, values)

        def side_by_side(windows: Iterable[Region]) -> Iterator[None]:
            windows = iter(windows)
            while batch := list(islice(windows, _BATCH)):
                yield from self._executor.map(work, batch)

        made = side_by_side(uneven())
        if all(spool.is_kept for spool in spools):
            is_there = all(spool.was_there for spool in spools)
            made = self.kept.each(name, uneven(), side_by_side, is_there=is_there)
        for _ in made:
            pass

    def close(self) -> None:
        for level in self._levels.values():
            for spool in level.arrays.values():
                spool.close()

    def heights(self, level: int, region: Region) -> Heights:
        """Return the target heights of a region of a level; voids hold their fill."""
        if level < self._grid.k_max:
            return self._levels[self._grid.k_max - level]["heights"].read(region)
        return self.targets(level, region)[0]

    def steps(self, level: int, region: Region) -> Heights:
        """Return heights of the pyramid of the 5/3 wavelet, which is made of whole steps."""
        heights = self.heights(level, region)
        if level == self._grid.k_max and self._quantizer.step > 1:
            # Rounded to the nearest; the step is odd.
            heights = (heights + (self._quantizer.step >> 1)) // self._quantizer.step
        return heights

    def mask(self, level: int, region: Region) -> Mask:
        """Return which samples of a region of a level are valid.

        A coarse sample is valid iff any full-grid sample of the cells touching it is.
        """
        shift = self._grid.k_max - level
        if not self._has_voids:
            return np.ones(region.shape, dtype=np.bool_)
        if shift == 0:
            return self._source.read(*region)[1]
        return self._levels[shift]["mask"].read(region)

    def own(self, level: int, region: Region) -> Mask:
        """Return which samples of a region of a level are valid by themselves, in the full grid."""
        shift = self._grid.k_max - level
        if shift == 0 or not self._has_voids:
            return self.mask(level, region)
        return self._levels[shift]["own"].read(region)

    def targets(self, level: int, region: Region) -> tuple[Heights, Mask]:
        """Return `heights` and `mask` of a region; of the full grid by one look at the source."""
        if level < self._grid.k_max:
            return self.heights(level, region), self.mask(level, region)
        quanta, valid = self.originals(region)
        if self._has_voids and not valid.all():
            self._fill(0, region, quanta, valid)
        return quanta, valid

    def originals(self, region: Region) -> tuple[Heights, Mask]:
        """Return quanta and validity of the full grid, 0 in voids."""
        raw, valid = self._source.read(*region)
        return self._quantizer.quantize(raw, valid), np.ascontiguousarray(valid)

    def remainders(self, region: Region, quanta: Heights) -> Remainders:
        """Return the originals less the decoded heights of the full grid; 0 in voids."""
        raw, valid = self._source.read(*region)
        return remainders(raw, valid, self._quantizer.dequantize(quanta))

    def even(self, level: int, region: Region) -> Even | None:
        """Return what all targets of a region are, on its level and all below it; None: unknown.

        In quanta, and with an apron on each of these levels.
        """
        return self._even(self._grid.k_max - level, region)

    def _even(self, shift: int, region: Region, margin: int = _EVEN_MARGIN) -> Even | None:
        """Return what all full-grid samples are below a region with a margin, in quanta."""
        row, col = region.row - margin << shift, region.col - margin << shift
        n_rows, n_cols = ((n - 1 + 2 * margin << shift) + 1 for n in region.shape)
        whole = Region(0, 0, self._grid.n_rows, self._grid.n_cols)
        even = self._even_of(Region(row, col, n_rows, n_cols).intersect(whole))
        if even is None or not even.is_valid:
            return None if even is None else Even(np.int32(0), False)
        raw = even.heights((1, 1), np.dtype(self._quantizer.dtype))
        quanta = self._quantizer.quantize(raw, np.ones((1, 1), dtype=np.bool_))
        return Even(quanta[0, 0], True)

    def _unread(self, shift: int, region: Region) -> Even | None:
        """Return what a region is in which nobody reads a fill: of valid samples, or far from any.

        Filters of other kinds than nested ones reach from level to level.
        """
        if self._kind == "nested":
            margin = _FILL_MARGIN * max(TILE // 2, self._grid.block) + _FILL_REACH
            even = self._even(shift, region, margin)
            if even is not None and not even.is_valid:
                return even
        even = self._even(shift, region)
        return even if even is not None and even.is_valid else None

    def _level_shifts(self) -> range:
        return range(self._first + 1, self._last + 1)

    def _shape(self, shift: int) -> tuple[int, int]:
        return (self._grid.n_rows - 1 >> shift) + 1, (self._grid.n_cols - 1 >> shift) + 1

    def _lowpass_window(self, shift: int, region: Region) -> Sequence[Heights]:
        level, is_in_tiles = self._grid.k_max - (shift - 1), self._kind == "lowpass53"
        halo = _LOWPASS53_HALO if is_in_tiles else _LOWPASS_HALO
        fine = _around(region, halo).intersect(self._level(shift - 1).whole)
        first = region.row, region.col
        place = (fine.row, fine.col), self._shape(shift - 1), first, region.shape
        if is_in_tiles:
            from terrainwave.codec.cdf53.tile_layout import TileLayout
            from terrainwave.coding.lifting53 import lowpass_window

            tiles = TileLayout(self._grid).lowpass_tiles(level)
            return (lowpass_window(self.steps(level, fine), *place, *tiles),)
        heights = lowpass_analysis(self.heights(level, fine), *place)
        # Filtering may overshoot; decoded heights are clamped to the range, so targets are too.
        return (np.clip(heights, self._quantizer.z_min, self._quantizer.z_max, out=heights),)

    def _nested_window(self, shift: int, region: Region) -> Sequence[Heights]:
        if shift > 1:
            return (self._nested_parts(shift, region),)
        raw, valid = self._source.read(*_below(region))
        raw, valid = (np.ascontiguousarray(part[::2, ::2]) for part in (raw, valid))
        quanta = self._quantizer.quantize(raw, valid)
        if self._has_voids and not valid.all():
            # These samples lie on those of the level above, whose fills are theirs.
            np.copyto(quanta, self._levels[shift]["fills"].read(region), where=~valid)
        return (quanta,)

    def _nested_parts(self, shift: int, region: Region) -> Heights:
        """Return heights of the level below; where all below a part is void, this level's fills.

        They are the same there. Further from valid samples than here, the level below has none.
        """
        below = self._levels[shift - 1]["heights"]
        if not self._has_voids:
            return below.view(_below(region))[::2, ::2]
        heights = np.empty(region.shape, dtype=np.int32)
        for part, even in even_parts(region, TILE // 2, partial(self._even, shift)):
            if even is None or even.is_valid:
                own = below.view(_below(part))[::2, ::2]
            else:
                own = self._levels[shift]["fills"].view(part)
            heights[part.slices_in(region)] = own
        return heights

    def _mask_window(self, shift: int, region: Region) -> Sequence[Mask]:
        # The first step reaches two samples far: a cell of shift 1 spans two full-grid cells.
        reach = 2 if shift == 1 else 1
        row, col, n_rows, n_cols = _below(region)
        around = Region(row - reach, col - reach, n_rows + 2 * reach, n_cols + 2 * reach)
        window = around.intersect(self._level(shift - 1).whole)
        fine = self.mask(self._grid.k_max - (shift - 1), window)
        if window != around:  # past the raster's edge its border is repeated
            first = window.row - around.row, window.col - around.col
            sizes = zip(first, window.shape, around.shape, strict=True)
            past = [(before, size - before - inside) for before, inside, size in sizes]
            fine = np.pad(fine, past, mode="edge")
        if shift == 1:
            own = fine[reach:, reach:][:n_rows:2, :n_cols:2]
        else:
            own = self._levels[shift - 1]["own"].view(_below(region))[::2, ::2]
        return touched(fine, reach), own

    def _push_window(self, shift: int, region: Region) -> tuple[Heights, Mask]:
        window = Region(
            2 * region.row - 1, 2 * region.col - 1, 2 * region.n_rows + 1, 2 * region.n_cols + 1
        ).intersect(self._level(shift - 1).whole)
        fine, is_known = self.originals(window) if shift == 1 else self.pushed(shift - 1, window)
        if not is_known.all():
            np.copyto(fine, _UNKNOWN, where=~is_known)
        values = np.empty(region.shape, dtype=np.int32)
        known = np.empty(region.shape, dtype=np.bool_)
        lines = np.empty((2, window.n_cols), dtype=np.int64)
        first = 2 * region.row - window.row, 2 * region.col - window.col
        push(fine, *first, lines, values, known)
        return values, known

    def _pull_window(self, shift: int, region: Region) -> Sequence[Heights]:
        values, known = self.pushed(shift, region)
        if not known.all():
            self._fill(shift, region, values, known)
        return (values,)

    def _fill(self, shift: int, region: Region, values: Heights, known: Mask) -> None:
        """Interpolate the filled level above where values of a region are not known."""
        above = self._levels.get(shift + 1)
        if above is None or "fills" not in above.arrays:  # a raster of one sample
            values[~known] = 0
            return
        last_row, last_col = (n - 1 for n in above.shape)
        outer = Region(
            region.row >> 1,
            region.col >> 1,
            min(region.row + region.n_rows >> 1, last_row) - (region.row >> 1) + 1,
            min(region.col + region.n_cols >> 1, last_col) - (region.col >> 1) + 1,
        )
        pull(above["fills"].read(outer), region.row & 1, region.col & 1, known, values)


def _unknown(*_: object) -> None:
    return None


def touched(fine: Mask, reach: int) -> Mask:
    """Return which samples of a level touch a valid one of the level below.

    `fine` are the samples below them and between, and `reach` more around.
    """
    n_rows, n_cols = (n - 2 * reach for n in fine.shape)
    reached = range(2 * reach + 1)
    if fine.all():
        return np.ones((-(-n_rows // 2), -(-n_cols // 2)), dtype=np.bool_)
    rows = reduce(np.logical_or, (fine[row:][:n_rows:2] for row in reached))
    return reduce(np.logical_or, (rows[:, col:][:, :n_cols:2] for col in reached))


def _below(region: Region) -> Region:
    """Return the samples of a region, and those between them, on the level below."""
    return Region(2 * region.row, 2 * region.col, 2 * region.n_rows - 1, 2 * region.n_cols - 1)


def _around(region: Region, halo: int) -> Region:
    """Return the samples of a region on the level below, and `halo` samples around."""
    row, col, n_rows, n_cols = region
    return Region(2 * row - halo, 2 * col - halo, 2 * (n_rows + halo), 2 * (n_cols + halo))
