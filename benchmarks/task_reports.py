"""Reports of the tasks of a cluster: seconds, processor seconds and bytes of each."""

import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any, NamedTuple
from unittest import mock

from terrainwave.write.cluster import DistributedPasses
from terrainwave.write.tasks import workers


class TaskReport(NamedTuple):
    """One task: its pass, its place in the full grid, and what it took.

    `source_bytes` are heights read from the raster, as numbers. The other two are bytes read from
    the depot and written there.
    """

    stage: str
    row: int
    col: int
    n_samples: int
    worker: str
    host: str
    began: float  # seconds since 1970, by the worker's clock
    seconds: float
    cpu_seconds: float
    source_bytes: int
    depot_bytes_read: int
    depot_bytes_written: int


class _Timed(NamedTuple):
    """Outcome of a task, with its times."""

    outcome: Any
    times: tuple[float, float, float]


def _timed(function: Callable[..., Any], *arguments: Any) -> _Timed:
    began, start, cpu = time.time(), time.perf_counter(), time.process_time()
    outcome = function(*arguments)
    return _Timed(outcome, (began, time.perf_counter() - start, time.process_time() - cpu))


class TimingExecutor(Executor):
    """Passes tasks on, to be timed where they run; for runs within `reported`."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def submit(self, function, /, *arguments) -> Future:
        """Submit a task."""
        return self._executor.submit(_timed, function, *arguments)


@contextmanager
def reported(report: Callable[[TaskReport], None]) -> Iterator[None]:
    """Call `report` when the client of a `TimingExecutor` takes the result of a task."""
    take, run = workers._outcome, DistributedPasses._run
    taken: list[tuple[Any, tuple[float, ...]]] = []

    def outcome_of(future: Future) -> Any:
        taken.append(take(future))
        return taken[-1].outcome

    def reporting(
        cluster: DistributedPasses,
        stage: str,
        function: Callable[..., Any],
        tasks: Mapping[Any, Any],
    ) -> Iterator[tuple[Any, Any]]:
        for item, result in run(cluster, stage, function, tasks):
            outcome, times = taken[-1]
            region, place, meter = cluster._region(item), outcome.place, outcome.meter
            report(
                TaskReport(
                    stage, region.row, region.col, region.n_rows * region.n_cols, place.worker,
                    place.host, *times, meter.source_bytes, meter.depot_bytes_read,
                    meter.depot_bytes_written,
                )
            )  # fmt: skip
            yield item, result

    with (
        mock.patch.object(workers, "_outcome", outcome_of),
        mock.patch.object(DistributedPasses, "_run", reporting),
    ):
        yield
