"""Does the load on `terrainwave serve` find a server that answers, and count what it should?"""

import pytest
from click.testing import CliRunner
from ext.rasters import hills, write_raster

from benchmarks import common
from faults import serving


def test_requests_are_counted_by_kind_and_status():
    requests = [["a", 10.0, 200], ["a", 30.0, 503], ["b", 20.0, 404], ["b", 5.0, 0], ["b", 9.0, -1]]
    a, b, everything = serving.rows_of(requests, 2.0)
    assert a == serving.Row("a", 2, 1.0, 10.0, 10.0, 1, 0, 1, 0, 0, 0)
    assert (b.n_4xx, b.n_lost, b.n_hung, b.median_ms) == (1, 1, 1, 20.0)
    assert everything.requests == 5


@pytest.mark.full
def test_ten_clients_get_answers_and_no_500(tmp_path):
    raster = write_raster(tmp_path / "x.tif", hills(300, 400), (8.0, 46.0, 8.5, 46.4))
    out = tmp_path / "serving.csv"
    options = ["--clients", "10", "--slow", "4", "--seconds", "2", "--out", str(out)]
    done = CliRunner().invoke(serving.main, [str(raster), *options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    rows = {row["kind"]: row for row in common.read_rows(out)}
    assert rows["all"]["n_good"] > 20
    assert rows["malformed"]["n_4xx"] == rows["malformed"]["requests"]
    held = common.read_rows(tmp_path / "serving_memory.csv")
    assert [held[k]["connections"] for k in (0, -1)] == [0, 0]
