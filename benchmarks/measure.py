"""Run one codec on one case: choose its best setting, check the bound, then time it."""

import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.peers import Codec, Stored, stored_size
from benchmarks.rasters import Forms, Raster, with_nan, without_nan

NOT_POSSIBLE = "not possible"
OWN_MASK = "own mask"
NAN = "NaN"


@dataclass(frozen=True)
class Row:
    """One line of the CSV. Errors are in the raster's units, speeds in 10^6 samples/s.

    `bits_per_sample` counts every sample of the grid, voids too. `n_runs` is how many
    runs the speeds are the median of; the first run of each is never among them.
    `problem` is empty, or says what went wrong; the figures may be missing then.
    """

    raster: str
    n_rows: int
    n_cols: int
    dtype: str
    valid_share: float
    quantum: float
    codec: str
    max_error: float
    n_bytes: int | None = None
    bits_per_sample: float | None = None
    measured_error: float | None = None
    rmse: float | None = None
    encode_speed: float | None = None
    decode_speed: float | None = None
    n_runs: int | None = None
    fill: str = ""
    margin: float | None = None
    problem: str = ""

    @property
    def failed(self) -> bool:
        """True if something is wrong; a case a codec is not made for is not."""
        return bool(self.problem) and not self.problem.startswith(NOT_POSSIBLE)


@dataclass(frozen=True)
class Errors:
    """Distance of decoded heights from the originals, over valid samples."""

    measured_error: float
    rmse: float
    problem: str


@dataclass(frozen=True)
class Trial:
    """One setting of a codec: which fill, which margin, what came of it."""

    raster: Raster
    fill: str
    margin: float
    stored: Stored
    n_bytes: int
    errors: Errors


@dataclass(frozen=True)
class Timing:
    """How often to run: `n_runs` times, fewer when that would take over `patience` s."""

    n_runs: int = 3
    patience: float = 60.0


def row_head(raster: Raster, codec: str, max_error: float) -> dict[str, Any]:
    """Return the fields of a `Row` that say which case it is."""
    n_rows, n_cols = raster.heights.shape
    return {
        "raster": raster.name,
        "n_rows": n_rows,
        "n_cols": n_cols,
        "dtype": raster.heights.dtype.name,
        "valid_share": round(float(raster.mask.mean()), 6),
        "quantum": raster.quantum,
        "codec": codec,
        "max_error": max_error,
    }


def measure(codec: Codec, forms: Forms, max_error: float, timing: Timing) -> Row:
    """Return the row of one case. The bound is checked by decoding, always."""
    raster = forms.raster
    head = row_head(raster, codec.name, max_error)
    reason = codec.refuses(raster, max_error)
    if reason:
        return Row(**head, problem=f"{NOT_POSSIBLE}: {reason}")
    best = best_trial(codec, forms, max_error)
    codec.prepare(best.raster)

    def encode() -> Stored:
        return codec.encode(best.raster, max_error, best.margin)

    def decode() -> np.ndarray:
        return codec.decode(best.stored, best.raster, max_error)

    encode_s, n_encodes = _median_seconds(encode, timing)
    decode_s, n_decodes = _median_seconds(decode, timing)
    n_samples = raster.heights.size
    return Row(
        **head,
        n_bytes=best.n_bytes,
        bits_per_sample=round(8 * best.n_bytes / n_samples, 5),
        measured_error=best.errors.measured_error,
        rmse=_round_to(best.errors.rmse, 5),
        encode_speed=_round_to(n_samples / encode_s / 1e6, 3),
        decode_speed=_round_to(n_samples / decode_s / 1e6, 3),
        n_runs=min(n_encodes, n_decodes),
        fill=best.fill,
        margin=best.margin,
        problem=best.errors.problem,
    )


def best_trial(codec: Codec, forms: Forms, max_error: float) -> Trial:
    """Return the smallest trial that keeps the bound; the last one if none does.

    These runs also warm the codec up: they compile and load what it needs.
    """
    trials = []
    for fill, filled, extra in _forms_for(codec, forms):
        codec.prepare(filled)
        for margin in codec.margins:
            stored = codec.encode(filled, max_error, margin)
            decoded = codec.decode(stored, filled, max_error)
            errors = _errors_of(codec, forms.raster, fill, decoded, max_error)
            n_bytes = stored_size(stored) + extra
            trials.append(Trial(filled, fill, margin, stored, n_bytes, errors))
            if not errors.problem:
                break
    kept = [trial for trial in trials if not trial.errors.problem]
    return min(kept, key=lambda trial: trial.n_bytes) if kept else trials[-1]


def _forms_for(codec: Codec, forms: Forms) -> Iterator[tuple[str, Raster, int]]:
    """Yield the forms a codec may be given: name, raster, bytes charged for the mask."""
    if codec.knows_voids:
        yield OWN_MASK, forms.raster, 0
        return
    for name, filled in forms.fills:
        yield name, filled, forms.mask_bytes
    if codec.takes_nan and not forms.raster.mask.all():
        yield NAN, with_nan(forms.raster), 0


def _errors_of(
    codec: Codec, raster: Raster, fill: str, decoded: np.ndarray, max_error: float
) -> Errors:
    """Compare with the raster as it was before it was filled."""
    if fill != NAN:
        return compare(raster, decoded, max_error, check_voids=codec.knows_voids)
    valid = without_nan(decoded, raster)
    if valid is None:
        return Errors(math.inf, math.inf, "MASK DIFFERS")
    return compare(raster, valid, max_error, check_voids=False)


def compare(raster: Raster, decoded: np.ndarray, max_error: float, *, check_voids: bool) -> Errors:
    """Compare every valid sample, in float64; with `check_voids` the mask, too."""
    if decoded.shape != raster.heights.shape or decoded.dtype != raster.heights.dtype:
        found = f"{decoded.dtype} {decoded.shape}"
        return Errors(math.inf, math.inf, f"decoded to {found}")
    difference = raster.valid.astype(np.float64) - decoded[raster.mask].astype(np.float64)
    measured_error = float(np.abs(difference).max(initial=0.0))
    rmse = math.sqrt(float(np.mean(difference**2))) if difference.size else 0.0
    problem = ""
    # `not <=`: a NaN among the decoded heights must fail.
    if not measured_error <= max_error + raster.slack:
        problem = f"BOUND VIOLATED: {measured_error!r}"
    elif check_voids and not _has_same_voids(raster, decoded):
        problem = "MASK DIFFERS"
    return Errors(measured_error, rmse, problem)


def _has_same_voids(raster: Raster, decoded: np.ndarray) -> bool:
    """Return whether `decoded` holds nodata exactly where the raster has voids."""
    if raster.nodata is None or math.isnan(raster.nodata):
        is_void = np.isnan(decoded)
    else:
        is_void = decoded == raster.nodata
    return bool(np.array_equal(is_void, ~raster.mask))


def _median_seconds(run: Callable[[], object], timing: Timing) -> tuple[float, int]:
    """Return the median time of a run and of how many; the caller has warmed it up."""
    seconds: list[float] = []
    while len(seconds) < max(1, timing.n_runs) and sum(seconds) < timing.patience:
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), len(seconds)


def _round_to(number: float, n_digits: int) -> float:
    """Round to significant digits."""
    return float(f"{number:.{n_digits}g}")
