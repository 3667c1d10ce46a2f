"""Compare codecs at equal error bounds: ``python -m benchmarks.codecs --help``.

Exit status: 0 good; 1 if a codec broke a bound or failed; 2 wrong usage.
"""

import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import click
from rasterio.errors import NotGeoreferencedWarning
from rich.console import Console

from benchmarks.lists import ListCommand, ListOption
from benchmarks.machine import pin_to_one_core
from benchmarks.measure import Row, Timing, measure, row_head
from benchmarks.peers import NAMES, Codec, make_codecs
from benchmarks.rasters import Forms, Raster, find_rasters, load_raster, make_forms
from benchmarks.report import CsvSink, make_console, print_rows, print_summary


@click.command(cls=ListCommand)
@click.argument("places", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--max-error",
    "max_errors",
    cls=ListOption,
    type=click.FloatRange(min=0),
    default=(0.0, 1.0, 3.0, 10.0),
    help="Bounds, in the rasters' units. 0 is left out where heights are on no grid.",
)
@click.option(
    "--codecs",
    "names",
    cls=ListOption,
    type=click.Choice(NAMES),
    default=NAMES,
    help="Which codecs; all that are installed by default.",
)
@click.option(
    "--method",
    "methods",
    cls=ListOption,
    default=("cdf97", "store"),
    help="terrainwave's methods.",
)
@click.option("--crop", type=click.IntRange(min=1), help="Use the upper left N × N samples.")
@click.option(
    "--runs",
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    help="Timed runs, after one that is discarded.",
)
@click.option(
    "--patience",
    type=float,
    default=60.0,
    show_default=True,
    help="Seconds after which no further run is begun.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/codecs.csv"),
    show_default=True,
)
def main(places, max_errors, names, methods, crop, runs, patience, out) -> None:
    """Compare codecs on the GeoTIFFs in PLACES (files or directories)."""
    console = make_console()
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    if not pin_to_one_core():
        console.print("cannot pin to one core here: some codecs may use more")
    paths = find_rasters(list(places))
    if not paths:
        raise click.UsageError("no GeoTIFFs there")
    timing = Timing(runs, patience)
    with tempfile.TemporaryDirectory() as folder, CsvSink(out) as sink:
        codecs = load_codecs(console, names, methods, Path(folder))
        rows: list[Row] = []
        for path in paths:
            raster = load_raster(path, crop)
            found = list(measure_raster(raster, codecs, max_errors, timing, sink))
            if found:
                print_rows(console, found)
            rows += found
    print_summary(console, rows)
    failed = [row for row in rows if row.failed]
    for row in failed:
        line = f"{row.raster} at {row.max_error:g}, {row.codec}: {row.problem}"
        console.print(line, style="red", markup=False)
    console.print(f"{len(rows)} cases, {len(failed)} failed; {out}", markup=False)
    raise SystemExit(1 if failed else 0)


def load_codecs(console: Console, names, methods, folder: Path) -> list[Codec]:
    """Return the codecs named; say which of them are not installed."""
    codecs: list[Codec] = []
    for name in names:
        try:
            codecs += make_codecs(name, list(methods), folder)
        except ImportError as error:
            console.print(f"{name}: not installed ({error})", style="yellow", markup=False)
    if not codecs:
        raise click.UsageError("none of the codecs is installed")
    return codecs


def measure_raster(raster: Raster, codecs, max_errors, timing: Timing, sink: CsvSink):
    """Yield the rows of one raster, writing each to `sink` as it comes."""
    forms = make_forms(raster)
    for max_error in max_errors:
        if not is_worth_trying(raster, max_error, max_errors):
            continue
        for codec in codecs:
            row = measure_or_explain(codec, forms, max_error, timing)
            sink.write(row)
            yield row


def is_worth_trying(raster: Raster, max_error: float, max_errors) -> bool:
    """Return False for 0 on no grid, and for 0.1 on integers where 0 is tried anyway."""
    if max_error == 0:
        return raster.quantum > 0
    return not (raster.is_integer and max_error < 1 and 0 in max_errors)


def measure_or_explain(codec: Codec, forms: Forms, max_error: float, timing: Timing) -> Row:
    """Measure; a codec that raises becomes a row that says so."""
    try:
        return measure(codec, forms, max_error, timing)
    except Exception as error:  # noqa: BLE001 - one codec's fault must not end the others'
        row = Row(**row_head(forms.raster, codec.name, max_error))
        return replace(row, problem=explain(error))


def explain(error: Exception) -> str:
    """Return what a row says about a codec that raised."""
    return f"FAILED: {type(error).__name__}: {error}"


if __name__ == "__main__":
    main()
