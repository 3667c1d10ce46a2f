"""Sizes, errors and speeds of codecs at equal bounds: what ``benchmarks.bench`` asks for."""

import math
import time
from collections import namedtuple
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from pathlib import Path

import click
import numpy as np

from benchmarks import common
from benchmarks.peers import Codec, stored_size
from benchmarks.rasters import Forms, Raster, load_raster, make_forms, with_nan, without_nan

BOUNDS = (0.0, 0.1, 0.5, 1.0, 3.0, 10.0)  # of all that docs/benchmarks.md compares
# Bounds of rasters of floats, which lidar is kept within.
FINE = (0.001, 0.01, 0.05, 0.1)
# Speeds are of rasters of so many samples; larger ones take JPEG XL too long.
SPEED_SAMPLES = 1_000_000, 20_000_000
SPEED_BOUNDS = 0.0, 1.0, 10.0
# Slow codecs take turns among themselves and with a COG, so that the others are run more often.
SLOW = ("sperr", "jxl-e7", "terrainwave-predictive", "terrainwave-cdf97")
SPEED_RUNS = {False: 5, True: 1}
NOT_POSSIBLE = "not possible"
OWN_MASK = "own mask"
NAN = "NaN"

# One line of a CSV of sizes; errors are in the raster's units. `bits_per_sample` counts all samples
# of the grid, voids too. `problem` is empty, or says what went wrong; figures may be missing then.
Row = namedtuple(
    "Row",
    "raster n_rows n_cols dtype valid_share quantum codec max_error n_bytes bits_per_sample "
    "measured_error rmse fill margin problem",
    defaults=(None,) * 4 + ("", None, ""),
)
# Distance of decoded heights from the originals, over valid samples.
Errors = namedtuple("Errors", "measured_error rmse problem")
# One setting of a codec: which fill, which margin, what came of it.
Trial = namedtuple("Trial", "codec max_error raster fill margin stored n_bytes errors")
# One line of ``speeds.csv``; speeds in 10^6 samples/s of processor time, on one thread. The codecs
# of a raster, a bound, a value of `is_slow` and a processor took turns.
SpeedRow = namedtuple(
    "SpeedRow",
    "raster max_error codec is_slow n_samples bits_per_sample encode_speed decode_speed n_runs "
    "processor",
)


def has_failed(row: Row) -> bool:
    """Return whether something is wrong; a case a codec is not made for is not."""
    return bool(row.problem) and not row.problem.startswith(NOT_POSSIBLE)


def measure(codec: Codec, forms: Forms, max_error: float) -> Row:
    """Return the row of one case, its bound checked by decoding; it says if the codec raised."""
    raster = forms.raster
    valid_share = round(float(raster.mask.mean()), 6)
    row = Row(
        raster.name, *raster.heights.shape, raster.heights.dtype.name, valid_share,
        raster.quantum, codec.name, max_error,
    )  # fmt: skip
    reason = codec.refuses(raster, max_error)
    if reason:
        return row._replace(problem=f"{NOT_POSSIBLE}: {reason}")
    try:
        best = best_trial(codec, forms, max_error)
    except Exception as error:  # noqa: BLE001 - one codec's fault must not end the others'
        return row._replace(problem=f"FAILED: {type(error).__name__}: {error}")
    return Row(
        *row[:8], best.n_bytes, round(8 * best.n_bytes / raster.heights.size, 5),
        best.errors.measured_error, float(f"{best.errors.rmse:.5g}"), best.fill, best.margin,
        best.errors.problem,
    )  # fmt: skip


def best_trial(codec: Codec, forms: Forms, max_error: float) -> Trial:
    """Return the smallest trial that keeps the bound; the last one if none does."""
    trials = []
    for fill, filled, extra in _forms_for(codec, forms):
        for margin in codec.margins:
            encode, decode, heights = codec.calls(filled, max_error, margin)
            stored = encode()
            decoded = heights(decode(stored))
            errors = _errors_of(forms.raster, fill, decoded, max_error)
            n_bytes = stored_size(stored) + extra
            trials.append(Trial(codec, max_error, filled, fill, margin, stored, n_bytes, errors))
            if not errors.problem:
                break
    kept = [trial for trial in trials if not trial.errors.problem]
    best = min(kept, key=lambda trial: trial.n_bytes) if kept else trials[-1]
    if best is not trials[-1]:  # its file has been written over
        best = best._replace(stored=codec.calls(best.raster, max_error, best.margin).encode())
    return best


def _forms_for(codec: Codec, forms: Forms) -> Iterator[tuple[str, Raster, int]]:
    if codec.knows_voids:
        yield OWN_MASK, forms.raster, 0
    is_whole = codec.knows_voids and forms.raster.mask.all()
    if codec.takes_fills and not is_whole:
        for name, filled in forms.fills:
            yield name, filled, forms.mask_bytes
    if codec.takes_nan(forms.raster) and not forms.raster.mask.all():
        yield NAN, with_nan(forms.raster), 0


def _errors_of(raster: Raster, fill: str, decoded: np.ndarray, max_error: float) -> Errors:
    if fill == NAN:
        valid = without_nan(decoded, raster)
        if valid is None:
            return Errors(math.inf, math.inf, "MASK DIFFERS")
        decoded = valid
    return compare(raster, decoded, max_error, check_voids=fill == OWN_MASK)


def compare(raster: Raster, decoded: np.ndarray, max_error: float, *, check_voids: bool) -> Errors:
    """Compare every valid sample, in float64; with `check_voids` the mask, too."""
    if decoded.shape != raster.heights.shape or decoded.dtype != raster.heights.dtype:
        return Errors(math.inf, math.inf, f"decoded to {decoded.dtype} {decoded.shape}")
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
    is_nan = raster.nodata is None or math.isnan(raster.nodata)
    is_void = np.isnan(decoded) if is_nan else decoded == raster.nodata
    return bool(np.array_equal(is_void, ~raster.mask))


def read_cases(path: Path) -> set[tuple[str, float, str]]:
    """Return the (raster, bound, codec) a CSV holds; none if there is no such file."""
    return {(row["raster"], row["max_error"], row["codec"]) for row in common.read_rows(path)}


def is_worth_trying(raster: Raster, bound: float) -> bool:
    """Return False for 0 on no grid, and for 0.1 on integers, where it is 0 once more."""
    return not (raster.is_integer and bound < 1) if bound else raster.quantum > 0


def measure_missing(
    paths: Sequence[Path], codecs: Sequence[Codec], bounds: Sequence[float],
    done: Collection[tuple[str, float, str]] = (),
) -> Iterator[Row]:  # fmt: skip
    """Yield the cases that are not done."""
    for path in paths:
        raster = load_raster(path)
        missing = [
            (codec, bound)
            for bound in bounds
            for codec in codecs
            if is_worth_trying(raster, bound) and (raster.name, bound, codec.name) not in done
        ]
        forms = make_forms(raster) if missing else None  # takes long where there are voids
        for codec, bound in missing:
            yield measure(codec, forms, bound)


def measure_speeds(
    paths: Sequence[Path], results: Path, codecs: Sequence[Codec]
) -> Iterator[SpeedRow]:
    """Yield the speeds on this processor that ``speeds.csv`` lacks."""
    done = {
        (row["raster"], row["max_error"])
        for row in common.read_rows(results / "speeds.csv")
        if (row["codec"], row["processor"]) == (codecs[-1].name, common.processor())
    }
    for raster in map(load_raster, paths):
        if not SPEED_SAMPLES[0] <= raster.heights.size <= SPEED_SAMPLES[1]:
            continue
        forms = make_forms(raster)
        for bound in SPEED_BOUNDS:
            if (raster.name, bound) in done or not is_worth_trying(raster, bound):
                continue
            # The best trial checks the bound.
            able = [codec for codec in codecs if not codec.refuses(raster, bound)]
            trials = [best_trial(codec, forms, bound) for codec in able]
            fast, slow = (
                [trial for trial in trials if trial.codec.name.startswith(SLOW) == is_slow]
                for is_slow in (False, True)
            )
            yield from _speeds(fast, is_slow=False)
            if slow:
                cog = next(trial for trial in fast if trial.codec.name == "cog")
                yield from _speeds([cog, *slow], is_slow=True)


def _speeds(trials: Sequence[Trial], *, is_slow: bool) -> Iterator[SpeedRow]:
    tasks = []
    for trial in trials:  # `best_trial` has run both calls, which compiles and loads what they need
        encode, decode, _ = trial.codec.calls(trial.raster, trial.max_error, trial.margin)
        tasks += [encode, partial(decode, trial.stored)]
    times = iter(common.take_turns(lambda: tasks, SPEED_RUNS[is_slow], clock=time.process_time))
    for trial, encode, decode in zip(trials, times, times, strict=True):
        if trial.errors.problem:
            raise RuntimeError(f"{trial.raster.name}, {trial.codec.name}: {trial.errors}")
        n = trial.raster.heights.size
        yield SpeedRow(
            trial.raster.name, trial.max_error, trial.codec.name, is_slow, n,
            round(8 * trial.n_bytes / n, 5), round(n / encode.seconds / 1e6, 2),
            round(n / decode.seconds / 1e6, 2), encode.n_runs, common.processor(),
        )  # fmt: skip


def exit_with_failures(rows: Sequence[Row]) -> None:
    """Say what failed; exit with 1 if anything did."""
    failed = [row for row in rows if has_failed(row)]
    for row in failed:
        click.echo(f"{row.raster} at {row.max_error:g}, {row.codec}: {row.problem}")
    click.echo(f"{len(rows)} cases, {len(failed)} failed")
    raise SystemExit(bool(failed))
