"""What `same_bytes` runs in each environment, with nothing installed but what the package needs."""

import functools
import hashlib
import json
import platform
import re
from pathlib import Path

import numba
import numpy as np
import rasterio

import terrainwave


def widest_registers() -> str:
    """Return the widest vector registers of additions in a compiled loop that vectorises."""

    @numba.njit
    def add(one, other, result):
        for index in range(result.size):
            result[index] = one[index] + 3 * other[index]

    array = np.zeros(64, np.int32)
    add(array, array, array.copy())
    (code,) = add.inspect_asm().values()
    return max(re.findall(r"padd\w\b.*?([xyz]mm)\d", code), default="none")


def processor() -> str:
    """Return the processor that numba compiles for, and features given by the environment."""
    from llvmlite import binding
    from numba.core import config

    name = config.CPU_NAME or binding.get_host_cpu_name()
    return f"{name} {config.CPU_FEATURES}" if config.CPU_FEATURES else name


def main(threads: str, folder: str, result: str, less: str = "") -> None:
    """Decode all golden files, and write them unless asked for less; leave what was found."""
    # Golden files are made and read by one thread; here by as many as asked for.
    for name in ("open", "compress"):
        function = functools.partial(getattr(terrainwave, name))

        def with_threads(*arguments, function=function, **options):
            return function(*arguments, **options | {"threads": int(threads)})

        setattr(terrainwave, name, with_threads)
    import golden_files
    import make_golden

    decoded, written = {}, {}
    for path in sorted(golden_files.GOLDEN.glob("v*/manifest.json")):
        files = json.loads(path.read_text(encoding="utf-8"))["files"]
        for name, expected in files.items():
            try:
                found = golden_files.found(path.with_name(name))
            except (terrainwave.TerrainwaveError, TypeError) as error:  # TypeError: numba's own
                print(f"{name}: {error}")
                found = {"sha256": "not decoded"}
            decoded[f"{path.parent.name}/{name}"] = found == {key: expected[key] for key in found}
    for name, case in () if less else make_golden.CASES.items():
        target = Path(folder, f"{name}.twz")
        make_golden.write_case(target, *case)
        written[name] = hashlib.sha256(target.read_bytes()).hexdigest()
        target.unlink()
    found = {
        "python": platform.python_version(), "numpy": np.__version__, "numba": numba.__version__,
        "rasterio": rasterio.__version__, "cpu": processor(), "widest": widest_registers(),
        "decoded": decoded, "written": written,
    }  # fmt: skip
    Path(result).write_text(json.dumps(found), encoding="utf-8")
