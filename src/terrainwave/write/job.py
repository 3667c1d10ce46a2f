"""`Job`: what every pass over a raster has to know, and the header that follows from it.

`settled` makes it of `Options` and of what a scan has found.
"""

import math
import sys
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from terrainwave._version import __version__
from terrainwave.container.header import (
    HAS_REMAINDERS,
    HAS_VOIDS,
    IS_FAITHFUL,
    Header,
)
from terrainwave.container.metadata import EARLIER, MAX_MOVED, ORIGIN
from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.default_bound import default_bound
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Grid
from terrainwave.grid.quantum import (
    MAX_QUANTA,
    HeightScan,
    Quantizer,
    as_fraction,
    rounded_up,
)
from terrainwave.grid.steps import FixedSteps
from terrainwave.mesh.codes import mesh_tolerance
from terrainwave.names import BOTH, Method, mesh_without_coefficients, methods_that
from terrainwave.place.units import height_unit
from terrainwave.raster_io.raster_info import NO_LOSS, EarlierLoss, RasterInfo, stored_nodata
from terrainwave.write.compress_options import Options
from terrainwave.write.earlier import NOTHING, Earlier

# How notes begin that say which bound was taken.
NO_BOUND = "no --max-error given:"
# Heights on no grid are rounded to their range / 2^18 or so before a stream of them is cut.
_FINE_BITS = 18


@dataclass(frozen=True)
class Job:
    """Settings of a run after the scan: plain values, the same on every machine.

    Attributes
    ----------
    options : Options
        What was asked for.
    bound : Fraction
        The bound that follows, in physical units; of an embedded file 0 until it has been measured.
    n_valid : int
        Samples of the raster that are valid.
    measured : float, optional
        The bound that holds where it does not follow from the quantizer, in raw units: of an
        embedded file, once it is known, and where heights give way to the nodata value.
    earlier : EarlierLoss
        How far the raster itself may be from an original that it was made of; of heights that do
        not move, beyond the file's own bound.
    origin : dict, optional
        What the file keeps of where it comes from (`origin_of`), if that was asked for.
    """

    options: Options
    info: RasterInfo
    grid: Grid
    bound: Fraction
    quantizer: Quantizer
    n_valid: int
    measured: float | None = None
    earlier: EarlierLoss = NO_LOSS
    origin: dict[str, Any] | None = None

    @property
    def effective_error(self) -> float:
        """Return the bound that holds, from the raster, in raw units."""
        return self.quantizer.effective_error if self.measured is None else self.measured

    @cached_property
    def moved(self) -> int:
        """Return `earlier` in quanta, rounded up."""
        quanta = as_fraction(self.earlier.max_error) / scale_of(self.info) / self._quantum
        return int(-(-quanta // 1))

    @property
    def moved_error(self) -> float:
        """Return what the file's bounds are larger by than those from the raster, in raw units."""
        return float(self.moved * self._quantum)

    @property
    def stated_bound(self) -> Fraction:
        """Return the bound from the original that the file states, in physical units."""
        return self.bound + self.moved * self._quantum * scale_of(self.info)

    @property
    def _quantum(self) -> Fraction:
        return Fraction(self.quantizer.numerator, self.quantizer.denominator)

    def with_measured(self, error: int) -> "Job":
        # That of a bounded file whose steps have this half.
        measured = replace(self.quantizer, step=2 * error + 1).effective_error
        return replace(self, measured=measured, bound=as_fraction(measured) * scale_of(self.info))

    def with_range_of_original(self) -> "Job":
        """Return the job with a range that holds the original's heights, too."""
        low, high = self.quantizer.z_min - self.moved, self.quantizer.z_max + self.moved
        if self.moved and high - low >= MAX_QUANTA:
            raise InvalidHeightsError(
                f"found heights within {self.earlier.max_error:g} of an original, in steps of"
                f" {float(self._quantum):g}; expected a larger `max_error`: the original's range"
                " may have more than 2^30 of these steps"
            )
        return replace(self, quantizer=replace(self.quantizer, z_min=low, z_max=high))

    def with_method(self, method: Method) -> "Job":
        """Return the job with another method; all that is settled stays.

        But for meshes that follow coefficients, where the method has none: these are measured.
        """
        mesh = mesh_without_coefficients(self.options.mesh_kind, method)
        return replace(self, options=self.options.with_method(method, mesh))

    @property
    def has_voids(self) -> bool:
        return self.n_valid < self.grid.n_rows * self.grid.n_cols

    @property
    def may_repeat(self) -> bool:
        """Say whether like segments have the same codes: nothing is measured across their borders.

        That of a mesh is, and what the errors of a faithful file are made of.
        """
        options = self.options
        return not (options.measures_meshes or options.faithful or options.is_embedded)

    @property
    def raw_bound(self) -> float:
        return float(self.bound / scale_of(self.info))

    @property
    def lost(self) -> int:
        """Return the largest loss besides that of coding, in quanta: rounded, moved, or before."""
        return self.quantizer.lost + self.moved + abs(self.quantizer.lift)

    @property
    def recursion_bound(self) -> int | None:
        """Return delta, in quanta, if errors of blocks are those of Y10's recursion, else None."""
        return (self.quantizer.step >> 1) + self.lost if self.options.faithful else None

    @property
    def mesh_tolerance(self) -> int:
        """Return the tolerance of the finest meshes in 1/16 quanta, rounded down; 0 without."""
        quantizer = self.quantizer
        if self.options.mesh_kind == "none":
            return 0
        if self.options.mesh_error is None:
            stated = self.effective_error + self.moved_error
            error = default_mesh_error(quantizer, stated, self.info)
        else:
            error = as_fraction(self.options.mesh_error) / scale_of(self.info)
        return mesh_tolerance(error, self._quantum)

    @property
    def parameters(self) -> CodecParameters:
        options = self.options
        return CodecParameters.of(
            self.quantizer,
            self.info.nodata,
            options.border_rings,
            options.effort_number,
            is_faithful=options.faithful,
            has_voids=self.has_voids,
        )

    def header(self, file_tables: bytes) -> Header:
        options, quantizer, info = self.options, self.quantizer, self.info
        metadata = metadata_of(info)
        if self.moved:
            metadata["moved"] = self.moved
            if self.earlier.files:
                metadata[EARLIER] = [file._asdict() for file in self.earlier.files]
        if self.origin is not None:
            metadata[ORIGIN] = self.origin
        if not options.verify:
            metadata["proof"] = "none"
        if quantizer.lift:
            metadata["bound"] = options.bound
        has_heights = self.n_valid > 0
        return Header(
            n_rows=info.n_rows,
            n_cols=info.n_cols,
            block=self.grid.block,
            border_rings=options.border_rings,
            method=options.named_method.name,
            dtype=info.dtype,
            effort=options.effort_number,
            quantum=self._quantum,
            base=quantizer.base,
            step=quantizer.step,
            z_min=quantizer.z_min if has_heights else 0,
            z_max=quantizer.z_max if has_heights else -1,
            max_error=self.raw_bound + self.moved_error,
            # That of a file with remainders is 0 (FORMAT.md §4.1).
            effective_bound=min(self.effective_error, self.raw_bound)
            + (0.0 if quantizer.remainder_bytes else self.moved_error),
            rho=quantizer.rho,
            features=(HAS_VOIDS if self.has_voids else 0)
            | (HAS_REMAINDERS if quantizer.remainder_bytes else 0)
            | (IS_FAITHFUL if options.faithful else 0),
            mesh=options.mesh_kind,
            mesh_tolerance=self.mesh_tolerance,
            metadata={**metadata, "software": f"terrainwave {__version__}"},
            file_tables=file_tables,
        )


def metadata_of(info: RasterInfo) -> dict[str, Any]:
    """Return what a file's metadata say of its raster.

    Only what is not as it would be anyway; size and type are in the header itself.
    """
    plain = RasterInfo(info.n_rows, info.n_cols, info.dtype).to_metadata()
    return {key: value for key, value in info.to_metadata().items() if value != plain[key]}


def origin_of(options: Options, scan: HeightScan) -> dict[str, Any]:
    """Return what a file keeps of where it comes from (FORMAT.md §4.2, *origin*)."""
    assert scan.digest is not None
    return {"heights": scan.digest.text, "options": options.to_metadata()}


def scale_of(info: RasterInfo) -> Fraction:
    """Return physical units per raw one, without sign; raise if it is 0 or not finite."""
    if info.scale == 0 or not math.isfinite(info.scale):
        raise InvalidHeightsError(
            f"the raster's scale is {info.scale:g}, expected a finite number that is not 0: correct"
            " its metadata"
        )
    return abs(as_fraction(info.scale))


def default_mesh_error(quantizer: Quantizer, bound: float, info: RasterInfo) -> Fraction:
    """Return the error of the finest meshes, in raw units, where none is named.

    What the bound of the heights guarantees, or the vertical quantum where that is more. Of exact
    heights on no grid both are next to nothing: theirs is the bound that such heights have by
    default.
    """
    quantum = Fraction(quantizer.numerator, quantizer.denominator)
    error = max(Fraction(bound), quantum)
    if not quantizer.remainder_bytes:
        return error
    scale, unit = scale_of(info), height_unit(info.units, info.crs)
    span = (quantizer.z_max - quantizer.z_min) * quantum * scale
    return max(error, default_bound(span, unit.name, unit.length).error / scale)


def fixed_steps(options: Options, info: RasterInfo) -> FixedSteps | None:
    """Return what heights are to be rounded to before all else; None: to nothing."""
    if not options.stable or options.max_error is None:
        return None
    nodata = None
    if info.nodata is not None and math.isfinite(info.nodata):
        nodata = stored_nodata(info.nodata, np.dtype(info.dtype)).item()
    return FixedSteps.of(_raw_bound(as_fraction(options.max_error), info), info.dtype, nodata)


def settled(
    options: Options, scan: HeightScan, info: RasterInfo, earlier: Earlier = NOTHING
) -> tuple[Job, list[str]]:
    """Return the job for a scanned raster, and notes for the user.

    `options` have the bound from the raster, `earlier` what was asked of that from its original.
    """
    bound, notes = Fraction(0), list[str]()
    if options.is_embedded:
        quantizer = _fine_quantizer(scan)
    else:
        bound, notes = _choose_bound(options, scan, info)
        # Tiles code whole levels at once: nothing of theirs could take remainders.
        raw_bound = Fraction(0) if options.stable else _raw_bound(bound, info)
        limits: dict[str, Any] = {
            "may_have_remainders": not options.named_method.is_tiled,
            "is_strict": options.strict,
            "side": info.stored_side(options.bound),
        }
        quantizer = _with_range(scan, options, info).quantizer(raw_bound, **limits)
        if (
            options.height_range is not None
            and quantizer.remainder_bytes
            and not scan.quantizer(raw_bound, **limits).remainder_bytes
        ):
            notes.append(
                "`height_range` is so wide that heights cannot be told within the bound at its"
                " ends: the file keeps all heights exactly, and is larger; choose a narrower range"
            )
    if options.height_range is not None and not scan.n_valid:
        notes.append(
            "the raster has voids alone: `height_range` has no effect, and patch can bring no"
            " heights"
        )
    is_exact = quantizer.rho == 0 or quantizer.remainder_bytes > 0
    if is_exact and scan.n_valid and fixed_steps(options, info) is not None:
        notes.append(
            "some heights lie on no fixed step (floats that are further apart than the bound needs,"
            " or a height whose step is the nodata value): the file keeps all heights exactly"
        )
    if scan.has_negative_zeros and bound == 0 and not quantizer.remainder_bytes:
        notes.append(
            f"-0.0 becomes 0.0: method {options.named_method.name} keeps numbers, not the sign of"
            f" zero; method {methods_that(lambda method: not method.is_tiled)} keeps both"
        )
    if options.bound != BOTH:
        notes += _notes_of_side(options.bound, bound, quantizer, earlier)
    measured = None
    if options.named_method.is_tiled:
        quantizer, measured = _with_room_for_nodata(quantizer, info)
        measured = None if options.is_embedded else measured
    grid = Grid(info.n_rows, info.n_cols, options.block)
    origin = origin_of(earlier.asked or options, scan) if options.keep_origin else None
    own = quantizer.effective_error * float(scale_of(info))
    more, earlier_notes = earlier.beyond(own)
    loss = EarlierLoss(more, earlier.files)
    job = Job(options, info, grid, bound, quantizer, scan.n_valid, measured, loss, origin)
    if job.moved > MAX_MOVED:
        raise InvalidHeightsError(
            f"the heights are within {earlier.error:g} of an original by what came with them, which"
            f" is more than 2^31 steps of {float(job.bound):g}; expected a larger `max_error`, or"
            " an array without the attribute max_error"
        )
    above = _above_limit(job, earlier)
    if not above:
        return job.with_range_of_original(), notes + earlier_notes
    return settled(_with_smaller_bound(job, above, earlier), scan, info, earlier)


def _notes_of_side(side: str, bound: Fraction, quantizer: Quantizer, earlier: Earlier) -> list[str]:
    """Return notes on a one-sided bound; raise where it says nothing of the original."""
    if earlier.error:
        raise InvalidHeightsError(
            f"found `bound` {side} and heights within {earlier.error:g} of an original, to both"
            " sides of it: expected the original raster"
        )
    if quantizer.lift or not bound:
        return []
    return [
        f"the file is lossless: a bound of {float(bound):g} to one side leaves no room between"
        f" heights in steps of {quantizer.quantum:g} (stored units)"
    ]


def _with_range(scan: HeightScan, options: Options, info: RasterInfo) -> HeightScan:
    """Return a scan whose range holds the heights that patches may bring, too."""
    if options.height_range is None:
        return scan
    scale, offset = as_fraction(info.scale), as_fraction(info.offset)
    low, high = sorted((as_fraction(end) - offset) / scale for end in options.height_range)
    return scan.reaching(low, high)


def _above_limit(job: Job, earlier: Earlier) -> Fraction:
    """Return by how much a bound from the original is above what was asked, in physical units.

    The earlier loss is stated in whole quanta. 0 where nothing was asked of this bound.
    """
    if earlier.asked is None or earlier.asked.max_error is None or job.options.is_embedded:
        return Fraction(0)
    return max(job.stated_bound - as_fraction(earlier.asked.max_error), Fraction(0))


def _with_smaller_bound(job: Job, above: Fraction, earlier: Earlier) -> Options:
    """Return the options with a bound that leaves more room for the earlier loss."""
    if not job.bound:
        least = rounded_up(job.stated_bound)
        raise InvalidHeightsError(
            f"found `max_error` {float(job.stated_bound - above):g} and heights within"
            f" {earlier.error:g} of an original, expected at least {least}: a file states what was"
            " lost before in whole steps of its own heights"
        )
    limit = max(job.bound - above, Fraction(0))
    smaller = float(limit)
    while as_fraction(smaller) > limit:  # its digits may be those of the bound that was too large
        smaller = math.nextafter(smaller, 0)
    return replace(job.options, max_error=smaller)


def _raw_bound(bound: Fraction, info: RasterInfo) -> Fraction:
    raw_bound = bound / scale_of(info)
    if raw_bound > sys.float_info.max:
        raise InvalidHeightsError(
            f"found `max_error` {float(bound):g} and a raster whose scale is {info.scale:g},"
            " expected a `max_error` that is a finite number of its stored units"
        )
    return raw_bound


def _with_room_for_nodata(quantizer: Quantizer, info: RasterInfo) -> tuple[Quantizer, float | None]:
    """Return a quantizer whose bound still holds where a height gives way to the nodata value.

    Methods of tiles move it past all quanta of that value, to one side (format-cdf53.md, C.6). The
    second is the bound with these moves, in raw units, if there may be any.
    """
    first, last = quantizer.quanta_of_value(info.nodata)
    room = last - first + 1
    half = quantizer.step >> 1
    if room <= 0 or (half == 0 and quantizer.rho == 0):  # quanta of originals are not in the way
        return quantizer, None
    narrow = replace(quantizer, step=2 * max(half - room, 0) + 1)
    moved = replace(quantizer, step=2 * max(half, room) + 1)
    return narrow, moved.effective_error if narrow.step > 1 or quantizer.rho else None


def _fine_quantizer(scan: HeightScan) -> Quantizer:
    """Return a quantizer for heights whose error is not chosen by a bound.

    The vertical quantum where there is one, else one far below what a cut stream tells.
    """
    if scan.true_quantum() is not None:
        try:
            return scan.quantizer(Fraction(0))
        except InvalidHeightsError:  # the range takes more than 30 bits of it
            pass
    error = (as_fraction(scan.maximum) - as_fraction(scan.minimum)) / (1 << _FINE_BITS)
    for _ in range(_FINE_BITS):
        try:
            return scan.quantizer(error)
        except InvalidHeightsError:
            error *= 2
    return scan.quantizer(error)


def _choose_bound(
    options: Options, scan: HeightScan, info: RasterInfo
) -> tuple[Fraction, list[str]]:
    """Return the bound in physical units, and by which rule it was chosen if none was given."""
    if options.max_error is not None:
        return as_fraction(options.max_error), []
    p, scale = scan.true_quantum(), scale_of(info)
    unit = height_unit(info.units, info.crs)
    behind = f" {unit.name}" if unit.name else ""
    if p is not None:
        rule = f"lossless, as all heights are multiples of {float(p * scale):g}{behind}"
        return Fraction(0), [f"{NO_BOUND} {rule}; --max-error E makes the file smaller"]
    bound, reason = default_bound(scan.span * scale, unit.name, unit.length)
    least = scan.least_bound() * scale
    if options.named_method.is_tiled and bound < least:
        bound = Fraction(rounded_up(least))
        reason += f", and method {options.named_method.name} needs this much for such heights"
    found = f"{float(bound):g}{behind}" if bound else "lossless"
    return bound, [f"{NO_BOUND} {found}, as {reason}; choose with --max-error E; 0 keeps every bit"]
