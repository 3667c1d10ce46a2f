"""All measurements in one command: ``make bench DATA=DIR``, ``python -m benchmarks.bench DIR``.

Sizes and errors of terrainwave and its peers at equal bounds, then speeds beside SPERR, then the
tables in the documents, a Markdown file and the plot. What the CSVs already hold is not measured
again: a run that was stopped goes on where it was. After a change of a codec, name its CSV:
``--again predictive speeds``.

Exit status: 0 good; 1 if a codec broke a bound or failed; 2 wrong usage.
"""

import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import click
from rasterio.errors import NotGeoreferencedWarning
from rich.console import Console

from benchmarks import plots, speeds, tables
from benchmarks.codecs import is_worth_trying, load_codecs, measure_or_explain
from benchmarks.lists import ListCommand, ListOption
from benchmarks.machine import pin_to_one_core
from benchmarks.measure import Timing
from benchmarks.peers import Codec
from benchmarks.rasters import Forms, find_rasters, load_raster, make_forms
from benchmarks.report import CsvSink, make_console, read_cases

BOUNDS = (0.0, 0.1, 0.5, 1.0, 3.0, 10.0)
PARTS = ("predictive", "cdf97", "peers", "speeds")
PEERS = ("sperr", "sz3", "sz3-interp", "jxl-e9", "cog-overviews")
RESULTS = Path("benchmarks/results")


@dataclass(frozen=True)
class Family:
    """Codecs that share a CSV: names for `make_codecs`, our methods among them."""

    names: tuple[str, ...]
    methods: tuple[str, ...] = ()


FAMILIES = {
    "predictive": Family(("terrainwave",), ("predictive", "predictive-fast", "predictive-best")),
    "cdf97": Family(("terrainwave",), ("cdf97",)),
    "peers": Family(PEERS),
}


@click.command(cls=ListCommand, help=__doc__)
@click.argument("places", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--only",
    "parts",
    cls=ListOption,
    type=click.Choice(PARTS),
    default=PARTS,
    help="Which parts to measure; the documents are always made.",
)
@click.option(
    "--again",
    cls=ListOption,
    type=click.Choice(PARTS),
    help="Parts whose CSV is thrown away first.",
)
@click.option("--max-error", "bounds", cls=ListOption, type=float, default=BOUNDS)
@click.option("--runs", type=click.IntRange(min=1), default=1, show_default=True)
@click.option("--results", type=click.Path(path_type=Path), default=RESULTS, show_default=True)
def main(places, parts, again, bounds, runs, results) -> None:
    """Measure what is missing; write CSVs, tables and the plot."""
    console = make_console()
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    if not pin_to_one_core():
        console.print("cannot pin to one core here: some codecs may use more")
    paths = find_rasters(list(places))
    if not paths:
        raise click.UsageError("no GeoTIFFs there")
    for part in again:
        (results / f"{part}.csv").unlink(missing_ok=True)
    n_failed = 0
    with tempfile.TemporaryDirectory() as folder:
        for part in parts:
            if part == "speeds":
                speeds.measure_all(console, paths, results, Path(folder))
            else:
                n_failed += measure_family(console, part, paths, bounds, runs, results, folder)
    for document in tables.write_all(results):
        console.print(f"wrote {document}", markup=False)
    plots.draw(plots.read_curves([results / f"{name}.csv" for name in FAMILIES]), results)
    console.print(f"{n_failed} failed; {results}", markup=False)
    raise SystemExit(1 if n_failed else 0)


def measure_family(console: Console, part, paths, bounds, runs, results, folder) -> int:
    """Measure what the family's CSV lacks; return how many cases failed."""
    family = FAMILIES[part]
    codecs = load_codecs(console, family.names, family.methods, Path(folder))
    out = results / f"{part}.csv"
    done = read_cases(out)
    n_failed = 0
    with CsvSink(out, append=True) as sink:
        for path in paths:
            raster = load_raster(path)
            missing = [
                (codec, bound)
                for bound in bounds
                for codec in codecs
                if is_worth_trying(raster, bound, bounds)
                and (raster.name, bound, codec.name) not in done
            ]
            if not missing:
                continue
            forms = make_forms(raster)  # takes long where there are voids
            for codec, bound in missing:
                n_failed += measure_case(console, codec, forms, bound, Timing(runs), sink)
    return n_failed


def measure_case(
    console: Console, codec: Codec, forms: Forms, bound: float, timing: Timing, sink: CsvSink
) -> bool:
    """Measure one case, write and print its row; return whether it failed."""
    begin = time.perf_counter()
    row = measure_or_explain(codec, forms, bound, timing)
    sink.write(row)
    found = row.problem or f"{row.bits_per_sample:.4f} bit/sample, error {row.measured_error:g}"
    console.print(
        f"{row.raster} at {bound:g}, {codec.name}: {found} ({time.perf_counter() - begin:.0f} s)",
        markup=False,
        highlight=False,
        style="red" if row.failed else None,
    )
    return row.failed


if __name__ == "__main__":
    main()
