"""One process that fuzzes one target; `fuzz.run` starts it.

``python -m fuzz.worker TARGET FOLDER STATE libFuzzer-arguments…``: finds go to FOLDER; STATE is
JSON of what was done so far, written every second, since a crash or a hang ends the process.
"""

import hashlib
import json
import resource
import sys
import time
import traceback
import warnings
from pathlib import Path

import atheris

from fuzz import IS_COMPILED

ROOT = Path(__file__).parents[1]
# Address space that a target may take beyond what the process has at first.
_MOST_BYTES = 2 << 30
_FINDS_OF_A_PLACE = 3
# What compiles kernels.
COMPILER = [f"terrainwave.coding.{name}" for name in ("borrowed", "jit")]


def kernel_modules() -> list[str]:
    """List the modules with kernels: numba compiles no instrumented code."""
    source = ROOT / "src"
    return [
        ".".join(path.relative_to(source).with_suffix("").parts)
        for path in (source / "terrainwave").rglob("*.py")
        if "terrainwave.coding.jit import" in path.read_text(encoding="utf-8")
    ]


with atheris.instrument_imports(
    include=["terrainwave"],
    exclude=[*kernel_modules(), *COMPILER] if IS_COMPILED else [],
):
    from fuzz import checksums, targets


class Watch:
    """Runs a target, counts, and keeps what it finds."""

    def __init__(self, name: str, folder: Path, state: Path) -> None:
        self._name, self._folder, self._state = name, folder, state
        self._places: dict[str, int] = {}
        self._written = time.monotonic()
        self.found = {"executions": 0, "accepted": 0, "finds": 0, "memory": 0}
        self.begin()

    def begin(self) -> None:
        """Take times from now on."""
        self._began = time.monotonic()
        self.found["slowest"] = 0.0

    def __call__(self, data: bytes) -> None:
        """Take one input."""
        started = time.perf_counter()
        try:
            self.found["accepted"] += targets.call(self._name, data)
        except Exception as error:  # noqa: BLE001 - any error is a find
            self._keep(data, error)
        now = time.perf_counter()
        self.found["executions"] += 1
        if now - started > self.found["slowest"]:
            self.found["slowest"] = now - started
            (self._folder / f"slowest-{self._name}").write_bytes(data)
        if now - self._written > 1:
            self.write()

    def _keep(self, data: bytes, error: Exception) -> None:
        """Write an input and where it failed; few of each place."""
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{type(error).__name__} {Path(last.filename).name}:{last.lineno}"
        self._places[place] = self._places.get(place, 0) + 1
        self.found["finds"] += self._places[place] == 1
        if self._places[place] <= _FINDS_OF_A_PLACE:
            path = self._folder / f"find-{self._name}-{hashlib.sha256(data).hexdigest()[:12]}"
            path.write_bytes(data)
            lines = "".join(traceback.format_exception(error))
            path.with_suffix(".txt").write_text(lines, encoding="utf-8")

    def write(self) -> None:
        """Write what was done so far."""
        self._written = time.perf_counter()
        self.found["seconds"] = time.monotonic() - self._began
        self.found["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        self._state.write_text(json.dumps(self.found), encoding="utf-8")


def main() -> None:
    """Fuzz until libFuzzer has done its time."""
    name, folder, state, *arguments = sys.argv[1:]
    watch = Watch(name, Path(folder), Path(state))
    warnings.simplefilter("ignore")
    with checksums.ignored():
        # Kernels are compiled before the clock and the limits begin.
        for path in targets.seeds(name) if IS_COMPILED else ():
            watch(path.read_bytes())
        watch.begin()
        with open("/proc/self/statm", encoding="ascii") as statm:
            size = int(statm.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + _MOST_BYTES, resource.RLIM_INFINITY))
        watch.write()
        atheris.Setup([sys.argv[0], *arguments], watch)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
