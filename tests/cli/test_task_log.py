"""What tasks of a cluster took: a CSV and a table."""

import csv
import os
from contextlib import closing

import pytest

from terrainwave.cli.task_log import TaskLog, task_log
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
    with task_log(str(path), [], overwrite=False) as log:
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
    path = tmp_path / "tasks.csv"
    path.write_bytes(b"others")
    with pytest.raises(StorageError, match="already exists and is left as it is; overwrite"):
        with task_log(str(path), [], overwrite=False):
            pass
    assert path.read_bytes() == b"others"
    with task_log(str(path), [], overwrite=True) as log:
        assert path.read_bytes() == b"others"  # until there is something to say
        log(report())
    assert path.read_text().startswith("stage,row,col")


def test_a_run_that_fails_before_its_first_task_leaves_no_file(tmp_path):
    path = tmp_path / "tasks.csv"
    with pytest.raises(ValueError, match="no scheduler"):
        with task_log(str(path), [], overwrite=False):
            raise ValueError("no scheduler")
    assert not path.exists()


def test_what_the_command_reads_or_writes_is_no_log(tmp_path):
    raster = tmp_path / "heights.csv"
    raster.write_bytes(b"heights")
    with pytest.raises(StorageError, match="is read or written by this command"):
        with task_log(str(raster), ["other.tif", str(raster)], overwrite=True):
            pass
    assert raster.read_bytes() == b"heights"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a disk that is always full: Linux")
def test_a_full_disk_costs_the_log_and_not_the_run(capsys):
    with closing(TaskLog("/dev/full", overwrite=True)) as log:
        log(report())
        log(report())
        log.print()
    out = capsys.readouterr()
    assert out.err.count("cannot write /dev/full any more: No space left on device") == 1
    assert out.out.splitlines()[1].split()[:3] == ["encoding", "2", "0"]


def test_without_a_name_there_is_no_log():
    with task_log(None, [], overwrite=False) as log:
        assert log is None
