"""Do the trained tables help rasters they never saw: ``python -m benchmarks.leave_one_out DIR``.

For each raster `tools/train_stencils.py` runs on all the others; whole files of `predictive` are
then written with those tables, with those trained on all rasters by the same script, with those in
use, and with none (models at one half, plain stencils). Training takes minutes; `--work` keeps it.
"""

import runpy
import subprocess
import sys
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np

import terrainwave
from benchmarks import common
from benchmarks.codecs import BOUNDS, is_worth_trying
from benchmarks.rasters import load_raster
from terrainwave.codec import nested, tables
from terrainwave.codec.lattice import CORES, HH, HL, LH, TAPS, WEIGHT_BITS
from terrainwave.coding.rangecoder import new_models

TRAINER = common.ROOT / "tools" / "train_stencils.py"
PARTS = ("STENCILS", "E_WEIGHTS", "start_models", "start_border_models")
# The trainer's own start, from which it learns weights of features.
FIRST_GUESS = {
    nested.F_W: 40, nested.F_N: 30, nested.F_NEAR: 30, nested.F_TWIST: 12, nested.F_CONST: 1,
}  # fmt: skip
IN_USE = {part: getattr(tables, part) for part in PARTS}

# One line of the CSV: bytes of whole files by the tables they were written with.
Row = namedtuple("Row", "raster max_error left_out_bytes all_bytes in_use_bytes untrained_bytes")


def trained(directory: Path, module: Path, leave_out: str = "") -> dict[str, object]:
    """Return the tables of all rasters in `directory` but `leave_out`, kept in `module`."""
    if not module.exists():
        options = ["--leave-out", leave_out] if leave_out else []
        command = [sys.executable, str(TRAINER), str(directory), str(module), *options]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    parts = runpy.run_path(str(module))
    return {part: parts[part] for part in PARTS}


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
    return dict(zip(PARTS, (stencils, e_weights, new_models, new_models)))


def size_with(parts: dict[str, object], path: Path, max_error: float, out: Path) -> int:
    """Return the bytes of the file written, and proved, with these tables."""
    with mock.patch.multiple(tables, **parts):
        result = terrainwave.compress(
            path, out, max_error=max_error, method="predictive", mesh="none", threads=1,
            overwrite=True,
        )  # fmt: skip
    return result.n_bytes


def measure(directory: Path, work: Path) -> Iterator[Row]:
    """Yield the rows of all rasters in `directory`."""
    others = [trained(directory, work / "all.py"), IN_USE, untrained()]
    for path in sorted(directory.glob("*.tif")):
        choices = [trained(directory, work / f"{path.stem}.py", path.stem), *others]
        raster, out = load_raster(path), work / "out.twz"
        for bound in BOUNDS:
            if is_worth_trying(raster, bound, BOUNDS):
                sizes = (size_with(parts, path, bound, out) for parts in choices)
                yield Row(path.stem, bound, *sizes)


@common.command("leave_one_out.csv")
@common.directory_argument
def main(directory: Path, folder: Path, out: Path) -> None:
    """Train without each GeoTIFF and compress it with what the others taught."""
    common.write_rows(out, measure(directory, folder))


if __name__ == "__main__":
    main()
