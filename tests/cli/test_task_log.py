"""What tasks of a cluster took: a CSV and a table."""

import csv

import pytest

from terrainwave.cli.task_log import task_log
from terrainwave.errors import StorageError
from terrainwave.progress import TaskReport


def report(**more):
    values = {
        "stage": "encoding", "row": 0, "col": 4096, "n_samples": 100, "attempt": 1,
        "worker": "tcp://10.0.0.1:4000", "host": "node1", "began": 0.0, "seconds": 2.0,
        "cpu_seconds": 1.5, "source_bytes": 3_000_000, "depot_bytes_read": 1_000_000,
        "depot_bytes_written": 2_000_000,
    }  # fmt: skip
    return TaskReport(**values | more)


def test_each_attempt_is_a_line_and_each_pass_one_of_the_table(tmp_path, capsys):
    path = tmp_path / "tasks.csv"
    with task_log(str(path), overwrite=False) as log:
        log(report(stage="scanning"))
        log(report(error="the disk is full", seconds=9.0))
        assert path.read_text().count("\n") == 3  # at once: who waits can look
        log(report(attempt=2, worker="tcp://10.0.0.2:4000", seconds=3.0))
        log.print()
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["stage"] for row in rows] == ["scanning", "encoding", "encoding"]
    assert rows[1]["error"] == "the disk is full"
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split() == ["encoding", "1", "1", "6.0", "9.0", "8.0", "4.0"]


def test_a_file_that_is_there_is_not_replaced_unasked(tmp_path):
    path = tmp_path / "dem.tif"
    path.write_bytes(b"heights")
    with pytest.raises(StorageError, match="already exists and is left as it is; overwrite"):
        with task_log(str(path), overwrite=False):
            pass
    assert path.read_bytes() == b"heights"
    with task_log(str(path), overwrite=True):
        pass
    assert path.read_text().startswith("stage,row,col")


def test_without_a_name_there_is_no_log():
    with task_log(None, overwrite=False) as log:
        assert log is None
