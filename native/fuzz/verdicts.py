"""Compare the verdicts of `twz check` and `terrainwave verify`: python … BUILD [N [SEED]].

BUILD is the folder of a build, which has `twz` and `mutants`. The files are those of the
conformance set, valid and invalid, some of several segments, and N mutants of the valid ones.
Meshes are not looked into. A file that one accepts and the other one refuses stays where the
message says; docs/FORMAT.md decides which verdict is right.
"""

import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

import terrainwave as tw

GOLDEN = Path(__file__).parents[2] / "tests" / "golden" / "v2"


def write_segments(folder):
    """Write files whose segments have neighbours in all directions, most of them absent."""
    row, col = np.mgrid[:1060, :1100]
    heights = (row // 50 + col // 40).astype(np.int16)
    heights[(row + col > 1100) | ((row + col) // 90 % 3 == 0)] = -1
    for method in ("rapid", "cdf53", "store"):
        path = folder / f"segments-{method}.twz"
        tw.compress(
            heights, path, method=method, block=32, max_error=0, nodata=-1, mesh="none", threads=1
        )
        yield str(path)


def verdict_of_twz(twz, path):
    """Return "" if `twz check` accepts a file, else what it says."""
    done = subprocess.run([twz, "check", path], capture_output=True, check=False, text=True)
    if done.returncode not in (0, 1):
        return f"status {done.returncode}: {done.stderr}"
    return done.stderr.strip() if done.returncode else ""


def verdict_of_python(path):
    """Return "" if `terrainwave verify` accepts a file, else what it says."""
    try:
        return "; ".join(tw.verify(path, threads=1).problems)
    except tw.TerrainwaveError as error:
        return str(error)


def main():
    """Compare all, and say by the status whether they agree."""
    build, *numbers = sys.argv[1:]
    n_mutants, seed = (*map(int, numbers), *(1000, 1)[len(numbers) :])
    folder = Path(tempfile.mkdtemp(prefix="native-verdicts-"))
    valid = [*sorted(map(str, GOLDEN.glob("*.twz"))), *4 * [*write_segments(folder)]]
    subprocess.run([f"{build}/mutants", folder, str(n_mutants), str(seed), *valid], check=True)
    counts, n_different = Counter(), 0
    golden = sorted(GOLDEN.glob("**/*.twz"))
    for path in (*golden, *sorted(folder.iterdir())):
        found = verdict_of_twz(f"{build}/twz", path), verdict_of_python(path)
        is_alike = bool(found[0]) == bool(found[1]) and not found[0].startswith("status")
        counts["refused" if found[1] else "accepted"] += is_alike
        if not is_alike:
            n_different += 1
            print(f"{path}\n  twz check: {found[0] or 'ok'}\n  terrainwave: {found[1] or 'ok'}")
        elif Path(path).parent == folder:
            Path(path).unlink()
    if not n_different:
        folder.rmdir()
    print(", ".join(f"{n} files {what} by both" for what, n in sorted(counts.items())), end="")
    print(f", {n_different} by one only")
    sys.exit(bool(n_different))


if __name__ == "__main__":
    main()
