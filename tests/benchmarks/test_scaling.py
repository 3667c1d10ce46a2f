"""What the measurement of clusters says of larger rasters."""

from benchmarks.common import InlineExecutor
from benchmarks.scaling import CountingExecutor, Row, extrapolate


def row(**more):
    zeros = dict.fromkeys(Row._fields, 0)
    return Row(**zeros | {"run": "2 workers", "n_tasks": 4, "n_calls": 20} | more)


def test_tasks_follow_from_the_grid_and_bytes_from_the_samples():
    found = extrapolate(
        row(n_samples=10**8, cpu_workers=36.0, file_bytes=10**7, task_bytes=900, result_bytes=100)
    )
    assert found.n_tasks == 245**2  # parts of 4096 samples a side
    assert found.n_calls == 5 * found.n_tasks
    assert found.scheduler_mb == 300.1
    assert found.file_gb == 100
    assert found.hours_workers == 100


def test_calls_and_their_bytes_are_counted():
    counting = CountingExecutor(InlineExecutor())
    assert counting.submit(len, "abc").result() == 3
    assert counting.n_calls == 1
    assert counting.task_bytes > counting.result_bytes > 0
