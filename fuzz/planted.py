"""Can the fuzzer find? ``python -m fuzz.planted`` takes checks out of readers and looks how long.

Each is removed in a copy of the package, which is fuzzed until the first find; a line for each goes
to ``benchmarks/results/fuzz_planted.csv``. The corpus is that of the repository.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import namedtuple
from pathlib import Path
from typing import NamedTuple

import click

from benchmarks import common
from fuzz.run import ROOT


class Planted(NamedTuple):
    """A check of a reader, what stands in its place, and the target that should miss it."""

    check: str
    target: str
    mode: str
    path: str
    before: str
    after: str


PLANTED = (
    Planted(
        "remainders: as many planes as bytes of a number", "remainders", "compiled",
        "codec/remainder_planes.py", "if not 1 <= n_planes <= width:", "if False:",
    ),
    Planted(
        "index page: as many bytes as its layout has", "pages", "compiled",
        "container/page.py", "if len(content) != expected:", "if False:",
    ),
    Planted(
        "exceptions: a bit for each height that equals nodata", "store", "python",
        "codec/group.py",
        "if len(section) < n_needed or (len(section) > n_needed and not is_part):", "if False:",
    ),
    Planted(
        "range decoder: no byte beyond the stream", "masks", "python",
        "coding/rangecoder.py",
        "np.int64(stream[np.uint64(pos - 1)]) if pos <= stream.shape[0] else np.int64(0)",
        "np.int64(stream[np.uint64(pos - 1)])",
    ),
    Planted(
        "tables of rapid: families that exist", "parameters", "python",
        "codec/rapid/file_tables.py", "if family >= N_FAMILIES:", "if False:",
    ),
)  # fmt: skip

Row = namedtuple("Row", "check target mode seconds found")


def hunt(planted: Planted, folder: Path, patience: float) -> Row:
    """Return how long the fuzzer took to find what is wrong in a copy."""
    for part in ("src", "fuzz", "tests/golden"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    path = folder / "src" / "terrainwave" / planted.path
    text = path.read_text(encoding="utf-8")
    if planted.before not in text:
        raise click.ClickException(f"{planted.path} has no such check any more")
    path.write_text(text.replace(planted.before, planted.after), encoding="utf-8")
    finds = folder / "build" / "fuzz" / "finds"
    command = [sys.executable, "-m", "fuzz.run", planted.target, "--mode", planted.mode,
               "--seconds", str(patience), "--out", str(folder / "fuzz.csv")]  # fmt: skip
    began = time.monotonic()
    with subprocess.Popen(
        command, cwd=folder, start_new_session=True, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as fuzzer:  # fmt: skip
        has_found = False
        while not has_found and fuzzer.poll() is None:
            time.sleep(0.2)
            has_found = any(not path.name.startswith("slowest-") for path in finds.glob("*"))
        seconds = time.monotonic() - began
        if fuzzer.poll() is None:
            os.killpg(fuzzer.pid, signal.SIGKILL)
    return Row(planted.check, planted.target, planted.mode, round(seconds, 1), int(has_found))


@click.command(help=__doc__)
@click.option("--patience", type=float, default=120, help="Seconds for each.")
@click.option("--out", type=common.FILE, default=common.RESULTS / "fuzz_planted.csv")
def main(patience: float, out: Path) -> None:
    """Hunt each, print a line, exit 1 if one is not found."""
    rows = []
    for planted in PLANTED:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            rows.append(hunt(planted, Path(folder), patience))
            click.echo(rows[-1])
    common.write_rows(out, rows)
    if not all(row.found for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
