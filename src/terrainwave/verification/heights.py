"""Independent check that every decoded height is within the bound of the original.

Shares no code with the encoder: the original is read only with rasterio (`original`), the decoded
heights with an ordinary `Terrain`. Not all samples are read where the index of both files says that
all is void, and for large parts of one height in both, one represents all with the same heights.
Memory holds a few windows.
"""

import math
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from terrainwave.arguments import (
    MASK,
    RAISE,
    check_band,
    check_callback,
    check_flags,
    checked_error,
    checked_path,
    checked_whole,
    nodata_choice,
    shown,
)
from terrainwave.errors import (
    CorruptStreamError,
    InvalidArgumentError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.grid.quadtree import Region
from terrainwave.names import METHODS
from terrainwave.place.meaning import check_kind
from terrainwave.progress import Progress, ProgressCallback
from terrainwave.raster_io.dataset import opened
from terrainwave.raster_io.even import Even, even_parts
from terrainwave.raster_io.vrt import remark_on_windows
from terrainwave.verification.original import (
    Original,
    metadata_problems,
    place_problem,
    place_text,
    unit_problem,
)


@dataclass(frozen=True)
class ErrorReport:
    """Errors over all samples that are valid in both rasters.

    `n_valid`: number of compared samples.
    `max_error`: largest absolute difference, in the units given to `ErrorSum`; 0 if nothing was
        compared.
    `rmse`: root of the mean squared difference; 0 if nothing was compared.
    `worst_row`, `worst_col`: the first sample with the largest difference; None if all are equal.
    `n_mask_differences`: samples that are valid in one raster and void in the other.
    """

    n_valid: int
    max_error: float
    rmse: float
    worst_row: int | None
    worst_col: int | None
    n_mask_differences: int


class ErrorSum:
    """Adds up differences over windows; `report` gives the result.

    Differences are taken in float64, and of short integers in int32 (exact for every integer type,
    and for float32 unless the two heights are more than 2^29 times apart), and multiplied by
    `scale` afterwards.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self._scale = abs(scale)
        self._n_valid = 0
        self._squares = 0.0
        self._largest = 0.0
        self._worst: tuple[int, int] | None = None
        self._n_mask_differences = 0

    def add(
        self,
        row: int,
        col: int,
        original: np.ndarray,
        decoded: np.ndarray,
        valid: np.ndarray,
        decoded_valid: np.ndarray,
        n_alike: int = 1,
    ) -> np.ndarray:
        """Add a window; a sample stands for `n_alike`. Return unscaled absolute differences."""
        both = valid & decoded_valid
        n_both, n_one = np.count_nonzero(both), np.count_nonzero(valid != decoded_valid)
        self._n_mask_differences += n_alike * int(n_one)
        self._n_valid += n_alike * int(n_both)
        if original.dtype.kind in "iu" and original.dtype.itemsize <= 2:
            differences = _small_differences(original, decoded, both, is_whole=n_both == both.size)
        else:
            differences = _differences(original, decoded, both)
        if not differences.size:
            return differences
        at = int(np.argmax(differences))
        largest = float(differences.flat[at])
        self._squares += n_alike * _sum_of_squares(differences, largest)
        if largest > self._largest:
            self._largest = largest
            at_row, at_col = divmod(at, differences.shape[1])
            self._worst = row + at_row, col + at_col
        return differences

    def is_within(self, bound: float, dtype: np.dtype[Any]) -> bool:
        """Return whether all unscaled differences are within a bound, also rounded to a type."""
        rounded = float(dtype.type(self._largest)) if dtype.kind == "f" else self._largest
        return max(self._largest, rounded) <= bound

    def report(self) -> ErrorReport:
        """Return the report so far."""
        worst_row, worst_col = self._worst or (None, None)
        return ErrorReport(
            n_valid=self._n_valid,
            max_error=self._largest * self._scale,
            rmse=math.sqrt(self._squares / max(self._n_valid, 1)) * self._scale,
            worst_row=worst_row,
            worst_col=worst_col,
            n_mask_differences=self._n_mask_differences,
        )


def _differences(original: np.ndarray, decoded: np.ndarray, both: np.ndarray) -> np.ndarray:
    differences = np.zeros(both.shape, dtype=np.float64)
    # Voids may hold infinities and NaN: they are never subtracted.
    with np.errstate(invalid="ignore"):
        np.subtract(decoded, original, out=differences, where=both, dtype=np.float64)
    np.abs(differences, out=differences)
    # NaN or infinity on one side, which no bound covers and no comparison would find.
    differences[np.isnan(differences)] = np.inf
    return differences


def _small_differences(
    original: np.ndarray, decoded: np.ndarray, both: np.ndarray, *, is_whole: bool
) -> np.ndarray:
    differences: np.ndarray = np.subtract(decoded, original, dtype=np.int32)
    if not is_whole:
        np.copyto(differences, 0, where=~both)
    return np.abs(differences, out=differences)


def _sum_of_squares(differences: np.ndarray, largest: float) -> float:
    if largest == 0:
        return 0.0
    if differences.dtype.kind == "i" and largest**2 * differences.shape[1] < 2**31:
        return float(np.einsum("ij,ij->i", differences, differences).sum(dtype=np.int64))
    return float(np.vdot(differences, differences.astype(np.float64, copy=False)))


if TYPE_CHECKING:
    from terrainwave.verification.mesh_walk import MeshReport

# Largest number of problems of one kind that are listed; further ones are counted.
_MAX_LISTED = 10
_MOST_LISTED = 100

# An integer bound of 8 quanta stored as 0.1 * 8 may read 7.999999999999999 quanta.
_SLACK = Fraction(1, 10**9)


@dataclass(frozen=True)
class VerifyReport:
    """Result of `verify`.

    Attributes
    ----------
    path, original : str or None
        The compared files; `original` is None if there was none.
    bound : float
        The bound used for every sample, in physical units.
    max_error, effective_error : float
        The bound requested at compression, and the bound that the file states.
    errors : ErrorReport or None
        Measured errors; None without an original.
    problems : tuple of str
        One sentence each.
    is_strict : bool or None
        True if ``abs(decoded - original) <= bound`` holds for all stored values, exactly and as
        numpy computes it in their type, with the `bound` given or else `max_error`. False without
        problems means that it holds for the decimal numbers that the floats represent: 0.01, 0.02 …
        None without an original.
    mesh : MeshReport or None
        Result for the meshes, if requested.
    earlier : tuple of dict
        The .twz files that the heights went through before, as in `Info`.
    window : tuple of int or None
        With `part`, the compared part of the file: (row, col, n_rows, n_cols); otherwise None.
    root : str or None
        The root of the file's digests, as `Terrain.digest` returns it.
    """

    path: str
    original: str | None
    bound: float
    max_error: float
    effective_error: float
    errors: ErrorReport | None
    problems: tuple[str, ...]
    is_strict: bool | None = None
    mesh: "MeshReport | None" = None
    earlier: tuple[dict[str, Any], ...] = ()
    window: tuple[int, int, int, int] | None = None
    root: str | None = None

    @property
    def ok(self) -> bool:
        """Return whether no problem was found."""
        return not self.problems

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain values for JSON, with ``"ok"``."""
        return {"ok": self.ok, **asdict(self), "problems": list(self.problems)}


def verify(
    twz: str | os.PathLike[str],
    original: str | os.PathLike[str] | None = None,
    *,
    max_error: float | None = None,
    band: int = 1,
    nodata: float | str | None = None,
    heights_are: str | None = None,
    part: bool = False,
    mesh: bool = False,
    root: str | None = None,
    window: Any = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> VerifyReport:
    """Check a .twz file against its original raster, or by itself.

    With `original`: every sample must be within the bound, void where the original is void and only
    there, and size, type, nodata, CRS, transform, units, scale and offset must be the same. Heights
    of another size, type or unit are not compared. Without: all checksums are checked, every block
    of every level is decoded, and heights are compared with the file's digests, if any. That finds
    damage, but not deliberate changes of both heights and digests. To check that the file is the
    published one, give its `root`.

    Parameters
    ----------
    twz : path
        The file to check.
    original : path, optional
        The raster that it was made from.
    max_error : float, optional
        Check this bound, in physical units, instead of the file's own.
    band : int
        The band of `original` that was compressed.
    nodata : float or str, optional
        The `nodata` given at compression, if any.
    heights_are : {"height", "depth", "radius"}, optional
        Meaning of the numbers of `original`; overrides its metadata.
    part : bool
        `original` covers a part of the file, or all of it, on its grid: compare that part only, for
        example after `patch` with the new raster. Size, description and nodata value may differ
        from the file's, as in `patch`.
    mesh : bool
        Check all meshes too: each covers its area once, without gaps, folds and T-junctions;
        neighbours fit; and no sample is further from a mesh than the mesh states.
    root : str, optional
        The published root of the heights (`Terrain.digest`), 64 hexadecimal digits. Not with
        `original`. The file need not have digests.
    window : tuple of int, optional
        Row, column, rows and columns: check this part of the full grid alone, by the digests of the
        squares of 4096 x 4096 samples that it touches. Not with `original` or `mesh`.
    threads : int, optional
        Threads that decode; the number of processors by default.
    progress : callable, optional
        Called with a `Progress` after each window, in samples.

    Returns
    -------
    VerifyReport
        If the file can be opened, problems are in its `problems`, not exceptions.

    Raises
    ------
    InvalidArgumentError
        If `part` comes without `original`, or with `mesh`; `root` with `original`; or `window` with
        one of the last two.
    TerrainwaveError
        If one of the files cannot be opened at all.

    Notes
    -----
    The bound is the file's effective error, which is at most the requested one. Integer heights are
    compared in whole steps, exactly. Float heights on a decimal grid are stored as the float
    nearest to k*p, which is not k*p itself: two of them are each up to half an ulp off, so their
    difference may exceed the bound by one ulp of the larger although the numbers k*p are within it.
    One ulp of the stored type is therefore allowed, only for float files on such a grid and a bound
    above 0; a bound of 0 means equal, and continuous floats get no allowance. A file made with
    `max_error` 0 has the bits of all valid floats, including the sign of -0.0 (except for method
    cdf53, which keeps only numbers). The bits of a NaN that marks a void are neither kept nor
    compared.
    """
    check_flags(part=part, mesh=mesh)
    if part and (original is None or mesh):
        raise InvalidArgumentError(
            f"found `part` {'with `mesh`' if mesh else 'without `original`'}, expected `part` with"
            " the raster of a part of the file: only its heights are compared"
        )
    root = _checked_root(root, original)
    if window is not None and (original is not None or mesh):
        other = "original" if original is not None else "mesh"
        raise InvalidArgumentError(
            f"found `window` with `{other}`, expected one of them: a window is compared with the"
            " file's digests"
        )
    check_callback(progress)
    max_error = checked_error("max_error", max_error)
    band = checked_whole("band", band, least=1)
    nodata_choice(nodata)
    check_kind(heights_are)
    checked_path(twz)
    if original is not None:
        checked_path(original)
    from terrainwave.terrain import Terrain

    # The existing part of a truncated file is checked like the rest.
    on_error = RAISE if original is not None else MASK
    with Terrain(twz, threads=threads, on_error=on_error) as terrain:
        if original is None:
            problems = tuple(_problems_of_bytes(terrain, root, window))
            report = _report(terrain, twz, max_error, original=None, errors=None, problems=problems)
            return _with_meshes(report, terrain, None, progress) if mesh else report
        with opened(os.fspath(original)) as dataset:
            check_band(band, dataset.count, str(original))
            whole = terrain.shape if part else None
            raster = Original(dataset, band, nodata, terrain.transform, heights_are, whole)
            remarks = [remark_on_windows(dataset)]
            if any(raster.turn):
                remarks.append(
                    "rows or columns are stored in another order than in the file; turned to its"
                    " order"
                )
            for remark in filter(None, remarks):
                warnings.warn(f"{original}: {remark}", TerrainwaveWarning, stacklevel=2)
            found = _Comparison(terrain, raster, max_error, part).run(progress)
            report = _report(terrain, twz, max_error, original=os.fspath(original), **found)
            if not mesh or report.errors is None:  # of another size, type or unit
                return report
            return _with_meshes(report, terrain, raster.read, progress)


def _checked_root(root: Any, original: Any) -> str | None:
    """Return a root in small letters."""
    if root is None:
        return None
    if original is not None:
        raise InvalidArgumentError(
            "found `root` with `original`, expected one of them: the root stands for the file's"
            " heights, not for the original's"
        )
    if not isinstance(root, str) or not re.fullmatch("[0-9a-fA-F]{64}", root):
        raise InvalidArgumentError(f"found `root` {shown(root)}, expected 64 hexadecimal digits")
    return root.lower()


def _problems_of_bytes(terrain: Any, root: str | None, window: Any) -> Iterator[str]:
    """Yield the problems of a file by itself, each once; of many problems the first and last."""
    missing, n_bytes = terrain.container.n_missing, terrain.container.extents.file_size
    if missing:
        yield f"the file has {n_bytes - missing:,} of its {n_bytes:,} bytes"
    problems = list(dict.fromkeys(terrain.check(root, window)))
    # The lost shares of levels come last.
    n_left_out = len(problems) - _MOST_LISTED - terrain.n_levels
    if n_left_out > 0:
        problems[_MOST_LISTED : -terrain.n_levels] = [f"{n_left_out:,} more like these"]
    yield from problems


def _with_meshes(
    report: VerifyReport, terrain: Any, read: Any, progress: ProgressCallback | None
) -> VerifyReport:
    """Add the checks of meshes to a report, unless heights cannot be read."""
    # Imported here: numba.
    from terrainwave.verification.mesh_walk import MeshVerification

    checked, problems = MeshVerification(
        terrain, None if read is None else lambda region: read(*region), progress
    ).run()
    return replace(report, mesh=checked, problems=(*report.problems, *problems))


def _report(terrain: Any, twz: Any, max_error: float | None, **found: Any) -> VerifyReport:
    root = None
    with suppress(CorruptStreamError):  # which the check of the file reports
        root = terrain.digest()
    return VerifyReport(
        path=os.fspath(twz),
        bound=float(terrain.effective_error if max_error is None else max_error),
        max_error=terrain.max_error,
        effective_error=terrain.effective_error,
        earlier=terrain.info().earlier,
        root=root,
        **found,
    )


class _Comparison:
    """Comparison of a decoded file with its original."""

    def __init__(
        self, terrain: Any, original: Original, max_error: float | None, part: bool
    ) -> None:
        self._terrain, self._original, self._part = terrain, original, part
        self._dtype, self._scale = original.dtype, original.scale
        # The raster of a part may have another one.
        self._nodata = terrain.nodata if part else original.nodata
        self._bound = float(terrain.effective_error if max_error is None else max_error)
        self._strict_bound = float(terrain.max_error if max_error is None else max_error)
        self._even = terrain.even_blocks()
        # Samples that the index of both files knows to be void.
        self._n_known = 0
        # By heights of the file and the original: their first region, and the number of samples.
        self._alike: dict[tuple[int, bytes], tuple[Region, int]] = {}

    def run(self, progress: ProgressCallback | None) -> dict[str, Any]:
        """Return the fields of the report."""
        terrain = self._terrain
        problems = list(metadata_problems(terrain, self._original, part=self._part))
        errors, is_strict, window = None, None, None
        if self._part:
            elsewhere = place_problem(terrain, self._original)
            problems += [elsewhere] * bool(elsewhere)
            is_same = not elsewhere
        else:
            is_same = tuple(terrain.shape) == self._original.shape
        is_same &= np.dtype(terrain.dtype) == self._dtype
        if is_same and not unit_problem(terrain, self._original):
            window = self._original.place if self._part else None
            measured, height_problems = self._compare_heights(progress)
            problems += height_problems
            errors = measured.report()
            bound = self._strict_bound / abs(self._scale or 1.0)
            is_strict = measured.is_within(bound, self._dtype)
        return {
            "errors": errors,
            "problems": tuple(problems),
            "is_strict": is_strict,
            "window": window,
        }

    def _compare_heights(self, progress: ProgressCallback | None) -> tuple[ErrorSum, list[str]]:
        errors = ErrorSum(self._scale)
        beyond = _Worst()
        signs, wrong_side, keeps_signs = _Counted(), _Counted(), self._keeps_signs()
        word = self._terrain.header.bound_side
        side = self._terrain.raster_info.stored_side(word)
        unreadable: list[str] = []
        n_taken = n_done = 0
        total = math.prod(self._original.shape)

        def report(n_done: int) -> None:
            if progress is not None:
                progress(Progress("verify", n_done, total, n_done * self._dtype.itemsize))

        for (row, col, n_rows, n_cols), n_alike in self._windows():
            original, valid = self._original.read(row, col, n_rows, n_cols)
            try:
                decoded = self._terrain.read(window=(row, col, n_rows, n_cols), masked=True)
            except TerrainwaveError as error:
                unreadable.append(
                    f"{place_text(row, col, n_rows, n_cols)} cannot be decoded: {error}"
                )
                continue
            heights, decoded_valid = np.ma.getdata(decoded), ~np.ma.getmaskarray(decoded)
            both = valid & decoded_valid
            differences = errors.add(row, col, original, heights, valid, decoded_valid, n_alike)
            beyond.add_beyond(
                row, col, differences, self._allowed(original, heights, both), n_alike
            )
            if keeps_signs:
                zeros = both & (original == 0) & (heights == 0)
                differ = zeros & (np.signbit(original) != np.signbit(heights))
                signs.add(row, col, differ, n_alike)
            if side:
                is_wrong = heights < original if side > 0 else heights > original
                wrong_side.add(row, col, both & is_wrong, n_alike)
            is_taken = self._original.equals(heights, self._nodata) & decoded_valid
            n_taken += n_alike * int(np.count_nonzero(is_taken))
            n_done += n_alike * n_rows * n_cols
            report(n_done + self._n_known)
        report(total)
        if len(unreadable) > _MAX_LISTED:
            n_more = len(unreadable) - _MAX_LISTED
            unreadable[_MAX_LISTED:] = [f"… and {n_more} more windows like these"]
        problems = [
            *unreadable,
            *self._mask_problems(errors.report(), n_taken),
            *beyond.problems_beyond(self._scale, self._bound),
            *signs.problems(_OTHER_ZEROS),
            *wrong_side.problems(f"not {word} the original, {{first}}, against the file's bound"),
        ]
        return errors, problems

    def _windows(self) -> Iterator[tuple[Region, int]]:
        """Yield windows to compare, and the number of samples that each sample represents.

        Windows that are void by the index of both files are left out.
        """
        for window, even in self._original.windows():
            if even is None:
                yield window, 1
                continue
            for part, known in even_parts(window, self._original.side, partial(self._known, even)):
                if known is None:
                    yield from ((one, 1) for one in part.tiles(*self._original.window_shape))
                elif not known.is_valid:
                    self._n_known += part.n_rows * part.n_cols
                else:
                    heights = known.value, even.value.tobytes()
                    first, n_before = self._alike.get(heights, (part, 0))
                    self._alike[heights] = first, n_before + part.n_rows * part.n_cols
        for first, n_alike in self._alike.values():
            yield first._replace(n_rows=1, n_cols=1), n_alike

    def _known(self, even: Even, region: Region) -> Even | None:
        """Return the file's content of an even region of the original: void, or one height."""
        if not even.is_valid:
            return even if self._is_void(region) else None
        try:
            height = None if self._even is None else self._even.own(region)
        except TerrainwaveError:  # reading there raises
            return None
        return None if height is None else Even(height, True)

    def _is_void(self, region: Region) -> bool:
        try:
            return next(self._terrain.coded_parts(region), None) is None
        except TerrainwaveError:  # reading there raises
            return False

    def _keeps_signs(self) -> bool:
        """Return whether the file must keep every bit, including that of -0.0."""
        method = METHODS[self._terrain.info().method]
        is_exact = self._terrain.max_error == 0 == self._bound
        return self._dtype.kind == "f" and is_exact and method.has_remainders

    def _mask_problems(self, report: ErrorReport, n_taken: int) -> Iterator[str]:
        if report.n_mask_differences:
            yield (
                f"{report.n_mask_differences} samples are void in one of the two and valid in the"
                " other"
            )
        if n_taken:
            yield f"{n_taken} valid samples decode to the nodata value {self._nodata!r}"

    def _allowed(self, original: np.ndarray, decoded: np.ndarray, both: np.ndarray) -> Any:
        """Return the largest allowed unscaled difference, a number or one per sample."""
        scale = Fraction(repr(self._scale)) if self._scale else Fraction(1)
        bound = Fraction(repr(self._bound)) / abs(scale)
        if self._dtype.kind != "f":
            return float(math.floor(bound + _SLACK))
        allowed = float(bound)
        # Division by the scale may have rounded down.
        if self._scale != 1:
            allowed = math.nextafter(allowed, math.inf)
        if self._bound == 0 or self._terrain.info().rounding_error > 0:
            return allowed
        zeros = np.zeros(both.shape, self._dtype)
        largest = np.maximum(
            np.abs(np.where(both, original, zeros)), np.abs(np.where(both, decoded, zeros))
        )
        with np.errstate(over="ignore", invalid="ignore"):
            ulps = np.spacing(largest).astype(np.float64)
        # Infinities have no ulp, nor has the largest number.
        return allowed + np.where(np.isfinite(ulps), ulps, 0.0)


class _Counted:
    """Counts samples of a kind, and keeps the first."""

    def __init__(self) -> None:
        self._count = self._row = self._col = 0

    def add(self, row: int, col: int, found: np.ndarray, n_alike: int) -> None:
        if found.any() and not self._count:
            at_row, at_col = np.argwhere(found)[0].tolist()
            self._row, self._col = row + at_row, col + at_col
        self._count += n_alike * int(np.count_nonzero(found))

    @property
    def _samples(self) -> str:
        return "1 sample is" if self._count == 1 else f"{self._count} samples are"

    def problems(self, words: str) -> Iterator[str]:
        if self._count:
            place = f"the first at row {self._row}, column {self._col}"
            yield f"{self._samples} {words.format(first=place)}"


_OTHER_ZEROS = (
    "0.0 in one of the two and -0.0 in the other, {first}, though `max_error` 0 keeps every bit:"
    " compress the original again"
)


class _Worst(_Counted):
    """Counts samples beyond their allowance and keeps the worst."""

    _excess = _difference = 0.0

    def add_beyond(
        self, row: int, col: int, differences: np.ndarray, allowed: Any, n_alike: int
    ) -> None:
        if np.ndim(allowed) == 0 and differences.max() <= allowed:
            return
        excess = differences - allowed
        self._count += n_alike * int(np.count_nonzero(excess > 0))
        at = int(np.argmax(excess))
        if excess.flat[at] > self._excess:
            at_row, at_col = divmod(at, excess.shape[1])
            self._row, self._col = row + at_row, col + at_col
            self._excess, self._difference = float(excess.flat[at]), float(differences.flat[at])

    def problems_beyond(self, scale: float, bound: float) -> Iterator[str]:
        return self.problems(
            f"further from the original than {bound:.17g}; the worst, at row {self._row}, column"
            f" {self._col}, by {self._difference * abs(scale):.17g}"
        )
