"""What the tasks of a cluster took: a line of a CSV for each, and a table of the passes."""

import csv
import statistics
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, fields
from typing import Any, TextIO

from terrainwave.cli.output import print_grid
from terrainwave.errors import StorageError
from terrainwave.progress import TaskReport

# With the longest name of a pass, as wide as a terminal.
_HEADER = ["pass", "tasks", "failed", "median s", "max s", "read MB", "written MB"]


class TaskLog:
    """Takes reports of tasks: writes a line for each at once, and keeps them for a table."""

    def __init__(self, path: str, file: TextIO) -> None:
        self._path = path
        self._file = file
        self._writer = csv.writer(file, lineterminator="\n")
        self._reports: list[TaskReport] = []
        self._write([field.name for field in fields(TaskReport)])

    def __call__(self, report: TaskReport) -> None:
        """Take the report of an attempt at a task."""
        self._reports.append(report)
        self._write(astuple(report))

    def _write(self, row: Iterable[Any]) -> None:
        from terrainwave.container.spool import storage_errors

        with storage_errors(f"cannot write {self._path}"):
            self._writer.writerow(row)
            self._file.flush()

    def print(self) -> None:
        """Print a line for each pass."""
        print_grid(_HEADER, [_line(stage, self._reports) for stage in self._stages()])

    def _stages(self) -> list[str]:
        return list(dict.fromkeys(report.stage for report in self._reports))


def _line(stage: str, reports: list[TaskReport]) -> list[str]:
    own = [report for report in reports if report.stage == stage]
    seconds = [report.seconds for report in own]
    n_failed = sum(bool(report.error) for report in own)
    return [
        stage,
        f"{len(own) - n_failed:,}",
        f"{n_failed:,}",
        f"{statistics.median(seconds):.1f}",
        f"{max(seconds):.1f}",
        f"{sum(report.source_bytes + report.depot_bytes_read for report in own) / 1e6:,.1f}",
        f"{sum(report.depot_bytes_written for report in own) / 1e6:,.1f}",
    ]


@contextmanager
def task_log(path: str | None, *, overwrite: bool) -> Iterator[TaskLog | None]:
    """Give a log that is written to `path`; None without one.

    Raises
    ------
    StorageError
        If the file is there and `overwrite` is false, or it cannot be written.
    """
    if path is None:
        yield None
        return
    from terrainwave.container.spool import storage_errors

    try:
        with storage_errors(f"cannot write {path}"):
            file = open(path, "w" if overwrite else "x", newline="", encoding="utf-8")
    except StorageError as error:
        if isinstance(error.__cause__, FileExistsError):
            raise StorageError(
                f"{path} already exists and is left as it is; `overwrite` replaces it"
            ) from error
        raise
    with file:
        yield TaskLog(path, file)
