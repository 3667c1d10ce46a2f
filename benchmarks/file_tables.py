"""What tables fitted to the file save: ``python -m benchmarks.file_tables DIR``.

Whole files of the default method without tables of their own, with stencils, and with stencils and
feature weights; bytes and the processor time of encoding (one thread, without the proof, after a
run that compiles).
"""

import csv
import tempfile
import time
from pathlib import Path

import click

import terrainwave
from benchmarks.lists import ListCommand, ListOption
from benchmarks.machine import pin_to_one_core
from terrainwave.codec import predictive
from terrainwave.codec.parameters import NO_TABLES, PLANES

CASES = (
    ("nrw", 0.1), ("nrw", 0), ("etopo5", 0), ("mars", 3), ("bigtujunga", 1), ("bigtujunga", 10),
    ("san_joaquin", 10), ("moon", 1), ("olympic", 3),
)  # fmt: skip
_FIT, _FIT_E = predictive.fit_tables, predictive._fit_e_weights
VARIANTS = ("none", "stencils", "stencils and feature weights")


def choose(variant: str) -> None:
    """Let the encoder fit what `variant` says."""
    none = dict.fromkeys(PLANES)
    predictive.fit_tables = _FIT if variant != "none" else lambda *_: NO_TABLES
    predictive._fit_e_weights = _FIT_E if "feature" in variant else lambda *_: none


@click.command(cls=ListCommand)
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@click.option("--only", cls=ListOption, default=(), help="Parts of rasters' names.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/file_tables.csv"),
    show_default=True,
)
def main(directory: Path, only, out: Path) -> None:
    """Measure the mixed cases of docs/decisions/0006 on the GeoTIFFs in DIRECTORY."""
    pin_to_one_core()
    with tempfile.TemporaryDirectory() as folder, out.open("w", newline="") as file:
        sink = csv.writer(file, lineterminator="\n")
        sink.writerow(["raster", "max_error", "tables", "n_bytes", "parameters", "encode_cpu_s"])
        for part, max_error in CASES:
            paths = sorted(directory.glob(f"*{part}*.tif"))
            if not paths or (only and part not in only):
                continue
            for variant in VARIANTS:
                choose(variant)
                target = Path(folder) / "out.twz"
                start = time.process_time()
                result = terrainwave.compress(
                    paths[0], target, max_error=max_error, threads=1, verify=False, overwrite=True
                )
                used = time.process_time() - start
                with terrainwave.Terrain(target) as terrain:
                    n_parameters = len(terrain.header.parameters)
                row = [paths[0].stem, max_error, variant, result.n_bytes, n_parameters]
                sink.writerow([*row, f"{used:.2f}"])
                file.flush()
                click.echo(f"{row} {used:.2f}")


if __name__ == "__main__":
    main()
