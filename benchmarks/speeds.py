"""Speeds of terrainwave beside SPERR's at low rates: the part `speeds` of ``benchmarks.bench``.

Cases: rasters of at least 10^6 samples, bounds at which `predictive` takes at most 1 bit/sample.
Seconds are the process's processor time on one core, kernels warm, median of some runs that take
turns with SPERR's; terrainwave goes through files, SPERR stays in memory.
"""

import csv
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from benchmarks.measure import OWN_MASK, Trial, best_trial
from benchmarks.peers import Codec, make_codecs
from benchmarks.rasters import load_raster, make_forms
from benchmarks.report import CsvSink, read_cases

METHODS = ("predictive-fast", "predictive", "cdf97")
MIN_SAMPLES = 1_000_000
MAX_BITS = 1.0
N_ROUNDS = 5
PATIENCE = 40.0


@dataclass(frozen=True)
class Row:
    """One line of the CSV; speeds in 10^6 samples/s of processor time."""

    raster: str
    max_error: float
    codec: str
    n_samples: int
    bits_per_sample: float
    encode_speed: float
    decode_speed: float
    n_runs: int


def find_cases(results: Path) -> list[tuple[str, float]]:
    """Return (raster, bound) of the cases, from ``predictive.csv``."""
    with (results / "predictive.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["codec"] == "terrainwave-predictive"]
    return [
        (row["raster"], float(row["max_error"]))
        for row in rows
        if row["bits_per_sample"]
        and float(row["bits_per_sample"]) <= MAX_BITS
        and int(row["n_rows"]) * int(row["n_cols"]) >= MIN_SAMPLES
        and not (row["dtype"].startswith("int") and 0 < float(row["max_error"]) < 1)
    ]


def measure_all(console: Console, paths: list[Path], results: Path, folder: Path) -> None:
    """Measure the cases that ``speeds.csv`` lacks."""
    out = results / "speeds.csv"
    done = read_cases(out)
    codecs = [*make_codecs("sperr", [], folder), *make_codecs("terrainwave", METHODS, folder)]
    cases = find_cases(results)
    with CsvSink(out, Row, append=True) as sink:
        for path in paths:
            bounds = [
                bound
                for raster, bound in cases
                if raster == path.stem and (raster, bound, codecs[-1].name) not in done
            ]
            if not bounds:
                continue
            forms = make_forms(load_raster(path))
            for bound in bounds:
                # The best trial warms everything up and checks the bound.
                trials = [best_trial(codec, forms, bound) for codec in codecs]
                for row in time_in_turns(codecs, trials, bound):
                    sink.write(row)
                    console.print(
                        f"{row.raster} at {bound:g}, {row.codec}: encode {row.encode_speed:.1f},"
                        f" decode {row.decode_speed:.1f} Msamples/s",
                        markup=False,
                        highlight=False,
                    )


def time_in_turns(codecs: list[Codec], trials: list[Trial], bound: float) -> list[Row]:
    """Return the rows of one case; the codecs take turns, so that all see the same machine."""
    encodes: list[list[float]] = [[] for _ in codecs]
    decodes: list[list[float]] = [[] for _ in codecs]
    begin = time.perf_counter()
    while len(encodes[0]) < N_ROUNDS and (
        len(encodes[0]) < 1 or time.perf_counter() - begin < PATIENCE
    ):
        for i, (codec, trial) in enumerate(zip(codecs, trials, strict=True)):
            codec.prepare(trial.raster)
            encode = partial(codec.encode, trial.raster, bound, trial.margin)
            decode = partial(codec.decode, trial.stored, trial.raster, bound)
            encodes[i].append(_seconds(encode))
            decodes[i].append(_seconds(decode))
    rows = []
    for i, (codec, trial) in enumerate(zip(codecs, trials, strict=True)):
        if trial.errors.problem:
            raise RuntimeError(f"{trial.raster.name} at {bound:g}, {codec.name}: {trial.errors}")
        assert trial.fill == OWN_MASK or not codec.knows_voids
        n = trial.raster.heights.size
        rows.append(
            Row(
                raster=trial.raster.name,
                max_error=bound,
                codec=codec.name,
                n_samples=n,
                bits_per_sample=round(8 * trial.n_bytes / n, 5),
                encode_speed=round(n / statistics.median(encodes[i]) / 1e6, 2),
                decode_speed=round(n / statistics.median(decodes[i]) / 1e6, 2),
                n_runs=len(encodes[i]),
            )
        )
    return rows


def _seconds(run: Callable[[], object]) -> float:
    begin = time.process_time()
    run()
    return time.process_time() - begin
