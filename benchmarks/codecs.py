"""Compare codecs at equal error bounds: ``python -m benchmarks.codecs --help``.

`measure_speeds` is the part `speeds` of ``benchmarks.bench``: all codecs in turns, terrainwave and
COGs through files, the others in memory.

Exit status: 0 good; 1 if a codec broke a bound or failed; 2 wrong usage.
"""

import math
import time
from collections import namedtuple
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from pathlib import Path

import click
import numpy as np

from benchmarks import common
from benchmarks.peers import NAMES, Codec, make_codecs, stored_size
from benchmarks.rasters import Forms, Raster, load_raster, make_forms, with_nan, without_nan

BOUNDS = (0.0, 0.1, 0.5, 1.0, 3.0, 10.0)  # of all that docs/benchmarks.md compares
# Speeds are of rasters of so many samples; larger ones take JPEG XL too long.
SPEED_SAMPLES = 1_000_000, 20_000_000
SPEED_BOUNDS = 0.0, 1.0, 10.0
SPEED_RUNS, SPEED_PATIENCE = 3, 20.0
PATIENCE = 60.0  # seconds after which no further run is begun
NOT_POSSIBLE = "not possible"
OWN_MASK = "own mask"
NAN = "NaN"

# One line of the CSV. Errors are in the raster's units, speeds in 10^6 samples/s. `bits_per_sample`
# counts every sample of the grid, voids too. `n_runs` is how many runs the speeds are the median
# of; the first run of each is never among them. `problem` is empty, or says what went wrong; the
# figures may be missing then.
Row = namedtuple(
    "Row",
    "raster n_rows n_cols dtype valid_share quantum codec max_error n_bytes bits_per_sample "
    "measured_error rmse encode_speed decode_speed n_runs fill margin problem",
    defaults=(None,) * 7 + ("", None, ""),
)
# Distance of decoded heights from the originals, over valid samples.
Errors = namedtuple("Errors", "measured_error rmse problem")
# One setting of a codec: which fill, which margin, what came of it.
Trial = namedtuple("Trial", "codec max_error raster fill margin stored n_bytes errors")
# One line of ``speeds.csv``; speeds in 10^6 samples/s, of processor time where one thread runs.
SpeedRow = namedtuple(
    "SpeedRow",
    "raster max_error codec threads n_samples bits_per_sample encode_speed decode_speed n_runs",
)


def has_failed(row: Row) -> bool:
    """Return whether something is wrong; a case a codec is not made for is not."""
    return bool(row.problem) and not row.problem.startswith(NOT_POSSIBLE)


def measure(codec: Codec, forms: Forms, max_error: float, n_runs: int) -> Row:
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
        return Row(*row[:8], *_figures(codec, forms, max_error, n_runs))
    except Exception as error:  # noqa: BLE001 - one codec's fault must not end the others'
        return row._replace(problem=f"FAILED: {type(error).__name__}: {error}")


def _figures(codec: Codec, forms: Forms, max_error: float, n_runs: int) -> tuple:
    best = best_trial(codec, forms, max_error)
    encode, decode = time_trials([best], n_runs, patience=PATIENCE, clock=time.perf_counter)
    n_samples = forms.raster.heights.size
    speeds = (_round_to(n_samples / timed.seconds / 1e6, 3) for timed in (encode, decode))
    return (
        best.n_bytes, round(8 * best.n_bytes / n_samples, 5), best.errors.measured_error,
        _round_to(best.errors.rmse, 5), *speeds, encode.n_runs, best.fill, best.margin,
        best.errors.problem,
    )  # fmt: skip


def time_trials(trials: Sequence[Trial], n_runs: int, **how) -> list[common.Timed]:
    """Return what encoding and decoding of each trial take, in turns; all are warm."""
    tasks = []
    for codec, max_error, raster, _fill, margin, stored, *_ in trials:
        codec.prepare(raster)
        tasks += [
            partial(codec.encode, raster, max_error, margin),
            partial(codec.decode, stored, raster, max_error),
        ]
    return common.take_turns(lambda: tasks, n_runs, **how)


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
            trials.append(Trial(codec, max_error, filled, fill, margin, stored, n_bytes, errors))
            if not errors.problem:
                break
    kept = [trial for trial in trials if not trial.errors.problem]
    return min(kept, key=lambda trial: trial.n_bytes) if kept else trials[-1]


def _forms_for(codec: Codec, forms: Forms) -> Iterator[tuple[str, Raster, int]]:
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
    if fill != NAN:
        return compare(raster, decoded, max_error, check_voids=codec.knows_voids)
    valid = without_nan(decoded, raster)
    if valid is None:
        return Errors(math.inf, math.inf, "MASK DIFFERS")
    return compare(raster, valid, max_error, check_voids=False)


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


def _round_to(number: float, n_digits: int) -> float:
    return float(f"{number:.{n_digits}g}")


def read_cases(path: Path) -> set[tuple[str, float, str]]:
    """Return the (raster, bound, codec) a CSV holds; none if there is no such file."""
    return {(row["raster"], row["max_error"], row["codec"]) for row in common.read_rows(path)}


def is_worth_trying(raster: Raster, bound: float, bounds: Sequence[float]) -> bool:
    """Return False for 0 on no grid, and for 0.1 on integers where 0 is tried anyway."""
    if bound == 0:
        return raster.quantum > 0
    return not (raster.is_integer and bound < 1 and 0 in bounds)


def measure_missing(
    paths: Sequence[Path], codecs: Sequence[Codec], bounds: Sequence[float], n_runs: int,
    done: Collection[tuple[str, float, str]] = (), crop: int | None = None,
) -> Iterator[Row]:  # fmt: skip
    """Yield the cases that are not done."""
    for path in paths:
        raster = load_raster(path, crop)
        missing = [
            (codec, bound)
            for bound in bounds
            for codec in codecs
            if is_worth_trying(raster, bound, bounds)
            and (raster.name, bound, codec.name) not in done
        ]
        forms = make_forms(raster) if missing else None  # takes long where there are voids
        for codec, bound in missing:
            yield measure(codec, forms, bound, n_runs)


def measure_speeds(
    paths: Sequence[Path], results: Path, codecs: Sequence[Codec]
) -> Iterator[SpeedRow]:
    """Yield the speeds that ``speeds.csv`` lacks."""
    done = {case[:2] for case in read_cases(results / "speeds.csv") if case[2] == codecs[-1].name}
    for raster in map(load_raster, paths):
        if not SPEED_SAMPLES[0] <= raster.heights.size <= SPEED_SAMPLES[1]:
            continue
        forms = make_forms(raster)
        for bound in SPEED_BOUNDS:
            if (raster.name, bound) in done or not is_worth_trying(raster, bound, SPEED_BOUNDS):
                continue
            # The best trial warms everything up and checks the bound.
            able = [codec for codec in codecs if not codec.refuses(raster, bound)]
            trials = [best_trial(codec, forms, bound) for codec in able]
            for threads in sorted({codec.threads for codec in able}):
                yield from _speeds([trial for trial in trials if trial.codec.threads == threads])


def _speeds(trials: Sequence[Trial]) -> Iterator[SpeedRow]:
    threads = trials[0].codec.threads
    common.pin_to_cores(threads)
    clock = time.process_time if threads == 1 else time.perf_counter
    times = iter(time_trials(trials, SPEED_RUNS, patience=SPEED_PATIENCE, clock=clock))
    common.pin_to_cores()
    for trial, encode, decode in zip(trials, times, times, strict=True):
        if trial.errors.problem:
            raise RuntimeError(f"{trial.raster.name}, {trial.codec.name}: {trial.errors}")
        n = trial.raster.heights.size
        yield SpeedRow(
            trial.raster.name, trial.max_error, trial.codec.name, threads, n,
            round(8 * trial.n_bytes / n, 5), round(n / encode.seconds / 1e6, 2),
            round(n / decode.seconds / 1e6, 2), encode.n_runs,
        )  # fmt: skip


def exit_with_failures(rows: Sequence[Row]) -> None:
    """Say what failed; exit with 1 if anything did."""
    failed = [row for row in rows if has_failed(row)]
    for row in failed:
        click.echo(f"{row.raster} at {row.max_error:g}, {row.codec}: {row.problem}")
    click.echo(f"{len(rows)} cases, {len(failed)} failed")
    raise SystemExit(bool(failed))


@common.command("codecs.csv")
@common.rasters_argument
@common.bounds_option(0.0, 1.0, 3.0, 10.0)
@common.option("--codecs", "names", cls=common.ListOption, type=click.Choice(NAMES), default=NAMES)
@common.option(
    "--method", "methods", cls=common.ListOption, default=("cdf97", "store"), help="terrainwave's."
)
@common.crop_option
@common.option("--runs", type=common.COUNT, default=3, help="Timed, after one that is not.")
def main(paths, bounds, names, methods, crop, runs, folder, out) -> None:
    """Compare codecs."""
    common.pin_to_cores()
    codecs = make_codecs(names, methods, folder)
    cases = measure_missing(paths, codecs, bounds, runs, crop=crop)
    exit_with_failures(common.write_rows(out, cases))


if __name__ == "__main__":
    main()
