"""Hold our readers against the set: ``python -m benchmarks.conformance``.

Files by reader and part: passed, outside of what the reader knows, failed. Needs node. The builds
of the library in C are those of ``make native native-sanitized native-arm`` that are there.
"""

import csv
import subprocess
import sys
import tempfile
from collections import Counter, namedtuple
from pathlib import Path

from benchmarks.common import RESULTS, ROOT, write_rows

READERS = {
    "Python": [sys.executable, "tests/conformance/library.py"],
    "reference decoder": [sys.executable, "tests/conformance/reference.py"],
    "JavaScript": ["node", "js/testing/conformance.js"],
}
# Builds of the library, with kinds of its kernels, and what runs them elsewhere.
BUILDS = {
    "gcc": ("baseline", "avx2", "avx512"),
    "clang": ("baseline", "avx2", "avx512"),
    "sanitized": ("auto",),
    "aarch64": ("auto",),
    "arm32": ("auto",),
}
EMULATORS = {
    "aarch64": ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"],
    "arm32": ["qemu-arm", "-L", "/usr/arm-linux-gnueabihf"],
}
for build, kinds in BUILDS.items():
    twz = ROOT / "build" / "native" / build / "twz"
    if twz.exists():
        for kind in kinds:
            READERS[f"C, {build}, {kind} kernels"] = [
                sys.executable, "tests/conformance/native.py", *EMULATORS.get(build, ()), str(twz),
                "--kernels", kind,
            ]  # fmt: skip
Row = namedtuple("Row", "reader part files passed outside failed")


def judged(name):
    """Yield a row for each part of what a reader is asked."""
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "rows.csv"
        runner = [sys.executable, "tools/run_conformance.py", "--csv", str(table), "--"]
        subprocess.run([*runner, *READERS[name]], cwd=ROOT, stdout=subprocess.DEVNULL, check=False)
        with table.open(newline="", encoding="utf-8") as file:
            counts = Counter((row["part"], row["outcome"]) for row in csv.DictReader(file))
    for part in ("metadata", "heights", "blocks", "meshes", "invalid"):
        found = [counts[part, outcome] for outcome in ("passed", "outside", "failed")]
        yield Row(name, part, sum(found), *found)


if __name__ == "__main__":
    write_rows(RESULTS / "conformance.csv", (row for name in READERS for row in judged(name)))
