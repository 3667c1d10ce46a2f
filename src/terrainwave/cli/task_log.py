"""Log of a cluster's tasks: a CSV with a line for each, and a table of the passes."""

import csv
import statistics
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import astuple, fields
from typing import IO, Any

from terrainwave.cli.output import print_grid, print_note
from terrainwave.progress import TaskReport

# Fits a terminal with the longest name of a pass.
_HEADER = ["pass", "tasks", "failed", "median s", "max s", "read MB", "written MB"]


class TaskLog:
    """Receives reports of tasks: writes a line for each, and collects them for a table.

    The first report creates the file, so a run that fails earlier leaves none. If the file cannot
    be written, one note is printed and the run continues.
    """

    def __init__(self, path: str, *, overwrite: bool) -> None:
        self._path, self._mode = path, "w" if overwrite else "x"
        self._file: IO[str] | None = None
        self._is_broken = False
        self._reports: list[TaskReport] = []

    def __call__(self, report: TaskReport) -> None:
        """Record the report of an attempt at a task."""
        self._reports.append(report)
        if self._is_broken:
            return
        try:
            if self._file is None:
                self._file = open(self._path, self._mode, newline="", encoding="utf-8")
                self._write([field.name for field in fields(TaskReport)])
            self._write(astuple(report))
        except OSError as error:
            self._is_broken = True
            print_note(f"cannot write {self._path} any more: {error.strerror}")

    def _write(self, row: Iterable[Any]) -> None:
        assert self._file is not None
        csv.writer(self._file, lineterminator="\n").writerow(row)
        self._file.flush()

    def close(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.close()

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
def task_log(path: str | None, used: Sequence[str], *, overwrite: bool) -> Iterator[TaskLog | None]:
    """Yield a log that is written to `path`; None without one. `used` are the names of other files.

    Raises
    ------
    StorageError
        If the file is one of `used`, cannot be written, or exists and `overwrite` is false.
    """
    if path is None:
        yield None
        return
    from terrainwave.container.targets.publication import check_target, refuse_own_source

    problem = "is read or written by this command; expected another name for the log"
    refuse_own_source(list(used), path, problem=problem)
    check_target(path, overwrite=overwrite)
    with closing(TaskLog(path, overwrite=overwrite)) as log:
        yield log
