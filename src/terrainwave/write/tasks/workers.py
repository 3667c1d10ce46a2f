"""Runs tasks on a cluster: retries failed ones on other workers and duplicates slow ones.

A cluster is a dask client, or any `concurrent.futures.Executor`. Only a client lists its workers.
Tasks give the same bytes wherever they run, also two copies at a time.
"""

import secrets
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from terrainwave.arguments import count_of
from terrainwave.container.spool import TEMPORARY_ADVICE
from terrainwave.errors import (
    ClusterError,
    InvalidHeightsError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.grid.quadtree import Region
from terrainwave.progress import TaskCallback, TaskReport
from terrainwave.write.tasks.measured import TaskOutcome, Workplace, run_task

Item = TypeVar("Item")

# Largest number of attempts at a task, with enough workers. On one machine, its disk may be full
# for only a moment.
_ATTEMPTS = 4
_ATTEMPTS_HERE = 2
_LOOK_AFTER = 2.0  # seconds without a result before the state is checked
# A slow task takes this many times as long as the longest of its pass, and at least these seconds.
_SLOW, _SLOW_SECONDS = 2.0, 30.0
_LONELY_SECONDS = 30.0  # seconds without any worker before a note
_CHOICE = 16  # workers that may repeat a task: thousands of names are too much to send for each
# Errors of dask and concurrent.futures if workers die or are removed.
_LOST = {"KilledWorker", "BrokenProcessPool", "FutureCancelledError", "NoValidWorkerError"}
_LOCAL_ADVICE = "; free space there, or start the worker with --local-directory on a larger disk"


def executor_of(client: Any) -> Executor:
    """Return the executor of a dask client; other executors unchanged."""
    if isinstance(client, Executor):
        return client
    if hasattr(client, "get_executor"):
        # Not pure: a second run must not get the first one's results.
        executor: Executor = client.get_executor(pure=False)
        return executor
    raise InvalidHeightsError(
        f"found a {type(client).__name__} as client, expected a dask.distributed.Client or a"
        " concurrent.futures.Executor"
    )


@dataclass
class _Attempt:
    """One attempt at a task on a worker; without `allowed`, any worker may run it."""

    item: Any
    number: int
    key: str
    allowed: frozenset[str] = frozenset()


@dataclass
class _Pass:
    """State of the tasks of one pass."""

    function: Callable[..., Any]
    tasks: Mapping[Any, tuple[Any, ...]]
    left: set[Any]
    running: dict["Future[TaskOutcome]", _Attempt] = field(default_factory=dict)
    done: "SimpleQueue[Future[TaskOutcome]]" = field(default_factory=SimpleQueue)
    failed_at: dict[Any, list[Workplace]] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)
    copied: set[Any] = field(default_factory=set)
    short_since: float | None = None

    def attempts(self, item: Any) -> Iterator["Future[TaskOutcome]"]:
        """Yield the unfinished attempts at a task."""
        return (future for future, attempt in self.running.items() if attempt.item == item)


class Workers:
    """The workers of a cluster.

    Parameters
    ----------
    client : dask.distributed.Client or concurrent.futures.Executor
    on_task : callable, optional
        Called with a `TaskReport` after each attempt at a task.
    """

    def __init__(self, client: Any, on_task: TaskCallback | None = None) -> None:
        self._executor = executor_of(client)
        self._client = None if isinstance(client, Executor) else client
        self._on_task = on_task
        self._failing: dict[str, Workplace] = {}
        self._lonely_since: float | None = None
        self.names: list[str] = []  # of the tasks' results in the depot

    def run(
        self,
        stage: str,
        function: Callable[..., Any],
        tasks: Mapping[Item, tuple[Any, ...]],
        region: Callable[[Item], Region],
    ) -> Iterator[tuple[Item, Any]]:
        """Yield (item, result) of each task when it is done.

        Parameters
        ----------
        stage : str
            Name of the pass in reports.
        tasks : mapping
            Arguments by item; the first is a `measured.Task`.
        region : callable
            Returns the samples of the full grid that belong to an item.

        Raises
        ------
        TerrainwaveError
            The error of a task on every worker that tried it, or `ClusterError` if workers were
            lost with it too often. Tasks that have not begun are cancelled.
        """
        work = _Pass(function, tasks, set(tasks))
        try:
            for item in tasks:
                self._submit(work, item, 1)
            while work.left:
                try:
                    future = work.done.get(timeout=_LOOK_AFTER)
                except Empty:
                    self._look_after(stage, work)
                    continue
                attempt = work.running.pop(future)
                item = attempt.item
                if item not in work.left or (_is_lost(future) and any(work.attempts(item))):
                    continue  # another copy was first, or may succeed
                outcome = _outcome(future)
                self.names += outcome.meter.names
                self._report(stage, region(item), attempt.number, outcome)
                if outcome.error is not None:
                    self._failed(stage, work, attempt, outcome)
                    continue
                work.left.remove(item)
                work.seconds.append(outcome.seconds)
                for other in list(work.attempts(item)):
                    other.cancel()
                yield item, outcome.result
        finally:
            for future in work.running:
                future.cancel()

    def _submit(
        self, work: _Pass, item: Any, number: int, avoided: frozenset[str] = frozenset()
    ) -> None:
        """Submit a task, to one of `avoided` workers only if there is no other.

        The others are the only ones allowed, not just preferred: dask lets idle workers steal
        tasks, and a worker that fails at once is always idle.
        """
        # Dashboards of dask show the part before the last hyphen.
        key = f"{work.function.__name__}-{secrets.token_hex(16)}"
        options: dict[str, Any] = {}
        others: list[str] = []
        if self._client is not None:
            options["key"] = key
            if avoided:
                others = sorted(set(self._client.nthreads()) - avoided)
            if others:
                first = number * len(work.left) % len(others)
                others = (others[first:] + others[:first])[:_CHOICE]
                options["workers"] = others
        future = self._executor.submit(run_task, work.function, *work.tasks[item], **options)
        work.running[future] = _Attempt(item, number, key, frozenset(others))
        future.add_done_callback(work.done.put)

    def _failed(self, stage: str, work: _Pass, attempt: _Attempt, outcome: TaskOutcome) -> None:
        """Retry a task on another worker, or raise its error after enough attempts."""
        assert outcome.error is not None
        item, place = attempt.item, outcome.place
        if any(work.attempts(item)):
            return
        places = work.failed_at.setdefault(item, [])
        places.append(place)
        tried = {one.worker for one in places}
        others: set[str] = set()
        if self._client is not None:
            others = set(self._client.nthreads()) - tried
        is_last = len(tried) >= _ATTEMPTS or len(places) >= (
            _ATTEMPTS_HERE if self._client is None else 2 * _ATTEMPTS
        )
        if is_last or (self._client is not None and not others and len(places) > 1):
            raise _given_up(stage, outcome, len(tried) - 1)
        if place.worker not in self._failing:
            self._failing[place.worker] = place
            warnings.warn(
                f"{_named(place)} fails: {_message(outcome.error)}; others do its tasks again",
                TerrainwaveWarning,
                stacklevel=2,
            )
        self._submit(work, item, attempt.number + 1, self._avoided(work, item))

    def _avoided(self, work: _Pass, item: Any) -> frozenset[str]:
        """Return the workers that must not retry a task: they failed with it, or with others."""
        tried = {place.worker for place in work.failed_at.get(item, ())}
        return frozenset(tried | self._failing.keys())

    def _report(self, stage: str, region: Region, number: int, outcome: TaskOutcome) -> None:
        if self._on_task is not None:
            self._on_task(
                TaskReport(
                    stage=stage,
                    row=region.row,
                    col=region.col,
                    n_samples=region.n_rows * region.n_cols,
                    attempt=number,
                    worker=outcome.place.worker,
                    host=outcome.place.host,
                    began=outcome.began,
                    seconds=outcome.seconds,
                    cpu_seconds=outcome.cpu_seconds,
                    source_bytes=outcome.meter.source_bytes,
                    depot_bytes_read=outcome.meter.depot_bytes_read,
                    depot_bytes_written=outcome.meter.depot_bytes_written,
                    error="" if outcome.error is None else _message(outcome.error),
                )
            )

    def _look_after(self, stage: str, work: _Pass) -> None:
        """Report a lack of workers; duplicate tasks that are slow or lost."""
        if self._client is None:
            return
        now = time.monotonic()
        threads = self._client.nthreads()
        if threads:
            self._lonely_since = None
        elif self._lonely_since is None:
            self._lonely_since = now
        elif self._lonely_since < now - _LONELY_SECONDS:
            self._lonely_since = float("inf")  # reported once
            warnings.warn(
                f"the cluster has no workers: {count_of(len(work.left), 'task')} of {stage} wait;"
                " start workers with dask worker, or interrupt this run",
                TerrainwaveWarning,
                stacklevel=2,
            )
        for future, attempt in list(work.running.items()):
            if threads and attempt.allowed and attempt.allowed.isdisjoint(threads):
                self._submit(work, attempt.item, attempt.number, self._avoided(work, attempt.item))
                future.cancel()
        if len(work.running) > sum(threads.values()) or not work.seconds:
            work.short_since = None
            return
        if work.short_since is None:
            work.short_since = now
        slow = max(_SLOW_SECONDS, _SLOW * max(work.seconds))
        if now - work.short_since < slow:
            return
        late = [one for one in work.running.values() if one.item in work.left - work.copied]
        if not late:
            return
        busy = {key: worker for worker, keys in self._client.processing().items() for key in keys}
        for attempt in late:
            work.copied.add(attempt.item)
            self._submit(
                work, attempt.item, attempt.number + 1, frozenset({busy.get(attempt.key, "")})
            )


def _is_lost(future: "Future[TaskOutcome]") -> bool:
    return future.cancelled() or type(future.exception()).__name__ in _LOST


def _outcome(future: "Future[TaskOutcome]") -> TaskOutcome:
    if not _is_lost(future):
        return future.result()
    error = None if future.cancelled() else future.exception()
    last = getattr(getattr(error, "last_worker", None), "address", None)
    where = "" if last is None else f" on worker {last} and others before it"
    raise ClusterError(
        f"the cluster has lost a task{where}: its workers, or the scheduler, ended while it ran;"
        " look at their logs, and give workers more memory if that is why"
    ) from error


def _named(place: Workplace) -> str:
    return f"the worker {place.worker} on {place.host}, with temporary files in {place.folder},"


def _message(error: TerrainwaveError) -> str:
    """Return the error's message, with advice for a worker."""
    text = str(error.args[0])
    if text.endswith(TEMPORARY_ADVICE):
        return text.removesuffix(TEMPORARY_ADVICE) + _LOCAL_ADVICE
    return text


def _given_up(stage: str, outcome: TaskOutcome, n_others: int) -> TerrainwaveError:
    """Return the error of a task that workers have failed with."""
    assert outcome.error is not None
    also = f" and by {count_of(n_others, 'other worker')} before," if n_others else ""
    text = f"{_message(outcome.error)}; found by {_named(outcome.place)}{also} while {stage}"
    return type(outcome.error)(text)
