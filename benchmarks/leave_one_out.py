"""Do the trained tables help rasters they never saw: ``python -m benchmarks.leave_one_out DIR``.

For each raster `tools/train_stencils.py` runs on all the others; whole files of the default method
are then written with those tables, with the tables trained on all rasters by the same script, with
the tables in use, and with none (every model at one half, plain stencils). Training takes minutes a
raster; tables found in WORK are not trained again.
"""

import csv
import json
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

import click
import numpy as np

import terrainwave
from benchmarks.bench import BOUNDS
from benchmarks.codecs import is_worth_trying
from benchmarks.machine import describe_machine
from benchmarks.rasters import Raster, load_raster
from terrainwave.codec import nested, tables
from terrainwave.codec.lattice import CORES, HH, HL, LH, TAPS, WEIGHT_BITS
from terrainwave.coding.rangecoder import new_models

TRAINER = Path(__file__).parents[1] / "tools" / "train_stencils.py"
PARTS = ("STENCILS", "E_WEIGHTS", "start_models", "start_border_models")
# The trainer's own start, from which it learns weights of features.
FIRST_GUESS = {
    nested.F_W: 40, nested.F_N: 30, nested.F_NEAR: 30, nested.F_TWIST: 12, nested.F_CONST: 1,
}  # fmt: skip
IN_USE = {part: getattr(tables, part) for part in PARTS}


def train(directory: Path, module: Path, leave_out: str = "") -> None:
    """Write the tables of all rasters in `directory` but `leave_out` to `module`, once."""
    if module.exists():
        return
    options = ["--leave-out", leave_out] if leave_out else []
    command = [sys.executable, str(TRAINER), str(directory), str(module), *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def load_tables(path: Path) -> dict[str, object]:
    """Return the parts of a table module."""
    module = runpy.run_path(str(path))
    return {part: module[part] for part in PARTS}


def untrained() -> dict[str, object]:
    """Return tables that know no terrain: the mean of the core, even odds everywhere."""
    stencils, e_weights = {}, {}
    for plane in (HH, HL, LH):
        places = [tuple(tap) for tap in TAPS[plane]]
        row = np.zeros((1, len(places)), dtype=np.int64)
        row[0, [places.index(tuple(core)) for core in CORES[plane]]] = (1 << WEIGHT_BITS) // 4
        stencils[plane] = row
        e_weights[plane] = np.zeros_like(tables.E_WEIGHTS[plane])
        for feature, weight in FIRST_GUESS.items():
            e_weights[plane][:, feature] = weight
    return {
        "STENCILS": stencils,
        "E_WEIGHTS": e_weights,
        "start_models": new_models,
        "start_border_models": new_models,
    }


def size_with(parts: dict[str, object], path: Path, max_error: float) -> int:
    """Return the bytes of the file written, and proved, with these tables."""
    for name, part in parts.items():
        setattr(tables, name, part)
    try:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "out.twz"
            result = terrainwave.compress(path, out, max_error=max_error, mesh="none", threads=1)
    finally:
        for name, part in IN_USE.items():
            setattr(tables, name, part)
    return result.n_bytes


def bounds_of(raster: Raster) -> list[float]:
    """Return the bounds the raster is measured at, as in docs/benchmarks.md."""
    return [bound for bound in BOUNDS if is_worth_trying(raster, bound, BOUNDS)]


@click.command()
@click.argument("directory", type=click.Path(exists=True, path_type=Path))
@click.option("--work", type=click.Path(path_type=Path), required=True, help="Keeps the tables.")
@click.option("--only", multiple=True, help="Parts of rasters' names.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/leave_one_out.csv"),
    show_default=True,
)
def main(directory: Path, work: Path, only: tuple[str, ...], out: Path) -> None:
    """Train without each GeoTIFF in DIRECTORY and compress it with what the others taught."""
    work.mkdir(parents=True, exist_ok=True)
    train(directory, work / "all.py")
    common = {"all": load_tables(work / "all.py"), "in_use": IN_USE, "untrained": untrained()}
    variants = ["left_out", *common]
    with out.open("w", newline="") as file:
        sink = csv.writer(file, lineterminator="\n")
        sink.writerow(["raster", "max_error", *(f"{name}_bytes" for name in variants)])
        for path in sorted(directory.glob("*.tif")):
            if only and not any(part in path.stem for part in only):
                continue
            train(directory, work / f"{path.stem}.py", path.stem)
            choices = {"left_out": load_tables(work / f"{path.stem}.py"), **common}
            for max_error in bounds_of(load_raster(path)):
                sizes = [size_with(choices[name], path, max_error) for name in variants]
                sink.writerow([path.stem, max_error, *sizes])
                file.flush()
                click.echo(f"{path.stem} {max_error:g}: {sizes}")
    out.with_suffix(".json").write_text(json.dumps(describe_machine(), indent=2) + "\n")


if __name__ == "__main__":
    main()
