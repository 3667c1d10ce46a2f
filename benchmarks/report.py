"""Tables on the terminal, CSV and JSON in files."""

import csv
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, fields
from pathlib import Path
from types import TracebackType
from typing import TextIO

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks.machine import describe_machine
from benchmarks.measure import OWN_MASK, Row


class CsvSink:
    """A CSV that is complete after each row, with a JSON about the machine beside it.

    With `append`, rows that are there stay, and the JSON lists what wrote them under "earlier";
    files are touched with the first new row only.
    """

    def __init__(self, path: Path, row_type: type = Row, *, append: bool = False) -> None:
        """Prepare to write to `path`; its directory is made."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._names = [field.name for field in fields(row_type)]
        self._goes_on = append and path.exists()
        self._file: TextIO | None = None
        if not append:
            self._open()

    def _open(self) -> None:
        beside = self._path.with_suffix(".json")
        machine = describe_machine()
        if self._goes_on and beside.exists():
            before = json.loads(beside.read_text(encoding="utf-8"))
            earlier = before.pop("earlier", [])
            if before != machine:
                earlier.append(before)
            if earlier:
                machine["earlier"] = earlier
        beside.write_text(json.dumps(machine, indent=2) + "\n", encoding="utf-8")
        self._file = self._path.open("a" if self._goes_on else "w", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, self._names, lineterminator="\n")
        if not self._goes_on:
            self._writer.writeheader()

    def write(self, row) -> None:
        """Append one row and flush it."""
        if self._file is None:
            self._open()
        assert self._file is not None
        self._writer.writerow(asdict(row))
        self._file.flush()

    def __enter__(self) -> "CsvSink":
        """Return the sink."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


def read_cases(path: Path) -> set[tuple[str, float, str]]:
    """Return the (raster, bound, codec) a CSV holds; none if there is no such file."""
    if not path.exists():
        return set()
    with path.open(encoding="utf-8", newline="") as file:
        return {
            (row["raster"], float(row["max_error"]), row["codec"]) for row in csv.DictReader(file)
        }


def make_console() -> Console:
    """Return a console on which the tables fit, also where the output is a file."""
    console = Console()
    if not console.is_terminal:
        console.width = 140
    return console


def print_rows(console: Console, rows: list[Row]) -> None:
    """Print the rows of one raster as a table, the smallest of each bound marked."""
    first = rows[0]
    title = f"{first.raster}  {first.n_rows} × {first.n_cols}  {first.dtype}"
    table = Table(title=f"{title}  quantum {first.quantum:g}", title_justify="left")
    for heading in ("max error", "codec"):
        table.add_column(heading)
    for heading in (
        "bytes",
        "bits/sample",
        "× best peer",
        "measured",
        "RMSE",
        "enc Ms/s",
        "dec Ms/s",
    ):
        table.add_column(heading, justify="right")
    table.add_column("note")
    for max_error in sorted({row.max_error for row in rows}):
        case = [row for row in rows if row.max_error == max_error]
        reference = best_peer(case)
        for row in sorted(case, key=lambda row: row.n_bytes or math.inf):
            table.add_row(*_cells(row, reference))
        table.add_section()
    console.print(table)


def best_peer(case: Iterable[Row]) -> Row | None:
    """Return the smallest row that is not ours and keeps the bound."""
    peers = [row for row in case if row.n_bytes and not row.problem]
    peers = [row for row in peers if not row.codec.startswith("terrainwave")]
    return min(peers, key=lambda row: row.n_bytes, default=None)


def print_summary(console: Console, rows: list[Row]) -> None:
    """Print each codec's geometric mean of size / best peer over the cases it did."""
    ratios: dict[str, list[float]] = {}
    for key in sorted({(row.raster, row.max_error) for row in rows}):
        case = [row for row in rows if (row.raster, row.max_error) == key]
        reference = best_peer(case)
        for row in case:
            if reference and row.n_bytes and not row.problem:
                ratio = row.n_bytes / reference.n_bytes
                ratios.setdefault(row.codec, []).append(ratio)
    table = Table(title="size / best peer of each case", title_justify="left")
    for heading in ("codec", "geometric mean", "worst", "cases"):
        table.add_column(heading, justify="left" if heading == "codec" else "right")
    for codec, values in sorted(ratios.items(), key=lambda item: _geometric_mean(item[1])):
        mean = _geometric_mean(values)
        table.add_row(codec, f"{mean:.3f}", f"{max(values):.3f}", str(len(values)))
    console.print(table)


def _geometric_mean(values: list[float]) -> float:
    return math.exp(math.fsum(map(math.log, values)) / len(values))


def _cells(row: Row, reference: Row | None) -> list[str]:
    """Format one row."""
    note = escape(row.problem or (row.fill if row.fill not in ("none", OWN_MASK) else ""))
    style = "[bold]{}[/bold]" if row.codec.startswith("terrainwave") else "{}"
    cells = [f"{row.max_error:g}", style.format(row.codec)]
    if row.n_bytes is None:
        return [*cells, *["–"] * 7, note]
    ratio = f"{row.n_bytes / reference.n_bytes:.3f}" if reference else "–"
    return [
        *cells,
        f"{row.n_bytes:,}",
        f"{row.bits_per_sample:.4f}",
        ratio,
        f"{row.measured_error:.6g}",
        f"{row.rmse:.4g}",
        f"{row.encode_speed:.3g}",
        f"{row.decode_speed:.3g}",
        f"[red]{note}[/red]" if row.problem else note,
    ]
