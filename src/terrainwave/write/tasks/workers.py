"""Runs tasks on a cluster; retries failed ones on other workers.

A cluster is a dask client, or any `concurrent.futures.Executor`. Only a client lists its workers.
Tasks give the same bytes wherever they run.
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
from terrainwave.write.tasks.task import TaskOutcome, Workplace, run_task

Item = TypeVar("Item")

# Largest number of attempts at a task, with enough workers. On one machine, its disk may be full
# for only a moment.
_ATTEMPTS = 4
_ATTEMPTS_HERE = 2
_LOOK_AFTER = 2.0  # seconds without a result before the state is checked
_LONELY_SECONDS = 30.0  # seconds without any worker before a note
_CHOICE = 16  # workers that may repeat a task: thousands of names are too much to send
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
class _Pass:
    """The tasks of one pass; `running` has the item and the allowed workers, none for all."""

    function: Callable[..., Any]
    tasks: Mapping[Any, tuple[Any, ...]]
    running: dict["Future[TaskOutcome]", tuple[Any, set[str]]] = field(default_factory=dict)
    done: "SimpleQueue[Future[TaskOutcome]]" = field(default_factory=SimpleQueue)
    failed_at: dict[Any, list[Workplace]] = field(default_factory=dict)


class Workers:
    """The workers of a cluster."""

    def __init__(self, client: Any) -> None:
        self._executor = executor_of(client)
        self._client = None if isinstance(client, Executor) else client
        self._failing: dict[str, Workplace] = {}
        self._lonely_since: float | None = None

    def run(
        self, stage: str, function: Callable[..., Any], tasks: Mapping[Item, tuple[Any, ...]]
    ) -> Iterator[tuple[Item, Any]]:
        """Yield (item, result) of each task when it is done; `tasks` are arguments by item.

        Raise the error of a task on every worker that tried it, or `ClusterError` if workers were
        lost with it too often. Tasks that have not begun are then cancelled.
        """
        work = _Pass(function, tasks)
        try:
            for item in tasks:
                self._submit(work, item)
            while work.running:
                try:
                    future = work.done.get(timeout=_LOOK_AFTER)
                except Empty:
                    self._look_after(stage, work)
                    continue
                if future not in work.running:  # its workers were gone
                    continue
                item, _ = work.running.pop(future)
                outcome = _outcome(future)
                if outcome.error is None:
                    yield item, outcome.result
                else:
                    self._failed(stage, work, item, outcome)
        finally:
            for future in work.running:
                future.cancel()

    def _submit(self, work: _Pass, item: Any) -> None:
        """Submit a task, again to workers that have not failed with it or others, if any.

        The others are the only ones allowed, not just preferred: dask lets idle workers steal
        tasks, and a worker that fails at once is always idle.
        """
        options: dict[str, Any] = {}
        others: list[str] = []
        if self._client is not None:
            # Dashboards of dask show what is before the last hyphen.
            options["key"] = f"{work.function.__name__}-{secrets.token_hex(16)}"
            places = work.failed_at.get(item, ())
            if places:
                tried = {place.worker for place in places}
                others = sorted(set(self._client.nthreads()) - tried - self._failing.keys())
            if others:
                first = len(places) * len(work.running) % len(others)
                others = (others[first:] + others[:first])[:_CHOICE]
                options["workers"] = others
        future = self._executor.submit(run_task, work.function, *work.tasks[item], **options)
        work.running[future] = item, set(others)
        future.add_done_callback(work.done.put)

    def _failed(self, stage: str, work: _Pass, item: Any, outcome: TaskOutcome) -> None:
        """Retry a task on another worker, or raise its error after enough attempts."""
        assert outcome.error is not None
        place = outcome.place
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
        self._submit(work, item)

    def _look_after(self, stage: str, work: _Pass) -> None:
        """Warn if there is no worker; submit tasks again whose workers are all gone."""
        if self._client is None:
            return
        now = time.monotonic()
        threads = self._client.nthreads()
        if threads:
            self._lonely_since = None
        elif self._lonely_since is None:
            self._lonely_since = now
        elif self._lonely_since < now - _LONELY_SECONDS:
            self._lonely_since = float("inf")  # warned
            warnings.warn(
                f"the cluster has no workers: {count_of(len(work.running), 'task')} of {stage}"
                " wait; start workers with dask worker, or interrupt this run",
                TerrainwaveWarning,
                stacklevel=2,
            )
        for future, (item, allowed) in list(work.running.items()):
            if threads and allowed and allowed.isdisjoint(threads):
                del work.running[future]
                future.cancel()
                self._submit(work, item)


def _outcome(future: "Future[TaskOutcome]") -> TaskOutcome:
    error = None if future.cancelled() else future.exception()
    if not future.cancelled() and type(error).__name__ not in _LOST:
        return future.result()
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
    assert outcome.error is not None
    also = f" and by {count_of(n_others, 'other worker')} before," if n_others else ""
    text = f"{_message(outcome.error)}; found by {_named(outcome.place)}{also} while {stage}"
    return type(outcome.error)(text)
