"""Say what a sample costs in each stage of a method: ``python -m benchmarks.stages dem.tif``.

Stages are functions of the package, timed where they are called, each without the stages inside it;
what none covers is "rest". CPU time of one thread, the least of ``--runs`` runs after a first one.
"""

import functools
import importlib
import itertools
import time
from collections import defaultdict, namedtuple
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import terrainwave
from benchmarks import common
from benchmarks.rasters import Raster, load_raster, write_geotiff

METHODS = ("predictive", "rapid")
# Stage, module, names there. Functions of the same stage may call each other.
STAGES = (
    ("read source", "terrainwave.raster_io.source", "RasterSource.read"),
    ("scan", "terrainwave.grid.quantum", "HeightScan.update"),
    ("quanta", "terrainwave.grid.quantum", "Quantizer.quantize Quantizer.dequantize"),
    ("pyramid", "terrainwave.write.pyramid", "Pyramid.build Pyramid.heights Pyramid.mask"),
    ("measure", "terrainwave.write.encoder", "TreeEncoder._measure"),
    ("mask", "terrainwave.codec.group", "_encode_validity _decode_validity"),
    ("borders", "terrainwave.codec.predictive.refiner", "code_border"),
    ("planes", "terrainwave.codec.predictive.refiner", "split merge fill_frame fill_bends"),
    ("choice", "terrainwave.codec.predictive.refiner", "_choose"),
    ("pass", "terrainwave.codec.predictive.refiner", "code_pass"),
    ("unit", "terrainwave.codec.predictive.refiner", "_code_unit"),
    ("fit", "terrainwave.codec.rapid.fit", "fit_tables"),
    ("rows", "terrainwave.codec.rapid.unit", "log_details code_heights encode_log"),
    ("unit", "terrainwave.write.encoder", "encode_unit"),
    ("unit", "terrainwave.codec.group", "decode_unit"),
    ("write", "terrainwave.write.compress", "assemble"),
)

FIELDS = "raster n_samples max_error method bits_per_sample task stage ns_per_sample"
Row = namedtuple("Row", FIELDS)


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


def run_task(task: Callable[[], object]) -> dict[str, float]:
    """Return the seconds of each stage of one run."""
    clock = Clock()
    with ExitStack() as stack:
        for stage, module, names in STAGES:
            for path in names.split():
                *classes, name = path.split(".")
                owner = functools.reduce(getattr, classes, importlib.import_module(module))
                timed = clock.wrap(stage, getattr(owner, name))
                stack.enter_context(mock.patch.object(owner, name, timed))
        start = time.thread_time()
        task()
        total = time.thread_time() - start
    return clock.seconds | {"rest": total - sum(clock.seconds.values()), "total": total}


def measure(
    raster: Raster, max_error: float, method: str, n_runs: int, folder: Path
) -> Iterator[Row]:
    """Yield rows: what encoding and decoding a raster cost in each stage."""
    source, target = folder / "source.tif", folder / "stages.twz"
    write_geotiff(raster, source)

    def encode() -> None:
        terrainwave.compress(
            source, target, max_error=max_error, method=method, threads=1, verify=False,
            mesh="none", overwrite=True,
        )  # fmt: skip

    def decode() -> None:
        with terrainwave.open(target, threads=1) as terrain:
            terrain.read()

    n_samples = raster.heights.size
    for task, function in (("encode", encode), ("decode", decode)):
        runs = [run_task(function) for _ in range(n_runs + 1)][1:]
        costs = {stage: min(run[stage] for run in runs) for stage in runs[0]}
        bits = round(8 * target.stat().st_size / n_samples, 4)
        head = (raster.name, n_samples, max_error, method, bits, task)
        for stage, seconds in sorted(costs.items(), key=lambda item: -item[1]):
            yield Row(*head, stage, round(seconds / n_samples * 1e9, 2))


@common.command("stages.csv")
@common.rasters_argument
@common.bounds_option(1.0, 10.0)
@common.crop_option
@common.option("--runs", type=common.COUNT, default=3)
@common.option("--method", "methods", cls=common.ListOption, default=METHODS)
def main(paths, bounds, crop, runs, methods, folder, out) -> None:
    """Write the nanoseconds per sample of each stage to a CSV."""
    common.pin_to_cores()
    cases = itertools.product([load_raster(path, crop) for path in paths], bounds, methods)
    rows = (row for case in cases for row in measure(*case, runs, folder))
    common.write_rows(out, rows)


if __name__ == "__main__":
    main()
