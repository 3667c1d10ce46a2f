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

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import DTypeLike, NDArray

from terrainwave.codec.cdf53.tile_layout import TileLayout
from terrainwave.codec.refiner import Heights, Mask
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.coding.lifting53 import lowpass_window
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


class SourceWindows(Protocol):
    """Raster as the pyramid reads it."""

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[np.generic], NDArray[np.bool_]]:
        """Return raw heights and validity of a window, which are not to be written to."""
        ...


@runtime_checkable
class IndexedWindows(SourceWindows, Protocol):
    """A raster that may know windows without reading them (`raster_io.even`)."""

    def even(self, region: Region) -> Even | None:
        """Return what all samples of a region of the full grid are; None: only reading tells."""
        ...

    def holds(self, region: Region, even: Even) -> bool:
        """Say whether some samples of a region, read, are that."""
        ...


class SubtreeRegion(NamedTuple):
    """A region of the full grid whose levels down to `shift` are made, each with an apron of 1.

    The frames grow from level to level by what a window of the next coarser one reaches: 5 samples
    in a low-pass window, 2 in a mask's, 1 in a push; one more where a frame's first or last row has
    not the parity of the next level's.
    """

    region: Region
    shift: int

    def heights_region(self, shift: int, is_framed: bool) -> Region:
        """Return where heights and masks of a level are made."""
        scale = 1 << self.shift - shift
        return self._framed(shift, 7 * scale - 6 if is_framed else 2 * scale - 1)

    def fill_region(self, shift: int) -> Region:
        """Return where the fills of a level are needed."""
        return self._framed(shift, 7 << self.shift - shift)

    def push_region(self, shift: int) -> Region:
        """Return where known heights are pushed to on a level."""
        return self._framed(shift, (9 << self.shift - shift) - 2)

    def _framed(self, shift: int, margin: int) -> Region:
        """Return the region on a level with a margin around it; may reach past the raster."""
        row, col, n_rows, n_cols = self.region
        first_row, first_col = (row >> shift) - margin, (col >> shift) - margin
        last_row = -(-(row + n_rows - 1) >> shift) + margin
        last_col = -(-(col + n_cols - 1) >> shift) + margin
        return Region(first_row, first_col, last_row - first_row + 1, last_col - first_col + 1)


class Base(NamedTuple):
    """Arrays of one level from which the next is made; the last four only with voids.

    `pushed` holds the averages of valid samples where there are any: where `known` says so; `own`
    says which samples are valid by themselves.
    """

    shift: int
    heights: Spool
    masks: Spool | None = None
    pushed: Spool | None = None
    known: Spool | None = None
    own: Spool | None = None


class Pyramid:
    """Targets of all levels of a raster; the finest is read from the source when asked for.

    Parameters
    ----------
    kind : str
        ``"lowpass"``, ``"lowpass53"`` or ``"nested"``.
    has_voids : bool
        Whether any sample of the raster is void; without voids no masks and fills are kept.
    directory : Path
        Where levels too large for memory are spooled.
    executor : Executor
        Makes the windows of a level side by side.
    part : Part, optional
        Make the levels of a part of the raster, of any kind but ``"lowpass53"``; where there are
        voids `pull` needs its coarsest fills.
    base : Base, optional
        Make the levels above that of `base`; below it there is nothing to ask for.

    Attributes
    ----------
    kept : Kept
        Where levels are left for a later run, and taken from; not those of a part.
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
        self._even_of: EvenOf = lambda _: None
        if isinstance(source, IndexedWindows):
            self._even_of = source.even
        self.kept = Kept()
        self._heights: dict[int, Spool] = {}
        self._masks: dict[int, Spool] = {}
        self._own: dict[int, Spool] = {}
        # Averages of valid samples, and where there are any; from `pull` on, fills of all samples.
        self._averages: dict[int, Spool] = {}
        self._known: dict[int, Spool] = {}
        self._fills: dict[int, Spool] = {}
        self._first = 0
        self._last = grid.k_max if part is None else part.shift
        if base is not None:
            self._first = base.shift
            self._heights[base.shift] = base.heights
            levels = self._masks, self._averages, self._known, self._own
            made = base.masks, base.pushed, base.known, base.own
            for spools, spool in zip(levels, made, strict=True):
                if spool is not None:
                    spools[base.shift] = spool

    def build(self, report: Callable[[int, int], None]) -> None:
        """Make every level below the full grid; `report` gets (samples done, samples in all)."""
        if self._has_voids:
            self.push()
            self.pull()
        self.make_heights(report)

    def push(self) -> None:
        """Make the masks of all levels, and average valid heights up to one sample."""
        self._build_masks()
        shift, dropped = self._first, self._dropped_averages()
        while shift < self._last or (self._part is None and max(self._shape(shift)) > 1):
            shift += 1
            if shift in dropped:
                continue
            region = self._inside(shift, self._part.push_region(shift) if self._part else None)
            averages = self._new_spool(region, np.int32, f"averages-{shift}")
            known = self._new_spool(region, np.bool_, f"known-{shift}")
            self._averages[shift], self._known[shift] = averages, known

            def fill(
                window: Region, even: Even, averages: Spool = averages, known: Spool = known
            ) -> None:
                averages.fill(window, even.value)
                known.fill(window, even.is_valid)

            windows = _uneven(region, partial(self._even, shift), fill)
            work = partial(self._push_window, shift)
            self._in_windows(f"push-{shift}", (averages, known), windows, work)

    def pushed(self, shift: int, region: Region) -> tuple[Heights, Mask]:
        """Return averages of valid heights and where they are known, before `pull`."""
        return self._averages[shift].read(region), self._known[shift].read(region)

    def pull(self, coarsest: Spool | None = None) -> None:
        """Interpolate from the coarsest level down where nothing is known.

        A part needs the fills of its coarsest level, where it would not know enough by itself.
        """
        if not self._averages:  # a raster of one sample
            return
        top = max(self._averages)
        self._fills[top] = coarsest or self._averages.pop(top)
        self._drop_averages(top)
        for finer in range(top - 1, max(self._first - 1, 0), -1):
            # Those of level 1 fill the full grid; of others nobody reads any more after heights.
            if finer > 1 and self._is_kept_whole(self._kind, finer):
                self._drop_averages(finer)
                continue
            region = self._inside(finer, self._part.fill_region(finer) if self._part else None)
            name = f"fills-{self._kind}-{finer}"
            spool = self._fills[finer] = self._new_spool(region, np.int32, name)

            def fill(window: Region, even: Even, spool: Spool = spool) -> None:
                spool.fill(window, even.value)

            windows = _uneven(region, partial(self._unread, finer), fill)
            self._make_windows(name, spool, partial(self._pull_window, finer), windows)
            self._drop_averages(finer)

    def _drop_averages(self, shift: int) -> None:
        """Give up what was averaged on a level, unless a later run makes the next ones of it."""
        is_needed = is_small(self._shape(shift + 1), np.bool_)
        for spools in (self._averages, self._known):
            if shift in spools:
                (spools[shift].close if is_needed else spools[shift].drop)()
                del spools[shift]

    def _dropped_averages(self) -> set[int]:
        """Return the levels whose averages an earlier run has dropped, if no level needs them."""
        dropped = set()
        for shift in self._level_shifts():
            path = self.kept.path(f"averages-{shift}")
            if path is None or is_small(self._shape(shift), np.bool_):
                continue
            if not path.exists():
                dropped.add(shift)
        kinds = self._kind, f"fills-{self._kind}"
        is_filled = (any(self._is_kept_whole(kind, shift) for kind in kinds) for shift in dropped)
        return dropped if all(is_filled) else set()

    def _is_kept_whole(self, kind: str, shift: int) -> bool:
        """Say whether an earlier run has left all heights or fills of a level."""
        path = self.kept.path(f"{kind}-{shift}")
        return path is not None and path.exists() and self.kept.is_whole(f"{kind}-{shift}")

    def fills(self, shift: int, region: Region) -> Heights:
        """Return the heights given to voids on a level, after `pull`."""
        return self._fills[shift].read(region)

    def make_heights(self, report: Callable[[int, int], None]) -> None:
        """Make the heights of every level above the full grid, after the fills of voids."""
        regions = {shift: self._heights_region(shift) for shift in self._level_shifts()}
        total = sum(region.n_rows * region.n_cols for region in regions.values())
        done = 0
        make = {
            "lowpass": self._lowpass_window,
            "lowpass53": self._lowpass53_window,
            "nested": self._nested_window,
        }[self._kind]
        for shift, region in regions.items():
            name = f"{self._kind}-{shift}"
            spool = self._heights[shift] = self._new_spool(region, np.int32, name)

            def fill(part: Region, even: Even, spool: Spool = spool) -> None:
                spool.fill(part, even.value)

            windows = _uneven(region, partial(self._even_heights, shift), fill)
            self._make_windows(name, spool, partial(make, shift), windows)
            if shift > 1 and shift in self._fills:
                self._fills.pop(shift).drop()
            done += region.n_rows * region.n_cols
            report(done, total)

    def close(self) -> None:
        """Delete the spools."""
        levels = self._heights, self._masks, self._own, self._averages, self._known, self._fills
        for spools in levels:
            for spool in spools.values():
                spool.close()

    def heights(self, level: int, region: Region) -> Heights:
        """Return the target heights of a region of a level; voids hold their fill."""
        return self._read_heights(self._grid.k_max - level, region)

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
        return self._masks[shift].read(region)

    def own(self, level: int, region: Region) -> Mask:
        """Return which samples of a region of a level are valid by themselves, in the full grid."""
        shift = self._grid.k_max - level
        if shift == 0 or not self._has_voids:
            return self.mask(level, region)
        return self._own[shift].read(region)

    def targets(self, level: int, region: Region) -> tuple[Heights, Mask]:
        """Return `heights` and `mask` of a region; of the full grid by one look at the source."""
        if level < self._grid.k_max:
            return self.heights(level, region), self.mask(level, region)
        return self._filled_originals(region)

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

    def _even_heights(self, shift: int, region: Region) -> Even | None:
        """Return what the heights of a region are, without looking at those of the level below."""
        return self._unread(shift, region) if self._kind == "nested" else None

    def _level_shifts(self) -> range:
        return range(self._first + 1, self._last + 1)

    def _heights_region(self, shift: int) -> Region:
        is_framed = self._has_voids or self._kind == "lowpass"
        return self._inside(
            shift, self._part.heights_region(shift, is_framed) if self._part else None
        )

    def _inside(self, shift: int, region: Region | None) -> Region:
        """Return the part of a region of a level inside the raster; None: the whole level."""
        whole = Region(0, 0, *self._shape(shift))
        return whole if region is None else region.intersect(whole)

    def _new_spool(self, region: Region, dtype: DTypeLike, name: str) -> Spool:
        path = self.kept.path(name)
        return Spool(region.shape, dtype, self._directory, (region.row, region.col), path)

    def _shape(self, shift: int) -> tuple[int, int]:
        return (self._grid.n_rows - 1 >> shift) + 1, (self._grid.n_cols - 1 >> shift) + 1

    def _read_heights(self, shift: int, region: Region) -> Heights:
        if shift:
            return self._heights[shift].read(region)
        return self._filled_originals(region)[0]

    def _filled_originals(self, region: Region) -> tuple[Heights, Mask]:
        """Return quanta and validity of the full grid, voids filled."""
        quanta, valid = self.originals(region)
        if self._has_voids and not valid.all():
            self._fill(0, region, quanta, valid)
        return quanta, valid

    def _around(self, shift: int, region: Region, halo: int) -> Region:
        """Return a region of the level above `shift` on that level, and `halo` samples around."""
        return Region(
            2 * region.row - halo,
            2 * region.col - halo,
            2 * region.n_rows + 2 * halo,
            2 * region.n_cols + 2 * halo,
        ).intersect(Region(0, 0, *self._shape(shift)))

    def _lowpass53_window(self, shift: int, region: Region) -> Heights:
        fine = self._around(shift - 1, region, _LOWPASS53_HALO)
        return lowpass_window(
            self.steps(self._grid.k_max - (shift - 1), fine),
            (fine.row, fine.col),
            self._shape(shift - 1),
            (region.row, region.col),
            region.shape,
            *TileLayout(self._grid).lowpass_tiles(self._grid.k_max - (shift - 1)),
        )

    def _lowpass_window(self, shift: int, region: Region) -> Heights:
        shape = self._shape(shift - 1)
        fine = self._around(shift - 1, region, _LOWPASS_HALO)
        heights = lowpass_analysis(
            self._read_heights(shift - 1, fine),
            (fine.row, fine.col),
            shape,
            (region.row, region.col),
            region.shape,
        )
        # Filtering may overshoot; decoded heights are clamped to the range, so targets are too.
        return np.clip(heights, self._quantizer.z_min, self._quantizer.z_max, out=heights)

    def _nested_window(self, shift: int, region: Region) -> Heights:
        if shift > 1:
            return self._nested_parts(shift, region)
        raw, valid = self._source.read(*_below(region))
        raw, valid = (np.ascontiguousarray(part[::2, ::2]) for part in (raw, valid))
        quanta = self._quantizer.quantize(raw, valid)
        if self._has_voids and not valid.all():
            # These samples lie on those of the level above, whose fills are theirs.
            np.copyto(quanta, self._fills[shift].read(region), where=~valid)
        return quanta

    def _nested_parts(self, shift: int, region: Region) -> Heights:
        """Return heights of the level below; where all below a part is void, this level's fills.

        They are the same there. Further from valid samples than here, the level below has none.
        """
        if not self._has_voids:
            return self._heights[shift - 1].view(_below(region))[::2, ::2]
        heights = np.empty(region.shape, dtype=np.int32)
        for part, even in even_parts(region, TILE // 2, partial(self._even, shift)):
            if even is None or even.is_valid:
                own = self._heights[shift - 1].view(_below(part))[::2, ::2]
            else:
                own = self._fills[shift].view(part)
            heights[part.slices_in(region)] = own
        return heights

    def _build_masks(self) -> None:
        for shift in self._level_shifts():
            region = self._heights_region(shift)
            spool = self._masks[shift] = self._new_spool(region, np.bool_, f"mask-{shift}")
            self._own[shift] = self._new_spool(region, np.bool_, f"own-{shift}")
            # The first step reaches two samples far: a cell of shift 1 spans two full-grid cells.
            reach = 2 if shift == 1 else 1

            def fill(
                part: Region, even: Even, spools: Sequence[Spool] = (spool, self._own[shift])
            ) -> None:
                for one in spools:
                    one.fill(part, even.is_valid)

            windows = _uneven(region, partial(self._even, shift), fill)
            make = partial(self._mask_window, shift, reach)
            self._make_windows(f"mask-{shift}", spool, make, windows)

    def _mask_window(self, shift: int, reach: int, region: Region) -> Mask:
        level = self._grid.k_max - (shift - 1)
        fine = self._gather(lambda window: self.mask(level, window), shift - 1, region, reach)
        rows, cols = (slice(2 * n - 1) for n in region.shape)
        if shift == 1:
            own = fine[reach:, reach:][rows, cols][::2, ::2]
        else:
            row, col, n_rows, n_cols = region
            places = Region(2 * row, 2 * col, 2 * n_rows - 1, 2 * n_cols - 1)
            own = self._own[shift - 1].view(places)[::2, ::2]
        self._own[shift].write(region, own)
        touched = fine[rows][::2].copy()
        for row in range(1, 2 * reach + 1):
            touched |= fine[row:][rows][::2]
        mask = touched[:, cols][:, ::2].copy()
        for col in range(1, 2 * reach + 1):
            mask |= touched[:, col:][:, cols][:, ::2]
        return mask

    def _push_window(self, shift: int, window: Region) -> None:
        values, known = self._pushed(shift, window)
        self._averages[shift].write(window, values)
        self._known[shift].write(window, known)

    def _pull_window(self, shift: int, window: Region) -> Heights:
        values, known = self.pushed(shift, window)
        if not known.all():
            self._fill(shift, window, values, known)
        return values

    def _pushed(self, shift: int, region: Region) -> tuple[Heights, Mask]:
        window = Region(
            2 * region.row - 1, 2 * region.col - 1, 2 * region.n_rows + 1, 2 * region.n_cols + 1
        ).intersect(Region(0, 0, *self._shape(shift - 1)))
        fine, is_known = self.originals(window) if shift == 1 else self.pushed(shift - 1, window)
        if not is_known.all():
            np.copyto(fine, _UNKNOWN, where=~is_known)
        values = np.empty(region.shape, dtype=np.int32)
        known = np.empty(region.shape, dtype=np.bool_)
        lines = np.empty((2, window.n_cols), dtype=np.int64)
        first = 2 * region.row - window.row, 2 * region.col - window.col
        push(fine, *first, lines, values, known)
        return values, known

    def _fill(self, shift: int, region: Region, values: Heights, known: Mask) -> None:
        """Interpolate the filled level above where values of a region are not known."""
        if shift + 1 not in self._fills:  # a raster of one sample has no level above
            values[~known] = 0
            return
        last_row, last_col = (n - 1 for n in self._shape(shift + 1))
        outer = Region(
            region.row >> 1,
            region.col >> 1,
            min(region.row + region.n_rows >> 1, last_row) - (region.row >> 1) + 1,
            min(region.col + region.n_cols >> 1, last_col) - (region.col >> 1) + 1,
        )
        pull(self._fills[shift + 1].read(outer), region.row & 1, region.col & 1, known, values)

    def _gather(
        self,
        read: Callable[[Region], NDArray[Any]],
        shift: int,
        coarse: Region,
        halo: int,
    ) -> NDArray[Any]:
        """Return level `shift` around the samples of the region `coarse` of the level above.

        Row 2 i + halo of the result lies on row ``coarse.row + i``; places past the raster's edge
        repeat its border.
        """
        around = Region(
            2 * coarse.row - halo,
            2 * coarse.col - halo,
            2 * (coarse.n_rows - 1 + halo) + 1,
            2 * (coarse.n_cols - 1 + halo) + 1,
        )
        window = around.intersect(Region(0, 0, *self._shape(shift)))
        values = read(window)
        if window == around:
            return values
        top, left = window.row - around.row, window.col - around.col
        bottom, right = top + window.n_rows, left + window.n_cols
        repeated = np.empty(around.shape, dtype=values.dtype)
        repeated[top:bottom, left:right] = values
        repeated[top:bottom, :left] = values[:, :1]
        repeated[top:bottom, right:] = values[:, -1:]
        repeated[:top] = repeated[top]
        repeated[bottom:] = repeated[bottom - 1]
        return repeated

    def _make_windows(
        self,
        name: str,
        spool: Spool,
        make: Callable[[Region], NDArray[np.generic]],
        windows: Iterable[Region],
    ) -> None:
        self._in_windows(name, [spool], windows, lambda region: spool.write(region, make(region)))

    def _in_windows(
        self,
        name: str,
        spools: Sequence[Spool],
        windows: Iterable[Region],
        work: Callable[[Region], None],
    ) -> None:
        """Do work for windows, side by side, but for those that an earlier run has finished."""
        for _ in self.kept.each(name, spools, windows, partial(self._side_by_side, work)):
            pass

    def _side_by_side(
        self, work: Callable[[Region], None], windows: Iterable[Region]
    ) -> Iterator[None]:
        windows = iter(windows)
        while batch := list(islice(windows, _BATCH)):
            yield from self._executor.map(work, batch)


def _below(region: Region) -> Region:
    """Return the samples of a region, and those between them, on the level below."""
    return Region(2 * region.row, 2 * region.col, 2 * region.n_rows - 1, 2 * region.n_cols - 1)


def _uneven(
    region: Region, even_of: EvenOf, fill: Callable[[Region, Even], None]
) -> Iterator[Region]:
    """Yield windows of a region but for its even parts, which `fill` gets."""
    for part, even in even_parts(region, TILE, even_of):
        if even is None:
            yield part
        else:
            fill(part, even)
