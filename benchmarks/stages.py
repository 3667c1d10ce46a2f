"""Say what a sample costs in each stage of `predictive`: ``python -m benchmarks.stages dem.tif``.

Stages are functions of the package, timed where they are called, each without the stages it calls
itself; what no stage covers is "rest". The parts of `code_pass` are kernels it calls for each row:
they are run once more on what the pass left, and "samples" is the pass without them. CPU time of
one thread; each stage is the smallest of ``--runs`` runs.

Exit status: 0 good; 2 wrong usage.
"""

import csv
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest import mock

import click
import numba

from benchmarks.lists import ListCommand, ListOption
from benchmarks.machine import describe_machine, pin_to_one_core
from benchmarks.rasters import Raster, find_rasters, load_raster, write_geotiff
from terrainwave.codec import nested
from terrainwave.codec.lattice import PAD

FIELDS = ("raster", "n_samples", "max_error", "effort", "bits_per_sample", "task", "stage")
EFFORTS = ("fast", "default")
# Stage, module, name there. Functions of the same stage may call each other.
STAGES = (
    ("read source", "terrainwave.raster_io.source", "RasterSource.read"),
    ("scan", "terrainwave.grid.quantum", "HeightScan.update"),
    ("quanta", "terrainwave.grid.quantum", "Quantizer.quantize"),
    ("quanta", "terrainwave.grid.quantum", "Quantizer.dequantize"),
    ("pyramid", "terrainwave.write.pyramid", "Pyramid.build"),
    ("pyramid", "terrainwave.write.pyramid", "Pyramid.heights"),
    ("pyramid", "terrainwave.write.pyramid", "Pyramid.mask"),
    ("measure", "terrainwave.write.encoder", "TreeEncoder._measure"),
    ("mask", "terrainwave.codec.group", "encode_mask"),
    ("mask", "terrainwave.codec.group", "decode_mask"),
    ("borders", "terrainwave.codec.predictive", "code_border"),
    ("planes", "terrainwave.codec.predictive", "split"),
    ("planes", "terrainwave.codec.predictive", "merge"),
    ("planes", "terrainwave.codec.predictive", "fill_frame"),
    ("planes", "terrainwave.codec.predictive", "fill_bends"),
    ("choice", "terrainwave.codec.predictive", "_choose"),
    ("pass", "terrainwave.codec.predictive", "code_pass"),
    ("unit", "terrainwave.codec.predictive", "_code_unit"),
    ("unit", "terrainwave.write.encoder", "encode_unit"),
    ("unit", "terrainwave.read.decoder", "decode_unit"),
    ("write", "terrainwave.write.compress", "assemble"),
)
PARTS = ("taps", "core", "distances", "errors", "activity")


class Clock:
    """Time spent in stages, each without the stages inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner = [0.0]

    def wrap(self, stage: str, function: Callable) -> Callable:
        """Return `function`, its time added to `stage`."""

        def timed(*arguments, **options):
            self._inner.append(0.0)
            start = time.thread_time()
            try:
                return function(*arguments, **options)
            finally:
                spent = time.thread_time() - start
                self.seconds[stage] += spent - self._inner.pop()
                self._inner[-1] += spent

        return timed


class Inline:
    """An executor of no threads, so that all stages share one clock."""

    def __init__(self, *arguments, **options) -> None:
        pass

    def __enter__(self):
        """Return itself."""
        return self

    def __exit__(self, *exc_info) -> None:
        """Do nothing."""

    def shutdown(self) -> None:
        """Do nothing."""

    def map(self, function, *values):
        """Call `function` when results are asked for."""
        return map(function, *values)


@numba.njit
def _run_part(part, arguments, n_rows, n_cols):
    """Run one kernel of a pass on all of its rows."""
    planes, errors, activity, bends, own, geometry, weights, e_weights, rows = arguments
    for row in range(n_rows):
        if part == 0:
            nested._add_taps(rows[0], planes, geometry.taps, weights, row, n_cols)
        elif part == 1:
            nested._sort_core(
                planes, geometry.core, row, n_cols, rows[1], rows[2], rows[3], rows[4]
            )
        elif part == 2:
            nested._add_spread(
                rows[6], planes, bends, geometry.core, geometry.bends, geometry.lines, row, n_cols,
                own == 1, e_weights, rows[1], rows[4],
            )  # fmt: skip
        elif part == 3:
            nested._add_errors(
                rows[5], errors, activity, own, geometry.near, geometry.far, row, n_cols, e_weights
            )
        else:
            above, errors_here = activity[own, row + PAD - 1], errors[own, row + PAD]
            nested._update_activity(errors_here, above, n_cols, rows.reshape(-1))


def time_parts(seconds: dict[str, float], arguments: tuple) -> None:
    """Add what the parts of a pass take, run again on its arrays, to `seconds`."""
    n_rows, n_cols = arguments[1].shape
    for part, name in enumerate(PARTS):
        start = time.thread_time()
        _run_part(part, (*arguments[2:10], arguments[15]), n_rows, n_cols)
        seconds[f"row: {name}"] += time.thread_time() - start


def run_task(task: Callable[[], object], with_parts: bool) -> dict[str, float]:
    """Return the seconds of each stage of one run."""
    import importlib

    clock = Clock()
    parts: dict[str, float] = defaultdict(float)
    with ExitStack() as stack:
        for stage, module_name, name in STAGES:
            owner = importlib.import_module(module_name)
            *classes, name = name.split(".")
            for part in classes:
                owner = getattr(owner, part)
            function = clock.wrap(stage, getattr(owner, name))
            if name == "code_pass" and with_parts:
                function = _with_parts(getattr(owner, name), parts)
            stack.enter_context(mock.patch.object(owner, name, function))
        start = time.thread_time()
        task()
        total = time.thread_time() - start
    if with_parts:
        return dict(parts)
    found = dict(clock.seconds)
    found["rest"] = total - sum(found.values())
    found["total"] = total
    return found


def _with_parts(function: Callable, seconds: dict[str, float]) -> Callable:
    def timed(*arguments):
        function(*arguments)
        time_parts(seconds, arguments)

    return timed


def stage_costs(task: Callable[[], object], n_runs: int) -> dict[str, float]:
    """Return the least seconds of each stage over some runs after a first one."""
    runs = [run_task(task, False) for _ in range(n_runs + 1)][1:]
    costs = {stage: min(run[stage] for run in runs) for stage in runs[0]}
    runs = [run_task(task, True) for _ in range(n_runs + 1)][1:]
    parts = {stage: min(run[stage] for run in runs) for stage in runs[0]}
    # Trials of the encoder are passes as well.
    costs["row: samples"] = costs.pop("pass") - sum(parts.values())
    return costs | parts


@contextmanager
def _inline():
    with (
        mock.patch("terrainwave.write.compress.ThreadPoolExecutor", Inline),
        mock.patch("terrainwave.terrain.ThreadPoolExecutor", Inline),
    ):
        yield


def measure(raster: Raster, max_error: float, effort: str, n_runs: int, folder: Path):
    """Yield rows: what encoding and decoding a raster cost in each stage."""
    import terrainwave

    source, target = folder / "source.tif", folder / "stages.twz"
    write_geotiff(raster, source)

    def encode() -> None:
        terrainwave.compress(
            source, target, max_error=max_error, method="predictive", effort=effort, threads=1,
            verify=False, mesh="none", overwrite=True,
        )  # fmt: skip

    def decode() -> None:
        with terrainwave.open(target, threads=1) as terrain:
            terrain.read()

    n_samples = raster.heights.size
    with _inline():
        for task, function in (("encode", encode), ("decode", decode)):
            costs = stage_costs(function, n_runs)
            bits = round(8 * target.stat().st_size / n_samples, 4)
            head = (raster.name, n_samples, max_error, effort, bits, task)
            for stage, seconds in sorted(costs.items(), key=lambda item: -item[1]):
                yield (*head, stage, round(seconds / n_samples * 1e9, 2))


@click.command(cls=ListCommand)
@click.argument("places", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--max-error", "max_errors", cls=ListOption, type=click.FloatRange(min=0), default=(1.0, 10.0)
)
@click.option("--crop", type=click.IntRange(min=1), help="Use the upper left N x N samples.")
@click.option("--runs", type=click.IntRange(min=1), default=3, show_default=True)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/stages.csv"),
    show_default=True,
)
def main(places, max_errors, crop, runs, out) -> None:
    """Write the nanoseconds per sample of each stage to a CSV."""
    pin_to_one_core()
    with tempfile.TemporaryDirectory() as folder, out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*FIELDS, "ns_per_sample"))
        for path in find_rasters(list(places)):
            raster = load_raster(path, crop)
            for max_error in max_errors:
                for effort in EFFORTS:
                    for row in measure(raster, max_error, effort, runs, Path(folder)):
                        writer.writerow(row)
                        click.echo(",".join(map(str, row)))
                    file.flush()
    text = json.dumps(describe_machine(), indent=2) + "\n"
    out.with_suffix(".json").write_text(text, encoding="utf-8")
    sys.exit(0)


if __name__ == "__main__":
    main()
