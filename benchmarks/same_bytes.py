"""Golden files in many environments: ``python -m benchmarks.same_bytes``.

In each environment (another processor for LLVM, fewer vector instructions, other loops of numpy,
other numbers of threads, other releases) all files of ``tests/golden`` are decoded wholly, heights,
masks and meshes of all levels, and compared with their manifest; and the raster of each is
compressed anew, and the file compared byte by byte with the one of the first environment here.
Kernels are compiled anew for each interpreter and for each setting that changes them.

``--python NAME=PATH`` adds an environment of another interpreter, which needs what the package
depends on, and hypothesis (a test's module makes the rasters). ``--decode-only`` writes no files:
emulated processors compile for minutes. `widest` is what additions of
int32 in a loop use in that environment: xmm, ymm or zmm.

Exit status: 0 good; 1 something differs; 2 wrong usage.
"""

import json
import os
import subprocess
import sys
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click

from benchmarks import common

THREADS = (1, 2, 3, 4, 8, 16)
AVX512 = (
    "f",
    "bw",
    "cd",
    "dq",
    "vl",
    "ifma",
    "vbmi",
    "vbmi2",
    "vnni",
    "bitalg",
    "vpopcntdq",
    "bf16",
)
NO_AVX512 = [f"-avx512{name}" for name in AVX512]
NO_AVX2 = [*NO_AVX512, "-avx2", "-fma", "-f16c", "-xop", "-fma4"]
# What an environment has besides. Numpy has loops for several processors; so has its OpenBLAS.
ENVIRONMENTS: dict[str, dict[str, str]] = {
    "host": {},
    "generic": {"NUMBA_CPU_NAME": "generic"},
    "no AVX-512": {"NUMBA_CPU_FEATURES": ",".join(NO_AVX512)},
    "no AVX2, no FMA": {"NUMBA_CPU_FEATURES": ",".join(NO_AVX2)},
    "numpy's baseline": {
        "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX2 FMA3",
        "OPENBLAS_CORETYPE": "Prescott",
    },
}  # fmt: skip

_WORKER = """
import sys
sys.path[:0] = ["src", "tests", "tools", "."]
from benchmarks import same_bytes_worker
same_bytes_worker.main(*sys.argv[1:])
"""

# One line of the CSV.
Row = namedtuple(
    "Row",
    "environment python numpy numba rasterio cpu widest threads decoded decoded_equal written "
    "written_equal",
)


def found_in(
    python: str, threads: int, cache: Path, more: dict[str, str], folder: Path, *, writes: bool
) -> dict:
    """Return what the worker finds in an environment."""
    result = folder / "found.json"
    command = [python, "-c", _WORKER, str(threads), str(folder), str(result)]
    command += ["decode only"] * (not writes)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), **more}
    subprocess.run(command, env=environment, cwd=common.ROOT, check=True)
    return json.loads(result.read_text(encoding="utf-8"))


def measured(
    pythons: dict[str, str], threads: list[int], names: list[str], folder: Path, *, writes: bool
):
    """Yield the rows of all environments."""
    runs = [(name, sys.executable, ENVIRONMENTS[name], 1) for name in names]
    runs[1:1] = [("host", sys.executable, {}, n) for n in threads if n > 1]
    runs += [(name, python, {}, 1) for name, python in pythons.items()]
    first: dict[str, str] = {}
    for name, python, more, n_threads in runs:
        compiling = [name for name in more if name.startswith("NUMBA_")]
        cache = folder / f"cache {Path(python).parts[-3]} {name if compiling else 'host'}"
        found = found_in(python, n_threads, cache, more, folder, writes=writes)
        first = first or found["written"]
        n_equal = sum(first[case] == digest for case, digest in found["written"].items())
        for case, digest in found["written"].items():
            if first[case] != digest:
                click.echo(f"{name}: {case} is written otherwise")
        for case, is_equal in found["decoded"].items():
            if not is_equal:
                click.echo(f"{name}: {case} is decoded otherwise")
        yield Row(
            name, found["python"], found["numpy"], found["numba"], found["rasterio"], found["cpu"],
            found["widest"], n_threads, len(found["decoded"]), sum(found["decoded"].values()),
            len(found["written"]), n_equal,
        )  # fmt: skip


def _pairs(_context, _parameter, values: tuple[str, ...]) -> dict[str, str]:
    if any("=" not in value for value in values):
        raise click.BadParameter("expected NAME=PATH")
    return dict(value.split("=", 1) for value in values)


@common.command("same_bytes.csv")
@common.option("--python", "pythons", multiple=True, callback=_pairs, metavar="NAME=PATH")
@common.option("--threads", cls=common.ListOption, type=common.COUNT, default=THREADS)
@common.option(
    "--only",
    cls=common.ListOption,
    type=click.Choice(list(ENVIRONMENTS)),
    default=list(ENVIRONMENTS),
)
@common.option("--decode-only", is_flag=True, help="Write no files.")
@common.option("--append", is_flag=True, help="Keep the rows that are there.")
def main(pythons, threads, only, decode_only, append, folder: Path, out: Path) -> None:
    """Run all environments."""
    names = ["host", *(name for name in only if name != "host")]
    rows: Iterator[Row] = measured(pythons, threads, names, folder, writes=not decode_only)
    if append and out.exists():
        next(rows)  # what others are compared with is there
    written = common.write_rows(out, rows, append=append)
    is_good = all(
        row.decoded == row.decoded_equal and row.written == row.written_equal for row in written
    )
    raise SystemExit(0 if is_good else 1)


if __name__ == "__main__":
    main()
