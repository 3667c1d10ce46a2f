"""Hold the reader in JavaScript against Python, on real rasters.

python js/tools/against_python.py compare DIR   equal bits of all levels, in Node and in Chromium
python js/tools/against_python.py speed DIR     samples per second of both, on one thread, in turns

DIR has GeoTIFFs; `--work` keeps the files that are made of them. Each raster is compressed with
every bound of `--max-error`, by the method that `compress` chooses and by the other of rapid and
predictive. Both need node, the comparison Chromium, chromedriver and selenium besides.
"""

import argparse
import contextlib
import csv
import hashlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import terrainwave

JS = Path(__file__).parents[1]
OTHER = {"rapid": "predictive", "predictive": "rapid"}
N_ROUNDS = 5
N_WARM = 3  # rounds that don't count: both compile
READ = """
    const [path, done] = [arguments[0], arguments[arguments.length - 1]];
    Promise.all([import("/js/src/index.js"), import("/js/testing/levels.js")])
      .then(async ([{ open }, { levelDigests }]) => levelDigests(await open(path)))
      .then(done, (error) => done(String(error)));
"""


def make_files(rasters: Path, work: Path, bounds: list[float]) -> list[Path]:
    """Compress what is not in `work` yet; return the files."""
    found = []
    for raster in sorted(rasters.glob("*.tif")):
        for bound in bounds:
            chosen = work / f"{raster.stem}-{bound:g}-default.twz"
            other = work / f"{raster.stem}-{bound:g}-other.twz"
            if not chosen.exists():
                terrainwave.compress(raster, chosen, max_error=bound)
            if not other.exists():
                method = OTHER[method_of(chosen)]
                terrainwave.compress(raster, other, max_error=bound, method=method)
            found += [chosen, other]
    return found


def method_of(path: Path) -> str:
    """Return the method of a file."""
    with terrainwave.open(path) as terrain:
        return str(terrain.info().method)


def digests(path: Path) -> list[list[str]]:
    """Return SHA-256 of heights and of validity, by level."""
    found = []
    with terrainwave.open(path) as terrain:
        for level in range(terrain.n_levels):
            arrays = terrain.read_with_mask(level=level)
            found.append([hashlib.sha256(array.tobytes()).hexdigest() for array in arrays])
    return found


class Node:
    """A process that answers questions about files, warm from one to the next."""

    def __init__(self) -> None:
        command = ["node", str(JS / "testing" / "serve.js")]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def ask(self, what: str, path: Path) -> Any:
        """Return the answer to a question about a file."""
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps({"what": what, "path": str(path)}) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin
        self.process.stdin.close()
        self.process.wait(30)


@contextlib.contextmanager
def browser(work: Path) -> Iterator[Any]:
    """Yield a function from a file in `work` to what a page in Chromium reads of it."""
    sys.path.insert(0, str(JS.parent / "tests"))
    from ext.browser import chromium
    from ext.static_server import static_server

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "js").symlink_to(JS)
        (Path(folder) / "files").symlink_to(work.absolute())
        with static_server(folder) as server, chromium() as driver:
            driver.set_script_timeout(600)
            driver.get(f"{server.address}/js/package.json")
            yield lambda path: driver.execute_async_script(
                READ, f"{server.address}/files/{path.name}"
            )


def compare(files: list[Path], work: Path) -> int:
    """Print a table; return how many files are read otherwise than by Python."""
    n_wrong = 0
    node = Node()
    print(f"{'file':54} {'method':10} levels  Node   Chromium")
    with browser(work) as read:
        for path in files:
            expected = digests(path)
            equal = [node.ask("digests", path) == expected, read(path) == expected]
            n_wrong += not all(equal)
            words = ["equal" if is_equal else "WRONG" for is_equal in equal]
            method = method_of(path)
            print(
                f"{path.name:54} {method:10} {len(expected):6}  {words[0]}  {words[1]}", flush=True
            )
    node.close()
    print(f"{len(files)} files, {n_wrong} of which differ")
    return n_wrong


def seconds_of_python(path: Path) -> tuple[float, int]:
    """Return the processor time of reading all of a file on one thread, and its samples."""
    with terrainwave.open(path, threads=1) as terrain:
        before = time.process_time()
        heights = terrain.read()
        return time.process_time() - before, heights.size


def speed(files: list[Path], out: Path) -> int:
    """Write a CSV of speeds and print it; return how many are below 0.3 of Python's."""
    node = Node()
    times: dict[Path, list[tuple[float, float]]] = {path: [] for path in files}
    sizes = {}
    for path in files:
        for number in range(-N_WARM, N_ROUNDS):
            python, sizes[path] = seconds_of_python(path)
            taken = node.ask("seconds", path)
            if number >= 0:
                times[path].append((python, taken))
    node.close()
    rows = []
    for path, found in times.items():
        medians = [statistics.median(taken) for taken in zip(*found, strict=True)]
        python, script = (sizes[path] / median / 1e6 for median in medians)
        raster, bound, _ = path.stem.rsplit("-", 2)
        rows.append({
            "raster": raster, "max_error": bound, "method": method_of(path),
            "n_samples": sizes[path],
            "python_msamples_per_s": round(python, 2), "node_msamples_per_s": round(script, 2),
            "ratio": round(script / python, 3), "n_runs": N_ROUNDS,
        })  # fmt: skip
        print(*rows[-1].values(), flush=True)
    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    for method in OTHER:
        ratios = [row["ratio"] for row in rows if row["method"] == method]
        middle = statistics.median(ratios)
        print(f"{method}: ratios {min(ratios)} to {max(ratios)}, median {middle:.3f}")
    return sum(row["ratio"] < 0.3 for row in rows)


def main() -> int:
    """Run one of the two; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["compare", "speed"])
    parser.add_argument("rasters", type=Path)
    parser.add_argument("--max-error", type=float, nargs="+", default=[0, 1])
    parser.add_argument("--work", type=Path)
    results = JS.parent / "benchmarks" / "results"
    parser.add_argument("--out", type=Path, default=results / "javascript.csv")
    told = parser.parse_args()
    with contextlib.ExitStack() as stack:
        work = told.work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        work.mkdir(parents=True, exist_ok=True)
        files = make_files(told.rasters, work, told.max_error)
        wrong = compare(files, work) if told.what == "compare" else speed(files, told.out)
    return min(wrong, 1)


if __name__ == "__main__":
    raise SystemExit(main())
