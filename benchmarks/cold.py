"""Processor time of first commands, with an empty cache of kernels: ``python -m benchmarks.cold``.

Each run is a process of its own, its whole time counted: starting, importing, compiling, working.
"warm" is the same command once more, with what the first one compiled. ``--package`` measures
another checkout beside this one, in turns; ``--python`` another environment.
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click

from benchmarks import common

# Seconds of user and system time, medians. `state` is the package and whether its cache is "empty"
# or "warm".
Row = namedtuple("Row", "raster command state n_runs cpu_seconds least most")
READ = "import sys, terrainwave; terrainwave.open(sys.argv[1]).read()"
COMMANDS = ("read", "compress", "compress rapid, bare", "verify")


def arguments_of(command: str, raster: Path, file: Path) -> list[str]:
    """Return what Python is told to run."""
    made = ["-c", common.CLI, "compress", str(raster), str(file.with_suffix(".made.twz"))]
    made += ["--max-error", "1", "--overwrite", "--quiet"]
    return {
        "read": ["-c", READ, str(file)],
        "compress": made,
        "compress rapid, bare": [*made, "--method", "rapid", "--no-mesh", "--no-verify"],
        "verify": ["-c", common.CLI, "verify", str(file), str(raster)],
    }[command]


def seconds_of(python: str, source: Path, arguments: list[str], cache: Path) -> float:
    """Return the processor time of a process; packages that PYTHONPATH names stay behind ours."""
    folders = os.pathsep.join(filter(None, [str(source), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": folders, "NUMBA_CACHE_DIR": str(cache)}
    before = os.times()
    subprocess.run([python, *arguments], env=environment, check=True, stdout=subprocess.DEVNULL)
    after = os.times()
    return after.children_user + after.children_system - before[2] - before[3]


def measure(paths, packages: dict[str, Path], python: str, n_runs: int, folder) -> Iterator[Row]:
    """Yield the rows of each raster and command."""
    for raster in paths:
        file = folder / f"{raster.stem}.twz"
        first = next(iter(packages.values()))
        made = ["-c", common.CLI, "compress", str(raster), str(file), "--max-error", "1", "--quiet"]
        seconds_of(python, first, made, folder / "made")
        for command in COMMANDS:
            found = {(name, cache): [] for name in packages for cache in ("empty", "warm")}
            for _ in range(n_runs):
                for name, source in packages.items():
                    cache = folder / "cache"
                    shutil.rmtree(cache, ignore_errors=True)
                    for kind in ("empty", "warm"):
                        arguments = arguments_of(command, raster, file)
                        found[name, kind].append(seconds_of(python, source, arguments, cache))
            for (name, kind), seconds in found.items():
                yield Row(
                    raster.stem, command, f"{name}-{kind}", n_runs,
                    *(round(f(seconds), 2) for f in (statistics.median, min, max)),
                )  # fmt: skip


@common.command("cold.csv")
@common.rasters_argument
@click.option("--python", default=sys.executable, help="An environment's interpreter.")
@click.option("--package", "others", multiple=True, help="NAME=PATH of another one's src.")
@common.option("--runs", type=common.COUNT, default=5)
def main(paths, python, others, runs, folder, out) -> None:
    """Measure first commands."""
    packages = {"now": common.ROOT / "src"}
    packages |= {name: Path(path) for name, path in (text.split("=", 1) for text in others)}
    common.write_rows(out, measure(paths, packages, python, runs, folder))
    about = out.with_suffix(".json")
    listed = subprocess.run(
        [python, "-m", "pip", "list", "--format", "json"], capture_output=True, check=True
    )
    names = {package["name"]: package["version"] for package in json.loads(listed.stdout)}
    told = json.loads(about.read_text(encoding="utf-8"))
    told["packages"] = {name: names[name] for name in common.PACKAGES if name in names}
    about.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
