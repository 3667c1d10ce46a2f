"""Hold `twz` against the Python package on more than the conformance set has: python … TWZ.

Rasters of many equal units, with and without voids, rasters at the border of what 16 bits hold, and
plateaus far apart by any tables: all levels, windows, each kind of kernels, one thread and three.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import terrainwave as tw

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fuzz"))
import forced

WAYS = (["--kernels", "baseline"], ["--kernels", "avx2"], [], ["--threads", "3"])
OPTIONS = (
    {"max_error": 0},
    {"max_error": 3},
    {"max_error": 40},
    {"max_error": 1, "method": "predictive"},
    {"max_error": 1, "method": "cdf97"},
    {"max_error": 0, "method": "cdf53"},
)


def terrain(has_voids):
    """Return hills with rough ground on them; with a hole, a float raster."""
    row, col = np.mgrid[:530, :771]
    rough = np.random.default_rng(7).integers(-9, 9, row.shape) * (col > 300)
    heights = (900 * np.sin(row / 60) * np.cos(col / 45)).astype(np.int64) + rough + row * 2
    if not has_voids:
        return heights.astype(np.int16)
    heights = heights.astype(np.float32) / 8
    heights[200:260, 100:400] = np.nan
    return heights


def of_range(span):
    """Return heights of a range that 16 bits hold, or not, with cliffs from end to end."""
    heights = terrain(False).astype(np.int32)[:200, :200]
    heights = (heights - heights.min()) % (span + 1)
    heights[40:90, 30:170] = np.where(heights[40:90, 30:170] % 3 == 0, 0, span)
    return heights - 1_000_000


def plateaus():
    """Return heights near each other within units; sums of all of them do not fit 32 bits."""
    heights = terrain(False).astype(np.int32)[:300, :300] // 100
    heights[:130] -= 30_000
    heights[130:] += 30_000
    return heights.astype(np.int16)


def is_readable(twz, way, path):
    """Say whether this processor has what a way asks for."""
    done = subprocess.run([twz, "info", path, *way], capture_output=True, check=False)
    return done.returncode == 0


def boxes(n_rows, n_cols):
    """Yield windows of which units need their first rows only."""
    yield 0, 0, -(-n_rows // 3), n_cols
    yield n_rows // 3, n_cols // 3, -(-n_rows // 4), -(-n_cols // 4)


def disagreements(twz, path):
    """Yield what is read otherwise, as a whole or by windows."""
    with tw.open(path, threads=1) as terrain_file:
        for level in range(terrain_file.n_levels):
            heights, valid = terrain_file.read_with_mask(level=level, voids="any")
            expected = {(): heights, ("--mask",): np.asarray(valid, dtype=np.uint8)}
            for way in WAYS:
                if not is_readable(twz, way, path):
                    continue
                for what, array in expected.items():
                    command = [twz, "dump", path, "--level", str(level), *what, *way]
                    done = subprocess.run(command, capture_output=True, check=False)
                    if done.stdout != np.ascontiguousarray(array).tobytes():
                        yield f"{path} level {level} {what} {way}: {done.stderr.decode()}"
                for row, col, n_rows, n_cols in boxes(*heights.shape):
                    window = f"{row},{col},{n_rows},{n_cols}"
                    command = [twz, "dump", path, "--level", str(level), "--window", window, *way]
                    done = subprocess.run(command, capture_output=True, check=False)
                    if done.stdout != heights[row : row + n_rows, col : col + n_cols].tobytes():
                        yield f"{path} level {level} window {window} {way}: {done.stderr.decode()}"
        yield from disagreements_on_windows(twz, path, terrain_file)


def disagreements_on_windows(twz, path, terrain_file):
    """Yield what becomes of windows at and beyond the edge that is otherwise in Python."""
    n_rows, n_cols = terrain_file.shape
    height, width = min(n_rows, 9), min(n_cols, 7)
    for window, is_cut in (
        ((n_rows - height, n_cols - width, height, width), False),
        ((n_rows - height, n_cols - width, 20, width), True),
        ((0, n_cols - width, 3, 4_000_000_000), True),
    ):
        expected = terrain_file.read(window, voids="any").tobytes()
        words = "--window", ",".join(map(str, window))
        done = subprocess.run([twz, "dump", path, *words], capture_output=True, check=False)
        has_note = b"note: the window reaches beyond" in done.stderr
        if (done.stdout, has_note, done.returncode) != (expected, is_cut, 0):
            yield f"{path} {words}: {done.stderr.decode()}"
    for window in (f"{n_rows},0,5,5", f"0,{n_cols},5,5", "0,0,0,5"):
        words = "--window", window
        done = subprocess.run([twz, "dump", path, *words], capture_output=True, check=False)
        if done.stdout or done.returncode == 0 or not done.stderr:
            yield f"{path} {words}: found {len(done.stdout)} bytes, expected an error"


def main():
    """Compare all, and say by the status whether they agree."""
    twz = str(Path(sys.argv[1]).resolve())
    n_files, found = 0, []
    with tempfile.TemporaryDirectory() as folder:
        for has_voids in (False, True):
            for number, options in enumerate(OPTIONS):
                path = str(Path(folder) / f"{has_voids}-{number}.twz")
                tw.compress(terrain(has_voids), path, block=64, mesh="none", **options)
                found += disagreements(twz, path)
                n_files += 1
        path = str(Path(folder) / "plateaus.twz")
        with forced.tables(np.random.default_rng(5)):
            tw.compress(plateaus(), path, max_error=0, block=32, mesh="none", method="rapid")
        found += disagreements(twz, path)
        n_files += 1
        for span in (65_533, 65_534, 65_536):
            for bound in (0, 3):  # the ends of the range are kept: cliffs lie on them
                path = str(Path(folder) / f"{span}-{bound}.twz")
                tw.compress(of_range(span), path, max_error=bound, block=32, mesh="none")
                found += disagreements(twz, path)
                n_files += 1
    for line in found:
        print(line)
    print(f"{n_files} files, {len(found)} disagreements")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
