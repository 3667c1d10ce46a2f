"""Reports of the tasks of a cluster: seconds, processor seconds and bytes of each."""

import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any, BinaryIO, NamedTuple
from unittest import mock

from terrainwave.container.depot import Depot
from terrainwave.container.sources.shared import SharedSource
from terrainwave.raster_io.source import RasterSource
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
    """Outcome of a task, with its times and the bytes that it read and wrote."""

    outcome: Any
    times: tuple[float, float, float]
    n_bytes: tuple[int, int, int]


@contextmanager
def _counted() -> Iterator[list[int]]:
    """Count bytes of heights read, and bytes read from the depot and written there."""
    counts = [0, 0, 0]
    close, read, create = RasterSource.close, SharedSource.read, Depot.create

    def closing(source: RasterSource) -> None:
        counts[0] += source.n_bytes_read
        close(source)

    def reading(entry: SharedSource, offset: int, length: int) -> bytes:
        counts[1] += length
        return read(entry, offset, length)

    @contextmanager
    def creating(depot: Depot, name: str) -> Iterator[BinaryIO]:
        with create(depot, name) as file:
            yield file
            counts[2] += file.tell()

    with (
        mock.patch.object(RasterSource, "close", closing),
        mock.patch.object(SharedSource, "read", reading),
        mock.patch.object(Depot, "create", creating),
    ):
        yield counts


def _timed(function: Callable[..., Any], *arguments: Any) -> _Timed:
    """Run a task, the only one of its process at a time."""
    began, start, cpu = time.time(), time.perf_counter(), time.process_time()
    with _counted() as counts:
        outcome = function(*arguments)
    times = began, time.perf_counter() - start, time.process_time() - cpu
    return _Timed(outcome, times, (counts[0], counts[1], counts[2]))


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
    taken: list[_Timed] = []

    def outcome_of(future: Future) -> Any:
        taken.append(take(future))
        return taken[-1].outcome

    def reporting(
        cluster: DistributedPasses,
        stage: str,
        function: Callable[..., Any],
        tasks: Mapping[Any, Any],
        *rest: str,
    ) -> Iterator[tuple[Any, Any]]:
        for item, result in run(cluster, stage, function, tasks, *rest):
            outcome, times, n_bytes = taken[-1]
            region, place = cluster._region(item), outcome.place
            report(
                TaskReport(
                    stage, region.row, region.col, region.n_rows * region.n_cols, place.worker,
                    place.host, *times, *n_bytes,
                )
            )  # fmt: skip
            yield item, result

    with (
        mock.patch.object(workers, "_outcome", outcome_of),
        mock.patch.object(DistributedPasses, "_run", reporting),
    ):
        yield
