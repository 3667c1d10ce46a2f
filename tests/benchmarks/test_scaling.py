"""What the measurement of clusters counts, and what the plan of larger runs follows from."""

import pytest
from strategies import terrain_like, write_geotiff

from benchmarks.cluster_plan import (
    Client,
    Cost,
    Costs,
    Inline,
    Site,
    client_costs,
    simulate,
    simulate_pass,
    task_costs,
)
from benchmarks.common import InlineExecutor
from benchmarks.scaling import CountingExecutor
from benchmarks.task_reports import TaskReport, TimingExecutor, reported
from terrainwave.write.compress import compress


def test_calls_and_their_bytes_are_counted():
    counting = CountingExecutor(InlineExecutor())
    assert counting.submit(len, "abc").result() == 3
    assert counting.n_calls == 1
    assert counting.task_bytes > counting.result_bytes > 0


def test_every_task_is_reported_with_its_place_and_its_bytes(tmp_path):
    heights = terrain_like(300, 40)
    write_geotiff(tmp_path / "dem.tif", heights)
    found = []
    with reported(found.append):
        compress(
            tmp_path / "dem.tif", tmp_path / "dem.twz", max_error=1, block=32, task_samples=1,
            client=TimingExecutor(InlineExecutor()),
        )  # fmt: skip
    stages = list(dict.fromkeys(one.stage for one in found))
    assert stages == ["scanning", "making levels", "encoding", "proving"]
    for stage in ("scanning", "proving"):
        own = [one for one in found if one.stage == stage]
        assert sum(one.n_samples for one in own) == heights.size
        assert sum(one.source_bytes for one in own) == heights.nbytes
        assert own[0].row == own[0].col == 0
    assert all(one.seconds > 0 for one in found)


def site(n_workers, **more):
    rates = {"link": 1e12, "source": 1e12, "depot": 1e12} | more
    return Site(n_workers, n_workers, **rates)


@pytest.mark.parametrize(("n_workers", "seconds"), [(1, 12), (2, 6), (4, 3), (5, 3), (12, 1)])
def test_tasks_of_a_second_are_shared_by_workers(n_workers, seconds):
    end, busy, _ = simulate_pass([Cost(1.0)] * 12, Client(), 0.0, site(n_workers), 0.0)
    assert end == pytest.approx(seconds)
    assert busy == pytest.approx(12)


def test_the_source_and_the_scheduler_bound_what_many_workers_do():
    tasks = [Cost(1.0, source=100.0)] * 50
    end, *_ = simulate_pass(tasks, Client(), 0.0, site(50, source=10.0), 0.0)
    assert end == pytest.approx(500 + 1)  # 5000 bytes through a pipe, then the last second
    end, *_ = simulate_pass(tasks, Client(), 2.0, site(50), 0.0)
    assert end == pytest.approx(50 * 2 + 1)
    end, *_ = simulate_pass(tasks, Client(result=3.0), 0.0, site(50), 0.0)
    assert end == pytest.approx(1 + 50 * 3)


def test_more_workers_than_cores_are_slower():
    end, *_ = simulate_pass([Cost(1.0)] * 12, Client(), 0.0, Site(3, 2, 1e12, 1e12, 1e12), 0.0)
    assert end == pytest.approx(6)


COSTS = Costs(
    dense=dict.fromkeys(
        ("scanning", "averaging", "making levels", "encoding", "proving"), Cost(10.0, written=5.0)
    ),
    void={"scanning": Cost(1.0)},
    client={"encoding": Client(7.0, 2.0), "proving": Client(0.0, 1.0)},
    call=0.0,
)


def test_the_client_works_before_a_pass_while_no_task_runs():
    found = simulate(COSTS, 4, 0, site(2))
    assert found["serial"] == pytest.approx(7 + 2 * 4 + 4)
    assert found["seconds"] == pytest.approx(4 * 20 + 19)
    assert found["written"] == 4 * 4 * 5
    assert found["busy"] == pytest.approx(80 / 99)


def test_only_voids_are_averaged_and_void_tasks_take_their_own_time():
    found = simulate(COSTS, 2, 2, site(1))
    assert found["seconds"] - found["serial"] == pytest.approx(5 * 2 * 10 + 2 * 1)


def test_larger_tasks_take_more_and_the_client_copies_as_much():
    found = simulate(COSTS, 1, 0, site(1), larger=2)
    assert found["seconds"] - found["serial"] == pytest.approx(4 * 4 * 10)
    assert found["serial"] == pytest.approx(7 + 2 * 1 + 4 * 1)


def test_the_client_copies_while_tasks_run():
    slow = site(100, latency=8.0)  # 2 * 8 / 16 = 1 s for each result of two passes
    assert simulate(COSTS, 4, 0, slow)["seconds"] == pytest.approx(4 * 10 + 19 + 2 * 4)
    slow = site(100, link=2.5)  # four times 5 bytes, to the depot and from there
    assert simulate(COSTS, 4, 0, slow)["seconds"] == pytest.approx(4 * (10 + 2) + 19 + 4 * 2)


def report(stage, row, seconds):
    return TaskReport(stage, row, 0, 1, "w", "h", 0.0, 99.0, seconds, 8 * (row < 2), 0, 3)


def test_what_the_client_takes_follows_from_runs_over_few_and_many_tasks():
    few = [(3.0, report("scanning", 0, 2.0)), (9.0, report("encoding", 0, 1.0))]
    many = [(5.0, report("scanning", 0, 2.0)), (5.5, report("scanning", 1, 2.0)),
            (13.5, report("encoding", 0, 1.0)), (13.5, report("encoding", 1, 1.0))]  # fmt: skip
    found = client_costs({1: Inline(0.0, few), 2: Inline(0.0, many)})
    assert found["scanning"] == Client(1.0, 0.0, 0.25)
    assert found["encoding"] == Client(4.0, 1.0, 0.0)


def test_costs_of_void_tasks_are_apart():
    reports = [report(stage, row, 1.0 + row)._asdict() for row in range(4)
               for stage in ("scanning", "encoding")]  # fmt: skip
    assert task_costs(reports, is_void=False)["encoding"] == Cost(1.5, 8, 0, 3)
    assert task_costs(reports, is_void=True)["encoding"] == Cost(3.5, 0, 0, 3)
