"""Counting of requests: rounds by the times they were in flight, bytes by the server."""

from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks import slow_server
from benchmarks.remote import count_rounds, main, window_cost, windows_of
from benchmarks.slow_server import SlowServer
from terrainwave.container.sources.opening import open_source
from terrainwave.errors import StorageError


def test_requests_in_flight_together_are_one_round():
    assert count_rounds([]) == 0
    assert count_rounds([(0, 10), (1, 11), (2, 12)]) == 1
    assert count_rounds([(0, 10), (11, 20), (1, 30), (21, 22)]) == 3


def test_the_first_window_is_the_centre_and_all_lie_inside():
    windows = windows_of(1000, 100, 50)
    assert len(windows) == 50
    assert windows[0] == (450, 450, 100, 100)
    assert np.min(windows) >= 0
    assert all(max(row, col) + 100 <= 1000 for row, col, _, _ in windows)


def test_a_window_of_a_file_costs_what_the_server_sends(tmp_path):
    import terrainwave

    heights = np.random.default_rng(1).integers(0, 1000, (300, 300)).astype(np.int16)
    path = tmp_path / "a.twz"
    terrainwave.compress(heights, path, max_error=0, block=32, mesh="none")
    with SlowServer(tmp_path, 0.0) as server:
        cost = window_cost(server, path.name, (100, 100, 8, 8))
    assert cost.requests >= cost.rounds >= 1
    assert cost.bytes >= cost.needed_bytes - 16 * 1024  # opening brought as much
    assert cost.needed_bytes > 0


@pytest.fixture
def clock(monkeypatch):
    """Seconds of slow servers: they pass when a server sleeps, and at no other time."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)

    def sleep(seconds):
        clock.now += seconds

    clock.sleep = sleep
    monkeypatch.setattr(slow_server, "time", clock)
    return clock


def test_a_slow_server_takes_its_time_and_can_go_down(tmp_path, clock):
    (tmp_path / "a").write_bytes(bytes(25_000))
    with SlowServer(tmp_path, 0.05, 1e6) as server:
        source = open_source(server.url("a"))  # 16 KiB
        assert clock.now == pytest.approx(2 * 0.05 + 16_384 * 8 / 1e6)  # round trips, the line
        assert (server.n_requests, server.n_bytes) == (1, 16_384)
        server.is_down = True
        with pytest.raises(StorageError):
            source.read(20_000, 5_000)
        server.is_down = False
        assert source.read(20_000, 5_000) == bytes(5_000)
    source.close()


def test_a_raster_that_is_missing_is_wrong_usage(tmp_path):
    result = CliRunner().invoke(main, ["missing.tif", "--work", str(tmp_path)])
    assert result.exit_code == 2
